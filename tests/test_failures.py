"""Failures reported per scene (kind, time, number of particles, first particle) without effect on other scenes."""

import copy
import gc
import pickle
import weakref

import pytest
import torch
from helpers import random_particles
from oracle import advance, transfer

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block

NONE = [0, 0, -1, 0, -1, 0, -1, 0]


def expected_rows(p, x, previous, activation):
    """The rows of the scenes after one more activation, counted from positions and scenes in plain Python."""
    rows = [list(row) for row in previous]
    for i, (position, scene) in enumerate(zip(x.tolist(), p.scene.tolist(), strict=True)):
        lost = any(a != a or abs(a) == float("inf") for a in position)
        outside = min(position) < -5
        if not (lost or outside) or not 0 <= scene < len(rows):
            continue
        row = rows[scene]
        if row[6] in (-1, activation):
            row[6] = activation
            entry = 3 if lost else 1
            if row[entry] == 0:
                row[entry + 1], row[7 if lost else 0] = i, i
            row[entry] += 1
    return rows


def test_each_scene_keeps_its_own_first_problem(device, dim, kernel):
    """Random particles leave or become NaN at random times, in three scenes of ragged size, one of them empty."""
    p = random_particles(dim, kernel, (60, 0, 45, 30), device=device)
    rows, status, x = [list(NONE) for _ in range(4)], None, p.x.clone()
    generator = torch.Generator().manual_seed(1)
    for activation in range(6):
        status = p.grid.activate(x, p.scene, status).status
        rows = expected_rows(p, x, rows, activation)
        assert status[1:].tolist() == rows
        for value in (torch.nan, -9.0, torch.inf):
            bad = torch.randint(len(x), (activation,), generator=generator)
            x[bad[p.scene.cpu()[bad] != activation % 4], 0] = value
    assert len({row[6] for row in rows}) > 2  # the scenes failed at different times
    first = min(row[6] for row in rows if row[6] >= 0)
    for entry in (1, 3):  # row 0 is that of the first activation with a problem in any scene
        assert int(status[0, entry]) == sum(row[entry] for row in rows if row[6] == first)


def test_a_nan_scene_does_not_hide_behind_one_that_left(device):
    step, state = batch(3, device)
    state = step(state, 1e-3)
    x = state.x.clone()
    x[first_of(state, 2) + 4] = 9.0
    state = step(state.replace(x=x), 1e-3)
    x = state.x.clone()
    x[first_of(state, 0) + 1 : first_of(state, 0) + 3] = torch.nan
    step(state.replace(x=x), 1e-3)
    with pytest.raises(mpm.SimulationError) as caught:
        step.check()
    message = str(caught.value)
    assert "2 particles had x that is NaN or infinite in the state given before step 2: 2 in scene 0 (low" in message
    assert "1 particles left the grid" in message
    assert f"1 in scene 2 (first at step 1, lowest index {first_of(state, 2) + 4})" in message
    failures = caught.value.failures
    assert failures.failed.tolist() == [True, False, True]
    assert failures.problems["not_finite"].count.tolist() == [2, 0, 0]
    assert failures.problems["outside"].step.tolist()[2] == 1


def test_the_particle_is_named_by_its_id(device):
    """Also when the state was sorted before, and is again since."""
    step, state = batch(2, device)
    lost = first_of(state, 1) + 7
    state = state.select(torch.randperm(len(state), generator=torch.Generator().manual_seed(2)).to(device))
    state = state.replace(ids=torch.arange(len(state), device=device)).sorted(step.grid)
    row = int((state.ids == lost).nonzero()[0, 0])
    x = state.x.clone()
    x[row] = torch.nan
    after = step(state.replace(x=x), 1e-3).sorted(step.grid)
    scene = int(state.scene[row])
    assert row != lost and step.failures(after).problems["not_finite"].id.tolist()[scene] == lost
    with pytest.raises(mpm.SimulationError, match=rf"1 in scene {scene} \(.*lowest index {row}, id {lost}\)"):
        step.check()


