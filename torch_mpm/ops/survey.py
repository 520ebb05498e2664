"""What a run asks of its particles between two steps, in one pass: Python face and fake kernel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from .arguments import refuse_vmap
from .autograd import register_autograd
from .contact import obstacle_arguments, time_arguments

if TYPE_CHECKING:
    from ..boundaries import Obstacle
    from ..grid import Grid
    from ..state import State


class Survey(NamedTuple):
    """Figures of each scene, float64 [B] on the device of the particles; zero for a scene without particles."""

    rate: Tensor
    """Largest 1/dt of the limits of `torch_mpm.cfl` [1/s]; infinite for a particle without mass."""
    speed: Tensor
    """Largest speed [m/s]."""
    wrong: Tensor
    """Particles that are not finite, outside the domain, or, where their energy is given, that it is not finite."""


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
        state: the particles; one of no scene counts in the scene next to its number.
        stress: Kirchhoff stress [P, D, D] [Pa].
        stiffness: tangent modulus [P] [Pa].
        bound: Λ/dx² of |∇v|² ≤ (Λ/dx²) |v|² [1/m²].
        kept: 1 + s, where one particle round trip keeps the part s of a mode.
        volumetric: whether the volume ratio alone follows the motion.
        viscosity: [P] [Pa s], or None.
        energy: energy density [P] [J/m³], or None; not finite where the law has no meaning.
        speed: of what moves near each particle [P] [m/s], or None.
        obstacles: at most `MAX_OBSTACLES` for which `fusible` holds, whose speed within `reach` [m] counts too.

    Raises:
        RuntimeError: for wrong shapes, dtypes or devices.
    """
    result = torch.ops.torch_mpm.survey(
        *(state.x, state.v, state.mass, state.volume, state.C, stress, stiffness, viscosity, energy, speed),
        *(state.scene, bound, kept, volumetric, reach, grid.upper, grid.scenes),
        *obstacle_arguments(obstacles, state.x, grid.scenes),
        *time_arguments(state.time, state.x, grid.scenes),
        *grid.packed,
    )
    return Survey(*result.unbind(1))


@torch.library.register_fake("torch_mpm::survey")
def _fake(x: Tensor, *arguments) -> Tensor:
    scenes = arguments[15]
    return x.new_empty((scenes, 3), dtype=torch.float64)


def _no_backward(ctx: Any, grad: Tensor) -> None:
    raise NotImplementedError("what a survey finds is not differentiable: take it under torch.no_grad()")


register_autograd("survey", _no_backward)
refuse_vmap("survey")
