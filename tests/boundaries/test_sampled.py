"""Shapes from samples of their distance: against what was sampled, and the kernel against torch operations."""

import pytest
import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.geometry import shapes
from torch_mpm.ops import contact
from torch_mpm.ops.contact import fusible


def ellipsoid(x: Tensor) -> Tensor:
    scale = torch.tensor([0.3, 0.2, 0.25], dtype=x.dtype, device=x.device)[: x.shape[1]]
    return ((x / scale).norm(dim=1) - 1) * 0.2


def sampled(dim: int, spacing: float = 0.05) -> shapes.Sampled:
    return shapes.Sampled.of(shapes.SDF(ellipsoid), (-0.5,) * dim, (0.5,) * dim, spacing)


def nodes(dim: int, device: str) -> tuple[mpm.Blocks, Tensor, Tensor]:
    grid = mpm.Grid(dx=0.07, lower=(0.0,) * dim, upper=(1.0,) * dim)
    x = torch.rand(400, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).to(device)
    blocks = grid.activate(x)
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64, device=device)
    return blocks, blocks.node_positions(torch.float64), velocity


def obstacle(dim: int, spacing: float = 0.05, kind: str = "separate", **options) -> mpm.boundaries.Obstacle:
    turn = {"rotation": 0.4, "angular_velocity": 1.0} if dim == 2 else {"rotation": (0.1, 0.4, 0.2)}
    motion = {"friction": 0.3, "velocity": (0.2, -0.1, 0.3)[:dim], **turn, **options}
    return mpm.boundaries.Obstacle(sampled(dim, spacing), (0.5,) * dim, kind, **motion)


@pytest.mark.parametrize("spacing", [0.05, 0.025, 0.0125])
def test_samples_are_as_far_off_as_the_spacing_says(spacing, dim):
    """Second order: h²/8 times the curvatures, which are below 2/0.2² here."""
    x = 0.8 * (torch.rand(2000, dim, dtype=torch.float64) - 0.5)
    shape = sampled(dim, spacing)
    error = (shape.surface(x)[0] - ellipsoid(x)).abs()
    away = x.norm(dim=1) > 0.1  # at the centre the distance has a kink
    assert float(error[away].max()) < 3 * spacing**2
    normal = shape.surface(x)[1]
    x.requires_grad_()
    (gradient,) = torch.autograd.grad(ellipsoid(x).sum(), x)
    turn = (normal - gradient / gradient.norm(dim=1, keepdim=True)).norm(dim=1)
    assert float(turn[away].max()) < 12 * spacing


TURNED = (0.6, -0.8, 0.5)
EXACT = {
    "sphere": lambda dim: shapes.Sphere(0.2),
    "box": lambda dim: shapes.Box((0.3, 0.5, 0.4)[:dim]),
    "capsule": lambda dim: shapes.Capsule((0.1, 0.12, -0.07)[:dim], 0.13),
    "revolved": lambda dim: shapes.Revolved(((0.0, -0.2), (0.2, -0.1), (0.05, 0.0), (0.2, 0.2)), TURNED[:dim]),
    "torus": lambda dim: shapes.Torus((0.1, 0.2, -0.07)[:dim], 0.1),
    "sdf": lambda dim: shapes.SDF(lambda x: x.norm(dim=1) - 0.2),
    "sampled": lambda dim: shapes.Sampled.of(shapes.Sphere(0.2), (-0.5,) * dim, (0.5,) * dim, 0.025),
}


@pytest.mark.parametrize("name", EXACT)
def test_distances_are_sampled_as_they_are(name, dim):
    """At the nodes to rounding, between them within half a diagonal of a cell: no distance is flattened."""
    exact, spacing = EXACT[name](dim), 0.05
    shape = shapes.Sampled.of(exact, (-0.5,) * dim, (0.5,) * dim, spacing)
    nodes = spacing * torch.randint(-10, 11, (200, dim), generator=torch.Generator().manual_seed(1)).double()
    torch.testing.assert_close(shape.signed_distance(nodes), exact.signed_distance(nodes), rtol=1e-9, atol=1e-12)
    x = torch.rand(2000, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) - 0.5
    error = (shape.signed_distance(x) - exact.signed_distance(x)).abs()
    assert float(error.max()) < 0.5 * dim**0.5 * spacing and float(error.median()) < 0.03 * spacing


def test_values_steeper_than_distances_are_flattened(dim):
    """By their slope, here along the diagonals: |x| + |y| (+ |z|) - 0.3 is steeper than a distance by √D."""
    steep = shapes.SDF(lambda x: x.abs().sum(1) - 0.3)
    flat = shapes.Sampled.of(steep, (-0.5,) * dim, (0.5,) * dim, 0.05)
    x = 0.05 * torch.tensor([[3, 5, -2], [1, -1, 3]], dtype=torch.float64)[:, :dim]
    ratio = steep.signed_distance(x) / flat.signed_distance(x)
    torch.testing.assert_close(ratio, torch.full_like(ratio, dim**0.5), rtol=1e-9, atol=0)


@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
def test_the_kernel_does_what_torch_operations_do(kind, dim, device):
    blocks, positions, velocity = nodes(dim, device)
    body = obstacle(dim, kind=kind)
    assert fusible(body, 0.1)
    expected = torch.where(blocks.active_nodes()[:, None], body(velocity, positions, None, 0.1, 0.0), velocity)
    found = contact(blocks, velocity, [body], 0.1)
    assert float((found - velocity).abs().max()) > 0.1
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


