"""The benchmark of training runs, and its peer in plain torch does the same physics with the same gradients."""

from pathlib import Path

import pytest
import torch
from helpers import relative_error, result, run_quick

import torch_mpm as mpm
from benchmarks.speed import memory, network_steps, training, work


def strained() -> tuple[work.Work, training.Setup]:
    """The work with strains of every kind, fast enough that particles change their cell."""
    w = work.make(6)
    s = training.corotated(w, "cpu", torch.float64)
    F = torch.eye(3, dtype=torch.float64) + 0.1 * torch.randn(w.particles, 3, 3, dtype=torch.float64)
    C = 5 * torch.randn(w.particles, 3, 3, dtype=torch.float64)
    return w, training.Setup(s.state.replace(F=F, C=C, v=150 * s.state.v), s.step)


@pytest.mark.parametrize("checkpoints", [False, True])
@pytest.mark.parametrize("script", training.SCRIPTS)
def test_scripts_do_the_physics_of_the_rollout(script: str, checkpoints: bool) -> None:
    """Positions and velocities, and gradients through the steps; the script's modulus is a logarithm in float32."""
    w, s = strained()
    v, n = s.state.v.clone().requires_grad_(), 20
    expected, _ = training.rolled(s, n)(v)
    found, _ = training.scripted(training.SCRIPTS[script](w, s), s, n, checkpoints)(v)
    before, after = (torch.floor(x.detach() * w.n - 0.5) for x in (s.state.x, expected))
    assert int((before != after).sum()) > 20
    assert relative_error(found - s.state.x, expected - s.state.x) < 1e-6
    grads = [torch.autograd.grad(x[:, 0].sin().sum(), v)[0] for x in (found, expected)]
    assert relative_error(*grads) < 1e-6


def test_stress_moves_the_particles_of_the_peer() -> None:
    """Without it they would be elsewhere, so that the agreement says something of the law."""
    s = strained()[1]
    stiff = training.Setup(s.state, mpm.Step(s.grid, mpm.FixedCorotated(mu=1.1 * work.MU, lam=work.LAM),
                                             gravity=s.step.gravity, stress_form="gradient"))  # fmt: skip
    found, other = (training.rolled(setup, 20)(s.state.v)[0] - s.state.x for setup in (s, stiff))
    assert relative_error(other, found) > 1e-3


def test_what_does_not_fit_is_a_row_without_a_time() -> None:
    def never(v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        if v.requires_grad:
            raise torch.OutOfMemoryError("of 1 GiB")
        return v, v

    row = training.Meter("cpu", 1).row(never, torch.zeros(3))
    assert row["forward"] > 0 and row["both"] is None and row["memory"] is None
    rows = [{"name": "a", "kept": "", "particles": 1, "steps": 2, **row}] * 2
    assert "does not fit" in training.common.table(training.BESIDE, training.rows_of_peer({"peer": rows}))


@pytest.mark.skipif(not memory.Resident.available, reason="/proc/self/clear_refs cannot be written to")
def test_resident_memory_is_that_of_the_work() -> None:
    resident, size = memory.Resident(), 2**28
    assert 0.9 * size < resident.peak(lambda: torch.zeros(size, dtype=torch.uint8).add_(1)) < 1.2 * size
    assert resident.peak(lambda: None) < 0.2 * size


def test_a_way_that_fails_is_reported() -> None:
    rows = list(network_steps.rows(64, "cpu", 1, "no_such_backend"))
    assert rows[0]["error"] == 0 and "no_such_backend" in rows[1]["failure"]
    assert "no_such_backend" in network_steps.text(rows) and len(list(network_steps.timed(rows))) == 1


def test_training_program(tmp_path: Path) -> None:
    run_quick("benchmarks.speed.training", tmp_path)
    found = result(tmp_path, "training_*.json")
    assert [row["held"] for row in found["rollouts"]] == ["by default", "32 steps", "all steps"]
    assert max(found["disagreement"].values()) < 1e-6
    assert all(row["both"] > 0 for row in found["peer"])
    eager, compiled = found["networks"]
    assert eager["error"] < 1e-5 and compiled["error"] < 1e-5 and compiled["particles"] == 64
