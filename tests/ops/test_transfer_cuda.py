"""Failures specific to CUDA: activation without the host, crowded and sparse blocks, atomics, graph capture."""

import dataclasses

import pytest
import torch
from helpers import TOLERANCE, Particles, random_particles, relative_error
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.grid.topology import Status

pytestmark = pytest.mark.cuda


def uneven_particles(dim: int, kernel: str, **options: object) -> Particles:
    """Two scenes of 4000: two thousand in one cell, the rest spread, many alone in their block, some outside or NaN."""
    options = {"max_blocks": 5400 if dim == 2 else 3450} | options
    p = random_particles(dim, kernel, (4000, 4000), dx=0.1 if dim == 3 else 0.02, extent=4.0, **options)
    x = p.x.clone()
    cell = torch.tensor([0.523, 0.541, 0.562][:dim])
    x[::4] = cell + 0.01 * p.grid.dx * torch.rand(2000, dim, dtype=x.dtype)
    x[::97] = 7.0
    x[50] = float("nan")
    x[51, 0] = float("inf")
    return dataclasses.replace(p, x=x)


def activate(p: Particles) -> tuple[Tensor, ...]:
    blocks = p.blocks()
    return blocks.table, blocks.block, blocks.offsets, blocks.index, blocks.status


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_activation_is_that_of_the_cpu(dim, kernel, deterministic, dtype):
    p = uneven_particles(dim, kernel, deterministic=deterministic)
    cpu, gpu = activate(p.to("cpu", dtype)), [t.cpu() for t in activate(p.to("cuda", dtype))]
    for i in (0, 1, 2, 4):
        assert torch.equal(cpu[i], gpu[i])
    offsets, P = cpu[2].tolist(), len(p.x)
    assert offsets[-1] < P - 80 and cpu[4][0, 3] == 2
    if deterministic:
        assert torch.equal(cpu[3][: offsets[-1]], gpu[3][: offsets[-1]])
    for begin, end in zip([0, *offsets], [*offsets, P], strict=True):
        assert torch.equal(cpu[3][begin:end].sort().values, gpu[3][begin:end].sort().values)


def test_first_problem_stays_in_the_status(dim, kernel):
    p = uneven_particles(dim, kernel).to("cuda", torch.float32)
    good = p.x.nan_to_num(1.0, 1.0, 1.0).clamp(0, 3)
    blocks = p.grid.activate(good, p.scene)
    assert blocks.status[0, 1:7].tolist() == [0, -1, 0, -1, 1, -1]
    blocks = p.grid.activate(p.x, p.scene, blocks.status)
    problem = blocks.status[0, 1:5].tolist()
    assert problem[1] == 0 and problem[2:] == [2, 50]
    worse = torch.full_like(p.x, float("nan"))
    status = p.grid.activate(worse, p.scene, blocks.status).status[0].tolist()
    assert status[1:5] == problem and status[5:7] == [3, 1] and status[0] > 0 and status[7] == 0


@pytest.mark.parametrize("scene_value", [-2, 2, 2**31 - 1, -(2**31)])
def test_a_scene_that_does_not_exist_is_outside(dim, kernel, scene_value):
    p = uneven_particles(dim, kernel).to("cuda", torch.float32)
    scene = torch.full_like(p.scene, scene_value)
    out = torch.ops.torch_mpm.activate(p.x, scene, None, None, 2, 3000, *p.grid.packed)
    assert not out[5][1:, 1:5:2].any()
    status = out[5][0].tolist()
    assert status[1] == len(p.x) - 2 and status[3] == 2 and status[7] == 0 and out[2].eq(0).all()


