"""Gradients through implicit steps: against differences of tightly solved steps, and what their memory does."""

import gc

import pytest
import torch
from cases.implicit_gradients import NAMES, TIGHT, inputs, run
from helpers import relative_error
from torch.autograd.graph import saved_tensors_hooks

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block
from torch_mpm.implicit import Implicit, equilibrium


def check_gradients(grid, values, limit, names=NAMES, **arguments):
    """Compare derivatives of a random sum of the results along a random direction of each input with differences."""
    leaves = {name: values[name].clone().requires_grad_() for name in names}
    weights = [torch.randn_like(values[name]) for name in ("x", "v", "F")]

    def loss(given):
        _, end = run(grid, given, **arguments)
        return sum((w * t).sum() for w, t in zip(weights, (end.x, end.v, end.F), strict=True))

    grads = torch.autograd.grad(loss({**values, **leaves}), list(leaves.values()))
    for name, grad in zip(leaves, grads, strict=True):
        direction = torch.randn_like(values[name]) * values[name].abs().mean()
        with torch.no_grad():
            ends = [loss({**values, name: values[name] + h * direction}) for h in (1e-5, -1e-5)]
        difference, terms = (ends[0] - ends[1]) / 2e-5, grad * direction
        assert float((terms.sum() - difference).abs() / terms.norm()) < limit, name  # terms may cancel


SIDES = (None, "sticky", "slip", "separate")
FORMS_AND_WALLS = [
    *((2, form, walls) for form, walls in zip(("mls", "gradient") * 2, SIDES, strict=True)),
    *(
        pytest.param(2, form, walls, marks=pytest.mark.thorough)
        for form, walls in zip(("gradient", "mls") * 2, SIDES, strict=True)
    ),
    (3, "mls", "separate"),
    (3, "gradient", "sticky"),
    (2, "mls", "mirror"),
    (2, "gradient", "mirror"),
]


@pytest.mark.parametrize(("dim", "stress_form", "walls"), FORMS_AND_WALLS)
def test_gradients_of_every_input(dim, stress_form, walls, device):
    grid, values = inputs(dim, device)
    check_gradients(grid, values, 1e-6, walls=walls, stress_form=stress_form)


@pytest.mark.parametrize("law", [mpm.Hencky, mpm.FixedCorotated])
def test_gradients_of_laws_in_principal_axes(law, device):
    grid, values = inputs(2, device)
    check_gradients(grid, values, 1e-6, walls="sticky", law=law)


@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
def test_gradients_beside_an_obstacle(kind, device):
    grid, values = inputs(2, device)
    check_gradients(
        grid, values, 1e-6, walls="slip", boundaries=[mpm.Sphere((0.5, 0.6), 0.2, kind, velocity=(0.2, -1.0))]
    )


@pytest.mark.thorough
def test_gradients_of_twenty_steps(device):
    grid, values = inputs(2, device)
    values["dt"] = values["dt"] / 4
    check_gradients(grid, values, 1e-6, ("v", "F", "mu", "dt"), walls="sticky", n=20)


def test_gradients_in_float32(dim, device):
    """Against float64, of a loss without large terms that cancel."""
    grads = []
    for dtype in (torch.float64, torch.float32):
        torch.manual_seed(0)
        grid, values = inputs(dim, device, dtype)
        leaves = {name: values[name].requires_grad_() for name in ("v", "F", "mu")}
        _, end = run(grid, {**values, **leaves}, options={"tolerance": 1e-6}, walls="sticky")
        grads.append(torch.autograd.grad(end.v.square().sum(), list(leaves.values())))
    for exact, single in zip(*grads, strict=True):
        assert relative_error(single, exact) < 1e-3


