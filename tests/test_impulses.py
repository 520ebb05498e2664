"""Impulses on walls and obstacles: balance of momentum, known forces, gradients, shares of boundaries."""

import math

import pytest
import torch
from cases.impulses import (
    DT,
    F64,
    GRAVITY,
    LAWS,
    STEPS,
    WALLS,
    by_scene,
    cloud,
    cross,
    momentum,
    obstacles,
    one_by_one,
)
from helpers import TOLERANCE, random_blocks, random_nodes, relative_error
from oracle import impulses as reference
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block, unit_box
from torch_mpm import ops

TRANSFERS = {"apic": {}, "pic": {"transfer": "pic"}, "flip": {"transfer": "flip"}, "blend": {"flip": 0.7}}


def few_blocks(dim: int, device: str, scenes: int) -> mpm.Blocks:
    return random_blocks(mpm.Grid(0.1, (0.0,) * dim, (0.6, 0.5, 0.5)[:dim], scenes=scenes), device)


def stepped(step: mpm.Step, state: mpm.State) -> tuple[mpm.State, tuple[Tensor, Tensor]]:
    """The state after single steps, and the impulse and moment of gravity in them [B, ...]."""
    linear = angular = torch.zeros(())
    g = torch.tensor(step.gravity, dtype=F64).to(state.x)
    for _ in range(STEPS):
        m = state.mass[:, None]
        linear = linear + DT * by_scene(m * g, state, step.grid.scenes)
        angular = angular + DT * by_scene(m * cross(state.x, g), state, step.grid.scenes)
        state = step(state, DT)
    return state, (linear, angular)


def assert_balanced(
    step: mpm.Step, state: mpm.State, end: mpm.State, given: tuple[Tensor, Tensor], angular: bool, tolerance: float
) -> None:
    """Impulses + change of the momentum = what gravity gives, relative to what boundaries and material exchange."""
    dim = step.grid.dim
    values = step.impulses(end).values.detach().cpu()
    before, after = momentum(state, step.grid), momentum(end, step.grid)
    for part, columns in enumerate((slice(0, dim), slice(dim, None))[: 2 if angular else 1]):
        exchanged = values[..., columns].norm(dim=-1).sum(1) + before[part].norm(dim=1)
        left = (after[part] - before[part] - given[part] + values[..., columns].sum(1)).norm(dim=1)
        assert float((left / exchanged).max()) < tolerance, "angular" if part else "linear"


@pytest.mark.thorough(dim=3)
@pytest.mark.thorough(transfer="blend", in_torch=True)
@pytest.mark.parametrize("walls", WALLS)
@pytest.mark.parametrize(
    ("dim", "transfer", "in_torch"),
    [(2, "apic", False), (2, "pic", True), (2, "flip", False), (2, "blend", False), (2, "blend", True)]
    + [(3, "apic", False), (3, "blend", False)],
)
def test_momentum_is_balanced(device, dim, walls, transfer, in_torch):
    """And the one op has the impulses of single steps."""
    grid = unit_box(dim, 0.1, scenes=2)
    step = mpm.Step(
        grid, LAWS["neo_hookean"](), GRAVITY[:dim], WALLS[walls], obstacles(dim, in_torch), **TRANSFERS[transfer]
    )
    state = step.with_impulses(step.prepare(cloud(dim, device, 2, 60)))
    with torch.no_grad():
        end, (single, given) = mpm.rollout(step, state, STEPS, DT), stepped(step, state)
    torch.testing.assert_close(end.impulse, single.impulse, rtol=1e-11, atol=1e-11)
    assert_balanced(step, state, end, given, transfer == "apic", TOLERANCE["conservation"][F64])
    if walls != "none":
        assert float(step.impulses(end)["-y"].linear.norm()) > 0


@pytest.mark.parametrize(
    *in_pairs(law=LAWS, form=["mls", "gradient"], dtype=[torch.float32, F64], kernel=["quadratic", "cubic"])
)
def test_momentum_is_balanced_for_laws(device, kernel, law, form, dtype):
    grid = unit_box(3, 0.1, kernel=kernel)
    step = mpm.Step(grid, LAWS[law](), GRAVITY, WALLS["friction"], obstacles(3), stress_form=form)
    state = step.with_impulses(step.prepare(cloud(3, device, dtype=dtype)))
    end = mpm.rollout(step, state, STEPS, DT)
    # The moments of the gradient form are those of a motion that rounding alone keeps symmetric.
    given = stepped(step, state)[1]
    assert_balanced(step, state, end, given, form == "mls", {torch.float32: 3e-6, F64: 1e-12}[dtype])
    assert end.impulse.dtype == F64


