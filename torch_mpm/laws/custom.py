"""A user's own laws, in ordinary torch code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..errors import check_number, shape_of
from ..ops.svd import svd3
from .material import Material

if TYPE_CHECKING:
    from ..state import State

__all__ = ["CustomLaw", "CustomPrincipalLaw"]


class CustomLaw(Material):
    """A law from any module or function: F [P, D, D] -> Kirchhoff stress [P, D, D] [Pa], in ordinary torch code.

    Args:
        function: called with the state field. It may return a pair (F, stress) instead, with F what a plastic law makes
            of its argument.
        state_field: "F", or "J" [P] for a law of the volume ratio alone.
        stiffness: see `Material.stiffness`; a number, a tensor [P] or a function of the state. None takes it from the
            function by automatic differentiation, each time that `stable_dt` asks.

    A law that needs more than this (other fields, history) is a subclass of `Material`.

    Raises:
        TypeError: for what is no function.
        ValueError: for an unknown field, a number as stiffness that is negative or not finite, or in use for a result
            of another shape.
    """

    def __init__(
        self,
        function: Callable[[Tensor], Any],
        state_field: str = "F",
        stiffness: float | Tensor | Callable[[State], Tensor] | None = None,
    ) -> None:
        super().__init__()
        if state_field not in ("F", "J"):
            raise ValueError(f"state_field must be 'F' or 'J', got {state_field!r}")
        self.function = check_function(function)
        self.state_fields = (state_field,)
        self._stiffness = check_stiffness(stiffness)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        (field,) = self.state_fields
        deformation = getattr(state, field)
        result = self.function(deformation)
        new, stress = result if isinstance(result, tuple) else (deformation, result)
        P, D = state.x.shape
        for name, value, shape in ((field, new, tuple(deformation.shape)), ("stress", stress, (P, D, D))):
            if not isinstance(value, Tensor) or tuple(value.shape) != shape:
                raise ValueError(f"the law must return {name} of shape {list(shape)}, got {shape_of(value)}")
        return {} if new is deformation else {field: new}, stress

    def stiffness(self, state: State) -> Tensor:
        return given_stiffness(self._stiffness, state) if self._stiffness is not None else super().stiffness(state)

    def invalid(self, state: State) -> Tensor:
        (field,) = self.state_fields
        deformation: Tensor = getattr(state, field)
        J = deformation if field == "J" else torch.linalg.det(deformation.where(deformation.isfinite(), torch.nan))
        return ~((J > 0) & J.isfinite())


def as_law(name: str, law: Any) -> Material:
    """A material as it is; a function or module F [P, D, D] -> Kirchhoff stress as a `CustomLaw`.

    Raises:
        TypeError: for anything else.
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
    """The function of a custom law."""
    if not callable(function):
        raise TypeError(f"function must be a function or module, got {shape_of(function)}")
    return function


def check_stiffness(value: Any) -> Any:
    """A stiffness that is given to a custom law."""
    if value is not None and not isinstance(value, Tensor) and not callable(value):
        return float(check_number("stiffness", value, "finite and not negative", lambda v: 0 <= v < math.inf))
    return value


def given_stiffness(value: Any, state: State) -> Tensor:
    """[P]"""
    value = value(state) if callable(value) else value
    return torch.as_tensor(value, dtype=state.x.dtype, device=state.x.device).expand(state.x.shape[0])


