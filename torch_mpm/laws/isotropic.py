"""Isotropic functions of a deformation gradient by its principal stretches, with gradients at equal stretches too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..errors import shape_of
from ..ops.arguments import no_vmap
from ..ops.precision import from_half, full_precision
from ..ops.svd import svd3


def isotropic(F: Tensor, function: Callable[[Tensor], Any]) -> Any:
    """Tensors U diag(τ) Uᵀ, and U diag(s) Vᵀ, for a function of the principal stretches of F = U diag(σ) Vᵀ.

        stress = torch_mpm.isotropic(F, lambda sigma: 2 * mu * sigma.log() + lam * sigma.log().sum(1, keepdim=True))

    Args:
        F: [P, D, D], float32 or float64.
        function: called with the stretches σ [P, D] in any order: it must be symmetric in them. Returns τ [P, D]; or a
            tuple (s, τ) with s [P, D], the stretches after a return map; or (s, τ, others ...), which are passed on. It
            may be called again in the backward pass. The smallest stretch has the sign of det F.

    Returns:
        U diag(τ) Uᵀ [P, D, D]; where the function returns a tuple, (U diag(s) Vᵀ, U diag(τ) Uᵀ, others ...).

    The gradient with respect to F is correct at equal stretches: differences of the function over a gap of at least the
    cube root of the rounding error approximate its derivative there (relative error about 1e-10 in float64, 1e-5 in
    float32). It is infinite or NaN only where two stretches add up to zero. Differentiable once; the differentiation of
    an energy of the stretches inside the function, as by `torch.func.grad`, does not count.

    Raises:
        TypeError, ValueError: for a wrong argument, or a result of the function of another shape.
    """
    if not callable(function):
        raise TypeError(f"function must be a function or module, got {shape_of(function)}")
    U, sigma, V = svd3(F)
    result = function(sigma)
    mapped, tau = _checked(result, sigma)

    def evaluate(stretches: Tensor) -> tuple[Tensor, Tensor]:
        return _checked(function(stretches), stretches)

    new, stress = _IsotropicFunction.apply(F, U.detach(), sigma.detach(), V.detach(), mapped, tau, evaluate)
    if not isinstance(result, tuple):
        return stress
    return F if mapped is sigma else new, stress, *result[2:]


def _checked(result: Any, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Stretches and stresses [P, D] from the result of a function of stretches."""
    mapped, tau = result[:2] if isinstance(result, tuple) and len(result) > 1 else (sigma, result)
    mapped, tau = from_half(mapped, sigma), from_half(tau, sigma)
    for name, value in (("stretches", mapped), ("stresses", tau)):
        if not isinstance(value, Tensor) or value.shape != sigma.shape:
            raise ValueError(f"the law must return {name} of shape {list(sigma.shape)}, got {shape_of(value)}")
    return mapped, tau


class _IsotropicFunction(torch.autograd.Function):
    """U diag(mapped) Vᵀ and U diag(tau) Uᵀ for F = U diag(sigma) Vᵀ.

    Its gradient by F is that of the rotation of the principal axes; mapped and tau have separate gradients.
    """

    @staticmethod
    def forward(
        F: Tensor, U: Tensor, sigma: Tensor, V: Tensor, mapped: Tensor, tau: Tensor, evaluate: Any
    ) -> tuple[Tensor, Tensor]:
        with full_precision(F):
            return (U * mapped[:, None, :]) @ V.mT, (U * tau[:, None, :]) @ U.mT

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        *tensors, ctx.evaluate = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def vmap(info: Any, in_dims: Any, *arguments: Any) -> Any:
        raise no_vmap("an isotropic function or CustomPrincipalLaw")

    @staticmethod
    def backward(ctx: Any, grad_F: Tensor, grad_stress: Tensor) -> Any:
        with full_precision(grad_F):
            return _IsotropicFunction._adjoint(ctx, grad_F, grad_stress)

    @staticmethod
    def _adjoint(ctx: Any, grad_F: Tensor, grad_stress: Tensor) -> Any:
        F, U, sigma, V, mapped, tau = ctx.saved_tensors
        M, N = (_once(t, F) for t in (U.mT @ grad_F @ V, U.mT @ grad_stress @ U))
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
            turned = _once(U @ principal @ V.mT, mapped, tau)
        diagonals = (t.diagonal(dim1=1, dim2=2) for t in (M, N))
        return turned, None, None, None, *diagonals, None


def _once(gradient: Tensor, *others: Tensor) -> Tensor:
    """A gradient that cannot be differentiated; compiled code has no second derivatives of any function."""
    return gradient if torch.compiler.is_compiling() else _DifferentiatedOnce.apply(gradient, *others)


class _DifferentiatedOnce(torch.autograd.Function):
    """A gradient that depends on other tensors in a way unknown to autograd."""

    @staticmethod
    def forward(gradient: Tensor, *others: Tensor) -> Tensor:
        return gradient.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        raise NotImplementedError(
            "an isotropic function or CustomPrincipalLaw has no second derivatives: differentiate it once, or write "
            "the law with functions of F that have them (polar, FᵀF, det F)"
        )


def _quotients(
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]], sigma: Tensor, mapped: Tensor, tau: Tensor, i: int, j: int
) -> tuple[Tensor, Tensor]:
    """Divided differences of mapped stretches and stresses i and j, over a gap of the stretches that is widened where
    small.
    """
    middle = (sigma[:, i] + sigma[:, j]) / 2
    least = torch.finfo(sigma.dtype).eps ** (1 / 3) * middle.abs()
    near = (sigma[:, i] - sigma[:, j]).abs() < least
    spread = sigma.clone()
    spread[:, i] = torch.where(near, middle + least / 2, sigma[:, i])
    spread[:, j] = torch.where(near, middle - least / 2, sigma[:, j])
    gap = spread[:, i] - spread[:, j]
    wide = evaluate(spread)
    return tuple(  # type: ignore[return-value]
        torch.where(near, w[:, i] - w[:, j], v[:, i] - v[:, j]) / gap for w, v in zip(wide, (mapped, tau), strict=True)
    )
