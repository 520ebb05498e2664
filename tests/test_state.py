"""Packing states: what joining, selecting and reordering keep of every particle."""

import pytest
import torch
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step
from torch_mpm.rollouts import checkpoints, facts, gradient_norms, graph_segments, memory
from torch_mpm.state.state import CONSTANTS, FIELDS, PARTICLE_FIELDS, ROLES, TRACKED


def block(count: int, device: str = "cpu", at: float = 0.3, **fields: object) -> mpm.State:
    """`count` particles of a 2-D scene, distinguished by their mass."""
    x = at + 0.3 * torch.rand(count, 2, dtype=torch.float64)
    mass = 1e-3 * (1 + torch.rand(count, dtype=torch.float64))
    state = mpm.State(x=x, v=torch.zeros_like(x), mass=mass, volume=torch.full_like(mass, 1e-3))
    return state.to(device).replace(**fields)


def grid(scenes: int = 1) -> mpm.Grid:
    return mpm.Grid(0.1, (0, 0), (1, 1), scenes=scenes, deterministic=True)


def test_joined_states_restore_in_their_own_orders(device):
    """ids of states that were sorted, selected or neither: unique, and `restored` is each state's own, one by one."""
    first, second, third = (block(n, device) for n in (40, 30, 20))
    parts = [first.sorted(grid()), second, third.sorted(grid())]
    some = third.sorted(grid()).select(torch.arange(0, 20, 3, device=device))
    joined = mpm.State.concatenate([*parts, some])
    assert torch.equal(joined.ids.sort().values, torch.arange(len(joined), device=device))
    expected = torch.cat([first.mass, second.mass, third.mass, some.restored().mass])
    assert torch.equal(joined.sorted(grid()).restored().mass, expected)
    again = mpm.State.concatenate([joined, first])
    assert torch.equal(again.restored().mass, torch.cat([expected, first.mass]))
    assert mpm.State.concatenate([first, second]).ids is None


def test_parameters_follow_particles_through_sorting_and_joining(device):
    """E per particle in a batch of sorted scenes: as each scene alone, and gradients too."""
    sizes = (60, 45)
    alone = [block(n, device, at) for n, at in zip(sizes, (0.2, 0.45), strict=True)]
    moduli = [1e4 * (1 + torch.rand(n, dtype=torch.float64)).to(device) for n in sizes]

    def run(state: mpm.State, E: Tensor, scenes: int) -> tuple[Tensor, Tensor]:
        E = E.clone().requires_grad_()
        step = mpm.Step(grid(scenes), mpm.NeoHookean(E=E, nu=0.3), gravity=(0.0, -9.8), walls="slip")
        end = mpm.rollout(step, state, 5, 1e-3).restored()
        return end.x.detach(), torch.autograd.grad(end.x.square().sum(), E)[0]

    packed = mpm.State.concatenate([s.sorted(grid()) for s in alone], scene=True)
    x, slope = run(packed, torch.cat(moduli), 2)
    ends = [run(s, E, 1) for s, E in zip(alone, moduli, strict=True)]
    torch.testing.assert_close(x, torch.cat([end for end, _ in ends]), rtol=1e-12, atol=0)
    torch.testing.assert_close(slope, torch.cat([grad for _, grad in ends]), rtol=1e-8, atol=1e-18)


def test_scenes_of_several_batches_follow_each_other(device):
    def batch(*sizes: int, **fields: object) -> mpm.State:
        return mpm.State.concatenate([block(n, device) for n in sizes], scene=True).replace(**fields)

    two, one, three = batch(3, 2), block(4, device), batch(1, 2, 1)
    joined = mpm.State.concatenate([two, one, three], scene=True)
    assert joined.scene.tolist() == [0] * 3 + [1] * 2 + [2] * 4 + [3] + [4] * 2 + [5]
    times = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, device=device)
    longer = batch(3, 2, time=times)  # whose last scene has lost its particles
    joined = mpm.State.concatenate([longer, one.replace(time=0.5)], scene=True)
    assert joined.scene.tolist() == [0] * 3 + [1] * 2 + [3] * 4
    torch.testing.assert_close(joined.time, torch.tensor([0.1, 0.2, 0.3, 0.5], dtype=torch.float64, device=device))
    counted = mpm.State.concatenate([two, one], scene=True, scenes=[5, 1])
    assert counted.scene.tolist() == [0] * 3 + [1] * 2 + [5] * 4
    with pytest.raises(ValueError, match=r"scenes must have one count for each of 2 states, got \[1\]"):
        mpm.State.concatenate([two, one], scene=True, scenes=[1])
    with pytest.raises(ValueError, match=r"scenes\[0\] must be above 1, .*, got 1"):
        mpm.State.concatenate([two, one], scene=True, scenes=[1, 1])