def test_steps_without_impulses_are_the_same(device):
    step = mpm.Step(unit_box(3, 0.1), LAWS["neo_hookean"](), GRAVITY, WALLS["mirror"], obstacles(3))
    state = step.prepare(cloud(3, device))
    counting = step.with_impulses(state)
    many = 20  # on CUDA some of them are replayed
    expected = one_by_one(step, counting, many).impulse
    for run in (lambda s: mpm.rollout(step, s, many, DT), lambda s: one_by_one(step, s, many)):
        without, with_impulses = run(state), run(counting)
        torch.testing.assert_close(with_impulses.impulse, expected, rtol=1e-10, atol=1e-10)
        assert without.impulse is None
        for name in ("x", "v", "C", "F"):
            a, b = getattr(without, name), getattr(with_impulses, name)
            assert torch.equal(a, b) if device == "cpu" else relative_error(a, b) < 1e-11
    assert step.explain(counting).startswith("all steps in one op") and step.explain(state).startswith("all steps")


# ---- the ops against what nodes lose


@pytest.mark.parametrize("name", ["separate", "friction", "sticky", "slip"])
def test_wall_impulses_are_what_nodes_lose(device, dim, name):
    blocks = few_blocks(dim, device, 3)
    nodes, gravity = random_nodes(blocks), torch.randn(3, dim, dtype=F64).to(device)
    dt = 0.5 + torch.rand(3, dtype=F64).to(device)
    expected = reference.wall_impulses(blocks, nodes, gravity, dt, WALLS[name].faces(blocks.grid))
    got = ops.wall_impulses(blocks, nodes, gravity, dt, WALLS[name])
    assert relative_error(got, expected) < 1e-13
    single = ops.wall_impulses(blocks, nodes.float(), gravity.float(), dt.float(), WALLS[name])
    assert single.dtype == F64 and relative_error(single, expected) < 1e-6


@pytest.mark.parametrize("per_scene", [False, True])
def test_contact_impulses_are_what_nodes_lose(device, dim, per_scene):
    blocks = few_blocks(dim, device, 2)
    nodes = random_nodes(blocks)
    several = obstacles(dim)
    if per_scene:
        several.append(mpm.Sphere((0.6,) * dim, 0.3, scene=1))
        several[0].position = torch.tensor([[0.4] * dim, [0.7] * dim], dtype=F64, device=device)
    for time in (0.0, 3 * DT, torch.tensor([0.0, 3 * DT], dtype=F64, device=device)):
        expected = reference.contact_impulses(blocks, nodes[:, 1:], nodes[:, 0], several, time)
        got = ops.contact_impulses(blocks, nodes[:, 1:], nodes[:, 0], several, time)
        assert relative_error(got, expected) < 1e-13
    if per_scene:
        assert (got[0, -1] == 0).all() and (got[1, -1] != 0).any()


def test_a_mirror_takes_the_normal_component(device, dim):
    """Nodes exchange momentum along the wall without a sum; only the moment changes."""
    blocks = random_blocks(unit_box(dim, 0.1), device, share=1.0)
    nodes = random_nodes(blocks)
    walls = mpm.Walls([("mirror", "open"), *["open"] * (dim - 1)])
    found = ops.wall_impulses(blocks, nodes, walls=walls)[0]
    rounding = 1e-13 * float(found.abs().max())
    assert float(found[0, 1:dim].abs().max()) < rounding and float(found[0, 0].abs()) > 1e3 * rounding
    assert (found[1:] == 0).all()


