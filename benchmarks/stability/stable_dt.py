"""Largest stable time step against the estimate of `step.stable_dt`: `python -m benchmarks.stability.stable_dt`.

A block of particles with one uniform deformation between slip walls is in equilibrium for any prestress. It is
disturbed by noise of 1e-7 of the wave speed, so that the motion stays linear; a step is stable if the noise does not
grow a hundredfold. Many steps are tried at once, as the scenes of a batch, then the bracket is refined. A case that is
unstable at 0.9 of the estimate and, over three times the time, at a tenth of it is unstable for any step.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common
from ..catalogue import laws

DENSITY = 1000.0
GROWTH = 100.0
CELLS = {2: 6, 3: 4}
STEPS = 150
COARSE = [0.9 * 1.25**k for k in range(10)]
"""Multiples of the estimate that are tried first."""

STRENGTH = 0.05
"""Strength of plastic laws, so that large strains yield."""
LAWS: dict[str, Callable[[Tensor, Tensor], mpm.Material]] = {
    title: partial(law, strength=STRENGTH)
    for title, law in {
        "neo-Hookean": laws.LAWS["neo_hookean"],
        "fixed corotated": laws.LAWS["fixed_corotated"],
        "Hencky": laws.LAWS["hencky"],
        "von Mises": laws.LAWS["von_mises"],
        "Herschel-Bulkley": laws.LAWS["herschel_bulkley"],
        "snow": laws.LAWS["snow"],
        "Cam-Clay": laws.LAWS["cam_clay"],
    }.items()
}
"""Laws of Young's modulus and Poisson's ratio."""


MATERIAL = ("dim", "E", "nu", "stretch", "stable")
SETTING = ("layout", "transfer", "stress_form", "kernel", "nu", "stretch", "stable")
"""Fields of the rows of a result."""


@dataclasses.dataclass(frozen=True)
class Case:
    """Stretch s < 1 is F = s I, s > 1 is F = diag(s, ...) of unit determinant; layouts are those of `positions`."""

    dim: int
    E: float = 1e6
    nu: float = 0.3
    stretch: float = 1.0
    layout: str = "2 per axis"
    transfer: str = "apic"
    stress_form: str = "mls"
    kernel: str = "quadratic"
    law: str = "neo-Hookean"

    @property
    def setting(self) -> tuple[Any, ...]:
        """Cases of one setting run in one batch."""
        return self.dim, self.layout, self.transfer, self.stress_form, self.kernel, self.law

    def deformation(self) -> Tensor:
        other = self.stretch if self.stretch < 1 else self.stretch ** (-1 / (self.dim - 1))
        return torch.diag(torch.tensor([self.stretch] + [other] * (self.dim - 1), dtype=torch.float64))


def positions(dim: int, layout: str, dx: float, generator: torch.Generator) -> tuple[Tensor, float]:
    """Particles that fill the domain and one cell around it, and the volume of one of them in cells.

    Layouts: lattices with "2 per axis" and "1 per axis" of a cell, "random" with as many as the former, "isolated".
    """
    if layout == "isolated":
        return 0.4 + 0.2 * torch.rand(1, dim, generator=generator, dtype=torch.float64), 1.0
    per_axis = 1 if layout == "1 per axis" else 2
    axis = ((torch.arange(round(1 / dx + 2) * per_axis, dtype=torch.float64) + 0.5) / per_axis - 1) * dx
    x = torch.cartesian_prod(*[axis] * dim)
    if layout == "random":
        x = (1 + 2 * dx) * torch.rand(x.shape, generator=generator, dtype=torch.float64) - dx
    return x, per_axis**-dim


def stable(cases: Sequence[Case], factors: Tensor, steps: int = STEPS, device: str = "cpu") -> Tensor:
    """Stability of multiples of the estimate, bool [cases, K]; cases of one setting."""
    first, (count, tries) = cases[0], factors.shape
    dim, scenes = first.dim, count * tries
    grid = mpm.Grid(1 / CELLS[dim], (0,) * dim, (1,) * dim, scenes=scenes, kernel=first.kernel)
    generator = torch.Generator().manual_seed(1)
    x, volume = positions(dim, first.layout, grid.dx, generator)
    n = len(x)

    def per_scene(values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64).repeat_interleave(tries)

    law = LAWS[first.law](per_scene([c.E for c in cases]), per_scene([c.nu for c in cases])).to(device)
    F = torch.stack([c.deformation() for c in cases]).repeat_interleave(tries * n, 0)
    rest_volume = volume * grid.dx**dim / torch.linalg.det(F)
    state = mpm.State(
        x=x.repeat(scenes, 1),
        v=torch.zeros(scenes * n, dim, dtype=torch.float64),
        mass=DENSITY * rest_volume,
        volume=rest_volume,
        F=F,
        scene=torch.arange(scenes).repeat_interleave(n).int(),
    ).to(device)
    walls = None if first.layout == "isolated" else "slip"
    step = mpm.Step(grid, law, walls=walls, transfer=first.transfer, stress_form=first.stress_form)
    estimate = step.stable_dt(state, cfl=1.0)
    speed = 1e-7 * law.wave_speed(state)[:, None]
    noise = torch.randn(n, dim * (1 + dim), generator=generator, dtype=torch.float64)
    noise = speed * noise.repeat(scenes, 1).to(device)
    state = state.replace(v=noise[:, :dim], C=noise[:, dim:].reshape(-1, dim, dim) / grid.dx)
    start = largest = size(state, grid)
    for _ in range(steps):
        state = step(state, estimate * factors.flatten().to(device))
        largest = torch.maximum(largest, size(state, grid))
    return (largest < GROWTH * start).view(count, tries).cpu()


def size(state: mpm.State, grid: mpm.Grid) -> Tensor:
    """The largest |v| + dx |C| of each scene, infinite where something is not finite."""
    value = state.v.norm(dim=1)
    if state.C is not None:
        value = value + grid.dx * state.C.norm(dim=(1, 2))
    assert state.scene is not None
    zero = value.new_zeros(grid.scenes)
    return zero.scatter_reduce(0, state.scene.long(), value.nan_to_num(torch.inf), "amax")


@torch.no_grad()
def measure(cases: Sequence[Case], device: str = "cpu") -> list[dict[str, Any]]:
    """The limit of each case, "stable", in multiples of the estimate: lower end of a bracket; 0: unstable at any dt."""
    results = []
    for setting, group in itertools.groupby(cases, key=lambda c: c.setting):
        batch = list(group)
        low, high = bracket(batch, torch.tensor(COARSE, dtype=torch.float64).repeat(len(batch), 1), device)
        never = torch.zeros(len(batch), dtype=torch.bool)
        if failed := (low == 0).nonzero().flatten().tolist():
            tenth = torch.full((len(failed), 1), 0.1, dtype=torch.float64)
            never[failed] = ~stable([batch[i] for i in failed], tenth, 30 * STEPS, device)[:, 0]
        between = torch.linspace(0, 1, 9, dtype=torch.float64)[1:-1]
        low, _ = bracket(batch, low[:, None] + (high - low)[:, None] * between, device, low, high)
        low = low.where(~never, 0)
        results += [{**dataclasses.asdict(c), "stable": limit} for c, limit in zip(batch, low.tolist(), strict=True)]
        print(*setting, f"{len(batch)} cases", flush=True)
    return results


def bracket(
    cases: Sequence[Case], factors: Tensor, device: str, low: Tensor | None = None, high: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The largest multiple up to which all are stable, and the next; `low` is known to be and `high` not to be."""
    good = stable(cases, factors, STEPS, device)
    low = factors.new_zeros(len(cases)) if low is None else low
    high = 2 * factors[:, -1] if high is None else high
    ladder = torch.cat([low[:, None], factors, high[:, None]], 1)
    passed = good.int().cumprod(1).sum(1)
    row = torch.arange(len(cases))
    return ladder[row, passed], ladder[row, passed + 1]


