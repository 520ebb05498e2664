"""Survey of particles between two steps of a run, in one pass: Python wrapper and fake kernel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from .arguments import refuse_vmap, sizes, soa_empty
from .autograd import dispatch, register_autograd
from .contact import obstacle_arguments, time_arguments

if TYPE_CHECKING:
    from ..boundaries import Obstacle
    from ..grid.grid import Grid
    from ..state.state import State


class Survey(NamedTuple):
    """Results per scene, float64 [B] on the device of the particles; zero for a scene without particles."""

    rate: Tensor
    """Largest 1/dt of the limits of `torch_mpm.cfl` [1/s]; infinite for a particle without mass."""
    speed: Tensor
    """Largest speed [m/s]."""
    wrong: Tensor
    """Number of particles that are not finite, outside the domain, or whose energy, where given, is not finite."""


def survey(
    grid: Grid,
    state: State,
    stress: Tensor,
    stiffness: Tensor,
    bound: float,
    kept: float,
    volumetric: bool = False,
    viscosity: Tensor | None = None,
    energy: Tensor | None = None,
    speed: Tensor | None = None,
    obstacles: Sequence[Obstacle] = (),
    reach: float = 0.0,
) -> Survey:
    """Limits of the time step, speed and validity of each scene, without synchronising; not differentiable.

    Args:
        grid: the lattice.
        state: the particles; a particle of an invalid scene counts in the nearest valid one.
        stress: Kirchhoff stress [P, D, D] [Pa].
        stiffness: tangent modulus [P] [Pa].
        bound: Λ/dx² of |∇v|² ≤ (Λ/dx²) |v|² [1/m²].
        kept: 1 + s, where one particle round trip retains the fraction s of a mode.
        volumetric: whether the deformation is the volume ratio only.
        viscosity: [P] [Pa s], or None.
        energy: energy density [P] [J/m³], or None; not finite for meaningless states.
        speed: speed of moving boundaries near each particle [P] [m/s], or None.
        obstacles: at most `MAX_OBSTACLES` for which `fusible` holds; their speed within `reach` [m] counts too.

    Raises:
        RuntimeError: for wrong shapes, dtypes or devices.
    """
    result = dispatch(
        torch.ops.torch_mpm.survey,
        *(state.x, state.v, state.mass, state.volume, state.C, stress, stiffness, viscosity, energy, speed),
        *(state.scene, bound, kept, volumetric, reach, grid.upper, grid.scenes),
        *obstacle_arguments(obstacles, state.x, grid.scenes),
        *time_arguments(state.time, state.x, grid.scenes),
        *grid.packed,
    )
    return Survey(*result.unbind(1))


def law_figures(
    state: State,
    names: str,
    options: Sequence[int],
    parameters: Sequence[Tensor],
    history: Sequence[Tensor],
    variables: Sequence[int],
    material: Tensor | None,
    energy: bool,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Values of compiled laws for a survey, all in one call; not differentiable.

    Args:
        state: the particles, with the fields that the laws read.
        names, options, parameters, history, variables, material: `torch_mpm.laws.calls.LawCalls`. Particles of unknown
            materials have zeros.
        energy: whether to return the energy of the state after the return map.

    Returns:
        Kirchhoff stress [P, D, D], stiffness [P], energy density [P] or None [Pa].

    Raises:
        RuntimeError: for an unknown law, wrong shapes, dtypes or devices.
    """
    fields = state.x, state.C, state.F, state.J, history, state.scene, material
    stress, stiffness, density = dispatch(
        torch.ops.torch_mpm.law_figures, *fields, names, options, parameters, variables, energy
    )
    return stress, stiffness, density if energy else None


@torch.library.register_fake("torch_mpm::law_figures")
def _law_figures_fake(x: Tensor, *arguments: Any) -> tuple[Tensor, Tensor, Tensor | None]:
    P, D = sizes(x, "x", 2)
    energy = soa_empty(x, (P,)) if arguments[-1] else None
    return soa_empty(x, (P, D, D)), soa_empty(x, (P,)), energy


@torch.library.register_fake("torch_mpm::survey")
def _fake(x: Tensor, *arguments) -> Tensor:
    scenes = arguments[15]
    return x.new_empty((scenes, 3), dtype=torch.float64)


def _no_backward(ctx: Any, *grads: Tensor) -> None:
    raise NotImplementedError("results of a survey are not differentiable: call it under torch.no_grad()")


for _name in ("survey", "law_figures"):
    register_autograd(_name, _no_backward)
    refuse_vmap(_name)
