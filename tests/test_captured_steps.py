"""Steps and gradients from graphs against the same steps from Python.

On the CPU there are no graphs: something in their place calls the function again, with results in the same memory.
"""

import contextlib
import copy
import gc
import pickle
import weakref

import pytest
import torch
from cases.networks import network
from cases.rollouts import F64, assert_equal, one_by_one
from torch import nn

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box
from torch_mpm.cuda_graphs import graph as cuda_graph
from torch_mpm.cuda_graphs.capture import CapturedGraphs
from torch_mpm.grid.topology import Status
from torch_mpm.rollouts import graph_segments
from torch_mpm.step.status import uncounted

DT = 2e-4


class Repeated(cuda_graph.Graphs):
    """Imitation of a replay: arguments and results have fixed memory, and a backward pass overwrites its inputs."""

    def capture(self, beside):
        with uncounted(self._steps.step), torch.random.fork_rng([]):
            ends = self._steps(*self.read)
        self.follows = [t.requires_grad for t in ends]
        self._ends = [torch.empty_like(t, requires_grad=False) for t in ends]
        self._grads = [torch.empty_like(t) for t in ends if t.requires_grad]
        self._found = [torch.empty_like(t) for t in self.read]
        Repeated.spoilt = self

    def forward(self, given):
        with torch.no_grad():
            cuda_graph.copy_all(self.read, given)
        with cuda_graph.no_hooks(), torch.set_grad_enabled(any(t.requires_grad for t in self.read)):
            self._now = self._steps(*self.read)
        Repeated.spoilt = None
        with torch.no_grad():
            cuda_graph.copy_all(self._ends, self._now)
        return self._ends

    def backward(self, grads):
        assert Repeated.spoilt is not self
        self._take(grads)
        found = self._gradients(self._now, self._grads)
        with torch.no_grad():
            kept = [None if t is None else to.copy_(t) for to, t in zip(self._found, found, strict=True)]
        Repeated.spoilt = self
        return kept


@pytest.fixture
def captured(device, monkeypatch):
    """The graphs that are captured from here on."""
    made = []
    base = cuda_graph.Graphs if device == "cuda" else Repeated

    class Counted(base):
        def capture(self, beside):
            super().capture(beside)
            made.append(self)

    monkeypatch.setattr(graph_segments, "Graphs", Counted)
    if device == "cpu":
        monkeypatch.setattr(graph_segments, "has_graphs", lambda device: True)
        monkeypatch.setattr(cuda_graph, "on_own_stream", lambda device: contextlib.nullcontext())
    return made


class Wind(nn.Module):
    """On the nodes."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(6)
        self.layer = nn.Linear(2, 2)

    def forward(self, blocks, velocity, mass, dt):
        return velocity + dt * 50 * self.layer(blocks.node_positions(velocity.dtype)).tanh()


class Control(nn.Module):
    """On the particles, by the time."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(7)
        self.layer = nn.Linear(1, 2)

    def forward(self, state, dt):
        time = state.time if isinstance(state.time, torch.Tensor) else torch.full_like(state.x[0, 0], state.time)
        return state.replace(v=state.v + 30 * dt * self.layer(1e3 * time.reshape(1)).sin())


def learned(device):
    return mpm.Step(unit_box(2, deterministic=True), network(2, device), gravity=(0.0, -9.8), walls="slip"), blob(
        device, 2
    )


def blown(device):
    law = mpm.NeoHookean(E=torch.tensor(1e4, dtype=F64, device=device, requires_grad=True), nu=0.3)
    return mpm.Step(unit_box(2, deterministic=True), law, on_grid=Wind().double()).to(device), blob(device, 2)


def driven(device):
    ball = mpm.Sphere((0.5, 0.2), 0.15, velocity=(0.0, 4.0))
    step = mpm.Step(
        unit_box(2, deterministic=True), network(2, device), on_particles=Control().double(), boundaries=[ball]
    )
    return step.to(device), blob(device, 2).replace(time=0.01)


