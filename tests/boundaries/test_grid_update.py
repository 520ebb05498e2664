"""The grid update against the plain-torch reference, closed forms, and finite differences."""

import dataclasses
import math

import pytest
import torch
from helpers import random_blocks, random_nodes, relative_error
from oracle.grid_update import grid_update as reference
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.ops import grid_update

INSET = {
    2: mpm.Walls([("separate", "sticky"), ("slip", "open")], (0.15, 0.2), (0.61, 0.7), [(0.3, 0.0), 0.2]),
    3: mpm.Walls(["slip", ("separate", "open"), ("open", "sticky")], (0.1,) * 3, (0.3,) * 3, 0.25),
}
MIXED = {  # mirrors on nodes and between them, and contact with friction on the other faces
    2: mpm.Walls([("mirror", "separate"), ("mirror", "mirror")], (0.15, 0.1), (0.9, 0.75), [(0.0, 0.3), 0.0]),
    3: mpm.Walls(["mirror", ("slip", "mirror"), ("open", "mirror")], (0.05, 0.0, 0.0), (0.55, 0.5, 0.45)),
}
WALLS = ["none", "slip", "separate", "sticky", "friction", "inset", "mirror", "mixed"]


def walls_named(name: str, dim: int) -> mpm.Walls | None:
    if name in ("none", "inset", "mixed"):
        return {"none": None, "inset": INSET[dim], "mixed": MIXED[dim]}[name]
    return mpm.Walls("separate", friction=0.4) if name == "friction" else mpm.Walls(name)


def grid_of(dim: int, scenes: int = 3) -> mpm.Grid:
    return mpm.Grid(dx=0.1, lower=(0.0,) * dim, upper=(1.0, 0.8)[:dim] if dim == 2 else (0.6, 0.5, 0.5), scenes=scenes)


def inputs(dim: int, device: str, scenes: int = 3) -> tuple[mpm.Blocks, Tensor, Tensor, Tensor]:
    blocks = random_blocks(grid_of(dim, scenes), device)
    gravity = torch.randn(scenes, dim, dtype=torch.float64).to(device)
    dt = 0.5 + torch.rand(scenes, dtype=torch.float64).to(device)
    return blocks, random_nodes(blocks), gravity, dt


def updated(
    blocks: mpm.Blocks, nodes: Tensor, gravity: Tensor | None, dt: Tensor | None, walls: mpm.Walls | None
) -> Tensor:
    faces = () if walls is None else walls.faces(blocks.grid)
    return reference(blocks, nodes, gravity, dt, faces)[:, 1:]


def assert_close(value: Tensor, expected: Tensor, tolerance: float) -> None:
    assert relative_error(value, expected) <= tolerance


# ---- values


@pytest.mark.parametrize(*in_pairs(name=WALLS, scenes=[1, 3], dim=[2, 3]))
def test_velocity_is_the_reference(device, dim, name, scenes):
    blocks, nodes, gravity, dt = inputs(dim, device, scenes)
    walls = walls_named(name, dim)
    expected = updated(blocks, nodes, gravity, dt, walls)
    assert_close(grid_update(blocks, nodes, gravity, dt, walls), expected, 1e-14)
    assert_close(grid_update(blocks, nodes.float(), gravity.float(), dt.float(), walls), expected, 3e-7)


def test_without_walls_and_gravity_momentum_stays(device, dim):
    blocks, nodes, _, _ = inputs(dim, device)
    velocity = grid_update(blocks, nodes)
    assert_close(nodes[:, :1] * velocity, nodes[:, 1:], 1e-14)
    empty = nodes[:, 0] == 0
    assert empty.any() and (velocity[empty] == 0).all()


def test_rows_without_mass_or_block_are_zero(device, dim):
    blocks, nodes, gravity, dt = inputs(dim, device)
    nodes[:, 1:] += 1.0  # momentum without mass, and rubbish in unused rows
    nodes[~blocks.active_nodes()] = float("nan")
    velocity = grid_update(blocks, nodes, gravity, dt, mpm.Walls("separate"))
    assert (velocity[(nodes[:, 0] == 0) | ~blocks.active_nodes()] == 0).all()
    assert velocity.isfinite().all()


