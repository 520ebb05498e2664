"""Gradients through implicit steps of plastic laws, with the flow after the solve and inside it: against differences of
tightly solved steps.

The states are compressed along one axis and extended along another, and move on in the same sense, so that particles
yield or are elastic by much more than the differences move them: on the yield surface a step has two derivatives.
"""

import pytest
import torch
from helpers import relative_error
from pairs import each_once

import torch_mpm as mpm
from benchmarks.catalogue.laws import having
from benchmarks.catalogue.scenes import block
from torch_mpm.implicit import Implicit, adjoint, equilibrium, implicit
from torch_mpm.laws.compiled import CompiledLaw
from torch_mpm.laws.parameters import Overlay
from torch_mpm.ops import LAWS as REGISTRY

pytestmark = pytest.mark.usefixtures("one_thread")

MODULI = {"E": 1e5, "nu": 0.3}
PARAMETERS = {
    law.make: {name: value for name, value in law.arguments(**MODULI, strength=0.02).items() if type(value) is float}
    for law in having("plastic").values()
}
ENERGIES = ("full", "unilateral", "hencky", "mixed")
LAWS = [*((law, {}) for law in PARAMETERS if law is not mpm.QuarticSand)]
LAWS += [(mpm.QuarticSand, {"energy": energy}) for energy in ENERGIES]
FIELDS = ("x", "v", "F", "C", "mass", "volume")


def name_of(law):
    return law[1].get("energy", law[0].__name__) if isinstance(law, tuple) else str(law)


def inputs(law, dim, device, dtype=torch.float64):
    """A block on the floor with all that a step reads: fields, history q, gravity, dt, parameters."""
    grid = mpm.Grid(0.25, (0,) * dim, (2.0,) + (1.5,) * (dim - 1))
    state = block((0.5, 0.0, 0.5)[:dim], (1.0, 0.5, 0.75)[:dim], grid)
    P = len(state)
    stretch, rate = (torch.diag(torch.tensor(t[:dim]).double()) for t in ((0.92, 1.04, 0.98), (-3.0, 2.0, -0.5)))

    def normal(*shape):
        return torch.randn(*shape, dtype=torch.float64)

    values = {
        "x": state.x + 0.02 * normal(P, dim),
        "v": (state.x - state.x.mean(0)) @ rate + 0.1 * normal(P, dim),
        "F": stretch + 0.01 * normal(P, dim, dim),
        "C": rate + 0.3 * normal(P, dim, dim),
        "mass": state.mass,
        "volume": state.volume,
        "q": 0.02 * torch.rand(P, dtype=torch.float64),
        "gravity": torch.tensor([0.0, -9.8, 0.0][:dim]),
        "dt": torch.tensor(0.01),
        **{name: torch.tensor(value) for name, value in PARAMETERS[law[0]].items()},
    }
    return grid, {name: value.to(device, dtype) for name, value in values.items()}


def run(grid, values, law, plasticity, n=1, tolerance=1e-12, **arguments):
    kind, options = law
    step = mpm.Step(
        grid,
        kind(**{name: values[name] for name in PARAMETERS[kind]}, **options),
        gravity=values["gravity"],
        integrator=Implicit(tolerance, 60, adjoint_tolerance=tolerance, plasticity=plasticity),
        **arguments,
    )
    state = state_of(values, step)
    for _ in range(n):
        state = step(state, values["dt"])
        assert bool(step.solve_report.converged.all()), step.solve_report
    return step, state


def state_of(values, step, **changes):
    extra = dict.fromkeys(step.law.extra_fields, values["q"])
    return mpm.State(**{name: values[name] for name in FIELDS}, extra=extra).replace(**changes)


def flowing(step, state, dt):
    return int((step.law.return_map(Overlay(step.prepare(state), dt=dt), details=True).branch > 0).sum())


def groups_of(law):
    """All inputs of a law, in groups that are moved together."""
    history = () if law[0] in (mpm.HerschelBulkley, mpm.QuarticSand) else ("q",)
    return [FIELDS, *((name,) for name in ("gravity", "dt", *PARAMETERS[law[0]], *history))]


