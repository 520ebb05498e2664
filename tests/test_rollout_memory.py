"""Memory of rollouts with gradients: what allocators give is at most the estimate, and the budget of `Checkpoints`.

The scenes are so small that PyTorch's allocator has all tensors, see `memory.of_host_allocator`. On CUDA the working
memory of some kernels is larger than these scenes; `test_checkpoints.py` measures a large one there.
"""

import heat_scenes
import pytest
import torch
from heat_scenes import DT
from helpers import SingleSteps

import torch_mpm as mpm
from benchmarks.speed import checkpoints as study
from benchmarks.speed import memory

N = 9
KEPT = {
    "every": 3,
    "states": mpm.Checkpoints(states=3),
    "single steps": mpm.Checkpoints(every=1, states=2),
    "parts": mpm.Checkpoints(every=2, states=2),
}
SOLIDS = ("neo_hookean", "fluid", "von_mises", "viscoelastic", "mixture")


@pytest.fixture(autouse=True)
def parts_of_small_scenes(monkeypatch):
    monkeypatch.setattr("torch_mpm.rollouts.budget.KEPT_BYTES", {"cpu": 0, "cuda": 0})


def without_heat(step, state):
    step.heat = None
    return step, state.replace(temperature=None, extra={k: t for k, t in state.extra.items() if "temp" not in k})


def work(step, state, n, kept):
    """A rollout and its backward pass, by velocities and what else requires a gradient."""
    others = [t for t in (*step.parameters(), *step.buffers()) if t.requires_grad]

    def run():
        v = state.v.clone().requires_grad_()
        end = mpm.rollout(step, state.replace(v=v), n, DT, checkpoint=kept)
        loss = end.x.square().sum() + end.v.sum()
        torch.autograd.grad(loss, [v, *others], allow_unused=True)

    return run


def measured(step, state, n, kept):
    run = work(step, state, n, kept)
    run()  # Pools of blocks and caches are those of later calls.
    return memory.of_host_allocator(run)


def check(step, state, kept, n=N):
    """Neither too small nor useless: padding and unused headroom of small scenes are less than three times the rest."""
    found = measured(step, state, n, kept)
    estimate = mpm.estimate_rollout(step, state, n, DT, checkpoint=kept).memory
    assert found <= estimate < 4 * found


def quick(*cases):
    """Parameters of the cases. The first case is in the quick suite."""
    first, *others = cases
    return [first, *(pytest.param(case, marks=pytest.mark.thorough) for case in others)]


@pytest.mark.parametrize("kept", KEPT)
@pytest.mark.parametrize("heated", [False, True])
@pytest.mark.parametrize("law", quick("viscoelastic", *(law for law in SOLIDS if law != "viscoelastic")))
@pytest.mark.parametrize("dim", quick(2, 3))
def test_steps_in_one_op(dim, law, heated, kept):
    step, state = heat_scenes.scene(dim, torch.float32, law=law, per_cell=4)
    if not heated:
        step, state = without_heat(step, state)
    check(step, state, KEPT[kept])


@pytest.mark.parametrize("kept", KEPT)
@pytest.mark.parametrize("name", quick("wax", "two tables", "viscoelastic wax", "expansion and flow"))
def test_laws_of_temperature(name, kept):
    step, state = heat_scenes.thermal([name], 2, torch.float32, per_cell=4)
    check(step, state, KEPT[kept])


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("name", ["neo_hookean", "viscoelastic", "wax"])
def test_threads_copy_particles(name, threads):
    """For their laws. Of a small scene without heat, that of `neo_hookean`, it is most of the memory."""
    step, state = heat_scenes.thermal([name], 2, torch.float32, per_cell=4)
    if name == "neo_hookean":
        step, state = without_heat(*heat_scenes.scene(2, torch.float32, per_cell=4))
    torch.set_num_threads(threads)  # until the next test, see conftest.py
    check(step, state, mpm.Checkpoints(every=1, states=2))


