"""Scenes that reach a time with their own time steps, against loops of single steps that compute the limit."""

import math

import pytest
import torch
from helpers import TOLERANCE
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import unit_box
from torch_mpm.rollouts import until_time

F64 = torch.float64
END = 0.06
STIFFNESS = (1e3, 3e4, 2e5)
"""Young's moduli of three scenes [Pa]; the last needs about 14 times the substeps of the first."""


def blob(device: str, dim: int, dtype: torch.dtype, count: int = 60) -> mpm.State:
    """A block of particles that spins and falls."""
    g = torch.Generator().manual_seed(4)
    x = 0.35 + 0.3 * torch.rand(count, dim, generator=g, dtype=F64)
    v = torch.zeros(count, dim, dtype=F64)
    v[:, 0], v[:, 1] = x[:, 1] - 0.5, 0.5 - x[:, 0]
    state = mpm.State(x=x, v=v, mass=torch.full((count,), 0.2, dtype=F64), volume=torch.full((count,), 2e-4, dtype=F64))
    return state.to(device, dtype)


def batch(device: str, dim: int, dtype: torch.dtype = F64) -> mpm.State:
    return mpm.State.concatenate([blob(device, dim, dtype)] * len(STIFFNESS), scene=True)


def step_of(dim: int, E, scenes: int = 1, device: str = "cpu", dtype: torch.dtype = F64, **options) -> mpm.Step:
    E = torch.tensor(E, dtype=dtype, device=device) if isinstance(E, tuple) else E
    gravity = options.pop("gravity", (0.0, -9.8, 0.0)[:dim])
    law = options.pop("law", mpm.NeoHookean)(E=E, nu=0.3)
    return mpm.Step(unit_box(dim, scenes=scenes), law, gravity=gravity, walls="separate", **options)


def one_by_one(step: mpm.Step, state: mpm.State, end: float, cfl: float, every: int) -> tuple[mpm.State, int]:
    """A scene alone: `every` equal steps with a dt of the limit, or the one before, until the rest is as short."""
    now, taken, bound = float(state.time), 0, 0.0
    while now < end:
        limit = cfl * float(step.stable_dt(state, cfl=1.0).double())
        bound = bound if limit / 2 <= bound <= limit else limit
        left = max(math.ceil((end - now) / bound * (1 - 1e-9)), 1)
        n = min(left, every)
        dt = (end - now) / left
        for _ in range(n):
            state = step(state, dt)
        taken, now = taken + n, end if left <= every else now + n * dt
    return state, taken


def error(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().max() / b.abs().max().clamp_min(1e-9))


@pytest.mark.parametrize("every", [1, 5, 16])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_one_scene_is_that_of_single_steps(dim, every, dtype, device):
    step, again = (step_of(dim, 3e4, dtype=dtype) for _ in range(2))
    state = blob(device, dim, dtype)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, state, END, every=every)
        expected, taken = one_by_one(again, state, END, 0.5, every)
    assert arrival.arrived.tolist() == [True] and arrival.substeps.tolist() == [taken]
    assert arrival.state.time == END
    for name in ("x", "v", "F", "C"):
        assert error(getattr(arrival.state, name), getattr(expected, name)) < TOLERANCE["rollout"][dtype], name


@pytest.mark.parametrize("every", [1, 5, 16, 64])
def test_scenes_of_a_batch_are_those_of_single_steps(every, dim, device):
    """Each with substeps of its own, while the others pause."""
    step = step_of(dim, STIFFNESS, scenes=3, device=device)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, batch(device, dim), END, every=every)
        parts = arrival.state.split()
        for k, E in enumerate(STIFFNESS):
            expected, taken = one_by_one(step_of(dim, E), blob(device, dim, F64), END, 0.5, every)
            assert int(arrival.substeps[k]) == taken
            for name in ("x", "v", "F", "C"):
                assert error(getattr(parts[k], name), getattr(expected, name)) < 1e-9, (k, name)
    substeps = arrival.substeps.tolist()
    assert substeps[2] > 4 * substeps[0]
    assert 0.3 < float(arrival.largest_cfl.min()) and float(arrival.largest_cfl.max()) < (0.6 if every == 1 else 0.8)