STEEP = {
    "values far steeper than a distance": (shapes.SDF(lambda x: 100 * ellipsoid(x)), 0.05),
    "an interpolant that is steeper than its values": (shapes.Sphere(0.1), 0.5),
}


@pytest.mark.parametrize("name", STEEP)
def test_no_node_inside_is_missed_by_the_test_of_blocks(name, dim, device):
    """Blocks are skipped by their distance; within a cell the slope may reach √D."""
    grid = mpm.Grid(dx=0.02, lower=(0.0,) * dim, upper=(1.0,) * dim)
    blocks = grid.activate(mpm.seed.box((0.3,) * dim, (0.7,) * dim, grid, 1, dtype=torch.float64, device=device).x)
    positions = blocks.node_positions(torch.float64)
    velocity = torch.ones_like(positions)
    steep = shapes.Sampled.of(STEEP[name][0], (-0.5,) * dim, (0.5,) * dim, STEEP[name][1])
    body = mpm.boundaries.Obstacle(steep, (0.5,) * dim, "sticky")
    inside = body.contains(positions, None, 0.0) & blocks.active_nodes()
    found = contact(blocks, velocity, [body], 0.0)
    assert inside.any() and torch.equal((found == 0).all(1) & blocks.active_nodes(), inside)


def test_gradients(dim, device):
    """Of motion and friction; no node lies where two cells of samples meet, at which the normal turns."""
    blocks, _, velocity = nodes(dim, device)
    weight = torch.randn_like(velocity)

    def loss(position: Tensor, rate: Tensor, friction: Tensor) -> Tensor:
        body = mpm.boundaries.Obstacle(sampled(dim), position, "separate", friction=friction, velocity=rate)
        return (weight * contact(blocks, velocity, [body], 0.1)).sum()

    position, rate = torch.tensor([0.4873, 0.5129, 0.5077])[:dim].double(), torch.full((dim,), 0.1, dtype=torch.float64)
    friction = torch.tensor(0.3, dtype=torch.float64)
    leaves = [t.to(device).requires_grad_() for t in (position, rate, friction)]
    nondet = 1e-10 if device == "cuda" else 0.0
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-7, atol=1e-5, nondet_tol=nondet)
    assert torch.autograd.gradgradcheck(loss, leaves, eps=1e-7, atol=1e-4, nondet_tol=nondet, fast_mode=True)


@pytest.mark.thorough
def test_a_rollout_around_a_sampled_mesh_goes_in_one_op(device):
    """And as with the mesh itself, to the spacing."""
    trimesh = pytest.importorskip("trimesh")
    mesh = shapes.Mesh(trimesh.creation.icosphere(1, 0.15))
    grid = mpm.Grid(dx=0.05, lower=(0.0,) * 3, upper=(1.0,) * 3)
    points = mpm.seed.box((0.3, 0.68, 0.3), (0.7, 0.8, 0.7), grid)
    ends = []
    for shape in (mesh, shapes.Sampled.of(mesh, (-0.3,) * 3, (0.3,) * 3, 0.0125)):
        body = mpm.boundaries.Obstacle(shape, (0.5, 0.5, 0.5), "separate", friction=0.2)
        step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), (0.0, -9.8, 0.0), boundaries=[body])
        state = mpm.State.at_rest(points, velocity=(0.0, -2.0, 0.0), dtype=torch.float64, device=device)
        assert (step.explain(state).startswith("all steps in one op")) == (shape is not mesh)
        with torch.no_grad():
            ends.append(mpm.rollout(step, state, 40, 5e-4))
    assert float((ends[0].v - ends[0].v.mean(0)).norm(dim=1).max()) > 0.5
    assert float((ends[0].x - ends[1].x).norm(dim=1).mean()) < 0.03 * grid.dx


def test_bad_samples():
    good = sampled(2).values
    for values, lower, spacing, message in (
        ([1.0], (0, 0), 1.0, "values must be a tensor"),
        (good[0], (0, 0), 1.0, "values must be a tensor"),
        (good, (0, 0, 0), 1.0, "lower"),
        (good, (0, 0), -1.0, "spacing must be positive"),
        (good * float("nan"), (0, 0), 1.0, "values must be finite"),
        (-good, (0, 0), 1.0, "positive on the border"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            shapes.Sampled(values, lower, spacing)


def test_numbers_that_are_no_samples_touch_nothing(device):
    """The raw op, whose data only the device can read."""
    blocks, _, velocity = nodes(2, device)
    table = torch.zeros(1, 1, 10, dtype=torch.float64, device=device)
    for numbers in ([0.0, 0.0], [0.0, 0.0, 1.0, 1e9, 1e9, -1.0], [0.0, 0.0, 1.0, float("nan"), 2.0, -1.0]):
        data = torch.tensor(numbers, dtype=torch.float64, device=device)
        rest = ([5], [len(numbers)], [1], [-1], [0.0], [1.0], None, 0.5, *blocks.packed)
        rows = torch.ops.torch_mpm.contact(velocity, table, data, *rest)
        assert torch.equal(rows[:, 1:], velocity)
