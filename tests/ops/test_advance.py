"""The end of a step, by itself and fused with G2P, against plain torch."""

import pytest
import torch
from helpers import Particles, random_particles, relative_error
from oracle import advance as reference
from pairs import in_pairs

import torch_mpm as mpm

DT = 0.013
CASES = {
    "solid": {"F": True},
    "fluid": {"J": True},
    "no C": {"F": True, "J": True, "affine": False},
    "gradient": {"F": True, "stress_form": "gradient"},
    "gradient, no C": {"J": True, "stress_form": "gradient", "affine": False},
    "neither": {},
}
OUTPUTS = ("x", "v", "C", "F", "J")


def inputs(p: Particles, case: dict) -> tuple[dict, dict]:
    """Optional tensors, and options, of a case."""
    tensors = {"F": p.stress if case.get("F") else None, "J": p.volume if case.get("J") else None}
    return tensors, {k: v for k, v in case.items() if k in ("affine", "stress_form")}


def node_velocity(blocks: mpm.Blocks, like: torch.Tensor) -> torch.Tensor:
    return torch.randn(blocks.node_count, like.shape[1], dtype=torch.float64).to(like)


@pytest.mark.parametrize("with_dt", [False, True])
def test_advance_is_the_reference(device, dim, with_dt):
    p = random_particles(dim, device=device, sizes=(70, 0, 50))
    dt = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, device=device) if with_dt else DT
    got = mpm.advance(p.x, p.v, dt, p.C, p.stress, p.volume, p.scene, 3)
    expected = reference.advance(p.x, p.v, dt[p.scene] if with_dt else dt, p.C, p.stress, p.volume)
    for value, other in zip(got, expected, strict=True):
        assert relative_error(value, other) < 1e-15


@pytest.mark.parametrize("with_dt", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_g2p_advance_is_the_reference(device, dim, kernel, case, with_dt):
    p = random_particles(dim, kernel, device=device, sizes=(70, 0, 50))
    blocks = p.blocks()
    velocity = node_velocity(blocks, p.x)
    tensors, options = inputs(p, CASES[case])
    dt = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, device=device) if with_dt else DT
    got = mpm.g2p_advance(blocks, p.x, velocity, dt, **tensors, **options)
    expected = reference.g2p_advance(
        blocks, p.x, velocity, dt[p.scene] if with_dt else dt, **tensors, stress_form=options.get("stress_form", "mls")
    )
    for name, value, other in zip(OUTPUTS, got, expected, strict=True):
        if (name in "FJ" and tensors[name] is None) or (name == "C" and not CASES[case].get("affine", True)):
            assert value is None
        else:
            assert relative_error(value, other) < 1e-14, name


@pytest.mark.parametrize("count", [1, 7, 8, 9, 1500])
def test_g2p_advance_is_the_composition(device, dim, kernel, count):
    """In float32 and in any order of the particles, to rounding of g2p and advance."""
    p = random_particles(dim, kernel, device=device, sizes=(count,), extent=0.5, dtype=torch.float32)
    blocks = p.blocks()
    order = blocks.index.long()
    for x, F in ((p.x, p.stress), (p.x[order], p.stress[order]), (p.x.T.contiguous().T[order], p.stress[order])):
        blocks = p.grid.activate(x)
        velocity = node_velocity(blocks, x)
        v, C, _ = mpm.g2p(blocks, x, velocity)
        next_x, next_F, _ = mpm.advance(x, v, DT, C, F)
        got = mpm.g2p_advance(blocks, x, velocity, DT, F)
        for value, other in zip(got, (next_x, v, C, next_F), strict=False):
            assert relative_error(value, other) < 3e-7


@pytest.mark.parametrize(*in_pairs(case=CASES, dim=[2, 3], kernel=["quadratic", "cubic"]))
def test_g2p_advance_gradients(device, dim, kernel, case):
    p = random_particles(dim, kernel, device=device, sizes=(2, 0, 1))
    blocks = p.blocks()
    tensors, options = inputs(p, CASES[case])
    names = [name for name, value in tensors.items() if value is not None]
    mix = torch.randn(blocks.node_count, 2, dtype=torch.float64, device=device)
    nodes = torch.randn(2, dim, dtype=torch.float64, device=device)
    dt = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, device=device)
    leaves = [t.clone().requires_grad_() for t in (p.x, nodes, dt, *(tensors[name] for name in names))]

    def function(x, nodes, dt, *rest):
        out = mpm.g2p_advance(blocks, x, mix @ nodes, dt, **dict(zip(names, rest, strict=True)), **options)
        return tuple(t for t in out if t is not None)

    nondet = 1e-12 if device == "cuda" else 0.0
    torch.autograd.gradcheck(function, leaves, nondet_tol=nondet, fast_mode=True)
    torch.autograd.gradgradcheck(function, leaves, nondet_tol=nondet, fast_mode=True)


