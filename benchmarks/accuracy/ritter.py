"""A dam break over a dry bed against Ritter's solution: the front at several resolutions.

    python -m benchmarks.accuracy.ritter             # 3 minutes on a GPU; on 4 cores 10, without the fine lattices
    python -m benchmarks.accuracy.ritter --quick     # seconds

Water of depth h0 behind x = 0 is released over a frictionless floor. Shallow water theory (Ritter 1892) has

    h(x, t) = (2 c − x/t)²/(9 g) for −c t ≤ x ≤ 2 c t, c = √(g h0); t* = t √(g/h0); the dry front is 2 c t.

The front of a depth e h0 is the foremost position with that depth; Ritter's is at (2 − 3 √e) c t. Its error is the
distance between the two over the distance of the dry front, 2 c t. Depth is the area of the particles in strips, each
1% of 2 c t wide.

Expected agreement: theory assumes a hydrostatic pressure, which does not hold while the water falls. In this first
phase, a few √(h0/g), the wave lags behind by about h0, and a thin horizontal jet leaves the foot of the dam (Stansby,
Chegini and Barnes, J. Fluid Mech. 374 (1998) 407; Castro-Orgaz and Chanson, Environ. Fluid Mech. 17 (2017) 665, on the
first phase), after which both agree. A displacement of h0 is 3% of 2 c t at t* = 17, so errors are evaluated from t* =
20 on. The jet, which is not part of the theory, stays ahead and becomes thinner: "tip" is the foremost particle. Fronts
of 1% of h0 and more are behind it by then.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torch_mpm as mpm

from .. import common

GRAVITY, DEPTH, DENSITY, GAMMA = 9.81, 1.0, 1000.0, 7.0
SPEED, UNIT = math.sqrt(GRAVITY * DEPTH), math.sqrt(DEPTH / GRAVITY)
"""c [m/s] and √(h0/g) [s]."""
CFL = 0.4
LEVELS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
"""Depths of the fronts over h0."""
JUDGED = 20.0
"""t* from which errors are evaluated."""
STRIPS = 100
"""Strips between the dam and the dry front."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A run with h0 = `n` dx up to t* = `duration`; `mach` is the speed of sound over 2 c."""

    n: int
    walls: str = "mirror"
    duration: float = 40.0
    mach: float = 10.0
    transfer: str = "apic"
    flip: float = 0.0
    kernel: str = "quadratic"
    per_cell: int = 9

    @property
    def drawn(self) -> bool:
        """Whether the figure shows its depth: cases that differ in the lattice only, and those with slip walls."""
        return self.walls == "slip" or self.name == f"h0/dx = {self.n}"

    @property
    def name(self) -> str:
        changed = [
            f"{f.name} {getattr(self, f.name)}"
            for f in dataclasses.fields(self)
            if f.name not in ("n", "duration") and getattr(self, f.name) != f.default
        ]
        return ", ".join([f"h0/dx = {self.n}", *changed])


def setup(case: Case, device: str) -> tuple[mpm.Step, mpm.State]:
    """Water at rest, with space for the waves in both directions of the channel."""
    behind, ahead = math.ceil(1.1 * case.duration), math.ceil(2.5 * case.duration)
    grid = mpm.Grid(DEPTH / case.n, (-behind * DEPTH, 0.0), (ahead * DEPTH, 1.5 * DEPTH), kernel=case.kernel)
    grid = mpm.Grid(grid.dx, grid.lower, grid.upper, kernel=case.kernel, max_blocks=grid.block_count)
    points = mpm.seed.box((-behind * DEPTH, 0.0), (0.0, DEPTH), grid, per_cell=case.per_cell)
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float32, device=device)
    bulk = DENSITY * (case.mach * 2 * SPEED) ** 2
    pressure = DENSITY * GRAVITY * (DEPTH - state.x[:, 1])  # The dam break then starts no sound.
    state = state.replace(J=(1 + GAMMA / bulk * pressure) ** (-1 / GAMMA), C=state.x.new_zeros(len(state), 2, 2))
    law = mpm.WeaklyCompressible(bulk, GAMMA)
    return mpm.Step(grid, law, (0.0, -GRAVITY), case.walls, transfer=case.transfer, flip=case.flip), state


def run(case: Case, device: str, records: int) -> dict[str, Any]:
    """Fronts at `records` equal intervals, the run time and, for cases in the figure, the depths at the end."""
    step, state = setup(case, device)
    interval = case.duration / records * UNIT
    sound = float(step.stable_dt(state, cfl=1.0))
    count = math.ceil(interval / (CFL / (1 / sound + 2.5 * SPEED / step.grid.dx)))
    advance = Advance(step, state, interval / count)
    rows = []
    begin = time.perf_counter()
    for k in range(1, records + 1):
        state = advance(count)
        if not bool(state.x.isfinite().all()):
            raise RuntimeError(f"{case.name}: a position is not finite at t* = {k * interval / UNIT:.1f}")
        place = state.x[:, 0].double().cpu().numpy()
        x, depths = profile(place, state.volume.double().cpu().numpy(), k * interval)
        rows.append(fronts(float(place.max()), x, depths, k * interval))
    found = {
        **dataclasses.asdict(case),
        "name": case.name,
        "particles": len(state),
        "steps": records * count,
        "seconds": time.perf_counter() - begin,
        "rows": rows,
    }
    if case.drawn:
        found |= {"x": [round(v, 4) for v in x.tolist()], "depth": [round(v, 6) for v in depths.tolist()]}
    return found


