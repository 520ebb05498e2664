"""Scenes side by side: each with its own size, clock and end; replaced where they stand."""

import numpy as np
import pytest
import torch
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block
from torch_mpm.step import particle_operations

F64 = torch.float64
DT, N = 1e-3, 8


def one(k: int, device: str = "cpu", **options) -> mpm.State:
    """A block of its own size and throw."""
    return block((0.2, 0.3), (0.4 + 0.05 * k, 0.5), 0.1, velocity=(1.0 - k, 0.5 * k), device=device, **options)


def step_of(scenes: int, device: str = "cpu", law: mpm.Material | None = None, **options) -> mpm.Step:
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0), scenes=scenes, deterministic=True)
    gravity = torch.tensor([[0.5 * k, -9.8] for k in range(scenes)], dtype=F64, device=device)
    E = torch.tensor([1e4 * (1 + k) for k in range(scenes)], dtype=F64, device=device)
    law = mpm.NeoHookean(E, 0.3) if law is None else law
    given = {"walls": "separate", "boundaries": [mpm.Sphere((0.5, 0.1), 0.2, friction=0.3)]} | options
    return mpm.Step(grid, law, gravity, **given)


def alone(step: mpm.Step, k: int, state: mpm.State, n: int, dt: float = DT) -> mpm.State:
    """Scene k by itself."""
    law = mpm.NeoHookean(step.law.E[k : k + 1], 0.3)
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0), deterministic=True)
    single = mpm.Step(grid, law, step.gravity[k], walls=step.walls, boundaries=list(step.boundaries))
    return mpm.rollout(single, single.with_impulses(state), n, dt)


def fields(state: mpm.State) -> dict[str, Tensor]:
    found = {name: getattr(state, name) for name in ("x", "v", "mass", "volume", "C", "F", "impulse")}
    return {name: t for name, t in (found | state.extra).items() if t is not None}


def assert_equal(a: mpm.State, b: mpm.State, exactly: bool = True) -> None:
    left, right = fields(a), fields(b)
    assert left.keys() == right.keys()
    for name, value in left.items():
        if exactly:
            assert torch.equal(value, right[name]), name
        else:
            torch.testing.assert_close(value, right[name], rtol=1e-9, atol=1e-9, msg=name)


def environments(device: str, count: int = 4) -> mpm.Environments:
    envs = mpm.Environments(step_of(count, device), [one(k, device) for k in range(count)])
    envs.count_impulses()
    return envs


def test_scenes_of_any_size_are_what_they_are_alone(device):
    """Each has its own size, throw, stiffness and gravity; absent particles have no effect and are not reported."""
    envs = environments(device)
    assert envs.step.explain(envs.state).startswith("all steps in one op")
    envs.advance(N, DT)
    for k in range(4):
        assert_equal(envs.scene(k), alone(envs.step, k, one(k, device), N), exactly=False)
    envs.step.check(envs.state)
    assert not envs.failed.any()
    assert envs.present.sum(1).tolist() == [len(one(k)) for k in range(4)]
    x = envs.observe("x")
    assert x.shape == (4, envs.room, 2) and (x[~envs.present] == 0).all()
    assert torch.equal(envs.observe("x", padded=False), torch.cat([envs.scene(k).x for k in range(4)]))


@pytest.mark.parametrize("form", ["mask", "indices", "states", "packed"])
def test_a_reset_replaces_scenes_and_leaves_the_others(device, form):
    envs, other = environments(device), environments(device)
    for e in (envs, other):
        e.advance(N, DT)
    storage = envs.state.x.data_ptr()
    new = [one(0, device), one(3, device)]  # of other sizes than those they replace
    if form == "mask":
        envs.reset(torch.tensor([False, True, False, True], device=device))
    elif form == "indices":
        envs.reset([3, 1])
    elif form == "states":
        envs.reset([1, 3], new)
    else:
        envs.reset(torch.tensor([1, 3], device=device), envs.pack(new))
    assert envs.state.x.data_ptr() == storage
    assert torch.equal(envs.time, other.time * torch.tensor([1.0, 0.0, 1.0, 0.0], dtype=F64, device=device))
    for e in (envs, other):
        e.advance(N, DT)
    for k in (0, 2):
        assert_equal(envs.scene(k), other.scene(k), exactly=device == "cpu")
    for k, state in zip((1, 3), new if form in ("states", "packed") else (one(1, device), one(3, device)), strict=True):
        assert_equal(envs.scene(k), alone(envs.step, k, state, N), exactly=False)
    assert envs.time.tolist() == pytest.approx([2 * N * DT, N * DT, 2 * N * DT, N * DT])


