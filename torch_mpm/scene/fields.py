"""Fields of a state by their names in trajectories and data sets."""

from __future__ import annotations

import difflib

import torch
from torch import Tensor

from ..data.stress import MEASURES
from ..laws.thermal import LIQUID
from ..state.state import State
from ..step.step import Step

RANKS = {
    **{"F": 2, "C": 2, "J": 0, "stress": 2, "cauchy_stress": 2, "kirchhoff_stress": 2, "out_of_plane_stress": 0},
    **{"von_mises_stress": 0, "pressure": 0, "temperature": 0, "liquid": 0},
}
"""Number of axes of a field beside that of the particles, each of length D."""
NAMES = ("position", "velocity", *RANKS)
"""Names of fields."""


def field(step: Step, state: State, name: str, kirchhoff: Tensor | None = None) -> Tensor | None:
    """A field [P, ...] of a prepared state; None where the scene has none.

    Args:
        step: step with the law and the reference temperature.
        state: result of `step.prepare`.
        name: "position" [m], "velocity" [m/s], "F", "C" [1/s], "J", "temperature" [K], "liquid", or a stress [Pa]:
            "cauchy_stress" σ = τ/J or its other name "stress", "kirchhoff_stress" τ, and of Cauchy's stress
            "out_of_plane_stress" σ_zz (2-D, plane strain), "von_mises_stress" and "pressure" −tr σ/3 with three normal
            components in 2-D too.
        kirchhoff: result of `step.law.stress`, if known.

    Raises:
        ValueError: for an unknown field, with the nearest known one; for "out_of_plane_stress" in 3-D.
        NotImplementedError: for a law without an out-of-plane stress, where it is needed.
    """
    if name not in NAMES:
        raise ValueError(f"name of a field must be one of {', '.join(NAMES)}, got {name!r}{_nearest(name)}")
    if name in MEASURES:
        return stress_field(step, with_C(state), name, kirchhoff)
    if name == "liquid":
        return state.extra.get(LIQUID)
    if name == "temperature" and state.temperature is not None and step.heat is not None:
        return state.temperature + step.heat.reference
    value: Tensor | None = getattr(state, {"position": "x", "velocity": "v"}.get(name, name))
    return with_C(state).C if value is None and name == "C" else value


def _nearest(name: object) -> str:
    near = difflib.get_close_matches(str(name), NAMES, 1)
    return f": did you mean {near[0]!r}?" if near else ""


def stress_field(step: Step, state: State, name: str, kirchhoff: Tensor | None = None) -> Tensor:
    """A stress [Pa] by its name; arguments and errors as for `field`."""
    law, dim = step.law, state.x.shape[1]
    if name == "out_of_plane_stress" and dim == 3:
        raise ValueError("out_of_plane_stress is for 2-D: in 3-D the stress tensor has all components")
    if kirchhoff is None and name != "out_of_plane_stress":
        kirchhoff = law.stress(state)
    if name == "kirchhoff_stress":
        assert kirchhoff is not None
        return kirchhoff
    J = law.volume_ratio(state)
    J = torch.where(J > 0, J, 1)  # Inverted particles have no stress.
    if name in ("stress", "cauchy_stress"):
        assert kirchhoff is not None
        return kirchhoff / J[:, None, None]
    normal = [law.out_of_plane_stress(state) / J] if dim == 2 else []
    if name == "out_of_plane_stress":
        return normal[0]
    assert kirchhoff is not None
    cauchy = kirchhoff / J[:, None, None]
    normals = torch.stack([*cauchy.diagonal(dim1=1, dim2=2).unbind(1), *normal])
    pressure = -normals.mean(0)
    if name == "pressure":
        return pressure
    shear = cauchy + cauchy.mT
    upper = torch.triu(shear, 1).square().sum((1, 2)) / 4
    return (1.5 * (normals + pressure).square().sum(0) + 3 * upper).sqrt()


def with_C(state: State) -> State:
    """A viscous stress reads C, which is absent before the first step and without APIC."""
    return state if state.C is not None else state.replace(C=state.x.new_zeros(*state.x.shape, state.x.shape[1]))
