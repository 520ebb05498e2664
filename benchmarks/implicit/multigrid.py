"""Would multigrid pay as a preconditioner of implicit steps?

An experiment in float64: the Hessians of linear solves are assembled by products with coloured vectors, and solved by
conjugate gradients with other preconditioners than the node blocks of the library.

"V(d, d)": a V-cycle with d Chebyshev iterations of the node blocks before and after; coarse levels are PᵀAP with linear
interpolation P between lattices of dx, 2 dx, ..., the coarsest is solved. "additive": the same levels side by side,
each with its node blocks and the coarsest solved, so that an iteration needs no further product (Bramble, Pasciak and
Xu 1990). "patches": inverses of the 2^D nodes of each cell that has a light node (below a fifth of the heaviest),
weighted and added, the node blocks elsewhere. "scalar patches": the same inverses of the correlations between nodes, of
the mean of the components, between B^(-1/2) and B^(-1/2). With "V" or "additive" the finest level has them.

Cost is counted in products with A, each a gather, the tangents and a scatter. The rest of an iteration counts by the
numbers that it reads and writes beside those of a product: 54 per particle in 3-D, 25 in 2-D. Coarse matrices are
stencils of 5^D blocks, patches symmetric. Set-up, per iteration of Newton's method, by the operations of a kernel that
assembles particle by particle: a coarse matrix 4 products in 2-D and 14 in 3-D, patches the half, scalar ones 1/D
of that, node blocks of a level 1.5. Launches of kernels are not counted.

Bodies: a block on a sticky floor, a beam of a sixth of its length in height that is clamped at an end, a ball on a
sticky plane; "cells" along the side, the length and the diameter. E = 1e8 Pa, ν = 0.3, 2^D particles per cell. "static"
is the equilibrium under gravity, other steps are in explicit limits. "contrast": a core 1000 times as stiff as the
rest. Bars of the stability study, half as high as long, first stretched to five times their length, which takes
particles apart, or spinning by a radian per step.

Linear solves: iterations with the first Hessian of a step until √(r · B⁻¹ r) is a share of the first, and the cost of
node blocks over that of the row, set-up not counted. Steps: all linear solves of a step, set-up counted;
"difference" of the displacements from those with node blocks.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any
from unittest import mock

import numpy as np
import torch

import torch_mpm as mpm
from torch_mpm.implicit import Implicit, quadratic_model
from torch_mpm.ops.implicit import CONVERGED, NEGATIVE_CURVATURE, SOLVING, ImplicitSolve

from ..common import one_thread
from .preconditioners import MOST, Preconditioner, System, assembled, iterations, preconditioner
from .stability import bar, started

SHARES = (1e-1, 1e-2, 1e-4, 1e-8)


def counts(s: System, p: Preconditioner) -> dict[float, int]:
    """Iterations to each share of the first residual."""
    first, found = float(np.sqrt(s.b @ (s.inverse @ s.b))), {}
    for k, (_, size) in enumerate(iterations(s, p), 1):
        found |= {share: k for share in SHARES if size <= share * first and share not in found}
        if len(found) == len(SHARES):
            break
    return found


class Work:
    """Solver of the linear systems of a step, which accumulates their costs."""

    def __init__(self, name: str) -> None:
        self.name, self.iterations, self.cost, self.solves = name, 0, 0.0, 0

    def __call__(self, *arguments: Any, local: Any = None, images: Any = None, held: Any = None) -> ImplicitSolve:
        _, _, rhs, mass, _, _, relative, *_ = arguments
        s = assembled(*arguments[:6])
        p = preconditioner(s, self.name)
        goal = float(relative[0]) * float(np.sqrt(s.b @ (s.inverse @ s.b)))
        d, state, k = np.zeros_like(s.b), NEGATIVE_CURVATURE, 0
        for k, (x, size) in enumerate(iterations(s, p), 1):
            d, state = x, CONVERGED if size <= goal else SOLVING if k == MOST else NEGATIVE_CURVATURE
            if state == CONVERGED:
                break
        self.solves, self.iterations = self.solves + 1, self.iterations + k
        self.cost += k * (1 + p.cost) + p.setup
        solution = torch.zeros_like(rhs)
        used = torch.nonzero(mass > 0)[:, 0]
        solution[used[s.node], s.component] = torch.from_numpy(d)
        return ImplicitSolve(solution, torch.tensor([k]).int(), relative.double(), torch.tensor([state]).int())


@dataclasses.dataclass
class Case:
    """A body and its step: `cells` along it, `multiple` of the explicit limit, zero for equilibrium."""

    body: str
    dim: int
    cells: int
    nu: float = 0.3
    multiple: float = 0.0
    contrast: float = 1.0
    tolerance: float = 1e-6

    def described(self) -> dict[str, Any]:
        words = [self.body, f"ν = {self.nu}" if self.nu != 0.3 else "", "contrast" if self.contrast != 1 else ""]
        length = f"{self.multiple:g}" if self.multiple else "static"
        return {"body": ", ".join(w for w in words if w), "dim": self.dim, "cells": self.cells, "dt": length}

    def made(self) -> tuple[mpm.Step, mpm.State, float]:
        if self.body in ("stretched", "spinning"):
            grid, state, law, limit = bar(1e8, self.nu, 1 / self.cells)
            dt = self.multiple * limit
            return mpm.Step(grid, law, integrator=Implicit(self.tolerance, 60)), started(state, self.body, dt), dt
        dim, dx = self.dim, 1 / self.cells
        rest = (0.0,) * (dim - 1)
        grid = mpm.Grid(dx, (-0.5,) * dim, (1.5,) * dim)
        if self.body == "block":
            points = mpm.seed.box((0.0, -0.5, 0.0)[:dim], (1.0, 0.5, 1.0)[:dim], grid, per_cell=2**dim)
            held = mpm.Plane((0.0, -0.5, 0.0)[:dim], (0.0, 1.0, 0.0)[:dim], kind="sticky")
        elif self.body == "beam":
            points = mpm.seed.box((-4 * dx, *(-1 / 12,) * (dim - 1)), (1, *(1 / 12,) * (dim - 1)), grid, 2**dim)
            held = mpm.Plane((0.0, *rest), (1.0, *rest), kind="sticky")
        else:
            points = mpm.seed.sphere((0.5,) * dim, 0.5, grid, per_cell=2**dim)
            held = mpm.Plane((0.0, 0.05, 0.0)[:dim], (0.0, 1.0, 0.0)[:dim], kind="sticky")
        state = mpm.State.at_rest(points, 1000.0, dtype=torch.float64)
        hard = ((state.x - state.x.mean(0)).abs() < 0.25).all(1)
        E = torch.where(hard, 1e8, 1e8 / self.contrast).double()
        law = mpm.NeoHookean(E=E if self.contrast != 1 else 1e8, nu=self.nu)
        step = mpm.Step(grid, law, (0.0, -9.8, 0.0)[:dim], boundaries=[held], integrator=Implicit(self.tolerance))
        dt = self.multiple * float(step.stable_dt(state, cfl=1.0).min()) if self.multiple else 1e3
        return step, state, dt


LINEAR = (*(Case("block", 2, n) for n in (16, 32, 64)), Case("block", 2, 64, multiple=10.0),
          Case("block", 2, 64, multiple=100.0), Case("block", 2, 32, nu=0.49), Case("block", 2, 32, contrast=1e3),
          Case("beam", 2, 96), *(Case("block", 3, n) for n in (8, 16)), Case("block", 3, 16, multiple=100.0),
          Case("block", 3, 12, nu=0.49), Case("block", 3, 12, contrast=1e3), Case("ball", 3, 24),
          Case("beam", 3, 36), Case("block", 3, 32))  # fmt: skip
STEPS = (*(Case("block", 2, n) for n in (16, 32, 64)), Case("beam", 2, 96), Case("stretched", 2, 16, multiple=100.0),
         Case("spinning", 2, 32, multiple=100.0), *(Case("block", 3, n) for n in (8, 16)),
         Case("block", 3, 16, multiple=100.0, tolerance=1e-4), Case("ball", 3, 12), Case("beam", 3, 24))  # fmt: skip
NAMES = ("blocks", "V(2, 2)", "additive", "patches", "scalar patches", "V(1, 1), patches", "additive, patches",
         "additive, scalar patches")  # fmt: skip


class Enough(Exception):
    """Raised after the first linear solve."""


def first_system(case: Case) -> System:
    """Costs of the first linear solve of a step."""
    found = []

    def keep(*arguments: Any, **rest: Any) -> Any:
        found.append(assembled(*arguments[:6]))
        raise Enough

    step, state, dt = case.made()
    with mock.patch.object(quadratic_model, "implicit_cg", keep), torch.no_grad(), contextlib.suppress(Enough):
        step(state, dt)
    return found[0]


@one_thread()
def linear_solves(quick: bool) -> list[dict[str, Any]]:
    rows = []
    for case in LINEAR[:1] if quick else LINEAR:
        s = first_system(case)
        base: dict[float, float] = {}
        for name in NAMES:
            p = preconditioner(s, name)
            found = counts(s, p)
            cost = {share: n * (1 + p.cost) for share, n in found.items()}
            base = base or cost
            ratios = {f"ratio, {share:g}": base[share] / cost[share] if share in cost else None for share in SHARES}
            rows.append({**case.described(), "unknowns": len(s.b), "preconditioner": name, "cost": 1 + p.cost,
                         **{f"{share:g}": found.get(share) for share in SHARES}, **ratios})  # fmt: skip
    return rows


@one_thread()
def steps(quick: bool) -> list[dict[str, Any]]:
    rows = []
    for case in STEPS[:1] if quick else STEPS:
        base, first = 0.0, None
        for name in NAMES:
            work = Work(name)
            step, state, dt = case.made()
            with mock.patch.object(quadratic_model, "implicit_cg", work), torch.no_grad():
                end = step(state, dt).x
            report = step.solve_report
            assert report is not None
            base, first = base or work.cost, end if first is None else first
            done = {"converged": bool(report.converged.all()), "Newton": work.solves, "CG": work.iterations}
            rows.append({**case.described(), "tolerance": case.tolerance, "preconditioner": name, **done,
                         "cost": work.cost, "ratio": base / work.cost,
                         "difference": float((end - first).norm() / (first - state.x).norm())})  # fmt: skip
    return rows
