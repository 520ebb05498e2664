"""P2G and G2P against the plain-torch reference, conservation laws, and each other's adjoint."""

import pytest
import torch
from helpers import Particles, random_particles, relative_error
from oracle import transfer as reference
from pairs import in_pairs

import torch_mpm as mpm
from torch_mpm.ops import gather, scatter

DT = 0.013
CASES = {
    "pic": {},
    "apic": {"C": True},
    "mls": {"C": True, "stress": True},
    "gradient": {"C": True, "stress": True, "form": "gradient"},
    "pic+mls": {"stress": True},
}


def p2g_inputs(p: Particles, case: dict) -> dict:
    stress = bool(case.get("stress"))
    return {
        "x": p.x,
        "mass": p.mass,
        "v": p.v,
        "C": p.C if case.get("C") else None,
        "stress": p.stress if stress else None,
        "volume": p.volume if stress else None,
    }


@pytest.mark.parametrize("case", CASES)
def test_p2g_is_the_reference(device, dim, kernel, case):
    p = random_particles(dim, kernel, device=device, sizes=(70, 0, 50))
    blocks, form = p.blocks(), CASES[case].get("form", "mls")
    inputs = p2g_inputs(p, CASES[case])
    nodes = mpm.p2g(blocks, **inputs, dt=DT, stress_form=form)
    expected = reference.p2g(blocks, **inputs, dt=DT, stress_form=form)
    assert relative_error(nodes, expected) < 1e-14
    dense = reference.dense_blocks(blocks)
    assert (
        relative_error(blocks.to_dense(nodes), dense.to_dense(reference.p2g(dense, **inputs, dt=DT, stress_form=form)))
        < 1e-14
    )


def test_g2p_is_the_reference(device, dim, kernel):
    p = random_particles(dim, kernel, device=device, sizes=(70, 0, 50))
    blocks = p.blocks()
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64, device=device)
    for got, expected in zip(
        mpm.g2p(blocks, p.x, velocity, True, True), reference.g2p(blocks, p.x, velocity), strict=True
    ):
        assert relative_error(got, expected) < 1e-14


@pytest.mark.parametrize("K", [1, 2, 3, 4, 7])
def test_scatter_and_gather_are_the_reference(device, dim, kernel, K):
    p = random_particles(dim, kernel, device=device)
    blocks, P = p.blocks(), p.x.shape[0]
    value, moment, gradient = (torch.randn(P, K, *s, dtype=torch.float64, device=device) for s in ((), (dim,), (dim,)))
    nodes = scatter(blocks, p.x, value, moment, gradient, 1.7)
    assert relative_error(nodes, reference.scatter(blocks, p.x, value, moment, gradient, 1.7)) < 1e-14
    assert relative_error(scatter(blocks, p.x, value), reference.scatter(blocks, p.x, value, None, None, 1.0)) < 1e-14
    g = torch.randn_like(nodes)
    for got, expected in zip(
        gather(blocks, p.x, g, True, True, 1.7), reference.gather(blocks, p.x, g, 1.7), strict=True
    ):
        assert relative_error(got, expected) < 1e-14


def test_p2g_and_g2p_are_adjoint(device, dim, kernel):
    """⟨scatter(a, B, G), g⟩ = ⟨(a, B, G), gather(g)⟩ for any vectors."""
    p = random_particles(dim, kernel, device=device, sizes=(200, 130))
    blocks, P = p.blocks(), p.x.shape[0]
    a, B, G = (torch.randn(P, 3, *s, dtype=torch.float64, device=device) for s in ((), (dim,), (dim,)))
    nodes = scatter(blocks, p.x, a, B, G)
    g = torch.randn_like(nodes)
    ga, gB, gG = gather(blocks, p.x, g, True, True)
    left, right = (nodes * g).sum(), (a * ga).sum() + (B * gB).sum() + (G * gG).sum()
    assert abs(float(left - right)) < 1e-12 * float(nodes.norm() * g.norm())


