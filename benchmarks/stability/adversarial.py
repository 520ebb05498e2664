"""Random rollouts that try to invert particles: `python -m benchmarks.stability.adversarial`.

Each rollout is determined by its number: a motion (impacts, collisions, crushing between plates, spinning, stretching,
sprays, sheets, density jumps, an obstacle that moves through, prestress), a law of any stiffness, and dimension,
kernel, transfer, stress form, walls, density and length. dt = `step.stable_dt(state, cfl)` is recomputed at every step.
Speeds are up to three times √(E/ρ). The exit status is zero if there was no failure at cfl = 1.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.laws.parameters import Overlay

from .. import common
from ..catalogue.laws import FORMS
from .stable_dt import LAWS as SOLIDS

STEPS = 200
CFL = (1.0, 0.5)
GAIN = 1.1
"""Largest ratio of the energy of a closed system to its first one that counts as conserved."""

DESCRIBED = ("number", "motion", "law", "dim", "kernel", "transfer", "flip", "stress_form", "mach")
"""Fields of a case in a result; its number determines the others."""

LAWS: dict[str, Callable[[float, float], mpm.Material]] = {
    **SOLIDS,  # type: ignore[dict-item]
    "sand, unilateral": FORMS["sand_unilateral"],
    "sand, full": FORMS["sand_full"],
    "sand, Hencky": FORMS["sand_hencky"],
    "water, γ = 7": FORMS["water"],
    "water, γ = 1": partial(FORMS["water"], gamma=1.0),
    "viscous water": lambda E, nu: FORMS["water"](E, viscosity=0.01 * E),
}
MOTIONS = (
    "impact", "collision", "crushing", "spinning", "stretching", "density jump", "spray", "sheet", "obstacle",
    "prestress",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Case:
    """One rollout. Lengths are in cells, speeds in multiples of √(E/ρ)."""

    number: int
    motion: str
    law: str
    dim: int
    kernel: str
    transfer: str
    flip: float
    stress_form: str
    walls: str
    per_axis: int
    E: float
    nu: float
    density: float
    dx: float
    mach: float
    gravity: bool
    dtype: str

    @staticmethod
    def make(number: int) -> Case:
        draw = random.Random(number)
        dim = draw.choice((2, 2, 3))
        return Case(
            number=number,
            motion=MOTIONS[number % len(MOTIONS)],
            law=draw.choice(list(LAWS)),
            dim=dim,
            kernel=draw.choice(("quadratic", "cubic")),
            transfer=draw.choice(("apic", "apic", "pic", "flip")),
            flip=draw.choice((0.0, 0.0, 0.0, 0.95)),
            stress_form=draw.choice(("mls", "mls", "gradient")),
            walls=draw.choice(("slip", "sticky", "separate", "mirror")),
            per_axis=draw.choice((1, 2) if dim == 3 else (1, 2, 3)),
            E=10 ** draw.uniform(2, 9),
            nu=draw.choice((0.0, 0.2, 0.4, 0.49)),
            density=10 ** draw.uniform(0, 4),
            dx=10 ** draw.uniform(-6, 4),
            mach=draw.choice((0.03, 0.1, 0.3, 1.0, 3.0)),
            gravity=draw.random() < 0.5,
            dtype=draw.choice(("float64", "float64", "float32")),
        )

    @property
    def closed(self) -> bool:
        """Whether nothing outside does work on the particles."""
        return self.motion not in ("crushing", "obstacle")


@dataclasses.dataclass
class Problem:
    """Initial data of a rollout."""

    step: mpm.Step
    state: mpm.State
    speed: float  # its unit of speed: `mach` times √(E/ρ) [m/s]


CELLS = {2: 16, 3: 9}
"""Cells of the domain along each axis."""


def problem(case: Case) -> Problem:
    """The scene of a case. All random numbers depend on its number."""
    torch.manual_seed(case.number)
    cells, dx, dim = CELLS[case.dim], case.dx, case.dim
    law = LAWS[case.law](case.E, case.nu)
    speed = case.mach * math.sqrt(case.E / case.density)
    lower, upper = body(case, cells)
    axes = [(torch.arange(case.per_axis * n, dtype=torch.float64) + 0.5) / case.per_axis for n in upper - lower]
    x = torch.cartesian_prod(*axes) + lower
    if case.motion == "spray":
        x = lower + (upper - lower) * torch.rand(len(x) // 4, dim, dtype=torch.float64)
    volume = torch.full((len(x),), (dx / case.per_axis) ** dim, dtype=torch.float64)
    mass = case.density * volume
    if case.motion == "density jump":
        mass = torch.where(x[:, 0] > cells / 2, mass * 10 ** (1 + 3 * torch.rand(())), mass)
    state = mpm.State(x=x * dx, v=velocity(case, x) * speed, mass=mass, volume=volume)
    if case.motion == "prestress":
        state = prestressed(state, law)
    grid = mpm.Grid(dx=dx, lower=(0,) * dim, upper=(cells * dx,) * dim, kernel=case.kernel)
    gravity = (0.0,) * (dim - 1) + (-(speed**2) / (2 * cells * dx),) if case.gravity else None
    step = mpm.Step(
        grid, law, gravity, case.walls, obstacles(case, cells, speed), case.transfer, case.flip, case.stress_form
    )
    return Problem(step, state.to(dtype=getattr(torch, case.dtype)), speed)


def body(case: Case, cells: int) -> tuple[Tensor, Tensor]:
    """Corners of the box of particles, in cells."""
    lower, upper = torch.full((case.dim,), cells // 2 - 2), torch.full((case.dim,), cells // 2 + 2)
    if case.motion == "sheet":
        upper[0] = lower[0] + 1
        lower[1:], upper[1:] = 1, cells - 1
    if case.motion in ("collision", "density jump"):
        lower[0], upper[0] = cells // 2 - 3, cells // 2 + 3
    return lower, upper


def velocity(case: Case, x: Tensor) -> Tensor:
    """Velocities in the unit of speed, at positions [P, D] in cells."""
    direction = torch.nn.functional.normalize(torch.randn(1, case.dim, dtype=x.dtype))
    from_middle = x - x.mean(0)
    if case.motion == "spray":
        return torch.randn_like(x)
    if case.motion in ("collision", "density jump"):
        return -direction.abs() * from_middle[:, :1].sign()
    if case.motion in ("spinning", "stretching"):
        A = torch.randn(case.dim, case.dim, dtype=x.dtype)
        A = A - A.T if case.motion == "spinning" else A
        return from_middle @ A.T / from_middle.norm(dim=1).max()
    if case.motion in ("crushing", "obstacle"):
        return torch.zeros_like(x)
    return direction.expand_as(x)


def prestressed(state: mpm.State, law: mpm.Material) -> mpm.State:
    """Deformations that differ from particle to particle, from strong compression to strong stretch."""
    dim = state.x.shape[1]
    if "J" in law.state_fields:
        return state.replace(J=torch.exp(torch.randn_like(state.mass)))
    F = torch.linalg.matrix_exp(0.3 * torch.randn(len(state), dim, dim, dtype=state.x.dtype))
    return state.replace(F=F)


def obstacles(case: Case, cells: int, speed: float) -> Sequence[Any]:
    """Plates that close on the body, or a ball that goes through it."""
    dx, middle = case.dx, cells / 2 * case.dx

    def along_x(value: float, others: float = 0.0) -> list[float]:
        return [value] + [others] * (case.dim - 1)

    if case.motion == "crushing":
        return [
            mpm.Plane(along_x(middle - side * 2.5 * dx, middle), along_x(side), "slip", velocity=along_x(side * speed))
            for side in (1.0, -1.0)
        ]
    if case.motion == "obstacle":
        return [mpm.Sphere(along_x(middle - 4 * dx, middle), 1.5 * dx, "separate", velocity=along_x(speed))]
    return ()


def energy(step: mpm.Step, state: mpm.State, dt: float) -> float:
    """Kinetic, elastic and potential [J]."""
    law = step.law
    total = 0.5 * state.mass * state.v.square().sum(1)
    total = total + law.energy(Overlay(state, dt=dt) if getattr(law, "rate_dependent", False) else state)  # type: ignore[arg-type]
    if state.C is not None and step.transfer == "apic":
        second = step.grid.dx**2 / (4 if step.grid.kernel == "quadratic" else 3)
        total = total + 0.5 * state.mass * second * state.C.square().sum((1, 2))
    if step.gravity is not None:
        total = total - state.mass * (state.x @ torch.tensor(step.gravity, dtype=state.x.dtype))
    return float(total.double().sum())


def flattened(state: mpm.State) -> Tensor:
    """Particles with a stretch below the rounding error of the largest one, whose sign has no meaning, bool [P]."""
    if state.F is None:
        return torch.zeros_like(state.mass, dtype=torch.bool)
    stretches = torch.linalg.svdvals(state.F)
    return stretches[:, -1] < 10 * torch.finfo(state.F.dtype).eps * stretches[:, 0]


@torch.no_grad()
def run(case: Case, cfl: float, steps: int = STEPS) -> dict[str, Any]:
    """Number of failed particles and step of the failure, where the rollout ended; the largest energy over the
    first.
    """
    p = problem(case)
    step, state = p.step, p.step.prepare(p.state)
    row: dict[str, Any] = {"inverted": 0, "flattened": 0, "not finite": 0, "step": None}
    dt = 0.0
    first = energy(step, state, dt)
    scale = max(first, 1e-3 * p.speed**2 * float(state.mass.sum()))
    largest = first
    for n in range(steps):
        dt = min(float(step.stable_dt(state, cfl)), 10 * case.dx / p.speed)
        before, state = state, step(state, dt)
        lost = ~(state.x.isfinite().all(1) & state.v.isfinite().all(1))
        wrong = step.law.invalid(state) & ~lost
        if bool((lost | wrong).any()):
            flat = wrong & flattened(before)
            counts = {"inverted": wrong & ~flat, "flattened": flat, "not finite": lost}
            row |= {name: int(particles.sum()) for name, particles in counts.items()} | {"step": n}
            break
        largest = max(largest, energy(step, state, dt))
    described = {name: getattr(case, name) for name in DESCRIBED}
    return {**described, **row, "cfl": cfl, "gain": largest / scale, "closed": case.closed}


def rises(row: dict[str, Any]) -> bool:
    """Whether a closed system gained energy; noise of FLIP is not counted."""
    return row["closed"] and row["gain"] > GAIN and row["transfer"] != "flip" and row["flip"] == 0


COUNTS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "inverted": lambda row: row["inverted"] > 0,
    "not finite": lambda row: row["not finite"] > 0,
    "energy rises": rises,
    "flattened": lambda row: row["flattened"] > 0,
}


def reduced(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rollouts by motion and by law, numbers of them per cfl, and the rows of those that failed."""
    first = [row for row in rows if row["cfl"] == CFL[0]]
    return {
        "rollouts": {key: dict(Counter(row[key] for row in first)) for key in ("motion", "law")},
        "rows": [row for row in rows if any(f(row) for f in COUNTS.values())],
    }


