"""The benchmark of steps with heat runs in its quick mode, and its peer conducts the same heat."""

from pathlib import Path

import pytest
import torch
from helpers import result, run_quick_here

import torch_mpm as mpm
from benchmarks import report
from benchmarks.speed import heat_peer_warp, peers, rollouts, step, thermal, work


def heated(diffusion: float, device: str) -> tuple[work.Work, step.Setup]:
    w = work.make(12)
    return w, thermal.heated(step.setup(w, device), diffusion=diffusion)


@pytest.mark.parametrize(("diffusion", "iterations"), [(work.DIFFUSION, heat_peer_warp.ITERATIONS), (0.1, 8)])
def test_peer_conducts_the_same_heat(diffusion: float, iterations: int, device: str) -> None:
    """Particles cross cells and conduct; 1e-4 of the range of temperatures, and of their largest change."""
    pytest.importorskip("warp")
    w, s = heated(diffusion, device)
    peer = heat_peer_warp.program(w, device, diffusion, iterations)
    with torch.no_grad():
        end = mpm.rollout(s.step, s.state, 40, work.DT)
    for _ in range(40):
        peer.step()
    peer.synchronize()
    found = {name: torch.from_numpy(field).to(end.x) for name, field in peer.fields().items()}
    range_of_theta = float(s.state.temperature.max() - s.state.temperature.min())
    change = float((end.temperature - s.state.temperature).abs().max())
    assert float((found["temperature"] - end.temperature).abs().max()) < 1e-4 * min(range_of_theta, change)
    gradient = end.extra["temperature_gradient"]
    most = float((gradient - s.state.extra["temperature_gradient"]).abs().max())
    assert float((found["temperature_gradient"] - gradient).abs().max()) < 1e-4 * most
    assert float((found["x"] - end.x).abs().max()) < 1e-6 and float((found["v"] - end.v).abs().max()) < 1e-5
    assert peer.figures()["residual"] < s.step.heat.tolerance


def test_an_iteration_less_misses_the_tolerance() -> None:
    """So the number of iterations of the peer is the least."""
    pytest.importorskip("warp")
    w, s = heated(work.DIFFUSION, "cpu")
    peer = heat_peer_warp.program(w, "cpu", iterations=heat_peer_warp.ITERATIONS - 1)
    peer.step()
    assert peer.figures()["residual"] > s.step.heat.tolerance


def test_start_of_the_temperatures_is_their_gradient() -> None:
    x = torch.rand(20, 3, dtype=torch.float64)
    h = 1e-3
    for axis in range(3):
        shift = h * torch.eye(3, dtype=torch.float64)[axis]
        ahead, behind = (torch.from_numpy(work.temperature((x + s).numpy())) for s in (shift, -shift))
        slope = torch.from_numpy(work.temperature_gradient(x.numpy()))[:, axis]
        torch.testing.assert_close((ahead - behind) / (2 * h), slope, rtol=1e-3, atol=0.1)


def test_peer_without_heat_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["peers", "taichi", "--heat"])
    with pytest.raises(SystemExit):
        peers.main()
    assert "--heat is for warp only, got taichi" in capsys.readouterr().err


def test_thermal_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the peer, which runs in another process."""
    monkeypatch.setattr(peers, "is_installed", lambda _: False)
    monkeypatch.setattr(rollouts, "SECONDS", 0.01)
    monkeypatch.setattr(thermal, "ROWS", {name: thermal.ROWS[name] for name in ("neo-Hookean", "heat")})
    run_quick_here("benchmarks.speed.thermal", tmp_path)
    found = result(tmp_path, "thermal_*.json")
    assert all(row["us"] > 0 for row in found["rows"]) and found["libraries"]["libtorch_mpm_cpu.so"] > 1e6
    assert "libtorch_mpm_cpu.so" in thermal.text(found) and "peer" not in thermal.text(found)
    assert "until a time" in report.thermal_speed([found])
    of_times = [row for row in found["rows"] if row["name"].startswith("until a time")]
    assert of_times and all(f"| {row['fixed']['own_schedule']} " in thermal.table(found) for row in of_times)
    assert thermal.UNTIL_A_TIME in thermal.text(found)
    older = {**found, "rows": [{k: v for k, v in row.items() if k != "fixed"} for row in found["rows"]]}
    assert "of its schedule" not in thermal.text(older)


def test_until_a_time_stands_beside_the_schedule_that_it_has(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    """A segment of one substep has another schedule than many substeps on a CPU."""
    monkeypatch.setattr(rollouts, "SECONDS", 0.001)
    s = step.setup(work.make(6), device)
    dt = float(s.step.stable_dt(s.state)) / 2
    for segment, own in ((thermal.SEGMENT, "sorted_cpu"), (1, "per_step")):
        monkeypatch.setattr(thermal, "SEGMENT", segment)
        with torch.no_grad():
            found = thermal.with_fixed_dt(s.step, s.state, 20, dt, device, 1)
        assert all(found[name] > 0 for name in ("fastest", "alike", "calls"))
        if device == "cpu":
            assert (found["schedule"], found["own_schedule"]) == ("sorted_cpu", own)
            assert (found["alike"] == found["fastest"]) == (own == "sorted_cpu")


@pytest.mark.thorough
def test_peer_has_a_row_beside_each_cube_with_heat() -> None:
    pytest.importorskip("warp")
    (row,) = thermal.of_peer("cpu", 6, 1, us=100.0)
    assert row["name"].startswith("peer: Warp 1.") and row["beside"] == "heat" and row["particles"] == 6**3
    assert row["times"] == pytest.approx(row["us"] / 100) and row["difference"]["temperature"] < 1e-3
    (row,) = thermal.of_peer("cpu", 4, 4, us=100.0)
    assert row["name"].endswith(", 4 scenes") and row["particles"] == 4 * 4**3 and "difference" not in row
    assert "conjugate gradients" in " ".join(thermal.notes({"rows": [{**row, "difference": {"temperature": 0.0}}]}))