def remembering(device):
    """A law from Python with history, FLIP, and impulses on a ball."""

    def law(F, strength):
        tau = (1e3 + 1e2 * strength)[:, None, None] * (F @ F.mT - torch.eye(2, dtype=F.dtype, device=F.device))
        return F, tau, strength + 10 * (F - F.mT)[:, 0, 1].square()

    custom = mpm.laws.CustomLaw(law, history={"strength": ()})
    ball = mpm.Sphere((0.5, 0.5), 0.15, friction=0.2)
    step = mpm.Step(unit_box(2, deterministic=True), custom, walls="separate", flip=0.6, boundaries=[ball])
    return step, step.with_impulses(blob(device, 2))


def warm(device):
    """No function of the user's, but two gradients of heat."""
    grid = unit_box(2, deterministic=True)
    conductivity = torch.tensor(5.0, dtype=F64, requires_grad=True)
    plate = mpm.heat_boundaries.Convection(mpm.heat_boundaries.FreeSurface(), coefficient=30.0, ambient=400.0)
    specific_heat = mpm.Table([200.0, 500.0], [700.0, 900.0])  # The fused op reads no tables of heat.
    heat = mpm.Heat(grid, conductivity=conductivity, specific_heat=specific_heat, boundaries=[plate], tolerance=1e-13)
    law = mpm.NeoHookean(E=mpm.Table([280.0, 320.0], [2e4, 1e4]), nu=0.3)
    state = blob(device, 2)
    step = mpm.Step(grid, law, gravity=(0.0, -9.8), walls="slip", heat=heat).to(device)
    return step, state.replace(temperature=300 + 40 * state.x[:, 0])


def mixed(device):
    laws = mpm.Mixture([mpm.laws.CustomLaw(network(2, device)), mpm.NeoHookean(E=1e4, nu=0.3)])
    state = blob(device, 2, material=torch.arange(300, dtype=torch.int32) % 2)
    return mpm.Step(unit_box(2, deterministic=True), laws, transfer="pic"), state


def energetic(device):
    """A law that is the derivative of an energy, by a transform."""

    def law(F):
        by_F = torch.func.grad(lambda F: 1e3 * (F.mT @ F).diagonal(dim1=1, dim2=2).sum(1).sub(2).square().sum())(F)
        return by_F @ F.mT

    state = blob(device, 2)
    F = 0.05 * torch.randn(300, 2, 2, dtype=F64, generator=torch.Generator().manual_seed(1))
    step = mpm.Step(unit_box(2, deterministic=True), law, gravity=torch.tensor([0.0, -9.8], dtype=F64).requires_grad_())
    return step.to(device), state.replace(F=F.to(device) + torch.eye(2, dtype=F64, device=device))


MAKERS = [energetic, learned, blown, driven, remembering, warm, mixed]


def trained(step, state, n, take):
    """The end, and gradients by what the start and the step have."""
    v = state.v.detach().clone().requires_grad_()
    end = take(step, state.replace(v=v), n, DT)
    loss = end.x.square().sum() + 1e-2 * end.v.square().sum()
    loss = loss if end.temperature is None else loss + 1e-3 * end.temperature.square().sum()
    loss = loss if end.impulse is None else loss + end.impulse.sum()
    leaves = [v, *(t for t in (*step.parameters(), *step.buffers()) if t.requires_grad)]
    return end.detach(), torch.autograd.grad(loss, leaves)


def assert_alike(found, expected, tolerance=1e-12):
    (end, grads), (other, expected_grads) = found, expected
    assert end.time == pytest.approx(other.time, rel=1e-15)
    assert_equal(end.replace(time=0.0), other.replace(time=0.0))
    for grad, expected_grad in zip(grads, expected_grads, strict=True):
        assert float(expected_grad.abs().max()) > 0
        assert float((grad - expected_grad).abs().max()) < tolerance * float(expected_grad.abs().max())


