"""Scripts that call a simulator, as users of other projects write them. Part of `training`."""

from __future__ import annotations

import dataclasses
import importlib.metadata
from collections.abc import Callable
from types import SimpleNamespace

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torch_mpm.compat import mpm_pytorch, nclaw, physgaussian
from torch_mpm.rollouts.checkpoints import contexts

from . import work
from .inference_peer_warp import WarpSimulator
from .training_peer import DenseSolver, Particles, corotated
from .training_peer_warp import WarpSolver

GRAVITY = (0.0, -work.GRAVITY, 0.0)
E, NU = work.MU * (3 * work.LAM + 2 * work.MU) / (work.LAM + work.MU), work.LAM / (2 * (work.LAM + work.MU))

Take = Callable[..., tuple[Tensor, ...]]
"""x, v, C and F a step later."""
Run = Callable[[Particles, int, bool], Particles]
"""x, v, C and F n steps later; whether torch's checkpoints surround each of them."""
Make = Callable[[work.Work, Tensor], Run]
"""Function of the work and its positions."""


def stepwise(take: Take) -> Run:
    """Steps one by one."""

    def run(particles: Particles, n: int, checkpoints: bool) -> Particles:
        for _ in range(n):
            if checkpoints:
                x, v, C, F = checkpoint(take, *particles, use_reentrant=False, context_fn=contexts)
            else:
                x, v, C, F = take(*particles)
            particles = x, v, C, F
        return particles

    return run


def mpm_pytorch_here(w: work.Work, x: Tensor) -> Run:
    edge = (w.particles * w.volume) ** (1 / 3)
    solver = mpm_pytorch.MPMSolver(x, work.DENSITY, w.n, work.DT, GRAVITY, size=(edge,) * 3)
    elasticity = mpm_pytorch.constitutive_models.CorotatedElasticity(E, NU).to(x.device)

    def take(x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> Particles:
        return solver(x, v, C, F, elasticity(F))

    return stepwise(take)


def mpm_pytorch_there(w: work.Work, x: Tensor) -> Run:
    return stepwise(DenseSolver(w.n, w.mass, w.volume, work.MU, work.LAM, GRAVITY, work.DT, x))


def nclaw_here(w: work.Work, x: Tensor) -> Run:
    settings = {"num_grids": w.n, "dt": work.DT, "bound": 3, "gravity": GRAVITY, "eps": 0.0}
    model = nclaw.sim.MPMModelBuilder().parse_cfg(settings).finalize(x.device, requires_grad=True)
    body = nclaw.sim.MPMInitData(work.DENSITY, 0.5, (0, 1), w.particles, w.volume, w.x)
    initializer = nclaw.sim.MPMStaticsInitializer(model)
    initializer.add_group(body)
    statics, sim = initializer.finalize(), nclaw.sim.MPMDiffSim(model)
    elasticity = nclaw.material.CorotatedElasticity(SimpleNamespace(E=E, nu=NU, random=False)).to(x.device)

    def take(x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> Particles:
        return sim(statics, x, v, C, F, elasticity(F))

    return stepwise(take)


def nclaw_there(w: work.Work, x: Tensor) -> Run:
    solver = WarpSolver(w.n, w.mass, w.volume, GRAVITY, work.DT)

    def take(x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> tuple[Tensor, ...]:
        return solver(x, v, C, F, corotated(F, work.MU, work.LAM))

    return stepwise(take)


def physgaussian_here(w: work.Work, x: Tensor) -> Run:
    numbers = {"material": "jelly", "E": E, "nu": NU, "density": work.DENSITY, "g": list(GRAVITY)}

    def run(particles: Particles, n: int, checkpoints: bool) -> Particles:
        x, v, C, F = particles
        simulator = physgaussian.MPM_Simulator_WARP(len(x))
        simulator.load_initial_data_from_torch(x, torch.full_like(x[:, 0], w.volume), n_grid=w.n, grid_lim=1.0)
        simulator.import_particle_v_from_torch(v)
        simulator.import_particle_C_from_torch(C.flatten(1))
        simulator.import_particle_F_from_torch(F.flatten(1))
        simulator.set_parameters_dict(numbers)
        simulator.finalize_mu_lam()
        for k in range(n):
            simulator.p2g2p(k, work.DT)
        x, v = simulator.export_particle_x_to_torch(), simulator.export_particle_v_to_torch()
        C, F = simulator.export_particle_C_to_torch(), simulator.export_particle_F_to_torch()
        return x, v, C.view(-1, 3, 3), F.view(-1, 3, 3)

    return run


def physgaussian_there(w: work.Work, x: Tensor) -> Run:
    return stepwise(WarpSimulator(w.n, w.mass, w.volume, work.MU, work.LAM, GRAVITY, work.DT))


def has_warp() -> bool:
    """Whether Warp is available in a version whose `svd3` returns its results."""
    try:
        version = importlib.metadata.version("warp-lang")
    except importlib.metadata.PackageNotFoundError:
        return False
    return [int(part) for part in version.split(".")[:2]] >= [1, 7]


@dataclasses.dataclass(frozen=True)
class Project:
    """A project of users: the form of its forces, its script for torch_mpm, and its algorithm."""

    stress_form: str
    here: Make
    there: Make
    precision: torch.dtype
    """Fastest version of its algorithm."""
    checkpoints: bool
    """Whether its users surround every step with checkpoints of torch."""
    gradients: bool = True
    """Whether its algorithm has checkpoints."""
    with_warp: bool = False
    """Whether its algorithm runs on Warp."""

    def scripts(self) -> dict[str, Make]:
        there = {"its algorithm": self.there} if has_warp() or not self.with_warp else {}
        return {"its script on torch_mpm.compat": self.here, **there}


PROJECTS = {
    "MPM-PyTorch": Project("gradient", mpm_pytorch_here, mpm_pytorch_there, torch.float64, True),
    "NCLaw": Project("mls", nclaw_here, nclaw_there, torch.float32, False, with_warp=True),
    "PhysGaussian": Project(
        "gradient", physgaussian_here, physgaussian_there, torch.float32, False, gradients=False, with_warp=True
    ),
}
