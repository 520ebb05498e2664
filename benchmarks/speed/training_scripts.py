"""Scripts that call a simulator for every step, as users of other projects write them. A part of `training`."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Callable
from types import SimpleNamespace

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torch_mpm.checkpoints import contexts
from torch_mpm.compat import mpm_pytorch, nclaw

from . import work
from .training_peer import DenseSolver, Particles, corotated
from .training_peer_warp import WarpSolver

GRAVITY = (0.0, -work.GRAVITY, 0.0)
E, NU = work.MU * (3 * work.LAM + 2 * work.MU) / (work.LAM + work.MU), work.LAM / (2 * (work.LAM + work.MU))

Take = Callable[..., Particles]
"""x, v, C and F a step later."""
Make = Callable[[work.Work, Tensor], Take]
"""Of the work and its positions."""


def mpm_pytorch_here(w: work.Work, x: Tensor) -> Take:
    edge = (w.particles * w.volume) ** (1 / 3)
    solver = mpm_pytorch.MPMSolver(x, work.DENSITY, w.n, work.DT, GRAVITY, size=(edge,) * 3)
    elasticity = mpm_pytorch.constitutive_models.CorotatedElasticity(E, NU).to(x.device)

    def take(x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> Particles:
        return solver(x, v, C, F, elasticity(F))

    return take


def mpm_pytorch_there(w: work.Work, x: Tensor) -> Take:
    return DenseSolver(w.n, w.mass, w.volume, work.MU, work.LAM, GRAVITY, work.DT, x)


def nclaw_here(w: work.Work, x: Tensor) -> Take:
    settings = {"num_grids": w.n, "dt": work.DT, "bound": 3, "gravity": GRAVITY, "eps": 0.0}
    model = nclaw.sim.MPMModelBuilder().parse_cfg(settings).finalize(x.device, requires_grad=True)
    body = nclaw.sim.MPMInitData(work.DENSITY, 0.5, (0, 1), w.particles, w.volume, w.x)
    initializer = nclaw.sim.MPMStaticsInitializer(model)
    initializer.add_group(body)
    statics, sim = initializer.finalize(), nclaw.sim.MPMDiffSim(model)
    elasticity = nclaw.material.CorotatedElasticity(SimpleNamespace(E=E, nu=NU, random=False)).to(x.device)

    def take(x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> Particles:
        return sim(statics, x, v, C, F, elasticity(F))

    return take


def nclaw_there(w: work.Work, x: Tensor) -> Take:
    solver = WarpSolver(w.n, w.mass, w.volume, GRAVITY, work.DT)

    def take(x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> Particles:
        x, v, C, F = solver(x, v, C, F, corotated(F, work.MU, work.LAM))
        return x, v, C, F

    return take


@dataclasses.dataclass(frozen=True)
class Project:
    """What people come from: the form of its forces, its script here, and its algorithm."""

    stress_form: str
    here: Make
    there: Make
    precision: torch.dtype
    """The best that its algorithm has."""
    checkpoints: bool
    """Whether its users put checkpoints of torch around every step."""
    needs: str = "torch"
    """Package without which its algorithm does not run."""

    def scripts(self) -> dict[str, Make]:
        there = {"its algorithm": self.there} if importlib.util.find_spec(self.needs) else {}
        return {"its script on torch_mpm.compat": self.here, **there}


PROJECTS = {
    "MPM-PyTorch": Project("gradient", mpm_pytorch_here, mpm_pytorch_there, torch.float64, True),
    "NCLaw": Project("mls", nclaw_here, nclaw_there, torch.float32, False, "warp"),
}


def taken(take: Take, particles: Particles, n: int, checkpoints: bool) -> Particles:
    """n steps; with checkpoints each is taken again by the backward pass."""
    for _ in range(n):
        if checkpoints:
            particles = checkpoint(take, *particles, use_reentrant=False, context_fn=contexts)
        else:
            particles = take(*particles)
    return particles
