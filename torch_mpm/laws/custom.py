"""User laws in ordinary torch code."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..errors import check_count, check_number, shape_of
from ..ops.precision import from_half
from .isotropic import isotropic
from .material import Material

if TYPE_CHECKING:
    from ..state.state import State

__all__ = ["CustomLaw", "CustomPrincipalLaw", "isotropic"]


RESERVED = ("F", "J", "stress", "dissipated")
"""Names of results of a law that are not history."""


class CustomLaw(Material):
    """A law from any module or function: F [P, D, D] -> Kirchhoff stress [P, D, D] [Pa], in ordinary torch code.

    Args:
        function: called with the state field, and the history if there is one. It may return a pair (F, stress)
            instead, with F after the flow of a plastic law; with history a tuple (F, stress, new history ...).
        state_field: "F", or "J" [P] for a law of the volume ratio alone.
        stiffness: see `Material.stiffness`; a number, a tensor [P] or a function of the state. None computes it from
            the function by automatic differentiation, in each call of `stable_dt`.
        history: variables that the law stores in `state.extra`, by name: the shape per particle, with zeros at the
            start, or the initial value, a tensor of that shape. The function is called with each of them [P, ...], in
            this order, after the state field.

    Under `torch.autocast` the function may return a half precision; it is cast to the dtype of the state, with
    gradients, and everything else is computed in that dtype. A law that needs more (other fields, the time step) is a
    subclass of `Material`.

    Raises:
        TypeError: unless `function` is callable.
        ValueError: for an unknown field, a number as stiffness that is negative or not finite, or in use for a result
            of another shape.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        state_field: str = "F",
        stiffness: float | Tensor | Callable[[State], Tensor] | None = None,
        history: Mapping[str, Sequence[int] | Tensor] | None = None,
    ) -> None:
        super().__init__()
        if state_field not in ("F", "J"):
            raise ValueError(f"state_field must be 'F' or 'J', got {state_field!r}")
        self.function = check_function(function)
        self.state_fields = (state_field,)
        self._stiffness = check_stiffness(stiffness)
        self._start = _checked_history(history)
        self.extra_fields = tuple(self._start)

    def initial(self, name: str, state: State) -> Tensor:
        start = self._start[name].to(state.x)
        return start.expand(state.x.shape[0], *start.shape).clone()

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        (field,) = self.state_fields
        deformation = getattr(state, field)
        history = [state.extra[n] if n in state.extra else self.initial(n, state) for n in self.extra_fields]
        result = self.function(deformation, *history)
        expected = 2 + len(history)
        if history and (not isinstance(result, tuple) or len(result) != expected):
            found = f"a tuple of {len(result)}" if isinstance(result, tuple) else shape_of(result)
            raise ValueError(f"the law must return {field}, stress, {', '.join(self.extra_fields)}, got {found}")
        new, stress, *moved = result if isinstance(result, tuple) else (deformation, result)
        P, D = state.x.shape
        fields = {}
        shapes = [(field, new, tuple(deformation.shape)), ("stress", stress, (P, D, D))]
        shapes += [(n, h, tuple(old.shape)) for n, h, old in zip(self.extra_fields, moved, history, strict=True)]
        for name, value, shape in shapes:
            if not isinstance(value, Tensor) or tuple(value.shape) != shape:
                raise ValueError(f"the law must return {name} of shape {list(shape)}, got {shape_of(value)}")
            fields[name] = from_half(value, state.x)
        stress = fields.pop("stress")
        if new is deformation:
            del fields[field]
        return fields, stress

    def stiffness(self, state: State) -> Tensor:
        return given_stiffness(self._stiffness, state) if self._stiffness is not None else super().stiffness(state)

    def invalid(self, state: State) -> Tensor:
        (field,) = self.state_fields
        deformation: Tensor = getattr(state, field)
        J = deformation if field == "J" else torch.linalg.det(deformation.where(deformation.isfinite(), torch.nan))
        return ~((J > 0) & J.isfinite())


