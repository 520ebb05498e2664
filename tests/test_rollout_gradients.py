"""Gradients of rollouts in one op against those of single steps, which other tests hold against oracles."""

from collections.abc import Callable

import pytest
import torch
from cases.rollout_gradients import (
    DT,
    F64,
    STEPS,
    assert_same,
    gradients,
    in_op,
    loss,
    moving,
    single,
    with_gradients,
)
from cases.rollouts import (
    LAWS_HERE,
    SEEDS,
    SOME_TRANSFERS,
    TRANSFERS,
    WALLS,
    assert_equal,
    each_scene,
    flying,
    mixture,
    one_by_one,
)
from combinations import DT as CASE_DT
from combinations import draw, make
from helpers import TOLERANCE
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, touched, unit_box
from torch_mpm.grid.topology import Status
from torch_mpm.ops.contact import obstacle_arguments
from torch_mpm.ops.grid_update import wall_arguments
from torch_mpm.rollouts import budget, fused_op

ALL = mpm.Checkpoints(memory=1e9)
"""Checkpoints without recomputed steps."""


def pulled(dim: int, dtype: torch.dtype = F64) -> Tensor:
    return torch.tensor((1.0, -9.8, 0.5)[:dim], dtype=dtype, requires_grad=True)


@pytest.mark.parametrize("seed", SEEDS)
def test_random_simulations(seed, device):
    """Simulations that are not computed in one op are included, with the reason."""
    case = make(draw(seed), device)
    case.step.heat = None
    state = case.step.prepare(case.state)
    got = gradients(lambda step, state: mpm.rollout(step, state, 3, CASE_DT, 2), case.step, state)
    reason = case.step.explain(state, CASE_DT)
    expected = gradients(single(3, CASE_DT), case.step, state)
    assert_same(got, expected, "rollout" if isinstance(case.step.law, mpm.Mixture) else "", reason)


@pytest.mark.parametrize(*in_pairs(law=LAWS_HERE, transfer=SOME_TRANSFERS, dim=[2, 3]))
@pytest.mark.parametrize("every", [1, 2, 7, ALL], ids=str)
def test_laws(law, every, transfer, dim, device):
    options = {"walls": "separate", **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(dim), with_gradients(LAWS_HERE[law]()), pulled(dim), **options).to(device)
    state = moving(step, blob(device, dim))
    tolerance = "rollout with FLIP" if "flip" in transfer else ""
    assert_same(gradients(in_op(every), step, state), gradients(single(), step, state), tolerance)


@pytest.mark.parametrize(
    *in_pairs(
        transfer=TRANSFERS,
        form=["mls", "gradient"],
        law=["fluid", "neo_hookean"],
        dtype=[torch.float32, F64],
        kernel=["quadratic", "cubic"],
    )
)
def test_transfers(transfer, form, law, dtype, kernel, device):
    """Viscous laws read C without APIC too. With FLIP what the mass gives is a small difference of two transfers."""
    options = {"stress_form": form, "walls": "slip", **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(kernel=kernel), with_gradients(LAWS_HERE[law](), dtype), pulled(3, dtype), **options).to(
        device
    )
    state = moving(step, blob(device, dtype=dtype))
    tolerance = "rollout" if "flip" in transfer and dtype == torch.float32 else ""
    assert_same(gradients(in_op(2), step, state), gradients(single(), step, state), tolerance)


@pytest.mark.parametrize(*in_pairs(transfer=TRANSFERS, walls=WALLS, n=[1, 40], dim=[2, 3], damping=[1.0, 0.8]))
def test_walls(transfer, walls, n, dim, damping, device):
    options = {"walls": touched(walls, dim), **TRANSFERS[transfer]}
    if damping < 1:
        ball = mpm.Sphere((0.5,) * dim, 0.2, velocity=(1.0,) + (0.0,) * (dim - 1), friction=0.3)
        options["boundaries"] = [mpm.boundaries.Damping(damping), ball]
    step = mpm.Step(unit_box(dim), with_gradients(mpm.NeoHookean(E=1e4, nu=0.3)), pulled(dim), **options).to(device)
    state = moving(step, blob(device, dim))
    assert_same(gradients(in_op(ALL, n), step, state), gradients(single(n), step, state))


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_mixtures(deterministic, transfer, dim, device):
    grid, options = unit_box(dim, deterministic=deterministic), {"walls": "sticky", **TRANSFERS[transfer]}
    step = mpm.Step(grid, with_gradients(mixture()), **options).to(device)
    material = torch.randint(0, 7, (400,), dtype=torch.int32, device=device)
    state = moving(step, blob(device, dim, 400)).replace(material=material, ids=torch.randperm(400).to(device))
    for start in (state, state.sorted(step.grid)):
        expected = gradients(single(), step, start)
        tolerance = "rollout with FLIP" if "flip" in transfer else "rollout"
        tolerance = "mixture on CUDA" if device == "cuda" else tolerance
        assert_same(gradients(in_op(2), step, start), expected, tolerance)
        assert_same(gradients(in_op(ALL), step, start), expected, tolerance)