def test_a_lost_scene_is_frozen_reported_and_reset(device):
    envs, other = environments(device), environments(device)
    v = envs.observe("v").clone()
    v[2] = torch.nan
    envs.state = envs.state.replace(v=v.reshape(-1, 2))
    for e in (envs, other):
        e.advance(2, DT)
    assert envs.failed.tolist() == [False, False, True, False]
    envs.freeze()
    still = envs.scene(2).x.clone()
    for e in (envs, other):
        e.advance(N, DT)
    torch.testing.assert_close(envs.scene(2).x, still, rtol=0, atol=0, equal_nan=True)
    assert envs.frozen.tolist() == [False, False, True, False]
    assert envs.time.tolist() == pytest.approx([(N + 2) * DT, (N + 2) * DT, 2 * DT, (N + 2) * DT])
    with pytest.raises(mpm.SimulationError, match="in scene 2"):
        envs.step.check()
    envs.reset(envs.frozen)
    assert not envs.failed.any() and not envs.frozen.any()
    envs.step.check(envs.state)
    for e in (envs, other):
        e.advance(N, DT)
    assert_equal(envs.scene(2), alone(envs.step, 2, one(2, device), N), exactly=False)
    for k in (0, 1, 3):
        assert_equal(envs.scene(k), other.scene(k), exactly=device == "cpu")


def test_clocks_of_heat(device):
    """Functions of time receive the time of each scene."""
    seen = []
    flux = mpm.heat_boundaries.Flux(mpm.heat_boundaries.FreeSurface(), lambda time: seen.append(time) or 0.0 * time)
    step = step_of(2, device)
    step.heat = mpm.Heat(step.grid, conductivity=1.0, specific_heat=1.0, boundaries=[flux])
    states = [one(k, device) for k in range(2)]
    envs = mpm.Environments(step, [state.replace(temperature=torch.ones_like(state.mass)) for state in states])
    envs.advance(2, DT)
    envs.time[1] = 0.5
    envs.advance(1, DT)
    assert seen[-1].tolist() == pytest.approx([2 * DT, 0.5])


@pytest.mark.parametrize("change", ["none", "reset", "frozen", "velocity", "number", "loaded", "rollout"])
def test_the_state_has_the_time_of_each_scene(change, device, tmp_path):
    """A rollout of the state meets the same obstacles on paths as the next call, with clocks counted here."""
    ball = mpm.Sphere(lambda time: torch.stack([0.2 + 20 * time, 0.45 + 0 * time], -1), 0.1)
    step = step_of(2, device, boundaries=[ball])
    envs = mpm.Environments(step, [one(0, device)] * 2)
    for _ in range(3):
        envs.advance(N, DT)
    expected = [3 * N * DT, 3 * N * DT]
    if change == "reset":
        envs.reset([1])
        expected[1] = 0.0
    elif change == "frozen":
        envs.freeze([0])
        envs.advance(N, DT)
        expected[1] = 4 * N * DT
    elif change == "velocity":
        envs.state = envs.state.replace(v=2 * envs.state.v)
    elif change == "number":
        envs.state = envs.state.replace(time=0.0)
    elif change == "loaded":
        envs.save(tmp_path / "envs.h5")
        envs = mpm.Environments(step, [one(0, device)] * 2)
        envs.load(tmp_path / "envs.h5")
    elif change == "rollout":
        envs.state = mpm.rollout(step, envs.state, N, DT)
        expected = [4 * N * DT, 4 * N * DT]
    assert envs.state.time.tolist() == pytest.approx(expected) == envs.time.tolist()
    after = mpm.rollout(step, envs.state, N, DT)
    moving = (envs.state.scene != -1)[:, None]
    envs.advance(N, DT)
    torch.testing.assert_close(torch.where(moving, after.x, envs.state.x), envs.state.x, rtol=0, atol=1e-6)
    assert envs.scene(1).time == pytest.approx(expected[1] + N * DT)