def in_graphs_of(graph, **options):
    return lambda step, state, n, dt: mpm.rollout(step, state, n, dt, graph=graph, **options)


# ---- rollouts


@pytest.mark.parametrize("make", MAKERS)
def test_values_and_gradients_are_those_of_single_steps(make, device, captured):
    """Three segments and a remainder, in a loop that changes state and parameters; the status counts each step once."""
    step, state = make(device)
    again = make(device)[0]
    for k in range(3):
        assert_alike(trained(step, state, 11, in_graphs_of(3)), trained(again, state, 11, one_by_one))
        state = state.replace(v=0.9 * state.v)
        with torch.no_grad():
            for s in (step, again):
                for p in (t for t in (*s.parameters(), *s.buffers()) if t.requires_grad):
                    p.mul_(0.9)
        assert int(step.status[0, Status.ACTIVATIONS]) == int(again.status[0, Status.ACTIVATIONS]) == 11 * (k + 1)
    assert len(captured) == 2
    with torch.no_grad():
        assert_equal(mpm.rollout(step, state, 7, DT, graph=3), one_by_one(again, state, 7, DT))
    if make is not warm:  # which has no function of the user's
        assert len(captured) == 4
    step.check()
    assert str(step.failures().problems) == str(again.failures().problems)


@pytest.mark.parametrize("wanted", [True, False])
def test_assigned_poses(wanted, device, captured):
    """Obstacles move to them as in single steps, with gradients by poses; these need no other capture."""
    home = torch.tensor([0.5, 0.2], dtype=F64, device=device)
    ball = mpm.Sphere(home, 0.15, "sticky")
    step = mpm.Step(unit_box(2, deterministic=True), network(2, device), boundaries=[ball]).to(device)
    before = mpm.rollout(step, blob(device, 2), 4, DT)
    for k in range(3):
        found = []
        for graph in (3, None):
            ball.position = (home + torch.tensor([0.0, 1e-3 * (k + 1)], dtype=F64, device=device)).requires_grad_(
                wanted
            )
            with torch.set_grad_enabled(wanted):
                end = mpm.rollout(step, before, 3, DT, graph=graph)
            grads = torch.autograd.grad(end.v.square().sum(), ball.position) if wanted else ()
            torch.testing.assert_close(ball.pose_in(end).centre, ball.position.detach())
            found.append((end.detach(), grads))
        assert_alike(*found)
    assert len(captured) == (1 if wanted else 3)


def slowed(state, k):
    return state.replace(v=0.99 * state.v)


@pytest.mark.parametrize(
    "options", [{"checkpoint": 5}, {"checkpoint": mpm.Checkpoints(states=3)}, {"every": 4, "hook": slowed}]
)
def test_with_checkpoints_and_hooks(options, device, captured):
    step, state = learned(device)
    again = learned(device)[0]
    take = lambda step, state, n, dt: mpm.rollout(step, state, n, dt, **options)  # noqa: E731
    assert_alike(trained(step, state, 13, in_graphs_of(2, **options)), trained(again, state, 13, take))
    assert captured
    assert int(step.status[0, Status.ACTIVATIONS]) == int(again.status[0, Status.ACTIVATIONS]) == 13


def test_frames_pass_it_on(device, captured):
    step, state = learned(device)
    with torch.no_grad():
        found = mpm.frames(step, state, 6, DT, every=2, graph=2)
        expected = mpm.frames(learned(device)[0], state, 6, DT, every=2)
    assert len(captured) == 1
    assert float((found.fields["x"] - expected.fields["x"]).abs().max()) < 1e-14


