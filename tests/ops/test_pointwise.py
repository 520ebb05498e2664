"""Functions of a row: their values and derivatives against plain torch, in all forms of their arguments."""

import math

import pytest
import torch
from oracle import pointwise as reference

from torch_mpm.ops.pointwise import FUNCTIONS, pointwise, row_shape

NAMES = sorted(FUNCTIONS)
ROWS = 37


def arguments(function, dim, device, dtype=torch.float64, rows=ROWS, seed=0):
    """Positive numbers, of matrices near the identity, on both sides of every switch of the functions."""
    random = torch.Generator().manual_seed(seed)
    made = []
    for shape in FUNCTIONS[function].arguments:
        value = 0.1 + 1.2 * torch.rand(row_shape(shape, rows, dim), generator=random, dtype=torch.float64)
        if shape == (-1, -1):
            value = 0.4 * (value - 0.7) + torch.eye(dim, dtype=torch.float64)
        made.append(value.to(device, dtype))
    return made


def expected(function, dim, given):
    extra = (dim,) if function == "surface_normals" else ()
    return getattr(reference, function)(*given, *extra)


def test_every_function_has_a_reference():
    assert all(hasattr(reference, name) for name in FUNCTIONS)


@pytest.mark.parametrize("dtype,bound", [(torch.float64, 1e-13), (torch.float32, 3e-6)])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("function", NAMES)
def test_values(function, dim, dtype, bound, device):
    given = arguments(function, dim, device, dtype)
    found = pointwise(function, dim, *given)
    wanted = expected(function, dim, [a.double() for a in given])
    assert len(found) == len(wanted)
    for a, b in zip(found, wanted, strict=True):
        assert a.shape == b.shape and a.dtype == dtype
        assert float((a.double() - b).abs().max()) <= bound * max(float(b.abs().max()), 1)


@pytest.mark.parametrize("function", NAMES)
def test_numbers_stand_for_all_rows(function, device):
    """A scalar as a number, as a tensor [] and as [1] is that of each row; a matrix that many times the identity."""
    given = arguments(function, 3, device)
    shapes = FUNCTIONS[function].arguments
    if len(given) < 2:
        pytest.skip("its only argument has rows")
    for k, shape in enumerate(shapes):
        if k == 0:
            continue  # which keeps the rows
        eye = torch.eye(3, dtype=torch.float64, device=device)
        spread = 0.7 * eye if shape == (-1, -1) else given[k].new_tensor(0.7)
        rows = [*given[:k], spread.expand_as(given[k]), *given[k + 1 :]]
        forms = [0.7, spread.reshape(1)] if shape == (0, 0) else [0.7]
        forms.append(rows[k][0])  # one row without its dimension
        for form in forms:
            found = pointwise(function, 3, *given[:k], form, *given[k + 1 :])
            for a, b in zip(found, pointwise(function, 3, *rows), strict=True):
                assert torch.equal(a, b)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("function", NAMES)
def test_gradients(function, dim, device):
    """First and second derivatives by every argument; one argument is shared by all rows."""
    given = [a.requires_grad_() for a in arguments(function, dim, device, rows=3, seed=4)]
    if FUNCTIONS[function].arguments[-1] == (0, 0) and len(given) > 1:
        given[-1] = given[-1].detach()[0].clone().requires_grad_()

    def call(*leaves):
        return tuple(pointwise(function, dim, *leaves))

    assert torch.autograd.gradcheck(call, given)
    assert torch.autograd.gradgradcheck(call, given)