class Advance:
    """Many equal steps, sorted periodically; on a GPU as replays of a graph."""

    CHUNK, SORTED = 25, 500

    def __init__(self, step: mpm.Step, state: mpm.State, dt: float) -> None:
        self.step, self.state, self.dt, self.done = step, state.sorted(step.grid), dt, 0
        self.graph: torch.cuda.CUDAGraph | None = None

    @torch.no_grad()
    def __call__(self, count: int) -> mpm.State:
        end = self.done + count
        while self.done < end:
            if self.done and self.done % self.SORTED < self.CHUNK:
                self._keep(self.state.sorted(self.step.grid))
            n = min(self.CHUNK, end - self.done)
            if self.state.x.is_cuda and n == self.CHUNK:
                self._replay()
            else:
                self._keep(mpm.rollout(self.step, self.state, n, self.dt))
            self.done += n
        return self.state

    def _keep(self, state: mpm.State) -> None:
        """Set the current state; on a GPU in the same memory, which the graph reads and writes."""
        if not self.state.x.is_cuda:
            self.state = state
            return
        for name in ("x", "v", "C", "J", "mass", "volume", "ids"):
            getattr(self.state, name).copy_(getattr(state, name))

    def _replay(self) -> None:
        if self.graph is None:
            mpm.rollout(self.step, self.state, 3, self.dt)  # One-time work of the first call of an op is not captured.
            self.step.reset()
            self.graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self.graph):
                self._keep(mpm.rollout(self.step, self.state, self.CHUNK, self.dt))
        self.graph.replay()


def profile(x: np.ndarray, volume: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Middles of the strips [m] and depths in them [m], from distances to the dam [P] [m] and areas [P] [m²]."""
    width = 2 * SPEED * t / STRIPS
    edges = width * np.arange(-STRIPS // 2, math.ceil(max(x.max(), 0.0) / width) + 3)
    return 0.5 * (edges[1:] + edges[:-1]), np.histogram(x, edges, weights=volume)[0] / width


def fronts(tip: float, x: np.ndarray, depths: np.ndarray, t: float) -> dict[str, Any]:
    """Position of the tip and errors of the fronts, over 2 c t."""
    row: dict[str, Any] = {"time": t / UNIT, "tip": tip / (2 * SPEED * t), "error": {}}
    for level in LEVELS:
        row["error"][str(level)] = foremost(x, depths, level * DEPTH) / (2 * SPEED * t) - ritter_front(level)
    return row


def ritter_front(level: float) -> float:
    """Position of Ritter's front of a depth over h0, over 2 c t."""
    return 1 - 1.5 * math.sqrt(level)


def foremost(x: np.ndarray, depths: np.ndarray, level: float) -> float:
    """The last place where the depth falls below a level, between the middles of two strips."""
    last = int(np.nonzero(depths > level)[0][-1])
    share = (depths[last] - level) / (depths[last] - depths[last + 1])
    return float(x[last] + share * (x[last + 1] - x[last]))


def worst(case: dict[str, Any], level: float) -> float | None:
    """Largest error of a front at the evaluated times."""
    errors = [abs(row["error"][str(level)]) for row in case["rows"] if row["time"] >= JUDGED - 1e-9]
    return max(errors, default=None)


def tip_speed(case: dict[str, Any]) -> float:
    """Speed of the tip over 2 c in the second half of the run."""
    late = [row for row in case["rows"] if row["time"] >= 0.5 * case["duration"] - 1e-9]
    return float(np.polyfit([r["time"] for r in late], [r["tip"] * r["time"] for r in late], 1)[0])


def extrapolate(cases: Sequence[dict[str, Any]], value: Any) -> float | None:
    """Richardson's limit of a value on three lattices, each twice as fine as the one before; None without order."""
    a, b, c = (value(case) for case in cases[-3:])
    return float(c + (c - b) ** 2 / ((b - a) - (c - b))) if abs(c - b) < abs(b - a) else None


def measure(cases: Sequence[Case], device: str, records: int) -> dict[str, Any]:
    result: dict[str, Any] = {"environment": common.environment(device), "judged": JUDGED, "cases": []}
    for case in cases:
        found = run(case, device, records)
        result["cases"].append(found)
        last = found["rows"][-1]
        errors = ", ".join(f"{float(level):.0%} {error:+.2%}" for level, error in last["error"].items())
        print(f"{case.name}: tip {last['tip']:.3f}, fronts {errors}; {found['seconds']:.1f} s", flush=True)
    return result


def text(result: dict[str, Any]) -> str:
    lines = ["# A dam break against Ritter's solution", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), ""]
    lines += [
        f"Largest errors of the fronts for t* ≥ {result['judged']:g}; tip at the end, and its speed over 2 c.",
        "",
    ]
    header = ("case", "particles", *(f"{level:.0%}" for level in LEVELS), "tip / 2 c t", "tip speed", "seconds")
    rows = [
        (
            case["name"],
            case["particles"],
            *(None if (e := worst(case, level)) is None else f"{e:.1%}" for level in LEVELS),
            f"{case['rows'][-1]['tip']:.3f}",
            f"{tip_speed(case):.3f}",
            case["seconds"],
        )
        for case in result["cases"]
    ]
    lines += [common.table(header, rows), ""]
    refined = refinement(result)
    if len(refined) >= 3:
        limit = extrapolate(refined, tip_speed)
        shown = "no order" if limit is None else f"{limit:.3f}"
        lines += [f"Richardson's limit of the tip's speed over 2 c: {shown}.", ""]
    for case in result["cases"]:
        lines += [f"## {case['name']}", "", _over_time(case), ""]
    return "\n".join(lines)