def test_random_numbers_are_those_of_the_first_time(device, captured):
    """Dropout falls on the same particles in the backward pass, and the generator is left where steps from Python leave
    it."""
    found = []
    for take in (in_graphs_of(3), one_by_one):
        step, state = learned(device)
        step.law.function.layers.append(nn.Dropout(0.5))
        torch.manual_seed(11)
        found.append(trained(step, state, 7, take) + (torch.rand(3, device=device),))
    assert_alike(found[0][:2], found[1][:2])
    assert torch.equal(found[0][2], found[1][2])


def test_a_backward_pass_after_other_calls(device, captured):
    """Graphs contain another state, and other particles, by then."""
    step, state = learned(device)
    starts = [state.replace(v=(k * state.v).requires_grad_()) for k in (1.0, 3.0)]
    ends = [mpm.rollout(step, start, 4, DT, graph=4) for start in starts]
    mpm.rollout(step, blob(device, 2, 100), 4, DT, graph=4)
    for start, end in zip(starts, ends, strict=True):
        expected = one_by_one(learned(device)[0], start, 4, DT)
        for _ in range(2):  # and it may be gone through twice
            grad = torch.autograd.grad(end.v.square().sum(), start.v, retain_graph=True)[0]
            reference = torch.autograd.grad(expected.v.square().sum(), start.v, retain_graph=True)[0]
            assert float((grad - reference).abs().max()) < 1e-12 * float(reference.abs().max())


def test_on_the_cpu_steps_are_taken_as_without():
    step, state = learned("cpu")
    assert_alike(trained(step, state, 5, in_graphs_of(2)), trained(step, state, 5, one_by_one), 1e-14)
    assert "_captured_graphs" not in vars(step)
    assert step.explain(state, DT).startswith("step by step, because")
    with pytest.raises(ValueError, match="graph must be at least 1"):
        mpm.rollout(step, state, 5, DT, graph=0)


# ---- what is captured, and when


def test_another_kind_is_captured(device, captured):
    step, state = learned(device)
    advance = mpm.make_graphed_step(step, None, DT, 2)
    assert not captured
    made = 0

    def check(state, new):
        nonlocal made
        assert_alike(
            trained(step, state, 2, lambda s, state, n, dt: advance(state)), trained(step, state, 2, one_by_one)
        )
        made += new
        assert len(captured) == made

    check(state, 1)
    check(state.replace(x=state.x + 0.01), 0)
    check(blob(device, 2, 200), 1)
    check(state, 0)
    check(state.replace(extra={"mark": torch.ones(300, device=device)}), 1)
    with torch.no_grad():
        assert_equal(advance(state), one_by_one(step, state, 2, DT))
    made += 1
    check(state, 0)
    step.flip = 0.5
    check(state, 1)
    step.gravity = torch.tensor([1.0, 0.0], dtype=F64, device=device)
    check(state, 1)
    step.gravity.mul_(2)  # and this is read anew
    check(state, 0)
    step.law = network(2, device).requires_grad_(True)
    check(state, 1)
    step.eval()
    check(state, 1)
    step.walls = "sticky"
    check(state, 1)


def test_the_latest_captured_graphs_are_kept(device, captured):
    step, _ = learned(device)
    advance = mpm.make_graphed_step(step, None, DT)
    states = [blob(device, 2, 20 + k) for k in range(CapturedGraphs.most + 1)]
    with torch.no_grad():
        for state in (*states, states[-1], states[1], states[0]):
            advance(state)
        assert len(captured) == len(states) + 1
        assert_equal(advance(states[0]), one_by_one(step, states[0], 1, DT))


def test_a_copy_of_a_step_begins_without(device, captured):
    step, state = blown(device)
    with torch.no_grad():
        expected = mpm.rollout(step, state, 4, DT, graph=2)
        for other in (copy.deepcopy(step), pickle.loads(pickle.dumps(step))):
            before = len(captured)
            assert_equal(mpm.rollout(other, state, 4, DT, graph=2), expected)
            assert len(captured) == before + 1
    assert step.explain(state, DT)


