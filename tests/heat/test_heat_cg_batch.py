"""The heat solve of many scenes at once: small ones, empty ones, and a few that are large."""

import math

import pytest
import torch
from cases.heat_cg import check_replay, heat
from helpers import relative_error
from oracle import heat as reference

SIZES = tuple((37 * n) % 60 if n % 5 else 0 for n in range(150))


def batch(dim, kernel="quadratic", device="cpu", dtype=torch.float64, **options):
    """150 scenes, every fifth of them empty; by default one is large and follows an empty one."""
    return heat(dim, kernel, device, dtype, **({"sizes": (*SIZES, 0, 9000, *SIZES[::9]), "dx": 0.2} | options))


def alone(h, **options):
    """The solve in plain torch."""
    return reference.heat_cg(
        h.blocks, h.x, h.conductance, h.heat_capacity, h.theta, h.dt, h.source, h.exchange, h.fixed, **options
    )


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("deterministic", [False, True])
def test_batch_is_the_reference(device, dim, kernel, deterministic):
    if dim == 3 and (kernel == "cubic") == deterministic:
        pytest.skip("2-D has it")
    h = batch(dim, kernel, device, deterministic=deterministic)
    for options in ({"tolerance": 0.0, "max_iterations": 2}, {"tolerance": 1e-9, "max_iterations": 200}):
        got, expected = h.solve(**options), alone(h, **options)
        assert relative_error(got.increment, expected[0]) < 1e-9
        assert torch.equal(got.iterations, expected[1]) and torch.equal(got.converged, expected[3])
        assert (got.increment[h.fixed] == 0).all()
    empty = torch.bincount(h.blocks.scene.long(), minlength=h.blocks.grid.scenes) == 0
    assert int(empty.sum()) > 30 and (got.iterations[empty] == 0).all() and (got.residual[empty] == 0).all()


def test_chebyshev_of_a_batch(device, dim, kernel):
    h = batch(dim, kernel, device)
    got = h.solve(tolerance=1e-10, max_iterations=1000, method="chebyshev")
    assert got.converged.all() and int(got.iterations.max()) > int(got.iterations.float().mean())
    assert relative_error(got.increment, alone(h, tolerance=1e-12, max_iterations=1000)[0]) < 1e-8


def test_batch_in_float32(device, dim):
    h = batch(dim, device=device, dtype=torch.float32)
    got, expected = h.solve(tolerance=1e-6), alone(h, tolerance=1e-6)
    assert got.converged.all() and relative_error(got.increment, expected[0]) < 1e-5


def test_nan_spreads_to_no_other_scene(device, dim):
    """In a scene of a thread block, and in the large one."""
    h = batch(dim, device=device, deterministic=True)
    scene, expected = h.blocks.node_scene(), h.solve(tolerance=1e-9)
    broken = (7, len(SIZES) + 1)
    for number in broken:
        h.theta[torch.nonzero((scene == number) & (h.heat_capacity > 0))[3]] = math.nan
    got = h.solve(tolerance=1e-9)
    rest = (scene != broken[0]) & (scene != broken[1])
    assert torch.equal(got.increment[rest], expected.increment[rest]) and (got.increment[~rest] == 0).all()
    assert torch.nonzero(~got.converged).flatten().tolist() == list(broken) and got.residual[list(broken)].isnan().all()


def test_batch_is_bit_identical(device, dim):
    h = batch(dim, device=device, dtype=torch.float32, deterministic=True)
    first, second = (h.solve(tolerance=1e-6) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_heat_capacity_without_particles(device, dim):
    """Nodes with heat capacity that no particle reaches warm by their own source; those without keep theirs."""
    h = batch(dim, device=device)
    scene = h.blocks.node_scene().long()
    reached = h.heat_capacity > 0
    h.heat_capacity[(scene >= 0) & ~reached] = 0.3
    h.source[scene >= 0] += 0.1
    got = h.solve(False, tolerance=1e-12)
    expected = torch.where(scene < 0, 0, h.dt[scene.clamp_min(0)] * h.source / h.heat_capacity)
    torch.testing.assert_close(got.increment[~reached], expected[~reached], rtol=1e-9, atol=1e-12)
    h.heat_capacity[:] = torch.where(reached & (torch.arange(len(scene), device=device) % 3 > 0), h.heat_capacity, 0)
    h.exchange[:], h.fixed[:] = 0, False
    got = h.solve(tolerance=1e-12)
    assert relative_error(got.increment, alone(h, tolerance=1e-12)[0]) < 1e-9
    assert (got.increment[h.heat_capacity == 0] == 0).all()


def test_crowded_cells_of_a_batch(device, dim):
    h = batch(dim, device=device, sizes=(700, 500, 0, 20), dx=0.5)
    x = h.x.clone()
    x[h.blocks.scene == 1] = x[torch.nonzero(h.blocks.scene == 1)[0]] + 1e-3 * torch.rand_like(x[:1])
    h.x, h.blocks = x, h.blocks.grid.activate(x, h.blocks.scene)
    got = h.solve(False, max_iterations=3)
    h.exchange[:], h.fixed[:] = 0, False
    assert relative_error(got.increment, alone(h, tolerance=0.0, max_iterations=3)[0]) < 1e-9


def test_batch_in_a_cuda_graph(device):
    if device == "cpu":
        pytest.skip("graphs are of CUDA")
    h = batch(3, device=device, dtype=torch.float32)
    check_replay(h)


def test_solve_asks_the_device_nothing(device):
    if device == "cpu":
        pytest.skip("the CPU does not wait for itself")
    h = batch(2, device=device)
    h.solve(tolerance=1e-6)
    torch.cuda.set_sync_debug_mode("error")
    try:
        h.solve(tolerance=1e-6)
    finally:
        torch.cuda.set_sync_debug_mode("default")
