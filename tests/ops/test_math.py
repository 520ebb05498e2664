"""The torch-free math headers, through their numpy bindings."""

import numpy as np
import pytest
import torch
from oracle.transfer import bspline

math = pytest.importorskip("torch_mpm._math", reason="torch_mpm._math is built where Python.h is")


@pytest.mark.parametrize(("order", "start"), [(2, 0.5), (3, 1.0)])
def test_bspline_weights_and_derivatives(order: int, start: float) -> None:
    f = start + np.linspace(0, 1, 101)[:-1]
    nodes = np.arange(order + 1)
    expected = bspline(torch.tensor(f[:, None] - nodes), order).numpy()
    weights = math.bspline(f, order)
    assert np.abs(weights - expected).max() < 1e-15
    assert np.abs(weights.sum(1) - 1).max() < 1e-15
    assert np.abs((weights * nodes).sum(1) - f).max() < 1e-14  # linear fields are reproduced
    h = 1e-6
    inner = f[1:]
    for derivative in (1, 2):
        change = math.bspline(inner + h, order, derivative - 1) - math.bspline(inner - h, order, derivative - 1)
        assert np.abs(math.bspline(inner, order, derivative) - change / (2 * h)).max() < 1e-9


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_expm1_to_two_units_in_the_last_place(dtype: type) -> None:
    largest = 88 if dtype == np.float32 else 709
    x = np.concatenate(
        [np.linspace(-largest, largest, 20001), np.geomspace(1e-30, 1, 2000), -np.geomspace(1e-30, 1, 2000)]
    )
    x = x.astype(dtype)
    exact = np.expm1(x.astype(np.longdouble))
    error = np.abs(math.expm1(x) - exact) / np.maximum(np.abs(exact), np.finfo(dtype).tiny)
    assert error.max() < 2 * np.finfo(dtype).eps
    special = math.expm1(np.array([0, 1e4, -1e4, np.nan, np.inf, -np.inf], dtype=dtype))
    assert special[0] == 0 and special[1] == np.inf and special[2] == -1 and np.isnan(special[3])
    assert special[4] == np.inf and special[5] == -1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_log_of_a_number_known_beside_its_distance_from_one(dtype: type) -> None:
    """Near 1 the distance counts, far from 1 the number."""
    small = np.concatenate([np.geomspace(1e-30, 0.2, 3000), -np.geomspace(1e-30, 0.2, 3000)]).astype(dtype)
    large = np.geomspace(1e-30, 1e30, 5000).astype(dtype)
    large = large[(large < 0.6) | (large > 1.6)]
    for a, difference, exact in (
        (1 + small, small, np.log1p(small.astype(np.longdouble))),
        (large, large - 1, np.log(large.astype(np.longdouble))),
    ):
        error = np.abs(math.log_1p(a.astype(dtype), difference.astype(dtype)) - exact) / np.abs(exact)
        assert error.max() < 2 * np.finfo(dtype).eps


def test_eigenvalue_bound_lies_between_the_largest_and_four_thirds_of_it() -> None:
    generator = np.random.default_rng(0)
    for _ in range(500):
        a = generator.normal(size=(3, 3)) * generator.choice([0.1, 1, 10], size=(3, 1))
        positive = a @ a.T
        largest, bound = np.linalg.eigvalsh(positive)[-1], math.largest_eigenvalue_bound(positive)
        assert largest * (1 - 1e-12) <= bound <= 4 / 3 * largest * (1 + 1e-12)
    assert math.largest_eigenvalue_bound(np.diag([5.0, 1.0, 1.0])) == pytest.approx(5)


def test_laws_are_bound() -> None:
    """Uniaxial stretch of a neo-Hookean solid by hand; errors for wrong arguments."""
    result = math.evaluate_law("neo_hookean", np.diag([2.0, 1.0, 1.0]), [3.0, 4.0])
    log = np.log(2)
    assert result["energy"] == pytest.approx(1.5 * 3 - 3 * log + 2 * log**2)
    assert np.allclose(result["stress"], np.diag([9 + 4 * log, 4 * log, 4 * log]))
    assert result["wave_modulus"] == pytest.approx(3 * 4 + 3 + 4 * (1 - log))
    with pytest.raises(ValueError, match="no law of this name"):
        math.evaluate_law("rubber", np.eye(3), [1.0])
    with pytest.raises(ValueError, match="another number of parameters"):
        math.evaluate_law("neo_hookean", np.eye(3), [1.0])
    with pytest.raises(ValueError, match="F must have shape"):
        math.evaluate_law("neo_hookean", np.ones((2, 3)), [1.0, 1.0])