def test_gravity_and_dt_of_each_scene(device, dim):
    blocks, nodes, gravity, dt = inputs(dim, device)
    change = grid_update(blocks, nodes, gravity, dt) - grid_update(blocks, nodes)
    scene = blocks.node_scene().long()
    heavy = nodes[:, 0] > 0
    assert_close(change[heavy], (dt[:, None] * gravity)[scene[heavy]], 1e-14)
    shared = grid_update(blocks, nodes, gravity[0], 0.25) - grid_update(blocks, nodes)
    assert_close(shared[heavy], (0.25 * gravity[0]).expand(int(heavy.sum()), dim), 1e-14)


def one_node(velocity: list[float], walls: mpm.Walls, at: list[float], dtype: torch.dtype = torch.float64) -> Tensor:
    """Velocity after the update of the node at a position, all nodes having the given velocity and mass 2."""
    dim = len(velocity)
    blocks = random_blocks(mpm.Grid(dx=0.1, lower=(0.0,) * dim, upper=(1.0,) * dim), share=1.0)
    row = torch.tensor([2.0] + [2.0 * v for v in velocity], dtype=dtype)
    nodes = torch.where(blocks.active_nodes()[:, None], row, 0)
    row_number = (blocks.node_positions(torch.float64) - torch.tensor(at)).norm(dim=1).argmin()
    return grid_update(blocks, nodes, walls=walls)[row_number]


@pytest.mark.parametrize(
    ("kind", "velocity", "expected"),
    [
        ("sticky", [-3.0, 1.0], [0.0, 0.0]),
        ("slip", [-3.0, 1.0], [0.0, 1.0]),
        ("slip", [3.0, 1.0], [0.0, 1.0]),
        ("separate", [-3.0, 1.0], [0.0, 1.0]),
        ("separate", [3.0, 1.0], [3.0, 1.0]),
        ("open", [-3.0, 1.0], [-3.0, 1.0]),
    ],
)
def test_kinds_of_walls(kind, velocity, expected):
    walls = mpm.Walls([(kind, "open"), "open"])
    for x in (0.0, -0.1, -0.3):  # on the wall and in the padding behind it
        assert one_node(velocity, walls, [x, 0.5]).tolist() == expected
    assert one_node(velocity, walls, [0.1, 0.5]).tolist() == velocity
    mirrored = one_node([-velocity[0], velocity[1]], mpm.Walls([("open", kind), "open"]), [1.0, 0.5])
    assert mirrored.tolist() == [-expected[0] if expected[0] else 0.0, expected[1]]


