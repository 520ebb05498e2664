"""Ways to use autograd: every law and differentiable op under checkpointing, hooks, forward mode and torch.func."""

import dataclasses
import warnings
from collections.abc import Callable

import pytest
import torch
from helpers import SingleSteps, random_particles, relative_error
from torch.autograd import forward_ad
from torch.autograd.graph import save_on_cpu, saved_tensors_hooks
from torch.utils.checkpoint import checkpoint

import torch_mpm as mpm
from benchmarks.catalogue import laws as catalogue
from benchmarks.catalogue.scenes import block
from torch_mpm import ops
from torch_mpm.ops.pointwise import pointwise

# ---- what is differentiated


@dataclasses.dataclass
class Case:
    """A function of tensors that gives a tuple of tensors, and whether its gradient can be differentiated again."""

    function: Callable
    inputs: list
    twice: bool = True

    def loss(self, *inputs, function=None):
        """Random sums of the outputs."""
        outputs = (function or self.function)(*inputs)
        generator = torch.Generator().manual_seed(5)
        weights = [torch.randn(y.shape, generator=generator, dtype=torch.float64).to(y) for y in outputs]
        return sum((w * y).sum() for w, y in zip(weights, outputs, strict=True))

    def leaves(self):
        return [t.detach().clone().requires_grad_() for t in self.inputs]

    def gradient(self, function=None):
        leaves = self.leaves()
        return torch.autograd.grad(self.loss(*leaves, function=function), leaves)

    def projected(self, grads):
        """A number whose gradient needs the second derivatives."""
        generator = torch.Generator().manual_seed(6)
        return sum((torch.randn(g.shape, generator=generator, dtype=torch.float64).to(g) * g).sum() for g in grads)

    def second(self, function=None):
        """Second derivatives by the inputs that a gradient depends on; None for the others."""
        leaves = self.leaves()
        grads = torch.autograd.grad(self.loss(*leaves, function=function), leaves, create_graph=True)
        return torch.autograd.grad(self.projected(grads), leaves, allow_unused=True)


def strained(dim, device, count=5):
    """Deformations with principal stretches well apart."""
    generator = torch.Generator().manual_seed(9)
    F = torch.eye(dim, dtype=torch.float64) + 0.2 * torch.randn(count, dim, dim, generator=generator).double()
    return (F @ torch.diag(torch.tensor([0.8, 1.0, 1.25], dtype=torch.float64)[:dim])).to(device)


def number(value, device):
    return torch.tensor(value, dtype=torch.float64, device=device)