def test_clocks_of_moving_obstacles(device):
    """A reset scene sees its paddle begin anew."""
    paddle = mpm.Box((0.5, 0.0), (0.2, 0.2), velocity=(0.0, 5.0), end=2.5 * N * DT)
    step = step_of(3, device, boundaries=[paddle])
    envs = mpm.Environments(step, [one(0, device)] * 3)
    assert step.explain(envs.state, DT).startswith("all steps in one op")
    envs.count_impulses()
    envs.advance(N, DT)
    envs.reset([1])
    envs.advance(N, DT)
    for k, n in ((0, 2 * N), (1, N), (2, 2 * N)):
        assert_equal(envs.scene(k), alone(step, k, one(0, device), n), exactly=False)


def test_time_steps_of_each_scene(device):
    dt = torch.tensor([DT, 0.0, 0.5 * DT], dtype=F64, device=device)
    envs = mpm.Environments(step_of(3, device), [one(k, device) for k in range(3)])
    before = envs.scene(1)
    envs.count_impulses()
    envs.advance(N, dt)
    assert envs.time.tolist() == pytest.approx([N * DT, 0.0, 0.5 * N * DT])
    assert torch.equal(envs.scene(1).x, before.x)
    assert_equal(envs.scene(0), alone(envs.step, 0, one(0, device), N), exactly=False)
    assert_equal(envs.scene(2), alone(envs.step, 2, one(2, device), N, 0.5 * DT), exactly=False)


def test_control_by_poses_and_forces(device):
    """A pose for each scene at each control step; the force is impulse over time, and zero where a scene was reset."""
    paddle = mpm.Sphere(torch.tensor([[0.3, 0.2]] * 3, dtype=F64, device=device), 0.15, kind="sticky")
    step = step_of(3, device, boundaries=[paddle])
    envs = mpm.Environments(step, [one(k, device) for k in range(3)])
    with pytest.raises(ValueError, match="impulses must be counted"):
        envs.forces()
    envs.count_impulses()
    for _ in range(3):
        paddle.position = paddle.position + torch.tensor([[0.0, 0.01 * b] for b in range(3)], dtype=F64, device=device)
        before = envs.state.impulse.clone()
        envs.advance(N, DT)
        force = envs.forces()
        change = (envs.state.impulse - before) / (N * DT)
        torch.testing.assert_close(force.values, change)
    assert torch.equal(force[paddle].linear, force.values[:, 0, :2])
    assert float(force["-y"].linear.abs().max()) >= 0
    envs.reset([2])
    assert (envs.forces().values[2] == 0).all() and (envs.state.impulse[2] == 0).all()


def test_materials_histories_and_heat(device):
    """Fields that a step makes are there from the beginning, and are reset too."""
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0), scenes=2, deterministic=True)
    law = mpm.VonMises(E=1e4, nu=0.3, yield_stress=1.0, hardening=100.0)
    step = mpm.Step(grid, law, (0.0, -9.8), "sticky", heat=mpm.Heat(grid, 1e3, 100.0))
    states = [one(k, device).replace(temperature=torch.ones_like(one(k, device).mass)) for k in (0, 2)]
    envs = mpm.Environments(step, states)
    first = {name: t.clone() for name, t in fields(envs.state).items()}
    envs.advance(250, DT)
    assert float(envs.observe("plastic_strain").max()) > 0
    envs.reset([0, 1])
    for name, value in fields(envs.state).items():
        assert torch.equal(value, first[name]), name


