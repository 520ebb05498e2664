"""Operations on particles before P2G: momentum of pushes, held and absent particles, and positions."""

import pytest
import torch

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step
from torch_mpm.step.particle_operations import Hold, Operations, Present, Push

DT = 1e-3


def momentum(state):
    return (state.mass[:, None] * state.v).sum(0)


def test_a_push_brings_its_momentum(device, dim):
    """Σ f for as long as it acts, to rounding; forces that differ, a start, an end, chosen particles."""
    start = block_state(dim, device)
    P = len(start)
    force = torch.randn(P, dim, dtype=torch.float64, device=device)
    chosen = torch.arange(P, device=device) % 3 == 0
    step = make_step(dim, on_particles=Push(force, 3 * DT - 1e-9, 8 * DT - 1e-9, chosen))
    end = mpm.rollout(step, start, 12, DT)
    expected = momentum(start) + 5 * DT * force[chosen].sum(0)
    torch.testing.assert_close(momentum(end), expected, rtol=1e-12, atol=1e-12)


def test_a_force_of_time_and_numbers(device):
    start = block_state(2, device)
    of_time = make_step(2, on_particles=Push(lambda time: (0.0, 1e3 * time)))
    end = mpm.rollout(of_time, start, 10, DT)
    expected = momentum(start) + torch.tensor(
        [0.0, DT * 1e3 * len(start) * 45 * DT], dtype=torch.float64, device=device
    )
    torch.testing.assert_close(momentum(end), expected, rtol=1e-12, atol=1e-12)


def test_scenes_have_their_own_time_steps(device):
    """In a batch with a tensor dt, each scene is what it is alone; one is paused."""
    scene = (torch.arange(len(block_state(2))) % 2).int().to(device)
    both = block_state(2, device, scene=scene)
    push = Push((3.0, -1.0), 0.0, 4.5 * DT)
    step = make_step(2, scenes=2, on_particles=push)
    dt = torch.tensor([DT, 2 * DT], dtype=torch.float64, device=device)
    end = mpm.rollout(step, both, 6, dt)
    paused = mpm.rollout(step, both, 6, dt * torch.tensor([1.0, 0.0], device=device))
    for k in (0, 1):
        alone = mpm.rollout(make_step(2, on_particles=push), both.split()[k], 6, float(dt[k]))
        torch.testing.assert_close(end.split()[k].x, alone.x, rtol=0, atol=1e-13)
    assert torch.equal(paused.split()[1].x, both.split()[1].x)
    torch.testing.assert_close(paused.split()[0].x, end.split()[0].x, rtol=0, atol=1e-13)


FORCES = {
    "time times a vector": lambda t, x: t * torch.arange(1.0, 1.0 + x.shape[1]).to(x),
    "numbers": lambda t, x: tuple(float(t) * k for k in range(1, 1 + x.shape[1])),
    "components": lambda t, x: torch.stack([torch.as_tensor(k * t).to(x) for k in range(1, 1 + x.shape[1])]),
    "of particles": lambda t, x: torch.as_tensor(t).to(x) * x,
}


@pytest.mark.parametrize("scenes", [1, 2, 3])
@pytest.mark.parametrize("force", FORCES)
def test_forces_of_one_time_serve_scenes_with_times_of_their_own(force, scenes, dim, device):
    """Whatever the number of scenes is, also that of the dimensions; also for reordered particles."""
    start = block_state(dim, device)
    dt = DT * torch.arange(1, scenes + 1, dtype=torch.float64, device=device)

    def change(B: int, dt: torch.Tensor | float) -> torch.Tensor:
        states = mpm.State.concatenate([start] * B, scene=True) if B > 1 else start
        turned = states.select(torch.arange(len(states) - 1, -1, -1, device=device))
        turned = turned.replace(ids=torch.arange(len(states) - 1, -1, -1, device=device))
        push = Push(lambda time: FORCES[force](time, states.x))
        step = make_step(dim, scenes=B, on_particles=push)
        ends = mpm.rollout(step, states, 4, dt), mpm.rollout(step, turned, 4, dt).restored()
        torch.testing.assert_close(ends[0].v, ends[1].v, rtol=1e-9, atol=1e-10)
        return ends[0].v

    expected = torch.cat([change(1, float(own)) for own in dt])
    torch.testing.assert_close(change(scenes, dt), expected, rtol=1e-9, atol=1e-10)