def batch(dim: int, device: str, transfer: str = "apic") -> tuple[mpm.Step, mpm.State]:
    """Scenes with obstacles, gravity and a modulus of their own, and a modulus of each particle."""
    scenes = 3
    state = blob(device, dim, scene=torch.arange(300, dtype=torch.int32) % scenes)
    state = state.replace(scene=state.scene.int(), ids=torch.randperm(300).to(device))
    mu = torch.linspace(1e3, 1e4, scenes, dtype=F64, device=device).requires_grad_()
    lam = torch.linspace(1e3, 2e3, 300, dtype=F64, device=device).requires_grad_()
    obstacles = [
        mpm.Sphere((0.5,) * dim, 0.15, velocity=(1.0,) + (0.0,) * (dim - 1), kind="slip", friction=0.3),
        mpm.Box((0.3,) * dim, (0.1,) * dim, kind="sticky", start=2e-4),
        mpm.Plane((0.0, 0.35, 0.0)[:dim], (0.0, 1.0, 0.0)[:dim], kind="separate", end=3e-4),
    ]
    gravity = torch.randn(scenes, dim, dtype=F64).to(device).requires_grad_()
    grid = unit_box(dim, scenes=scenes)
    options = {"boundaries": obstacles, "walls": "mirror", **TRANSFERS[transfer]}
    step = mpm.Step(grid, mpm.NeoHookean(mu=mu, lam=lam), gravity, **options)
    return step, moving(step, state)


@pytest.mark.parametrize("every", [None, 2, ALL], ids=str)
@pytest.mark.parametrize(*in_pairs(transfer=TRANSFERS, dim=[2, 3]))
def test_batches_with_obstacles_and_parameters_of_scenes_and_particles(every, transfer, dim, device):
    step, state = batch(dim, device, transfer)
    expected = gradients(single(), step, state)
    assert {"law.mu", "law.lam", "gravity"} <= expected.keys()
    assert_same(gradients(in_op(every), step, state), expected)


@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_the_state_is_that_without_gradients(transfer, device):
    step, state = batch(2, device, transfer)
    start = state.replace(v=state.v.clone().requires_grad_())
    with torch.no_grad():
        expected = mpm.rollout(step, state, STEPS, DT)
    for every in (2, ALL):
        step.reset()
        assert_equal(mpm.rollout(step, start, STEPS, DT, checkpoint=every), expected)


@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_a_record_of_all_steps_may_be_gone_through_twice(transfer, device):
    step, state = batch(3, device, transfer)
    v = state.v.clone().requires_grad_()
    end = mpm.rollout(step, state.replace(v=v), STEPS, DT, checkpoint=ALL)
    assert end.x.grad_fn.saved_tensors[0].numel() > 1000  # no step is recomputed
    first, second = (torch.autograd.grad(loss(end), v, retain_graph=True)[0] for _ in range(2))
    assert_same({"v": second}, {"v": first})
    again = mpm.rollout(step, state.replace(v=v), STEPS, DT, checkpoint=2)
    assert again.x.grad_fn.saved_tensors[0] is None
    assert_same({"v": first}, {"v": torch.autograd.grad(loss(again), v)[0]})


@pytest.mark.parametrize("law", ["neo_hookean", "viscoelastic", "sand"])
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_grids_are_kept_where_particles_are_dense(law, transfer, device):
    """With obstacles; gradients equal those of recomputed steps."""
    one, _ = batch(2, device)
    options = {"walls": "slip", "boundaries": one.boundaries.entries, **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(2), with_gradients(LAWS_HERE[law]()), pulled(2), **options)
    step, state = step.to(device), moving(step, blob(device, 2, 4000))
    start = state.replace(v=state.v.clone().requires_grad_())
    end = mpm.rollout(step, start, STEPS, DT, checkpoint=ALL)
    record = end.x.grad_fn.saved_tensors[0]
    plastic, history = law == "sand", sum(t[0].numel() for t in state.extra.values())
    of_particles = STEPS * 4000 * (4 + 12 + 4 * plastic + history) * 8
    assert of_particles * 1.1 < record.numel() < of_particles * 1.7
    expected = gradients(single(), step, state)
    assert_same(gradients(in_op(ALL), step, state), expected)
    assert_same(gradients(in_op(2), step, state), expected)


