"""Force, torque and impulse of the material on the boundaries of a step and on the walls of the domain.

    state = step.with_impulses(state)             # zero, counted from here on
    end = mpm.rollout(step, state, n=100, dt=1e-4)
    on = step.impulses(end)
    on[paddle].linear                             # [B, D] [N s], by the boundary itself or its place in the list
    on["-y"].about((0.5, 0.2))                    # on the lower face of the axis y, moment about a point [N m s]
    force = (on - step.impulses(state)) / (100 * 1e-4)    # mean forces [N] and torques [N m] of an interval

Impulses are exact: those on boundaries and walls and that of gravity balance the change of the momentum of the
particles, to rounding, in implicit steps to the tolerance of the solve. The same holds for the angular momentum, where
explicit steps and the transfer conserve it. They are computed where the boundaries act, between P2G and G2P; `on_grid`,
which acts later, is not included. Differentiable like any field of the state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..errors import shape_of
from ..ops.impulses import impulse_size, with_moment

if TYPE_CHECKING:
    from ..state.state import State
    from ..step.step import Step

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
"""Names of the faces of the domain, in their order."""


@dataclasses.dataclass(frozen=True, eq=False)
class Impulse:
    """Impulse of the material on one boundary of each scene.

    Attributes:
        linear: [B, D] [N s].
        angular: about the origin [B] (2-D) or [B, 3] [N m s].
    """

    linear: Tensor
    angular: Tensor

    def about(self, point: Sequence[float] | Tensor) -> Tensor:
        """Angular impulse about a point [D] or [B, D] [m]: [B] (2-D) or [B, 3] [N m s]."""
        dim = self.linear.shape[1]
        at = torch.as_tensor(point, dtype=self.linear.dtype).to(self.linear.device, non_blocking=True)
        if tuple(at.shape) not in ((dim,), tuple(self.linear.shape)):
            expected = f"[D] or [B, D] = {list(self.linear.shape)}"
            raise ValueError(f"point must have shape {expected}, got {shape_of(at)}")
        moment = with_moment(at.expand_as(self.linear), self.linear)[:, dim:]
        return self.angular - (moment[:, 0] if dim == 2 else moment)


@dataclasses.dataclass(frozen=True, eq=False)
class Impulses:
    """Impulses on all boundaries of a step and all faces of the domain.

    Attributes:
        values: [B, K + 2 D, D + 1 or 3] [N s, N m s], see `State.impulse`.
        boundaries: the K boundaries of the step.
    """

    values: Tensor
    boundaries: tuple[Any, ...]

    def __getitem__(self, boundary: Any) -> Impulse:
        """Impulse on a boundary of the step, given by itself or its number; or on a face of the domain, given by a name
        of `FACES`.

        Raises:
            KeyError: the step has no such boundary.
        """
        values = self.values[:, self._place(boundary)]
        dim = self._dim
        return Impulse(values[:, :dim], values[:, dim] if dim == 2 else values[:, dim:])

    def __sub__(self, earlier: Impulses) -> Impulses:
        """Impulses since an earlier state."""
        return Impulses(self.values - earlier.values, self.boundaries)

    def __truediv__(self, seconds: float | Tensor) -> Impulses:
        """Mean forces [N] and torques [N m] over a time [s], a number or [B]."""
        over = seconds.reshape(-1, 1, 1) if isinstance(seconds, Tensor) else seconds
        return Impulses(self.values / over, self.boundaries)

    @property
    def total(self) -> Tensor:
        """Sum over all boundaries and faces, linear [B, D] [N s]."""
        return self.values[..., : self._dim].sum(1)

    @property
    def _dim(self) -> int:
        return 2 if self.values.shape[2] == impulse_size(2) else 3

    def _place(self, boundary: Any) -> int:
        count, faces = len(self.boundaries), FACES[: 2 * self._dim]
        if isinstance(boundary, str):
            if boundary in faces:
                return count + faces.index(boundary)
        elif isinstance(boundary, int):
            if -count <= boundary < count:
                return boundary % count
        else:
            for k, known in enumerate(self.boundaries):
                if known is boundary:
                    return k
        raise KeyError(f"{boundary!r} is neither one of the {count} boundaries of the step nor one of {faces}")


def no_impulse(step: Step, x: Tensor) -> Tensor:
    """Impulses of a state at the start of the count."""
    return torch.zeros(_shape(step), dtype=torch.float64, device=x.device)


def check_impulse(step: Step, state: State) -> None:
    impulse, expected = state.impulse, _shape(step)
    if impulse is not None and tuple(impulse.shape) != expected:
        raise ValueError(
            f"state.impulse must have shape {list(expected)} for the {expected[1] - 2 * step.grid.dim} boundaries of "
            f"the step and the faces of the domain, got {shape_of(impulse)}: begin anew with step.with_impulses(state)"
        )


def impulses_of(step: Step, state: State) -> Impulses:
    if state.impulse is None:
        raise ValueError("state.impulse is None: count impulses from step.with_impulses(state) on")
    check_impulse(step, state)
    return Impulses(state.impulse, tuple(step.boundaries.entries))


def _shape(step: Step) -> tuple[int, int, int]:
    dim = step.grid.dim
    return step.grid.scenes, len(step.boundaries) + 2 * dim, impulse_size(dim)