def check_gradients(grid, values, law, groups, limit, **arguments):
    """Compare derivatives of a random sum of the results with differences, in one random direction per group."""
    weights = [torch.randn_like(values[name]) for name in ("x", "v", "F")]
    leaves = {name: values[name].clone().requires_grad_() for group in groups for name in group}

    def run_to_the_end(given):
        step, end = run(grid, given, law, **arguments)
        return sum((w * t).sum() for w, t in zip(weights, (end.x, end.v, end.F), strict=True)), step, end

    loss, step, end = run_to_the_end({**values, **leaves})
    grads = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
    assert step.integrator.adjoint_converged.all() and flowing(step, end, values["dt"]) >= 1
    for group in groups:
        directions = {name: torch.randn_like(values[name]) * values[name].abs().mean() for name in group}
        with torch.no_grad():
            ends = [
                run_to_the_end({**values, **{name: values[name] + h * d for name, d in directions.items()}})[0]
                for h in (1e-5, -1e-5)
            ]
        difference = (ends[0] - ends[1]) / 2e-5
        # Rounding error of the difference: one unit in the last place of each of its ends.
        rounding = 2 * torch.finfo(loss.dtype).eps * float(loss.abs()) / 2e-5
        along = sum((grads[name] * d).sum() for name, d in directions.items())
        error = float((along - difference).abs())
        assert bool(difference != 0) and error < limit * float(difference.abs()) + rounding, group


@pytest.mark.parametrize(*each_once(plasticity=["after", "inside"], law=LAWS), ids=name_of)
def test_gradients_of_every_law(law, plasticity, device):
    grid, values = inputs(law, 2, device)
    check_gradients(grid, values, law, groups_of(law), 1e-6, plasticity=plasticity, walls="sticky")


@pytest.mark.parametrize(("law", "plasticity"), [(LAWS[2], "after"), (LAWS[6], "inside")], ids=name_of)
def test_gradients_in_3d(law, plasticity, device):
    grid, values = inputs(law, 3, device)
    groups = FIELDS, ("dt",), ("nu",)
    check_gradients(grid, values, law, groups, 1e-6, plasticity=plasticity, walls="slip", stress_form="gradient")


SEVERAL = [(LAWS[2], "inside", 5, "hardening"), (LAWS[3], "after", 20, "consolidation")]
SEVERAL += [(LAWS[5], "inside", 5, "friction_angle")]


@pytest.mark.parametrize(("law", "plasticity", "n", "parameter"), SEVERAL, ids=name_of)
def test_gradients_of_several_steps(law, plasticity, n, parameter, device):
    grid, values = inputs(law, 2, device)
    values["dt"] = values["dt"] * 5 / n
    check_gradients(grid, values, law, [FIELDS, (parameter,)], 1e-6, plasticity=plasticity, n=n, walls="sticky")


SURFACES = [(LAWS[0], "separate", 0.3), (LAWS[3], "slip", 5.0), (LAWS[6], "separate", 0.3), (LAWS[6], "slip", 5.0)]


@pytest.mark.parametrize(("law", "kind", "friction"), SURFACES, ids=name_of)
def test_gradients_with_friction(law, kind, friction, device):
    """A plane rubs the block, or holds it by friction: where all of it sticks nothing depends on the coefficient."""
    grid, values = inputs(law, 2, device)
    values["v"] = values["v"] + values["v"].new_tensor([0.5 if friction < 1 else 0.0, -0.5])
    values["friction"] = values["dt"].new_tensor(friction)
    plane = mpm.Plane((0.0, 0.1), (0.0, 1.0), kind)

    def moved(given):
        plane.friction = given["friction"]
        return run(grid, given, law, "inside", boundaries=[plane])

    leaf = values["friction"].clone().requires_grad_()
    v = values["v"].clone().requires_grad_()
    weight = torch.randn_like(v)
    step, end = moved({**values, "friction": leaf, "v": v})
    grads = torch.autograd.grad((weight * end.v).sum(), [leaf, v])
    assert step.integrator.adjoint_converged.all() and flowing(step, end, values["dt"]) >= 1
    directions = torch.ones_like(leaf), torch.randn_like(v)
    for name, grad, direction in zip(("friction", "v"), grads, directions, strict=True):
        with torch.no_grad():
            ends = [moved({**values, name: values[name] + h * direction})[1].v for h in (1e-6, -1e-6)]
        difference = (weight * (ends[0] - ends[1])).sum() / 2e-6
        if friction > 1 and name == "friction":
            assert not grad.any() and abs(float(difference)) < 1e-8
        else:
            assert bool(difference != 0) and relative_error((grad * direction).sum(), difference) < 1e-5, name


