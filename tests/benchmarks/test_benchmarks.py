"""The benchmark programs run in their quick mode, and the exact solution that they compare with is one."""

import json
import math
import os
import re
from pathlib import Path

import pytest
import torch
from helpers import result, run_quick, run_quick_here

import setup
from benchmarks import common, report
from benchmarks.accuracy import convergence, manufactured, ritter
from benchmarks.speed import bodies_newton, checkpoints, peers, splats, step, work
from benchmarks.stability.stable_dt import LAWS
from torch_mpm.splats import ply


@pytest.mark.thorough
def test_speed_program_times_every_part(tmp_path: Path) -> None:
    run_quick("benchmarks.speed.step", tmp_path, "--peers")
    found = result(tmp_path, "speed_*.json")
    (size,) = found["sizes"]
    names = {part["name"] for part in size["parts"]}
    assert found["failures"] == []
    assert {"activate", "stress", "p2g", "g2p", "grid update", "advance", "p2g with stress, backward"} <= names
    assert all(part["ms"] > 0 and part["bytes"] > 0 for part in size["parts"])
    assert max(size["errors"].values()) < 5e-6


@pytest.mark.thorough
def test_splats_program_times_runs_with_files(tmp_path: Path) -> None:
    run_quick_here("benchmarks.speed.splats", tmp_path)
    found = result(tmp_path, "splats_*.json")
    (parts,) = found["runs"]
    assert all(parts["seconds"][part] > 0 for part in splats.PARTS)
    assert [run["degree"] for run in found["loops"]] == [0, 3]
    for run in found["loops"]:
        assert run["bytes"] == ply.size_of(2000, (run["degree"] + 1) ** 2)
        assert run["frames"] == 3 and run["held_bytes"] == 3 * run["bytes"]
        assert run["seconds"] > 0 and run["from_memory"] > 0
    names = [name for name, _ in splats.timed_parts(found)]
    assert len(set(names)) == len(names) == len(splats.PARTS) + 2


