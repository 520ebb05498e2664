"""Forms and values of parameters of obstacles and shapes, and of gravity: one reading of all forms, wrong values."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import shapes

F64 = torch.float64
NAN, INF = math.nan, math.inf
WAYS = ("constructor", "assigned", "path")


def columns(rows: list[list[float]]) -> list[list[float]]:
    return [list(column) for column in zip(*rows, strict=True)]


SCENES: dict[str, Callable[[list[list[float]]], Any]] = {
    "tensor": lambda rows: torch.tensor(rows, dtype=F64),
    "array": lambda rows: np.array(rows),
    "array of float32": lambda rows: np.array(rows, dtype=np.float32),
    "list of lists": lambda rows: rows,
    "tuple of tuples": lambda rows: tuple(map(tuple, rows)),
    "arrays": lambda rows: tuple(np.array(c) for c in columns(rows)),
    "list of arrays": lambda rows: [np.array(c) for c in columns(rows)],
    "tensors": lambda rows: tuple(torch.tensor(c, dtype=F64) for c in columns(rows)),
    "arrays and tensors": lambda rows: (
        *(np.array(c) for c in columns(rows)[:-1]),
        torch.tensor(columns(rows)[-1], dtype=F64),
    ),
    "arrays and a number": lambda rows: (*(np.array(c) for c in columns(rows)[:-1]), rows[0][-1]),
    "tensors and a number": lambda rows: (*(torch.tensor(c) for c in columns(rows)[:-1]), rows[0][-1]),
    "rows of tensors": lambda rows: [[torch.tensor(a, dtype=F64) for a in row] for row in rows],
}
"""Values [B, D] whose last component is the same in all scenes."""
SINGLE: dict[str, Callable[[list[float]], Any]] = {
    "tuple": tuple,
    "list": list,
    "array": np.array,
    "numbers of NumPy": lambda row: [np.float32(a) for a in row],
    "arrays []": lambda row: tuple(np.array(a) for a in row),
    "tensors []": lambda row: [torch.tensor(a, dtype=F64) for a in row],
    "a tensor and numbers": lambda row: (torch.tensor(row[0], dtype=F64), *row[1:]),
    "a whole tensor and numbers": lambda row: (torch.tensor(int(row[0])), *row[1:]),
}
"""Values [D] whose first component is a whole number."""


NUMBERS_OF_SCENES = {name: make for name, make in SCENES.items() if name == "tensor" or "tensor" not in name}
"""Those without tensors in a list, which paths alone may return."""


def refuses_tensors_in_a_list(form: str, way: str, value: Any) -> bool:
    if way == "path" or form == "tensor" or "tensor" not in form:
        return False
    with pytest.raises(TypeError, match="position must be numbers or one tensor, got tensors in a list: stack them"):
        moved(way, value)
    return True


def moved(way: str, value: Any) -> mpm.Obstacle:
    if way == "path":
        return mpm.Sphere(lambda t: value, 0.1)
    ball = mpm.Sphere((0.0,) * 3 if way == "assigned" else value, 0.1)
    ball.position = value
    return ball


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("form", SCENES)
@pytest.mark.parametrize("scenes", [1, 2, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_positions_of_scenes(dim, scenes, form, way):
    """Also where there are as many scenes as components."""
    rows = [[1.0 + k, 10.0 + 3 * k, 7.0][-dim:] for k in range(scenes)]
    if refuses_tensors_in_a_list(form, way, SCENES[form](rows)):
        return
    centre = moved(way, SCENES[form](rows)).centre_at(0.0, torch.empty(0, dtype=F64))
    torch.testing.assert_close(centre, torch.tensor(rows, dtype=F64))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("form", SINGLE)
@pytest.mark.parametrize("dim", [2, 3])
def test_a_position(dim, form, way):
    row = [1.0, 0.5, 0.25][:dim]
    if refuses_tensors_in_a_list(form, way, SINGLE[form](row)):
        return
    centre = moved(way, SINGLE[form](row)).centre_at(0.0, torch.empty(0, dtype=F64))
    torch.testing.assert_close(centre, torch.tensor(row, dtype=F64))


@pytest.mark.parametrize("form", NUMBERS_OF_SCENES)
@pytest.mark.parametrize("name", ["velocity", "rotation", "angular_velocity"])
def test_motions_of_scenes(name, form):
    rows = [[0.1, 0.2, -0.4], [0.3, 0.5, -0.4], [0.7, -0.1, -0.4]]
    like = torch.empty(0, dtype=F64)
    for ball in (mpm.Sphere((0, 0, 0), 0.1, **{name: SCENES[form](rows)}), mpm.Sphere((0, 0, 0), 0.1)):
        setattr(ball, name, SCENES[form](rows))
        torch.testing.assert_close(ball.parameter(name, like, (3,)), torch.tensor(rows, dtype=F64))
        ball.check_scenes(3, 3)
        with pytest.raises(ValueError, match=rf"{name} must be given once or per scene, .* B = 2, got \[3, 3\]"):
            ball.check_scenes(3, 2)


@pytest.mark.parametrize("form", NUMBERS_OF_SCENES)
@pytest.mark.parametrize("name", ["normal", "size", "half_axis", "ring"])
def test_directions_and_sizes_of_scenes(name, form):
    rows = [[0.1, 0.2, 0.4], [0.3, 0.5, 0.4], [0.7, 0.1, 0.4]]
    make = {"normal": shapes.Plane, "size": shapes.Box}.get(name)
    value = SCENES[form](rows)
    shape = make(value) if make else shapes.Capsule(value, 0.1) if name == "half_axis" else shapes.Torus(value, 0.1)
    points = torch.randn(30, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    scene = torch.arange(30, dtype=torch.int32) % 3
    single = [type(shape)(rows[k], *([0.1] if name in ("half_axis", "ring") else [])) for k in range(3)]
    expected = torch.stack([single[k].signed_distance(x[None])[0] for k, x in zip(scene, points, strict=True)])
    torch.testing.assert_close(shape.signed_distance(points, scene), expected)


NUMBERS = (np.array([0.1, 0.3]), [0.1, 0.3], torch.tensor([0.1, 0.3]))


@pytest.mark.parametrize("value", NUMBERS, ids=["array", "list", "tensor"])
def test_numbers_of_scenes(value, device):
    """Friction of a floor: a block at rest on it that slides at v loses at most μ times the stopped velocity."""
    value = value.to(device) if isinstance(value, Tensor) else value
    velocity = torch.tensor([[1.0, -2.0], [1.0, -2.0]], dtype=F64, device=device)
    scene = torch.tensor([0, 1], dtype=torch.int32, device=device)
    floor = mpm.Plane((0.0, 0.0), (0.0, 1.0), friction=value)
    after = floor(velocity, torch.full_like(velocity, -0.01), scene, 0.0, 1e-3)
    torch.testing.assert_close(after.cpu().double(), torch.tensor([[0.8, 0.0], [0.4, 0.0]], dtype=F64))
    ball = mpm.Sphere((0.0, 0.0), value)
    distance = ball.signed_distance(torch.ones_like(velocity), scene, 0.0)
    torch.testing.assert_close(distance.cpu().double(), math.sqrt(2) - torch.tensor([0.1, 0.3], dtype=F64))


@pytest.mark.parametrize("form", ["arrays", "tensors", "arrays and a number", "list of lists"])
def test_paths_of_scenes_push_alike(form, device):
    """Two scenes in two dimensions: the ball of the first scene meets the block, the other one does not."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1), scenes=2)
    body = mpm.State.at_rest(mpm.seed.box((0.4, 0.3), (0.6, 0.6), 0.1, per_cell=4), 1000.0, dtype=F64)
    bodies = mpm.State.concatenate([body, body], scene=True).to(device=device)

    def pushed(path: Any) -> Tensor:
        step = mpm.Step(grid, mpm.NeoHookean(E=3e4, nu=0.3), boundaries=[mpm.Sphere(path, 0.1)])
        return mpm.rollout(step, bodies, 20, 1e-3).v

    def path(t: Tensor) -> Any:
        value = SCENES[form]([[0.32 + float(t.reshape(-1)[0]), 0.45], [0.1, 0.45]])
        return [v.to(device) for v in value] if form == "tensors" else value

    v = pushed(path)
    first = torch.stack([torch.tensor([0.32, 0.45], dtype=F64), torch.tensor([0.1, 0.45], dtype=F64)]).to(device)
    rate = torch.tensor([[1.0, 0.0], [0.0, 0.0]], dtype=F64, device=device)
    torch.testing.assert_close(v, pushed(lambda t: first + rate * t.reshape(-1)[0]), rtol=1e-8, atol=1e-8)
    assert float(v[bodies.scene == 0, 0].mean()) > 0.1
    assert float(v[bodies.scene == 1].abs().max()) < 1e-12


