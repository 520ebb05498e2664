"""Rigid bodies of another simulator: poses and velocities in, wrenches out; a free body integrated here."""

import itertools
import math

import pytest
import torch
from cases.impulses import F64, cross, momentum
from scipy.spatial.transform import Rotation
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block, unit_box
from torch_mpm.bodies import Part, RigidBodies, moved, with_velocities
from torch_mpm.bodies.exchange import POSE

DT, N = 1e-3, 5


class FreeBody:
    """A free body by semi-implicit Euler, which stores its spin momentum, so that this is kept to rounding."""

    def __init__(self, mass: float, inertia: float | tuple[float, ...], motion: list[float], gravity: float = 0.0):
        self.mass, self.dim, self.gravity = mass, 2 if len(motion) == 6 else 3, gravity
        self.inertia = torch.tensor(inertia, dtype=F64)
        values = torch.tensor(motion, dtype=F64)
        self.x, self.v = values[: self.dim], values[-6:-3] if self.dim == 3 else values[3:5]
        self.turn = Rotation.from_quat(values[3:7], scalar_first=True) if self.dim == 3 else values[2]
        self.spin = self._inertia() @ values[-3:] if self.dim == 3 else self.inertia * values[5]

    def _inertia(self) -> Tensor:
        R = torch.tensor(self.turn.as_matrix(), dtype=F64)
        return R @ torch.diag(self.inertia) @ R.T

    @property
    def omega(self) -> Tensor:
        return torch.linalg.solve(self._inertia(), self.spin) if self.dim == 3 else self.spin / self.inertia

    def row(self) -> Tensor:
        if self.dim == 2:
            return torch.cat([self.x, self.turn[None], self.v, self.omega[None]])
        return torch.cat([self.x, torch.tensor(self.turn.as_quat(scalar_first=True)), self.v, self.omega])

    def step(self, wrench: Tensor, seconds: float) -> None:
        force, torque = wrench[: self.dim], wrench[self.dim :]
        self.v = self.v + seconds * force / self.mass
        self.v[-1] -= seconds * self.gravity
        self.spin = self.spin + seconds * (torque if self.dim == 3 else torque[0])
        self.x = self.x + seconds * self.v
        if self.dim == 3:
            self.turn = Rotation.from_rotvec(seconds * self.omega.numpy()) * self.turn
        else:
            self.turn = self.turn + seconds * self.omega

    def momentum(self) -> tuple[Tensor, Tensor]:
        """Linear and angular about the origin."""
        return self.mass * self.v, cross(self.x, self.mass * self.v) + self.spin


def dumbbell(dim: int, kind: str) -> list[Part]:
    """Two obstacles on a body; one of them is turned."""
    out = (0.12, 0.0, 0.0)[:dim]
    ball, box = (
        mpm.Sphere((0.0,) * dim, 0.1, kind, friction=0.2),
        mpm.Box((0.0,) * dim, (0.15,) * dim, kind, friction=0.2),
    )
    return [Part(ball, out), Part(box, [-a for a in out], 0.4 if dim == 2 else (0.1, 0.3, -0.2))]


def motion(dim: int) -> list[float]:
    if dim == 2:
        return [0.5, 0.68, 0.3, 0.3, -1.5, 4.0]
    half = 0.15
    return [0.5, 0.5, 0.7, math.cos(half), 0.0, math.sin(half), 0.0, 0.3, 0.1, -1.5, 1.0, -3.0, 2.0]


@pytest.mark.parametrize("kind", ["sticky", "separate"])
def test_momentum_of_material_and_body_is_kept(device, dim, kind):
    """Linear and angular, to rounding: the body takes what the material loses, about where it takes it."""
    parts = dumbbell(dim, kind)
    step = mpm.Step(unit_box(dim, 0.1), mpm.NeoHookean(E=2e4, nu=0.2), boundaries=[p.obstacle for p in parts])
    bodies = RigidBodies(step, [parts])
    state = step.with_impulses(step.prepare(block((0.2,) * dim, (0.8,) * (dim - 1) + (0.6,), 0.1, device=device)))
    body = FreeBody(20.0, 0.2 if dim == 2 else (0.1, 0.2, 0.3), motion(dim))

    def total() -> Tensor:
        material = torch.cat([part[0].reshape(-1) for part in momentum(state, step.grid)])
        return material + torch.cat([part.reshape(-1) for part in body.momentum()])

    before, met = total(), 0.0
    for _ in range(12):
        state, wrenches = bodies.advance(state, body.row().to(device)[None, None], N, DT)
        body.step(wrenches[0, 0].cpu(), N * DT)
        met += float(wrenches[0, 0, :dim].norm()) * N * DT
    assert met > 5.0
    assert float((total() - before).abs().max()) < 1e-12 * met