def test_gradients_of_a_mixture(device):
    """Sand that flows beside an elastic solid and a fluid."""
    sand = LAWS[6]
    grid, values = inputs(sand, 2, device)
    material = torch.arange(len(values["x"]), device=device).remainder(3).int()
    angle, E, v = (values[name].clone().requires_grad_() for name in ("friction_angle", "E", "v"))
    weight = torch.randn_like(v)

    def end_of(angle, E, v):
        laws = [sand[0](E=1e5, nu=0.3, friction_angle=angle, **sand[1]), mpm.NeoHookean(E=E, nu=0.3)]
        law = mpm.Mixture([*laws, mpm.WeaklyCompressible(1e5, viscosity=50.0)])
        step = mpm.Step(grid, law, values["gravity"], "slip", integrator=Implicit(1e-12, 60, 1000, 1e-12, "inside"))
        state = state_of(values, step, v=v, material=material, J=torch.ones_like(values["mass"]))
        end = step(state, values["dt"])
        assert bool(step.solve_report.converged.all())
        return (weight * end.v).sum()

    leaves = [angle, E, v]
    grads = torch.autograd.grad(end_of(*leaves), leaves)
    for k, grad in enumerate(grads):
        direction = torch.randn_like(grad) * leaves[k].detach().abs().mean()
        with torch.no_grad():
            ends = [end_of(*(t + s * direction if i == k else t for i, t in enumerate(leaves))) for s in (1e-5, -1e-5)]
        difference = (ends[0] - ends[1]) / 2e-5
        assert bool(difference != 0) and relative_error((grad * direction).sum(), difference) < 1e-5, k


@pytest.mark.parametrize("plasticity", ["after", "inside"])
def test_scenes_have_adjoints_of_their_own(plasticity, device):
    """Scenes with their own dt and cohesion, the second so large that nothing flows, against each scene alone."""
    law = (mpm.QuarticSand, {"energy": "hencky"})
    grid, values = inputs(law, 2, device)
    pair = mpm.Grid(grid.dx, grid.lower, grid.upper, scenes=2)
    P, dts = len(values["x"]), values["x"].new_tensor([0.01, 0.004])
    cohesion = values["x"].new_tensor([0.0, 1.0])
    weight = torch.randn_like(values["v"])

    def grads(grid, cohesion, dt, scenes):
        angle = values["friction_angle"].expand(scenes).clone().requires_grad_()
        dt = dt.clone().requires_grad_()
        sand = mpm.QuarticSand(**MODULI, energy="hencky", friction_angle=angle, cohesion=cohesion)
        integrator = Implicit(1e-12, adjoint_tolerance=1e-12, plasticity=plasticity)
        step = mpm.Step(grid, sand, walls="sticky", integrator=integrator)
        fields = {name: torch.cat([values[name]] * scenes) for name in FIELDS}
        scene = torch.arange(scenes, device=device).repeat_interleave(P).int()
        end = step(mpm.State(**fields, scene=scene), dt)
        result = torch.autograd.grad((torch.cat([weight] * scenes) * end.v).sum(), [angle, dt])
        assert step.integrator.adjoint_converged.all()
        return result

    together = grads(pair, cohesion, dts, 2)
    for b in range(2):
        alone = grads(grid, cohesion[b : b + 1], dts[b : b + 1], 1)
        for k, grad in enumerate(alone):
            assert bool(grad != 0) == (b == 0 or k == 1)
            assert relative_error(together[k][b], grad[0]) < 1e-7


@pytest.mark.parametrize("checkpoint", [2, mpm.Checkpoints(states=2)], ids=["every second", "two states"])
def test_gradients_of_steps_that_are_taken_again(checkpoint, device, monkeypatch):
    """The derivatives of the flow, which the solve takes by autograd, do not set off more of them."""
    solves, minimise = [], implicit.minimise
    monkeypatch.setattr(implicit, "minimise", lambda *a: solves.append(1) or minimise(*a))
    grid, values = inputs(LAWS[3], 2, device)
    grads = []
    for kept in (None, checkpoint):
        slope = values["critical_slope"].clone().requires_grad_()
        step, _ = run(grid, {**values, "critical_slope": slope}, LAWS[3], "inside", n=0, walls="sticky")
        end = mpm.rollout(step, state_of(values, step), 5, 0.01, checkpoint=kept)
        grads += torch.autograd.grad(end.x.square().sum(), slope)
        assert step.integrator.adjoint_converged.tolist() == [True]
    assert bool(grads[0] != 0) and relative_error(*grads) < 1e-10
    assert 15 <= len(solves) <= 25  # each step once or twice, and some three times


