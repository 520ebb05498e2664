"""Inputs that ops accept from an activation: packing, rows of nodes, and particles in scenes that do not exist."""

import dataclasses
import resource
import subprocess
import sys

import pytest
import torch
from helpers import random_particles
from pairs import in_pairs

import torch_mpm as mpm
from torch_mpm.grid.topology import Topology


@pytest.mark.parametrize("sizes", [(9,), (11, 0, 6)])
def test_unpack_is_the_inverse_of_packed(dim, kernel, sizes):
    blocks = random_particles(dim, kernel, sizes=sizes, deterministic=True).blocks()
    topology = Topology.unpack(*blocks.packed)
    assert type(topology) is Topology and topology.packed[1:] == blocks.packed[1:]
    assert all(a is b for a, b in zip(topology.packed[0], blocks.packed[0], strict=True))
    assert (topology.scenes, topology.node_count) == (len(sizes), blocks.node_count)
    for name in ("dx", "lower", "blocks", "order", "deterministic", "dim", "nodes_per_block", "inverse_inertia"):
        assert getattr(topology.grid, name) == getattr(blocks.grid, name), name


def test_lists_of_a_wrong_length_are_refused():
    tensors, lattice, layout = random_particles(2, sizes=(4,)).blocks().packed
    for wrong in (tensors[:4], [*tensors, *tensors[:2]]):
        with pytest.raises(ValueError, match="topology must have 5 tensors and perhaps scene, got"):
            Topology.unpack(wrong, lattice, layout)
    for wrong in ((lattice[:1], layout), (lattice, layout[:-1]), (lattice, [*layout[:-1], 0])):
        with pytest.raises(ValueError, match=r"lattice must be \[dx, \*lower\]"):
            Topology.unpack(tensors, *wrong)


def test_rows_of_lattice_nodes(device, dim):
    """Each row is found again from the indices and the scene of its node; nodes elsewhere have none."""
    blocks = random_particles(dim, sizes=(5, 0, 4), dx=0.2, device=device).blocks()
    node, scene = blocks.node_indices(), blocks.node_scene()
    used = torch.nonzero(scene >= 0)[:, 0]
    assert torch.equal(blocks.rows_at(node[used], scene[used]), used)
    assert torch.equal(blocks.rows_at(node[used].reshape(-1, 2, dim), scene[used][::2]).reshape(-1), used)
    assert (blocks.rows_at(node[used], torch.ones_like(scene[used])) == -1).all()  # the scene without particles
    for axis in range(dim):
        for far in (-1, 4 * blocks.grid.blocks[axis]):
            outside = node[used].clone()
            outside[:, axis] = far
            assert (blocks.rows_at(outside, scene[used]) == -1).all()


def test_a_particle_in_no_scene_takes_no_part_in_gradients(device):
    """Neither in that of a time step per scene, whose entries are summed over the particles of a scene."""
    p = random_particles(2, sizes=(5, 3), device=device, shuffled=False)

    def gradients(p):
        dt = torch.tensor([0.1, 0.2], dtype=torch.float64, device=device, requires_grad=True)
        x = p.x.clone().requires_grad_()
        blocks = p.grid.activate(x, p.scene)
        nodes = mpm.p2g(blocks, x, p.mass, p.v, p.C, p.stress, p.volume, dt)
        moved = mpm.g2p_advance(blocks, x, nodes[:, 1:], dt, p.stress)
        inside = (p.scene >= 0) & (p.scene < 2)
        loss = nodes.square().sum() + sum((t[inside] ** 2).sum() for t in moved if t is not None)
        grad_x, grad_dt = torch.autograd.grad(loss, (x, dt))
        return grad_x[inside], grad_dt

    def more(t):
        return torch.cat([t[:1], t, t[-1:]])

    lost = dataclasses.replace(
        p, **{f.name: more(getattr(p, f.name)) for f in dataclasses.fields(p) if f.name != "grid"}
    )
    lost.scene[0], lost.scene[-1] = -3, 7
    for got, expected in zip(gradients(lost), gradients(p), strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-14)


# ---- domains that are large beside what the particles touch


def drops(dim: int, scenes: int, count: int = 3000) -> mpm.State:
    """Small drops in each scene, all in the unit box and on their way to others; some particles are not to be had."""
    g = torch.Generator().manual_seed(7)
    corner = torch.rand(3, dim, generator=g, dtype=torch.float64) * 0.5 + 0.2
    drop = torch.randint(0, 3, (count,), generator=g)
    x = corner[drop] + 0.1 * torch.rand(count, dim, generator=g, dtype=torch.float64)
    x[5], x[8, 0] = float("nan"), -9.0
    scene = torch.randint(-1, scenes, (count,), dtype=torch.int32, generator=g)
    ones = torch.ones(count, dtype=torch.float64)
    return mpm.State(
        x=x, v=8 * (0.5 - corner[drop]), mass=1e-3 * ones, volume=1e-6 * ones, scene=scene if scenes > 1 else None
    )


def in_domain(width: float, dim: int, scenes: int, **options) -> mpm.Grid:
    return mpm.Grid(dx=1 / 32, lower=(0.0,) * dim, upper=(width,) * dim, scenes=scenes, **options)


