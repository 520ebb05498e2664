"""Plans: schedule, pool and steps of a call by its facts, on any machine; and how rollouts follow them."""

import dataclasses

import pytest
import torch
from cases.rollouts import DT, LAWS_HERE, one_by_one

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box
from torch_mpm.rollouts.facts import Facts
from torch_mpm.rollouts.plan import SCHEDULES, plan_call

CUDA = Facts(
    cuda=True,
    float32=True,
    dim=3,
    particles=20000,
    scenes=1,
    steps=1000,
    blocks_per_scene=10000,
    max_blocks=500,
    grows=True,
    deterministic=False,
    quadratic=True,
    apic=True,
    flips=False,
    mls=True,
    mirrors=False,
    impulses=False,
    clocks=False,
    scene_ids=False,
    sorted=True,
    laws=1,
    materials=False,
    additive=False,
    uniform_parameters=True,
    one_deformation=True,
    gradients=False,
    records=False,
    captured=False,
    graph_loops=True,
    path_bytes=0,
    obstacles=0,
    heat=False,
    rests=False,
    bodies=False,
)
CPU = CUDA._replace(cuda=False, graph_loops=False)
FEW = CUDA._replace(particles=5000, blocks_per_scene=1000, max_blocks=100)
MANY = CUDA._replace(particles=2**20, blocks_per_scene=10**6, max_blocks=4000)
BATCH = CUDA._replace(particles=100 * 500, scenes=100, scene_ids=True, blocks_per_scene=64, max_blocks=2000)


def test_facts_are_the_arguments_of_the_op():
    arguments = torch.ops.torch_mpm.plan_substeps.default._schema.arguments
    assert ["schedule", *Facts._fields] == [a.name for a in arguments]