def test_components_are_differentiable():
    x = torch.tensor([0.3, 0.4], dtype=F64, requires_grad=True)
    ball = mpm.Sphere(lambda t: (x, 0.5), 0.1)
    ball.centre_at(0.0, torch.empty(0, dtype=F64))[1, 0].backward()
    assert x.grad.tolist() == [0.0, 1.0]


def test_lists_and_arrays_are_read_anew():
    rows, array = [[0.1, 0.2], [0.3, 0.4]], np.array([0.1, 0.2])
    balls = mpm.Sphere((0, 0), 0.1), mpm.Sphere((0, 0), 0.1)
    balls[0].position, balls[1].position = rows, array
    like = torch.empty(0, dtype=F64)
    for ball in balls:
        ball.centre_at(0.0, like)
    rows[1][0], array[1] = 0.9, 0.7
    assert [ball.centre_at(0.0, like).tolist() for ball in balls] == [[[0.1, 0.2], [0.9, 0.4]], [0.1, 0.7]]
    array[1] = NAN
    with pytest.raises(ValueError, match="position must be finite"):
        balls[1].centre_at(0.0, like)


@pytest.mark.parametrize("form", [list, np.array, tuple])
def test_outlines_in_either_order(form):
    """A clockwise outline is the same polygon, also where it is assigned."""
    corners = [(0.0, -0.5), (0.3, -0.5), (0.3, 0.5), (0.0, 0.5)]
    points = torch.tensor([[0.1, 0.2, 0.0], [0.5, 0.1, 0.0], [-0.4, 0.7, 0.0]], dtype=F64)
    expected = torch.tensor([-0.2, 0.2, math.hypot(0.1, 0.2)], dtype=F64)
    for outline in (corners, corners[::-1]):
        tube = shapes.Revolved([(0, 0), (1, 0), (1, 1)])
        tube.outline = form(outline)
        for shape in (tube, shapes.Revolved(form(outline))):
            torch.testing.assert_close(shape.signed_distance(points), expected)


