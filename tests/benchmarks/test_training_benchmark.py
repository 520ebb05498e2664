"""The benchmark of training runs, and its peers do the same physics with the same gradients."""

from pathlib import Path

import pytest
import torch
from helpers import relative_error, result, run_quick

import torch_mpm as mpm
from benchmarks.speed import memory, network_steps, training, work
from benchmarks.speed.training_scripts import PROJECTS

SCRIPTS = [(key, name) for key, project in PROJECTS.items() for name in project.scripts()]


def strained(key: str, device: str) -> tuple[work.Work, training.Setup]:
    """The work of a project with strains of every kind, fast enough that particles change their cell."""
    w, project = work.make(6), PROJECTS[key]
    s = training.corotated(project, w, device, project.precision)
    F = torch.eye(3) + 0.1 * torch.randn(w.particles, 3, 3)
    C = 5 * torch.randn(w.particles, 3, 3)
    return w, training.Setup(s.state.replace(F=F.to(s.state.x), C=C.to(s.state.x), v=150 * s.state.v), s.step)


@pytest.mark.parametrize("checkpoints", [False, True])
@pytest.mark.parametrize(("key", "name"), SCRIPTS)
def test_scripts_do_the_physics_of_the_rollout(key: str, name: str, checkpoints: bool, device: str) -> None:
    """Positions, and gradients through the steps; moduli of scripts may be logarithms in float32."""
    project, n = PROJECTS[key], 20
    w, s = strained(key, device)
    v = s.state.v.clone().requires_grad_()
    expected, _ = training.rolled(s, n)(v)
    before, after = (torch.floor(x.detach() * w.n - 0.5) for x in (s.state.x, expected))
    assert int((before != after).sum()) > 20
    with torch.set_grad_enabled(project.gradients):
        found, _ = training.scripted(project.scripts()[name], w, s, n, checkpoints)(v)
    tolerance = 1e-6 if project.precision == torch.float64 else 2e-5
    assert relative_error(found - s.state.x, expected - s.state.x) < tolerance
    if not project.gradients:
        return
    grads = [torch.autograd.grad(x[:, 0].sin().sum(), v)[0] for x in (found, expected)]
    assert relative_error(*grads) < tolerance


def test_stress_moves_the_particles_of_the_peer() -> None:
    """With another modulus the positions differ, so the agreement is evidence for the law."""
    s = strained("MPM-PyTorch", "cpu")[1]
    stiff = training.with_room(s, mpm.FixedCorotated(mu=1.1 * work.MU, lam=work.LAM), stress_form="gradient")
    found, other = (training.rolled(setup, 20)(s.state.v)[0] - s.state.x for setup in (s, stiff))
    assert relative_error(other, found) > 1e-3


def test_what_does_not_fit_is_a_row_without_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(forward: training.Forward, v: torch.Tensor) -> None:
        raise torch.OutOfMemoryError("of 1 GiB")

    monkeypatch.setattr(training, "both", full)
    row = training.measured(training.Case("rollout", "all steps", 4, 2), "cpu", 1)
    assert row["forward"] > 0 and row["both"] is None and row["memory"] is None
    assert "does not fit" in training.common.table(training.BESIDE, training.rows_of_peers({"peers": [row]}))


@pytest.mark.thorough
@pytest.mark.skipif(not memory.Resident.available, reason="/proc/self/clear_refs cannot be written to")
def test_resident_memory_of_a_case_is_that_of_its_tensors() -> None:
    """Tensors that ops return, counted here, against the memory that the system reports for another process."""
    case = training.Case("its algorithm", "all steps", 12, 4, project="MPM-PyTorch")
    program = case.program("cpu")
    counted = memory.of_returned_tensors(lambda: training.both(*program))
    assert 0.8 * counted < training.resident(case) < 1.2 * counted + 2**24  # of threads and allocators


def test_a_way_that_fails_is_reported() -> None:
    rows = list(network_steps.rows((2, 2, 2), "cpu", 1, "no_such_backend"))
    assert rows[0]["error"] == 0 and "no_such_backend" in rows[1]["failure"]
    assert "no_such_backend" in network_steps.text(rows) and len(list(network_steps.timed(rows))) == 1


@pytest.mark.thorough
def test_training_program(tmp_path: Path) -> None:
    run_quick("benchmarks.speed.training", tmp_path)
    found = result(tmp_path, "training_*.json")
    assert [row["kept"] for row in found["rollouts"]] == [
        "by default",
        "32 steps",
        "all steps",
        "everything, none again",
    ]
    assert found["disagreement"].keys() == {row["project"] for row in found["peers"]} == PROJECTS.keys()
    assert all((row["both"] or row["forward"]) > 0 and row["fits"] for row in found["peers"])
    eager, compiled = found["networks"]
    assert eager["error"] < 1e-5 and compiled["error"] < 1e-5 and compiled["particles"] == 64