def test_apic_conserves_mass_and_momenta(device, dim, kernel):
    """P2G then G2P with APIC keeps linear and angular momentum (Jiang et al. 2015, section 5.3)."""
    p = random_particles(dim, kernel, device=device, sizes=(500,))
    blocks = p.blocks()
    nodes = mpm.p2g(blocks, p.x, p.mass, p.v, p.C)
    positions = blocks.node_positions(torch.float64)

    def angular(x, momentum):
        """Antisymmetric part of Σ x ⊗ momentum."""
        total = x.T @ momentum
        return total - total.T

    skew = (p.mass[:, None, None] * p.C).sum(0) / p.grid.inverse_inertia
    linear = (p.mass[:, None] * p.v).sum(0)
    total = angular(p.x, p.mass[:, None] * p.v) + skew.T - skew
    assert float((nodes[:, 0].sum() - p.mass.sum()).abs()) < 1e-12 * float(p.mass.sum())
    scale = float((p.mass[:, None] * p.v).abs().sum())
    assert float((nodes[:, 1:].sum(0) - linear).abs().max()) < 1e-12 * scale
    assert float((angular(positions, nodes[:, 1:]) - total).abs().max()) < 1e-12 * scale
    mass = nodes[:, :1]
    velocity = torch.where(mass > 0, nodes[:, 1:] / torch.where(mass > 0, mass, 1), 0)
    v, C, _ = mpm.g2p(blocks, p.x, velocity)
    skew = (p.mass[:, None, None] * C).sum(0) / p.grid.inverse_inertia
    assert float(((p.mass[:, None] * v).sum(0) - linear).abs().max()) < 1e-12 * scale
    assert float((angular(p.x, p.mass[:, None] * v) + skew.T - skew - total).abs().max()) < 1e-12 * scale