# Blocks of one scene: 10^D, and some millions, for whose table an activation has memory of another kind.
WIDTHS = {2: (1.0, 200.0), 3: (1.0, 18.0)}


def wide_blocks(blocks: mpm.Blocks) -> torch.Tensor:
    """Scene and block indices of each slot [N, 1 + D], -1 where unused."""
    index, columns = blocks.block.long(), []
    for size in reversed(blocks.grid.blocks):
        columns.insert(0, index % size)
        index = index.div(size, rounding_mode="floor")
    return torch.where(blocks.block[:, None] >= 0, torch.stack([index, *columns], 1), -1)


@pytest.mark.parametrize(*in_pairs(scenes=[1, 3], room=[4000, 6], dim=[2, 3], kernel=["quadratic", "cubic"]))
def test_a_large_domain_has_the_blocks_of_a_small_one(dim, kernel, scenes, room):
    """In the same slots, also where there is no room for all; activations do not see each other's tables."""
    state = drops(dim, scenes)
    small, large = (
        in_domain(width, dim, scenes, kernel=kernel)._activate(state.x, state.scene, None, room)
        for width in WIDTHS[dim]
    )
    again = large.grid._activate(state.x, state.scene, None, room)
    used = min(small.wanted, room)
    assert (small.wanted > room) == (room == 6)
    for blocks in (large, again):
        assert torch.equal(wide_blocks(blocks), wide_blocks(small))
        for name in ("offsets", "index", "status"):
            assert torch.equal(getattr(blocks, name), getattr(small, name)), name
        assert torch.equal(blocks.table[blocks.block[:used].long()], torch.arange(used, dtype=torch.int32))
        assert int((blocks.table != -1).sum()) == used
        blocks.table.fill_(3)  # its own


@pytest.mark.parametrize(*in_pairs(scenes=[1, 3], deterministic=[False, True], dim=[2, 3]))
def test_a_large_domain_moves_as_a_small_one(dim, scenes, deterministic):
    """Bit by bit, while particles go from block to block, in one op, step by step, and with gradients."""
    state = drops(dim, scenes)
    ends = []
    for width in WIDTHS[dim]:
        grid = in_domain(width, dim, scenes, deterministic=deterministic)
        step = mpm.Step(grid, mpm.NeoHookean(E=10.0, nu=0.3), gravity=(0.0,) * (dim - 1) + (-1.0,))
        with torch.no_grad():
            rolled = mpm.rollout(step, state, 60, 1e-3)
            for _ in range(5):
                rolled = step(rolled, 1e-3)
        before = grid.activate(state.x, state.scene).block.sort()[0]
        assert not torch.equal(before, grid.activate(rolled.x, rolled.scene).block.sort()[0])
        v = state.v.clone().requires_grad_()
        tracked = mpm.rollout(step, state.replace(v=v), 12, 1e-3)
        loss = tracked.x.nan_to_num().square().sum() + tracked.v.nan_to_num().square().sum()
        ends.append((rolled.x, rolled.v, rolled.C, rolled.F, tracked.x, torch.autograd.grad(loss, v)[0]))
    for small, large in zip(*ends, strict=True):
        assert torch.equal(small.nan_to_num(7.0), large.nan_to_num(7.0))


def test_a_domain_of_4096_cells_along_each_axis():
    """Takes memory for its particles, where the table of a thousand million blocks would take 4 GB."""
    g = torch.Generator().manual_seed(1)
    far = torch.tensor([[0.0, 0.0, 0.0], [2000.0, 3000.0, 1000.0], [4090.0, 4090.0, 4090.0]])
    x = (far.repeat_interleave(100, 0) + 1 + 4 * torch.rand(300, 3, generator=g)).double()
    ones = torch.ones(300, dtype=torch.float64)
    state = mpm.State(x=x, v=2 - x % 10, mass=ones, volume=0.1 * ones)
    grid = mpm.Grid(dx=1.0, lower=(0.0,) * 3, upper=(4096.0,) * 3)
    step = mpm.Step(grid, mpm.NeoHookean(E=100.0, nu=0.3), walls="sticky")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with torch.no_grad():
        end = step(mpm.rollout(step, state, 40, 0.01), 0.01)
        blocks = grid.activate(end.x)
    step.check(end)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak < 500_000  # [KB]
    assert len(blocks.table) == grid.block_count > 1e9
    active = blocks.block[: blocks.wanted].long()
    assert torch.equal(blocks.table[active], torch.arange(len(active), dtype=torch.int32))
    assert bool((blocks.table[active - 1].clamp_max(0) == (active - 1 == active.roll(1)).int() - 1).all())
    assert float((end.x - state.x).norm(dim=1).min()) > 0.1


@pytest.mark.thorough
def test_a_large_domain_after_descriptors_were_closed():
    """As daemons do: another file may have the number of that which large tables are mapped from."""
    program = """
import os, tempfile, torch, torch_mpm as mpm
def blocks():
    grid = mpm.Grid(dx=1 / 64, lower=(0,) * 3, upper=(16,) * 3)
    x = 8 + torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    found = grid.activate(x)
    return int((found.table >= 0).sum()), found.wanted
first = blocks()
os.closerange(3, 256)
files = [tempfile.TemporaryFile() for _ in range(20)]
assert first == blocks(), (first, blocks())
"""
    subprocess.run([sys.executable, "-c", program], check=True)
