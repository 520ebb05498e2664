"""Functions of a user in the lists of MPM-PyTorch's solver, which read and write its dense grid, or x and v."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from torch import Tensor, nn

from ...grid.grid import Blocks
from ...state.state import State
from ...step.particle_operations import Timed

if TYPE_CHECKING:
    from .mpm_solver import MPMSolver

PADDING = 3
"""Nodes of the lattice before the origin."""


def parameters_of(function: Any) -> int:
    """Number of arguments without default of a plain function; 0 of a module or an object with `apply`."""
    if isinstance(function, nn.Module) or hasattr(function, "apply") or not callable(function):
        return 0
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    parameters = inspect.signature(function).parameters.values()
    return sum(p.kind in kinds and p.default is p.empty for p in parameters)


def writes_grid(function: Any) -> bool:
    """Whether an entry of `post_grid_process` is a function of the solver alone."""
    return parameters_of(function) == 1


def writes_particles(function: Any) -> bool:
    """Whether an entry of `pre_particle_process` is a function (solver, x, v)."""
    return parameters_of(function) == 3


class Written(Timed):
    """A function (solver, x, v) that writes to x and v; x moves at the end of the step, as in MPM-PyTorch."""

    def __init__(self, solver: MPMSolver, function: Any) -> None:
        super().__init__()
        self.solver, self.function = solver, function

    def forward(self, state: State, dt: float | Tensor) -> State:
        before = self.solver.displacement
        start = state.x if before is None else state.x + before
        x, v = start.clone(), state.v.clone()
        self.function(self.solver, x, v)
        self.solver.displacement = x - state.x
        return state.replace(v=v)


def dense(blocks: Blocks, nodes: Tensor, n: int) -> Tensor:
    """Values of nodes [N, C] as rows [n³, C] of the cube of n nodes along each axis from the origin."""
    part = slice(PADDING, PADDING + n)
    return blocks.to_dense(nodes)[0, part, part, part].reshape(n**3, -1)


def replaced(blocks: Blocks, nodes: Tensor, rows: Tensor, n: int) -> Tensor:
    """Values of nodes [N, C] with those of rows [n³, C] in place of theirs in the cube."""
    part = slice(PADDING, PADDING + n)
    whole = blocks.to_dense(nodes).clone()
    whole[0, part, part, part] = rows.reshape(n, n, n, -1)
    return blocks.from_dense(whole)