def test_materials_and_order_by_content(device, captured):
    """Where steps keep indices that follow from them: other tensors of the same content are no other kind."""
    step, state = mixed(device)
    again = mixed(device)[0]
    swapped = 1 - state.material
    with torch.no_grad():
        for material, made in ((state.material, 1), (state.material.clone(), 1), (swapped, 2), (state.material, 2)):
            given = state.replace(material=material)
            end = mpm.rollout(step, given, 4, DT, graph=2)
            assert_equal(end, one_by_one(again, given, 4, DT))
            assert len(captured) == made and end.material is material
    stiff = torch.linspace(1e3, 1e4, 300, dtype=F64, device=device)
    step, again = (
        mpm.Step(unit_box(2, deterministic=True), mpm.NeoHookean(E=stiff, nu=0.3), on_grid=lambda b, v, m, dt: 0.99 * v)
        for _ in range(2)
    )
    state = blob(device, 2)
    orders = [torch.arange(300, device=device), torch.arange(300, device=device).flip(0)]
    with torch.no_grad():
        for ids in (*orders, orders[0]):
            given = state.replace(ids=ids)
            assert_equal(mpm.rollout(step, given, 4, DT, graph=2), one_by_one(again, given, 4, DT))
        step.law.E.mul_(2)  # steps store a copy of E
        again.law.E = step.law.E.clone()
        assert_equal(mpm.rollout(step, given, 4, DT, graph=2), one_by_one(again, given, 4, DT))


def test_states_are_not_kept(device, captured):
    """Neither states nor their history are stored, as after the first rollout of a long training."""
    step, state = learned(device)
    v = state.v.clone().requires_grad_()
    middle = mpm.rollout(step, state.replace(v=v), 2, DT)
    end = mpm.rollout(step, middle, 5, DT, graph=2)
    torch.autograd.grad(end.x.sum(), v)
    kept = [weakref.ref(t) for t in (v, middle.x, middle.F, end.x)]
    del v, middle, end
    gc.collect()
    assert captured and not any(ref() is not None for ref in kept)


def test_graphs_go_with_their_step(device, captured):
    """At once: a loop over steps must not keep the memory of their graphs until the garbage collector runs."""
    step, state = blown(device)
    with torch.no_grad():
        mpm.rollout(step, state, 4, DT, graph=2)
    kept = [weakref.ref(graphs) for graphs in captured]
    captured.clear()
    gc.collect()
    gc.disable()
    try:
        del step
        assert kept and not any(ref() is not None for ref in kept)
    finally:
        gc.enable()


def test_under_autocast_and_without_gradients_for_good(device, captured):
    """Separate graphs: half precision is that of the call, and tensors of inference mode stay in inference mode."""
    step, state = mixed(device)
    step, state = step.float(), state.to(dtype=torch.float32)
    with torch.inference_mode():
        mpm.rollout(step, state, 2, DT, graph=2)
    again = mpm.Step(unit_box(2, deterministic=True), step.law, transfer="pic")
    plain, expected_plain = (trained(s, state, 4, take) for s, take in ((step, in_graphs_of(2)), (again, one_by_one)))
    with torch.autocast(device, torch.bfloat16):
        half, expected = (trained(s, state, 4, take) for s, take in ((step, in_graphs_of(2)), (again, one_by_one)))
    assert len(captured) == 3
    # With casts of weights that are kept, autograd sums up gradients of the steps in half precision.
    for found, reference, tolerance in ((plain, expected_plain, 1e-5), (half, expected, 1e-2)):
        error = float((found[0].v - reference[0].v).abs().max())
        assert error < 0.1 * float((half[0].v - plain[0].v).abs().max())
        for grad, expected_grad in zip(found[1], reference[1], strict=True):
            assert float((grad - expected_grad).abs().max()) < tolerance * float(expected_grad.abs().max())