def all_cases(quick: bool) -> tuple[list[Case], list[Case]]:
    """Materials and deformations in one setting, and settings with few materials."""
    stiffness = (1e6,) if quick else (1e3, 1e6, 1e9)
    ratios = (0.0, 0.49) if quick else (0.0, 0.2, 0.4, 0.49)
    stretches = (0.05, 1.0, 20.0) if quick else (0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0)
    dims = (2,) if quick else (2, 3)
    layouts = ("2 per axis", "1 per axis", "random", "isolated")
    transfers = ("apic", "pic", "flip")
    forms, kernels = (("mls",), ("quadratic",)) if quick else (("mls", "gradient"), ("quadratic", "cubic"))
    materials = [Case(*values) for values in itertools.product(dims, stiffness, ratios, stretches)]
    settings = [
        Case(2, nu=nu, stretch=stretch, layout=layout, transfer=transfer, stress_form=form, kernel=kernel)
        for layout, transfer, form, kernel in itertools.product(layouts, transfers, forms, kernels)
        if layout != "isolated" or (transfer, form) == ("apic", "mls")
        for stretch in ((1.0,) if layout in ("random", "isolated") else (0.5, 1.0, 3.0))
        for nu in (0.0, 0.49)
    ]
    return materials, settings


def text(result: dict[str, Any]) -> str:
    materials, settings = result["materials"], result["settings"]
    buckling = [c["stable"] for c in settings if crowded(c)]
    others = materials + [c for c in settings if not crowded(c)]
    limited = [c["stable"] for c in others if c["stable"] > 0]
    hopeless = sum(c["stable"] == 0 for c in materials + settings)
    lines = [
        "# Largest stable time step",
        "",
        f"{common.describe(result['environment'])}; {result['seconds']:.0f} s.",
        "",
        "The largest stable time step in multiples of the estimate `step.stable_dt(state, cfl=1)`: the lower end of a",
        f"bracket 3% wide. The smallest of {len(limited)} cases is {min(limited):.2f}. {hopeless} cases are unstable",
        "for every step (–): the grid does not resolve all motions of their particles, and prestress feeds those. One",
        f"particle per cell under compression ({len(buckling)} cases, apart) buckles in this way; PIC damps that per",
        "step, which leaves a limit that is not one of waves.",
        "",
        "## Material and deformation",
        "",
        "APIC, MLS, quadratic kernel, 2 particles per axis of a cell. s < 1 is F = s I, s > 1 is F = diag(s, ...) with",
        "det F = 1.",
        "",
    ]
    for dim in sorted({c["dim"] for c in materials}):
        mine = [c for c in materials if c["dim"] == dim]
        columns = sorted({(c["nu"], c["E"]) for c in mine})
        rows = []
        for s in sorted({c["stretch"] for c in mine}):
            found = {(c["nu"], c["E"]): ratio(c["stable"]) for c in mine if c["stretch"] == s}
            rows.append([f"{s:g}", *(found[column] for column in columns)])
        header = ["s", *(f"ν={nu:g}, E={E:.0e}" for nu, E in columns)]
        lines += [f"### {dim}-D", "", common.table(header, rows), ""]
    keys = ("layout", "transfer", "stress_form", "kernel")
    columns = sorted({(c["stretch"], c["nu"]) for c in settings})
    rows = []
    for key in dict.fromkeys(tuple(c[k] for k in keys) for c in settings):
        found = {(c["stretch"], c["nu"]): ratio(c["stable"]) for c in settings if tuple(c[k] for k in keys) == key}
        rows.append([*key, *(found.get(column, "") for column in columns)])
    header = [*keys, *(f"s={s:g}, ν={nu:g}" for s, nu in columns)]
    return "\n".join([*lines, "## Layout, transfer, stress form and kernel (2-D)", "", common.table(header, rows)])


def crowded(case: dict[str, Any]) -> bool:
    return case["layout"] == "1 per axis" and case["stretch"] < 1


def ratio(value: float) -> str:
    return f"{value:.2f}" if value > 0 else "–"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few cases, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    common.use_all_cores()
    begin = time.perf_counter()
    materials, settings = all_cases(arguments.quick)
    result: dict[str, Any] = {"environment": common.environment()}
    result["materials"] = [{key: row[key] for key in MATERIAL} for row in measure(materials)]
    result["settings"] = [{key: row[key] for key in SETTING} for row in measure(settings)]
    result["seconds"] = time.perf_counter() - begin
    print(text(result))
    common.write(arguments.out, "stability", result, text(result))


if __name__ == "__main__":
    sys.exit(main())