def test_files(device, tmp_path):
    pytest.importorskip("h5py")
    envs, again = environments(device), environments(device)
    envs.advance(N, DT)
    envs.freeze([3])
    envs.save(tmp_path / "all.h5")
    envs.save(tmp_path / "one.h5", 2)
    again.load(tmp_path / "all.h5")
    for e in (envs, again):
        e.advance(N, DT)
    assert torch.equal(envs.time, again.time) and torch.equal(envs.frozen, again.frozen)
    for k in range(4):
        assert_equal(envs.scene(k), again.scene(k), exactly=device == "cpu")
    other = environments(device)
    other.load(tmp_path / "one.h5", 2)
    assert other.time.tolist() == pytest.approx([0.0, 0.0, N * DT, 0.0])
    other.advance(N, DT)
    assert_equal(envs.scene(2), other.scene(2), exactly=False)
    with pytest.raises(ValueError, match="must hold one scene"):
        other.load(tmp_path / "all.h5", 1)
    with pytest.raises(ValueError, match="must hold 4 scenes"):
        other.load(tmp_path / "one.h5")


def test_errors(device):
    step = step_of(2, device)
    with pytest.raises(ValueError, match="states must be a list of the 2 scenes of the grid, got 1"):
        mpm.Environments(step, [one(0, device)])
    with pytest.raises(ValueError, match=r"states\[1\] must have at most 16 particles"):
        mpm.Environments(step, [one(0, device), one(3, device)], room=16)
    with pytest.raises(ValueError, match="states must have at least one particle each"):
        mpm.Environments(step, [one(0, device), one(0, device).select(torch.arange(0, device=device))])
    with pytest.raises(TypeError, match="step must be a Step"):
        mpm.Environments(step.law, [one(0, device)] * 2)
    envs = mpm.Environments(step, [one(0, device), one(1, device)])
    with pytest.raises(ValueError, match="states must be 2, one for each scene to reset, got 1"):
        envs.reset([0, 1], [one(0, device)])
    with pytest.raises(ValueError, match=r"a mask of scenes must have shape \[B\] = \[2\], got \[3\]"):
        envs.reset(torch.ones(3, dtype=torch.bool, device=device))
    with pytest.raises(ValueError, match=r"states must be torch\.float64"):
        envs.reset([0], [one(0, device).to(dtype=torch.float32)])
    with pytest.raises(ValueError, match="states must have no material"):
        envs.reset([0], [one(0, device).replace(material=torch.zeros(len(one(0)), dtype=torch.int32, device=device))])
    with pytest.raises(ValueError, match=r"scenes must be from 0 to 1, got \[2\]"):
        envs.reset([2])
    with pytest.raises(ValueError, match="name must be that of a field"):
        envs.observe("colour")
    with pytest.raises(ValueError, match="k must be a scene from 0 to 1"):
        envs.scene(2)


# ---- absent particles and clocks in what acts on particles


def test_each_scene_is_prepared_by_itself(device):
    """Scenes at one place, with temperatures that would cancel."""
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0), scenes=2)
    heat = mpm.Heat(grid, conductivity=5.0, specific_heat=800.0)
    step = mpm.Step(grid, mpm.NeoHookean(1e4, 0.3), heat=heat)
    states = [one(1, device), one(1, device)]
    states = [s.replace(temperature=sign * 100 * s.x[:, 0]) for s, sign in zip(states, (1, -1), strict=True)]
    envs = mpm.Environments(step, states, room=len(states[0]) + 3)
    gradient = envs.first.extra["temperature_gradient"].reshape(2, envs.room, 2)
    torch.testing.assert_close(gradient[0], -gradient[1])
    assert float(gradient[0, :, 0].max()) > 50
    envs.advance(3, torch.tensor([DT, 2 * DT], dtype=F64, device=device))
    assert all(bool(envs.scene(k).temperature.isfinite().all()) for k in range(2))