def test_time_of_joined_states(device):
    """Each scene keeps its time, with its gradient; bodies of one batch need one time."""
    dt = torch.tensor(0.25, dtype=torch.float64, device=device, requires_grad=True)
    first, second = block(3, device), block(2, device)
    late = second.replace(time=0.5 + dt)
    joined = mpm.State.concatenate([first.replace(time=0.5), late], scene=True)
    torch.testing.assert_close(joined.time.detach(), torch.tensor([0.5, 0.75], dtype=torch.float64, device=device))
    assert float(torch.autograd.grad(joined.time.sum(), dt)[0]) == 1
    same = [s.replace(time=0.5) for s in (first, second)]
    assert mpm.State.concatenate(same, scene=True).time == 0.5
    assert mpm.State.concatenate(same).time == 0.5
    with pytest.raises(ValueError, match=r"states of one batch must have one time, got 0.0 and 0.5.*scene=True"):
        mpm.State.concatenate([first, same[1]])
    with pytest.raises(ValueError, match="one time"):
        mpm.State.concatenate([same[0], late])


def test_absent_fields_are_made_or_named(device):
    first, second = block(3, device), block(2, device)
    moving = first.replace(
        C=torch.rand(3, 2, 2, dtype=torch.float64, device=device),
        F=torch.rand(3, 2, 2, dtype=torch.float64, device=device),
        J=torch.rand(3, dtype=torch.float64, device=device),
    )
    joined = mpm.State.concatenate([moving, second])
    step = mpm.Step(grid(), mpm.Mixture([mpm.NeoHookean(E=1.0, nu=0.3), mpm.WeaklyCompressible(1.0)]))
    made = step.prepare(second)
    for name, expected in (("C", torch.zeros_like(moving.C[:2])), ("F", made.F), ("J", made.J)):
        assert torch.equal(getattr(joined, name), torch.cat([getattr(moving, name), expected]))
    for name, dtype in (("temperature", torch.float64), ("material", torch.int32), ("scene", torch.int32)):
        given = first.replace(**{name: torch.zeros(3, dtype=dtype, device=device)})
        with pytest.raises(ValueError, match=f"state 1 has no {name}, which state 0 has"):
            mpm.State.concatenate([given, second])
    kept = first.replace(extra={"plastic_strain": torch.zeros_like(first.mass)})
    with pytest.raises(ValueError, match=r"state 0 has no extra\['plastic_strain'\], which state 1 has.*step.prepare"):
        mpm.State.concatenate([second, kept])
    with pytest.raises(ValueError, match=r"states must have one dimension, dtype and device.*float32"):
        mpm.State.concatenate([first, second.to(dtype=torch.float32)])
    with pytest.raises(TypeError, match="states must be a list of State, got State"):
        mpm.State.concatenate(first)


def test_gradients_through_joining_and_selecting():
    first, second = block(3), block(2)
    leaf = first.x.clone().requires_grad_()
    joined = mpm.State.concatenate([first.replace(x=leaf), second, first.replace(x=2 * leaf)])
    weights = torch.rand(8, 2, dtype=torch.float64)
    grad = torch.autograd.grad((weights * joined.select(torch.arange(7, -1, -1)).x).sum(), leaf)[0].flip(0)
    torch.testing.assert_close(grad, weights[5:] + 2 * weights[:3], rtol=1e-14, atol=0)


def test_time_of_every_scene_in_a_checkpoint(tmp_path):
    from torch_mpm.state import state_file
    from torch_mpm.state.state import tensors_of

    pytest.importorskip("h5py")
    state = mpm.State.concatenate([block(3).replace(time=0.1), block(2).replace(time=0.2)], scene=True)
    state_file.save(tmp_path / "state.h5", tensors_of(state), {"time": 0.0})
    loaded, _ = state_file.load(tmp_path / "state.h5")
    assert torch.equal(loaded.time, state.time) and torch.equal(loaded.x, state.x)


