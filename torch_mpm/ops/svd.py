"""Singular value and polar decompositions of batches of 2x2 and 3x3 matrices."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..errors import FLOATING, shape_of
from .arguments import refuse_vmap, sizes, soa_empty
from .autograd import dispatch, register_autograd


class SVD(NamedTuple):
    """F = U diag(sigma) Vᵀ."""

    U: Tensor
    sigma: Tensor
    V: Tensor


class Polar(NamedTuple):
    """F = R S."""

    R: Tensor
    S: Tensor


def svd3(F: Tensor) -> SVD:
    """Singular value decomposition F = U diag(σ) Vᵀ with rotations U and V (one-sided Jacobi; Hestenes 1958).

    Args:
        F: [..., 3, 3] or [..., 2, 2], float32 or float64.

    Returns:
        U [..., D, D], sigma [..., D], V [..., D, D]. det U = det V = 1, so that the last singular value has the sign of
        det F; |sigma| descends, up to rounding between equal values. A matrix with a NaN or an infinity gives NaN.

    Differentiable, also twice. The gradient of sigma always exists. Those of U and V are divided by the gap of two |σ|,
    and their rounding error with them (relative to the rest about eps |F|/gap): where two |σ| are equal up to rounding
    they are finite but wrong, where they are equal NaN or infinite, because singular vectors are not continuous there.
    Use `polar` for the rotation, functions of F itself, or `CustomPrincipalLaw` for a law of the stretches; the
    gradients of the other laws are correct there too.

    Raises:
        ValueError, TypeError: for a wrong shape or dtype.
    """
    _check(F)
    flat = F.reshape(-1, *F.shape[-2:])
    U, sigma, V = dispatch(torch.ops.torch_mpm.svd3, flat)
    return SVD(U.reshape(F.shape), sigma.reshape(F.shape[:-1]), V.reshape(F.shape))


def polar(F: Tensor) -> Polar:
    """Polar decomposition F = R S with a rotation R and a symmetric S.

    Args:
        F: [..., 3, 3] or [..., 2, 2], float32 or float64.

    Returns:
        R, S [..., D, D]. S is positive semidefinite where det F ≥ 0; otherwise its eigenvalue of least magnitude is
        negative. A matrix with a NaN or an infinity gives NaN.

    Differentiable, also twice. The gradient is infinite or NaN only where R is not unique: where two signed singular
    values add up to zero.

    Raises:
        ValueError, TypeError: for a wrong shape or dtype.
    """
    _check(F)
    R, S = dispatch(torch.ops.torch_mpm.polar, F.reshape(-1, *F.shape[-2:]))
    return Polar(R.reshape(F.shape), S.reshape(F.shape))


def _check(F: Tensor) -> None:
    if not isinstance(F, Tensor) or F.shape[-2:] not in ((2, 2), (3, 3)):
        raise ValueError(f"F must have shape [..., 3, 3] or [..., 2, 2], got {shape_of(F)}")
    if F.dtype not in FLOATING:
        raise TypeError(f"F must be float32 or float64, got {F.dtype}")


# ---- fake kernels


@torch.library.register_fake("torch_mpm::svd3")
def _svd3_fake(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    shape = sizes(F, "F", 3)
    return soa_empty(F, shape), soa_empty(F, shape[:2]), soa_empty(F, shape)


@torch.library.register_fake("torch_mpm::polar")
def _polar_fake(F: Tensor) -> tuple[Tensor, Tensor]:
    shape = sizes(F, "F", 3)
    return soa_empty(F, shape), soa_empty(F, shape)


# ---- autograd: in plain torch on the results, so that it is differentiable again


def _keep_output(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs, *output)


def _skew(a: Tensor) -> Tensor:
    return a - a.mT


def _svd3_backward(ctx: Any, grad_U: Tensor | None, grad_sigma: Tensor | None, grad_V: Tensor | None) -> Tensor | None:
    # With M = Uᵀ dF V: dσ = diag M, Uᵀ dU = E ∘ (M Σ + Σ Mᵀ), Vᵀ dV = E ∘ (Σ M + Mᵀ Σ), E_ij = 1/(σ_j² − σ_i²).
    _, U, sigma, V = ctx.saved_tensors
    row, column = sigma[:, :, None], sigma[:, None, :]
    off_diagonal = 1 - torch.eye(sigma.shape[1], dtype=sigma.dtype, device=sigma.device)
    E = off_diagonal / ((column - row) * (column + row) + (1 - off_diagonal))
    M = sigma.new_zeros(()) if grad_sigma is None else torch.diag_embed(grad_sigma)
    if grad_U is not None:
        M = M + E * _skew(U.mT @ grad_U) * column
    if grad_V is not None:
        M = M + row * E * _skew(V.mT @ grad_V)
    return U @ M @ V.mT if M.dim() else None


def _polar_backward(ctx: Any, grad_R: Tensor | None, grad_S: Tensor | None) -> Tensor | None:
    # dR = R Ω with the skew Ω of Ω S + S Ω = Rᵀ dF − dFᵀ R, and dS = Rᵀ dF − Ω S. With X the skew part of the
    # factor of Ω, the adjoint is 2 R Y with Y S + S Y = X.
    _, R, S = ctx.saved_tensors
    if grad_R is None and grad_S is None:
        return None
    X = torch.zeros_like(S) if grad_R is None else _skew(R.mT @ grad_R) / 2
    if grad_S is None:
        return 2 * R @ _solve_skew(S, X)
    symmetric = (grad_S + grad_S.mT) / 2
    return R @ (symmetric + 2 * _solve_skew(S, X - _skew(symmetric @ S) / 2))


def _solve_skew(S: Tensor, X: Tensor) -> Tensor:
    """The skew Y [P, D, D] of Y S + S Y = X for symmetric S and skew X."""
    trace = S.diagonal(dim1=1, dim2=2).sum(1)
    if S.shape[1] == 2:
        return X / trace[:, None, None]
    # In terms of axial vectors, (tr S I − S) y = x.
    x = torch.stack([X[:, 2, 1], X[:, 0, 2], X[:, 1, 0]], 1)
    A = torch.eye(3, dtype=S.dtype, device=S.device) - S / trace[:, None, None]
    cofactors = torch.stack([torch.linalg.cross(A[:, i - 2], A[:, i - 1]) for i in range(3)], 1)
    y = (cofactors @ x[:, :, None])[:, :, 0] / ((A[:, 0] * cofactors[:, 0]).sum(1) * trace)[:, None]
    zero = torch.zeros_like(trace)
    rows = ((zero, -y[:, 2], y[:, 1]), (y[:, 2], zero, -y[:, 0]), (-y[:, 1], y[:, 0], zero))
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


for _name, _backward in (("svd3", _svd3_backward), ("polar", _polar_backward)):
    register_autograd(_name, _backward, _keep_output)
    refuse_vmap(_name)