GRAVITY = {k: v for k, v in NUMBERS_OF_SCENES.items() if k != "array of float32"}


@pytest.mark.parametrize("form", GRAVITY)
def test_gravity_of_scenes(form, device):
    """A free body falls with g dt."""
    rows = [[0.5, -2.0], [-0.5, -2.0]]
    value = GRAVITY[form](rows)
    if isinstance(value, Tensor):
        value = value.to(device)
    grid = mpm.Grid(0.1, (0, 0), (1, 1), scenes=2)
    body = mpm.State.at_rest(mpm.seed.box((0.4, 0.3), (0.6, 0.6), 0.1), 1000.0, dtype=F64, device=device)
    step = mpm.Step(grid, mpm.NeoHookean(E=3e4, nu=0.3), gravity=value)
    end = mpm.rollout(step, mpm.State.concatenate([body, body], scene=True), 4, 1e-3)
    for k in range(2):
        assert end.v[end.scene == k].mean(0).tolist() == pytest.approx([4e-3 * a for a in rows[k]])


@pytest.mark.parametrize("value", [torch.tensor([[0.0, -9.8]]), np.array([[0.0, -9.8]]), [[0.0, -9.8]]])
@pytest.mark.parametrize("scenes", [1, 3])
def test_gravity_given_once(scenes, value):
    grid = mpm.Grid(0.1, (0, 0), (1, 1), scenes=scenes)
    body = mpm.State.at_rest(mpm.seed.box((0.4, 0.3), (0.6, 0.6), 0.1), 1000.0)
    step = mpm.Step(grid, mpm.NeoHookean(E=3e4, nu=0.3), gravity=value)
    end = mpm.rollout(step, mpm.State.concatenate([body] * scenes, scene=True), 2, 1e-3)
    assert end.v[:, 1].tolist() == pytest.approx([-2 * 9.8e-3] * len(end.v))
    torch.testing.assert_close(step(end, 1e-3).v[:, 1].mean(), torch.tensor(-3 * 9.8e-3))


# ---- wrong values


def ball(**given: Any) -> mpm.Sphere:
    return mpm.Sphere(**{"position": (0.3, 0.3), "radius": 0.1, **given})


def gravity_of(v: Any) -> mpm.Step:
    return mpm.Step(mpm.Grid(0.1, (0, 0), (1, 1)), mpm.NeoHookean(E=1e4, nu=0.3), gravity=v)