def test_a_slab_carries_a_body_along():
    """A perfectly inelastic impact: both end with the velocity of their common centre of mass."""
    grid = mpm.Grid(0.1, (0.0, 0.0), (3.0, 1.0))
    ball = mpm.Box((0.0, 0.0), (0.4, 0.4), "sticky")
    law = mpm.NeoHookean(E=2e4, nu=0.2)
    step = mpm.Step(grid, law, boundaries=[ball], transfer="pic")
    bodies = RigidBodies(step, [ball])
    state = block((0.3, 0.3), (0.8, 0.7), grid, velocity=(2.0, 0.0))
    body = FreeBody(100.0, 5.0, [1.05, 0.5, 0.0, 0.0, 0.0, 0.0])
    for _ in range(60):
        state, wrenches = bodies.advance(state, body.row()[None, None], 10, DT)
        body.step(wrenches[0, 0], 10 * DT)
    slab = float(state.mass.sum())
    expected = 2.0 * slab / (slab + 100.0)
    assert float(body.v[0]) == pytest.approx(expected, rel=1e-2)
    assert float(state.v[:, 0].mean()) == pytest.approx(expected, rel=1e-2)
    assert float(body.v[1].abs()) < 1e-3


def test_a_ball_comes_to_rest_on_a_block():
    """It is carried with its weight; the wrench has no torque then."""
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0))
    ball = mpm.Sphere((0.0, 0.0), 0.2)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.2), (0.0, -9.8), walls="slip", boundaries=[ball], transfer="pic")
    bodies = RigidBodies(step, [ball])
    state = block((0.0, 0.0), (1.0, 0.5), grid)
    body = FreeBody(150.0, 3.0, [0.5, 0.85, 0.0, 0.0, 0.0, 0.0], gravity=9.8)
    forces = []
    for _ in range(150):
        state, wrenches = bodies.advance(state, body.row()[None, None], 10, DT)
        body.step(wrenches[0, 0], 10 * DT)
        forces.append(wrenches[0, 0])
    mean = torch.stack(forces[-50:]).mean(0)
    assert max(float(force[1]) for force in forces) > 2 * 150.0 * 9.8  # of the impact
    assert float(mean[1]) == pytest.approx(150.0 * 9.8, rel=1e-2)
    assert float(mean[[0, 2]].abs().max()) < 1e-6 * 150.0 * 9.8
    assert 0.5 < float(body.x[1]) < 0.8 and float(body.v.abs().max()) < 0.02