def test_advance_gradients(device, dim):
    p = random_particles(dim, device=device, sizes=(2, 1))
    dt = torch.tensor([0.1, 0.2], dtype=torch.float64, device=device)
    leaves = [t.clone().requires_grad_() for t in (p.x, p.v, dt, p.C, p.stress, p.volume)]

    def function(*tensors):
        return mpm.advance(*tensors, p.scene, 2)

    torch.autograd.gradcheck(function, leaves)
    torch.autograd.gradgradcheck(function, leaves)


def test_particles_of_scenes_without_dt_have_no_position(device, dim):
    """As many scenes as dt has entries: a particle of a later one has NaN, an absent one the dt of scene 0."""
    p = random_particles(dim, device=device, sizes=(6,))
    scene = torch.tensor([0, 1, 2, 3, -1, 1], dtype=torch.int32, device=device)
    dt = torch.tensor([0.1, 0.2], dtype=torch.float64, device=device)
    x, F, J = mpm.advance(p.x, p.v, dt, p.C, p.stress, p.volume, scene, 2)
    known = [0, 1, 4, 5]
    expected = reference.advance(p.x[known], p.v[known], dt[[0, 1, 0, 1]], p.C[known], p.stress[known], p.volume[known])
    for got, right in zip((x, F, J), expected, strict=True):
        torch.testing.assert_close(got[known], right)
        assert got[2:4].isnan().all()
    raw = torch.ops.torch_mpm.advance(p.x, p.v, None, None, None, scene, dt, 1.0)[0]
    assert raw[2:4].isnan().all() and not raw[known].isnan().any()


def test_particles_outside_stay(device, dim, kernel):
    p = random_particles(dim, kernel, device=device, sizes=(40,))
    x = p.x.clone()
    x[3] = torch.nan
    x[9, -1] = -5.0
    blocks = p.grid.activate(x)
    out = mpm.g2p_advance(blocks, x, node_velocity(blocks, x), DT, p.stress, p.volume)
    rest = torch.where(x.isfinite().all(1), 0.0, torch.nan).to(x)[:, None].expand_as(x)
    before = (x, rest, rest[..., None].expand_as(p.C), p.stress, p.volume)
    for value, other in zip(out, before, strict=True):
        torch.testing.assert_close(value[[3, 9]], other[[3, 9]], rtol=0, atol=0, equal_nan=True)


def test_opcheck(device, dim, kernel):
    p = random_particles(dim, kernel, device=device, sizes=(5, 3))
    ops = torch.ops.torch_mpm
    blocks = p.blocks()
    dt = torch.tensor([0.1, 0.2], dtype=torch.float64, device=device, requires_grad=True)
    x, v, C, F, J = (t.clone().requires_grad_() for t in (p.x, p.v, p.C, p.stress, p.volume))
    velocity = node_velocity(blocks, x).requires_grad_()
    checks = {
        ops.g2p_advance.default: (x, velocity, F, J, 1e-9 * p.x, dt, 1.0, True, 0, *blocks.packed),
        ops.advance.default: (x, v, C, F, J, p.scene, dt, 1.0),
        ops.advance_backward.default: (x, F, J, x, v, C, F, J, p.scene, dt, 1.0, 31),
    }
    for op, arguments in checks.items():
        torch.library.opcheck(
            op, arguments, test_utils=["test_schema", "test_autograd_registration", "test_faketensor"]
        )


@pytest.mark.parametrize(
    "change,error,message",
    [
        ({"x": torch.zeros(5, 3)}, ValueError, r"x must have shape \[P, 2\]"),
        ({"velocity": torch.zeros(3, 2)}, ValueError, r"velocity must have shape \[N, D\]"),
        ({"F": torch.zeros(4, 2, 2)}, ValueError, r"F must have shape \[P, D, D\]"),
        ({"J": torch.zeros(5)}, TypeError, "J must have the dtype of x"),
        ({"dt": -1.0}, ValueError, "dt must be a positive number"),
        ({"stress_form": "weak"}, ValueError, "stress_form must be one of"),
    ],
)
def test_bad_input(change, error, message):
    p = random_particles(2, sizes=(5,))
    blocks = p.blocks()
    arguments = {"x": p.x, "velocity": node_velocity(blocks, p.x), "dt": DT, **change}
    with pytest.raises(error, match=message):
        mpm.g2p_advance(blocks, **arguments)