def test_each_scene_has_its_own_adjoint(device):
    """The gradients of a batch are those of its scenes alone."""
    grid, values = inputs(2, device)
    pair = mpm.Grid(grid.dx, grid.lower, grid.upper, scenes=2)
    mu = torch.tensor([3e4, 3e6], dtype=torch.float64, device=device, requires_grad=True)
    fields = {name: torch.cat([values[name]] * 2) for name in ("x", "v", "F", "C", "mass", "volume")}
    scene = torch.arange(2, device=device).repeat_interleave(len(values["x"])).int()
    step = mpm.Step(pair, mpm.NeoHookean(mu=mu, lam=values["lam"]), walls="sticky", integrator=Implicit(**TIGHT))
    end = step(mpm.State(**fields, scene=scene), 0.02)
    (together,) = torch.autograd.grad(end.x.square().sum(), mu)
    assert step.integrator.adjoint_converged.tolist() == [True, True]
    for b in range(2):
        own = mu[b].detach().clone().requires_grad_()
        alone = {**values, "mu": own, "dt": values["dt"] * 0 + 0.02, "gravity": values["gravity"] * 0}
        _, end = run(grid, alone, walls="sticky")
        (grad,) = torch.autograd.grad(end.x.square().sum(), own)
        assert relative_error(together[b], grad) < 1e-7


def test_memory_does_not_grow_with_the_iterations(device):
    """Sizes that autograd saves for a step with one iteration and for one with many."""
    kept, iterations = [], []
    for tolerance in (0.5, 1e-12):
        grid, values = inputs(2, device)
        values["mu"].requires_grad_()
        sizes = []

        def pack(t, sizes=sizes):
            sizes.append(t.numel())
            return t

        with saved_tensors_hooks(pack, lambda t: t):
            step, _ = run(grid, values, options={"tolerance": tolerance}, walls="sticky")
        kept.append(sum(sizes))
        iterations.append(int(step.solve_report.cg_iterations[0]))
    assert iterations[1] > 2 * iterations[0] and kept[0] == kept[1]


def clay(mu, lam):
    return mpm.CamClay(mu=mu, lam=lam, critical_slope=1.0, consolidation=1e3, hardening=5.0)


@pytest.mark.parametrize(("rubs", "flows"), [(False, False), (True, False), (True, True)])
def test_all_that_waits_for_the_backward_pass_is_saved_by_autograd(rubs, flows, device):
    """Where hooks put saved tensors aside, no tensor of particles or nodes is left; and the gradient is the same."""

    def graph(device):
        grid, values = inputs(2, device)
        friction = torch.tensor(0.3, dtype=torch.float64, device=device, requires_grad=True)
        sphere = mpm.Sphere((0.5, 0.6), 0.2, "slip", friction=friction if rubs else 0.0)
        values["mu"].requires_grad_()
        law, options = (clay, {**TIGHT, "plasticity": "inside"}) if flows else (mpm.NeoHookean, TIGHT)
        _, end = run(grid, values, law, 2, options, walls="slip", boundaries=[sphere])
        return end.x.square().sum(), [values["mu"], friction][: 1 + rubs]

    def large():
        gc.collect()
        found = [t for t in gc.get_objects() if type(t) is torch.Tensor and t.numel() >= 16]
        return {id(t) for t in found}

    loss, leaves = graph(device)
    expected = torch.autograd.grad(loss, leaves)
    del loss, leaves
    torch.manual_seed(0)
    before = large()
    with saved_tensors_hooks(lambda t: (t.device, t.detach().cpu().numpy().copy()), unpacked):
        loss, leaves = graph(device)
    assert not large() - before
    for grad, wanted in zip(torch.autograd.grad(loss, leaves), expected, strict=True):
        assert bool(wanted != 0) and relative_error(grad, wanted) < 1e-12


def unpacked(kept):
    device, array = kept
    return torch.from_numpy(array).to(device)


