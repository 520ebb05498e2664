"""Steps with an external stress, for simulators that are called with it."""

from __future__ import annotations

import torch
from torch import Tensor

from ..errors import check_like
from ..laws import Material
from ..ops.precision import from_half
from ..state.state import State
from ..step.step import Step


class GivenStress(Material):
    """Law that returns the stress that was set last."""

    def __init__(self) -> None:
        super().__init__()
        self.given: Tensor | None = None

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert self.given is not None
        return {}, self.given

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        return ~state.F.isfinite().all((1, 2))


def stepped(
    step: Step, x: Tensor, v: Tensor, C: Tensor, F: Tensor, stress: Tensor, mass: Tensor, volume: Tensor, time: float,
    dt: float,
) -> State:  # fmt: skip
    """State after a step of a `GivenStress`.

    Raises:
        TypeError, ValueError: for wrong shapes, dtypes or devices.
    """
    law = step.law
    assert isinstance(law, GivenStress)
    stress = from_half(stress, x)
    check_like("stress", stress, x, (len(x), 3, 3), "[P, 3, 3]")
    state = State(x=x, v=v, mass=mass.to(x), volume=volume.to(x), C=C, F=F, time=time)
    law.given = stress
    try:
        return step(state, dt)
    finally:
        law.given = None


def clamped(x: Tensor, lower: float | Tensor, upper: float | Tensor) -> Tensor:
    """Positions between two bounds, numbers or [P, 1]."""
    return torch.minimum(torch.maximum(x, x.new_zeros(()) + lower), x.new_zeros(()) + upper)