def test_operations_on_particles_see_the_clocks(device):
    push = particle_operations.Push((1.0, 0.0), start=2.5 * DT, end=6.5 * DT)
    step = step_of(2, device, on_particles=push, boundaries=[], walls=None)
    envs = mpm.Environments(step, [one(0, device), one(1, device)])
    plain = mpm.Environments(step_of(2, device, boundaries=[], walls=None), [one(0, device), one(1, device)])
    for _ in range(4):
        envs.advance(2, torch.tensor([DT, DT / 2], dtype=F64, device=device))
        plain.advance(2, torch.tensor([DT, DT / 2], dtype=F64, device=device))
    for k, (steps, dt) in enumerate(((4, DT), (3, DT / 2))):  # 3, 4, 5, 6; and 5, 6, 7 half steps
        gained = envs.scene(k).mass[:, None] * (envs.scene(k).v - plain.scene(k).v)
        expected = torch.tensor([steps * dt * len(one(k)), 0.0], dtype=F64, device=device)
        torch.testing.assert_close(gained.sum(0), expected, rtol=1e-6, atol=1e-9)


def test_absent_particles_have_no_part_in_gradients_and_batches(device):
    envs = mpm.Environments(step_of(3, device), [one(k, device) for k in range(3)])
    E = torch.tensor([1e4, 2e4, 3e4], dtype=F64, device=device, requires_grad=True)
    step = step_of(3, device, mpm.NeoHookean(E, 0.3))
    mpm.rollout(step, envs.state, 3, DT).x.square().sum().backward()
    for k in range(3):
        own = E.detach()[k : k + 1].clone().requires_grad_()
        single = alone_step(step, k, mpm.NeoHookean(own, 0.3))
        mpm.rollout(single, one(k, device), 3, DT).x.square().sum().backward()
        torch.testing.assert_close(E.grad[k], own.grad[0], rtol=1e-9, atol=0)
    joined = mpm.State.concatenate([envs.state, envs.state], scene=True, scenes=[3, 3])
    assert int((joined.scene == -1).sum()) == 2 * int((envs.state.scene == -1).sum())
    parts = joined.replace(impulse=torch.zeros(6, 5, 3, dtype=F64, device=device)).split(6)
    assert [len(p) for p in parts] == [len(one(k % 3)) for k in range(6)]
    assert all(p.impulse.shape[0] == 1 for p in parts)


def alone_step(step: mpm.Step, k: int, law: mpm.Material) -> mpm.Step:
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0), deterministic=True)
    return mpm.Step(grid, law, step.gravity[k], walls=step.walls, boundaries=list(step.boundaries))


def test_frozen_scenes_stand_still_whatever_their_law(device):
    law = mpm.Viscoelastic(E=1e4, nu=0.3, branch_modulus=1e4, relaxation_time=1e-2)
    envs = mpm.Environments(step_of(2, device, law), [one(0, device), one(1, device)])
    envs.advance(5, DT)
    envs.freeze([1])
    before = envs.state.map(torch.clone)
    envs.advance(5, DT)
    frozen = slice(envs.room, None)
    for name, value in fields(envs.state).items():
        assert torch.equal(value[frozen], fields(before)[name][frozen]), name
    assert not torch.equal(envs.state.x[: envs.room], before.x[: envs.room])


def test_scenes_are_named_by_masks_or_whole_numbers(device):
    envs = environments(device)
    envs.advance(2, DT)
    envs.forces()
    envs.reset([False, False, False, True])
    assert envs.time.tolist() == pytest.approx([2 * DT] * 3 + [0.0])
    with pytest.raises(TypeError, match="must be a mask or whole numbers"):
        envs.freeze(torch.tensor([1.7]))
    with pytest.raises(ValueError, match="from 0 to 3"):
        envs.reset(torch.tensor([-1]))
    envs.reset([2], one(2, device))
    x = envs.state.x.clone()
    envs.state.extra["a"] = torch.zeros(len(envs.state), device=device)
    wrong = one(1, device).replace(extra={"a": torch.zeros(len(one(1)), 2, device=device)})
    with pytest.raises(ValueError, match="a of a particle must be"):
        envs.reset([1], [wrong])
    assert torch.equal(x, envs.state.x)
    envs.count_impulses()
    with pytest.raises(ValueError, match="impulses must be counted"):
        envs.forces()