def test_a_step_that_was_taken_in_inference_mode_is_trained(device):
    step, state = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3)), blob(device, 2)
    with torch.inference_mode():
        mpm.rollout(step, state, 3, DT)
    v = state.v.clone().requires_grad_()
    end = mpm.rollout(step, state.replace(v=v), 3, DT, checkpoint=ALL)
    assert float(torch.autograd.grad(end.x.sum(), v)[0].norm()) > 0


def test_recorded_steps_in_checkpoints_of_torch(device):
    def ends(around: bool) -> Tensor:
        step, v = mpm.Step(unit_box(2, max_blocks=36), mpm.NeoHookean(E=1e4, nu=0.3)), state.v.clone().requires_grad_()

        def taken(v: Tensor) -> Tensor:
            return mpm.rollout(step, state.replace(v=v), 3, DT, checkpoint=ALL).x

        options = {"use_reentrant": False, "context_fn": mpm.rollouts.checkpoints.contexts}
        x = torch.utils.checkpoint.checkpoint(taken, v, **options) if around else taken(v)
        return torch.autograd.grad(x.square().sum(), v)[0]

    state = blob(device, 2)
    assert_same({"v": ends(True)}, {"v": ends(False)})


def test_the_status_goes_on_from_call_to_call_of_recorded_steps(device):
    step, state = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3)), blob(device, 2)
    start = state.replace(v=state.v.clone().requires_grad_())
    middle = mpm.rollout(step, start, 3, DT, checkpoint=ALL)
    x = middle.x.clone()
    x[4] = 7.0
    mpm.rollout(step, middle.replace(x=x), 3, DT, checkpoint=ALL)
    assert int(step.status[0, Status.ACTIVATIONS]) == 6
    with pytest.raises(mpm.SimulationError, match="step 3"):
        step.check()


@pytest.mark.parametrize("every,calls", [(1, 6), (4, 2), (6, 1), (100, 1), (None, 1)])
def test_a_state_is_kept_every_so_many_steps(every, calls, device, monkeypatch):
    taken = []

    def counted(*arguments):
        taken.append(arguments[2])
        return substeps(*arguments)

    substeps = fused_op.substeps
    monkeypatch.setattr(fused_op, "substeps", counted)
    step, state = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3)), blob(device, 2)
    mpm.rollout(step, state.replace(v=state.v.clone().requires_grad_()), 6, DT, checkpoint=every)
    assert len(taken) == calls
    assert sum(taken) == 6


def test_large_states_are_kept_every_sqrt_n_steps(device, monkeypatch):
    monkeypatch.setattr(budget, "KEPT_BYTES", {"cpu": 1, "cuda": 1})
    test_a_state_is_kept_every_so_many_steps(None, 3, device, monkeypatch)


def lost(state: mpm.State) -> mpm.State:
    """With particles outside the grid, without a position, turned inside out, and without a volume."""
    x, F = state.x.clone(), state.F.clone()
    x[5], x[7, 0] = 3.0, float("nan")
    F[11, 0], F[13] = -F[11, 0], 0.0
    return state.replace(x=x, F=F)


@pytest.mark.parametrize("law", ["neo_hookean", "von_mises", "sand", "viscoelastic"])
@pytest.mark.parametrize("form", ["mls", "gradient"])
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_lost_particles(law, form, transfer, device):
    options = {"walls": "slip", "stress_form": form, **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(), with_gradients(LAWS_HERE[law]()), **options).to(device)
    state = lost(moving(step, blob(device)))
    expected = gradients(single(), step, state)
    assert all(bool(g.isfinite().all()) for g in expected.values() if g is not None)
    assert_same(gradients(in_op(2), step, state), expected)
    assert_same(gradients(in_op(ALL), step, state), expected)


def test_a_pool_that_grows():
    state, dt = flying("cpu")
    law = {"E": torch.tensor(1.0, dtype=F64, requires_grad=True), "nu": 0.3}
    step = mpm.Step(unit_box(dx=1 / 64), mpm.NeoHookean(**law))
    expected = gradients(single(8, dt), mpm.Step(unit_box(dx=1 / 64), mpm.NeoHookean(**law)), state)
    assert_same(gradients(in_op(3, 8, dt), step, state), expected)
    step = mpm.Step(unit_box(dx=1 / 64), mpm.NeoHookean(**law))
    assert_same(gradients(in_op(ALL, 8, dt), step, state), expected)