@pytest.mark.parametrize("of", ["tables", "particles"])
def test_gradients_by_parameters(of, one_thread):
    """The backward pass has an adjoint per particle of each parameter, and of each value of a table."""
    step, state = heat_scenes.scene(2, torch.float32, per_cell=4)
    if of == "tables":
        knots = torch.linspace(-10, 20, 80)
        E = mpm.Table(knots, (1e5 - 1e3 * knots).requires_grad_())
    else:
        E = torch.full((len(state),), 1e5, requires_grad=True)
    step.law = mpm.NeoHookean(E=E, nu=0.3)
    values = E.value if of == "tables" else E
    without = mpm.estimate_rollout(heat_scenes.scene(2, torch.float32, per_cell=4)[0], state, N, DT, 3)
    assert mpm.estimate_rollout(step, state, N, DT, 3).memory > without.memory
    start = state.replace(v=state.v.clone().requires_grad_())
    (gradient,) = torch.autograd.grad(mpm.rollout(step, start, N, DT, checkpoint=3).v.square().sum(), values)
    assert gradient.norm() > 0
    check(step, state, 3)


@pytest.mark.parametrize("kept", KEPT)
@pytest.mark.parametrize("kind", quick("heat", "torch code", "obstacle on a path"))
def test_steps_from_python(kind, kept):
    """Of enough particles that fixed costs are small."""
    if kind == "heat":
        step, state = heat_scenes.scene(2, torch.float32, per_cell=16)
        step.__class__ = SingleSteps
    else:
        step, state = study.setup("torch code", 4, "cpu")
    if kind == "obstacle on a path":
        step.boundaries = [mpm.Sphere(lambda t: torch.stack([0.5 + t, 0.2 + 0 * t, 0.5 + 0 * t], -1), 0.1)]
        state = step.with_impulses(state)
    check(step, state, KEPT[kept])


@pytest.mark.parametrize("kept", KEPT)
def test_obstacles_on_paths(kept):
    """In one op, whose calls have a table of the rows of all steps, with gradients by it."""
    step, state = without_heat(*heat_scenes.scene(2, torch.float32, per_cell=4))
    speed = torch.tensor(5.0, requires_grad=True)
    path = mpm.Sphere(lambda t: torch.stack([0.45 + speed * t, 0.25 + 0 * t], -1), 0.12)
    step.boundaries = [path, heat_scenes.bodies(2)["box"]]
    assert mpm.plan_rollout(step, state, N, DT).executor == "fused"
    check(step, state, KEPT[kept])


@pytest.mark.parametrize("hooked", [False, True])
@pytest.mark.parametrize("share", [2, 4])
@pytest.mark.parametrize("kind", ["one op", "heat"])
def test_a_budget_is_kept(kind, share, hooked):
    """A hook reads states on the way, and each of these is stored."""
    step, state = heat_scenes.scene(2, torch.float32, per_cell=4)
    if kind == "one op":
        step, state = without_heat(step, state)
    n, every = 64, 16
    budget = mpm.estimate_rollout(step, state, n, DT, checkpoint=mpm.Checkpoints(memory=1e12)).memory / share
    read = (lambda state, k: None) if hooked else None

    def run():
        v = state.v.clone().requires_grad_()
        kept = mpm.Checkpoints(memory=budget)
        end = mpm.rollout(step, state.replace(v=v), n, DT, checkpoint=kept, hook=read, every=every)
        torch.autograd.grad(end.x.square().sum(), v)

    run()
    assert memory.of_host_allocator(run) <= budget


@pytest.mark.thorough
def test_recomputed_tensors_that_no_gradient_reaches_are_released():
    """Of steps whose loss does not depend on their temperatures, with few stored states: not those of all steps."""
    step, state = heat_scenes.scene(2, torch.float32, per_cell=4)
    step.__class__ = SingleSteps
    for kept in (mpm.Checkpoints(states=2), mpm.Checkpoints(every=2, states=2)):
        few, many = (measured(step, state, n, kept) for n in (6, 14))
        assert many < 1.15 * few