def test_held_particles_have_their_velocity_and_are_let_go_in_turn(device):
    """Before P2G of each step; in the order of `ids` after particles were sorted."""
    start = block_state(2, device)
    ends = torch.linspace(0, 10 * DT, len(start), dtype=torch.float64, device=device)
    seen = []

    def look(state, dt):
        seen.append((state.time, state.v, ends if state.ids is None else ends[state.ids]))
        return state

    hold = Hold((0.25, 0.0), end=ends)
    step = make_step(2, on_particles=Operations([hold, Looking(look)]))
    state = mpm.rollout(step, start, 3, DT)
    mpm.rollout(step, state.sorted(step.grid), 5, DT)
    assert len(seen) == 8
    for time, v, until in seen:
        held = time < until
        assert 0 < int(held.sum()) < len(start) or time == 0
        assert bool((v[held] == torch.tensor([0.25, 0.0], device=device)).all())
        assert not bool((v[~held] == torch.tensor([0.25, 0.0], device=device)).all(1).any())


class Looking(torch.nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, state, dt):
        return self.function(state, dt)


def test_absent_particles_are_as_if_they_were_not_there(device, dim):
    """The others move as in a state without them; they stay bit by bit, and come when their time has come."""
    start = block_state(dim, device)
    start = start.replace(F=torch.eye(dim, dtype=torch.float64, device=device).repeat(len(start), 1, 1))
    late = torch.arange(len(start), device=device) % 4 == 0
    step = make_step(dim, on_particles=Present(5 * DT - 1e-9, particles=late))
    end = mpm.rollout(step, start, 5, DT)
    alone = mpm.rollout(make_step(dim), start.select((~late).nonzero().squeeze(1)), 5, DT)
    torch.testing.assert_close(end.x[~late], alone.x, rtol=0, atol=1e-13)
    for name in ("x", "v", "F", "mass", "volume"):
        assert torch.equal(getattr(end, name)[late], getattr(start, name)[late])
    after = step(end, DT)
    assert not bool((after.x[late] == end.x[late]).all(1).any())
    assert torch.equal(after.mass, start.mass)


def test_absent_particles_take_no_part_in_heat_either(device):
    """Temperatures and gradients are those of a state without them, to the tolerance of the heat solve."""
    start = block_state(2, device)
    start = make_step(2).prepare(start.replace(temperature=100 * start.x[:, 0]))
    late = torch.arange(len(start), device=device) % 4 == 0
    k = torch.tensor(50.0, dtype=torch.float64, device=device, requires_grad=True)
    results = []
    for here in (True, False):
        step = make_step(2, on_particles=Present(1.0, particles=late) if here else None)
        step.heat = mpm.Heat(step.grid, conductivity=k, specific_heat=1.0, tolerance=1e-12)
        state = step.prepare(start)  # with the same temperature gradients
        end = mpm.rollout(step, state if here else state.select((~late).nonzero().squeeze(1)), 3, DT)
        theta = end.temperature[~late] if here else end.temperature
        if here:
            assert torch.equal(end.temperature[late], start.temperature[late])
        results.append((theta.detach(), torch.autograd.grad(theta.square().sum(), k)[0]))
    torch.testing.assert_close(results[0], results[1], rtol=1e-8, atol=1e-8)
    assert float((results[0][0] - start.temperature[~late]).abs().max()) > 0.1