@pytest.mark.parametrize(
    "arguments",
    [(torch.float64,), ("cpu", torch.float64), (None, torch.float64), (torch.zeros(3, dtype=torch.float64),)],
    ids=["dtype", "device and dtype", "no device", "tensor"],
)
def test_to_takes_what_a_module_does(arguments):
    """Whole numbers keep their dtype, clocks and impulses are float64."""
    P = 4
    state = mpm.State(
        x=torch.rand(P, 2), v=torch.rand(P, 2), mass=torch.ones(P), volume=torch.ones(P), F=torch.rand(P, 2, 2),
        scene=torch.zeros(P, dtype=torch.int32), ids=torch.arange(P), material=torch.zeros(P, dtype=torch.int32),
        extra={"strain": torch.rand(P), "count": torch.arange(P)}, time=torch.tensor([0.1]),
        impulse=torch.zeros(1, 4, 3, dtype=torch.float64),
    )  # fmt: skip
    module = torch.nn.Module()
    for name in ("x", "v", "mass", "volume", "F", "scene", "ids", "material"):
        module.register_buffer(name, getattr(state, name))
    for name, value in state.extra.items():
        module.register_buffer(f"extra_{name}", value)
    module.to(*arguments)
    moved = state.to(*arguments)
    for name in ("x", "v", "mass", "volume", "F", "scene", "ids", "material"):
        assert (
            torch.equal(getattr(moved, name), getattr(module, name))
            and getattr(moved, name).dtype == getattr(module, name).dtype
        )
    for name, value in moved.extra.items():
        assert value.dtype == getattr(module, f"extra_{name}").dtype
    assert moved.time.dtype == moved.impulse.dtype == torch.float64
    assert moved.to(torch.float32).x.dtype == torch.float32 and moved.to(torch.float32).time.dtype == torch.float64


def test_a_time_of_an_earlier_version_is_read(tmp_path):
    """Its tensors were in the dtype of the particles."""
    state = mpm.State(x=torch.rand(3, 2), v=torch.rand(3, 2), mass=torch.ones(3), volume=torch.ones(3))
    state.__dict__["_time"] = torch.tensor([0.1, 0.2])
    torch.save(state, tmp_path / "state.pt")
    read = torch.load(tmp_path / "state.pt", weights_only=True)
    assert read.time.dtype == torch.float64 and read.time.tolist() == torch.tensor([0.1, 0.2]).double().tolist()
    assert mpm.State.concatenate([read.replace(time=0.25)]).time == 0.25


WRONG = {
    "v": lambda s: s.v[1:],
    "mass": lambda s: s.mass[1:],
    "volume": lambda s: s.volume.float(),
    "C": lambda s: s.x.new_zeros(len(s), 3, 3),
    "F": lambda s: s.x.new_zeros(len(s) - 1, 2, 2),
    "J": lambda s: s.mass[1:],
    "scene": lambda s: torch.zeros(len(s) - 1, dtype=torch.int32),
    "ids": lambda s: torch.arange(len(s) - 1),
    "material": lambda s: torch.zeros(len(s)),
    "temperature": lambda s: s.mass[1:],
    "extra": lambda s: {"history": s.mass[1:]},
    "impulse": lambda s: s.mass.new_zeros(3),
    "x_residual": lambda s: s.x[1:],
}
"""A field that does not fit its state."""


@pytest.mark.parametrize("way", ["replace", "step", "rollout"])
@pytest.mark.parametrize("name", WRONG)
def test_fields_that_do_not_fit_are_errors(name, way):
    """Also where a field is assigned, and no op reads it."""
    step, state = mpm.Step(grid(), mpm.NeoHookean(E=1e4, nu=0.3)), block(5)
    wrong = WRONG[name](state)
    with pytest.raises((TypeError, ValueError, RuntimeError), match=name.removeprefix("x_")):
        if way == "replace":
            state.replace(**{name: wrong})
        setattr(state, name, wrong)
        step(state, 1e-4) if way == "step" else mpm.rollout(step, state, 2, 1e-4)


def test_fields_that_do_not_exist_are_errors():
    with pytest.raises(TypeError, match="velocity"):
        block(5).replace(velocity=None)


