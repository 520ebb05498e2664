"""The CPU transfers: threads, instruction sets, order and strides of the particles, skipped particles."""

import os
import subprocess
import sys

import pytest
import torch
from helpers import TOLERANCE, relative_error
from oracle import transfer as reference

import torch_mpm as mpm
from torch_mpm.info import info

OPS = torch.ops.torch_mpm
DIMENSIONS = [2, 3]
KERNELS = ["quadratic", "cubic"]
MLS, GRADIENT = 0, 1
ALL = 127  # every adjoint of p2g_backward


def make_grid(dim, kernel="quadratic", dx=0.07, scenes=1):
    return mpm.Grid(dx=dx, lower=(0.1,) * dim, upper=(1.1,) * dim, scenes=scenes, kernel=kernel)


def particles(dim, count, dtype=torch.float32, seed=0):
    """x inside the grid, mass, v, C, stress, volume."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(count, *shape, generator=random, dtype=torch.float64).to(dtype)

    x = (0.1 + torch.rand(count, dim, generator=random, dtype=torch.float64)).to(dtype).clamp(0.1, 1.1)
    return x, normal().abs(), normal(dim), normal(dim, dim), normal(dim, dim), normal().abs()


def run_all(blocks, x, mass, v, C, stress, volume, form=MLS):
    """Every transfer op once, by name."""
    topology = blocks.packed
    p2g = OPS.p2g(x, mass, v, C, stress, volume, None, 0.1, form, *topology)
    random = torch.Generator().manual_seed(9)
    nodes = torch.randn(p2g.shape, generator=random, dtype=torch.float64).to(x.dtype)
    results = {"p2g": p2g, "scatter": OPS.scatter(x, v, C, stress, 2.0, *topology)}
    gathered = OPS.gather(x, nodes, 2.0, True, True, *topology)
    results |= zip(["value", "moment", "gradient"], gathered, strict=True)
    adjoints = OPS.p2g_backward(nodes, x, mass, v, C, stress, volume, None, 0.1, form, ALL, *topology)
    results |= zip(["x", "mass", "v", "C", "stress", "volume", "dt"], adjoints, strict=True)
    results["position"] = OPS.position_gradient(x, v, C, stress, nodes[:, 1:], 2.0, *topology)
    return results


def reference_all(blocks, x, mass, v, C, stress, volume, form=MLS):
    """The same in plain torch and float64."""
    inputs = [t.double().requires_grad_() for t in (x, mass, v, C, stress, volume)]
    x, mass, v, C, stress, volume = inputs
    dt = torch.full_like(mass, 0.1, requires_grad=True)
    p2g = reference.p2g(blocks, *inputs, dt, "mls" if form == MLS else "gradient")
    random = torch.Generator().manual_seed(9)
    nodes = torch.randn(p2g.shape, generator=random, dtype=torch.float64)
    results = {"p2g": p2g.detach(), "scatter": reference.scatter(blocks, x, v, C, stress, 2.0).detach()}
    gathered = reference.gather(blocks, x.detach(), nodes, 2.0)
    results |= zip(["value", "moment", "gradient"], gathered, strict=True)
    adjoints = torch.autograd.grad(p2g, [*inputs, dt], nodes)
    results |= zip(["x", "mass", "v", "C", "stress", "volume", "dt"], adjoints, strict=True)
    results["position"] = reference.position_gradient(blocks, x, v, C, stress, nodes[:, 1:], 2.0).detach()
    return results


def assert_close(results, expected, tolerance):
    """Relative L2 distance of every result."""
    assert results.keys() == expected.keys()
    for name, value in results.items():
        error = relative_error(value, expected[name])
        assert error <= tolerance, f"{name}: relative error {error:.1e}"


@pytest.fixture
def threads():
    """Sets the number of threads, and restores it after the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("dim", DIMENSIONS)
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("form", [MLS, GRADIENT])
@pytest.mark.parametrize("dtype, tolerance", TOLERANCE["transfer"].items())
def test_agrees_with_float64_reference(dim, kernel, form, dtype, tolerance):
    grid = make_grid(dim, kernel)
    inputs = particles(dim, 400, dtype)
    blocks = grid.activate(inputs[0])
    assert_close(run_all(blocks, *inputs, form), reference_all(blocks, *inputs, form), tolerance)


@pytest.mark.parametrize("dim", DIMENSIONS)
def test_independent_of_thread_count(dim, threads):
    grid = make_grid(dim, dx=0.02 if dim == 2 else 0.05)
    inputs = particles(dim, 30000)
    results = []
    for count in (1, 2, 4):
        threads(count)
        blocks = grid.activate(inputs[0])
        activation = {name: getattr(blocks, name) for name in ("table", "block", "offsets", "index", "status")}
        results.append(activation | run_all(blocks, *inputs))
    for other in results[1:]:
        for name, value in results[0].items():
            assert torch.equal(value, other[name]), name