def test_one_report_for_all_kinds(device):
    """Scene 0 left the grid, 1 is inverted, 2 has no mass, 3 a negative dt; scene 4 is well."""
    step, state = batch(5, device)
    x, mass, F = state.x.clone(), state.mass.clone(), step.prepare(state).F.clone()
    x[2] = 9.0
    F[first_of(state, 1) + 3, 0, 0] = -1.0
    mass[first_of(state, 2) : first_of(state, 2) + 4] = torch.tensor([0.0, -1.0, torch.nan, torch.inf]).to(mass)
    dt = torch.tensor([1e-3, 1e-3, 1e-3, -1e-3, 1e-3], dtype=torch.float64, device=device)
    state = state.replace(x=x, F=F, mass=mass)
    step(state, dt)
    failures = step.failures(state)
    assert failures.failed.tolist() == [True, True, True, True, False]
    with pytest.raises(mpm.SimulationError) as caught:
        step.check(state)
    message = str(caught.value)
    for words in (
        "1 particles left the grid",
        f"1 particles are inverted or not finite: 1 in scene 1 (lowest index {first_of(state, 1) + 3})",
        "4 particles have a mass that is not positive and finite",
        f"in scene 2 (lowest index {first_of(state, 2)})",
        "1 steps had a dt that was negative or NaN",
        "1 in scene 3: give each scene a dt",
    ):
        assert words in message, words
    assert len(message.splitlines()) == 4


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
@pytest.mark.parametrize("n", [1, 3])
def test_positions_after_the_latest_step_are_checked(n, integrator, device):
    """They left the grid, or became NaN, in that step: no step has read them yet."""
    step, state = batch(3, device)
    step.integrator = integrator
    state = state.replace(v=torch.zeros_like(state.v))
    state = mpm.rollout(step, state, n - 1, 1e-3) if n > 1 else state
    v = state.v.clone()
    row = first_of(state, 1) + 2
    v[state.scene == 1] = 1e6
    after = step(state.replace(v=v), 1e-3)
    step.check()
    x = after.x.clone()
    x[row] = torch.nan
    failures = step.failures(after.replace(x=x))
    assert failures.failed.tolist() == [False, True, False]
    outside, lost = failures.problems["outside"], failures.problems["not_finite"]
    count = int((state.scene == 1).sum())
    assert outside.count.tolist() == [0, count - 1, 0] and outside.first.tolist()[1] == first_of(state, 1)
    assert lost.count.tolist() == [0, 1, 0] and lost.first.tolist()[1] == row and lost.step.tolist()[1] == n
    with pytest.raises(mpm.SimulationError, match=f"{count} particles left the grid.*first at step {n}"):
        step.check(after)
    step.check(state)
    step.check()


CALLS = {
    "step": lambda step, state: step(state, 1e-3),
    "rollout": lambda step, state: mpm.rollout(step, state, 3, 1e-3),
    "hook": lambda step, state: mpm.rollout(step, state, 4, 1e-3, hook=lambda state, k: state, every=2),
    "checkpoint": lambda step, state: mpm.rollout(step, state, 4, 1e-3, checkpoint=2),
    "rollout_to": lambda step, state: mpm.rollout_to(step, state, 0.005, longest=1e-3, most=10).state,
}


@pytest.mark.parametrize("way", CALLS)
@pytest.mark.parametrize("name", ["x", "v", "mass", "volume", "C", "F"])
def test_a_state_given_later_explains_a_failure(name, way, device):
    """A state with NaN in one scene, given to a step that was used before: its field is named, and not dt."""
    if way == "rollout_to" and name != "v":
        pytest.skip("a limit of dt that is NaN ends the steps")
    step, state = batch(3, device)
    before = mpm.rollout(step, state, 2, 1e-3)
    step.check(before)
    value = getattr(before, name).clone()
    value[state.scene == 1] = torch.nan
    after = CALLS[way](step, before.replace(**{name: value}))
    with pytest.raises(mpm.SimulationError) as caught:
        step.check(after)
    message = str(caught.value)
    index = first_of(state, 1)
    assert f"36 particles had {name} that is NaN or infinite in the state given before step 2: 36 in scene 1" in message
    assert f"lowest index {index}" in message and "dt with" not in message
    assert not step.failures(after).failed[[0, 2]].any()


