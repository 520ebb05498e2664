"""Singular value and polar decompositions against torch.linalg, closed forms and finite differences."""

import pytest
import torch
from cases.matrices import rotations
from oracle import svd as reference
from torch import Tensor

import torch_mpm as mpm

DTYPES = [torch.float32, torch.float64]


def with_singular_values(sigma: Tensor) -> Tensor:
    count, dim = sigma.shape
    return rotations(count, dim) * sigma[:, None, :] @ rotations(count, dim).mT


def check_decomposition(F: Tensor, tolerance: float) -> None:
    """U and V are rotations, σ descends with the sign last, and their product is F, relative to the largest σ."""
    U, sigma, V = (t.double() for t in mpm.svd3(F))
    eye = torch.eye(F.shape[-1], dtype=torch.float64, device=F.device)
    for Q in (U, V):
        assert (Q @ Q.mT - eye).abs().max() <= tolerance
        assert (torch.linalg.det(Q) - 1).abs().max() <= tolerance
    largest = sigma[:, :1]
    assert (sigma[:, :-1] >= 0).all()
    assert (sigma[:, :-1] - sigma[:, 1:].abs() >= -tolerance * largest).all()
    product = (U * sigma[:, None, :]) @ V.mT
    assert ((product - F.double()).abs() <= tolerance * largest[:, :, None] + 1e-300).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_random_matrices(device, dim, dtype):
    F = torch.randn(5001, dim, dim, dtype=torch.float64).to(device, dtype)
    check_decomposition(F, 8 * torch.finfo(dtype).eps)
    expected = reference.svd3(F.double().cpu())[1].to(device)  # LAPACK; the decompositions of GPUs are less accurate
    assert ((mpm.svd3(F).sigma.double() - expected).abs() <= 8 * torch.finfo(dtype).eps * expected[:, :1]).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("condition", [1e1, 1e4, 1e8, 1e12])
@pytest.mark.parametrize("small", [1, 2])
def test_ill_conditioned(device, dtype, condition, small):
    spread = torch.rand(4000, 3, dtype=torch.float64) + 0.5
    spread[:, 3 - small :] /= condition
    F = with_singular_values(spread).to(device, dtype)
    check_decomposition(F, 8 * torch.finfo(dtype).eps)
    expected = torch.linalg.svdvals(F.double().cpu()).to(device)
    error = ((mpm.svd3(F).sigma.double().abs() - expected).abs() / expected[:, :1]).max()
    assert error <= 6 * torch.finfo(dtype).eps


