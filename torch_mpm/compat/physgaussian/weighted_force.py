"""The forces of GaussianFluent's FLIP: those of the stress times the weight of the node."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...grid.bspline import base_node, bspline, bspline_derivative
from ...grid.grid import Blocks
from ...grid.topology import PADDING
from ...laws import Material
from ...step.step import Step

if TYPE_CHECKING:
    from ...state.state import State

QUADRATIC = 2


class _WithoutForce(Material):
    """A law whose stress is kept for `WeightedForceStep`, and zero for the step itself."""

    def __init__(self, law: Material) -> None:
        super().__init__()
        self.law, self.kept = law, torch.zeros(0)
        self.state_fields, self.extra_fields = law.state_fields, law.extra_fields

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        fields, self.kept = self.law(state)
        return fields, torch.zeros_like(self.kept)

    def initial(self, name: str, state: State) -> Tensor:
        return self.law.initial(name, state)

    def check_parameters(self, particles: int, scenes: int | None) -> None:
        self.law.check_parameters(particles, scenes)

    def invalid(self, state: State) -> Tensor:
        return self.law.invalid(state)


class WeightedForceStep(Step):
    """A step with the force −V τ N ∇N of a particle on a node, in torch operations."""

    def __init__(self, grid: Any, law: Material, **options: Any) -> None:
        super().__init__(grid, _WithoutForce(law), **options)

    def update_grid(
        self, blocks: Blocks, nodes: Tensor, state: Any, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        assert isinstance(self.law, _WithoutForce)
        force = weighted_force(blocks, state.x, state.volume, self.law.kept)
        return super().update_grid(blocks, nodes + torch.nn.functional.pad(dt * force, (1, 0)), state, dt)


def weighted_force(blocks: Blocks, x: Tensor, volume: Tensor, stress: Tensor) -> Tensor:
    """−Σ V τ N ∇N on each node [N, 3] [N], for positions [P, 3] [m], volumes [P] [m³] and τ [P, 3, 3] [Pa]."""
    dx = blocks.grid.dx
    cells = x / dx
    base = base_node(cells, QUADRATIC)
    force = x.new_zeros(len(blocks.block) * blocks.grid.nodes_per_block, 3)
    for offset in itertools.product(range(3), repeat=3):
        node = torch.stack([base[:, k] + offset[k] for k in range(3)], 1)
        weight, slope = bspline(cells - node, QUADRATIC), bspline_derivative(cells - node, QUADRATIC) / dx
        w0, w1, w2 = weight.unbind(1)
        gradient = slope * torch.stack([w1 * w2, w0 * w2, w0 * w1], 1)
        rows = blocks.rows_at(node + PADDING, None)
        part = -(volume * weight.prod(1))[:, None] * (stress @ gradient[:, :, None])[:, :, 0]
        force = force.index_add(0, rows.clamp_min(0), torch.where((rows >= 0)[:, None], part, 0))
    return force