@pytest.mark.parametrize("function", NAMES)
def test_gradients_of_the_reference(function, device):
    """Reverse mode of plain torch gives the same gradients, on both sides of every switch."""
    ours = [a.requires_grad_() for a in arguments(function, 3, device)]
    theirs = [a.detach().clone().requires_grad_() for a in ours]
    found, wanted = pointwise(function, 3, *ours), expected(function, 3, theirs)
    weights = [torch.randn(a.shape, generator=torch.Generator().manual_seed(k)).to(a) for k, a in enumerate(found)]
    a = torch.autograd.grad(found, ours, weights, allow_unused=True, materialize_grads=True)
    b = torch.autograd.grad(
        [w for w in wanted if w.requires_grad],
        theirs,
        [g for g, w in zip(weights, wanted, strict=True) if w.requires_grad],
        allow_unused=True,
        materialize_grads=True,
    )
    for mine, other in zip(a, b, strict=True):
        assert torch.allclose(mine, other, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("function", [name for name in NAMES if len(FUNCTIONS[name].results) > 1])
def test_some_of_the_results(function, device):
    given = [a.requires_grad_() for a in arguments(function, 2, device, torch.float32)]
    everything = pointwise(function, 2, *given)
    for wanted in ([0], [1], [1, 0]):
        some = pointwise(function, 2, *given, wanted=wanted)
        assert len(some) == len(wanted)
        for k, value in zip(wanted, some, strict=True):
            assert torch.equal(value, everything[k])
        gradients = (torch.autograd.grad([v.sum() for v in values], given, retain_graph=True, materialize_grads=True)
                     for values in (some, [everything[k] for k in wanted]))  # fmt: skip
        assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


def test_scalars_on_the_cpu(device):
    """A tensor [] may stay on the CPU beside tensors of a device, with a gradient too."""
    distance = arguments("heat_layer", 3, device)[0]
    width = torch.tensor(0.8, dtype=torch.float64)
    expected = pointwise("heat_layer", 3, distance, 0.8)
    for given in (width, width.clone().requires_grad_()):
        found = pointwise("heat_layer", 3, distance, given)
        assert all(torch.equal(a.detach(), b) for a, b in zip(found, expected, strict=True))
    assert float(torch.autograd.grad(found[0].sum(), given)[0]) != 0
    meta = pointwise("heat_layer", 3, distance.to("meta"), width)
    assert all(a.is_meta and a.shape == b.shape for a, b in zip(meta, expected, strict=True))


def test_third_derivatives_are_refused(device):
    theta = arguments("heat_radiation", 3, device)
    theta[1].requires_grad_()
    value = pointwise("heat_radiation", 3, *theta)[1].sum()
    for _ in range(2):
        (value,) = torch.autograd.grad(value.sum(), theta[1], create_graph=True)
    with pytest.raises(NotImplementedError, match="twice"):
        torch.autograd.grad(value.sum(), theta[1])


def test_melting_point_that_is_infinite(device):
    """The temperature does not change then, and its gradients are finite."""
    given = [a.requires_grad_() for a in arguments("heat_melt", 3, device)]
    with torch.no_grad():
        given[1].zero_()
        given[2].fill_(torch.inf)
    theta, liquid, changing = pointwise("heat_melt", 3, *given)
    assert torch.equal(theta, given[0]) and not bool(liquid.any() | changing.any())
    gradients = torch.autograd.grad((theta + liquid + changing).sum(), given)
    assert all(bool(g.isfinite().all()) for g in gradients)


@pytest.mark.parametrize("function", NAMES)
def test_no_rows(function, device):
    for result in pointwise(function, 3, *arguments(function, 3, device, rows=0)):
        assert result.shape[0] == 0


@pytest.mark.parametrize("function", NAMES)
def test_opcheck(function, device):
    given = [a.requires_grad_() for a in arguments(function, 2, device, rows=3)]
    results = list(range(len(FUNCTIONS[function].results)))
    call = function, 2, given, list(range(len(given))), [0.0] * len(given), results
    ops = torch.ops.torch_mpm
    torch.library.opcheck(ops.pointwise.default, call)
    plain = function, 2, [a.detach() for a in given], *call[3:5]
    adjoints = [torch.ones_like(a) for a in ops.pointwise(*plain, results)]
    fake = ("test_schema", "test_faketensor")
    torch.library.opcheck(ops.pointwise_backward.default, (*plain, adjoints, results, call[3]), test_utils=fake)
    tangents = [torch.ones_like(a) for a in plain[2]]
    second = *plain, adjoints, results, tangents, call[3], call[3]
    torch.library.opcheck(ops.pointwise_second.default, second, test_utils=fake)


def test_on_the_switches(device):
    """Exactly on a boundary between cases, and what is not a number."""
    nan = math.nan
    rows = torch.tensor(
        [[0.5, 0.1], [0.5, 0.5], [0.0, 0.0], [nan, 0.0], [0.0, nan]], dtype=torch.float64, device=device
    )
    (distance,) = pointwise("box_distance", 2, rows, torch.ones(2, dtype=torch.float64, device=device))
    assert distance[:3].tolist() == [0.0, 0.0, -0.5] and bool(distance[3:].isnan().all())
    J, f = (torch.tensor(v, dtype=torch.float64, device=device) for v in ([0.5, 0.5], [0.8, 0.7999]))
    solid = torch.eye(2, dtype=torch.float64, device=device).expand(2, 2, 2)
    volume, F = pointwise("melting_parts", 2, J, solid, f, 0.8)
    assert volume.tolist() == [0.5, 1.0] and torch.allclose(F[:, 0, 0] ** 2, volume)


@pytest.mark.parametrize("dtype,bound", [(torch.float64, 1e-14), (torch.float32, 1e-6)])
def test_volumes_far_from_one(dim, dtype, bound, device):
    """Flow conserves the volume, from 1e-30 to 1e30."""
    J = torch.logspace(-30, 30, 61, dtype=dtype, device=device)
    _, F = pointwise("melting_parts", dim, J, 1.0, 1.0, 0.8)
    assert float((F[:, 0, 0].double() ** dim / J.double() - 1).abs().max()) < 10 * bound


def test_bad_arguments(device):
    op, x = torch.ops.torch_mpm.pointwise, torch.ones(4, device=device)
    with pytest.raises(RuntimeError, match=r"function must be one of heat_weights, .*, got no_such"):
        op("no_such", 3, [x], [0], [0.0], [0])
    with pytest.raises(RuntimeError, match=r"dim must be 2 or 3, got 4"):
        op("length", 4, [x], [0], [0.0], [0])
    with pytest.raises(RuntimeError, match=r"tensors\[0\] must have shape \[4, 3\], got \[4, 2\]"):
        op("length", 3, [torch.ones(4, 2, device=device)], [0], [0.0], [0])
    with pytest.raises(RuntimeError, match=r"numbers must have 2 entries for the function heat_layer, got 1"):
        op("heat_layer", 3, [x], [0], [0.0], [0])
    with pytest.raises(RuntimeError, match=r"places must be different numbers below 2, got \[2\]"):
        op("heat_layer", 3, [x], [2], [0.0, 0.0], [0])
    with pytest.raises(RuntimeError, match=r"tensors\[1\] must be float32, got float64"):
        op("heat_layer", 3, [x, x.double()], [0, 1], [0.0, 0.0], [0])
    with pytest.raises(RuntimeError, match=r"tensors\[0\] must have shape \[4\], got \[3\]"):
        op("heat_layer", 3, [x[:3], x], [0, 1], [0.0, 0.0], [0])
    with pytest.raises(RuntimeError, match="a row for each particle"):
        op("heat_layer", 3, [x[0]], [0], [0.0, 1.0], [0])
    with pytest.raises(RuntimeError, match=r"wanted must be different numbers below 2, got \[0, 0\]"):
        op("heat_layer", 3, [x], [0], [0.0, 1.0], [0, 0])


def test_strides(device):
    """Arguments of any strides, and results as the other ops give them."""
    F = torch.randn(ROWS, 3, 3, device=device).mT
    J, expanded = pointwise("thermal_stretch", 3, 1.0, F, 0.0, torch.zeros(ROWS, device=device), 1.0)
    assert torch.equal(expanded, F) and expanded.stride(0) == 1 and torch.equal(J, torch.ones_like(J))