def test_more_obstacles_than_an_op_takes(device):
    many = [mpm.Sphere((0.1 + 0.04 * k, 0.3), 0.1, kind="slip", friction=0.1) for k in range(20)]
    blocks = random_blocks(unit_box(2, 0.1), device)
    nodes = random_nodes(blocks)
    step = mpm.Step(unit_box(2, 0.1), LAWS["neo_hookean"](), boundaries=many)
    state = step.with_impulses(cloud(2, device))
    end = step(state, DT)
    assert end.impulse.shape == (1, 24, 3)
    blocks = step.grid.activate(state.x)
    tau = step.law(step.prepare(state))[1]
    nodes = mpm.p2g(blocks, state.x, state.mass, state.v, state.C, tau, state.volume, DT)
    velocity = mpm.grid_update(blocks, nodes)
    expected = reference.contact_impulses(blocks, velocity, nodes[:, 0], many, 0.0)
    assert relative_error(end.impulse[:, :20], expected) < 1e-12


# ---- known forces


def settled(step: mpm.Step, state: mpm.State, n: int, dt: float) -> mpm.State:
    with torch.no_grad():
        return step.with_impulses(mpm.rollout(step, state, n, dt))


def test_a_column_weighs_on_the_floor(device):
    """m g, in every substep once it is at rest; at its middle, so that it has no moment about its own foot."""
    grid = mpm.Grid(0.05, (0.0, 0.0), (0.4, 0.6))
    law = mpm.NeoHookean(E=1e5, nu=0.2)
    step = mpm.Step(grid, law, (0.0, -9.8), walls="slip", transfer="pic")
    points = mpm.seed.box((0.0, 0.0), (0.4, 0.3), grid, per_cell=4)
    state = settled(step, mpm.State.at_rest(points, 1000.0, dtype=F64, device=device), 3000, 5e-4)
    end = mpm.rollout(step, state, 4, 5e-4)
    floor = step.impulses(end)["-y"]
    weight = 9.8 * float(state.mass.sum()) * 4 * 5e-4
    assert float(floor.linear[0, 1]) == pytest.approx(-weight, rel=2e-3)
    assert abs(float(floor.linear[0, 0])) < 1e-9 * weight
    assert abs(float(floor.about((0.2, 0.0)))) < 1e-6 * weight


@pytest.mark.parametrize("friction", [0.2, 2.0])
def test_friction_on_a_slope(device, friction):
    """A block on a slope of 30°: it slides, and friction is μ times the pressure, or it sticks, and friction is what
    holds it."""
    slope = math.radians(30)
    normal = torch.tensor([math.sin(slope), math.cos(slope)], dtype=F64)
    along = torch.tensor([math.cos(slope), -math.sin(slope)], dtype=F64)
    plane = mpm.Plane((0.5, 0.5), normal.tolist(), friction=friction)
    grid = mpm.Grid(0.05, (0.0, 0.0), (1.0, 1.2))
    step = mpm.Step(grid, mpm.NeoHookean(E=2e5, nu=0.2), (0.0, -9.8), boundaries=[plane], transfer="pic")
    points = mpm.seed.box((-0.1, 0.0), (0.1, 0.1), 0.05, per_cell=4)
    turned = points.x[:, :1].double() * along + points.x[:, 1:].double() * normal + torch.tensor([0.35, 0.5866])
    state = mpm.State.at_rest(points, 1000.0, dtype=F64)
    state = settled(step, state.replace(x=turned).to(device), 400, 2e-4)
    end = mpm.rollout(step, state, 200, 2e-4)
    force = step.impulses(end)[plane].linear[0].cpu() / (200 * 2e-4)
    pressure, drag = -float(force @ normal), float(force @ along)
    weight = 9.8 * float(state.mass.sum())
    assert pressure == pytest.approx(weight * math.cos(slope), rel=0.03)
    if friction < math.tan(slope):
        assert drag == pytest.approx(friction * pressure, rel=1e-6)
    else:
        assert drag == pytest.approx(weight * math.sin(slope), rel=0.03)


def test_what_pushes_a_ball_through_is_resisted(device):
    ball = mpm.Sphere((0.3, 0.4), 0.15, kind="sticky", velocity=(1.0, 0.0))
    grid = unit_box(2, 0.1)
    step = mpm.Step(grid, mpm.WeaklyCompressible(1e4), boundaries=[ball], walls="separate")
    state = block((0.0, 0.0), (1.0, 0.8), grid, device=device)
    end = mpm.rollout(step, step.with_impulses(state), 100, 5e-4)
    on = step.impulses(end)
    assert float(on[ball].linear[0, 0]) < 0  # against its motion
    assert float(on["+x"].linear[0, 0]) > 0  # and the wall ahead feels it
    assert_close = torch.testing.assert_close
    assert_close(on.total[0].cpu(), -(end.mass[:, None] * end.v).sum(0).cpu().double(), rtol=1e-9, atol=1e-9)