def test_the_pool_follows_the_scene(device, captured):
    """Matter that flies apart wants more blocks than it began with, in a training loop too."""
    found = []
    for take in (in_graphs_of(8), one_by_one):
        step, state = learned(device)
        step.walls, step.grid = None, unit_box(2, 0.02, deterministic=True)
        first = step(state.replace(x=0.5 + 0.3 * (state.x - 0.5)), DT).detach()
        first = first.replace(v=70 * (first.x - 0.5))
        before = step.grid.max_blocks
        found.append(trained(step, first, 192, take))
        step.check()
        assert step.grid.max_blocks > before
    assert_alike(*found, tolerance=1e-9)
    assert len(captured) > 1


class OwnStep(mpm.Step):
    pass


class OwnLaw(mpm.NeoHookean):
    pass


class Target(nn.Module):
    """User module with a tensor that is no buffer."""

    def __init__(self, device):
        super().__init__()
        self.wind = torch.tensor([1.0, 0.0], dtype=F64, device=device)

    def forward(self, blocks, velocity, mass, dt):
        return velocity + dt * self.wind


ASSIGNED = {
    "gravity": lambda step: setattr(step, "gravity", (3.0, 0.0)),
    "flip": lambda step: setattr(step, "flip", 0.5),
    "form": lambda step: setattr(step, "stress_form", "gradient"),
    "walls": lambda step: setattr(step.walls, "kind", ("sticky", "sticky")),
    "modulus": lambda step: setattr(step.law, "E", 5e4),
    "ball": lambda step: setattr(step.boundaries[0], "velocity", (0.0, -9.0)),
    "tensor": lambda step: setattr(step.on_grid, "wind", -step.on_grid.wind),
}


@pytest.mark.parametrize("what", ASSIGNED)
def test_what_is_assigned_is_captured_anew(what, device, captured):
    """Attributes of subclasses too, of objects that the step stores, and tensors of the user."""

    def make():
        ball = mpm.Sphere((0.5, 0.2), 0.15, velocity=(0.0, 4.0))
        law = OwnLaw(E=1e4, nu=0.3)
        walls = mpm.Walls("slip", lower=(0.4, 0.0), upper=(1.0, 1.0))
        options = {"walls": walls, "boundaries": [ball], "on_grid": Target(device)}
        return OwnStep(unit_box(2, deterministic=True), law, (0.0, -9.8), **options)

    step, again, state = make(), make(), blob(device, 2)
    with torch.no_grad():
        mpm.rollout(step, state, 4, DT, graph=2)
        before = one_by_one(again, state, 4, DT)
        for one in (step, again):
            ASSIGNED[what](one)
        end, expected = mpm.rollout(step, state, 4, DT, graph=2), one_by_one(again, state, 4, DT)
    assert len(captured) == 2
    assert_equal(end, expected)
    assert float((expected.v - before.v).abs().max()) > 1e-4


class Twice(nn.Module):
    """Two steps, and a time and a history of its own."""

    def __init__(self, step, starts_over):
        super().__init__()
        self.step, self.starts_over = step, starts_over
        self.norm = nn.BatchNorm1d(2).double()

    def forward(self, state, dt):
        self.norm(state.v)
        state = self.step(self.step(state, dt), dt)
        return state.replace(extra={}, time=0.0) if self.starts_over else state


@pytest.mark.parametrize("starts_over", [False, True])
def test_a_module_of_the_users_says_what_time_it_is(device, captured, starts_over):
    """And may drop a history; what it writes to buffers are its calls alone."""
    module, again = (Twice(blown(device)[0], starts_over).to(device) for _ in range(2))
    state = blob(device, 2).replace(extra={"mark": torch.ones(300, dtype=F64, device=device)})
    with torch.no_grad():
        end, expected = mpm.rollout(module, state, 4, DT, graph=2), one_by_one(again, state, 4, DT)
    torch.testing.assert_close(torch.as_tensor(end.time).double().cpu(), torch.as_tensor(expected.time).double().cpu())
    assert end.extra.keys() == expected.extra.keys()
    assert int(module.norm.num_batches_tracked) == int(again.norm.num_batches_tracked) == 4
    assert_equal(end.replace(time=0.0), expected.replace(time=0.0))