KINDS = {
    "op": {},
    "several transfers": {"transfer": "flip"},
    "sand": {"law": mpm.QuarticSand},
    "single steps": {"on_grid": lambda blocks, velocity, mass, dt: velocity},
    "obstacle": {"boundaries": [mpm.Sphere((0.4, 0.1), 0.2, velocity=(0.5, 0.5))]},
    "path": {"boundaries": [mpm.Sphere(lambda t: torch.stack([0.4 + 0.5 * t, 0.1 + 0.5 * t], -1), 0.2)]},
}
"""Options of steps, computed in one op or one by one."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("limits", [{}, {"most": 21}, {"longest": 2e-3, "every": 7}])
def test_a_scene_does_not_depend_on_the_scenes_beside_it(kind, limits, device):
    """Bit by bit on deterministic grids, where it begins and ends at times of its own, too."""
    times = torch.tensor([0.0, 0.02, 0.01], dtype=F64), torch.tensor([0.05, 0.03, 0.06], dtype=F64)
    start, end = (t.to(device) for t in times)
    step = step_of(2, STIFFNESS, scenes=3, device=device, **KINDS[kind])
    step.grid = unit_box(2, scenes=3, deterministic=True)
    with torch.no_grad():
        together = mpm.rollout_to(step, batch(device, 2).replace(time=start), end, **limits)
        for k, E in enumerate(STIFFNESS):
            alone = step_of(2, (E,), device=device, **KINDS[kind])
            alone.grid = unit_box(2, deterministic=True)
            state = blob(device, 2, F64).replace(time=start[k : k + 1])
            expected = mpm.rollout_to(alone, state, end[k : k + 1], **limits)
            assert together.substeps[k] == expected.substeps[0]
            assert together.arrived[k] == expected.arrived[0]
            assert together.largest_cfl[k] == expected.largest_cfl[0]
            one = together.state.split()[k]
            for name in ("x", "v", "C", "F", "time"):
                a, b = getattr(one, name), getattr(expected.state, name)
                assert a is None or torch.equal(a, b), (k, name)


def test_gradients_of_a_scene_do_not_depend_on_the_scenes_beside_it(device):
    def gradient(E: tuple[float, ...]) -> Tensor:
        step = step_of(2, E, scenes=len(E), device=device)
        step.grid = unit_box(2, scenes=len(E), deterministic=True)
        state = mpm.State.concatenate([blob(device, 2, F64, count=12)] * len(E), scene=True)
        v = state.v.clone().requires_grad_()
        arrival = mpm.rollout_to(step, state.replace(v=v), END, every=4)
        return torch.autograd.grad(arrival.state.x.square().sum() + arrival.state.v.square().sum(), v)[0]

    together = gradient(STIFFNESS)
    for k, E in enumerate(STIFFNESS):
        assert error(together[12 * k : 12 * (k + 1)], gradient((E,))) < 1e-11


@pytest.mark.parametrize("law", [mpm.NeoHookean, mpm.FixedCorotated, mpm.QuarticSand])
@pytest.mark.parametrize("transfer", ["apic", "pic", "flip"])
def test_momentum_is_that_of_gravity_however_long_the_steps_are(law, transfer, device):
    """Free flight: momentum equals that of gravity to rounding."""
    gravity = torch.tensor([[0.0, -9.8], [0.0, 0.0], [3.0, 1.0]], dtype=F64, device=device)
    step = step_of(2, STIFFNESS, scenes=3, device=device, law=law, gravity=gravity, transfer=transfer)
    state = batch(device, 2)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, state, END)
    assert bool(arrival.arrived.all())
    before, after = (torch.stack([(s.mass[:, None] * s.v).sum(0) for s in t.split()]) for t in (state, arrival.state))
    assert error(after - before, END * gravity * 0.2 * 60) < 1e-11


def test_times_of_scenes(device):
    """One that has arrived before is left as it is, bit by bit."""
    step, state = step_of(2, STIFFNESS, scenes=3, device=device), batch(device, 2)
    start = torch.tensor([0.0, 0.01, 0.03], dtype=F64, device=device)
    time = torch.tensor([0.005, 0.02, 0.02], dtype=F64, device=device)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, state.replace(time=start), time)
    assert arrival.arrived.tolist() == [True] * 3
    assert arrival.substeps.tolist()[2] == 0 and float(arrival.largest_cfl[2]) == 0
    assert torch.equal(arrival.state.time, torch.tensor([0.005, 0.02, 0.03], dtype=F64, device=device))
    rest = arrival.state.split()[2]
    assert torch.equal(rest.x, state.split()[2].x) and torch.equal(rest.v, state.split()[2].v)


def test_frames_add_up_to_their_end_in_float32(device):
    """The clocks are in double precision, for every dtype of the particles."""
    step = step_of(2, STIFFNESS, scenes=3, device=device, dtype=torch.float32)
    state = batch(device, 2, torch.float32)
    with torch.no_grad():
        for k in range(1, 4):
            arrival = mpm.rollout_to(step, state, k * END / 3)
            state = arrival.state
            assert state.time == k * END / 3


def test_moving_obstacles_are_where_the_time_of_a_scene_says(device):
    """A floor that rises lifts the particles of each scene by its way."""
    floor = mpm.Plane((0.0, 0.2), (0.0, 1.0), kind="sticky", velocity=(0.0, 1.0))
    step = step_of(2, STIFFNESS, scenes=3, device=device, boundaries=[floor], gravity=None)
    with torch.no_grad():
        start = batch(device, 2)
        arrival = mpm.rollout_to(step, start.replace(v=torch.zeros_like(start.v)), 0.2)
    lowest = torch.stack([s.x[:, 1].min() for s in arrival.state.split()])
    assert bool((lowest > 0.4 - 0.0625).all()) and bool(arrival.arrived.all())


def test_gradients_are_those_of_the_steps(device):
    """With the dt of the rollout, which autograd takes for constants."""
    state = blob(device, 2, F64, count=12)
    E = torch.tensor(1e5, dtype=F64, device=device, requires_grad=True)

    def loss(end: mpm.State) -> Tensor:
        return (end.x * torch.linspace(1, 2, 24, dtype=F64, device=device).reshape(12, 2)).sum() + end.v.square().sum()

    v = state.v.clone().requires_grad_()
    arrival = mpm.rollout_to(step_of(2, E), state.replace(v=v), END, every=4)
    got = torch.autograd.grad(loss(arrival.state), [v, E])
    expected, taken = one_by_one(step_of(2, E), state.replace(v=v), END, 0.5, 4)
    assert taken == int(arrival.substeps) and taken > 8
    for a, b in zip(got, torch.autograd.grad(loss(expected), [v, E]), strict=True):
        assert error(a, b) < 1e-10


def test_steps_of_heat_and_of_functions_arrive_too(device):
    """Steps that are no single op."""
    seen = []

    def on_grid(blocks, velocity, mass, dt):
        seen.append(dt)
        return velocity

    state = batch(device, 2)
    state = state.replace(temperature=torch.full_like(state.mass, 300.0))
    step = step_of(2, STIFFNESS, scenes=3, device=device, on_grid=on_grid)
    step.heat = mpm.Heat(step.grid, conductivity=1.0, specific_heat=1e3)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, state, 0.004)
    assert bool(arrival.arrived.all()) and len(seen) >= int(arrival.substeps.max())
    assert error(arrival.state.temperature, state.temperature) < 1e-9


def test_scenes_that_cannot_arrive_keep_nobody(device):
    """Without mass the limit is zero; with too few substeps a scene stops where it is."""
    state = batch(device, 2)
    state.mass[0] = 0
    step = step_of(2, STIFFNESS, scenes=3, device=device)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, state, END)
    assert arrival.arrived.tolist() == [False, True, True]
    assert arrival.substeps.tolist()[0] == 0
    assert arrival.state.time.tolist() == [0.0, END, END]
    with torch.no_grad():
        arrival = mpm.rollout_to(step_of(2, STIFFNESS, scenes=3, device=device), batch(device, 2), 0.2, most=16)
    assert arrival.arrived.tolist() == [True, False, False]
    assert int(arrival.substeps.max()) == 16
    with torch.no_grad():
        arrival = mpm.rollout_to(step_of(2, STIFFNESS, scenes=3, device=device), batch(device, 2), 0.2, most=37)
    assert int(arrival.substeps.max()) == 37


def test_clocks_are_not_set_back(device):
    step, state = step_of(2, STIFFNESS, scenes=3, device=device), batch(device, 2)
    late = torch.tensor([0.0, 5.0, 0.0], dtype=F64, device=device)
    with torch.no_grad():
        assert mpm.rollout_to(step_of(2, 1e3), blob(device, 2, F64).replace(time=2.0), 1.0).state.time == 2.0
        assert mpm.rollout_to(step, state.replace(time=late), 0.01).state.time.tolist() == [0.01, 5.0, 0.01]


def test_times_that_are_not_finite(device):
    step, state = step_of(2, STIFFNESS, scenes=3, device=device), batch(device, 2)
    time = torch.tensor([math.inf, math.nan, 0.01], dtype=F64, device=device)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, state, time)
    assert arrival.arrived.tolist() == [False, False, True]
    assert arrival.state.time.tolist() == [0.0, 0.0, 0.01]
    step.check(arrival.state)


def test_limits_that_shrink_are_reported(device):
    """The body accelerates within a segment; its dt was chosen at rest."""
    often, seldom = (
        mpm.rollout_to(step_of(2, 1e5, gravity=(0.0, -300.0)), blob(device, 2, F64), 0.03, every=every)
        for every in (1, 64)
    )
    assert float(often.largest_cfl) < 0.6
    assert float(seldom.largest_cfl) > 1


def test_empty_scenes_and_no_particles(device):
    step = step_of(2, STIFFNESS, scenes=3, device=device)
    one = blob(device, 2, F64)
    scene = torch.full((len(one),), 1, dtype=torch.int32, device=device)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, one.replace(scene=scene), END)
        assert bool(arrival.arrived.all()) and arrival.state.time == END
        none = mpm.State(x=one.x[:0], v=one.v[:0], mass=one.mass[:0], volume=one.volume[:0])
        nothing = mpm.rollout_to(step_of(2, 1e3), none, END)
    assert bool(nothing.arrived.all()) and len(nothing.state) == 0


def test_a_scene_that_is_lost_arrives_and_is_reported(device):
    state = batch(device, 2)
    state.v[:60] = math.nan
    step = step_of(2, STIFFNESS, scenes=3, device=device)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, state, END)
    assert bool(arrival.arrived.all())
    assert step.failures(arrival.state).failed.tolist() == [True, False, False]


def test_calls_that_follow_one_another_keep_their_dt(device):
    """Scenes with limits that change by less than half; end times are no multiples of dt."""
    step, state = step_of(2, STIFFNESS, scenes=3, device=device, gravity=None), batch(device, 2)
    bounds, dt = [], None
    with torch.no_grad():
        for k in range(12):
            arrival = mpm.rollout_to(step, state, 0.01 * (k + 1) + 0.003 * (k % 2), previous=dt)
            state, dt = arrival.state, arrival.dt
            bounds.append(dt)
    assert bool(arrival.arrived.all())
    bounds = torch.stack(bounds)
    assert bool((bounds.diff(dim=0) <= 0).all()) and bool((bounds[-1] > 0.5 * bounds[0]).all())
    assert bool((bounds[-1] == bounds[-3]).all())
    with pytest.raises(ValueError, match=r"previous must be a number or have shape .* \[3\], got \[2\]"):
        mpm.rollout_to(step, state, 1.0, previous=dt[:2])


def test_longest_step(device):
    step = step_of(2, 1e3)
    with torch.no_grad():
        arrival = mpm.rollout_to(step, blob(device, 2, F64), END, longest=3e-4)
    assert int(arrival.substeps) == 200


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"time": math.nan}, ValueError, "time must be finite"),
        ({"time": "soon"}, TypeError, "time must be a number or a tensor"),
        ({"time": torch.zeros(2)}, ValueError, r"time must be a number or have shape .* \[3\], got \[2\]"),
        ({"cfl": 0.0}, ValueError, "cfl must be positive"),
        ({"longest": -1.0}, ValueError, "longest must be positive"),
        ({"every": 0}, ValueError, "every must be at least 1"),
        ({"most": 0}, ValueError, "most must be at least 1"),
        ({"step": lambda state, dt: state}, TypeError, "step must be a Step"),
    ],
)
def test_wrong_arguments(given, error, text):
    arguments = {"step": step_of(2, STIFFNESS, scenes=3), "state": batch("cpu", 2), "time": END, **given}
    with pytest.raises(error, match=text):
        mpm.rollout_to(**arguments)


@pytest.mark.parametrize("heated", [False, True])
@pytest.mark.parametrize("mixed", [False, True])
def test_particles_are_sorted_again(mixed, heated, device, monkeypatch):
    """After as many substeps as by `rollout`, with states in the given order; a sort changes rounding only. The host
    reads the device as often as without sorts."""
    sorts, reads = [], []

    def run(order):
        step, state = step_of(2, 1e4, device=device), blob(device, 2, F64, count=200)
        if mixed:
            step.law = mpm.Mixture([mpm.NeoHookean(E=1e4, nu=0.3), mpm.Hencky(E=2e4, nu=0.3)])
            state = state.replace(material=(torch.arange(len(state), device=device) % 2).int())
        if heated:
            step.heat = mpm.Heat(step.grid, conductivity=1.0, specific_heat=100.0)
            state = state.replace(temperature=10 * state.x[:, 0].sin())
        plan = until_time.plan_call
        with monkeypatch.context() as patch, torch.no_grad():
            patch.setattr(until_time, "STEPS_WITH_HEAT" if heated else "STEPS_IN_ORDER", 8)
            patch.setattr(until_time, "plan_call", lambda *args: plan(*args)._replace(order=order))
            sort, remaining = until_time.sort_particles, until_time.Clocks.remaining
            patch.setattr(until_time, "sort_particles", lambda *args: sorts.append(order) or sort(*args))
            patch.setattr(until_time.Clocks, "remaining", lambda self: reads.append(order) or remaining(self))
            arrival = mpm.rollout_to(step, state, 2 * END, every=4)
            step.check(arrival.state)
        return arrival

    found, expected = run(1), run(0)
    segments = (int(expected.substeps) - 1) // 4  # Before the last substeps.
    assert sorts.count(1) == math.ceil(segments / 2) > 2 and sorts.count(0) == 0
    assert reads.count(1) == reads.count(0) and torch.equal(found.substeps, expected.substeps)
    assert found.state.ids is None
    for name in ("x", "v", "F", "mass", "temperature" if heated else "volume"):
        assert error(getattr(found.state, name), getattr(expected.state, name)) < 1e-9
