"""What the ops take of an activation: packing, the rows of nodes, and particles in scenes that do not exist."""

import dataclasses

import pytest
import torch
from helpers import random_particles

import torch_mpm as mpm
from torch_mpm.topology import Topology


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