@pytest.mark.parametrize("order", ["same", "sorted"])
def test_a_later_state_does_not_explain_an_earlier_failure(order, device):
    """A step that fails by itself, and is given its results, in their order or another."""
    step, state = batch(1, device)
    state = mpm.rollout(step, state, 2, 1e-3)
    state = step(state.replace(v=state.v + 1e-3), torch.tensor([1e38], device=device))
    for _ in range(3):
        state = step(step.sorted(state) if order == "sorted" else state, 1e-3)
    with pytest.raises(mpm.SimulationError) as caught:
        step.check(state)
    assert "in the state given" not in str(caught.value)


def test_a_given_state_is_not_kept_in_copies(device):
    step, state = batch(2, device)
    given = state.replace(v=2 * state.v)
    step(state, 1e-3)
    step(given, 1e-3)
    copies = [copy.deepcopy(step), pickle.loads(pickle.dumps(step))]
    gone = weakref.ref(given.v)
    step(step(state, 1e-3), 1e-3)
    del given
    gc.collect()
    assert gone() is None and all(c._error_status._call.given is None for c in copies)


@pytest.mark.parametrize("part", ["gravity", "velocity", "angular_velocity", "path"])
def test_inputs_with_nan_explain_a_failure(part, device):
    """Values written in place, or computed by a path, are not checked where they are assigned."""
    step, state = batch(2, device)
    rates = torch.zeros(2, 2, device=device), torch.zeros(2, device=device)
    motion = {"position": (0.45, 0.45), "velocity": rates[0], "angular_velocity": rates[1]}
    if part == "path":
        motion = {"position": lambda t: torch.stack([0.45 + 0 * t, 0.45 + torch.where(t < 1.5e-3, 0, torch.nan)], -1)}
    step.boundaries = [mpm.Plane((0.0, 0.0), (0.0, 1.0)), mpm.Sphere(radius=0.1, kind="sticky", **motion)]
    step.gravity = torch.zeros(2, 2, device=device)
    state = step(state, 1e-3)
    words = f"the {part} of boundary 1 (Sphere)"
    scenes = [1]
    if part == "gravity":
        step.gravity[1, 0], words = torch.nan, "the gravity"
    elif part == "path":
        words, scenes = words + " at the time of the state", [0, 1]
    else:
        rates[part == "angular_velocity"][1] = torch.nan
    if part == "path" and device == "cpu":
        with pytest.raises(ValueError, match="position must return finite numbers at a time"):
            mpm.rollout(step, state, 4, 1e-3)
        return
    state = mpm.rollout(step, state, 4, 1e-3)
    assert step.failures(state).failed.nonzero().flatten().tolist() == scenes
    with pytest.raises(mpm.SimulationError) as caught:
        step.check(state)
    message = str(caught.value)
    assert f"components of {words} are NaN or infinite: " in message and "in scene 1: give finite" in message
    assert "dt with" not in message and ("in scene 0" in message) == (0 in scenes)


def test_a_state_is_checked_before_the_first_step(device):
    step, state = batch(2, device)
    x = state.x.clone()
    x[first_of(state, 1) + 1] = torch.nan
    with pytest.raises(mpm.SimulationError, match=r"1 particles had x that is NaN or inf.*1 in scene 1") as caught:
        step.check(state.replace(x=x))
    assert "dt with" not in str(caught.value)


def test_many_scenes_are_counted(device):
    step, state = batch(20, device)
    step(state.replace(x=torch.full_like(state.x, torch.nan)), 1e-3)
    with pytest.raises(mpm.SimulationError, match=r"in scene 11 \(.*; and more in 8 other scenes") as caught:
        step.check()
    assert "in scene 12" not in str(caught.value) and len(str(caught.value)) < 1200