@pytest.mark.parametrize("checkpoint", [2, mpm.Checkpoints(states=2)])
def test_gradients_of_steps_that_are_taken_again(checkpoint, device):
    grid, values = inputs(2, device)
    grads = []
    for kept in (None, checkpoint):
        mu = values["mu"].clone().requires_grad_()
        step = mpm.Step(grid, mpm.NeoHookean(mu=mu, lam=values["lam"]), walls="sticky", integrator=Implicit(**TIGHT))
        state = mpm.State(**{name: values[name] for name in ("x", "v", "F", "C", "mass", "volume")})
        end = mpm.rollout(step, state, 5, 0.01, checkpoint=kept)
        grads += torch.autograd.grad(end.x.square().sum(), mu)
        assert step.integrator.adjoint_converged.tolist() == [True]
    assert relative_error(*grads) < 1e-10


def test_every_solve_of_a_backward_pass_counts(device):
    """Two steps in one backward pass: the solve of the second fails, and that of the first, which comes last, does not;
    the next step begins anew."""
    grid, values = inputs(2, device)
    values["mu"].requires_grad_()
    step, first = run(grid, values, walls="sticky")
    options = step.integrator.options

    def enough(grad):
        options.max_cg_iterations = 1000
        return grad

    start = mpm.State(**{name: values[name] for name in ("x", "v", "F", "C", "mass", "volume")})
    second = step(start.replace(v=2 * start.v), values["dt"])
    first.x.register_hook(enough)
    loss = first.x.sum() + second.x.sum()
    options.max_cg_iterations = 1
    loss.backward()
    assert options.max_cg_iterations == 1000 and step.integrator.adjoint_converged.tolist() == [False]
    again = step(start, values["dt"])
    again.x.sum().backward()
    assert step.integrator.adjoint_converged.tolist() == [True]


def test_an_integrator_given_to_two_steps(device):
    """Each has a status of its own."""
    grid, values = inputs(2, device)
    integrator = Implicit(**TIGHT)
    steps = [mpm.Step(grid, mpm.NeoHookean(E=E, nu=0.3), integrator=integrator) for E in (1e4, 1e6)]
    state = mpm.State(**{name: values[name] for name in ("x", "v", "F", "C", "mass", "volume")})
    steps[0](state, 0.02)
    assert steps[1].solve_report is None and integrator.report is None
    kept = steps[0].solve_report
    steps[1](state, 0.02)
    assert steps[0].solve_report is kept and steps[1].solve_report is not kept
    assert steps[0].integrator.options == steps[1].integrator.options


def test_a_solve_of_the_adjoint_that_fails_is_reported(device):
    """With too few iterations the gradient is NaN, not wrong."""
    grid, values = inputs(2, device)
    values["mu"].requires_grad_()
    step, end = run(grid, values, walls="sticky")
    step.integrator.options.max_cg_iterations = 1
    (grad,) = torch.autograd.grad(end.x.sum(), values["mu"])
    assert step.integrator.adjoint_converged.tolist() == [False] and bool(grad.isnan())


def test_stiffness_from_the_sag_of_a_column(device):
    """u is proportional to 1/E: d u/dE = −u/E, and one Newton step of ln E finds the stiffness that gives a sag."""
    grid = mpm.Grid(0.125, (0, 0), (0.75, 1.5))
    state = block((0.25, 0.0), (0.5, 1.0), grid, device=device)

    def sag(log_E):
        law = mpm.Hencky(E=log_E.exp(), nu=0.0)
        step = mpm.Step(grid, law, (0.0, -1.0), walls="sticky", integrator=Implicit(1e-10))
        return (state.x - equilibrium(step, state, 1e3).x)[:, 1].mean()

    log_E = torch.tensor(14.0, dtype=torch.float64, device=device, requires_grad=True)
    value = sag(log_E)
    (slope,) = torch.autograd.grad(value, log_E)
    assert relative_error(slope, -value) < 0.01
    target = sag(torch.tensor(13.9, dtype=torch.float64, device=device))
    found = log_E + (target.log() - value.log()) * value / slope
    assert abs(found.item() - 13.9) < 1e-4