def test_a_held_ball_is_lifted_by_water(device):
    """By the weight of the water in its place (Archimedes), to first order in dx: the contact is that of nodes."""

    def lift(dx: float) -> float:
        ball = mpm.Sphere((0.5, 0.3), 0.15)
        grid = mpm.Grid(dx, (0.0, 0.0), (1.0, 0.8))
        step = mpm.Step(grid, mpm.WeaklyCompressible(4e4, viscosity=2.0), (0.0, -9.8), "mirror", [ball])
        points = mpm.seed.box((0.0, 0.0), (1.0, 0.6), grid, per_cell=4)
        water = mpm.State.at_rest(points, 1000.0, dtype=F64, device=device)
        outside = (points.x - torch.tensor([0.5, 0.3])).norm(dim=1) > 0.15
        state = settled(step, water.select(outside.nonzero()[:, 0].to(device)), round(75 / dx), 0.02 * 3.16 * dx)
        end = mpm.rollout(step, state, round(16 / dx), 0.02 * 3.16 * dx)
        assert abs(float(step.impulses(end)[ball].about((0.5, 0.3)))) < 1e-9  # without friction
        return float(step.impulses(end)[ball].linear[0, 1]) / (end.time - state.time)

    displaced = 9.8 * 1000.0 * math.pi * 0.15**2
    coarse, fine = (1 - lift(dx) / displaced for dx in (0.05, 0.025))
    assert 0 < fine < 0.8 * coarse and fine < 0.2


# ---- shares of boundaries


def test_nothing_to_count(device):
    """No boundaries, no particles, an empty scene."""
    step = mpm.Step(unit_box(2, 0.1, scenes=2), LAWS["neo_hookean"]())
    state = cloud(2, device, 2).select(torch.arange(0, 240, 2).to(device))
    end = mpm.rollout(step, step.with_impulses(state), 3, DT)
    assert end.impulse.shape == (2, 4, 3) and (end.impulse == 0).all()
    step = mpm.Step(unit_box(2, 0.1, scenes=2), LAWS["neo_hookean"](), GRAVITY[:2], "sticky", obstacles(2))
    end = mpm.rollout(step, step.with_impulses(state), 3, DT)  # scene 1 is empty
    assert (end.impulse[1] == 0).all() and (end.impulse[0] != 0).any()
    empty = state.select(torch.empty(0, dtype=torch.int64, device=device))
    assert (mpm.rollout(step, step.with_impulses(empty), 3, DT).impulse == 0).all()
    assert (step(step.with_impulses(empty), DT).impulse == 0).all()


def test_a_lost_scene_does_not_reach_the_others(device):
    step = mpm.Step(
        unit_box(2, 0.1, scenes=2, deterministic=True), LAWS["neo_hookean"](), GRAVITY[:2], "sticky", obstacles(2)
    )
    state = step.with_impulses(cloud(2, device, 2))
    broken = state.replace(v=torch.where((state.scene == 1)[:, None], torch.nan, state.v))
    for run in (lambda s: mpm.rollout(step, s, 4, DT), lambda s: one_by_one(step, s, 4)):
        well, ill = run(state).impulse, run(broken).impulse
        assert torch.equal(well[0], ill[0]) and ill[1].isnan().any()


def test_a_paused_scene_counts_nothing(device):
    step = mpm.Step(unit_box(2, 0.1, scenes=2), LAWS["neo_hookean"](), GRAVITY[:2], "sticky", obstacles(2))
    state = step.with_impulses(cloud(2, device, 2))
    dt = torch.tensor([DT, 0.0], dtype=F64, device=device)
    end = one_by_one(step, state, 3, dt)
    assert (end.impulse[1] == 0).all() and (end.impulse[0] != 0).any()