# ---- gradients


def controlled(device: str) -> tuple[mpm.Environments, mpm.Sphere]:
    """Two scenes with a paddle in front of the block."""
    paddle = mpm.Sphere(torch.tensor([[0.13, 0.4]] * 2, dtype=F64, device=device), 0.12, kind="sticky")
    step = step_of(2, device, boundaries=[paddle])
    return mpm.Environments(step, [one(0, device), one(0, device)]), paddle


def reward(envs: mpm.Environments) -> Tensor:
    return (envs.observe("v")[..., 0] * envs.observe("x")[..., 0]).sum(1)


@pytest.mark.parametrize("action", ["position", "velocity", "gravity", "state", "law", "dt"])
def test_gradients_pass_through_calls(action, device):
    """As those of finite differences, through three calls, and beside another part of the loss."""
    shift = {"position": 0.02, "velocity": 1.5, "gravity": 3.0, "state": 0.5, "law": 1e4, "dt": DT}[action]
    scenes = (2,) if action in ("law", "dt") else (2, 2)

    def total(a: Tensor) -> Tensor:
        envs, paddle = controlled(device)
        step, dt = envs.step, DT
        home = paddle.position
        if action == "state":
            states = [one(0, device).replace(v=one(0, device).v + a[k]) for k in range(2)]
            envs = mpm.Environments(step, states)
        elif action == "law":
            step.law.E = a
        elif action == "dt":
            dt = a
        for k in range(3):
            if action == "position":
                paddle.position = home + (k + 1) * a
            elif action == "velocity":
                paddle.velocity = (k + 1) * a
            elif action == "gravity":
                step.gravity = (k + 1) * a
            envs.advance(4, dt)
        return reward(envs).sum() + 1e-3 * a.square().sum()

    a = shift * (1 + 0.1 * torch.arange(float(np.prod(scenes)), dtype=F64, device=device).reshape(scenes))
    a.requires_grad_()
    (gradient,) = torch.autograd.grad(total(a), a)
    with torch.no_grad():
        for k in range(a.numel()):
            e = torch.zeros_like(a).flatten()
            e[k] = h = 1e-6 * shift
            e = e.reshape(a.shape)
            difference = float(total(a + e) - total(a - e)) / (2 * h)
            assert float(gradient.flatten()[k]) == pytest.approx(difference, rel=1e-4, abs=1e-7 / shift), k
    assert float((gradient - 2e-3 * a).abs().max()) > 1e-3 / shift


def test_a_reset_cuts_the_gradient_of_its_scenes(device):
    """And those of the others pass; `detach` cuts all."""
    envs, paddle = controlled(device)
    a = torch.full((2, 2), 0.02, dtype=F64, device=device, requires_grad=True)
    envs.advance(2, DT)
    paddle.position = paddle.position + a
    envs.advance(4, DT)
    mask = torch.tensor([False, True], device=device)
    (whole,) = torch.autograd.grad(reward(envs).sum(), a, retain_graph=True)
    envs.reset(mask)
    paddle.position = paddle.position.detach()
    envs.advance(4, DT)
    (gradient,) = torch.autograd.grad(reward(envs).sum(), a, retain_graph=True)
    assert (whole != 0).any(1).all() and (gradient[0] != 0).any() and (gradient[1] == 0).all()
    envs.reset([0], [one(0, device).replace(v=one(0, device).v * a[0, 0])])
    (gradient,) = torch.autograd.grad(envs.observe("v").sum(), a, retain_graph=True)
    assert float(gradient[0, 0]) == pytest.approx(float(one(0, device).v.sum()))
    envs.detach()
    envs.advance(2, DT)
    assert not envs.state.x.requires_grad and not envs.time.requires_grad
