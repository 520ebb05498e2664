"""Shapes: distance, normal, volume, bounds and mesh of one against each other, and against brute force."""

import math
import textwrap
import types

import numpy as np
import pytest
import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.boundaries import Obstacle
from torch_mpm.geometry import shapes
from torch_mpm.geometry.seed import Region

VASE = ((0.1, -0.5), (0.6, -0.4), (0.3, 0.1), (0.7, 0.5), (0.15, 0.45))
REACH = 1.3


def bounded(dim: int) -> list[shapes.Shape]:
    """One of every shape that has a volume."""
    axis = (0.3, 0.8, -0.2)[:dim]
    made = [
        shapes.Sphere(0.6),
        shapes.Box((0.9, 0.5, 1.2)[:dim]),
        shapes.Capsule(axis, 0.3),
        shapes.Revolved(VASE, axis),
        shapes.Revolved(VASE),
        shapes.Torus(axis, 0.3),
    ]
    return made + ([shapes.Cylinder(axis, 0.4)] if dim == 3 else [])


def sample(dim: int, count: int) -> Tensor:
    generator = torch.Generator().manual_seed(7)
    return REACH * (2 * torch.rand(count, dim, generator=generator, dtype=torch.float64) - 1)


def on_surface(pieces: list, count: int) -> Tensor:
    """At least `count` points of each piece of a surface."""
    points = []
    for vertices, faces in pieces:
        corners = vertices[faces] if faces is not None else np.stack([vertices, np.roll(vertices, -1, 0)], 1)
        rng = np.random.default_rng(1)
        weights = rng.dirichlet(np.ones(corners.shape[1]), (-(-count // len(corners)), len(corners)))
        points.append(np.einsum("ctk,tkd->ctd", weights, corners).reshape(-1, vertices.shape[1]))
    return torch.from_numpy(np.concatenate(points))


def test_volume_is_the_share_of_points_inside(dim):
    x = sample(dim, 200_000)
    for shape in bounded(dim):
        share = float(shape.contains(x).double().mean())
        volume = (2 * REACH) ** dim
        error = 4 * (share * (1 - share) / len(x)) ** 0.5 * volume
        assert abs(share * volume - shape.volume(dim)) < error, shape.name


def test_bounds_are_the_smallest_box(dim):
    for shape in bounded(dim):
        lower, upper = shape.bounds(dim)
        points = on_surface(shape.mesh(np.full(dim, -1.0), np.full(dim, 1.0)), 1000)
        vertices = np.concatenate([piece.vertices for piece in shape.mesh(np.full(dim, -1.0), np.full(dim, 1.0))])
        assert ((points >= lower - 1e-12) & (points <= upper + 1e-12)).all(), shape.name
        # Round bodies are drawn by 64 flat sides.
        np.testing.assert_allclose(vertices.min(0), lower, atol=2e-3)
        np.testing.assert_allclose(vertices.max(0), upper, atol=2e-3)
    assert shapes.Plane((0.0, 1.0, 0.0)[:dim]).volume(dim) == np.inf


def test_distance_is_that_to_the_surface(dim):
    """Away from the surface too: to the nearest of many points of the mesh."""
    x = sample(dim, 300)
    for shape in bounded(dim):
        spread = on_surface(shape.mesh(np.full(dim, -1.0), np.full(dim, 1.0)), 2000 if dim == 2 else 12_000)
        distance, _ = shape.surface(x)
        nearest = torch.cdist(x, spread).amin(1)
        assert (nearest > distance.abs() - 5e-3).all() and (nearest < distance.abs() + 0.12).all(), shape.name
        assert torch.equal(distance <= 0, shape.contains(x))


def test_normal_is_the_gradient_of_the_distance_inside(dim):
    x = sample(dim, 2000).requires_grad_()
    for shape in [*bounded(dim), shapes.Plane((0.3, -1.0, 0.2)[:dim])]:
        distance, normal = shape.surface(x)
        (gradient,) = torch.autograd.grad(distance.sum(), x)
        inside = distance < 0
        agree = (normal - gradient).norm(dim=1)[inside] < 1e-10
        corner = 0.85 if shape.name == "revolved" else 1.0  # from a reentrant corner the normal is that of an edge
        assert agree.double().mean() >= corner, shape.name
        assert inside.sum() > 30


def test_parameters_of_each_scene(dim):
    radius = torch.tensor([0.2, 0.5], dtype=torch.float64)
    x, scene = sample(dim, 50), torch.arange(50) % 2
    both, _ = shapes.Sphere(radius).surface(x, scene)
    for b in range(2):
        alone = shapes.Sphere(float(radius[b]))
        torch.testing.assert_close(both[scene == b], alone.surface(x)[0][scene == b], rtol=0, atol=1e-15)
        assert shapes.Sphere(radius).volume(dim, b) == alone.volume(dim)
        assert torch.equal(shapes.Sphere(radius).bounds(dim, b)[1], alone.bounds(dim)[1])


def test_a_mesh_is_the_body_that_it_bounds():
    trimesh = pytest.importorskip("trimesh")
    mesh = shapes.Mesh(trimesh.creation.box((0.9, 0.5, 1.2)))
    box = shapes.Box((0.9, 0.5, 1.2))
    x = sample(3, 500).requires_grad_()
    (distance, normal), (expected, _) = mesh.surface(x), box.surface(x)
    torch.testing.assert_close(distance, expected, rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(expected.sum(), x)
    torch.testing.assert_close(normal, gradient, rtol=0, atol=1e-9)
    assert mesh.volume(3) == pytest.approx(box.volume(3), rel=1e-12)
    velocity = torch.ones_like(x)
    after = [Obstacle(s, (0.1, 0.0, 0.0), "slip").apply(velocity, x.detach(), None, 0.0, 0.1) for s in (mesh, box)]
    torch.testing.assert_close(after[0], after[1], rtol=0, atol=1e-9)


def test_any_shape_is_filled():
    vase = Region(shapes.Revolved(VASE, (0.0, 0.0, 1.0)), (1.0, 2.0, 3.0))
    points = mpm.seed.fill(vase, 0.1, dtype=torch.float64)
    assert float(points.volume.sum()) == pytest.approx(vase.shape.volume(3), rel=1e-12)
    assert len(points) * 0.1**3 / 8 == pytest.approx(vase.shape.volume(3), rel=0.02)
    assert vase.shape.contains(points.x - vase.position).all()
    with pytest.raises(NotImplementedError, match="the bounds of a sdf are not known"):
        Region(shapes.SDF(lambda x: x.norm(dim=1) - 1), (0.0, 0.0))


def test_the_shape_of_the_docstring():
    """It acts as an obstacle, and its distance is that to a tube."""
    text = shapes.__doc__.split("\n\n")[2]
    namespace = {"torch": torch, "Shape": shapes.Shape, "norm": mpm.vectors.norm, "unit": mpm.vectors.unit}
    exec(textwrap.dedent(text), namespace)
    tube = namespace["Tube"](0.6, 0.2)
    x = sample(3, 1000).requires_grad_()
    distance, normal = tube.surface(x)
    outer = shapes.Revolved(((0.5, -9.0), (0.7, -9.0), (0.7, 9.0), (0.5, 9.0)))
    torch.testing.assert_close(distance, outer.surface(x)[0], rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    torch.testing.assert_close(normal, gradient, rtol=0, atol=1e-10)
    stopped = Obstacle(tube, (0.0, 0.0, 0.0), "sticky").apply(torch.ones_like(x), x.detach(), None, 0.0, 0.1) == 0
    assert torch.equal(stopped.all(1), distance <= 0)


def test_a_subclass_declares_its_own_surface():
    """What a kernel, a scene file or a search for edges knows of a shape does not hold for another surface."""

    class Cap(shapes.Sphere):
        name = "cap"

        def surface(self, x, scene=None):
            return x[:, 1] - 0.1, torch.tensor([[0.0, 1.0]], dtype=x.dtype).expand_as(x)

    cap = Cap(0.5)
    assert (cap.number, cap.words, cap.is_smooth, cap.is_convex) == (None, None, False, False)
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0))
    points = mpm.seed.Points(torch.tensor([[0.5, 0.55]], dtype=torch.float64), torch.tensor([0.01]).double())
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[Obstacle(cap, (0.5, 0.5), "sticky")])
    moving = mpm.State.at_rest(points, 1000.0, velocity=(1.0, -1.0))
    assert step(moving, 1e-3).v.abs().max() < 1e-12


def test_a_torus_is_thinner_than_its_ring():
    with pytest.raises(ValueError, match=r"radius must be below that of the circle, 0\.5 m, got 0\.5"):
        shapes.Torus((0.0, 0.5), 0.5)
    with pytest.raises(ValueError, match="ring must not be zero"):
        shapes.Torus((0.0, 0.0), 0.5)


def test_an_axis_of_zero_in_a_scene_file():
    schema = pytest.importorskip("torch_mpm.scene.schema")
    for name in ("torus", "revolved", "plane"):
        words = schema.OBSTACLE_WORDS[name].keys
        given = {key: (0.0, 0.0) if kind.kind in ("point", "vector") else 0.1 for key, kind in words.items()}
        with pytest.raises(ValueError, match=r"(axis|normal) must not be zero"):
            shape = schema.OBSTACLE_SHAPES[name]
            shape.from_words(types.SimpleNamespace(**given | ({"outline": VASE} if name == "revolved" else {})))


def test_messages():
    with pytest.raises(TypeError, match=r"shape must be a shape of torch_mpm\.shapes, got float"):
        Obstacle(0.3, (0.0, 0.0))
    with pytest.raises(ValueError, match="a cylinder needs three dimensions"):
        shapes.Cylinder((0.0, 1.0), 0.1)
    with pytest.raises(ValueError, match="radius must be positive, got 0"):
        shapes.Cylinder((0.0, 1.0, 0.0), 0.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_distance_alone(dim, device):
    """Without the normal it is the same, from shapes with a way of their own to it and from others."""
    x = 2 * torch.rand(200, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).to(device) - 1
    ring = shapes.SDF(lambda x: (x.square().sum(1).sqrt() - 0.5).abs() - 0.1)
    for shape in [*bounded(dim), ring, shapes.Sampled.of(ring, (-1.0,) * dim, (1.0,) * dim, 0.1)]:
        distance, _ = shape.surface(x)
        assert torch.allclose(shape.signed_distance(x), distance, rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match=r"distance and normal of an SDF must have shape"):
        shapes.SDF(lambda x: x).signed_distance(x)


def test_gradient_of_the_distance_from_a_box(device):
    """On a face it is the normal, also if only the distance is computed; with a NaN pose there is no contact."""
    box = shapes.Box((1.0, 1.0))
    x = torch.tensor([[0.5, 0.1]], dtype=torch.float64, device=device).requires_grad_()
    (gradient,) = torch.autograd.grad(box.signed_distance(x).sum(), x)
    assert gradient.tolist() == [[1.0, 0.0]]
    hessian = torch.func.hessian(lambda p: box.signed_distance(p[None])[0])(x.detach()[0] + 0.3)
    assert bool(hessian.isfinite().all())
    found = box.signed_distance(torch.tensor([[0.5, math.nan]], device=device))
    assert bool(found.isnan().all())
    apart = torch.rand(50, 3, dtype=torch.float64, device=device) * 3 - 1.5
    solid = shapes.Box((1.0, 0.6, 1.4))
    with_graph = solid.signed_distance(apart.clone().requires_grad_()).detach()
    assert torch.allclose(solid.signed_distance(apart), with_graph, rtol=0, atol=1e-15)