LEVELS = info()["build"]["cpu"]["isa"]
LEVEL_SCRIPT = """
import sys, torch
from test_transfer_cpu import make_grid, particles, run_all
inputs = particles(3, 2000)
torch.save(run_all(make_grid(3).activate(inputs[0]), *inputs), sys.argv[1])
"""


@pytest.mark.skipif(len(LEVELS) < 2, reason="built for one level only (TORCH_MPM_ISA_LEVELS)")
def test_instruction_sets_agree(tmp_path):
    inputs = particles(3, 2000)
    best = run_all(make_grid(3).activate(inputs[0]), *inputs)
    for level in LEVELS[:-1]:
        file = tmp_path / level
        environment = os.environ | {"TORCH_MPM_ISA_LEVEL": level, "PYTHONPATH": os.pathsep.join(sys.path)}
        subprocess.run([sys.executable, "-c", LEVEL_SCRIPT, str(file)], env=environment, check=True)
        assert_close(torch.load(file, weights_only=True), best, 1e-6)


@pytest.mark.parametrize("dim", DIMENSIONS)
def test_index_groups_particles_by_block(dim):
    grid = make_grid(dim, scenes=2)
    x = particles(dim, 3000)[0]
    scene = torch.randint(0, 2, (3000,), dtype=torch.int32, generator=torch.Generator().manual_seed(1))
    blocks = grid.activate(x, scene)
    base = torch.floor((x.double() - 0.1) / grid.dx + 3 - 0.5).long()
    entry = scene.long()
    for axis in range(dim):
        entry = entry * grid.blocks[axis] + base[:, axis] // 4
    slot = blocks.table[entry]
    assert torch.equal(blocks.index.long(), torch.argsort(slot, stable=True))
    assert torch.equal(
        blocks.offsets, torch.searchsorted(slot.sort()[0], torch.arange(len(blocks.offsets)), out_int32=True)
    )
    touched = torch.unique(reference.support(blocks, x.double()).rows // grid.nodes_per_block)
    active = int((blocks.block >= 0).sum())
    assert torch.equal(touched, torch.arange(active)), "active blocks are those that a particle touches"
    assert torch.equal(blocks.block[:active], blocks.block[:active].sort()[0]), "slots are in the order of the table"
    assert torch.equal(blocks.table[blocks.block[:active].long()], torch.arange(active, dtype=torch.int32))


@pytest.mark.parametrize("dim", DIMENSIONS)
def test_independent_of_order_and_strides(dim):
    grid = make_grid(dim)
    inputs = particles(dim, 4000)
    order = grid.activate(inputs[0]).index.long()
    inputs = [t[order] for t in inputs]  # by block, rows contiguous
    expected = run_all(grid.activate(inputs[0]), *inputs)
    columns = [t.movedim(0, -1).contiguous().movedim(-1, 0) for t in inputs]
    results = run_all(grid.activate(columns[0]), *columns)
    assert all(torch.equal(value, expected[name]) for name, value in results.items())
    shuffle = torch.randperm(4000, generator=torch.Generator().manual_seed(2))
    shuffled = run_all(grid.activate(inputs[0][shuffle]), *(t[shuffle] for t in inputs))
    for name, value in shuffled.items():
        same = expected[name] if name in ("p2g", "scatter") else expected[name][shuffle]
        assert_close({name: value}, {name: same}, 1e-6)


def test_more_than_four_channels_of_sorted_particles():
    grid = make_grid(3)
    x = particles(3, 3000, torch.float64)[0]
    base = torch.floor((x - 0.1) / grid.dx + 2.5).long()
    key = ((base[:, 0] // 4 * 64 + base[:, 1] // 4) * 64 + base[:, 2] // 4) * 64
    key += base[:, 0] % 4 * 16 + base[:, 1] % 4 * 4 + base[:, 2] % 4
    x = x[torch.argsort(key)]
    random = torch.Generator().manual_seed(3)
    value, moment = torch.randn(3000, 6, generator=random), torch.randn(3000, 6, 3, generator=random)
    value, moment = value.double(), moment.double()
    blocks = grid.activate(x)
    nodes = torch.randn(blocks.node_count, 6, generator=random).double()
    result = OPS.position_gradient(x, value, moment, None, nodes, 2.0, *blocks.packed)
    expected = reference.position_gradient(blocks, x, value, moment, None, nodes, 2.0)
    torch.testing.assert_close(result, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("dim", DIMENSIONS)
def test_crowded_cell(dim):
    grid = make_grid(dim)
    inputs = particles(dim, 1200)  # more than a chunk
    x = 0.5 + 0.02 * (inputs[0] - 0.1)
    blocks = grid.activate(x)
    assert_close(run_all(blocks, x, *inputs[1:]), reference_all(blocks, x, *inputs[1:]), 5e-6)


@pytest.mark.parametrize("dim", DIMENSIONS)
def test_one_particle_and_none(dim):
    grid = make_grid(dim)
    inputs = particles(dim, 1, torch.float64)
    blocks = grid.activate(inputs[0])
    assert_close(run_all(blocks, *inputs), reference_all(blocks, *inputs), TOLERANCE["transfer"][torch.float64])
    none = [t[:0] for t in inputs]
    blocks = grid.activate(none[0])
    assert blocks.status.tolist() == [[0, 0, -1, 0, -1, 1, -1, 0], [0, 0, -1, 0, -1, 0, -1, 0]]
    results = run_all(blocks, *none)
    assert not results["p2g"].any() and results["value"].shape == (0, 1 + dim)


@pytest.mark.parametrize("dim", DIMENSIONS)
def test_particles_outside_give_and_take_nothing(dim):
    grid = make_grid(dim)
    inputs = particles(dim, 500)
    x = inputs[0].clone()
    x[3, 0], x[70, 1] = float("nan"), float("inf")
    x[5], x[90, 1] = -7.0, 1e30
    blocks = grid.activate(x)
    assert blocks.status[:, 1:5].tolist() == 2 * [[2, 5, 2, 3]]
    out = torch.tensor([3, 5, 70, 90])
    assert torch.equal(blocks.index[-4:].long(), out) and int(blocks.offsets[-1]) == 496
    results = run_all(blocks, x, *inputs[1:])
    inside = torch.ones(500, dtype=torch.bool)
    inside[out] = False
    expected = run_all(grid.activate(x[inside]), x[inside], *(t[inside] for t in inputs[1:]))
    for name, value in results.items():
        if name in ("p2g", "scatter"):
            rows = min(len(value), len(expected[name]))
            assert torch.equal(value[:rows], expected[name][:rows]) and not value[rows:].any()
        else:
            assert not value[out].any(), name
            assert value[inside].isfinite().all() and value[inside].any(), name


@pytest.mark.parametrize("dim", DIMENSIONS)
@pytest.mark.parametrize("max_blocks", [0, 1, 7])
def test_overflow_leaves_out_whole_particles(dim, max_blocks):
    grid = make_grid(dim)
    inputs = particles(dim, 2000, torch.float64)
    x, mass = inputs[:2]
    wanted = grid.activate(x).wanted
    assert wanted > 7
    tensors = OPS.activate(x, None, None, None, 1, max_blocks, *grid.packed)
    blocks = mpm.grid.Blocks(grid, *tensors[:5], None, tensors[5])
    assert blocks.status.tolist() == [[wanted, 0, -1, 0, -1, 1, 0, wanted], [0, 0, -1, 0, -1, 0, -1, 0]]
    assert torch.equal(blocks.index.sort()[0], torch.arange(2000, dtype=torch.int32))
    count = int(blocks.offsets[-1])
    transferred = blocks.index[:count].long()
    # Particles with their whole support in active blocks have weights that sum to one in the reference.
    whole = (reference.support(blocks, x).weight.sum(1) > 0.5).nonzero()[:, 0]
    assert torch.equal(transferred.sort()[0], whole)
    results = run_all(blocks, *inputs)
    assert_close({"mass": results["p2g"][:, 0].sum()}, {"mass": mass[transferred].sum()}, 1e-14)
    left = blocks.index[count:].long()
    assert not any(value[left].any() for name, value in results.items() if name not in ("p2g", "scatter"))


def test_status_keeps_the_first_problem():
    grid = make_grid(3)
    x = particles(3, 100)[0]
    first = grid.activate(x)
    bad = x.clone()
    bad[17] = 9.0
    second = grid.activate(bad, previous=first.status)
    worse = x.clone()
    worse[3:6] = float("nan")
    third = grid.activate(worse, previous=second.status)
    wanted = [b.wanted for b in (first, second, third)]
    assert second.status[0].tolist() == [max(wanted[:2]), 1, 17, 0, -1, 2, 1, wanted[1]]
    assert third.status[0].tolist() == [max(wanted), 1, 17, 0, -1, 3, 1, wanted[2]]