def test_particles_without_a_scene_count_in_the_totals(device):
    step, state = batch(2, device)
    scene = state.scene.clone()
    scene[[3, 8]], scene[5] = -2, 2
    step(state.replace(scene=scene), 1e-3)
    assert not step.failures().failed.any()
    with pytest.raises(mpm.SimulationError, match="3 particles have a scene id outside the 2 scenes of the grid"):
        step.check()


def test_no_scenes_and_no_particles(device, dim):
    x = torch.empty((0, dim), device=device)
    arguments = (None, None, 0, 4, [0.1, *[0.0] * dim], [2, 0, *[3] * dim])
    for scene in (None, torch.zeros(0, dtype=torch.int32, device=device)):
        table, block, offsets, index, _, status = torch.ops.torch_mpm.activate(x, scene, *arguments)
        assert table.numel() == 0 and block.tolist() == [-1] * 4 and offsets.tolist() == [0] * 5
        assert index.numel() == 0 and status.tolist() == [[0, 0, -1, 0, -1, 1, -1, 0]]
    step, state = batch(3, device)
    empty = state.select(torch.zeros(0, dtype=torch.int64, device=device))
    after = step(empty, torch.full((3,), 1e-3, dtype=torch.float64, device=device))
    step.check(after)
    assert len(after) == 0 and step.status[1:].tolist() == [NONE] * 3


def test_failures_before_the_first_step_and_after_a_reset(device):
    step, state = batch(2, device)
    assert step.failures().failed.tolist() == [False, False]
    x = state.x.clone()
    x[0] = torch.nan
    step(state.replace(x=x), torch.tensor([1e-3, torch.nan], dtype=torch.float64, device=device))
    assert step.failures().failed.tolist() == [True, True]
    step.reset()
    assert step.failures().failed.tolist() == [False, False]
    step.check(state)


def test_a_loss_leaves_failed_scenes_out(device):
    """The gradient of a batch whose lost scene is masked is that of the other scenes alone."""
    law = mpm.NeoHookean(E=torch.tensor(1e4, dtype=torch.float64, device=device, requires_grad=True), nu=0.3)

    def gradient(poisoned):
        step, state = batch(2, device, law=law)
        x = state.x.clone()
        if poisoned:
            x[first_of(state, 1) + 5] = torch.nan
        F = 1.1 * torch.eye(state.x.shape[1], dtype=x.dtype, device=device).expand(len(state), -1, -1)
        state = mpm.rollout(step, state.replace(x=x, F=F), 4, 1e-3)
        failed = step.failures().failed
        kept = ~failed[state.scene.long()] & (state.scene == 0)
        return torch.autograd.grad(torch.where(kept[:, None], state.v, 0).square().sum(), law.E)[0], failed.tolist()

    (alone, none), (masked, failed) = gradient(False), gradient(True)
    assert none == [False, False] and failed == [False, True]
    torch.testing.assert_close(masked, alone, rtol=0 if device == "cpu" else 1e-10, atol=0)


def test_lost_particles_have_no_velocity(device, dim, kernel):
    """NaN where the position is not finite, so that energy and momentum of the scene show it; others as they were."""
    p = random_particles(dim, kernel, (50, 40), device=device)
    x = p.x.clone()
    x[3], x[10, 0], x[20, -1] = torch.nan, torch.inf, -7.0
    lost, outside = torch.tensor([3, 10], device=device), torch.tensor([20], device=device)
    blocks = p.grid.activate(x, p.scene)
    nodes = torch.randn(blocks.node_count, dim, dtype=x.dtype).to(device)
    v, C, gradient = mpm.g2p(blocks, x, nodes, gradient=True)
    advanced = mpm.g2p_advance(blocks, x, nodes, 0.1, p.stress, p.volume)
    for field in (v, C, gradient, *advanced[1:3]):
        assert field[lost].isnan().all() and not field[outside].any()
        assert field.flatten(1).isfinite().all(1).sum() == len(x) - 2
    for field, before in zip((advanced[0], *advanced[3:]), (x, p.stress, p.volume), strict=True):
        torch.testing.assert_close(field[lost], before[lost], rtol=0, atol=0, equal_nan=True)
    expected = (*transfer.g2p(blocks, x, nodes),)
    for mine, other in zip((v, C, gradient), expected, strict=True):
        torch.testing.assert_close(mine, other, equal_nan=True)
    for mine, other in zip(advanced, advance.g2p_advance(blocks, x, nodes, 0.1, p.stress, p.volume), strict=True):
        torch.testing.assert_close(mine, other, equal_nan=True)