def test_small_singular_values_keep_their_digits(device):
    """Relative error of every singular value at condition 10² and 10⁴, float32: a product FᵀF would lose all digits."""
    for condition, tolerance in ((1e2, 2e-5), (1e4, 2e-3)):
        sigma = torch.rand(4000, 3, dtype=torch.float64) + 0.5
        sigma[:, 2] /= condition
        F = with_singular_values(sigma).float().to(device)
        expected = torch.linalg.svdvals(F.double().cpu()).to(device)
        assert ((mpm.svd3(F).sigma.double().abs() / expected - 1).abs().max()) < tolerance


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [1e-7, 1e-3, 0.1])
def test_near_the_identity(device, dim, dtype, size):
    F = (torch.eye(dim, dtype=torch.float64) + size * torch.randn(4000, dim, dim, dtype=torch.float64)).to(
        device, dtype
    )
    check_decomposition(F, 8 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scale", [1e-44, 1e-38, 1e-30, 1e-20, 1e20, 1e30, 3e37])
def test_scales(device, dim, dtype, scale):
    F = torch.randn(1000, dim, dim, dtype=torch.float64).clamp(-2, 2).to(device, dtype)
    small = scale < 1e-37 and dtype == torch.float32
    scaled = F.double() * scale
    U, sigma, V = (t.double() for t in mpm.svd3(scaled.to(dtype)))
    rounding = 4e-45 if small else 0.0  # of a denormal entry
    tolerance = 8 * torch.finfo(dtype).eps * scale * 6 + 8 * rounding
    assert ((U * sigma[:, None, :]) @ V.mT - scaled).abs().max() <= tolerance


@pytest.mark.parametrize("dtype", DTYPES)
def test_special_matrices(device, dim, dtype):
    eye = torch.eye(dim, dtype=dtype)
    first = torch.zeros(dim, dim, dtype=dtype)
    first[0, 0] = 1
    last = torch.zeros(dim, dim, dtype=dtype)
    last[-1, 0] = -3
    ones = torch.ones(dim, dim, dtype=dtype)
    graded = torch.diag(torch.tensor([1e-25, 1.0, 1e-30][:dim], dtype=dtype))
    cases = torch.stack([0 * eye, eye, -eye, first, last, ones, graded, eye.flip(0), eye - 2 * first, 1e-30 * ones])
    check_decomposition(cases.to(device), 8 * torch.finfo(dtype).eps)
    sigma = mpm.svd3(cases.to(device)).sigma.cpu()
    assert (sigma[0] == 0).all()
    assert torch.equal(sigma[1], torch.ones(dim, dtype=dtype))
    assert (sigma[:, -1] * torch.linalg.det(cases.double()) >= 0).all()
    assert torch.allclose(sigma[6], graded.diagonal().sort(descending=True).values, rtol=1e-6, atol=0)


def test_not_finite_gives_nan(device, dim):
    F = torch.eye(dim).repeat(4, 1, 1)
    F[1, 0, dim - 1] = torch.nan
    F[2, dim - 1, dim - 1] = torch.inf
    F[3, 0, 0] = -torch.inf
    for result in (*mpm.svd3(F.to(device)), *mpm.polar(F.to(device))):
        assert result[0].isfinite().all()
        assert result[1:].isnan().all()


def test_any_strides_shapes_and_sizes(device, dim):
    F = torch.randn(37, dim, dim, device=device)
    expected = mpm.svd3(F)
    soa = F.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    wide = torch.zeros(37, dim, 2 * dim, device=device)[:, :, ::2].copy_(F)
    for other in (soa, wide):
        assert all(torch.equal(a, b) for a, b in zip(mpm.svd3(other), expected, strict=True))
    for count in (0, 1, 5):
        assert torch.equal(mpm.svd3(F[:count]).sigma, expected.sigma[:count])
    nested = mpm.svd3(F[:36].reshape(2, 3, 6, dim, dim))
    assert nested.U.shape == (2, 3, 6, dim, dim)
    assert nested.sigma.shape == (2, 3, 6, dim)
    assert torch.equal(mpm.svd3(F[0]).sigma, expected.sigma[0])


@pytest.mark.parametrize("dtype", DTYPES)
def test_polar(device, dim, dtype):
    F = torch.randn(2000, dim, dim, dtype=torch.float64).to(device, dtype)
    R, S = (t.double() for t in mpm.polar(F))
    tolerance = 16 * torch.finfo(dtype).eps
    eye = torch.eye(dim, dtype=torch.float64, device=device)
    assert (R @ R.mT - eye).abs().max() <= tolerance
    assert (torch.linalg.det(R) - 1).abs().max() <= tolerance
    assert (S - S.mT).abs().max() <= tolerance * 8
    assert (R @ S - F.double()).abs().max() <= tolerance * 8
    right = torch.linalg.det(F.double()) > 0
    assert torch.linalg.eigvalsh(S[right]).min() >= -tolerance * 8


# ---- gradients


def separated(dim: int, device: str) -> Tensor:
    sigma = torch.tensor([[3.0, 1.5, 0.5], [2.0, 1.1, -0.3], [1.0, 0.7, 1e-3]], dtype=torch.float64)[:, 3 - dim :]
    return with_singular_values(sigma).to(device).requires_grad_()


def test_gradients(device, dim):
    F = separated(dim, device)
    assert torch.autograd.gradcheck(lambda F: tuple(mpm.svd3(F)), F)
    assert torch.autograd.gradcheck(lambda F: tuple(mpm.polar(F)), F)


def test_second_derivatives(device):
    F = separated(3, device)[:2].detach().requires_grad_()
    assert torch.autograd.gradgradcheck(lambda F: tuple(mpm.svd3(F)), F)
    assert torch.autograd.gradgradcheck(lambda F: tuple(mpm.polar(F)), F)


def test_gradient_of_singular_values_exists_where_they_are_equal(device, dim):
    """The gradient of the sum of all is that of the trace of S, which is R."""
    F = torch.stack([torch.eye(dim), 2 * rotations(1, dim)[0].float()]).double().to(device).requires_grad_()
    (grad,) = torch.autograd.grad(mpm.svd3(F).sigma.sum(), F)
    assert torch.allclose(grad, mpm.polar(F.detach()).R, atol=1e-14)


def test_gradient_of_polar_at_equal_singular_values(device, dim):
    F = torch.stack([torch.eye(dim, dtype=torch.float64), 3 * rotations(1, dim)[0]]).to(device).requires_grad_()
    assert torch.autograd.gradcheck(lambda F: tuple(mpm.polar(F)), F)
    small = (1e-30 * torch.eye(dim, device=device)[None]).requires_grad_()
    (grad,) = torch.autograd.grad(mpm.polar(small).S.sum(), small)
    assert grad.isfinite().all()


def test_gradients_of_vectors_are_not_finite_where_values_are_equal(device, dim):
    F = torch.eye(dim, dtype=torch.float64, device=device)[None].requires_grad_()
    (grad,) = torch.autograd.grad((mpm.svd3(F).U * torch.randn(1, dim, dim, device=device)).sum(), F)
    assert not grad.isfinite().all()


# ---- registration and errors


@pytest.mark.thorough(dim=3)
def test_opcheck(device, dim):
    F = torch.randn(5, dim, dim, dtype=torch.float64, device=device, requires_grad=True)
    torch.library.opcheck(torch.ops.torch_mpm.svd3.default, (F,))
    torch.library.opcheck(torch.ops.torch_mpm.polar.default, (F,))


def test_errors():
    for function in (mpm.svd3, mpm.polar):
        with pytest.raises(ValueError, match=r"F must have shape \[..., 3, 3\] or \[..., 2, 2\], got \[4, 3\]"):
            function(torch.zeros(4, 3))
        with pytest.raises(TypeError, match="float32 or float64, got torch"):
            function(torch.zeros(4, 3, 3, dtype=torch.int64))
        with pytest.raises(NotImplementedError, match="vmap"):
            torch.vmap(function)(torch.zeros(2, 4, 3, 3))