@pytest.mark.parametrize("law", [LAWS[0], LAWS[3], LAWS[6]], ids=name_of)
@pytest.mark.parametrize("plasticity", ["after", "inside"])
def test_gradients_in_float32(law, plasticity, device):
    """Against float64, of a loss without large terms that cancel."""
    grads = []
    for dtype in (torch.float64, torch.float32):
        torch.manual_seed(0)
        grid, values = inputs(law, 2, device, dtype)
        leaves = {name: values[name].requires_grad_() for name in ("v", "F", "E")}
        _, end = run(grid, {**values, **leaves}, law, plasticity, tolerance=1e-6, walls="sticky")
        grads.append(torch.autograd.grad(end.v.square().sum(), list(leaves.values())))
    for exact, single in zip(*grads, strict=True):
        assert relative_error(single, exact) < 1e-3


@pytest.mark.parametrize("plasticity", ["after", "inside"])
@pytest.mark.parametrize("law", LAWS, ids=name_of)
def test_gradients_are_finite_where_the_state_is(law, plasticity, device):
    """Material at rest, sheared, compressed, torn apart, and inverted (without stress)."""
    grid, values = inputs(law, 2, device)
    F = torch.eye(2).to(values["F"]).repeat(len(values["F"]), 1, 1)
    F[1, 0, 1], F[2, 0, 0], F[3, 1, 1], F[4, 0, 0], F[5, 0, 0] = 0.3, 0.8, 1.5, -1.0, 0.0
    F[6:, 0, 0], F[7:, 1, 1] = 1.1, 1.1
    leaves = {name: values[name].clone().requires_grad_() for name in ("x", "v", "gravity", "E", "nu")}
    leaves["F"] = F.requires_grad_()
    step, end = run(grid, {**values, **leaves}, law, plasticity, tolerance=1e-9)
    grads = torch.autograd.grad(end.v.square().sum(), list(leaves.values()))
    for name, grad in zip(leaves, grads, strict=True):
        assert bool(grad.isfinite().all()) and bool((grad != 0).any()), name
    assert not grads[-1][4:6].any() and step.integrator.adjoint_converged.all()


@pytest.mark.parametrize("law", [(mpm.NeoHookean, {}), LAWS[6]], ids=name_of)
def test_a_bad_scene_does_not_keep_the_others_waiting(law, device, monkeypatch):
    """One scene is not a number, with friction: the gradients of the other are what they were without, and the backward
    pass takes no more linear solves."""
    grid, values = inputs(LAWS[6], 2, device)
    pair = mpm.Grid(grid.dx, grid.lower, grid.upper, scenes=2)
    P, counts, grads = len(values["x"]), [], []
    friction = {"walls": mpm.Walls(("open", ("separate", "open")), friction=(0.0, (0.3, 0.0)))}
    parameters = {name: values[name] for name in PARAMETERS.get(law[0], MODULI)}
    solve = adjoint.implicit_cg
    for bad in (False, True):
        v = torch.cat([values["v"]] * 2) - torch.tensor([[0.0, 0.5]]).to(values["v"])
        v[P + 3] = torch.nan if bad else 0.0
        fields = {name: torch.cat([values[name]] * 2) for name in FIELDS}
        state = mpm.State(**fields, scene=torch.arange(2, device=device).repeat_interleave(P).int())
        step = mpm.Step(
            pair,
            law[0](**parameters, **law[1]),
            integrator=Implicit(1e-10, 60, adjoint_tolerance=1e-10, plasticity="inside"),
            **friction,
        )
        leaf = v.requires_grad_()
        end = step(state.replace(v=leaf), 0.01)
        calls = []
        monkeypatch.setattr(adjoint, "implicit_cg", lambda *a, calls=calls, **k: calls.append(1) or solve(*a, **k))
        grads += torch.autograd.grad(end.v.square().sum(), leaf)
        counts.append(len(calls))
        assert step.integrator.adjoint_converged.tolist() == [True, not bad]
    assert 1 < counts[1] <= counts[0]
    assert relative_error(grads[1][:P], grads[0][:P]) < 1e-12