# The facts, what differs in them, and the schedule, blocks and steps of a call.
DECISIONS = [
    (CPU, {}, "sorted_cpu", None, 1000),
    (CPU, {"steps": 1}, "per_step", None, 1),
    (CPU, {"steps": 10**6}, "sorted_cpu", None, 2**16),
    (CPU, {"gradients": True, "records": True}, "per_step", None, 1000),
    (CPU, {"gradients": True, "float32": False, "flips": True, "deterministic": True}, "sorted_cpu", None, 1000),
    (CUDA, {}, "per_step", None, 64),
    (CUDA, {"grows": False}, "per_step", None, 1000),
    (CUDA, {"grows": False, "steps": 10**6}, "per_step", None, 2**28 // 20000),
    (CUDA, {"grows": False, "particles": 10**7, "steps": 10**6}, "fused_g2p2g", None, 512),
    (CUDA, {"grows": False, "path_bytes": 2**20}, "per_step", None, 64),
    # Few particles.
    (FEW, {}, "persistent", 1000, 1000),
    (FEW, {"bodies": True}, "per_step", None, 64),
    (MANY, {"bodies": True}, "per_step", 32768, 512),
    (BATCH, {"bodies": True}, "per_step", None, 64),
    (CPU, {"bodies": True}, "sorted_cpu", None, 1000),
    (FEW, {"steps": 2000}, "persistent", 1000, 1024),
    (FEW, {"steps": 10}, "persistent", 1000, 10),
    (FEW, {"steps": 9}, "per_step", None, 9),
    (FEW, {"max_blocks": -1}, "per_step", None, 64),
    (FEW, {"max_blocks": -1, "deterministic": True}, "persistent", 1000, 1000),
    (FEW, {"max_blocks": 420}, "per_step", None, 64),
    (FEW, {"max_blocks": 420, "blocks_per_scene": 420}, "persistent", None, 64),
    (FEW, {"blocks_per_scene": 4097}, "per_step", None, 64),
    (FEW, {"particles": 2**14 + 1, "deterministic": True}, "per_step", None, 64),
    (FEW, {"particles": 2**15, "max_blocks": 50}, "persistent", 1000, 1000),
    (FEW, {"particles": 2**15 + 1, "max_blocks": 50}, "per_step", None, 64),
    (FEW, {"obstacles": 1}, "persistent", 1000, 1000),
    (FEW, {"obstacles": 2}, "persistent", 1000, 1000),
    (FEW, {"grows": False}, "persistent", None, 1000),
    (FEW, {"grows": False, "max_blocks": 257}, "per_step", None, 1000),
    (FEW, {"grows": False, "particles": 2**14 + 1}, "per_step", None, 1000),
    (FEW, {"dim": 2, "max_blocks": 450}, "persistent", 1000, 1000),
    (FEW, {"dim": 2, "max_blocks": 480}, "per_step", None, 64),
    (FEW, {"captured": True}, "per_step", 1000, 1000),
    (FEW, {"graph_loops": False}, "per_step", 1000, 1000),
    (FEW, {"clocks": True}, "persistent", 1000, 1000),
    (FEW, {"clocks": True, "deterministic": True}, "per_step", 1000, 1000),
    (FEW, {"one_deformation": False}, "per_step", 1000, 1000),
    (FEW, {"gradients": True}, "per_step", None, 64),
    (FEW, {"float32": False}, "per_step", None, 64),
    (FEW, {"quadratic": False}, "per_step", None, 64),
    (FEW, {"apic": False}, "per_step", None, 64),
    (FEW, {"flips": True}, "per_step", None, 64),
    (FEW, {"mls": False}, "per_step", None, 64),
    (FEW, {"mirrors": True}, "per_step", None, 64),
    (FEW, {"impulses": True}, "per_step", None, 64),
    (FEW, {"laws": 2}, "per_step", None, 64),
    (FEW, {"heat": True}, "per_step", 1000, 1000),
    (FEW, {"heat": True, "blocks_per_scene": 1025}, "per_step", None, 64),
    (FEW, {"heat": True, "gradients": True}, "per_step", None, 64),
    # Many particles.
    (MANY, {}, "fused_g2p2g", 2**15, 512),
    (MANY, {"max_blocks": 9000}, "fused_g2p2g", 2**15, 256),
    (MANY, {"max_blocks": 11000}, "fused_g2p2g", None, 64),
    (MANY, {"blocks_per_scene": 2**15}, "fused_g2p2g", 2**15, 1000),
    (MANY, {"deterministic": True}, "fused_g2p2g", None, 64),
    (MANY, {"steps": 3}, "per_step", 2**15, 3),
    (MANY, {"scene_ids": True}, "per_step", 2**15, 512),
    (MANY, {"uniform_parameters": False}, "per_step", 2**15, 512),
    (MANY, {"mirrors": True}, "per_step", None, 64),
    (MANY, {"particles": 2**18}, "fused_g2p2g", None, 64),
    (MANY, {"particles": 2**18 - 1}, "per_step", None, 64),
    (MANY, {"gradients": True}, "per_step", None, 64),
    # Small scenes.
    (BATCH, {}, "block_per_scene", None, 64),
    (BATCH, {"steps": 3}, "per_step", None, 3),
    (BATCH, {"apic": False}, "block_per_scene", None, 64),
    (BATCH, {"one_deformation": False}, "block_per_scene", None, 64),
    (BATCH, {"particles": 100 * 2305}, "per_step", None, 64),
    (BATCH, {"dim": 2, "particles": 100 * 4097}, "per_step", 6400, 1000),
    (BATCH, {"blocks_per_scene": 4097}, "per_step", None, 64),
    (BATCH, {"particles": 3 * 2000, "scenes": 3, "max_blocks": 1000}, "per_step", None, 64),
    (BATCH, {"particles": 3 * 2000, "scenes": 3, "deterministic": True, "clocks": True}, "block_per_scene", 192, 1000),
    (BATCH, {"flips": True}, "per_step", None, 64),
    (BATCH, {"gradients": True}, "per_step", None, 64),
    (BATCH, {"particles": 0}, "per_step", None, 64),
    (FEW, {"particles": 96}, "block_per_scene", 1000, 1000),
    (FEW, {"particles": 97}, "persistent", 1000, 1000),
]


@pytest.mark.parametrize(("facts", "changes", "schedule", "blocks", "steps"), DECISIONS)
def test_decisions(facts, changes, schedule, blocks, steps):
    facts = facts._replace(**changes)
    call = plan_call(None, facts)
    assert (call.schedule, call.max_blocks, call.steps) == (schedule, blocks, steps)
    assert {name for name, _ in call.reasons} == set(SCHEDULES) - {schedule}
    assert all(reason for _, reason in call.reasons)


@pytest.mark.parametrize(
    ("changes", "order"),
    [
        ({}, 1),
        ({"sorted": True}, 0),
        ({"steps": 63}, 0),
        ({"particles": 2**15 - 1}, 0),
        ({"captured": True}, 0),
        ({"cuda": False}, 0),
        ({"particles": 2**18}, 2),
        ({"particles": 2**18, "gradients": True}, 1),
        ({"particles": 2**18, "scene_ids": True}, 1),
        ({"particles": 2**18, "laws": 2}, 1),
        ({"particles": 2**18, "heat": True, "steps": 128}, 1),
        ({"particles": 2**18, "heat": True, "steps": 128, "sorted": True}, 1),
        ({"particles": 2**18, "heat": True, "steps": 127, "sorted": True}, 0),
        ({"particles": 2**18 - 1, "heat": True, "steps": 128, "sorted": True}, 0),
        ({"particles": 2**18, "heat": True, "steps": 128, "sorted": True, "gradients": True}, 0),
        ({"particles": 2**18, "heat": True, "rests": True, "steps": 8}, 1),
        ({"particles": 2**18, "heat": True, "rests": True, "steps": 7}, 0),
        ({"particles": 2**18 - 1, "heat": True, "rests": True, "steps": 8}, 0),
        ({"particles": 2**18, "heat": True, "rests": True, "steps": 8, "sorted": True}, 0),
        ({"particles": 2**18, "heat": True, "rests": True, "steps": 8, "gradients": True}, 0),
        ({"particles": 2**18, "heat": True, "rests": True, "steps": 8, "captured": True}, 0),
        ({"cuda": False, "particles": 10, "heat": True, "rests": True, "steps": 8}, 1),
        ({"cuda": False, "particles": 10, "heat": True, "rests": True, "steps": 7}, 0),
    ],
)
def test_order_of_particles(changes, order):
    assert plan_call(None, CUDA._replace(sorted=False, particles=2**15)._replace(**changes)).order == order


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("scenes", [1, 40])
@pytest.mark.parametrize("blocks", [64, 4096, 4097, 8000])
@pytest.mark.parametrize("particles", [400, 5000, 2**14, 2**15, 2**18])
def test_the_schedule_of_a_deterministic_grid_does_not_depend_on_its_pool(dim, scenes, blocks, particles):
    """A pool may have grown to all blocks of the domain, and another run of the same steps begins with a small one."""
    facts = CUDA._replace(
        dim=dim, deterministic=True, scenes=scenes, scene_ids=scenes > 1, particles=particles, blocks_per_scene=blocks
    )
    every = blocks * scenes
    plans = [plan_call(None, facts._replace(max_blocks=pool)) for pool in (-1, every // 7 + 1, every // 2, every)]
    assert len({plan.schedule for plan in plans}) == 1


@pytest.mark.parametrize(
    ("schedule", "facts", "reason"),
    [
        ("sorted_cpu", CUDA, "the particles are on a CUDA device"),
        ("sorted_cpu", CPU._replace(gradients=True, records=True), "recorded for its gradient"),
        ("persistent", CPU, "the particles are on the CPU"),
        ("persistent", FEW._replace(steps=9), "fewer than 10 steps"),
        ("persistent", FEW._replace(particles=2**15 + 1), "more than 32768 particles"),
        ("persistent", FEW._replace(captured=True), "captured into a CUDA graph"),
        ("persistent", FEW._replace(graph_loops=False), "no CUDA graphs with loops"),
        ("fused_g2p2g", MANY._replace(scene_ids=True), "number of a scene"),
        ("fused_g2p2g", MANY._replace(gradients=True), "gradients are wanted"),
        ("fused_g2p2g", MANY._replace(flips=True), "FLIP"),
        ("block_per_scene", BATCH._replace(mirrors=True), "mirrors"),
        ("block_per_scene", BATCH._replace(float32=False), "float64"),
    ],
)
def test_a_schedule_that_cannot_take_the_steps(schedule, facts, reason):
    with pytest.raises(RuntimeError, match=f"schedule must be one that supports the call, got {schedule}: .*{reason}"):
        plan_call(schedule, facts)


def test_a_forced_schedule_pays_or_not():
    few = FEW._replace(particles=500)
    assert plan_call("fused_g2p2g", few).schedule == "fused_g2p2g"
    assert plan_call("per_step", FEW).schedule == "per_step"
    assert dict(plan_call("per_step", FEW).reasons)["persistent"] == "per_step was requested"


def test_calls_of_a_forced_schedule_have_about_as_many_steps():
    """So that the last one has enough for the schedule."""
    assert plan_call("fused_g2p2g", FEW._replace(steps=1025)).steps == 513
    assert plan_call("persistent", FEW._replace(steps=66, blocks_per_scene=4097)).steps == 33


# ---- rollouts


def elastic(device: str, **options) -> tuple[mpm.Step, mpm.State]:
    return mpm.Step(unit_box(), LAWS_HERE["neo_hookean"](), **options), blob(device)


def test_a_plan_is_a_value(device):
    step, state = elastic(device)
    with torch.no_grad():
        plan = mpm.plan_rollout(step, state, 20, DT)
        assert plan == mpm.plan_rollout(step, state, 20, DT) and plan.executor == "fused"
        assert set(plan.reasons) == {"replay", "graph", "loop", *SCHEDULES} - {plan.schedule}
        with pytest.raises(dataclasses.FrozenInstanceError):
            plan.schedule = "per_step"
        text = step.explain(state, DT, n=20)
        assert text == str(plan) and f"all steps in one op (executor fused, schedule {plan.schedule})\n" in text
        assert all(f"not {name}: {reason}" in text for name, reason in plan.reasons.items())
        end = mpm.rollout(step, state, 20, DT, plan=plan)
        torch.testing.assert_close(end.x, mpm.rollout(step, state, 20, DT).x)  # Sums of atomics differ by rounding.
        assert SCHEDULES[torch.ops.torch_mpm.latest_schedule(state.x)] == plan.schedule


def test_plans_of_rollouts_with_gradients(device):
    step, state = elastic(device)
    state = state.replace(v=state.v.requires_grad_())
    plan = mpm.plan_rollout(step, state, 20, DT, checkpoint=5)
    assert (plan.steps_per_call, plan.checkpoints) == (5, mpm.Checkpoints(every=5))
    assert str(plan).startswith("all steps between two stored states in one op (executor fused, schedule ")
    whole = mpm.plan_rollout(step, state, 20, DT, checkpoint=mpm.Checkpoints(memory=1e9))
    assert whole.stores_all and whole.schedule == "per_step"
    ends = [mpm.rollout(step, state, 20, DT, plan=p).x for p in (plan, whole)]
    torch.testing.assert_close(*ends)
    least = mpm.plan_rollout(step, state, 400, DT, checkpoint=mpm.Checkpoints(memory=4e6))
    assert least.checkpoints is not None and least.checkpoints.memory is None and not least.stores_all


def test_frames_are_those_of_the_plan(device):
    step, state = elastic(device)
    with torch.no_grad():
        plan = mpm.plan_rollout(step, state, 5, DT, schedule="per_step")
        movie = mpm.frames(step, state, 10, DT, every=5, plan=plan)
        assert SCHEDULES[torch.ops.torch_mpm.latest_schedule(state.x)] == "per_step"
        torch.testing.assert_close(movie.end.x, mpm.frames(step, state, 10, DT, every=5, schedule="per_step").end.x)
        with pytest.raises(ValueError, match="must be None with a plan"):
            mpm.frames(step, state, 10, DT, every=5, schedule="per_step", plan=plan)


def test_a_rollout_to_a_time_follows_a_plan(device):
    step, state = elastic(device)
    with torch.no_grad():
        ends = []
        for options in ({}, {"schedule": "per_step"}):
            plan = mpm.plan_rollout(step, state, 8, torch.full((1,), DT).to(state.x), **options)
            ends += [mpm.rollout_to(step, state, 100 * DT, every=8, **named) for named in (options, {"plan": plan})]
        assert SCHEDULES[torch.ops.torch_mpm.latest_schedule(state.x)] == plan.schedule == "per_step"
        assert all(torch.equal(ends[0].substeps, end.substeps) for end in ends)
        for end in ends[1:]:
            torch.testing.assert_close(end.state.x, ends[0].state.x)
        with pytest.raises(ValueError, match="checkpoint and schedule must be None with a plan"):
            mpm.rollout_to(step, state, DT, schedule="per_step", plan=plan)
        with pytest.raises(TypeError, match="plan must be a RolloutPlan or None, got int"):
            mpm.rollout_to(step, state, DT, plan=3)
        with pytest.raises(ValueError, match="schedule must be one of"):
            mpm.rollout_to(step, state, 100 * DT, schedule="fastest")


def test_plans_of_steps_from_python(device):
    step, state = elastic(device, on_grid=lambda blocks, v, m, dt: v)
    plan = mpm.plan_rollout(step, state, 20, DT, graph=4)
    assert plan.reasons["fused"] == "it calls on_grid" and plan.schedule is None
    assert (plan.executor, plan.steps_per_call) == (("graph", 4) if device == "cuda" else ("loop", 1))
    assert mpm.plan_rollout(lambda state, dt: state, state, 5, DT).reasons["fused"] == "it is no Step"
    with pytest.raises(ValueError, match=r"schedule must be None .* got 'per_step': it calls on_grid"):
        mpm.rollout(step, state, 20, DT, schedule="per_step")


def test_a_plan_that_is_for_other_steps(device):
    step, state = elastic(device)
    plan = mpm.plan_rollout(step, state, 5, DT)
    step.on_grid = lambda blocks, v, m, dt: v
    with pytest.raises(ValueError, match="plan must be one for these steps, got the executor 'fused': it calls"):
        mpm.rollout(step, state, 5, DT, plan=plan)


def test_wrong_arguments(device):
    step, state = elastic(device)
    plan = mpm.plan_rollout(step, state, 5, DT)
    with pytest.raises(ValueError, match="must be None with a plan"):
        mpm.rollout(step, state, 5, DT, plan=plan, checkpoint=3)
    with pytest.raises(TypeError, match="plan must be a RolloutPlan or None, got int"):
        mpm.rollout(step, state, 5, DT, plan=3)
    with pytest.raises((TypeError, ValueError), match="schedule must be"):
        mpm.rollout(step, state, 5, DT, schedule="fastest")
    with pytest.raises(TypeError, match="step must be a Step or a function"):
        mpm.plan_rollout(3, state, 5, DT)
    with pytest.raises(ValueError, match="n must not be negative"):
        mpm.plan_rollout(step, state, -1, DT)
    with pytest.raises(ValueError, match=r"n must be below 2\^63, got 9223372036854775808"):
        mpm.plan_rollout(step, state, 2**63, DT)


@torch.no_grad()
def test_hooks_keep_the_schedule(device):
    step, state = elastic(device)
    seen = []
    end = mpm.rollout(
        step, state, 6, DT, hook=lambda state, k: seen.append(latest(state)), every=2, schedule="per_step"
    )
    assert seen[1:] == ["per_step", "per_step"]
    assert float((end.x - one_by_one(step, state, 6, DT).x).abs().max()) < 1e-12


def latest(state: mpm.State) -> str:
    return SCHEDULES[torch.ops.torch_mpm.latest_schedule(state.x)]