def test_a_step_that_was_moved_is_captured(device, captured):
    """After steps on the CPU."""
    step, state = blown("cpu")
    with torch.no_grad():
        state = step(state, DT)
        step, state = step.to(device), state.to(device)
        mpm.rollout(step, state, 4, DT, graph=2)
    assert step.status.device.type == torch.device(device).type and int(step.status[0, Status.ACTIVATIONS]) == 5


# ---- what does not go into a graph


def test_hooks_and_tensors_elsewhere_are_refused(device, captured):
    step, state = blown(device)
    advance = mpm.make_graphed_step(step, state, DT, n=2)
    hook = step.law.register_forward_hook(lambda module, args, result: None)
    with pytest.raises(ValueError, match="step must have no hooks"):
        advance(state)
    hook.remove()
    advance(state)
    step.register_buffer("elsewhere", torch.ones((), device="meta"))
    with pytest.raises(ValueError, match="step must be on the device of the state"):
        mpm.make_graphed_step(step, state, DT, n=2)
    if device == "cuda":
        assert "a tensor of it is on meta" in step.explain(state, DT)


def test_gradients_that_would_be_lost_are_refused(device, captured):
    weight = torch.ones((), dtype=F64, device=device, requires_grad=True)
    state = blob(device, 2)
    for used in (weight, 2 * weight):
        step = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3), on_grid=lambda b, v, m, dt, w=used: v * w)
        with pytest.raises(ValueError, match=r"must be a parameter or buffer of the step .* got one of shape \[\]"):
            mpm.rollout(step, state, 4, DT, graph=2)
        with torch.no_grad():  # where there is none to lose
            mpm.rollout(step, state, 4, DT, graph=2)


def test_what_is_wrong(device, captured):
    step, state = learned(device)
    with pytest.raises(TypeError, match="step must be a Step or another module"):
        mpm.make_graphed_step(lambda state, dt: state, state, DT)
    with pytest.raises(TypeError, match="state"):
        mpm.make_graphed_step(step, None, DT)(state.x)
    with pytest.raises(ValueError, match="n must be at least 1"):
        mpm.make_graphed_step(step, state, DT, 0)
    advance = mpm.make_graphed_step(step, state, DT, 2)
    v = state.v.clone().requires_grad_()
    grad = torch.autograd.grad(advance(state.replace(v=v)).v.square().sum(), v, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


@pytest.mark.filterwarnings("ignore:Anomaly Detection")
def test_obstacles(device, captured):
    step, state = learned(device)

    def why(step, state, dt):
        return mpm.plan_rollout(step, state, 100, dt).reasons["graph"]

    assert why(step, state, DT).startswith("rollout(graph=...)")
    assert why(lambda state, dt: state, state, DT) == "it is no module"
    assert why(step, state, torch.tensor(DT, device=device)) == "dt is a tensor"
    with torch.autograd.detect_anomaly():
        assert "anomaly" in why(step, state, DT)
    slow = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3), integrator="implicit")
    assert why(slow, state, DT) == "an implicit step waits for its solve"
    hot = warm(device)[0]
    hot.heat.method = "multigrid"
    assert "multigrid" in why(hot, state, DT)
    step.law.register_forward_hook(lambda *arguments: None)
    assert why(step, state, DT) == "there are hooks"
    with torch.no_grad():  # and such steps are taken all the same
        assert_equal(mpm.rollout(step, state, 3, DT, graph=2), one_by_one(learned(device)[0], state, 3, DT))
    assert not captured
    if device == "cuda":
        assert "not graph: there are hooks" in step.explain(state, DT)
        assert "rollout(graph=...) launches some" in learned(device)[0].explain(state, DT)