def transfer_case(name, device):
    p = random_particles(2, sizes=(9, 4), device=device, deterministic=True)
    blocks, dt = p.blocks(), torch.tensor([1e-3, 2e-3], dtype=torch.float64, device=device)
    generator = torch.Generator().manual_seed(3)
    nodes = torch.randn(blocks.node_count, 2, generator=generator, dtype=torch.float64).to(device)
    mass_and_momentum = torch.cat([1 + nodes[:, :1] ** 2, nodes], 1)
    F = strained(2, device, 13)
    J = torch.linalg.det(F)
    if name == "p2g":
        function = lambda *t: (ops.p2g(blocks, *t),)  # noqa: E731
        return Case(function, [p.x, p.mass, p.v, p.C, p.stress, p.volume, dt])
    if name == "g2p":
        return Case(lambda x, v: ops.g2p(blocks, x, v, gradient=True), [p.x, nodes])
    if name == "scatter":
        return Case(lambda *t: (ops.scatter(blocks, *t),), [p.x, p.v, p.C, p.stress])
    if name == "gather":
        return Case(lambda x, n: ops.gather(blocks, x, n, moment=True, gradient=True), [p.x, nodes])
    if name == "advance":
        return Case(lambda *t: ops.advance(*t, scene=p.scene, scenes=2), [p.x, p.v, dt, p.C, F, J])
    if name == "g2p_advance":
        return Case(lambda *t: ops.g2p_advance(blocks, *t), [p.x, nodes, dt, F, J])
    if name == "grid_update":
        g = torch.randn(2, 2, generator=generator, dtype=torch.float64).to(device)
        walls = mpm.Walls("separate", friction=0.3)
        return Case(lambda n, g, dt: (ops.grid_update(blocks, n, g, dt, walls),), [mass_and_momentum, g, dt])
    if name == "contact":
        balls = [mpm.Sphere((0.3, 0.3), 0.3, friction=0.4), mpm.Sphere((0.5, 0.2), 0.2, "slip")]
        return Case(lambda v: (ops.contact(blocks, v, balls, 0.0),), [nodes])
    if name == "wall_impulses":
        g = torch.randn(2, 2, generator=generator, dtype=torch.float64).to(device)
        walls = mpm.Walls([("mirror", "slip"), "separate"], friction=[(0.0, 0.3), 0.3])
        return Case(lambda n, g, dt: (ops.wall_impulses(blocks, n, g, dt, walls),), [mass_and_momentum, g, dt])
    if name == "contact_impulses":
        balls = [mpm.Sphere((0.3, 0.3), 0.3, friction=0.4), mpm.Sphere((0.5, 0.2), 0.2, "slip")]
        function = lambda v, m: (ops.contact_impulses(blocks, v, m, balls, 0.0),)  # noqa: E731
        return Case(function, [nodes, mass_and_momentum[:, 0]])
    assert name == "sdf"
    shape = mpm.SDF(lambda x: (x**2).sum(1) - 0.1, (0.3, 0.3), friction=0.4)

    def obstruct(velocity, position):
        shape.position = position
        return (shape.apply(velocity, blocks.node_positions(torch.float64), blocks.node_scene(), 0.0, 1e-3),)

    return Case(obstruct, [nodes, torch.tensor([0.3, 0.3], dtype=torch.float64, device=device)])