@pytest.mark.thorough
def test_environment_program_counts_steps_and_resets(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium")
    run_quick_here("benchmarks.speed.envs", tmp_path)
    (row,) = result(tmp_path, "envs_*.json")["tasks"]
    assert row["task"] == "Push" and row["failed"] == 0 and row["reset"] > 0
    assert row["rate"] == pytest.approx(2 / row["step"] * 1e3)


@pytest.mark.thorough
@pytest.mark.parametrize("of", ["torch_mpm", "newton"])
def test_water_stays_in_a_cup(of: str) -> None:
    """At the level of its volume within a cell, in torch_mpm; Newton's water is denser in so few cells."""
    if of == "newton":
        pytest.importorskip("newton")
    made = bodies_newton.of_newton(2, "cpu", "xpbd") if of == "newton" else bodies_newton.of_torch_mpm(2, "cpu", 0.9)
    run, found = made
    run(40)
    error = (found()["water"] - bodies_newton.level()) / bodies_newton.DX
    assert (-0.5 if of == "torch_mpm" else -1.5) < error < 0.5
    assert found()["cup"] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.thorough
def test_coupling_program_divides_the_time_of_a_step(tmp_path: Path) -> None:
    pytest.importorskip("mujoco.batch")
    run_quick_here("benchmarks.speed.coupling", tmp_path)
    found = result(tmp_path, "coupling_*.json")
    for run in found["coupled"]:
        parts = [run["ms"][part] for part in ("MuJoCo", "exchange", "material")]
        assert min(parts) > 0 and sum(parts) == pytest.approx(run["ms"]["total"])
        assert run["particles"] == 160 * run["scenes"]
    assert {run["scenes"] for run in found["coupled"]} == {1, 4}
    assert all(min(run["us"].values()) > 0 for run in found["steps"])


@pytest.mark.thorough
def test_bodies_are_stable_where_the_velocity_is_solved_for(tmp_path: Path) -> None:
    """Light discs, which an exchange after each step and a penalty throw away."""
    run_quick("benchmarks.stability.bodies", tmp_path)
    rows = result(tmp_path, "stability_bodies.json")["rows"]
    assert len(rows) == 4 and max(row["solved"]["growth"] for row in rows) < 1.001
    light, heavy = ([row for row in rows if (row["ratio"] < 1) == lighter] for lighter in (True, False))
    assert all(row[coupling]["growth"] > 100 for row in light for coupling in ("one exchange", "penalty"))
    assert all(0 < row["penalty"]["penetration"] < 1 for row in heavy)


@pytest.mark.thorough
def test_failed_part_is_reported_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("no such device")

    monkeypatch.setattr(step, "whole_steps", broken)
    found = step.measure("cpu", [8], [], samples=1, budget=0.0)
    assert found["failures"] == [f"{part}: RuntimeError: no such device" for part in ("whole steps", "host")]
    assert found["sizes"][0]["parts"] and found["sizes"][0]["errors"]


def test_work_is_sorted_by_block_and_fills_the_cells() -> None:
    w = work.make(16)
    s = step.setup(w, "cpu")
    index = s.grid.activate(s.state.x).index
    assert torch.equal(index, torch.arange(16**3, dtype=torch.int32))
    cells = torch.floor(s.state.x * w.n).long().unique(dim=0, return_counts=True)[1]
    assert cells.tolist() == [8] * 8**3


@pytest.mark.parametrize("peer", sorted(peers.PEERS))
def test_peer_does_the_same_work(peer: str, tmp_path: Path) -> None:
    pytest.importorskip(peers.PEERS[peer][1])
    report = step.Report("cpu")
    step.measure_peer(report, peer, "cpu", [16], samples=1)
    difference = report.result["difference"][peer]
    assert difference["x"] < 1e-6 and difference["v"] < 1e-5
    assert report.result["peers"][0]["particles"] == 16**3


def test_bytes_count_node_tensors_by_their_active_rows() -> None:
    s = step.setup(work.make(8), "cpu")
    blocks = s.grid.activate(s.state.x)
    nodes = torch.zeros(blocks.node_count, 4)
    assert step.bytes_of([nodes, s.state.x], blocks, active=100) == 100 * 16 + 8**3 * 12


@pytest.mark.parametrize("dim", [2, 3])
def test_manufactured_solution_satisfies_the_equation_of_motion(dim: int) -> None:
    """ρ ∂²u/∂t² = Div P + ρ b with P = μ (F − F⁻ᵀ) + λ ln J F⁻ᵀ, by finite differences in X and t."""
    X, t, h = torch.rand(5, dim, dtype=torch.float64), 0.0037, 1e-4

    def stress(X: torch.Tensor) -> torch.Tensor:
        F = manufactured.Solution(X).stretch(t)
        return manufactured.MU * (F - 1 / F) + manufactured.LAM * F.log().sum(1, keepdim=True) / F

    divergence = torch.empty_like(X)
    for axis in range(dim):
        shift = h * torch.eye(dim, dtype=torch.float64)[axis]
        divergence[:, axis] = ((stress(X + shift) - stress(X - shift)) / (2 * h))[:, axis]
    s, tau = manufactured.Solution(X), h / manufactured.SPEED
    acceleration = (s.displacement(t + tau) - 2 * s.displacement(t) + s.displacement(t - tau)) / tau**2
    force = manufactured.DENSITY * s.body_force(t)
    torch.testing.assert_close(manufactured.DENSITY * acceleration - divergence, force, rtol=1e-5, atol=1e-2)


def test_manufactured_gradients_belong_to_the_motion() -> None:
    X, t = torch.rand(4, 3, dtype=torch.float64, requires_grad=True), 0.0037
    s = manufactured.Solution(X)
    x = X + s.displacement(t)
    F = torch.stack([torch.autograd.grad(x[:, i].sum(), X, retain_graph=True)[0] for i in range(3)], 1)
    torch.testing.assert_close(F, torch.diag_embed(s.stretch(t)))
    rate = torch.stack([torch.autograd.grad(s.velocity(t)[:, i].sum(), X, retain_graph=True)[0] for i in range(3)], 1)
    torch.testing.assert_close(rate @ F.inverse(), torch.diag_embed(s.velocity_gradient(t, t)))


def test_mirrored_walls_converge_with_second_order_and_slip_walls_with_first() -> None:
    orders = {}
    for walls in ("slip", "mirror"):
        rows = [convergence.run(convergence.Case(2, "quadratic", walls, ()), n)[1] for n in (8, 16)]
        orders[walls] = math.log2(rows[0]["displacement"] / rows[1]["displacement"])
    assert 0.8 < orders["slip"] < 1.3
    assert 1.8 < orders["mirror"] < 2.2


def test_fronts_of_the_exact_solution_have_no_error() -> None:
    """Particles of equal area placed by Ritter's depth; the tip is the foremost of them."""
    t, count = 5.0, 40000
    ahead = (torch.arange(count, dtype=torch.float64) + 0.5) / count  # share of the water released that is ahead
    x = 2 * ritter.SPEED * t * (1 - ahead ** (1 / 3))
    area = torch.full_like(x, 8 / 27 * ritter.SPEED * t * ritter.DEPTH / count)
    row = ritter.fronts(float(x.max()), *ritter.profile(x.numpy(), area.numpy(), t), t)
    assert all(abs(row["error"][str(level)]) < 1e-3 for level in ritter.LEVELS if level < 0.4)
    assert row["tip"] == pytest.approx(1 - (0.5 / count) ** (1 / 3))


def test_richardson() -> None:
    assert ritter.extrapolate([1.0, 1.5, 1.75], lambda value: value) == 2.0
    assert ritter.extrapolate([1.0, 1.5, 2.0], lambda value: value) is None


def test_limits_program(tmp_path: Path) -> None:
    run_quick_here("benchmarks.accuracy.limits", tmp_path)
    found = result(tmp_path, "limits.json")
    for row in found["spins"]:
        assert row["momentum"] < 1e-13
        kept = row["angular momentum"]
        assert abs(kept - 1) < 1e-12 if row["transfer"] == "apic" else kept < 1
    sliding, sticking = found["inclines"][0], found["inclines"][-1]
    assert sliding["speed"] == pytest.approx(sliding["rigid"], rel=0.02)
    assert abs(sticking["speed"]) < 0.01
    errors = {row["gap"]: row for row in found["vectors"] if row["dtype"] == "float32"}
    assert errors[1e-6]["error"] > 1e3 * errors[1e-2]["error"]
    assert all(row["polar"] < 1e-6 for row in errors.values())


@pytest.mark.thorough
@pytest.mark.parametrize("program", ["convergence", "precision", "ritter", "rollout_gradients"])
def test_accuracy_program(program: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    run_quick_here(f"benchmarks.accuracy.{program}", tmp_path)
    result(tmp_path, f"{program}.json")


def test_table_and_orders() -> None:
    assert common.table(("a", "b"), [(1, None), (0.5, 1e-5)]).splitlines() == [
        "| a   | b       |",
        "|-----|---------|",
        "| 1   | –       |",
        "| 0.5 | 1.0e-05 |",
    ]
    assert common.order_of([1, 0.5, 0.25], [8, 2, 0.5]) == [None, 2, 2]


def test_report_has_every_section_and_goes_between_its_marks(tmp_path: Path) -> None:
    place = {"device": "abacus", "commit": "0"}
    part = {"name": "p2g", "ms": 0.5, "bytes": 1}
    entry = {"particles": 10**6, "steps": [{"name": "step", "ms": 2.0}], "parts": [part], "errors": {"g2p": 1e-7}}
    speed = {"environment": place, "sizes": [entry], "peers": [{"name": "warp", "particles": 10**6, "ms": 8.0}]}
    rows = [{"n": 8, "displacement": 0.5, "seconds": 1.0}]
    cases = {"cases": [{"name": "2-D", "order": {"displacement": 2.0}, "rows": rows}]}
    for name, found in (("speed_abacus", speed), ("convergence", cases)):
        (tmp_path / f"{name}.json").write_text(json.dumps(found))
    assert list(report.sections(tmp_path)) == ["Speed", "Convergence"]
    tables = report.documents(tmp_path)[report.MEASURED]
    cells = [cell.strip() for line in tables.splitlines() if line.startswith("| abacus") for cell in line.split("|")]
    assert cells[1:5] == ["abacus", "1 M", "2", "4.0x"] and cells[7] == "2"
    assert tables.index("### Speed") < tables.index("### Convergence")
    document = report.insert(f"before {report.BEGIN} old {report.END} after", tables)
    assert document.startswith("before") and document.endswith("after") and "old" not in document and "4.0x" in document
    with pytest.raises(ValueError, match="needs the lines"):
        report.insert("no marks", tables)


def test_tables_of_the_documents_are_those_of_the_results() -> None:
    """`python -m benchmarks.report --write` writes them."""
    for document, tables in report.documents(common.RESULTS).items():
        text = document.read_text()
        assert report.insert(text, tables) == text, f"{document.name} differs: python -m benchmarks.report --write"


def test_captions_of_the_documents_have_a_sentence_per_line() -> None:
    for document, tables in report.documents(common.RESULTS).items():
        captions = [line for line in tables.splitlines() if not line.startswith(("|", "- ", "#", "!"))]
        assert captions
        for line in filter(None, captions):
            assert not re.search(r"[\w)\]`]\. [A-Z0-9`]", line), f"{document.name}: {line}"
            assert line[-1] in ".:", f"{document.name}: {line}"


@pytest.mark.thorough
def test_return_map_of_sand_against_extended_precision(tmp_path: Path) -> None:
    for package in ("matplotlib", "mpmath", "torch_mpm._math"):
        pytest.importorskip(package)
    run_quick_here("benchmarks.accuracy.sand", tmp_path)
    for row in result(tmp_path, "sand_accuracy.json")["rows"]:
        assert row["reference against 50 digits"] < 1e-18
        for name in ("float32", "float64"):
            found = row[name]
            assert found["on the cone"] > 1500
            assert found["error over condition"][2] < found["allowed"]
            assert found["wrong branches"] == 0


def test_gradients_of_sand_program(tmp_path: Path) -> None:
    run_quick_here("benchmarks.accuracy.sand_gradient", tmp_path)
    found = result(tmp_path, "sand_gradient.json")
    for row in found["rows"]:
        assert row["at rest"] < found["allowed"]
        for case in row["gaps"]:
            assert case["states"] > 300
            assert max(case["largest"], case["of the usual norm, largest"]) < found["allowed"]


@pytest.mark.thorough
def test_no_law_is_unstable_below_its_estimate(tmp_path: Path) -> None:
    run_quick_here("benchmarks.stability.law_dt", tmp_path)
    cases = result(tmp_path, "stability_laws.json")["cases"]
    assert {case["law"] for case in cases} == set(LAWS) - {"neo-Hookean"}
    assert all(1 <= case["stable"] < 10 for case in cases)


def test_random_rollouts_program(tmp_path: Path) -> None:
    run_quick_here("benchmarks.stability.adversarial", tmp_path)
    found = result(tmp_path, "adversarial.json")
    assert len(found["rollouts"]["motion"]) == 10
    assert not any(row["inverted"] or row["flattened"] or row["not finite"] for row in found["rows"])


@pytest.mark.thorough
def test_data_sets_program(tmp_path: Path) -> None:
    run_quick("benchmarks.datasets", tmp_path, "--only", "Water", "--work", str(tmp_path))
    alone, together = result(tmp_path, "datasets_*.json")["sets"]
    assert alone["processes"] == 1 and together["processes"] == len(os.sched_getaffinity(0))
    for row in (alone, together):
        assert row["valid"] == 4 and row["complete"] and row["bytes"] > 0 and row["frames"] == 4


def test_svd_program(tmp_path: Path) -> None:
    run_quick_here("benchmarks.accuracy.svd", tmp_path)
    for row in result(tmp_path, "svd_accuracy.json")["rows"]:
        assert row["errors"]["svd3"]["product"][1] < 1e-6


def test_memory_of_checkpoints_is_what_was_estimated() -> None:
    """Memory of live tensors, counted separately. The estimate of the working memory is an upper bound, two recorded
    steps and three states."""
    for name in ("all steps", "5 states"):
        case = checkpoints.case("torch code", name, 4, 20, "cpu")
        assert 0.6 * case["estimated_memory"] < case["memory"] <= case["estimated_memory"]


@pytest.mark.parametrize("flags", [["-O3"], ["-O3", setup.NVCC_FAST_COMPILE]])
def test_slow_kernels_of_a_check_are_named(flags, monkeypatch):
    monkeypatch.setattr("torch_mpm.info.info", lambda: {"version": "1", "build": {"cuda": {"flags": flags}}})
    monkeypatch.setattr(common, "device_name", str)
    assert ("kernels" in common.environment("cuda")) == (len(flags) == 2)
