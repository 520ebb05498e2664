"""Fields of a state by the names that trajectories and data sets give them."""

from __future__ import annotations

from torch import Tensor

from ..laws.thermal import LIQUID
from ..state import State
from ..step import Step

RANKS = {"F": 2, "C": 2, "stress": 2, "J": 0, "temperature": 0, "liquid": 0}
"""Axes of a field beside that of the particles, each of length D."""


def field(step: Step, state: State, name: str) -> Tensor | None:
    """A field [P, ...] of a prepared state; None where the scene has none.

    Args:
        step: whose law and whose reference temperature count.
        state: what `step.prepare` gives.
        name: "position" [m], "velocity" [m/s], "F", "C" [1/s], "stress" (Kirchhoff) [Pa], "J", "temperature" [K] or
            "liquid".
    """
    if name == "stress":
        return step.law.stress(with_C(state))
    if name == "liquid":
        return state.extra.get(LIQUID)
    if name == "temperature" and state.temperature is not None and step.heat is not None:
        return state.temperature + step.heat.reference
    value: Tensor | None = getattr(state, {"position": "x", "velocity": "v"}.get(name, name))
    return with_C(state).C if value is None and name == "C" else value


def with_C(state: State) -> State:
    """A viscous stress reads C, which is absent before the first step and without APIC."""
    return state if state.C is not None else state.replace(C=state.x.new_zeros(*state.x.shape, state.x.shape[1]))