VECTOR = [(0.1, NAN), (INF, 0.1)]
SIZE = [*VECTOR, (-0.1, 0.2)]
LENGTH = [NAN, INF, -0.1]
ANGLE = [NAN, -INF]
ZERO = [*VECTOR, (0.0, 0.0), ((0.0, 1.0), (0.0, 0.0))]
WRONG: dict[str, tuple[Callable[[Any], Any], str, list[Any]]] = {
    "position": (lambda v: ball(position=v), "position", VECTOR),
    "velocity": (lambda v: ball(velocity=v), "velocity", VECTOR),
    "rotation": (lambda v: ball(rotation=v), "rotation", ANGLE),
    "angular velocity": (lambda v: ball(angular_velocity=v), "angular_velocity", ANGLE),
    "friction": (lambda v: ball(friction=v), "friction", LENGTH),
    "radius": (lambda v: ball(radius=v), "radius", LENGTH),
    "normal": (lambda v: mpm.Plane((0, 0), v), "normal", ZERO),
    "size": (lambda v: mpm.Box((0, 0), v), "size", SIZE),
    "half axis": (lambda v: mpm.Capsule((0, 0), v, 0.1), "half_axis", VECTOR),
    "radius of a capsule": (lambda v: mpm.Capsule((0, 0), (0.1, 0.1), v), "radius", LENGTH),
    "ring": (lambda v: shapes.Torus(v, 0.1), "ring", ZERO[:3]),
    "radius of a torus": (lambda v: shapes.Torus((0.0, 0.3), v), "radius", [*LENGTH, 0.3]),
    "axis": (lambda v: mpm.Revolved((0, 0), ((0, 0), (1, 0), (1, 1)), v), "axis", ZERO),
    "outline": (
        lambda v: mpm.Revolved((0, 0), v),
        "outline",
        [((0, 0), (1, 0), (1, NAN)), ((-0.1, 0), (1, 0), (1, 1)), ((0, 0), (1, 0), (2, 0)), ((0, 0), (1, 0))],
    ),
    "gravity": (gravity_of, "gravity", VECTOR),
    "direction": (lambda v: mpm.Active(mpm.NeoHookean(E=1e4, nu=0.3), v), "direction", VECTOR),
    "place": (lambda v: ball().place(v), "position", VECTOR),
    "turn": (lambda v: ball().place(None, v), "rotation", ANGLE),
    "waypoints": (lambda v: mpm.Waypoints((0.0, 1.0), v), r"position(\[1\])?", [((0.0, 0.0), (0.0, NAN))]),
    "times of waypoints": (lambda v: mpm.Waypoints(v, ((0, 0), (1, 1))), "time", [(0.0, NAN), (1.0, 0.0)]),
    "flux": (lambda v: mpm.heat_boundaries.Flux(mpm.heat_boundaries.FreeSurface(), v), "flux", ANGLE),
}
ASSIGNED = ("position", "velocity", "rotation", "angular_velocity", "friction", "radius")


@pytest.mark.parametrize("form", [lambda v: v, torch.tensor, lambda v: torch.tensor(v).requires_grad_(False).double()])
@pytest.mark.parametrize("case", WRONG)
def test_wrong_values(case, form):
    make, name, values = WRONG[case]
    for value in values:
        with pytest.raises(ValueError, match=rf"\b{name}\b.* must "):
            make(form(value))


@pytest.mark.parametrize("form", [lambda v: v, np.array, torch.tensor])
@pytest.mark.parametrize("name", ASSIGNED)
def test_wrong_values_that_are_assigned(name, form):
    body = ball(velocity=(0.0, 0.0), rotation=0.1, angular_velocity=0.2)
    before = getattr(body, name)
    for value in WRONG[name.replace("_", " ")][2]:
        with pytest.raises(ValueError, match=rf"^{name} must be"):
            setattr(body, name, form(value))
    assert getattr(body, name) is before


@pytest.mark.parametrize("make", [lambda v: moved("constructor", v), lambda v: moved("path", v).pose(0.0)])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        ((np.zeros(3), np.zeros(2)), r"position must have components of shape \[\] or \[B\], got \[3\], \[2\]"),
        ([[0.1, 0.2], [0.3]], r"position must have one list of D numbers for each scene, got \[2\], \[1\]"),
        ([[0.1, 0.2], 0.3], "position must have one list of D numbers for each scene"),
        (({"x": 1}, 2), "position must be numbers in an order, got dict"),
        (np.array(["a", "b"]), "position must be numbers, got an array of"),
        ([None, 1.0], "position must be a number, got NoneType"),
        ({0.1, 0.2}, "position must be numbers in an order, got set"),
    ],
)
def test_messages(make, value, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make(value)


def test_values_are_not_read_inside_transforms():
    """Construction and assignment inside a transform of torch.func or a compiled function."""

    def height(p: Tensor) -> Tensor:
        body = mpm.Sphere(p, 0.1, velocity=(0.0, 0.0))
        body.velocity = p
        return body.signed_distance(torch.tensor([[1.0, 0.0]], dtype=F64), None, 0.0)[0]

    p = torch.tensor([0.5, 0.0], dtype=F64)
    torch.testing.assert_close(torch.func.grad(height)(p), torch.tensor([-1.0, 0.0], dtype=F64))
    torch.testing.assert_close(torch.vmap(height)(torch.stack([p, 0.5 * p])), torch.tensor([0.4, 0.65], dtype=F64))