def test_affine_velocity_fields_are_reproduced(device, dim, kernel):
    """An affine field on the nodes arrives as it is: v exactly, and both gradients."""
    p = random_particles(dim, kernel, device=device)
    blocks = p.blocks()
    A = torch.randn(dim, dim, dtype=torch.float64, device=device)
    velocity = blocks.node_positions(torch.float64) @ A.T
    v, C, grad_v = mpm.g2p(blocks, p.x, velocity, True, True)
    torch.testing.assert_close(v, p.x @ A.T, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(C, A.expand_as(C), rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(grad_v, A.expand_as(C), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(*in_pairs(case=CASES, dim=[2, 3], kernel=["quadratic", "cubic"]))
def test_float32_forward_and_backward(device, dim, kernel, case):
    """Within 5e-6 of the float64 reference on the same (rounded) inputs, P2G and G2P, forward and backward."""
    single = random_particles(dim, kernel, sizes=(700, 300), device=device, dtype=torch.float32, dx=1 / 64)
    double = single.to("cpu", torch.float64)
    form = CASES[case].get("form", "mls")
    lattice = [4 * b for b in single.grid.blocks]
    field_values = torch.randn(2, *lattice, 1 + dim).double()

    def run(p, p2g, g2p):
        inputs = {k: None if t is None else t.clone().requires_grad_() for k, t in p2g_inputs(p, CASES[case]).items()}
        blocks = p.grid.activate(p.x, p.scene)
        nodes = p2g(blocks, **inputs, dt=DT, stress_form=form)
        weights = blocks.from_dense(field_values.to(p.x))
        dense = blocks.to_dense(nodes)
        grads = torch.autograd.grad((nodes * weights).sum(), [t for t in inputs.values() if t is not None])
        x = p.x.clone().requires_grad_()
        field = weights[:, :dim].clone().requires_grad_()
        v, C, grad_v = g2p(blocks, x, field)
        probe = torch.cos(torch.arange(p.x.shape[0], dtype=torch.float64)).to(x)
        loss = (v * probe[:, None]).sum() + (C * probe[:, None, None]).sum() + (grad_v * probe[:, None, None]).sum()
        grad_x, grad_field = torch.autograd.grad(loss, (x, field))
        return [dense, *grads, v, C, grad_v, grad_x, blocks.to_dense(grad_field)]

    got = run(single, mpm.p2g, lambda b, x, u: mpm.g2p(b, x, u, True, True))
    expected = run(double, reference.p2g, reference.g2p)
    errors = [relative_error(a, b) for a, b in zip(got, expected, strict=True)]
    assert max(errors) < 5e-6, errors


@pytest.mark.parametrize(*in_pairs(case=CASES, dim=[2, 3], kernel=["quadratic", "cubic"]))
def test_p2g_gradients(device, dim, kernel, case):
    p = random_particles(dim, kernel, device=device, sizes=(3, 0, 2))
    blocks, form = p.blocks(), CASES[case].get("form", "mls")
    inputs = p2g_inputs(p, CASES[case])
    names = [k for k, t in inputs.items() if t is not None]
    tensors = [inputs[k].clone().requires_grad_() for k in names]
    mix = torch.randn(2, blocks.node_count, dtype=torch.float64, device=device)
    if CASES[case].get("stress"):
        names.append("dt")
        tensors.append(torch.tensor([0.3, 0.2, 0.4], dtype=torch.float64, device=device, requires_grad=True))

    def function(*args):
        return mix @ mpm.p2g(blocks, **dict(zip(names, args, strict=True)), stress_form=form)

    torch.autograd.gradcheck(function, tensors, nondet_tol=1e-12 if device == "cuda" else 0.0)
    torch.autograd.gradgradcheck(function, tensors, nondet_tol=1e-12 if device == "cuda" else 0.0, fast_mode=True)


def test_g2p_gradients(device, dim, kernel):
    p = random_particles(dim, kernel, device=device, sizes=(3, 0, 2))
    blocks = p.blocks()
    mix = torch.randn(blocks.node_count, 3, dtype=torch.float64, device=device)
    x = p.x.clone().requires_grad_()
    values = torch.randn(3, dim, dtype=torch.float64, device=device, requires_grad=True)

    def function(x, values):
        return mpm.g2p(blocks, x, mix @ values, True, True)

    torch.autograd.gradcheck(function, (x, values), nondet_tol=1e-12 if device == "cuda" else 0.0)
    torch.autograd.gradgradcheck(function, (x, values), nondet_tol=1e-12 if device == "cuda" else 0.0)


def test_second_derivatives_of_functions_of_g2p(dim):
    """The adjoint that reaches G2P depends on the positions itself."""
    p = random_particles(dim, sizes=(3,))
    blocks = p.blocks()
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64)

    def function(x):
        return mpm.g2p(blocks, x, velocity)[0] ** 2

    torch.autograd.gradgradcheck(function, p.x.clone().requires_grad_(), fast_mode=True)


def test_scatter_and_gather_gradients(device, dim, kernel):
    p = random_particles(dim, kernel, device=device, sizes=(4,))
    blocks = p.blocks()
    mix = torch.randn(2, blocks.node_count, dtype=torch.float64, device=device)
    x, *rest = (
        torch.randn(*s, dtype=torch.float64, device=device, requires_grad=True) if i else p.x.clone().requires_grad_()
        for i, s in enumerate(((), (4, 2), (4, 2, dim), (4, 2, dim)))
    )
    nondet = 1e-12 if device == "cuda" else 0.0
    both = lambda *a: mix @ scatter(blocks, *a, 1.3)  # noqa: E731
    torch.autograd.gradcheck(both, (x, *rest), nondet_tol=nondet)
    torch.autograd.gradgradcheck(both, (x, *rest), nondet_tol=nondet)


def test_order_and_strides_do_not_matter(device, dim, kernel):
    """Particle order, row-major or structure-of-arrays storage, and gaps between rows change nothing but rounding."""
    p = random_particles(dim, kernel, device=device, sizes=(400, 300))
    blocks = p.blocks()
    nodes = mpm.p2g(blocks, p.x, p.mass, p.v, p.C, p.stress, p.volume, DT)
    order = torch.randperm(p.x.shape[0]).to(device)
    soa = lambda t: t.permute(*range(1, t.dim()), 0).contiguous().permute(t.dim() - 1, *range(t.dim() - 1))  # noqa: E731
    gaps = lambda t: torch.stack([t, torch.full_like(t, torch.nan)], -1)[..., 0]  # noqa: E731
    for view in (soa, gaps):
        args = [view(t[order]) for t in (p.x, p.mass, p.v, p.C, p.stress, p.volume)]
        other = p.grid.activate(args[0], p.scene[order])
        assert relative_error(mpm.p2g(other, *args, DT), nodes) < 1e-14
        velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64, device=device)
        v, C, _ = mpm.g2p(blocks, p.x, velocity)
        w, E, _ = mpm.g2p(other, args[0], gaps(velocity))
        assert relative_error(w, v[order]) < 1e-14
        assert relative_error(E, C[order]) < 1e-14
        row_view = torch.cat([torch.zeros_like(velocity[:, :1]), velocity], 1)[:, 1:]
        assert relative_error(mpm.g2p(other, args[0], row_view)[0], v[order]) < 1e-14


def test_scenes_do_not_touch_each_other(device, dim, kernel):
    """A scene in a batch gives what it gives alone, and so do its gradients."""
    p = random_particles(dim, kernel, device=device, sizes=(150, 90, 60))
    velocity = None

    def run(q, scene):
        nonlocal velocity
        x = q.x.clone().requires_grad_()
        blocks = q.grid.activate(q.x, q.scene)
        nodes = mpm.p2g(blocks, x, q.mass, q.v, q.C, q.stress, q.volume, DT)
        v, C, _ = mpm.g2p(blocks, x, nodes[:, 1:])
        loss = (v**3).sum() + (C**2).sum()
        return blocks.to_dense(nodes)[scene], v, torch.autograd.grad(loss, x)[0]

    for s in range(3):
        members = (p.scene == s).nonzero()[:, 0]
        alone = Particles(mpm.Grid(p.grid.dx, p.grid.lower, p.grid.upper, kernel=kernel), *(
            t[members] for t in (p.x, p.mass, p.v, p.C, p.stress, p.volume)), None)  # fmt: skip
        nodes, v, grad = run(p, s)
        nodes_alone, v_alone, grad_alone = run(alone, 0)
        assert relative_error(nodes, nodes_alone) < 1e-14
        assert relative_error(v[members], v_alone) < 1e-13
        assert relative_error(grad[members], grad_alone) < 1e-12


def test_particles_outside_give_and_take_nothing(device, dim, kernel):
    p = random_particles(dim, kernel, device=device, sizes=(40,))
    x = p.x.clone()
    x[3] = torch.nan
    x[5, 0] = torch.inf
    x[7] = 1e30
    x[9, -1] = -5.0
    good = torch.ones(40, dtype=torch.bool, device=device)
    good[[3, 5, 7, 9]] = False
    blocks = p.grid.activate(x)
    nodes = mpm.p2g(blocks, x, p.mass, p.v, p.C, p.stress, p.volume, DT)
    assert bool(torch.isfinite(nodes).all())
    kept = [t[good] for t in (x, p.mass, p.v, p.C, p.stress, p.volume)]
    alone = p.grid.activate(kept[0])
    assert relative_error(blocks.to_dense(nodes), alone.to_dense(mpm.p2g(alone, *kept, DT))) < 1e-14
    v, C, _ = mpm.g2p(blocks, x, torch.ones_like(nodes[:, 1:]))
    assert v[[3, 5]].isnan().all() and C[[3, 5]].isnan().all()
    assert not v[[7, 9]].any() and not C[[7, 9]].any()
    leaf = x.clone().requires_grad_()
    (mpm.p2g(blocks, leaf, p.mass, p.v) ** 2).sum().backward()
    assert float(leaf.grad[~good].abs().max()) == 0 and bool(torch.isfinite(leaf.grad).all())
    status = blocks.status[0].tolist()
    assert status[1] == 2 and status[2] == 7 and status[3] == 2 and status[4] == 3 and status[6] == 0


@pytest.mark.parametrize("sizes", [(0,), (0, 0), (1,)])
def test_empty_and_single(device, dim, kernel, sizes):
    p = random_particles(dim, kernel, device=device, sizes=sizes)
    blocks = p.blocks()
    x = p.x.clone().requires_grad_()
    nodes = mpm.p2g(blocks, x, p.mass, p.v, p.C, p.stress, p.volume, DT)
    v, C, _ = mpm.g2p(blocks, x, nodes[:, 1:])
    (v.sum() + C.sum()).backward()
    assert v.shape == (sum(sizes), dim) and x.grad.shape == x.shape
    torch.testing.assert_close(nodes[:, 0].sum(), p.mass.sum())


def test_no_scenes(device, dim):
    grid = mpm.Grid(0.1, (0,) * dim, (1,) * dim, scenes=0)
    x = torch.zeros(0, dim, device=device)
    blocks = grid.activate(x, torch.zeros(0, dtype=torch.int32, device=device))
    assert float(mpm.p2g(blocks, x, x[:, 0], x).sum()) == 0


def test_opcheck(device, dim, kernel):
    p = random_particles(dim, kernel, device=device, sizes=(5, 3))
    ops = torch.ops.torch_mpm
    blocks = p.blocks()
    grad = torch.randn(blocks.node_count, 1 + dim, dtype=torch.float64, device=device)
    dt = torch.tensor([0.1, 0.2], dtype=torch.float64, device=device)
    tensors = [t.clone().requires_grad_() for t in (p.x, p.mass, p.v, p.C, p.stress, p.volume, dt)]
    top = blocks.packed
    value, moment = p.v.clone().requires_grad_(), p.C.clone().requires_grad_()
    activation = (p.x, p.scene, None, None, 2, p.grid.max_blocks, *p.grid.packed)
    checks = {
        ops.activate.default: activation,
        ops.p2g.default: (*tensors, 1.0, 0, *top),
        ops.p2g_backward.default: (grad, *tensors, 1.0, 0, 127, *top),
        ops.g2p.default: (tensors[0], grad[:, 1:].clone().requires_grad_(), True, True, *top),
        ops.scatter.default: (tensors[0], value, moment, None, 1.0, *top),
        ops.gather.default: (tensors[0], grad.clone().requires_grad_(), 1.0, True, False, *top),
        ops.position_gradient.default: (tensors[0], value, moment, None, grad[:, 1:].clone(), 1.0, *top),
    }
    tests = ["test_schema", "test_autograd_registration", "test_faketensor"]
    for op, args in checks.items():
        torch.library.opcheck(op, args, test_utils=tests)


def test_vmap_is_refused(dim):
    p = random_particles(dim, sizes=(4,))
    blocks = p.blocks()
    with pytest.raises(NotImplementedError, match="pack the scenes"):
        torch.vmap(lambda m: torch.ops.torch_mpm.p2g(p.x, m, p.v, None, None, None, None, 0.0, 0, *blocks.packed))(
            torch.ones(2, 4, dtype=torch.float64)
        )


BAD = [
    ({"x": lambda t: t[:, :1]}, ValueError, r"x must have shape \[P, 2\]"),
    ({"x": lambda t: t.half()}, TypeError, "x must be float32 or float64"),
    ({"mass": lambda t: t[:-1]}, ValueError, r"mass must have shape \[P\] = \[17\], got \[16\]"),
    ({"v": lambda t: t.float()}, TypeError, "v must have the dtype of x"),
    ({"C": lambda t: t[:, 0]}, ValueError, r"C must have shape \[P, D, D\] = \[17, 2, 2\], got \[17, 2\]"),
    ({"volume": lambda t: None}, ValueError, "stress needs volume and dt"),
    ({"v": lambda t: t.to("meta")}, ValueError, "v must be on the device of x"),
]


@pytest.mark.parametrize("change,error,message", BAD)
def test_bad_input(change, error, message):
    p = random_particles(2)
    blocks = p.blocks()
    inputs = p2g_inputs(p, {"C": True, "stress": True})
    for name, make in change.items():
        inputs[name] = make(inputs[name])
    with pytest.raises(error, match=message):
        mpm.p2g(blocks, **inputs, dt=DT)


@pytest.mark.parametrize("dt", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_dt(dt):
    p = random_particles(2)
    with pytest.raises(ValueError, match="dt must be a positive number"):
        mpm.p2g(p.blocks(), p.x, p.mass, p.v, p.C, p.stress, p.volume, dt)


def test_zero_mass_particles_give_no_nan(device, dim):
    p = random_particles(dim, device=device)
    nodes = mpm.p2g(p.blocks(), p.x, torch.zeros_like(p.mass), p.v, p.C)
    assert float(nodes.abs().max()) == 0


def test_compiles_to_one_graph(dim):
    p = random_particles(dim, sizes=(30,))
    p.blocks()

    @torch.compile(backend="aot_eager", fullgraph=True)
    def loss(x, v):
        blocks = p.grid.activate(x)
        nodes = mpm.p2g(blocks, x, p.mass, v, p.C, p.stress, p.volume, DT)
        w, C, _ = mpm.g2p(blocks, x, nodes[:, 1:])
        return (w**2).sum() + C.sum()

    def grads(function):
        leaves = [t.clone().requires_grad_() for t in (p.x, p.v)]
        return torch.autograd.grad(function(*leaves), leaves)

    for compiled, eager in zip(grads(loss), grads(loss._torchdynamo_orig_callable), strict=True):
        assert relative_error(compiled, eager) < 1e-13