def heat_case(name, device):
    p = random_particles(2, sizes=(30,), device=device, deterministic=True)
    blocks = p.blocks()
    heat_capacity = ops.scatter(blocks, p.x, p.mass[:, None])[:, 0].detach()
    theta = torch.randn(heat_capacity.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(device)
    if name == "pointwise":
        given = [p.mass, p.volume, theta[:30], p.x[:, 0] ** 2, 1 + p.v[:, 0] ** 2, number(0.3, device)]
        return Case(
            lambda *t: tuple(pointwise("heat_radiation", 2, *t[:5]) + pointwise("heat_layer", 2, *t[4:])), given
        )
    if name == "heat_operator":
        return Case(lambda x, k, u: (ops.heat_operator(blocks, x, k, u),), [p.x, p.volume, theta])
    method = {"heat_cg": "cg", "heat_multigrid": "multigrid"}[name]
    options = dict(tolerance=1e-13, adjoint_tolerance=1e-13, method=method)

    def solve(x, conductance, heat_capacity, theta, dt):
        return (ops.heat_cg(blocks, x, conductance, heat_capacity, theta, dt, **options).increment,)

    return Case(solve, [p.x, p.volume, heat_capacity, theta, number(0.02, device)])


def law_op_case(name, device):
    F, mu, lam = strained(3, device), number(3.0, device), number(5.0, device)
    if name in ("svd3", "polar"):
        return Case(getattr(mpm, name), [F])
    if name == "law_update":
        return Case(lambda F, *p: (ops.law_update("neo_hookean", F, list(p)).stress,), [F, mu, lam])
    if name == "law_energy":
        return Case(lambda F, *p: (ops.law_energy("neo_hookean", F, list(p)),), [F, mu, lam])
    if name == "plastic law_update":
        names = (*(F, mu, lam, number(0.1, device), number(2.0, device)), torch.zeros_like(F[:, 0, 0]))

        def update(F, mu, lam, limit, hardening, strain):
            result = ops.law_update("von_mises", F, [mu, lam, limit, hardening], [strain], details=True)
            return result.state, result.stress, *result.history, result.dissipated

        return Case(update, list(names), twice=False)
    if name == "principal law_energy":
        return Case(lambda F, *p: (ops.law_energy("hencky", F, list(p)),), [F, mu, lam])
    if name == "quartic_energy":
        return Case(lambda F, mu, lam: (ops.quartic_energy(F, mu, lam, energy="full"),), [F, mu, lam])
    if name == "quartic_stress":
        return Case(lambda F, mu, lam: (ops.quartic_stress(F, mu, lam, energy="full"),), [F, mu, lam], twice=False)
    assert name == "quartic_return_map"

    def return_map(F, mu, lam, alpha, cohesion, volume):
        options = dict(alpha=alpha, energy="hencky", details=True, cohesion=cohesion, volume_correction=volume)
        result = ops.quartic_return_map(F, mu, lam, **options)
        return result.F, result.stress, result.multiplier, result.dissipated, result.volume_correction

    given = [F, mu, lam, number(0.2, device), number(0.05, device), 0.01 * torch.ones_like(F[:, 0, 0])]
    return Case(return_map, given, twice=False)


TRANSFER_OPS = (
    *("p2g", "g2p", "scatter", "gather", "advance", "g2p_advance", "grid_update", "contact", "sdf"),
    *("wall_impulses", "contact_impulses"),
)
HEAT_OPS = ("pointwise", "heat_operator", "heat_cg", "heat_multigrid")
LAW_OPS = (
    *("svd3", "polar", "law_update", "law_energy", "plastic law_update", "principal law_energy"),
    *("quartic_energy", "quartic_stress", "quartic_return_map"),
)
NO_GRADIENT = {
    *("survey", "law_figures", "segment_clock", "pointwise_second", "take"),
    *("law_stiffness", "law_wave_modulus", "law_update_double_backward", "law_energy_double_backward"),
    *("heat_stencil", "heat_patches"),
    *("free_bodies", "substeps_with_bodies"),  # they refuse: see FreeBodies
    *("law_tangent", "implicit_apply", "implicit_node_blocks", "implicit_cg"),  # they refuse: see the adjoint of a step
}

LAWS = catalogue.LAWS | catalogue.named("sand_hardening")
TWICE = {"active", "custom", "expansion", "fluid", "neo_hookean"}


def rollout_case(name, device, every=None, n=2):
    """Steps of a law with heat, gravity, a wall and a rotating obstacle; all of their fields are inputs."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1), deterministic=True)
    generator = torch.Generator().manual_seed(1)
    rest = block((0.3, 0.3), (0.6, 0.6), 0.1, device=device)

    def noise(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64).to(device)

    P = len(rest)
    heat = dict(conductivity=1e3, specific_heat=100.0, tolerance=1e-13)
    if name == "melting":
        heat |= dict(melting_point=0.0, latent_heat=1e3)
    if name == "mixture":
        rest = rest.replace(material=(torch.arange(P, device=device) % 3).int())
    uses_F = name != "fluid"

    def run(E, x, v, deformation, temperature):
        ball = mpm.Sphere((0.45, 0.25), 0.1, friction=0.3, velocity=(0.1, 0.2))
        options = dict(gravity=(0.0, -9.8), walls="slip", boundaries=[ball], heat=mpm.Heat(grid, **heat))
        step = SingleSteps(grid, LAWS[name](E), **options)
        fields = {"F": deformation} if uses_F else {"J": deformation[:, 0, 0]}
        end = mpm.rollout(step, rest.replace(x=x, v=v, temperature=temperature, **fields), n, 1e-3, checkpoint=every)
        return end.x, end.v, end.temperature, end.C

    F = torch.eye(2, dtype=torch.float64, device=device) + 0.05 * noise(P, 2, 2)
    inputs = [number(1e4, device), rest.x + 0.01 * noise(P, 2), 0.3 * noise(P, 2), F, noise(P)]
    return Case(run, inputs, twice=name in TWICE)


def one_op_case(device):
    """Steps of particles with histories, on which gravity, walls and an obstacle act."""
    p = random_particles(2, sizes=(9, 4), device=device, deterministic=True)
    ball = mpm.Sphere((0.3, 0.3), 0.2, friction=0.4)

    def run(x, v, mass, volume, C, F, history, E, limit, gravity):
        law = mpm.VonMises(E=E, nu=0.3, yield_stress=limit, hardening=2.0)
        step = mpm.Step(p.grid, law, gravity, walls="separate", boundaries=[ball])
        extra = {"plastic_strain": history}
        state = mpm.State(x=x, v=v, mass=mass, volume=volume, C=C, F=F, scene=p.scene, extra=extra)
        end = mpm.rollout(step, state, 4, 1e-3)
        return end.x, end.v, end.C, end.F, end.extra["plastic_strain"]

    history = 0.1 * torch.ones_like(p.mass)
    numbers = (number(10.0, device), number(0.5, device), torch.tensor([[0.0, -9.8], [1.0, 2.0]]).to(p.x))
    return Case(run, [p.x, p.v, p.mass, p.volume, p.C, strained(2, device, 13), history, *numbers], twice=False)


CASES = (*TRANSFER_OPS, *HEAT_OPS, *LAW_OPS, "substeps", *LAWS)


def make_case(name, device):
    if name == "substeps":
        return one_op_case(device)
    if name in LAWS:
        return rollout_case(name, device)
    make = transfer_case if name in TRANSFER_OPS else heat_case if name in HEAT_OPS else law_op_case
    return make(name, device)


@pytest.fixture(params=CASES)
def case(request, device):
    return make_case(request.param, device)


def assert_same(got, expected, factor=1.0):
    for a, b in zip(got, expected, strict=True):
        assert (a is None) == (b is None)
        if b is not None:
            assert bool(b.isfinite().all())
            torch.testing.assert_close(a, factor * b, rtol=1e-9, atol=1e-11 * factor * float(b.abs().max()))


def tracked_ops(case):
    """Names of the ops in the graphs of the case, and of its gradient."""
    leaves, found, seen = case.leaves(), set(), set()
    loss = case.loss(*leaves)
    grads = torch.autograd.grad(loss, leaves, create_graph=True)
    pending = [t.grad_fn for t in (loss, *grads) if t.grad_fn is not None]
    while pending:
        node = pending.pop()
        if node in seen:
            continue
        seen.add(node)
        if node.name().startswith("torch_mpm_"):
            found.add(node.name().removeprefix("torch_mpm_").removesuffix("Backward"))
        pending += [next_node for next_node, _ in node.next_functions if next_node is not None]
    return found


def test_every_op_is_in_a_case():
    tracked = set().union(*(tracked_ops(make_case(name, "cpu")) for name in CASES))
    names = [n for n in torch._C._dispatch_get_all_op_names() if n.startswith("torch_mpm::")]
    registered = {n.partition("::")[2] for n in names if torch._C._dispatch_has_kernel_for_dispatch_key(n, "Autograd")}
    assert registered == tracked | NO_GRADIENT


# ---- saved tensors


class OnlyOnce:
    """Hooks that keep what is saved in numpy, and allow to read it once."""

    def pack(self, t):
        return [t.device, t.detach().cpu().numpy().copy()]

    def unpack(self, kept):
        device, array = kept
        assert array is not None, "a saved tensor was read twice"
        kept[1] = None
        return torch.from_numpy(array).to(device)


def kept_in_numpy():
    hooks = OnlyOnce()
    return saved_tensors_hooks(hooks.pack, hooks.unpack)


def computed_again(function):
    return lambda *inputs: checkpoint(function, *inputs, use_reentrant=False)


def under(context):
    def wrap(function):
        def run(*inputs):
            with context():
                return function(*inputs)

        return run

    return wrap


@pytest.mark.parametrize(
    "wrap", [computed_again, under(kept_in_numpy), under(save_on_cpu)], ids=["checkpoint", "numpy", "save_on_cpu"]
)
def test_saved_tensors_may_be_kept_elsewhere(case, wrap):
    assert_same(case.gradient(wrap(case.function)), case.gradient())


@pytest.mark.parametrize("wrap", [computed_again, under(save_on_cpu)], ids=["checkpoint", "save_on_cpu"])
def test_second_derivatives_with_saved_tensors_elsewhere(case, wrap):
    if case.twice:
        assert_same(case.second(wrap(case.function)), case.second())
    else:
        with pytest.raises(NotImplementedError, match=r"second derivatives: differentiate (it|them) once"):
            case.second(wrap(case.function))


@pytest.mark.parametrize("first,then", [("F", "F"), ("E", "F"), ("F", "E")])
def test_a_custom_principal_law_has_no_second_derivatives(first, then, device):
    """Its axes and divided differences are not tracked: second derivatives are refused rather than wrong."""
    leaves = {"F": strained(2, device).requires_grad_(), "E": number(3.0, device).requires_grad_()}
    law = mpm.CustomPrincipalLaw(lambda sigma: leaves["E"] * sigma.log() ** 3)
    F = leaves["F"]
    state = mpm.State(x=F[:, 0].detach(), v=F[:, 0].detach(), mass=F[:, 0, 0].detach(), volume=F[:, 0, 0].detach(), F=F)
    (gradient,) = torch.autograd.grad((law.stress(state) ** 2).sum(), [leaves[first]], create_graph=True)
    with pytest.raises(NotImplementedError, match="CustomPrincipalLaw has no second derivatives"):
        torch.autograd.grad(gradient.sum(), [leaves[then]])


@pytest.mark.parametrize("name", LAWS)
def test_rollouts_with_checkpoints(name, device):
    assert_same(rollout_case(name, device, 2, 5).gradient(), rollout_case(name, device, n=5).gradient())


# ---- the same graph, used in other ways


def test_a_graph_may_be_used_again(case):
    """Anomaly mode, two backward passes through one graph, outputs and inputs used twice."""
    expected = case.gradient()
    leaves = case.leaves()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that anomaly mode is slow
        with torch.autograd.detect_anomaly():
            loss = case.loss(*leaves)
            assert_same(torch.autograd.grad(loss, leaves, retain_graph=True), expected)
    assert_same(torch.autograd.grad(loss, leaves), expected)
    assert_same(case.gradient(lambda *t: tuple(y + y.clone() for y in case.function(*t))), expected, 2)
    leaves = case.leaves()
    assert_same(torch.autograd.grad(case.loss(*leaves) + case.loss(*leaves), leaves), expected, 2)


# ---- torch.func


def test_reverse_mode_of_torch_func(case):
    """torch.func.grad and vjp are autograd; once more where two derivatives are promised."""
    expected, every = case.gradient(), tuple(range(len(case.inputs)))
    assert_same(torch.func.grad(case.loss, every)(*case.inputs), expected)
    _, pull_back = torch.func.vjp(case.loss, *case.inputs)
    assert_same(pull_back(torch.ones_like(case.loss(*case.inputs))), expected)
    assert_same(case.gradient(), expected)  # nothing that was kept belongs to a transform
    if case.twice:
        once = lambda *t: case.projected(torch.func.grad(case.loss, every)(*t))  # noqa: E731
        zeros = [torch.zeros_like(t) for t in case.inputs]
        second = [z if g is None else g for z, g in zip(zeros, case.second(), strict=True)]
        assert_same(torch.func.grad(once, every)(*case.inputs), second)


def test_parameters_of_a_step_by_torch_func(device):
    """`functional_call` with the parameters of a step under torch.func.grad."""
    E = torch.nn.Parameter(number(1e4, device))
    step = mpm.Step(mpm.Grid(0.1, (0, 0), (1, 1)), mpm.NeoHookean(E=E, nu=0.3), walls="slip")
    state = block((0.3, 0.3), (0.6, 0.6), 0.1, device=device)
    state = step.prepare(state.replace(v=0.5 - state.x))

    def loss(parameters):
        end = mpm.rollout(lambda s, dt: torch.func.functional_call(step, parameters, (s, dt)), state, 3, 1e-2)
        return (end.x**2).sum()

    got = torch.func.grad(loss)({name: p.detach() for name, p in step.named_parameters()})
    (expected,) = torch.autograd.grad(loss(dict(step.named_parameters())), [E])
    assert float(expected.abs()) > 0
    assert relative_error(got["law.E"], expected) < 1e-12


def test_jacobians_of_a_step(device):
    """jacrev is refused with what to use instead, which is right by differences."""
    case = rollout_case("neo_hookean", device)
    E, x, v, F, temperature = case.inputs
    centre = lambda v: case.function(E, x, v, F, temperature)[0].mean(0)  # noqa: E731
    with pytest.raises(NotImplementedError, match=r"torch.vmap over torch_mpm::.*instead of torch.func.jacrev"):
        torch.func.jacrev(centre)(v)
    rows = torch.autograd.functional.jacobian(centre, v)
    direction = torch.randn(v.shape, dtype=torch.float64).to(device)
    difference = (centre(v + 1e-5 * direction) - centre(v - 1e-5 * direction)) / 2e-5
    torch.testing.assert_close((rows * direction).sum((1, 2)), difference, rtol=1e-6, atol=1e-12)
    _, product = torch.autograd.functional.jvp(centre, v, direction)
    torch.testing.assert_close(product, difference, rtol=1e-6, atol=1e-12)


# ---- forward mode

REFUSED = "torch_mpm::.* has no forward-mode derivative .*: use reverse mode"


def test_forward_mode_is_refused(case):
    """Never tangents of zero: by torch.func.jvp, by dual tensors with and without grad mode, of gradients too."""
    tangents = tuple(torch.ones_like(t) for t in case.inputs)
    if not tracked_ops(case):  # torch code alone, which has tangents
        _, tangent = torch.func.jvp(case.loss, tuple(case.inputs), tangents)
        torch.testing.assert_close(tangent, sum((g * t).sum() for g, t in zip(case.gradient(), tangents, strict=True)))
        return
    with pytest.raises(NotImplementedError, match=REFUSED):
        torch.func.jvp(case.loss, tuple(case.inputs), tangents)
    if len(case.inputs) == 1 or case.twice:
        with pytest.raises(NotImplementedError, match=REFUSED):
            torch.func.jvp(torch.func.grad(case.loss), tuple(case.inputs), tangents)
    for grad_mode in (True, False):
        with forward_ad.dual_level(), torch.set_grad_enabled(grad_mode):
            assert case.loss(*case.inputs).isfinite()  # without a tangent
            duals = [forward_ad.make_dual(t, s) for t, s in zip(case.inputs, tangents, strict=True)]
            with pytest.raises(NotImplementedError, match=REFUSED):
                case.loss(*duals)


def test_forward_mode_of_what_has_no_gradient_is_refused(device):
    F, mu = strained(3, device), number(1.0, device)
    for function in (
        lambda F: ops.law_stiffness("neo_hookean", F, [mu, mu]),
        lambda F: ops.law_wave_modulus("hencky", F, [mu, mu]),
        lambda F: ops.quartic_stiffness(F, mu, mu),
    ):
        with pytest.raises(NotImplementedError, match=REFUSED):
            torch.func.jvp(function, (F,), (F,))