def summary(result: dict[str, Any], key: str) -> str:
    """A table of rollouts that failed, by motion or law, for each cfl; failures that never occurred are omitted."""
    rows, rollouts = result["rows"], result["rollouts"][key]
    seen = {name: f for name, f in COUNTS.items() if name == "inverted" or any(map(f, rows))}
    header = [key, "rollouts", *(f"{name}, {cfl:g}" for cfl in CFL for name in seen)]
    lines = []
    for value, number in [*rollouts.items(), ("all", sum(rollouts.values()))]:
        mine = [row for row in rows if value in (row[key], "all")]
        counts = [sum(f(row) for row in mine if row["cfl"] == cfl) for cfl in CFL for f in seen.values()]
        lines.append([value, number, *counts])
    return common.table(header, lines)


def text(result: dict[str, Any]) -> str:
    lines = ["# Random rollouts at the limit of the time step", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 1)[1].strip(), ""]
    lines += [
        f"Rollouts of {result['steps']} steps, by cfl, in which a particle turned inside out or was not finite, in",
        f"which the energy of a closed system rose above {GAIN:g} of the first (without FLIP), and in which a particle",
        "had been flattened to rounding before it lost its sign, which a law of finite energy cannot prevent.",
        "",
        summary(result, "motion"),
        "",
        summary(result, "law"),
    ]
    keys = (*DESCRIBED, "cfl", "step", "gain")
    wrong = [[row[k] for k in keys] for row in result["rows"]]
    return "\n".join([*lines, "", "## What went wrong", "", common.table(keys, wrong)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few rollouts, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("--count", type=int, default=240, help="number of rollouts")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    count, begin = 10 if arguments.quick else arguments.count, time.perf_counter()
    result: dict[str, Any] = {"environment": common.environment(), "steps": 30 if arguments.quick else STEPS}
    cases = [Case.make(number) for number in range(count)]
    result |= reduced([run(case, cfl, result["steps"]) for cfl in CFL for case in cases])
    result["seconds"] = time.perf_counter() - begin
    print(summary(result, "motion"))
    common.write(arguments.out, "adversarial", result, text(result))
    sys.exit(any(row["cfl"] == 1 and (row["inverted"] or row["not finite"]) for row in result["rows"]))


if __name__ == "__main__":
    main()
