"""Rigid bodies that the material pushes: conservation, stability for all ratios of masses, joints, gradients."""

import copy
import math

import pytest
import torch
from cases.impulses import F64, cross, momentum

import torch_mpm as mpm
from torch_mpm.bodies import Body, Driven, FreeBodies, Hinge, Part, Slider

BALL, DENSITY = 0.2, 1000.0


def material(dim, device="cpu", dtype=F64, velocity=None, scenes=1, walls=None, gravity=None, E=1e4):
    """A step, and an elastic block in the middle of a domain."""
    grid = mpm.Grid(0.1, (0.0,) * dim, (2.0,) * dim, scenes=scenes)
    step = mpm.Step(grid, mpm.NeoHookean(E=E, nu=0.3), gravity, walls)
    points = mpm.seed.box((0.6,) * dim, (1.4, 1.0, 1.4)[:dim], grid, per_cell=2**dim)
    state = mpm.State.at_rest(points, DENSITY, velocity, dtype, device)
    return step, mpm.State.concatenate([state] * scenes, scene=True) if scenes > 1 else state


def ball_of(dim, ratio=1.0, friction=0.5, radius=BALL, **options):
    """A ball of a density that is `ratio` times that of the material."""
    volume = math.pi * radius**2 if dim == 2 else 4 / 3 * math.pi * radius**3
    mass = ratio * DENSITY * volume
    inertia = (0.5 if dim == 2 else 0.4) * mass * radius**2
    return Body(mpm.Sphere((0.0,) * dim, radius, friction=friction), mass, inertia, **options)


def rows_of(dim, position, velocity, spin=None, device="cpu"):
    """Rows [1, 1, 6 or 13] without a rotation."""
    turn = [0.0] if dim == 2 else [1.0, 0.0, 0.0, 0.0]
    spin = [0.0] * (1 if dim == 2 else 3) if spin is None else spin
    return torch.tensor([[[*position, *turn, *velocity, *spin]]], dtype=F64, device=device)


def momenta(state, grid, body, rows):
    """Linear and angular momentum about the origin of the material, with that of C, and of one body."""
    dim, row = grid.dim, rows[0, 0].cpu()
    linear, angular = momentum(state, grid)
    own = row[3 if dim == 2 else 7 :]
    p, spin = body.mass * own[:dim], body.inertia[0] * own[dim:]
    return torch.cat([linear[0] + p, angular[0] + cross(row[:dim], p) + spin])