@pytest.mark.parametrize("form", ["mls", "gradient"])
def test_lost_particles_spoil_no_gradient(device, dim, form):
    """Gradients of nodes, dt, F and J, and second ones, are those without the lost particles."""
    p = random_particles(dim, "quadratic", (30, 25), device=device)
    x = p.x.clone()
    x[[2, 7]] = torch.nan
    good = x.isfinite().all(1)

    def gradients(x, scene, F, J):
        blocks = p.grid.activate(x, scene)
        nodes = blocks.node_positions(x.dtype).sin().requires_grad_()
        dt = torch.tensor([0.1, 0.2], dtype=x.dtype, device=device, requires_grad=True)
        F, J = F.clone().requires_grad_(), J.clone().requires_grad_()
        out = mpm.g2p_advance(blocks, x, nodes, dt, F, J, stress_form=form)
        keep = x.isfinite().all(1)
        loss = sum((t[keep] * torch.linspace(1, 2, t[0].numel()).to(t).reshape(t[0].shape)).sum() for t in out)
        loss = loss + out[3].sum() + out[4].sum()
        first = torch.autograd.grad(loss, (nodes, dt, F, J), create_graph=True)
        second = torch.autograd.grad(first[0].square().sum() + first[1].square().sum(), (nodes, dt))
        return blocks.to_dense(first[0]), blocks.to_dense(second[0]), first[1], second[1], *first[2:]

    mine = gradients(x, p.scene, p.stress, p.volume)
    alone = gradients(x[good], p.scene[good], p.stress[good], p.volume[good])
    for a, b in zip((*mine[:4], mine[4][good], mine[5][good]), alone, strict=True):
        torch.testing.assert_close(a, b)
    assert mine[4][~good].eq(1).all() and mine[5][~good].eq(1).all()