def test_no_scenes(device):
    gravity = torch.zeros(0, 2, dtype=F64, device=device, requires_grad=True)
    step = mpm.Step(mpm.Grid(1 / 16, (0.0, 0.0), (1.0, 1.0), scenes=0), mpm.NeoHookean(E=1e4, nu=0.3), gravity)
    state = blob(device, 2, 0)
    state = state.replace(scene=torch.zeros(0, dtype=torch.int32, device=device))
    end = mpm.rollout(step, state, 3, DT)
    (found,) = torch.autograd.grad(end.x.sum() + end.v.sum(), [gravity], allow_unused=True)
    assert found is None or found.shape == (0, 2)


@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_no_particles(transfer, device):
    law = with_gradients(mpm.VonMises(E=1e4, nu=0.3, yield_stress=1.0))
    step = mpm.Step(unit_box(), law, pulled(3), **TRANSFERS[transfer]).to(device)
    for gradient in gradients(in_op(), step, step.prepare(blob(device, count=0))).values():
        assert gradient is None or float(gradient.norm()) == 0


# ---- against differences


def few(device: str) -> tuple[mpm.State, Tensor]:
    """Particles in contact with each other, and their deformation."""
    state = blob(device, 2, 6)
    F = torch.eye(2, dtype=F64, device=device) + 0.05 * torch.randn(6, 2, 2, dtype=F64).to(device)
    return state.replace(x=0.45 + 0.2 * (state.x - 0.3)), F


@pytest.mark.parametrize("law", ["neo_hookean", "von_mises", "viscoelastic"])
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_gradcheck(law, transfer, device):
    state, F = few(device)
    make = {"neo_hookean": mpm.NeoHookean, "von_mises": mpm.VonMises, "viscoelastic": mpm.Viscoelastic}[law]
    others = {
        "von_mises": {"yield_stress": 30.0, "hardening": 100.0},
        "viscoelastic": {"branch_modulus": 3e3, "relaxation_time": 0.01},
    }.get(law, {})

    def run(x: Tensor, v: Tensor, F: Tensor, mass: Tensor, E: Tensor, gravity: Tensor) -> Tensor:
        step = mpm.Step(unit_box(2, 0.125), make(E=E, nu=0.3, **others), gravity, walls="slip", **TRANSFERS[transfer])
        return loss(mpm.rollout(step, state.replace(x=x, v=v, F=F, mass=mass), 3, 1e-2, checkpoint=2))

    inputs = (
        state.x,
        state.v,
        F,
        1e-3 + state.mass,
        torch.tensor(10.0, dtype=F64, device=device),
        pulled(2).to(device),
    )
    leaves = [t.detach().clone().requires_grad_() for t in inputs]
    assert torch.autograd.gradcheck(run, leaves, eps=1e-6, atol=1e-5, rtol=1e-5, nondet_tol=1e-8)


def test_a_difference_of_many_steps(device):
    """A drop on a ball, 40 steps: the derivative along a random direction."""
    step = mpm.Step(
        unit_box(2), mpm.FixedCorotated(E=1e3, nu=0.3), (0.0, -9.8), boundaries=[mpm.Sphere((0.5, 0.3), 0.1)]
    )
    state = blob(device, 2)
    direction = torch.randn(state.x.shape, dtype=F64).to(device)

    def height(share: Tensor) -> Tensor:
        return mpm.rollout(step, state.replace(v=state.v + share * direction), 40, 5e-4).x[:, 1].square().sum()

    share = torch.zeros((), dtype=F64, device=device, requires_grad=True)
    (gradient,) = torch.autograd.grad(height(share), share)
    with torch.no_grad():
        difference = (height(share + 1e-6) - height(share - 1e-6)) / 2e-6
    torch.testing.assert_close(gradient, difference, rtol=1e-6, atol=0)


# ---- what goes another way


def test_a_second_derivative_is_refused(device):
    step, state = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3)), blob(device, 2)
    v = state.v.clone().requires_grad_()

    def second(move: Callable[..., mpm.State]) -> Tensor:
        end = move(step, state.replace(v=v), 2, DT)
        (gradient,) = torch.autograd.grad(end.x.pow(3).sum(), v, create_graph=True)
        return torch.autograd.grad(gradient.square().sum(), v)[0]

    with pytest.raises(NotImplementedError, match=r"no second derivatives: .*`state = step\(state, dt\)"):
        second(mpm.rollout)
    assert bool(second(one_by_one).isfinite().all())
    by_function = second(lambda step, *rest: mpm.rollout(lambda state, dt: step(state, dt), *rest))
    torch.testing.assert_close(by_function, second(one_by_one))