@pytest.mark.parametrize("max_blocks", [0, 1, 7, 100])
def test_an_overflow_drops_whole_particles(dim, kernel, max_blocks):
    p = uneven_particles(dim, kernel, max_blocks=max_blocks).to("cuda", torch.float64)
    blocks = p.blocks()
    transferred = int(blocks.offsets[-1])
    assert blocks.status[0, Status.BLOCKS_WANTED] > max_blocks and blocks.status[0, Status.PROBLEM_ACTIVATION] == 0
    index = blocks.index.long()
    assert torch.equal(index.sort().values, torch.arange(len(p.x), device="cuda"))
    nodes = mpm.p2g(blocks, p.x, p.mass, p.v, p.C)
    torch.testing.assert_close(nodes[:, 0].sum(), p.mass[index[:transferred]].sum())
    v, C, _ = mpm.g2p(blocks, p.x, nodes[:, 1:])
    dropped = index[transferred:]
    lost = ~p.x[dropped].isfinite().all(1)
    for value in (v[dropped], C[dropped]):
        assert value[~lost].eq(0).all() and value[lost].isnan().all()


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("form", ["mls", "gradient"])
def test_uneven_particles_agree_with_the_cpu(dim, kernel, deterministic, form):
    p = uneven_particles(dim, kernel, deterministic=deterministic)
    results = {}
    for device, dtype in [("cpu", torch.float64), ("cuda", torch.float64), ("cuda", torch.float32)]:
        q = p.to(device, dtype)
        leaves = [t.requires_grad_() for t in (q.x, q.mass, q.v, q.C, q.stress, q.volume)]
        blocks = q.blocks()
        nodes = mpm.p2g(blocks, *leaves, dt=0.01, stress_form=form)
        v, C, grad_v = mpm.g2p(blocks, q.x, nodes[:, 1:], gradient=True)
        finite = q.x.isfinite().all(1)
        assert all(t[~finite].isnan().all() for t in (v, C, grad_v))
        v, C, grad_v = (t[finite] for t in (v, C, grad_v))
        loss = (nodes**2).sum() + (v**2).sum() + (C**2).sum() + (grad_v**2).sum()
        results[device, dtype] = [nodes, v, C, grad_v, *torch.autograd.grad(loss, leaves)]
    expected = results["cpu", torch.float64]
    for dtype, tolerance in TOLERANCE["transfer on CUDA"].items():
        for value, reference in zip(results["cuda", dtype], expected, strict=True):
            assert relative_error(value, reference) < tolerance  # gradients of sums through three transfers
    assert finite.sum() == len(p.x) - 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_deterministic_mode_repeats_itself_bit_by_bit(dim, kernel, dtype):
    p = uneven_particles(dim, kernel, deterministic=True).to("cuda", dtype)
    moment = torch.randn(len(p.x), 4, dim, device="cuda", dtype=dtype)
    runs = []
    for _ in range(3):
        blocks = p.blocks()
        momentum = mpm.p2g(blocks, p.x, p.mass, p.v, p.C, p.stress, p.volume, 0.01)
        features = mpm.scatter(blocks, p.x, moment[..., 0].contiguous(), moment)
        runs.append((blocks.index, momentum, features))
    for other in runs[1:]:
        for a, b in zip(runs[0], other, strict=True):
            assert torch.equal(a, b)


def test_a_step_is_captured_in_a_graph(dim, kernel):
    p = uneven_particles(dim, kernel).to("cuda", torch.float64)

    def transfer() -> tuple[Tensor, ...]:
        blocks = p.blocks()
        nodes = mpm.p2g(blocks, p.x, p.mass, p.v, p.C, p.stress, p.volume, 0.01)
        return nodes, *mpm.g2p(blocks, p.x, nodes[:, 1:])[:2]

    transfer()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = transfer()
    p.x.copy_(uneven_particles(dim, kernel).x.flip(0))  # the graph reads new positions from the same memory
    graph.replay()
    for a, b in zip(captured, transfer(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10, equal_nan=True)


def test_positions_that_were_not_activated_touch_no_memory(dim, kernel):
    p = uneven_particles(dim, kernel).to("cuda", torch.float64)
    blocks = p.blocks()
    for x in (p.x.flip(0), p.x + 1.0, torch.full_like(p.x, float("nan")), torch.full_like(p.x, 1e300)):
        nodes = mpm.p2g(blocks, x, p.mass, p.v, p.C)
        assert 0 <= nodes[:, 0].sum() <= p.mass.sum()
        v = mpm.g2p(blocks, x, nodes[:, 1:])[0]
        assert torch.equal(v.isfinite().all(1), x.isfinite().all(1))
    torch.cuda.synchronize()