@pytest.mark.parametrize("transfer", ["apic", "pic", "flip"])
def test_energy_of_a_lost_scene_is_not_finite(device, transfer):
    """From the step on, and for good; the other scene is as it is alone."""
    step, state = batch(2, device, transfer=transfer)
    x = state.x.clone()
    x[first_of(state, 1)] = torch.nan
    state = mpm.rollout(step, state.replace(x=x), 3, 1e-3)
    energy = state.v.square().sum(1) * state.mass
    assert energy[state.scene == 1].sum().isnan() and energy[state.scene == 0].isfinite().all()
    alone, single = batch(1, device, transfer=transfer)
    expected = mpm.rollout(alone, single, 3, 1e-3)
    torch.testing.assert_close(state.v[state.scene == 0], expected.v, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("value", [0.0, -1.0, torch.nan, torch.inf])
@pytest.mark.parametrize("field", ["mass", "volume"])
def test_masses_and_volumes_are_checked(device, field, value):
    step, state = batch(3, device)
    values = getattr(state, field).clone()
    bad = first_of(state, 1) + torch.tensor([2, 5], device=device)
    values[bad] = value
    with pytest.raises(mpm.SimulationError, match=rf"2 particles have a (rest )?{field} .*: 2 in scene 1 \(lowest i"):
        step.check(state.replace(**{field: values}))
    step.check(state)


@pytest.mark.parametrize("density", [0.0, -1.0, float("nan"), float("inf")])
def test_density_is_checked(density):
    points = mpm.seed.box((0, 0), (1, 1), 0.1)
    with pytest.raises(ValueError, match="density must be positive and finite, got"):
        mpm.State.at_rest(points, density)
    tensor = torch.full((len(points.x),), 1000.0)
    tensor[7] = density
    with pytest.raises(ValueError, match="density must be positive and finite, got"):
        mpm.State.at_rest(points, tensor)


def test_errors_can_be_sent_between_processes():
    error = mpm.SimulationError("words")
    assert str(pickle.loads(pickle.dumps(error))) == "words" and error.failures is None


@pytest.mark.cuda
def test_failures_need_no_synchronisation_and_see_replays():
    """Scenes that fail in different replays of a CUDA graph, and a dt that becomes negative, are all named."""
    step, state = batch(3, "cuda")
    dt = torch.full((3,), 1e-3, dtype=torch.float64, device="cuda")
    with torch.no_grad():
        static = step(step(state, dt), dt).map(torch.clone)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            step(static, dt)
        graph.replay()
        good = copy.deepcopy(static.x)
        static.x[first_of(state, 2)] = 9.0
        graph.replay()
        static.x.copy_(good)
        static.x[first_of(state, 0) + 2] = torch.nan
        dt[1] = -1.0
        graph.replay()
        torch.cuda.set_sync_debug_mode("error")
        try:
            failures = step.failures(static)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert step.grid._on_host.shape == (8,)  # what the grid copies to the host is as small for any batch
    assert failures.problems["outside"].step.tolist() == [4, -1, 3]
    assert failures.problems["outside"].count.tolist() == [0, 0, 1]
    assert failures.problems["not_finite"].count.tolist() == [1, 0, 0]
    assert failures.problems["dt"].count.tolist() == [0, 1, 0]
    with pytest.raises(mpm.SimulationError, match="in scene 2"):
        step.check()


def batch(scenes, device, law=None, **options):
    """Scenes of elastic blocks of 36 particles that move, in one batch; scene 0 is the same in every batch."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1), scenes=scenes, max_blocks=None)
    step = mpm.Step(grid, law or mpm.NeoHookean(E=1e4, nu=0.3), gravity=(0, -9.8), walls="slip", **options)
    one = block((0.3, 0.3), (0.6, 0.6), 0.1, velocity=(0.5, 0.1), device=device)
    return step, mpm.State.concatenate([one] * scenes, scene=True)


def first_of(state, scene):
    """Index of the first particle of a scene in `batch`."""
    return 36 * scene


FIELDS = ("x", "v", "C", "F")


WAYS = {"rollout": lambda step, state: mpm.rollout(step, state, 3, 1e-4), "step": lambda step, state: step(state, 1e-4)}


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("way", WAYS)
def test_what_is_nan_in_the_first_state_is_named(field, way, device):
    """Not the time step; also where another state was given before."""
    step, state = batch(3, device, mpm.VonMises(E=1e4, nu=0.3, yield_stress=100.0))
    state = step.prepare(state)
    state = state.replace(C=torch.zeros_like(state.F), ids=torch.arange(len(state), device=device) + 1000)
    bad = first_of(state, 1) + 7
    value = getattr(state, field).clone()
    value[bad] = torch.nan
    state = state.replace(**{field: value})
    with torch.no_grad():
        end = WAYS[way](step, state)
    with pytest.raises(mpm.SimulationError) as error:
        step.check(end)
    where = f"1 in scene 1 (lowest index {bad}, id {bad + 1000})"
    assert f"had {field} that is NaN or infinite in the state before the first step: {where}" in str(error.value)
    assert "time step" not in str(error.value)
    step.reset()
    with torch.no_grad():
        step(batch(3, device)[1], 1e-4)
        later = step(state, 1e-4)
    with pytest.raises(mpm.SimulationError) as error:
        step.check(later)
    assert f"had {field} that is NaN or infinite in the state given before step 1: {where}" in str(error.value)
    assert "time step" not in str(error.value)


def test_what_nothing_reads_may_be_nan(device):
    step, state = batch(2, device)
    state.extra["label"] = torch.full_like(state.mass, torch.nan)
    with torch.no_grad():
        step.check(step(state, 1e-4))


def test_a_state_before_any_step_is_not_the_fault_of_the_time_step(device):
    step, state = batch(2, device)
    state.v[3] = torch.nan
    with pytest.raises(
        mpm.SimulationError, match=r"a velocity that is NaN or infinite: .*: give each particle a finite velocity"
    ):
        step.check(state)