@pytest.mark.parametrize("kind", ["slip", "separate"])
def test_coulomb_friction_of_a_wall(kind):
    walls = mpm.Walls([(kind, "open"), "open", "open"], friction=0.25)
    sliding = one_node([-2.0, 3.0, -4.0], walls, [0.0, 0.5, 0.5])  # tangential speed 5 loses 0.25 * 2
    torch.testing.assert_close(sliding, torch.tensor([0.0, 2.7, -3.6], dtype=torch.float64), rtol=1e-15, atol=0)
    assert one_node([-2.0, 0.3, -0.4], walls, [0.0, 0.5, 0.5]).tolist() == [0.0, 0.0, 0.0]  # inside the cone
    assert one_node([-2.0, 0.0, 0.0], walls, [0.0, 0.5, 0.5]).tolist() == [0.0, 0.0, 0.0]
    away = one_node([2.0, 3.0, -4.0], walls, [0.0, 0.5, 0.5])  # no pressure, no friction
    assert away.tolist() == [2.0 if kind == "separate" else 0.0, 3.0, -4.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dx", [0.1, 1 / 3, 0.0173])
def test_a_node_on_the_plane_counts(dtype, dx):
    lower, nodes = -0.7, 200
    grid = mpm.Grid(dx=dx, lower=(lower, lower), upper=(lower + nodes * dx,) * 2)
    blocks = random_blocks(grid, share=1.0)
    rows = blocks.active_nodes()[:, None].to(dtype) * torch.tensor([1.0, 1.0, 1.0], dtype=dtype)
    index = blocks.node_indices() - 3
    for first, last in ((7, 199), (31, 150)):
        walls = mpm.Walls(["sticky", "open"], (lower + first * dx, lower), (lower + last * dx, lower + 1))
        stopped = (grid_update(blocks, rows, walls=walls) == 0).all(1) & blocks.active_nodes()
        expected = ((index[:, 0] <= first) | (index[:, 0] >= last)) & blocks.active_nodes()
        assert torch.equal(stopped, expected)


def test_nan_stays_in_its_node(device, dim):
    blocks, nodes, gravity, dt = inputs(dim, device)
    sick = int((nodes[:, 0] > 0).nonzero()[3])
    walls = mpm.Walls("separate", friction=0.4)
    healthy = grid_update(blocks, nodes, gravity, dt, walls)
    nodes[sick, 1:] = float("nan")
    nodes.requires_grad_()
    velocity = grid_update(blocks, nodes, gravity, dt, walls)
    others = torch.arange(len(nodes), device=device) != sick
    assert velocity[sick].isnan().all() and torch.equal(velocity[others], healthy[others])
    (grad,) = torch.autograd.grad(velocity[others].sum(), nodes)
    assert grad[others].isfinite().all()


def test_any_strides(device, dim):
    blocks, nodes, gravity, dt = inputs(dim, device)
    expected = grid_update(blocks, nodes, gravity, dt, INSET[dim])
    column_major = nodes.T.contiguous().T
    shifted = torch.empty(nodes.numel() + 1, dtype=nodes.dtype, device=device)[1:].view_as(nodes).copy_(nodes)
    for other in (column_major, shifted):
        assert torch.equal(grid_update(blocks, other, gravity.T.contiguous().T, dt, INSET[dim]), expected)


# ---- derivatives


@pytest.mark.parametrize("name", WALLS)
def test_gradient_is_the_reference(device, dim, name):
    blocks, nodes, gravity, dt = inputs(dim, device)
    walls = walls_named(name, dim)
    leaves = [t.requires_grad_() for t in (nodes, gravity, dt)]
    weight = torch.randn_like(nodes)[:, 1:]
    expected = torch.autograd.grad((updated(blocks, *leaves, walls) * weight).sum(), leaves)
    grads = torch.autograd.grad((grid_update(blocks, *leaves, walls) * weight).sum(), leaves)
    for got, want in zip(grads, expected, strict=True):
        assert_close(got, want, 1e-13)
    single = [t.detach().float().requires_grad_() for t in leaves]
    for got, want in zip(
        torch.autograd.grad((grid_update(blocks, *single, walls) * weight.float()).sum(), single), expected, strict=True
    ):
        assert_close(got, want, 5e-6)


@pytest.mark.parametrize(
    "walls",
    [
        mpm.Walls("slip", friction=0.3),
        mpm.Walls("separate", (0.1,) * 2, (0.3,) * 2),
        mpm.Walls([("mirror", "open"), ("open", "mirror")], (0.05, 0.0), (0.4, 0.1)),
        mpm.Walls([("mirror", "open"), ("separate", "open")], friction=[0.0, 0.3]),
    ],
)
def test_gradcheck(walls):
    grid = mpm.Grid(dx=0.1, lower=(0.0, 0.0), upper=(0.4, 0.1), scenes=2)
    blocks = random_blocks(grid, share=1.0)
    nodes = random_nodes(blocks).requires_grad_()
    gravity, dt = torch.randn(2, 2, dtype=torch.float64), torch.rand(2, dtype=torch.float64)
    heavy = nodes.detach()[:, :1] != 0  # at zero mass the velocity is not continuous

    def function(nodes: Tensor, gravity: Tensor, dt: Tensor) -> Tensor:
        return grid_update(blocks, torch.where(heavy, nodes, 0), gravity, dt, walls)

    arguments = (nodes, gravity.requires_grad_(), dt.requires_grad_())
    assert torch.autograd.gradcheck(function, arguments, fast_mode=True)
    assert torch.autograd.gradgradcheck(function, arguments, fast_mode=True)


def test_gradcheck_of_one_node_with_friction():
    """Entry by entry, at an edge where two walls act in turn."""
    grid = mpm.Grid(dx=0.1, lower=(0.0,) * 3, upper=(0.1,) * 3)
    blocks = random_blocks(grid, share=1.0)
    row = (blocks.node_positions(torch.float64) - torch.tensor([0.0, 0.0, 0.05])).norm(dim=1).argmin()
    walls = mpm.Walls(["slip", "separate", "open"], friction=0.2)

    def function(values: Tensor) -> Tensor:
        nodes = torch.zeros(blocks.node_count, 4, dtype=torch.float64).index_copy(0, row[None], values[None])
        return grid_update(blocks, nodes, walls=walls)[row]

    values = torch.tensor([1.3, -0.4, -0.5, 2.0], dtype=torch.float64, requires_grad=True)
    assert function(values.detach())[2].item() not in (0.0, 2.0 / 1.3)  # it slides
    assert torch.autograd.gradcheck(function, (values,))
    assert torch.autograd.gradgradcheck(function, (values,))


def op_arguments(blocks: mpm.Blocks, nodes: Tensor, gravity: Tensor, dt: Tensor, walls: mpm.Walls) -> tuple:
    kinds = {"open": 0, "sticky": 1, "slip": 2, "separate": 3, "mirror": 4}
    kind, plane, friction = zip(*walls.faces(blocks.grid), strict=True)
    return (nodes, gravity, dt, 0.1, [kinds[k] for k in kind], plane, friction, *blocks.packed)


def test_opcheck(device, dim):
    blocks, nodes, gravity, dt = inputs(dim, device)
    arguments = op_arguments(blocks, *(t.requires_grad_() for t in (nodes, gravity, dt)), INSET[dim])
    torch.library.opcheck(torch.ops.torch_mpm.grid_update, arguments)
    plain = [a.detach() if isinstance(a, Tensor) else a for a in arguments]
    for wants_change in (False, True):
        torch.library.opcheck(torch.ops.torch_mpm.grid_update_backward, (plain[0].clone(), wants_change, *plain))


def test_compile(dim):
    blocks, nodes, gravity, dt = inputs(dim, "cpu")
    compiled = torch.compile(grid_update, fullgraph=True, backend="aot_eager")
    nodes.requires_grad_()
    expected = grid_update(blocks, nodes, gravity, dt, INSET[dim])
    got = compiled(blocks, nodes, gravity, dt, INSET[dim])
    assert torch.equal(got, expected)
    assert torch.equal(*(torch.autograd.grad(v.square().sum(), nodes)[0] for v in (got, expected)))


# ---- bad input


def test_messages():
    blocks, nodes, gravity, _ = inputs(2, "cpu")
    N = blocks.node_count
    for arguments, error, message in [
        ((nodes[:, :2],), ValueError, rf"nodes must have shape \[N, 1 \+ D\] = \[{N}, 3\], got \[{N}, 2\]"),
        ((nodes.half(),), TypeError, "nodes must be float32 or float64, got torch.float16"),
        ((nodes, gravity), ValueError, "gravity needs dt"),
        ((nodes, gravity, 0.0), ValueError, "dt must be a positive"),
        ((nodes, gravity, math.nan), ValueError, "dt must be a positive"),
        ((nodes, gravity[:2], 0.1), ValueError, r"gravity must have shape \[D\] or \[B, D\] = \[3, 2\], got \[2, 2\]"),
        (
            (nodes, gravity.float(), 0.1),
            TypeError,
            "gravity must have the dtype of x, torch.float64, got torch.float32",
        ),
        ((nodes, None, None, mpm.Walls("slip", (0, 0, 0))), ValueError, "lower and upper of walls must have 2 numbers"),
        ((nodes, None, None, mpm.Walls("slip", (2, 2))), ValueError, "upper of walls must be above lower"),
        (
            (nodes, None, None, mpm.Walls(["slip"] * 3)),
            ValueError,
            "kind of walls must have one entry or pair per axis",
        ),
        (
            (nodes, None, None, mpm.Walls("mirror", (0.03, 0.0))),
            ValueError,
            "a mirror must lie on a node or halfway between two: the one at 0.03 m on axis 0 is 0.3 cells",
        ),
        ((nodes, None, None, mpm.Walls("mirror", friction=0.1)), ValueError, "friction of a mirror must be 0, got 0.1"),
        (
            (nodes, None, None, mpm.Walls([("slip", "mirror"), "open"], (0.6, 0.0))),
            ValueError,
            "a mirror must be at least 5 cells from the wall opposite, got 4 on axis 0",
        ),
    ]:
        with pytest.raises(error, match=message):
            grid_update(blocks, *arguments)
    for arguments, error, message in [
        (("stiky",), ValueError, "kind of a wall must be one of .*'stiky'"),
        (("slip", None, None, -0.1), ValueError, "friction of walls must be a finite number >= 0, got -0.1"),
        (("slip", None, None, torch.tensor(0.1)), TypeError, "friction of walls must be a number, got Tensor"),
        (("slip", (math.nan, 0)), ValueError, "lower of walls must be finite"),
    ]:
        with pytest.raises(error, match=message):
            mpm.Walls(*arguments)
        walls = mpm.Walls()
        for name, value in zip(("kind", "lower", "upper", "friction"), arguments, strict=False):
            setattr(walls, name, value)
        if "lower" not in message:  # which is compared with the grid
            with pytest.raises(error, match=message):
                grid_update(blocks, nodes, None, None, walls)
    with pytest.raises(NotImplementedError, match="vmap"):
        torch.vmap(lambda g: grid_update(blocks, nodes, g, 0.1))(torch.randn(4, 2, dtype=torch.float64))


def test_the_op_checks_what_memory_safety_needs(dim):
    blocks, nodes, gravity, dt = inputs(dim, "cpu")
    arguments = list(op_arguments(blocks, nodes, gravity, dt, INSET[dim]))
    op = torch.ops.torch_mpm.grid_update
    shorter = dataclasses.replace(blocks, block=torch.tensor([0, 1], dtype=torch.int32)).packed[0]
    for position, value in [
        (0, nodes[:-1]), (0, nodes[:, 0]), (0, nodes.long()), (1, gravity[:, :1]), (1, gravity.float()), (2, dt[:-1]),
        (4, [1]), (4, [7] * 2 * dim), (5, [0.0]), (6, []), (7, shorter),
    ]:  # fmt: skip
        with pytest.raises(RuntimeError):
            op(*arguments[:position], value, *arguments[position + 1 :])


def test_blocks_outside_the_batch_count_as_unused(dim):
    blocks, nodes, gravity, dt = inputs(dim, "cpu")
    wrong = blocks.block.clone()
    wrong[0], wrong[1] = blocks.grid.block_count, 2**31 - 1
    arguments = op_arguments(dataclasses.replace(blocks, block=wrong), nodes, gravity, dt, INSET[dim])
    rows = 2 * blocks.grid.nodes_per_block
    assert (torch.ops.torch_mpm.grid_update(*arguments)[:rows] == 0).all()


@pytest.mark.parametrize("scenes", [0, 2])
@pytest.mark.parametrize("max_blocks", [0, 3])
def test_nothing_to_do(device, dim, scenes, max_blocks):
    grid = grid_of(dim, scenes)
    blocks = random_blocks(grid, device, share=0.0, unused=max_blocks)
    nodes = torch.zeros(blocks.node_count, 1 + dim, device=device, requires_grad=True)
    gravity = torch.ones(scenes, dim, device=device, requires_grad=True)
    velocity = grid_update(blocks, nodes, gravity, 0.1, mpm.Walls("slip"))
    assert velocity.shape == (max_blocks * 4**dim, dim) and (velocity == 0).all()
    grads = torch.autograd.grad(velocity.sum(), (nodes, gravity))
    assert all((g == 0).all() for g in grads)