def test_results_have_the_same_bits_again(device):
    step = mpm.Step(
        unit_box(3, 0.1, deterministic=True, scenes=2), LAWS["neo_hookean"](), GRAVITY, "sticky", obstacles(3)
    )
    state = step.with_impulses(cloud(3, device, 2, 400))
    runs = [mpm.rollout(step, state, STEPS, DT).impulse for _ in range(3)]
    assert torch.equal(runs[0], runs[1]) and torch.equal(runs[0], runs[2])


def test_fields_of_a_state(device):
    step = mpm.Step(unit_box(2, 0.1, scenes=2), LAWS["neo_hookean"](), boundaries=obstacles(2), walls="slip")
    single = mpm.Step(unit_box(2, 0.1), LAWS["neo_hookean"](), boundaries=obstacles(2), walls="slip")
    parts = [mpm.rollout(single, single.with_impulses(cloud(2, device, count=n)), 3, DT) for n in (30, 50)]
    batch = mpm.State.concatenate(parts, scene=True)
    assert torch.equal(batch.impulse, torch.cat([p.impulse for p in parts]))
    assert mpm.rollout(step, batch, 2, DT).impulse.shape == batch.impulse.shape
    for other in (batch.detach(), batch.to(dtype=torch.float32), batch.sorted(step.grid), batch.select(batch.scene)):
        assert torch.equal(other.impulse, batch.impulse)
    more = mpm.State.concatenate([parts[0], cloud(2, device, count=5).replace(time=parts[0].time)])
    assert torch.equal(more.impulse, parts[0].impulse)
    with pytest.raises(ValueError, match="states of one batch must have one impulse"):
        mpm.State.concatenate(parts)
    with pytest.raises(ValueError, match=r"impulse of state 1 must have shape \[1, 7, 3\]"):
        mpm.State.concatenate([parts[0], cloud(2, device, count=5)], scene=True)


def test_frames_and_control(device):
    """Impulses between frames, while a hook gives the paddle new poses; forces by boundary, number and face."""
    paddle = mpm.Box(torch.tensor([0.5, 0.4], dtype=F64, device=device), (0.3, 0.1))
    step = mpm.Step(unit_box(2, 0.1), LAWS["neo_hookean"](), GRAVITY[:2], "sticky", boundaries=[paddle])
    state = step.with_impulses(cloud(2, device))

    def control(state: mpm.State, k: int) -> None:
        paddle.position = torch.tensor([0.5, 0.4 + 0.01 * k], dtype=F64, device=device)

    kept = mpm.frames(step, state, 6, DT, every=2, fields=["impulse"], hook=control)
    assert kept.fields["impulse"].shape == (4, 1, 5, 3)
    on = step.impulses(kept.end)
    assert torch.equal(on[paddle].linear, on[0].linear) and torch.equal(
        on[0].linear, kept.fields["impulse"][-1, :, 0, :2]
    )
    assert torch.equal((on - step.impulses(state)).values, on.values)
    lever = on["+x"].about((1.0, 0.0)) - on["+x"].angular
    torch.testing.assert_close(lever, -on["+x"].linear[:, 1])
    for wrong in ("+z", "top", 1, -2, mpm.Sphere((0.0, 0.0), 1.0)):
        with pytest.raises(KeyError, match="neither one of the 1 boundaries"):
            on[wrong]


def test_errors():
    step = mpm.Step(unit_box(2, 0.1), LAWS["neo_hookean"](), walls="slip")
    state = cloud(2)
    with pytest.raises(ValueError, match=r"state\.impulse is None"):
        step.impulses(state)
    with pytest.raises(ValueError, match=r"impulse must have shape \[B, K, 3\], got \[4, 3\]"):
        state.replace(impulse=torch.zeros(4, 3, dtype=F64))
    with pytest.raises(TypeError, match="impulse must be float64"):
        state.replace(impulse=torch.zeros(1, 4, 3))
    counted = step.with_impulses(state)
    step.boundaries.append(obstacles(2)[0])
    with pytest.raises(ValueError, match=r"state.impulse must have shape \[1, 5, 3\] for the 1 boundaries"):
        step(counted, DT)
    with pytest.raises(ValueError, match="point must have shape"):
        step.impulses(step.with_impulses(state))["-x"].about((0.0, 0.0, 0.0))
