"""Collapse of columns of dry sand: run-out against aspect ratio, and the steepest slope that stands.

    python -m benchmarks.accuracy.runout                 # all cases, minutes on a GPU; the CPU does one batch only
    python -m benchmarks.accuracy.runout --quick         # seconds

A column of height H and half width (radius) r₀ on a rough floor, to which sand sticks, is released; a = H/r₀. All
aspect ratios of a case run as one batch of scenes with equal volume. "planar" is the 2-D law, "slab" the 3-D law in
plane strain between frictionless walls, "axisymmetric" a quarter of a round column between frictionless walls of
symmetry. The sand starts in the equilibrium of a confined column, and is stiff enough to be compressed by 2% at its
foot. A run lasts 6 √(H/g).

Run-out: (r − r₀)/r₀ for the smallest radius r at which the deposit is less deep than one grid cell; also the radius
that contains 99% of the mass. Slope: the least-squares slope of the deposit between 20% and 80% of its height.

Published: planar 1.2 a below a = 2.3, 1.9 a^⅔ above (Lube et al. 2005); 2-D discs 2.5 a below 2, 3.25 a^0.7 above
(Staron and Hinch 2005); axisymmetric 1.24 a below 1.7, 1.6 a^½ above (Lube et al. 2004). The factors depend on the
material and on the side walls of the experiments; exponents in 0.9 ± 0.1 and, planar, 0.65 ± 0.05 are common to many
materials (Balmforth and Kerswell 2005).

Standing slopes: heaps with a plane flank from 20° to 50° stand against a frictionless wall, in one batch. A heap has
failed if the mean displacement is more than 2% of its height after 4 √(H/g). Also given is the Mohr-Coulomb angle that
the law mobilises in steady shear: the friction angle in 2-D, and in plane strain one that depends on energy and flow
rule.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import re
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.geometry.seed import Box, Points, fill

from .. import common

GRAVITY, DENSITY, NU = 9.81, 1600.0, 0.3
DX = 0.01
QUARTIC = 6.254421582537118
"""Coefficient a of the quartic energies."""
SLAB = 4
"""Thickness of a slab in cells."""
SEGMENT = 32
"""Steps between two reorderings."""
ASPECTS = (0.5, 0.8, 1.2, 2.0, 3.0, 5.0, 7.0, 10.0)
ANGLES = tuple(range(20, 51, 2))
FIGURES = {"planar": ("planar", "slab"), "axisymmetric": ("axisymmetric",)}
"""Shapes of the columns in each figure."""
PUBLISHED = {
    "planar": ("Lube et al. 2005", 2.3, (1.2, 1.0), (1.9, 2 / 3)),
    "discs": ("Staron and Hinch 2005, 2-D discs", 2.0, (2.5, 1.0), (3.25, 0.7)),
    "axisymmetric": ("Lube et al. 2004", 1.7, (1.24, 1.0), (1.6, 0.5)),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """A batch of columns: `cells` is the volume of each (of a quarter of each, axisymmetric) in grid cells."""

    shape: str
    cells: int
    flow: str = "radial"
    energy: str = "unilateral"
    friction_angle: float = 30.0
    volume_correction: bool = False
    kernel: str = "quadratic"
    transfer: str = "apic"
    cfl: float = 0.5
    compression: float = 0.02
    per_axis: int = 2

    @property
    def dim(self) -> int:
        return 2 if self.shape == "planar" else 3

    @property
    def name(self) -> str:
        rule = "" if self.dim == 2 else f", {self.flow} flow"
        extra = "".join(f", {item}" for item in self.unusual())
        return f"{self.shape}{rule}, {self.energy}, φ = {self.friction_angle:g}°, {self.cells} cells{extra}"

    def unusual(self) -> list[str]:
        """Differences from the usual computation."""
        usual = Case(self.shape, self.cells)
        words = {
            "volume_correction": "volume correction",
            "kernel": f"{self.kernel} kernel",
            "transfer": self.transfer,
            "cfl": f"CFL {self.cfl:g}",
            "compression": f"compression {self.compression:g}",
            "per_axis": f"{self.per_axis}^D per cell",
        }
        return [text for key, text in words.items() if getattr(self, key) != getattr(usual, key)]


PLANAR = (Case("planar", 2500), Case("planar", 10000), Case("planar", 2500, volume_correction=True))
SLABS = (Case("slab", 1200), Case("slab", 1200, "exact"))
ROUND = (
    Case("axisymmetric", 4000),
    Case("axisymmetric", 12000),
    Case("axisymmetric", 4000, "exact"),
    Case("axisymmetric", 4000, volume_correction=True),
)
CASES = (*PLANAR, *SLABS, *ROUND)
SLOPES = (
    Case("planar", 50),
    *(Case("slab", 50, flow, energy) for flow in ("radial", "exact") for energy in ("unilateral", "full")),
)
VARIANTS = (
    *(Case("planar", cells) for cells in (160, 640, 2500)),
    *(
        dataclasses.replace(PLANAR[0], **change)  # type: ignore[arg-type]
        for change in (
            {"friction_angle": 20.0},
            {"friction_angle": 40.0},
            {"energy": "full"},
            {"compression": 0.01},
            {"compression": 0.04},
            {"cfl": 0.25},
            {"per_axis": 4},
            {"kernel": "cubic"},
            {"transfer": "pic"},
        )
    ),
)
"""Variants for one aspect ratio only, which show the sensitivity of the run-out."""
VARIED = 2.0
"""Aspect ratio of the variants."""


# ---- bodies


class QuarterCylinder:
    """The quarter x, z ≥ 0 of a standing cylinder."""

    def __init__(self, radius: float, height: float) -> None:
        self.lower = torch.zeros(3, dtype=torch.float64)
        self.upper = torch.tensor([radius, height, radius], dtype=torch.float64)
        self.volume = 0.25 * math.pi * radius**2 * height

    def inside(self, x: Tensor) -> Tensor:
        return x[:, 0].square() + x[:, 2].square() <= self.upper[0].square()


class Heap:
    """Height H at x = 0, falling at an angle to 0; `depth` is the extent along z, if any."""

    def __init__(self, height: float, angle: float, depth: float | None) -> None:
        width = height / math.tan(angle)
        size = [width, height] if depth is None else [width, height, depth]
        self.lower, self.upper = torch.zeros(len(size), dtype=torch.float64), torch.tensor(size, dtype=torch.float64)
        self.volume = 0.5 * float(self.upper.prod())

    def inside(self, x: Tensor) -> Tensor:
        return x[:, 0] / self.upper[0] + x[:, 1] / self.upper[1] <= 1


def column(case: Case, aspect: float) -> tuple[Points, float, float]:
    """Particles of a column, its height and its half width or radius [m]."""
    shape: Any
    if case.shape == "axisymmetric":
        radius = DX * (4 * case.cells / (math.pi * aspect)) ** (1 / 3)
        shape = QuarterCylinder(radius, aspect * radius)
    else:
        radius = DX * math.sqrt(case.cells / aspect)
        shape = Box((0.0,) * case.dim, (radius, aspect * radius, SLAB * DX)[: case.dim])
    return fill(shape, DX, case.per_axis**case.dim, dtype=torch.float64), aspect * radius, radius


# ---- simulation


def stiffness(height: float, compression: float) -> tuple[float, float]:
    """μ and λ [Pa] with which a confined column of sand has the Hencky strain −`compression` at its foot.

    Uniaxial: ρ g H = 2 a (2 μ + λ) ε³.
    """
    modulus = DENSITY * GRAVITY * height / (2 * QUARTIC * compression**3)
    lam = modulus * NU / (1 - NU)
    return 0.5 * (modulus - lam), lam


def pressed(case: Case, points: Points, overburden: Tensor, height: float) -> mpm.State:
    """Sand at rest under the depth `overburden` [P] [m] of sand, in a laterally confined column."""
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    mu, lam = stiffness(height, case.compression)
    strain = (DENSITY * GRAVITY * overburden.clamp(min=0) / (2 * QUARTIC * (2 * mu + lam))).pow(1 / 3)
    F = torch.eye(state.x.shape[1], dtype=torch.float64).repeat(len(state), 1, 1)
    F[:, 1, 1] = torch.exp(-strain)
    return state.replace(F=F, volume=state.volume / F[:, 1, 1], J=torch.ones_like(strain))


def simulate(
    case: Case, states: Sequence[mpm.State], heights: Sequence[float], reach: float, duration: float, device: str
) -> tuple[mpm.State, list[dict[str, Any]], int]:
    """Simulate all scenes to the time `duration` √(H/g); returns the final state, a record per unit of that time, and
    the number of steps.

    The scenes share the clock t/√(H/g): it advances by the largest step that is stable in all of them.
    """
    dim, height = case.dim, torch.tensor(heights, device=device)
    upper = (reach, max(heights) + 10 * DX, SLAB * DX if case.shape == "slab" else reach)[:dim]
    grid = mpm.Grid(DX, (0.0,) * dim, upper, scenes=len(states), kernel=case.kernel)
    packed = mpm.State.concatenate(list(states), scene=True).to(device, torch.float32)
    wanted = grid.activate(packed.x, packed.scene).wanted
    room = min(3 * wanted, grid.block_count)  # Space to spread; fixed, for the graph.
    grid = mpm.Grid(DX, (0.0,) * dim, upper, scenes=len(states), kernel=case.kernel, max_blocks=room)
    moduli = [stiffness(h, case.compression) for h in heights]
    mu, lam = (torch.tensor(values, device=device) for values in zip(*moduli, strict=True))
    law = mpm.QuarticSand(
        mu=mu,
        lam=lam,
        friction_angle=torch.full_like(mu, math.radians(case.friction_angle)),
        energy=case.energy,
        smallest_strain=case.compression,
        flow=case.flow,
        volume_correction=case.volume_correction,
    )
    walls = mpm.Walls([("slip", "separate"), ("sticky", "separate"), "slip"][:dim])
    step = mpm.Step(grid, law, gravity=(0.0, -GRAVITY, 0.0)[:dim], walls=walls, transfer=case.transfer)
    unit = (height / GRAVITY).sqrt()
    segment = Segment(step, step.prepare(packed), lambda state: (step.stable_dt(state, case.cfl) / unit).amin() * unit)
    steps, clock, records = 0, 0.0, [record(step, segment.state)]
    while clock < duration:
        segment.run()
        steps += SEGMENT
        before, clock = clock, float(segment.time[0] / unit[0])
        if math.floor(clock) > math.floor(before):
            records.append(record(step, segment.state))
    step.check(segment.state)
    return segment.state, records, steps


class Segment:
    """SEGMENT steps in place; on a GPU, from the second call on, a CUDA graph.

    Args:
        step: a step with a grid of fixed max_blocks.
        state: initial state, with all fields that the step needs.
        time_step: function of a state that returns dt [B].
        every_step: whether to compute dt at every step, not once.

    Attributes:
        state, time: after the steps so far.
    """

    def __init__(
        self, step: mpm.Step, state: mpm.State, time_step: Callable[[mpm.State], Tensor], every_step: bool = False
    ) -> None:
        self.step, self.time_step, self.every_step = step, time_step, every_step
        ids = torch.arange(len(state), device=state.x.device)
        C = torch.zeros_like(state.F) if step.transfer == "apic" else None  # type: ignore[arg-type]
        self.state = state.replace(ids=ids, C=C)
        self.time = torch.zeros(step.grid.scenes, dtype=torch.float64, device=state.x.device)
        self.graph: torch.cuda.CUDAGraph | None = None
        self.called = False

    def run(self) -> None:
        if self.called and self.graph is None and self.time.is_cuda:
            self.graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self.graph):
                self._steps()
        if self.graph is not None:
            self.graph.replay()
        else:
            self._steps()
        self.called = True

    def _steps(self) -> None:
        state = self.state.sorted(self.step.grid)
        dt = self.time_step(state)
        for k in range(SEGMENT):
            if k and self.every_step:
                dt = self.time_step(state)
            state = self.step(state, dt)
            self.time += dt
        for field in dataclasses.fields(state):
            if isinstance(kept := getattr(self.state, field.name), Tensor):
                kept.copy_(getattr(state, field.name))
        for name, kept in self.state.extra.items():
            kept.copy_(state.extra[name])


def record(step: mpm.Step, state: mpm.State) -> dict[str, list[float]]:
    """Energies of each scene [J]."""

    assert state.scene is not None
    scene = state.scene.long()

    def total(values: Tensor) -> list[float]:
        sums = torch.zeros(step.grid.scenes, dtype=torch.float64, device=values.device)
        return sums.index_add_(0, scene, values.double()).tolist()

    return {
        "kinetic": total(0.5 * state.mass * state.v.square().sum(1)),
        "potential": total(state.mass * GRAVITY * state.x[:, 1]),
        "elastic": total(step.law.energy(state)),
    }


# ---- what is measured


def profile(case: Case, state: mpm.State, scene: int) -> tuple[Tensor, Tensor, float]:
    """Depth [m] of a deposit in bins one cell wide, distance of their centres, and the distance that holds 99%."""
    mine = state.scene == scene
    x, mass = state.x[mine].double().cpu(), state.mass[mine].double().cpu()
    distance = x[:, 0] if case.shape != "axisymmetric" else (x[:, 0].square() + x[:, 2].square()).sqrt()
    index = (distance / DX).long()
    edges = DX * torch.arange(int(index.max()) + 3, dtype=torch.float64)
    area = {
        "planar": edges.diff(),
        "slab": edges.diff() * SLAB * DX,
        "axisymmetric": 0.25 * math.pi * edges.square().diff(),
    }[case.shape]
    depth = torch.zeros(len(area), dtype=torch.float64).index_add_(0, index, mass / DENSITY) / area
    order = distance.argsort()
    share = mass[order].cumsum(0) / mass.sum()
    return depth, edges[:-1] + 0.5 * DX, float(distance[order][int((share < 0.99).sum())])


def front(depth: Tensor) -> float:
    """Least distance at which a deposit is less deep than one cell [m], between bins by interpolation."""
    k = int((depth < DX).nonzero()[0, 0])
    if k == 0:
        return 0.0
    before, after = float(depth[k - 1]), float(depth[k])
    return DX * (k - 0.5 + (before - DX) / (before - after))


def flank_angle(depth: Tensor, distance: Tensor) -> float:
    """Angle [degrees] of the line fitted to a deposit between 20% and 80% of its height."""
    top = float(depth[:3].mean())
    flank = (depth > 0.2 * top) & (depth < 0.8 * top) & (distance < front(depth))
    if int(flank.sum()) < 3:
        return math.nan
    return math.degrees(math.atan(-float(np.polyfit(distance[flank].numpy(), depth[flank].numpy(), 1)[0])))


def collapse(case: Case, aspects: Sequence[float], duration: float, device: str) -> dict[str, Any]:
    """All columns of a case: the deposits, and the history of energy and volume."""
    bodies = [column(case, a) for a in aspects]
    heights = [height for _, height, _ in bodies]
    states = [pressed(case, points, height - points.x[:, 1], height) for points, height, _ in bodies]
    reach = max(
        radius * (1 + 4.5 * a ** (0.75 if case.dim == 2 or case.shape == "slab" else 0.6))
        for (_, _, radius), a in zip(bodies, aspects, strict=True)
    )
    begin = time.perf_counter()
    state, records, steps = simulate(case, states, heights, reach, duration, device)
    seconds = time.perf_counter() - begin
    rows = []
    for b, (a, (points, _, radius)) in enumerate(zip(aspects, bodies, strict=True)):
        depth, distance, reach99 = profile(case, state, b)
        energy = [r["kinetic"][b] + r["potential"][b] + r["elastic"][b] for r in records]
        floor_energy = min(r["potential"][b] for r in records)
        rows.append(
            {
                "a": a,
                "particles": len(points),
                "radius / dx": radius / DX,
                "run-out": front(depth) / radius - 1,
                "run-out of 99%": reach99 / radius - 1,
                "height": float(depth[:3].mean()) / radius,
                "angle": flank_angle(depth, distance),
                "volume": float(state.J[state.scene == b].median()) - 1,  # type: ignore[index]
                "kinetic energy": records[-1]["kinetic"][b] / (energy[0] - floor_energy),
                "largest energy rise": float(max(np.diff(energy))) / energy[0],
                "profile": [[round(float(v) / radius, 4) for v in values] for values in (distance, depth)],
            }
        )
    exponents = {
        name: fitted_exponent(
            [row for row in rows if row["a"] >= 3] if narrow else [row for row in rows if row["a"] <= 2]
        )
        for name, narrow in (("wide", False), ("narrow", True))
    }
    print(f"{case.name}: {len(state)} particles, {steps} steps in {seconds:.1f} s", flush=True)
    return {
        "case": dataclasses.asdict(case),
        "name": case.name,
        "steps": steps,
        "seconds": seconds,
        "particles": len(state),
        "exponents": exponents,
        "rows": rows,
    }


def fitted_exponent(rows: Sequence[dict[str, Any]]) -> float:
    """Exponent of the run-out as a power of a."""
    points = [(math.log(row["a"]), math.log(row["run-out"])) for row in rows if row["run-out"] > 0]
    return float(np.polyfit(*zip(*points, strict=True), 1)[0]) if len(points) > 1 else math.nan


def standing(case: Case, angles: Sequence[float], duration: float, device: str) -> dict[str, Any]:
    """The steepest of some heaps that stands and the least steep that fails; `cells` is their height."""
    height = case.cells * DX
    states = []
    for angle in angles:
        body = Heap(height, math.radians(angle), None if case.dim == 2 else SLAB * DX)
        points = fill(body, DX, 2**case.dim, dtype=torch.float64)
        surface = height * (1 - points.x[:, 0] / body.upper[0])
        states.append(pressed(case, points, surface - points.x[:, 1], height))
    starts = torch.cat([s.x for s in states])
    begin = time.perf_counter()
    reach = 1.3 * height / math.tan(math.radians(min(angles)))
    state, _, steps = simulate(case, states, [height] * len(angles), reach, duration, device)
    moved = (state.restored().x.double().cpu() - starts).norm(dim=1).split([len(s) for s in states])
    displacement = [float(d.mean()) / height for d in moved]
    failed = [d > 0.02 for d in displacement]
    print(f"standing slopes, {case.name}: {steps} steps in {time.perf_counter() - begin:.1f} s", flush=True)
    return {
        "case": dataclasses.asdict(case),
        "name": case.name,
        "displacement": displacement,
        "steepest": max((angle for angle, f in zip(angles, failed, strict=True) if not f), default=math.nan),
        "least failing": min((angle for angle, f in zip(angles, failed, strict=True) if f), default=math.nan),
    }


def mobilised_angle(case: Case) -> float:
    """Mohr-Coulomb angle [degrees] of steady shear in plane strain, by a hundred steps of the return map."""
    dim = case.dim
    shear = torch.tensor([-0.1, 0.1, 0.0][:dim], dtype=torch.float64)
    h = torch.full_like(shear, -0.01)
    for _ in range(100):
        F = torch.diag_embed((h + shear).exp())[None]
        friction_angle = math.radians(case.friction_angle)
        lam = 2 * NU / (1 - 2 * NU)
        result = mpm.ops.quartic_return_map(F, 1.0, lam, friction_angle, energy=case.energy, flow=case.flow)
        h = result.F[0].diagonal().log()
    pressure = -result.stress[0].diagonal()
    least, most = float(pressure[:2].min()), float(pressure[:2].max())
    return math.degrees(math.asin((most - least) / (most + least)))


def measure(device: str, quick: bool, only: str) -> dict[str, Any]:
    """All parts whose kind and name match the regular expression `only`; few of them on the CPU."""
    cases, slopes, variants, aspects, angles = CASES, SLOPES, VARIANTS, ASPECTS, ANGLES
    duration, standing_duration = 6.0, 4.0
    if quick:
        cases = tuple(dataclasses.replace(c, cells=60) for c in (PLANAR[0], SLABS[0], ROUND[0]))
        slopes = tuple(dataclasses.replace(c, cells=10) for c in SLOPES[:2])
        variants, aspects, angles = (), (1.0, 2.0), (20, 50)
        duration = standing_duration = 1.0
    elif device == "cpu":
        cases, slopes, variants = (Case("planar", 640),), (Case("planar", 25),), ()

    def chosen(kind: str, among: Sequence[Case]) -> list[Case]:
        return [case for case in among if re.search(only, f"{kind} {case.name}")]

    with torch.no_grad():
        found = {
            "environment": common.environment(device),
            "variants": [collapse(c, (VARIED,), duration, device) for c in chosen("variant", variants)],
            "collapse": [collapse(c, aspects, duration, device) for c in chosen("column", cases)],
            "standing": [standing(c, angles, standing_duration, device) for c in chosen("slope", slopes)],
        }
    return reduced(found)


def drawn(result: dict[str, Any], shapes: Sequence[str]) -> list[dict[str, Any]]:
    """Cases of some shapes in a figure; the deposits are those of the last."""
    return [case for case in result["collapse"] if case["case"]["shape"] in shapes]


def reduced(result: dict[str, Any]) -> dict[str, Any]:
    """A result with the profiles of the figure only."""
    last = [drawn(result, shapes)[-1:] for shapes in FIGURES.values()]
    for case in (*result["collapse"], *result["variants"]):
        if [case] not in last:
            for row in case["rows"]:
                row.pop("profile", None)
    return result


# ---- report


def added(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """The results of two runs, in the order of the first; the newer where both have a case."""
    result = {"environment": new["environment"]}
    for part in ("collapse", "standing", "variants"):
        cases = {entry["name"]: entry for entry in (*old[part], *new[part])}
        result[part] = list(cases.values())
    return reduced(result)


def published(shape: str, a: float) -> float:
    """Published run-out."""
    _, limit, wide, narrow = PUBLISHED[shape]
    factor, power = wide if a < limit else narrow
    return factor * a**power


def slopes(result: dict[str, Any]) -> str:
    """Table of the stable slopes, with the angle that the law mobilises."""
    header = ("slope in plane strain", "steepest that stands [°]", "least steep that fails [°]", "mobilised [°]")
    rows = [
        (s["name"], s["steepest"], s["least failing"], f"{mobilised_angle(Case(**s['case'])):.1f}")
        for s in result["standing"]
    ]
    return common.table(header, rows)


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = ["# Collapse of columns of sand", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), ""]
    header = ("case", "exponent, a ≤ 2", "exponent, a ≥ 3", "particles", "steps", "seconds")
    rows = [
        (c["name"], *(f"{c['exponents'][k]:.2f}" for k in ("wide", "narrow")), c["particles"], c["steps"], c["seconds"])
        for c in result["collapse"]
    ]
    lines += ["## Exponents and run time", "", common.table(header, rows)]
    if result["standing"]:
        lines += ["", "## Standing slopes", "", slopes(result)]
    if result["variants"]:
        header = ("variant", "particles", "steps", "run-out", "run-out of 99%", "angle [°]", "volume", "seconds")
        rows = [
            (c["name"], c["particles"], c["steps"])
            + (*(c["rows"][0][k] for k in ("run-out", "run-out of 99%", "angle", "volume")), c["seconds"])
            for c in result["variants"]
        ]
        lines += ["", f"## On what the run-out depends (a = {VARIED:g})", "", common.table(header, rows)]
    keys = (
        "a", "particles", "radius / dx", "run-out", "run-out of 99%", "height", "angle", "volume", "kinetic energy",
        "largest energy rise",
    )  # fmt: skip
    for case in result["collapse"]:
        shape = "axisymmetric" if case["case"]["shape"] == "axisymmetric" else "planar"
        rows = [[row["a"], published(shape, row["a"]), *(row[k] for k in keys[1:])] for row in case["rows"]]
        lines += ["", f"## {case['name']}", "", common.table(("a", "published", *keys[1:]), rows)]
    return "\n".join(lines)


def plot(result: dict[str, Any], path: Path) -> None:
    """Run-out over aspect ratio, and the deposits of one case."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(13, 9))
    a = np.geomspace(0.4, 12, 100)
    for row, (title, sources) in zip(
        axes,
        (("planar", ("planar", "discs")), ("axisymmetric", ("axisymmetric",))),
        strict=True,
    ):
        for source, line in zip(sources, ("-", "--"), strict=False):
            row[0].loglog(
                a, [published(source, v) for v in a], color="gray", linestyle=line, label=PUBLISHED[source][0]
            )
        cases = drawn(result, FIGURES[title])
        for case in cases:
            row[0].loglog(
                [r["a"] for r in case["rows"]],
                [r["run-out"] for r in case["rows"]],
                marker="o",
                markersize=5,
                label=case["name"],
            )
        row[0].set(xlabel="aspect ratio a = H / r₀", ylabel="run-out (r − r₀) / r₀", title=title)
        row[0].legend(fontsize=7)
        for r in cases[-1]["rows"] if cases else ():
            row[1].plot(*r["profile"], label=f"a = {r['a']:g}, {r['angle']:.0f}°")
        row[1].set(xlabel="r / r₀", ylabel="depth / r₀", title="deposits: " + (cases[-1]["name"] if cases else ""))
        if cases:
            row[1].legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    print(f"wrote {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two small columns of each shape, to see that it works")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--only", default="", help="parts (column, slope or variant, and case) that match this")
    parser.add_argument("--add", action="store_true", help="to the results in --out, which keep their place")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    common.use_all_cores()
    result = measure(arguments.device, arguments.quick, arguments.only)
    if arguments.add:
        result = added(json.loads((arguments.out / "runout.json").read_text()), result)
    print(text(result).split("\n\n## ", 1)[1])
    common.write(arguments.out, "runout", result, text(result))
    plot(result, arguments.out / "runout.png")


if __name__ == "__main__":
    sys.exit(main())
