"""Static equilibrium: an implicit step without inertia."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from ..errors import check_number

if TYPE_CHECKING:
    from ..state.state import State
    from ..step.step import Step


def equilibrium(step: Step, state: State, dt: float) -> State:
    """State at rest under gravity, walls and obstacles: one implicit step, so long that inertia vanishes.

    The shape functions are those of the given positions, so that the displacements may be any (total Lagrangian on the
    lattice). A body without supports falls as far as it does in dt, and `step.check` of the result reports particles
    outside the grid. A body one particle thick has no bending stiffness, so that the solve of one that is held at one
    end does not converge.

    Args:
        step: a step with `integrator="implicit"`; static loads need a tolerance of 1e-6 or less.
        state: particles; their velocities are ignored.
        dt: [s], at least some hundred periods of the slowest vibration: the ratio of inertia to stiffness is 1/(ω dt)².

    Returns:
        The particles in equilibrium, with velocity zero, at the time of `state`. `step.solve_report` states whether the
        solve converged; `step.check` raises an error if not.

    Raises:
        ValueError: for an explicit step, one with heat or explicit materials, or a dt that is not positive.

    Differentiable as the step is: a stiffness can be found from a sag (examples/beam_stiffness.py).
    """
    if step.integrator is None:
        raise ValueError("equilibrium needs a step with integrator='implicit'")
    if step.integrator.explicit:
        raise ValueError(f"equilibrium needs a step without explicit materials, got {list(step.integrator.explicit)}")
    if step.heat is not None:
        raise ValueError("equilibrium needs a step without heat, which would be conducted for dt: set step.heat = None")
    check_number("dt", dt, "a positive number of seconds", lambda v: v > 0)
    nothing = torch.zeros_like(state.v)
    rest = step(state.replace(v=nothing, C=None), dt)
    return rest.replace(v=nothing, C=None if rest.C is None else torch.zeros_like(rest.C), time=state.time)