def refinement(result: dict[str, Any]) -> list[dict[str, Any]]:
    """The cases that differ in the lattice only."""
    return [case for case in result["cases"] if case["name"] == f"h0/dx = {case['n']}"]


def _over_time(case: dict[str, Any]) -> str:
    header = ("t*", "tip / 2 c t", *(f"error of {level:.0%}" for level in LEVELS))
    rows = [
        (f"{row['time']:g}", f"{row['tip']:.3f}", *(f"{error:+.2%}" for error in row["error"].values()))
        for row in case["rows"]
    ]
    return common.table(header, rows)


def plot(result: dict[str, Any], path: Path) -> None:
    """Depth at the end, places of the fronts over time, and errors over dx."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (depth, places, errors) = plt.subplots(1, 3, figsize=(16, 4.6))
    refined = refinement(result)
    others = [case for case in result["cases"] if case["walls"] == "slip"]
    for case, style in [*((c, "-") for c in refined), *((c, "--") for c in others)]:
        t = case["duration"] * UNIT
        depth.semilogy(
            np.array(case["x"]) / (2 * SPEED * t), np.maximum(case["depth"], 1e-5), style, label=case["name"]
        )
        times = [row["time"] for row in case["rows"]]
        exact = ritter_front(0.01)
        places.plot(times, [1 + row["error"]["0.01"] / exact for row in case["rows"]], style, label=case["name"])
    x = np.linspace(-0.5, 1, 400)
    depth.semilogy(x, (2 - 2 * x) ** 2 / 9, "k:", label="Ritter 1892")
    depth.set(xlabel="x / 2 c t", ylabel="depth / h0", title="depth at the end", ylim=(1e-4, 1.2), xlim=(-0.5, 1.2))
    for case in refined[-1:]:
        places.plot(times, [row["tip"] for row in case["rows"]], "r-.", label=f"tip, {case['name']}")
    places.axhspan(0.97, 1.03, color="0.9")
    places.set(xlabel="t*", ylabel="place over Ritter's", title="front of 1% of h0, and tip", ylim=(0.5, 1.2))
    for level in LEVELS:
        points = [(1 / case["n"], e) for case in refined if (e := worst(case, level)) is not None]
        errors.loglog(*zip(*points, strict=True) if points else ((), ()), "o-", label=f"{level:.0%} of h0")
    errors.axhline(0.03, color="0.5", linewidth=0.8)
    errors.set(xlabel="dx / h0", ylabel="error / 2 c t", title=f"largest error of fronts, t* ≥ {JUDGED:g}")
    for axes in (depth, places, errors):
        axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)
    print(f"wrote {path}")


SIZES = (8, 16, 32, 64)
CASES = (
    *(Case(n) for n in SIZES),
    *(Case(n, "slip") for n in SIZES[:-1]),
    Case(16, mach=5.0),
    Case(32, mach=20.0),
    Case(32, flip=0.95),
    Case(32, kernel="cubic"),
    *(Case(n, per_cell=4) for n in SIZES[1:]),
    Case(32, per_cell=16),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse lattices for a short time, to see that it works")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    cases: Sequence[Case] = (
        CASES if arguments.device != "cpu" else [Case(8), Case(16), Case(8, "slip"), Case(16, "slip")]
    )
    if arguments.quick:
        cases = [Case(n, duration=4.0, mach=5.0) for n in (4, 8, 16)] + [Case(8, "slip", 4.0, 5.0)]
    result = measure(cases, arguments.device, 4 if arguments.quick else 16)
    common.write(arguments.out, "ritter", result, text(result))
    plot(result, arguments.out / "ritter.png")


if __name__ == "__main__":
    sys.exit(main())