def test_copies_share_nothing_that_is_replaced():
    state = block(5).replace(extra={"history": torch.zeros(5)})
    changed = state.replace(time=0.5, extra={}, v=state.v + 1)
    assert changed.time == 0.5 and state.time == 0 and set(state.extra) == {"history"} and changed.extra == {}
    assert changed.x is state.x and not torch.equal(changed.v, state.v)
    with pytest.raises(ValueError, match="v must have shape"):
        state.replace(x=state.x[1:])


# ---- roles of fields


def step_and_state_with_all_fields(device: str) -> tuple[mpm.Step, mpm.State]:
    """A step that reads all fields and changes all that a step may change, and a state with all fields."""
    step = make_step(2, gravity=(0.3, -9.8), walls="slip", compensated=True)
    step.heat = mpm.Heat(step.grid, 2.0, 1.0, transfer="flip")
    state = block_state(2, device, low=0.02, high=0.4)  # Touches walls.
    P = len(state)
    indices = {name: torch.zeros(P, dtype=torch.int32, device=device) for name in ("scene", "material")}
    state = state.replace(
        **indices,
        v=torch.rand_like(state.v),
        C=torch.rand(P, 2, 2, dtype=torch.float64).to(device),
        F=torch.eye(2, dtype=torch.float64, device=device) + 0.01 * torch.rand(P, 2, 2, device=device).double(),
        J=torch.ones_like(state.mass),
        ids=torch.arange(P, device=device),
        temperature=torch.rand_like(state.mass),
        extra={"history": torch.zeros_like(state.mass)},
        time=torch.zeros(1, dtype=torch.float64, device=device),
        impulse=torch.zeros(1, 4, 3, dtype=torch.float64, device=device),
        x_residual=torch.zeros_like(state.x),
    )
    return step, state


@pytest.mark.parametrize("name", [name for name in FIELDS if name != "extra"])
def test_steps_change_the_fields_that_their_role_names(name, device):
    step, state = step_and_state_with_all_fields(device)
    before, after = (getattr(s, name) for s in (state, step(state, 1e-3)))
    assert torch.equal(before, after) == (ROLES[name].changed_by is None)
    step.heat = None
    assert torch.equal(before, getattr(step(state, 1e-3), name)) == (ROLES[name].changed_by != "motion")


@pytest.mark.parametrize("name", [name for name in PARTICLE_FIELDS if name not in ("scene", "ids", "material")])
def test_gradients_pass_to_the_fields_that_their_role_names(name, device):
    step, state = step_and_state_with_all_fields(device)
    given = getattr(state, name).clone().requires_grad_()
    end = step(state.replace(**{name: given}), 1e-3)
    loss = sum(getattr(end, result).square().sum() for result in TRACKED) + 0 * given.sum()
    (grad,) = torch.autograd.grad(loss, given)
    assert bool(grad.any()) == ROLES[name].differentiable


def test_every_field_has_a_role_and_is_in_the_lists_that_it_determines():
    """All lists of fields in rollouts are derived from the roles."""
    assert tuple(ROLES) == FIELDS
    for name, role in ROLES.items():
        if name == "extra":
            continue
        tracked = role.changed_by is not None and role.differentiable
        assert (name in CONSTANTS) == (role.changed_by is None)
        assert (name in TRACKED) == tracked
        assert (name in gradient_norms.NORMED) == (tracked and name in PARTICLE_FIELDS)
        assert (name in facts._READ) == (role.differentiable and role.changed_by != "heat")
    assert checkpoints.CONSTANTS is memory.CONSTANTS is CONSTANTS and graph_segments.TRACKED is TRACKED


@pytest.mark.parametrize("name", [name for name in FIELDS if name not in ("scene", "ids", "material", "time")])
def test_rollouts_without_heat_are_differentiated_by_the_fields_that_motion_reads(name, device):
    step, state = step_and_state_with_all_fields(device)
    step.heat = None
    given = state.extra["history"] if name == "extra" else getattr(state, name)
    given = given.clone().requires_grad_()
    state = state.replace(**{name: {"history": given} if name == "extra" else given})
    role = ROLES[name]
    assert facts.differentiates(step, state, 1e-3) == (role.differentiable and role.changed_by != "heat")