@pytest.mark.parametrize("ratio", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("kind", ["separate", "slip", "sticky"])
def test_momentum_is_conserved(dim, device, kind, ratio):
    """Linear and angular momentum of material and body, to rounding."""
    step, state = material(dim, device, velocity=(0.3, 0.5, -0.2)[:dim])
    body = ball_of(dim, ratio)
    body.parts[0].obstacle.kind = kind
    bodies = FreeBodies(step, [body])
    rows = rows_of(dim, (1.05, 1.22, 0.95)[:dim], (0.2, -1.0, 0.1)[:dim], device=device)
    state = step.prepare(state)
    before = momenta(state, step.grid, body, rows)
    own = rows[0, 0, -3:] if dim == 2 else rows[0, 0, -6:]
    with torch.no_grad():
        state, rows = bodies.advance(state, rows, 12, 2e-3)
    bodies.check()
    after = momenta(state, step.grid, body, rows)
    assert float((rows[0, 0, -len(own) :] - own).abs().max()) > 1e-4 / max(1.0, ratio)  # they have met
    scale = float(state.mass.sum()) + body.mass
    torch.testing.assert_close(after, before, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("friction", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("ratio", [1e-3, 1e-2, 1.0, 1e2])
def test_bodies_of_any_mass_are_stable_at_the_time_step_of_the_material(device, ratio, friction):
    """A light disc is not thrown away by what it lies on, and a heavy one does not stop at once: energy never grows."""
    step, state = material(2, device, walls="slip", E=1e4 * max(1.0, ratio))
    bodies = FreeBodies(step, [ball_of(2, ratio, friction)])
    rows = rows_of(2, (1.0, 1.19), (0.3, -1.0), device=device)
    dt = float(step.stable_dt(state, 0.9))
    mass, inertia = bodies.bodies[0].mass, bodies.bodies[0].inertia[0]

    def energy(state, rows):
        own = rows[0, 0, 3:]
        kinetic = 0.5 * mass * float(own[:2].square().sum()) + 0.5 * inertia * float(own[2] ** 2)
        elastic = float((step.diagnostics(state).energy * state.volume).sum())
        return kinetic + 0.5 * float((state.mass * state.v.square().sum(1)).sum()) + elastic

    first = energy(state, rows)
    for _ in range(8):
        with torch.no_grad():
            state, rows = bodies.advance(state, rows, 10, dt)
        bodies.check()
        assert bodies.report.iterations <= 8
        assert energy(state, rows) < 1.02 * first
    step.check(state)


def test_a_body_without_contact_flies_freely(device):
    """Three unequal moments of inertia: the angular momentum stays, the spin does not; gravity of the step acts."""
    step, state = material(3, device, gravity=(0.0, -9.8, 0.0))
    body = Body(mpm.Sphere((0.0,) * 3, 0.05), 2.0, (1.0, 2.0, 3.0))
    bodies = FreeBodies(step, [body])
    rows = rows_of(3, (0.2, 1.8, 0.2), (0.1, 0.0, 0.0), (1.0, 2.0, 0.5), device=device)
    with torch.no_grad():
        _, end = bodies.advance(state, rows, 40, 5e-3)
    turn = mpm.bodies.solution.rotation_matrix(mpm.bodies.exchange.motion_of(end, 3).rotation, 3)
    momentum = (body.mass_matrix(turn[:, 0])[0, 3:, 3:] @ end[0, 0, 10:]).cpu()
    torch.testing.assert_close(momentum, torch.tensor([1.0, 4.0, 1.5], dtype=F64), rtol=1e-12, atol=0)
    assert float((end[0, 0, 10:] - rows[0, 0, 10:]).norm()) > 0.1
    torch.testing.assert_close(end[0, 0, 8].cpu(), torch.tensor(-9.8 * 0.2, dtype=F64), rtol=1e-12, atol=0)
    # Symplectic Euler: −g dt² n (n + 1)/2.
    torch.testing.assert_close(end[0, 0, 1].cpu(), torch.tensor(1.8 - 9.8 * 5e-3**2 * 820, dtype=F64))


def test_a_driven_body_is_an_obstacle_that_moves(dim, device):
    """As an obstacle with that velocity in single steps."""
    velocity = (0.1, -1.0, 0.05)[:dim]
    step, state = material(dim, device)
    bodies = FreeBodies(step, [ball_of(dim, joint=Driven())])
    at = (1.02, 1.2, 0.97)[:dim]
    with torch.no_grad():
        end, rows = bodies.advance(state, rows_of(dim, at, velocity, device=device), 5, 2e-3)
        other, _ = material(dim, device)
        other.boundaries.append(mpm.Sphere(at, BALL, friction=0.5, velocity=velocity))
        for _ in range(5):
            state = other(state, 2e-3)
    torch.testing.assert_close(end.v, state.v, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(rows[0, 0, :dim].cpu(), torch.tensor(at, dtype=F64) + 0.01 * torch.tensor(velocity))
    assert float(end.v.abs().max()) > 0.1


def test_a_joint_that_changes_between_calls(device):
    """A free body falls, and then stays where it is driven, as a new object computes."""
    step, state = material(2, device, gravity=(0.0, -9.8))
    body = ball_of(2)
    bodies, rows = FreeBodies(step, [body]), rows_of(2, (1.0, 1.8), (0.0, 0.0), device=device)
    with torch.no_grad():
        assert float(bodies.advance(state, rows, 2, 1e-3)[1][0, 0, 4]) < -0.01
        body.joint = Driven()
        assert float(bodies.advance(state, rows, 2, 1e-3)[1][0, 0, 4]) == 0


def test_a_hinge_keeps_its_distance_and_its_energy(device):
    """A pendulum of a disc: the anchor stays where it is; in gravity alone its energy stays to the order of dt."""
    step, state = material(2, device, gravity=(0.0, -9.8))
    anchor, length = (0.3, 1.6), 0.3
    bodies = FreeBodies(step, [ball_of(2, radius=0.05, joint=Hinge(anchor))])
    rows = rows_of(2, (anchor[0] + length, anchor[1]), (0.0, 0.0), device=device)
    with torch.no_grad():
        _, end = bodies.advance(state, rows, 400, 5e-4)
    x, v, spin = end[0, 0, :2].cpu(), end[0, 0, 3:5].cpu(), float(end[0, 0, 5])
    arm = x - torch.tensor(anchor, dtype=F64)
    assert abs(float(arm.norm()) - length) < 1e-12
    torch.testing.assert_close(v, spin * torch.stack([-arm[1], arm[0]]), rtol=1e-12, atol=1e-12)
    body = bodies.bodies[0]
    kinetic = 0.5 * body.mass * float(v @ v) + 0.5 * body.inertia[0] * spin**2
    lost = body.mass * 9.8 * (anchor[1] - float(x[1]))
    assert lost > 0.1 * body.mass * 9.8 * length
    assert abs(kinetic - lost) < 0.01 * lost


def test_a_slider_moves_along_its_axis_alone(dim, device):
    step, state = material(dim, device)
    way = (0.6, -0.8, 0.0)[:dim]
    bodies = FreeBodies(step, [ball_of(dim, joint=Slider(way))])
    at = (1.0, 1.2, 1.0)[:dim]
    with torch.no_grad():
        _, rows = bodies.advance(state, rows_of(dim, at, way, device=device), 10, 2e-3)
    moved = rows[0, 0, :dim].cpu() - torch.tensor(at, dtype=F64)
    along = torch.tensor(way, dtype=F64)
    assert 0 < float(moved @ along) < 0.0199  # it was slowed
    torch.testing.assert_close(moved, (moved @ along) * along, rtol=1e-12, atol=1e-14)
    assert float(rows[0, 0, -1]) == 0


def test_scenes_of_a_batch_are_independent(device):
    """Bodies of a batch in float64 are those of each scene alone."""
    step, state = material(2, device, scenes=3)
    speeds = (-1.0, -0.5, 0.4)
    rows = torch.cat([rows_of(2, (1.0, 1.2), (0.1, speed), device=device) for speed in speeds])
    with torch.no_grad():
        _, together = FreeBodies(step, [ball_of(2)]).advance(state, rows, 6, 2e-3)
        alone, one = material(2, device)
        for k in range(3):
            _, end = FreeBodies(alone, [ball_of(2)]).advance(one, rows[k : k + 1], 6, 2e-3)
            torch.testing.assert_close(together[k], end[0], rtol=1e-12, atol=1e-13)


def test_parts_of_a_body_and_two_bodies(device):
    """A dumbbell of two discs is pushed as one body; a second body elsewhere is left alone."""
    step, state = material(2, device)
    discs = [Part(mpm.Sphere((0, 0), 0.15, friction=0.3), (side, 0.0)) for side in (-0.2, 0.2)]
    dumbbell = Body(discs, 50.0, 4.0)
    bodies = FreeBodies(step, [dumbbell, ball_of(2, radius=0.1)])
    rows = torch.cat([rows_of(2, (1.4, 1.13), (0.0, -1.0)), rows_of(2, (0.3, 0.3), (0.5, 0.0))], 1).to(device)
    with torch.no_grad():
        state, end = bodies.advance(step.prepare(state), rows, 10, 2e-3)
    assert float(end[0, 0, 5]) < -0.1  # only its left disc is above the block
    torch.testing.assert_close(end[0, 1, 3:], rows[0, 1, 3:], rtol=1e-14, atol=0)
    linear = (state.mass[:, None] * state.v).sum(0) + 50.0 * end[0, 0, 3:5]
    torch.testing.assert_close(linear, 50.0 * rows[0, 0, 3:5], rtol=0, atol=1e-10)


def test_a_hinge_passes_on_angular_momentum_about_its_anchor(device):
    """A disc on a hinge hits the block: the anchor takes momentum, and no angular momentum about itself."""
    step, state = material(2, device)
    anchor, length = (1.5, 1.6), 0.45
    body = ball_of(2, joint=Hinge(anchor))
    bodies = FreeBodies(step, [body])
    arm = (-0.3, -math.sqrt(length**2 - 0.3**2))
    spin = 2.0
    rows = rows_of(2, (anchor[0] + arm[0], anchor[1] + arm[1]), (-spin * arm[1], spin * arm[0]), [spin], device=device)
    state = step.prepare(state)
    with torch.no_grad():
        state, rows = bodies.advance(state, rows, 12, 2e-3)
    bodies.check()
    linear, angular = (values[0] for values in momentum(state, step.grid))
    of_material = float(angular - cross(torch.tensor(anchor, dtype=F64), linear))
    about_anchor = body.inertia[0] + body.mass * length**2
    assert abs(of_material) > 0.01 * about_anchor * spin
    assert of_material + about_anchor * float(rows[0, 0, 5]) == pytest.approx(about_anchor * spin, rel=1e-11)


@pytest.mark.parametrize("gap", [0.05, 0.0, -0.05])
def test_bodies_that_share_nodes(device, gap):
    """Two light discs close together, whose equations are solved as one system: converged, with gradients."""
    step, state = material(2, device)
    bodies = FreeBodies(step, [ball_of(2, 0.3, radius=0.15), ball_of(2, 0.3, radius=0.15)])
    half = 0.15 + gap / 2
    given = torch.cat([rows_of(2, (1.0 + side * half, 1.14), (-0.3 * side, -1.0)) for side in (-1, 1)], 1).to(device)
    weights = torch.linspace(-1, 1, 12, dtype=F64, device=device).reshape(1, 2, 6)

    def loss(rows):
        end, after = bodies.advance(state, rows, 5, 2e-3)
        bodies.check()
        return (after * weights).sum() + (end.v.square() * state.mass[:, None]).sum()

    rows = given.clone().requires_grad_()
    (grad,) = torch.autograd.grad(loss(rows), rows)
    assert bodies.report.iterations <= 6
    way = torch.randn(given.shape, generator=torch.Generator().manual_seed(1), dtype=F64).to(device)
    with torch.no_grad():
        difference = float(loss(given + 1e-6 * way) - loss(given - 1e-6 * way)) / 2e-6
    assert float((grad * way).sum()) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("kind", ["separate", "sticky"])
@pytest.mark.parametrize("ratio", [1e-3, 1.0])
def test_float32(device, kind, ratio):
    """Converged to what the rounding of velocities allows, near the result in float64."""
    ends = []
    for dtype in (torch.float32, F64):
        step, state = material(2, device, dtype)
        body = ball_of(2, ratio)
        body.parts[0].obstacle.kind = kind
        bodies = FreeBodies(step, [body])
        with torch.no_grad():
            ends.append(bodies.advance(state, rows_of(2, (1.05, 1.21), (0.2, -1.0), device=device), 20, 2e-3)[1])
        bodies.check()
    torch.testing.assert_close(*ends, rtol=2e-3, atol=2e-3)


def test_wrenches_act_as_gravity_does(device):
    """A force m g, and a torque that turns a body in free flight: ω = τ t / I."""
    step, state = material(2, device)
    body = ball_of(2, radius=0.05)
    force = torch.tensor([[[0.0, -9.8 * body.mass, 0.5]]], dtype=F64, device=device)
    rows = rows_of(2, (0.2, 1.5), (0.1, 0.0), device=device)
    with torch.no_grad():
        _, pushed = FreeBodies(step, [body]).advance(state, rows, 10, 1e-3, force)
        _, falling = FreeBodies(step, [ball_of(2, radius=0.05)], gravity=(0.0, -9.8)).advance(state, rows, 10, 1e-3)
    torch.testing.assert_close(pushed[..., [0, 1, 3, 4]], falling[..., [0, 1, 3, 4]], rtol=1e-12, atol=0)
    assert float(pushed[0, 0, 5]) == pytest.approx(0.5 * 0.01 / body.inertia[0], rel=1e-12)


def test_a_solve_that_has_not_converged_is_reported(monkeypatch):
    monkeypatch.setattr(mpm.bodies.solution, "MAX_ITERATIONS", 0)
    step, state = material(2)
    bodies = FreeBodies(step, [ball_of(2, 0.1)])
    with torch.no_grad():
        bodies.advance(state, rows_of(2, (1.05, 1.19), (0.2, -1.0)), 3, 2e-3)
    with pytest.raises(mpm.SimulationError, match="body 0 of scene 0 has not converged"):
        bodies.check()


def test_thin_walls_of_bodies_are_reported():
    step, _ = material(2)
    walls = [mpm.Box((0.0, 0.0), (0.8, size)) for size in (0.4, 0.3)]
    with pytest.warns(mpm.ThinWallWarning, match=r"obstacle 1 \(box\) is 3 dx thick") as found:
        FreeBodies(step, [Body(wall, 10.0, 1.0) for wall in walls]).check()
    assert found[0].filename == __file__


def test_what_has_no_derivative_is_an_error():
    """Second derivatives and torch.func; the bodies hold no graph after a step, and inference mode needs none."""
    step, state = material(2)
    bodies = FreeBodies(step, [ball_of(2)])
    rows = rows_of(2, (1.05, 1.19), (0.2, -1.0)).requires_grad_()
    end = bodies.advance(state, rows, 2, 2e-3)[1]
    copy.deepcopy(bodies)
    (first,) = torch.autograd.grad(end.square().sum(), rows, create_graph=True)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        torch.autograd.grad(first.sum(), rows)
    with torch.inference_mode():
        inferred = bodies.advance(state, rows.detach(), 2, 2e-3)[1]
    torch.testing.assert_close(inferred.clone(), end.detach(), rtol=1e-10, atol=1e-12)
    with pytest.raises(NotImplementedError, match=r"torch\.func"):
        torch.func.grad(lambda r: bodies.advance(state, r, 1, 1e-3)[1].sum())(rows.detach())


@pytest.mark.parametrize("joint", [Slider((0.0, 1.0)), Hinge((1.0, 1.5))], ids=["slider", "hinge"])
def test_velocities_that_a_joint_does_not_allow(joint):
    step, state = material(2)
    bodies = FreeBodies(step, [ball_of(2), ball_of(2, joint=joint)])
    rows = torch.cat([rows_of(2, (0.5, 0.5), (1, 0)), rows_of(2, (1.0, 1.2), (1, -1), [2.0])], 1)
    with pytest.raises(ValueError, match="body 1 is on a"):
        bodies.advance(state, rows, 1, 1e-3)


@pytest.mark.parametrize("joint", [None, Slider((0.3, -1.0))], ids=["free", "slider"])
def test_gradients_equal_differences(device, joint):
    """By pose and velocity of the body, its friction, the modulus and the velocity of the material."""
    step, state = material(2, device)
    E = torch.tensor(1e4, dtype=F64, device=device, requires_grad=True)
    friction = torch.tensor(0.2, dtype=F64, device=device, requires_grad=True)
    rows = rows_of(2, (1.03, 1.19), (0.3, -1.0), device=device).requires_grad_()
    speed = torch.tensor([0.1, 0.2], dtype=F64, device=device, requires_grad=True)
    inputs = [rows, friction, E, speed]

    def loss(rows, friction, E, speed):
        own = mpm.Step(step.grid, mpm.NeoHookean(E=E, nu=0.3))
        body = ball_of(2, joint=joint)
        body.parts[0].obstacle.friction = friction
        bodies = FreeBodies(own, [body])
        end, after = bodies.advance(state.replace(v=state.v + speed), rows, 8, 2e-3)
        weights = torch.tensor([1.0, -2.0, 0.5, 0.3, 0.2, 0.1], dtype=F64, device=device)
        return (after * weights).sum() + (end.v.square() * state.mass[:, None]).sum() + end.x[:, 1].sum()

    grads = torch.autograd.grad(loss(*inputs), inputs)
    generator = torch.Generator().manual_seed(0)
    for k, (value, grad) in enumerate(zip(inputs, grads, strict=True)):
        way = torch.randn(value.shape, generator=generator, dtype=F64).to(device)
        h = 1e-6 * max(1.0, float(value.detach().abs().max()))
        with torch.no_grad():
            sides = [loss(*[v + s * h * way if i == k else v for i, v in enumerate(inputs)]) for s in (1, -1)]
        difference = float(sides[0] - sides[1]) / (2 * h)
        assert float((grad * way).sum()) == pytest.approx(difference, rel=1e-6, abs=1e-8), k


def test_mass_and_inertia_may_be_tensors(dim, device):
    """They may change between calls, as numbers may."""
    step, state = material(dim, device)
    inertia = [1.6] if dim == 2 else [1.2, 1.4, 1.6]
    number = FreeBodies(step, [Body(mpm.Sphere((0.0,) * dim, BALL), 80.0, inertia)])
    mass = torch.tensor(8.0, device=device)
    tensor = FreeBodies(step, [Body(mpm.Sphere((0.0,) * dim, BALL), mass, torch.tensor(inertia, device=device))])
    place, velocity = (1.03, 1.19, 0.97)[:dim], (0.3, -1.0, 0.2)[:dim]
    rows = rows_of(dim, place, velocity, [1.0, 2.0, 0.5][: 2 * dim - 3], device)
    light = tensor.advance(state, rows, 8, 2e-3)[1]
    mass.fill_(80.0)
    expected, found = (bodies.advance(state, rows, 8, 2e-3)[1] for bodies in (number, tensor))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7)
    assert not torch.allclose(found, light, rtol=1e-3)


@pytest.mark.parametrize("made", ["without a gradient", "before it requires one"])
@pytest.mark.parametrize("per_axis", [False, True])
def test_gradients_by_mass_and_inertia_of_bodies_made_without(made, per_axis, dim, device):
    """They equal those by tensors that require a gradient when the body is made; a copy has its own parameters."""
    step, state = material(dim, device)
    rows = rows_of(dim, (1.05, 1.19, 0.97)[:dim], (0.2, -1.0, 0.1)[:dim], device=device)
    inertia = torch.full((3 if per_axis and dim == 3 else 1,) if per_axis else (), 1.4, dtype=F64, device=device)
    mass, ball = torch.tensor(80.0, dtype=F64, device=device), mpm.Sphere((0.0,) * dim, BALL, friction=0.4)

    def gradients(body):
        end = FreeBodies(step, [body]).advance(state, rows, 2, 2e-3)[1]
        return torch.autograd.grad(end[..., dim:].square().sum(), (body.mass, body.inertia))

    expected = gradients(Body(ball, mass.clone().requires_grad_(), inertia.clone().requires_grad_()))
    if made == "without a gradient":
        with torch.no_grad():
            body = Body(ball, torch.nn.Parameter(mass), torch.nn.Parameter(inertia))
    else:
        body = Body(ball, mass, inertia)
        mass.requires_grad_()
        inertia.requires_grad_()
    other = copy.deepcopy(body)
    assert other.inertia is not body.inertia and other.inertia.requires_grad
    for found in (gradients(body), gradients(other)):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=0)
    assert all(bool((value != 0).all()) for value in expected)


def test_masses_of_another_device(device):
    if device == "cpu":
        pytest.skip("of CUDA")
    step, state = material(2, device)
    bodies = FreeBodies(step, [Body(mpm.Sphere((0.0, 0.0), BALL), torch.tensor(80.0), 1.6)])
    with pytest.raises(ValueError, match="mass must be on the device of the state"):
        bodies.advance(state, rows_of(2, (1.0, 1.3), (0.0, 0.0), device=device), 1, 1e-3)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda step: FreeBodies(step, []), "bodies must be a list of Body"),
        (lambda step: FreeBodies(step, [mpm.Sphere((0, 0), 0.1)]), "bodies must be a list of Body"),
        (lambda step: Body(mpm.Sphere((0, 0), 0.1), 0.0, 1.0), "mass must be positive"),
        (lambda step: Body(mpm.Sphere((0, 0), 0.1), 1.0, -1.0), "inertia must be positive"),
        (lambda step: Body(mpm.Sphere((0, 0), 0.1), torch.tensor(-1.0), 1.0), "mass must be positive"),
        (lambda step: Body(mpm.Sphere((0, 0), 0.1), torch.ones(2), 1.0), r"mass must have shape \[\], got \[2\]"),
        (lambda step: Body(mpm.Sphere((0, 0), 0.1), 1.0, torch.ones(2)), r"inertia must have shape .* got \[2\]"),
        (
            lambda step: FreeBodies(step, [Body(mpm.Sphere((0, 0), 0.1), 1.0, (1.0, 1.0, 1.0))]),
            "inertia must be a number",
        ),
        (lambda step: FreeBodies(step, [ball_of(2, joint=Hinge((0, 0, 0), (0, 0, 1)))]), "anchor of 2 numbers"),
        (lambda step: FreeBodies(step, [ball_of(2), _of_a_boundary(step)]), "no boundaries of the step"),
        (lambda step: FreeBodies(step, [Body(mpm.Sphere((0, 0), 0.1, end=1.0), 1.0, 1.0)]), "at all times"),
        (lambda step: FreeBodies(step, [Body(mpm.SDF(lambda x: x[:, 0], (0, 0)), 1.0, 1.0)]), "Sampled.of"),
        (lambda step: Slider((0.0, 0.0)), "positive length"),
        (lambda step: Body(mpm.Sphere((0, 0), 0.1), 1.0, 1.0, joint=OwnJoint((1.0, 0.0))), "joint must be a Hinge"),
        (lambda step: FreeBodies(step, [Body(_hooked(), 1.0, 1.0)]), "no hooks"),
    ],
)
def test_wrong_arguments(make, error):
    step, _ = material(2)
    with pytest.raises((TypeError, ValueError), match=error):
        make(step)


class OwnJoint(Slider):
    """A joint that the kernels do not know."""


def _hooked():
    ball = mpm.Sphere((0, 0), 0.1)
    ball.register_forward_hook(lambda *arguments: None)
    return ball


def _of_a_boundary(step):
    """A body whose obstacle is a boundary of the step."""
    ball = mpm.Sphere((0, 0), 0.1)
    step.boundaries.append(ball)
    return Body(ball, 1.0, 1.0)


def test_steps_that_do_not_fit():
    step, state = material(2)
    bodies = FreeBodies(step, [ball_of(2)])
    with pytest.raises(ValueError, match="bodies must have shape"):
        bodies.advance(state, torch.zeros(1, 2, 6), 1, 1e-3)
    with pytest.raises(ValueError, match="n must be"):
        bodies.advance(state, torch.zeros(1, 1, 6), 0, 1e-3)
    step.on_grid = lambda blocks, velocity, mass, dt: velocity
    with pytest.raises(ValueError, match="on_grid"):
        bodies.advance(state, torch.zeros(1, 1, 6), 1, 1e-3)