@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_gradients_of_scenes_with_time_steps_of_their_own(transfer, device):
    step, state = each_scene(device, transfer=transfer)
    step.gravity = torch.tensor([[0.5, -9.8], [0.0, 1.0], [2.0, 3.0]], dtype=F64, device=device, requires_grad=True)
    dt = CASE_DT * torch.tensor([1.0, 0.0, 0.3], dtype=F64, device=device)
    ends = [
        gradients(lambda step, state: mpm.rollout(step, state, 5, dt, checkpoint=3), step, state),
        gradients(lambda step, state: one_by_one(step, state, 5, dt), step, state),
    ]
    recorded = gradients(lambda step, state: mpm.rollout(step, state, 5, dt, checkpoint=ALL), step, state)
    assert_same(recorded, ends[0])
    assert ends[0].keys() == ends[1].keys() and "gravity" in ends[0]
    for name, grad in ends[0].items():
        expected = ends[1][name]
        assert (grad is None) == (expected is None), name
        if grad is not None:
            scale = expected.abs().max().clamp_min(1e-9)
            assert float((grad - expected).abs().max() / scale) < TOLERANCE["rollout gradient"][F64], name


def raw_arguments(device: str) -> list:
    """Arguments of `substeps`: two laws, walls, an obstacle and gravity in two scenes."""
    state, D = blob(device, 2, 40), 2
    g = torch.Generator().manual_seed(2)
    scene, material = (torch.arange(40) % 2).int().to(device), (torch.arange(40) // 2 % 2).int().to(device)
    F = torch.eye(2, dtype=F64) + 0.05 * torch.randn(40, 2, 2, generator=g, dtype=F64)
    scalar = torch.tensor(2e3, dtype=F64, device=device)
    grid = unit_box(2, scenes=2, max_blocks=64, deterministic=True)
    ball = [mpm.Sphere((0.5, 0.4), 0.1)]
    laws = ("von_mises,neo_hookean", [0, 0], [scalar, scalar, 0.01 * scalar, scalar, scalar, 0.5 * scalar], [1, 0])
    particles = (state.x, state.v, state.mass, state.volume, 0.1 * F.to(device), F.to(device), None, 1e-9 * state.x)
    how = (3, DT, True, [0.9, 1.0], True, 0, torch.randn(2, D, generator=g, dtype=F64).to(device))
    walls = wall_arguments(mpm.Walls("slip"), grid)
    obstacles = obstacle_arguments(ball, state.x, 2)
    impulse = torch.randn(2, 5, 3, generator=g, dtype=F64).to(device)
    rest = (
        *walls,
        *obstacles,
        0.0,
        2,
        64,
        False,
        False,
        False,
        impulse,
        *(None, None),
        *([], [], [], [], [], [], [], []),  # no heat
        *grid.packed,
    )
    return [*particles, [state.mass * 0], scene, None, material, None, *laws, *how, *rest]


def test_the_raw_ops(device):
    call = raw_arguments(device)
    wanted = (0, 1, 2, 3, 4, 5, 23, 41)
    given = [t.clone().requires_grad_() if i in wanted else t for i, t in enumerate(call)]
    torch.library.opcheck(torch.ops.torch_mpm.substeps.default, tuple(given), raise_exception=True)
    recorded = (*given[:40], True, None, *given[42:])
    checks = ("test_schema", "test_faketensor")  # the others compare uninitialised bytes
    torch.library.opcheck(torch.ops.torch_mpm.substeps.default, recorded, test_utils=checks, raise_exception=True)
    grads = [torch.randn_like(t) for t in torch.ops.torch_mpm.substeps(*call)[:6] if t is not None]
    adjoint = ([*grads[:4], None, grads[4], torch.ones_like(call[41]), None], 15, None, *call)
    torch.library.opcheck(torch.ops.torch_mpm.substeps_backward.default, adjoint, raise_exception=True)
    with pytest.raises(RuntimeError, match=r"grads\[0\] must have shape \[40, 2\]"):
        torch.ops.torch_mpm.substeps_backward([grads[0][:3], *adjoint[0][1:]], *adjoint[1:])
    with pytest.raises(RuntimeError, match="grads must have 8 entries, got 6"):
        torch.ops.torch_mpm.substeps_backward(adjoint[0][:6], *adjoint[1:])