def _checked_history(history: Any) -> dict[str, Tensor]:
    """Initial value of each history variable of a particle."""
    if history is None:
        return {}
    if not isinstance(history, Mapping):
        raise TypeError(f"history must be a dict of shapes or tensors by name, got {shape_of(history)}")
    start = {}
    for name, given in history.items():
        if not isinstance(name, str) or name in RESERVED:
            raise ValueError(f"a history variable must have a name of its own, got {name!r}")
        if isinstance(given, Tensor):
            start[name] = given
        elif isinstance(given, (list, tuple)):
            start[name] = torch.zeros([check_count(f"history[{name!r}]", n) for n in given], device="cpu")
        else:
            raise TypeError(f"history[{name!r}] must be a shape or a tensor, got {shape_of(given)}")
    return start


def as_law(name: str, law: Any) -> Material:
    """A material unchanged; a function or module F [P, D, D] -> Kirchhoff stress as a `CustomLaw`.

    Raises:
        TypeError: for other arguments.
    """
    if isinstance(law, Material):
        return law
    if isinstance(law, type) or hasattr(law, "update") or not callable(law):
        found = f"the class {law.__name__}" if isinstance(law, type) else shape_of(law)
        raise TypeError(
            f"{name} must be a material (an instance of torch_mpm.Material), or a function or module from the "
            f"deformation gradient [P, D, D] to the Kirchhoff stress, got {found}"
        )
    return CustomLaw(law)


def check_function(function: Any) -> Any:
    """Function of a custom law."""
    if not callable(function):
        raise TypeError(f"function must be a function or module, got {shape_of(function)}")
    return function


def check_stiffness(value: Any) -> Any:
    """Stiffness that was given to a custom law."""
    if value is not None and not isinstance(value, Tensor) and not callable(value):
        return float(check_number("stiffness", value, "finite and not negative", lambda v: 0 <= v < math.inf))
    return value


def given_stiffness(value: Any, state: State) -> Tensor:
    """Values [P]."""
    value = value(state) if callable(value) else value
    return torch.as_tensor(value, dtype=state.x.dtype, device=state.x.device).expand(state.x.shape[0])


class CustomPrincipalLaw(Material):
    """A law from any module or function of the principal stretches, in ordinary torch code.

    Args:
        function: called with the stretches σ [P, D] in any order: it must be symmetric in them. Returns the principal
            Kirchhoff stresses [P, D] [Pa], or a pair (stretches, stresses) where a plastic law changes σ.
        stiffness: see `Material.stiffness`; a number, a tensor [P] or a function of the state. None computes it from
            the function by automatic differentiation, in each call of `stable_dt`.

    It is `isotropic` of the function, whose gradient with respect to F is correct at equal stretches. Particles with
    det F ≤ 0 or F not finite have no stress; the function receives σ = 1 for them.

    Raises:
        TypeError: unless `function` is callable.
        ValueError: for a number as stiffness that is negative or not finite, or in use for a result of another shape.
    """

    def __init__(
        self,
        function: Callable[[Tensor], Any],
        stiffness: float | Tensor | Callable[[State], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.function = check_function(function)
        self._stiffness = check_stiffness(stiffness)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        if state.F is None:
            raise ValueError("CustomPrincipalLaw needs state.F, which is None")
        good = ~self.invalid(state)[:, None, None]
        F = state.F.where(good, torch.eye(state.x.shape[1], dtype=state.x.dtype, device=state.x.device))
        result = isotropic(F, self.function)
        new, stress = result if isinstance(result, tuple) else (F, result)
        stress = stress.where(good, torch.zeros((), dtype=stress.dtype, device=stress.device))
        return {} if new is F else {"F": new.where(good, state.F)}, stress

    def stiffness(self, state: State) -> Tensor:
        return given_stiffness(self._stiffness, state) if self._stiffness is not None else super().stiffness(state)

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        J = torch.linalg.det(state.F.where(state.F.isfinite(), torch.nan))
        return ~((J > 0) & J.isfinite())