def test_the_error_is_of_first_order_in_the_interval():
    """Differences of intervals of 2, 4, 8 and 16 steps, of a plate that shakes on a block."""

    def end(n: int) -> Tensor:
        plate = mpm.Box((0.0, 0.0), (0.5, 0.13), "sticky")
        law = mpm.NeoHookean(E=2e4, nu=0.2)
        step = mpm.Step(unit_box(2, 0.1), law, boundaries=[plate], walls="sticky")
        bodies, state = RigidBodies(step, [plate]), block((0.2, 0.0), (0.8, 0.5), 0.1)
        body = FreeBody(100.0, 2.0, [0.51, 0.52, 0.0, 0.0, -0.01, 0.02])
        for _ in range(256 // n):
            state, wrenches = bodies.advance(state, body.row()[None, None], n, 2e-4)
            body.step(wrenches[0, 0], n * 2e-4)
        return torch.cat([body.v, body.spin[None]])

    ends = [end(n) for n in (2, 4, 8, 16)]
    changes = [float((b - a).norm()) for a, b in itertools.pairwise(ends)]
    for smaller, larger in itertools.pairwise(changes):
        assert larger / smaller == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("mass", [50.0, 200.0])
def test_the_limit_of_the_mass(mass):
    """A body that carries material answers each change of its velocity by another one, with the ratio of the masses."""
    shell = mpm.Box((0.0, 0.0), (0.9, 0.9), "sticky")
    step = mpm.Step(unit_box(2, 0.1), mpm.NeoHookean(E=1.0, nu=0.2), boundaries=[shell])
    bodies, state = RigidBodies(step, [shell]), block((0.3, 0.3), (0.7, 0.6), 0.1)
    body = FreeBody(mass, 1e9, [0.5, 0.5, 0.0, 0.01, 0.0, 0.0])
    speeds = [0.0]
    for _ in range(6):
        speeds.append(float(body.v[0]))
        state, wrenches = bodies.advance(state, body.row()[None, None], 3, DT)
        body.step(wrenches[0, 0], 3 * DT)
    changes = [b - a for a, b in itertools.pairwise(speeds)]
    for before, after in itertools.pairwise(changes):
        assert after / before == pytest.approx(-float(state.mass.sum()) / mass, rel=1e-6)


# ---- poses


def row_of(turn: Rotation, x: list[float], v: list[float], omega: list[float]) -> Tensor:
    return torch.tensor([*x, *turn.as_quat(scalar_first=True), *v, *omega], dtype=F64)


def test_obstacles_are_where_the_body_is(device):
    """Each at its place on the body, with the velocity of the body there, from the time of the state on."""
    at, own = (0.1, -0.05, 0.02), Rotation.from_rotvec((0.5, -1.0, 0.3))
    box = mpm.Box((0.0, 0.0, 0.0), (0.2, 0.2, 0.2))
    step = mpm.Step(
        unit_box(3, 0.1, scenes=2), mpm.NeoHookean(E=1e4, nu=0.2), boundaries=[mpm.Sphere((0.1,) * 3, 0.1), box]
    )
    bodies = RigidBodies(step, [Part(box, at, tuple(own.as_rotvec()))])
    scene = torch.tensor([0, 1], dtype=torch.int32)
    state = mpm.State(torch.full((2, 3), 0.9, dtype=F64), torch.zeros(2, 3, dtype=F64), *torch.ones(2, 2).double())
    state = state.replace(scene=scene, time=0.7).to(device)
    turns = [Rotation.from_rotvec((0.0, 0.0, 3.0)), Rotation.from_rotvec((-2.0, 0.7, 1.0))]
    xs, v, omega = [[0.4, 0.5, 0.6], [0.3, 0.2, 0.6]], [0.2, -0.1, 0.3], [2.0, -5.0, 1.0]
    rows = torch.stack([row_of(turn, x, v, omega) for turn, x in zip(turns, xs, strict=True)])[:, None]
    rows[1, :, 3:7] *= -1  # the same rotation
    end, _ = bodies.advance(state, rows.to(device), 4, 5e-3)
    for time, pose in ((0.7, box.pose(0.7, state.x)), (end.time, box.pose_in(end))):
        for b, (turn, x) in enumerate(zip(turns, xs, strict=True)):
            arm = torch.tensor(turn.apply(at))
            rate = torch.tensor(v, dtype=F64) + torch.linalg.cross(torch.tensor(omega, dtype=F64), arm)
            expected = torch.tensor(x, dtype=F64) + arm + (time - 0.7) * rate
            torch.testing.assert_close(pose.centre[b].cpu(), expected, rtol=0, atol=1e-12)
            turned = Rotation.from_rotvec([(time - 0.7) * rate for rate in omega]) * turn * own
            torch.testing.assert_close(pose.rotation[b].cpu(), torch.tensor(turned.as_matrix()), rtol=0, atol=1e-12)
    matter = box.velocity_at(torch.zeros(2, 3, dtype=F64, device=device), scene.to(device), 0.7)
    torch.testing.assert_close(matter[0].cpu(), v_at(v, omega, turns[0].apply(at)), rtol=0, atol=1e-12)


def v_at(v: list[float], omega: list[float], arm: object) -> Tensor:
    return torch.tensor(v, dtype=F64) + torch.linalg.cross(torch.tensor(omega, dtype=F64), torch.as_tensor(arm))


def test_velocities_of_a_change():
    begin, turn = Rotation.from_rotvec((1.0, 2.0, -0.5)), (0.3, -0.2, 0.9)
    end = Rotation.from_rotvec(turn) * begin
    poses = [row_of(r, x, [9.0] * 3, [9.0] * 3)[None, None] for r, x in ((begin, [0.0, 1.0, 2.0]), (end, [0.1, 1, 1]))]
    found = with_velocities(*poses, 0.5)
    torch.testing.assert_close(found[0, 0, :7], poses[0][0, 0, :7])
    torch.testing.assert_close(found[0, 0, 7:10], torch.tensor([0.2, 0.0, -2.0], dtype=F64))
    torch.testing.assert_close(found[0, 0, 10:], 2 * torch.tensor(turn, dtype=F64))
    flat = with_velocities(torch.tensor([[[0.0, 0.0, 3.0]]]), torch.tensor([[[1.0, 0.0, -3.0]]]), 0.1)
    torch.testing.assert_close(flat[0, 0], torch.tensor([0.0, 0.0, 3.0, 10.0, 0.0, 10 * (2 * math.pi - 6.0)]))
    with pytest.raises(ValueError, match="seconds must be positive"):
        with_velocities(*poses, 0.0)
    with pytest.raises(ValueError, match=r"poses must have shape .*, got \[1, 1, 5\]"):
        with_velocities(poses[0][..., :5], poses[1], 0.1)
    with pytest.raises(ValueError, match=r"later must have the dimension of poses, 3, got \[1, 1, 3\]"):
        with_velocities(poses[0], poses[1][..., :3], 0.1)


@pytest.mark.parametrize("dim", [2, 3])
def test_moved_poses_are_those_of_scipy(dim):
    rows = torch.tensor([[motion(dim)]], dtype=F64)
    found, seconds = moved(rows, 0.3)[0, 0], 0.3
    columns = POSE[dim]
    torch.testing.assert_close(found[:dim], (rows[..., :dim] + seconds * rows[..., columns : columns + dim])[0, 0])
    if dim == 2:
        assert float(found[2]) == pytest.approx(float(rows[0, 0, 2] + seconds * rows[0, 0, 5]))
    else:
        turn = Rotation.from_rotvec(seconds * rows[0, 0, 10:].numpy())
        expected = turn * Rotation.from_quat(rows[0, 0, 3:7].numpy(), scalar_first=True)
        assert (expected.inv() * Rotation.from_quat(found[3:].numpy(), scalar_first=True)).magnitude() < 1e-12
    torch.testing.assert_close(with_velocities(rows, moved(rows, seconds), seconds), rows)
    with pytest.raises(ValueError, match=rf"bodies must have shape .*, got \[1, 1, {columns}\]"):
        moved(rows[..., :columns], 0.1)


# ---- batches and gradients


@pytest.mark.parametrize("per_scene", [False, True])
def test_scenes_are_those_of_single_runs(device, per_scene):
    """Also where a scene has another time step, or is paused."""
    rows = torch.tensor([[0.5, 0.62, 0.1, 0.5, -1.0, 2.0], [0.4, 0.65, -0.4, 0.0, -2.0, 0.0]], dtype=F64, device=device)
    steps = torch.tensor([DT, 0.5 * DT], dtype=F64, device=device)

    def run(scenes: list[int]) -> tuple[mpm.State, Tensor]:
        parts = dumbbell(2, "separate")
        step = mpm.Step(
            unit_box(2, 0.1, scenes=len(scenes)), mpm.NeoHookean(E=2e4, nu=0.2), boundaries=[p.obstacle for p in parts]
        )
        state = block((0.2, 0.2), (0.8, 0.6), 0.1, device=device)
        states = mpm.State.concatenate([state] * len(scenes), scene=True) if len(scenes) > 1 else state
        dt = steps[scenes] if per_scene else DT
        return RigidBodies(step, [parts]).advance(states, rows[scenes][:, None], N, dt)

    both, wrenches = run([0, 1])
    for b in (0, 1):
        single, wrench = run([b])
        torch.testing.assert_close(wrenches[b], wrench[0], rtol=1e-10, atol=1e-9)
        torch.testing.assert_close(both.v[both.scene == b], single.v, rtol=1e-10, atol=1e-12)
    assert float(wrenches.abs().amax((1, 2)).min()) > 1.0
    steps[1] = 0.0
    if per_scene:
        assert (run([0, 1])[1][1] == 0).all()


def test_bodies_of_environments(device):
    """`move` before `advance`, and impulses of it; also in a scene that was reset, whose clock is another one."""
    ball = mpm.Sphere((0.0, 0.0), 0.15)
    step = mpm.Step(unit_box(2, 0.1, scenes=2), mpm.NeoHookean(E=2e4, nu=0.2), boundaries=[ball])
    envs = mpm.Environments(step, [block((0.2, 0.2), (0.8, 0.6), 0.1, device=device)] * 2)
    envs.count_impulses()
    bodies = RigidBodies(step, [ball])
    row = torch.tensor([[[0.5, 0.62, 0.0, 0.5, -1.0, 2.0]]] * 2, dtype=F64, device=device)
    found = []
    for _ in range(2):
        bodies.move(row, envs.state)
        before = envs.state
        envs.advance(N, DT)
        found.append(bodies.impulses(before, envs.state, row))
        envs.reset([1])
    assert float(found[0][0].abs().max()) > 0.01
    torch.testing.assert_close(found[0][1], found[0][0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-10, atol=1e-10)
    assert not torch.allclose(found[1][0], found[0][0])


def test_gradients_of_wrenches():
    parts = dumbbell(2, "separate")
    step = mpm.Step(unit_box(2, 0.1), mpm.NeoHookean(E=2e4, nu=0.2), boundaries=[p.obstacle for p in parts])
    bodies, state = RigidBodies(step, [parts]), block((0.2, 0.2), (0.8, 0.6), 0.1)
    pose = torch.tensor(motion(2)[:3], dtype=F64)

    def wrench(velocity: Tensor) -> Tensor:
        return bodies.advance(state, torch.cat([pose, velocity])[None, None], 3, DT)[1]

    velocity = torch.tensor(motion(2)[3:], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(wrench, velocity, atol=1e-4, rtol=1e-5)


# ---- errors

VALID = torch.tensor([[[0.5, 0.5, 0.5, 1.0, 0.0, 0.0, 0.0, *[0.0] * 6]]], dtype=F64)


@pytest.mark.parametrize(
    ("bodies", "error", "message"),
    [
        (VALID[0], ValueError, r"bodies must have shape \[B, K, 13\] = \[1, 1, 13\], got \[1, 13\]"),
        (VALID[..., :7], ValueError, r"got \[1, 1, 7\]"),
        (VALID.expand(2, 1, 13), ValueError, r"got \[2, 1, 13\]"),
        (VALID.tolist(), ValueError, "got list"),
        (VALID.long(), TypeError, "bodies must be float32 or float64, got torch.int64"),
        (VALID.to("meta"), ValueError, "bodies must be on the device of the state, cpu, got meta"),
        (VALID.where(VALID != 1, torch.nan), ValueError, "finite, got NaN or infinity for body 0 of scene 0"),
        (2 * VALID, ValueError, "unit quaternions w, x, y, z in columns 3 to 6, got another length for body 0"),
    ],
)
def test_wrong_poses(bodies, error, message):
    ball = mpm.Sphere((0.0,) * 3, 0.1)
    step = mpm.Step(unit_box(3, 0.1), mpm.NeoHookean(E=1e4, nu=0.2), boundaries=[ball])
    with pytest.raises(error, match=message):
        RigidBodies(step, [ball]).advance(block((0.2,) * 3, (0.3,) * 3, 0.1), bodies, 1, DT)


def test_errors():
    ball, other = mpm.Sphere((0.0, 0.0), 0.1), mpm.Sphere((0.0, 0.0), 0.1)
    step = mpm.Step(unit_box(2, 0.1), mpm.NeoHookean(E=1e4, nu=0.2), boundaries=[ball])
    for given, error, message in (
        ([ball, ball], ValueError, "obstacles of body 1 must be boundaries of the step, and those of no other body"),
        ([other], ValueError, "obstacles of body 0 must be boundaries"),
        ([ball, []], ValueError, "body 1 must have an obstacle"),
        (["ball"], TypeError, "obstacle must be an Obstacle, got str"),
        (ball, TypeError, "bodies must be a list"),
        ([Part(ball, (0.0, 0.0, 0.0))], ValueError, "position of a part must have 2 numbers"),
        ([Part(ball, None, (0.0, 0.0, 0.0))], ValueError, "rotation of a part must be an angle in 2-D"),
    ):
        with pytest.raises(error, match=message):
            RigidBodies(step, given)
    with pytest.raises(TypeError, match="step must be a Step"):
        RigidBodies(ball, [ball])
    with pytest.raises(ValueError, match="got a function of time"):
        Part(mpm.Sphere(lambda t: torch.zeros(2), 0.1))
    state, rows = block((0.2, 0.2), (0.3, 0.3), 0.1), torch.zeros(1, 1, 6, dtype=F64)
    for n, dt, message in ((0, DT, "n must be at least 1"), (1, -DT, "dt must be")):
        with pytest.raises(ValueError, match=message):
            RigidBodies(step, [ball]).advance(state, rows, n, dt)
    with pytest.raises(ValueError, match=r"state\.impulse is None"):
        RigidBodies(step, [ball]).impulses(state, state)
    counted = step.with_impulses(state)
    with pytest.raises(ValueError, match=r"about must have shape \[B, K, D\] = \[1, 1, 2\], got \[1, 2\]"):
        RigidBodies(step, [ball]).impulses(counted, counted, rows[0, :, :2])