def test_gradients_pass_and_absent_particles_have_none(device):
    start = block_state(2, device)
    late = torch.arange(len(start), device=device) < 5
    force = torch.zeros(2, dtype=torch.float64, device=device, requires_grad=True)
    v = start.v.clone().requires_grad_()
    step = make_step(2, on_particles=Operations([Push(force), Present(1.0, particles=late)]))
    end = mpm.rollout(step, start.replace(v=v), 4, DT, checkpoint=2)
    (mass, moved) = (start.mass[~late], end.v[~late])
    by_force, by_v = torch.autograd.grad((mass[:, None] * moved).sum(0)[0], (force, v))
    torch.testing.assert_close(by_force, torch.tensor([4 * DT * float((~late).sum()), 0.0], device=device).double())
    assert float(by_v[late].abs().max()) == 0 and bool((by_v[~late, 0] > 0).all())


def test_rollouts_take_such_steps_one_by_one(device):
    calls = []

    def count(state, dt):
        calls.append(state.time)
        return state

    step = make_step(2, on_particles=count)
    assert "it calls on_particles" in step.explain(block_state(2, device))
    mpm.rollout(step, block_state(2, device), 9, DT)
    assert calls == pytest.approx([k * DT for k in range(9)])
    step.on_particles = None
    assert step.explain(block_state(2, device)).startswith("all steps in one op")


@pytest.mark.cuda
def test_operations_of_the_library_are_replayed_from_a_graph():
    state = block_state(2, "cuda", dtype=torch.float32)
    held = torch.arange(len(state), device="cuda") % 2 == 0
    step = make_step(2, on_particles=Operations([Push((1.0, 0.0), 2.5 * DT), Hold((0.0, 0.0), 0.0, 6.5 * DT, held)]))
    with torch.no_grad():
        assert step.explain(state, DT).startswith("from a CUDA graph")
        end, single = mpm.rollout(step, state, 20, DT), state
        for _ in range(20):
            single = step(single, DT)
    torch.testing.assert_close(end.x, single.x, rtol=0, atol=1e-5)


def test_who_waits_is_not_pushed(device):
    """In whichever order the operations are."""
    state = block_state(2, device)
    for operations in ([Push((1.0, 0.0)), Present(start=1.0)], [Present(start=1.0), Push((1.0, 0.0))]):
        end = mpm.rollout(make_step(2, on_particles=Operations(operations)), state, 5, DT)
        assert torch.equal(end.v, state.v) and torch.equal(end.x, state.x)


def test_an_empty_scene(device):
    start = block_state(2, device).select(torch.zeros(0, dtype=torch.int64, device=device))
    step = make_step(2, on_particles=Operations([Push((1.0, 0.0)), Hold((0.0, 0.0)), Present(1.0)]))
    assert len(step(start, DT)) == 0


def test_wrong_results_and_arguments_are_named(device):
    state = block_state(2, device)

    def refused(operation, error, message):
        with pytest.raises(error, match=message):
            make_step(2, on_particles=operation)(state, DT)

    P = len(state)
    refused(lambda s, dt: None, TypeError, rf"on_particles must return a State of {P} particles")
    refused(lambda s, dt: s.select(torch.arange(3, device=device)), TypeError, "got one of 3")
    refused(lambda s, dt: (s, s.mass[:3] > 0), ValueError, rf"enabled must have shape \[P\] = \[{P}\], got \[3\]")
    refused(lambda s, dt: (s, s.mass), TypeError, "enabled must be bool, got torch.float64")
    refused(Push(torch.ones(5, 2, device=device)), ValueError, rf"force must have shape \[2\] or \[{P}, 2\]")
    refused(Hold((0.0, 1.0, 2.0)), ValueError, "velocity must have 2 numbers")
    refused(Hold((0.0, 1.0), end=torch.ones(3, device=device)), ValueError, rf"end must have shape \[\] or \[{P}\]")
    with pytest.raises(TypeError, match=r"particles must be bool \[P\], got torch.int64"):
        Push((0.0, 1.0), particles=torch.ones(3).long())
    with pytest.raises(TypeError, match="on_particles must be a function, a module or None, got int"):
        make_step(2, on_particles=3)
    with pytest.raises(ValueError, match="start must be a number, got nan"):
        Push((0.0, 1.0), float("nan"))
