"""A scene whose entry of a tensor dt is zero stands still, values and gradients, and the others do not notice."""

import dataclasses
import math

import pytest
import torch

import torch_mpm as mpm
from benchmarks.catalogue.laws import named
from benchmarks.catalogue.scenes import block

DT = 1e-3
LAWS = named("neo_hookean", "sand", "fluid", "herschel_bulkley", "snow")


def scenes(count, device, law="neo_hookean", obstacle=True, **options):
    """Blocks that fall on an obstacle, in one batch after some steps, so that all fields are there."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1), scenes=count)
    boundaries = [mpm.Sphere((0.5, 0.2), 0.15, friction=0.3)] if obstacle else []
    step = mpm.Step(grid, LAWS[law](), (0.5, -9.8), walls="slip", boundaries=boundaries, **options)
    states = [block((0.3, 0.3), (0.6, 0.6), 0.1, velocity=(0.5 - k, -1.0), device=device) for k in range(count)]
    state = states[0] if count == 1 else mpm.State.concatenate(states, scene=True)
    return step, mpm.rollout(step, state, 5, DT)


def fields_of(state):
    """All tensors of the particles by name."""
    named = {f.name: getattr(state, f.name) for f in dataclasses.fields(state) if f.name not in ("extra", "time")}
    return {k: t for k, t in (named | state.extra).items() if t is not None}


def times(values, device):
    return torch.tensor(values, dtype=torch.float64, device=device)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("options", [{}, {"transfer": "pic"}, {"flip": 0.95}, {"stress_form": "gradient"}])
def test_a_paused_scene_stays_bit_by_bit(device, law, options):
    """And the others are what they are without a pause, bit by bit on the CPU."""
    step, state = scenes(3, device, law, **options)
    paused = mpm.rollout(step, state, 4, times([DT, 0.0, DT], device))
    running = mpm.rollout(step, state, 4, times([DT, DT, DT], device))
    still = (state.scene == 1).to(device)
    before, mine, others = fields_of(state), fields_of(paused), fields_of(running)
    assert mine.keys() == others.keys()
    for name, value in mine.items():
        assert torch.equal(value[still], before[name][still]), name
        tolerance = 0 if device == "cpu" else 1e-9
        torch.testing.assert_close(value[~still], others[name][~still], rtol=tolerance, atol=tolerance)
    assert not torch.equal(running.v[still], state.v[still])
    torch.testing.assert_close(paused.time, state.time + times([4 * DT, 0.0, 4 * DT], device))
    step.check(paused)


@pytest.mark.parametrize("law", LAWS)
def test_gradients_pass_through_a_pause(device, law):
    """Gradients of the others, of dt and of the law are those of a batch without the scene; its own pass unchanged."""

    def gradients(dt):
        step, state = scenes(len(dt), device, law)
        leaves = {k: t.detach().clone().requires_grad_() for k, t in fields_of(state).items() if t.is_floating_point()}
        extra = {k: leaves.pop(k) for k in state.extra}
        dt = times(dt, device).requires_grad_()
        end = mpm.rollout(step, state.replace(**leaves, extra=extra), 3, dt)
        weight = torch.linspace(1, 2, 36, dtype=torch.float64, device=device).repeat(len(dt.detach()))
        loss = sum(
            (weight.reshape(-1, *(1,) * (t.dim() - 1)) * t).sum()
            for k, t in fields_of(end).items()
            if t.is_floating_point() and k in ("x", "v", "C", "F", "J", *extra)
        )
        inputs = {**leaves, **extra, "dt": dt}
        grads = torch.autograd.grad(loss, list(inputs.values()), allow_unused=True, materialize_grads=True)
        return dict(zip(inputs, grads, strict=True)), weight

    (mine, weight), (alone, _) = gradients([DT, 0.0]), gradients([DT])
    for name, grad in mine.items():
        assert grad.isfinite().all(), name
        if name == "dt":
            assert grad[1] == 0
            torch.testing.assert_close(grad[:1], alone[name], rtol=1e-9, atol=1e-12)
            continue
        torch.testing.assert_close(grad[:36], alone[name], rtol=1e-9, atol=1e-9 * float(alone[name].abs().max()))
        passed = weight[36:].reshape(-1, *(1,) * (grad.dim() - 1)).expand_as(grad[36:])
        expected = torch.zeros_like(passed) if name in ("mass", "volume") else passed
        assert torch.equal(grad[36:], expected), name


@pytest.mark.parametrize("value", [-DT, -math.inf, math.nan])
def test_a_dt_that_is_none_pauses_and_is_reported(device, value):
    step, state = scenes(3, device)
    dt = times([DT, DT, value], device)
    end = mpm.rollout(step, state, 2, dt)
    still = state.scene == 2
    for name, before in fields_of(state).items():
        assert torch.equal(fields_of(end)[name][still], before[still]), name
    assert end.time.isfinite().all() and float(end.time[2]) == state.time
    assert step.failures().failed.tolist() == [False, False, True]
    with pytest.raises(mpm.SimulationError, match=r"^2 steps had a dt that was negative or NaN.*: 2 in scene 2: "):
        step.check(end)
    step.reset()
    step(state, times([DT, DT, 0.0], device))
    step.check()


def test_scenes_without_particles_take_the_stable_time_step(device):
    """It is infinite for them, which is no reason for a report."""
    step, state = scenes(3, device)
    state = state.select((state.scene != 1).nonzero()[:, 0])
    dt = step.stable_dt(state)
    end = step(state, dt)
    step.check(end)
    assert dt[1] == math.inf and end.x.isfinite().all() and not torch.equal(end.x, state.x)


@pytest.mark.parametrize("shape", [[], [1]])
def test_one_dt_for_all_scenes_pauses_all(device, shape):
    for count in (1, 2):
        step, state = scenes(count, device)
        end = step(state, torch.zeros(shape, dtype=torch.float64, device=device))
        for name, before in fields_of(state).items():
            assert torch.equal(fields_of(end)[name], before), name
        step(state, torch.full(shape, -1.0, dtype=torch.float64, device=device))
        assert step.failures().problems["dt"].count.tolist() == [1] * count


def test_fields_that_the_first_step_makes_are_at_rest_in_a_pause(device):
    grid = mpm.Grid(0.1, (0, 0), (1, 1), scenes=2)
    one = mpm.State.at_rest(mpm.seed.box((0.3, 0.3), (0.6, 0.6), 0.1), velocity=(1.0, 0.0), device=device)
    state = mpm.State.concatenate([one, one], scene=True)
    end = mpm.Step(grid, LAWS["neo_hookean"]())(state, torch.tensor([DT, 0.0], device=device))
    still = state.scene == 1
    assert end.C is not None and not end.C[still].any()
    assert torch.equal(end.F[still], torch.eye(2, device=device).expand_as(end.F[still]))


def test_a_pause_leaves_a_lost_scene_as_it_is(device):
    step, state = scenes(2, device)
    v = state.v.clone()
    v[40] = torch.nan
    state = state.replace(v=v)
    end = step(state, times([DT, 0.0], device))
    torch.testing.assert_close(end.v[36:], v[36:], rtol=0, atol=0, equal_nan=True)
    assert end.x.isfinite().all()


def test_a_wrong_shape_is_refused(device):
    step, state = scenes(3, device)
    with pytest.raises(ValueError, match=r"dt must be a number or have shape \[\], \[1\] or \[B\] = \[3\], got \[2\]"):
        step(state, times([DT, DT], device))


def test_a_pause_compiles_to_one_graph():
    step, state = scenes(2, "cpu", obstacle=False)

    @torch.compile(backend="aot_eager", fullgraph=True)
    def compiled(x, v, C, F, dt):
        out = step(state.replace(x=x, v=v, C=C, F=F), dt)
        return out.x, out.v, out.C, out.F

    for dt in (times([DT, 0.0], "cpu"), times([-1.0, DT], "cpu")):
        expected = step(state, dt)
        for a, b in zip(
            compiled(state.x, state.v, state.C, state.F, dt),
            (expected.x, expected.v, expected.C, expected.F),
            strict=True,
        ):
            torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)
    assert step.failures().problems["dt"].count.tolist() == [2, 0]


@pytest.mark.cuda
def test_a_pause_needs_no_synchronisation():
    step, state = scenes(3, "cuda")
    dt = times([DT, 0.0, -DT], "cuda")
    step(state, dt)
    torch.cuda.set_sync_debug_mode("error")
    try:
        step(state, dt)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert step.failures().problems["dt"].count.tolist() == [0, 0, 2]


def test_heat_alone_pauses_and_reports_as_a_step_does(device):
    """`Heat.forward` with a dt of zero, negative and NaN: the scenes stay, and `check` names the last two."""
    _, state = scenes(3, device)
    state = state.replace(temperature=state.x[:, 0].clone())
    heat = mpm.Heat(mpm.Grid(0.1, (0, 0), (1, 1), scenes=3), 1.0, 1.0)
    state = heat.prepare(state)
    end = heat(state, times([0.0, -1.0, math.nan], device))
    for name, before in fields_of(state).items():
        assert torch.equal(fields_of(end)[name], before), name
    assert torch.equal(end.time, times([state.time] * 3, device))
    with pytest.raises(mpm.SimulationError, match=r"^2 steps had a dt that was negative or NaN.*: 1 in scene 1; 1 in"):
        heat.check()
    heat.reset()
    heat.check()


def test_what_is_counted_belongs_to_no_transform(device):
    """Counts made inside of torch.func.grad can be read and added to when it has ended."""
    step, state = scenes(1, device)
    state = state.replace(temperature=state.x[:, 0].clone())
    heat = mpm.Heat(step.grid, 1.0, 1.0)

    def end(dt):
        return step(state, dt).x.square().sum() + heat(state, dt).temperature.square().sum()

    torch.func.grad(torch.func.grad(end))(times(-DT, device))
    counts = [problem.count for problem in step.failures().problems.values()]
    for count in (*counts, heat.unsolved, heat.residual):
        assert not torch._C._functorch.is_functorch_wrapped_tensor(count)
    assert step.failures().problems["dt"].count.tolist() == [1]
    with pytest.raises(mpm.SimulationError, match=r"1 .*had a dt that was negative"):
        heat.check()