class CustomPrincipalLaw(Material):
    """A law from any module or function of the principal stretches, in ordinary torch code.

    Args:
        function: called with the stretches σ [P, D], in no order that matters: it must treat them alike. Returns the
            principal Kirchhoff stresses [P, D] [Pa], or a pair (stretches, stresses) where a plastic law changes σ.
        stiffness: see `Material.stiffness`; a number, a tensor [P] or a function of the state. None takes it from the
            function by automatic differentiation, each time that `stable_dt` asks.

    The gradient with respect to F holds at equal stretches: differences of the function over a gap of at least the cube
    root of the rounding error stand for its derivative there (relative error about 1e-10 in float64, 1e-5 in float32).
    Particles with det F ≤ 0 or F not finite have no stress, and the function sees them at rest.

    Raises:
        TypeError: for what is no function.
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
        with torch.no_grad():
            U, _, V = svd3(F)
        sigma = svd3(F).sigma
        mapped, tau = self._evaluate(sigma)
        new, stress = _IsotropicFunction.apply(F, U, sigma.detach(), V, mapped, tau, self._evaluate)
        stress = stress.where(good, torch.zeros((), dtype=stress.dtype, device=stress.device))
        return {} if mapped is sigma else {"F": new.where(good, state.F)}, stress

    def stiffness(self, state: State) -> Tensor:
        return given_stiffness(self._stiffness, state) if self._stiffness is not None else super().stiffness(state)

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        J = torch.linalg.det(state.F.where(state.F.isfinite(), torch.nan))
        return ~((J > 0) & J.isfinite())

    def _evaluate(self, sigma: Tensor) -> tuple[Tensor, Tensor]:
        result = self.function(sigma)
        mapped, tau = result if isinstance(result, tuple) else (sigma, result)
        for name, value in (("stretches", mapped), ("stresses", tau)):
            if not isinstance(value, Tensor) or value.shape != sigma.shape:
                raise ValueError(f"the law must return {name} of shape {list(sigma.shape)}, got {shape_of(value)}")
        return mapped, tau


class _IsotropicFunction(torch.autograd.Function):
    """U diag(mapped) Vᵀ and U diag(tau) Uᵀ for F = U diag(sigma) Vᵀ.

    Its gradient of F is that of turning the principal axes; mapped and tau bring their own.
    """

    @staticmethod
    def forward(
        F: Tensor, U: Tensor, sigma: Tensor, V: Tensor, mapped: Tensor, tau: Tensor, evaluate: Any
    ) -> tuple[Tensor, Tensor]:
        return (U * mapped[:, None, :]) @ V.mT, (U * tau[:, None, :]) @ U.mT

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        *tensors, ctx.evaluate = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, grad_F: Tensor, grad_stress: Tensor) -> Any:
        F, U, sigma, V, mapped, tau = ctx.saved_tensors
        M, N = (_DifferentiatedOnce.apply(t, F) for t in (U.mT @ grad_F @ V, U.mT @ grad_stress @ U))
        turned = None
        if ctx.needs_input_grad[0]:
            principal = torch.zeros_like(M)
            for i in range(sigma.shape[1]):
                for j in range(i + 1, sigma.shape[1]):
                    with torch.no_grad():
                        map_slope, stress_slope = _quotients(ctx.evaluate, sigma, mapped, tau, i, j)
                    total = sigma[:, i] + sigma[:, j]
                    even = map_slope * (M[:, i, j] + M[:, j, i]) / 2
                    odd = (mapped[:, i] + mapped[:, j]) / total * (M[:, i, j] - M[:, j, i]) / 2
                    stress = (N[:, i, j] + N[:, j, i]) * stress_slope / total
                    principal[:, i, j] = even + odd + stress * sigma[:, j]
                    principal[:, j, i] = even - odd + stress * sigma[:, i]
            turned = _DifferentiatedOnce.apply(U @ principal @ V.mT, mapped, tau)
        diagonals = (t.diagonal(dim1=1, dim2=2) for t in (M, N))
        return turned, None, None, None, *diagonals, None


class _DifferentiatedOnce(torch.autograd.Function):
    """A gradient that depends on other tensors in a way that autograd does not see."""

    @staticmethod
    def forward(gradient: Tensor, *others: Tensor) -> Tensor:
        return gradient.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        raise NotImplementedError("CustomPrincipalLaw has no second derivatives: differentiate it once")


def _quotients(
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]], sigma: Tensor, mapped: Tensor, tau: Tensor, i: int, j: int
) -> tuple[Tensor, Tensor]:
    """Differences of mapped stretches and stresses i and j over that of the stretches, which is widened where small."""
    middle = (sigma[:, i] + sigma[:, j]) / 2
    least = torch.finfo(sigma.dtype).eps ** (1 / 3) * middle
    near = (sigma[:, i] - sigma[:, j]).abs() < least
    spread = sigma.clone()
    spread[:, i] = torch.where(near, middle + least / 2, sigma[:, i])
    spread[:, j] = torch.where(near, middle - least / 2, sigma[:, j])
    gap = spread[:, i] - spread[:, j]
    wide = evaluate(spread)
    return tuple(  # type: ignore[return-value]
        torch.where(near, w[:, i] - w[:, j], v[:, i] - v[:, j]) / gap for w, v in zip(wide, (mapped, tau), strict=True)
    )