def test_a_solve_of_the_adjoint_that_fails_is_reported(device):
    """With too few iterations the gradient is NaN, not wrong."""
    grid, values = inputs(LAWS[6], 2, device)
    values["E"] = (100 * values["E"]).requires_grad_()
    step, end = run(grid, values, LAWS[6], "inside", tolerance=1e-9, walls="sticky")
    step.integrator.options.max_cg_iterations = 1
    (grad,) = torch.autograd.grad(end.x.sum(), values["E"])
    assert step.integrator.adjoint_converged.tolist() == [False] and bool(grad.isnan())


@pytest.mark.parametrize("law", LAWS, ids=name_of)
def test_trial_stress_is_that_of_the_energy(law, dim, device):
    """Also where it comes from the law that has the same energy; with derivatives by F, moduli and history."""
    torch.manual_seed(0)
    kind, options = law
    P, names = 4, [name for name in PARAMETERS[kind] if name not in MODULI]
    F = torch.eye(dim, dtype=torch.float64) * 0.9 + 0.05 * torch.randn(P, dim, dim, dtype=torch.float64)
    q, E, nu = (a + 0.1 * torch.rand(P, dtype=torch.float64) for a in (0.05, 1.0, 0.2))
    zero, one = torch.zeros(P, dim, dtype=torch.float64, device=device), torch.ones_like(q).to(device)

    def stress(F, q, E, nu):
        material = kind(E=E, nu=nu, **{name: PARAMETERS[kind][name] for name in names}, **options)
        state = mpm.State(x=zero, v=zero, mass=one, volume=one, F=F, extra={name: q for name in material.extra_fields})
        timed = Overlay(state, dt=0.1)
        result = material.trial_stress(timed, timed)
        given = F.detach().requires_grad_()
        energy = material.trial_energy(Overlay(timed, F=given), timed).sum()
        expected = torch.autograd.grad(energy, given)[0] @ F.mT
        assert relative_error(result, expected) < 1e-13
        return result

    inputs = [t.to(device).requires_grad_() for t in (F, q, E, nu)]
    assert torch.autograd.gradcheck(stress, inputs)


def test_a_static_sag_beyond_yield(device):
    """Column that flows under its weight; gradients by its strength against differences."""
    grid = mpm.Grid(0.125, (0, 0), (1.5, 1.5))
    state = block((0.5, 0.0), (0.75, 1.0), grid, device=device)

    def sag(strength, hardening):
        law = mpm.VonMises(E=1e6, nu=0.3, yield_stress=strength, hardening=hardening)
        integrator = Implicit(1e-11, adjoint_tolerance=1e-11, plasticity="inside")
        end = equilibrium(mpm.Step(grid, law, (0.0, -9.8), walls="sticky", integrator=integrator), state, 10.0)
        return (state.x - end.x)[:, 1].mean()

    strength, hardening = torch.tensor([4e3, 2e5], dtype=torch.float64, device=device).requires_grad_().unbind()
    grads = torch.autograd.grad(sag(strength, hardening), [strength, hardening])
    with torch.no_grad():
        assert sag(strength, hardening) > 1.05 * sag(1e9 * strength, hardening)
        h = 1e-5
        by_strength = (sag((1 + h) * strength, hardening) - sag((1 - h) * strength, hardening)) / (2 * h * strength)
        by_hardening = (sag(strength, (1 + h) * hardening) - sag(strength, (1 - h) * hardening)) / (2 * h * hardening)
    assert relative_error(grads[0], by_strength) < 1e-6 and relative_error(grads[1], by_hardening) < 1e-6


def test_every_law_with_a_tangent_has_second_derivatives():
    kinds = [kind for kind in vars(mpm).values() if isinstance(kind, type) and issubclass(kind, CompiledLaw)]
    names = {kind.name: kind.elastic_name or kind.name for kind in kinds if "name" in vars(kind)}
    assert set(PARAMETERS) <= set(kinds)
    assert all(REGISTRY[names[n]].twice_differentiable_energy for n in names if REGISTRY[n].has_tangent)
