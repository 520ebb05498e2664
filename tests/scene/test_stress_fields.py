"""Fields of stress: Cauchy's, its out-of-plane component in 2-D, von Mises stress and pressure, of every law."""

import dataclasses
import math
from functools import partial

import pytest
import torch
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.catalogue.laws import LAWS, named
from torch_mpm.data.stress import MEASURES
from torch_mpm.laws.thermal import LIQUID
from torch_mpm.scene.fields import RANKS, field

E, NU = 1e4, 0.3
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
MODULI = {"mu": MU, "lam": LAM}
SANDS = ("sand_unilateral", "sand_full", "sand_hencky", "sand_mixed", "sand_exact")
OF_THE_PLANE = ("custom", "custom_principal")
ELASTIC = {
    **named("neo_hookean", "fixed_corotated", "hencky"),
    **{name: partial(law, strength=1.9) for name, law in named("von_mises", "herschel_bulkley", "snow").items()},
    **{name: partial(law, strength=1.9, cohesion=0.5) for name, law in named("cam_clay", *SANDS).items()},
}
"""Laws in a state where nothing flows, in which that in 2-D is the one in 3-D at F_zz = 1."""
OTHERS = {name: law for name, law in (LAWS | named("water")).items() if name not in (*ELASTIC, *OF_THE_PLANE)}


def state_of(F, device, history=None, **fields):
    """Particles with a deformation and all other fields that a law may read."""
    F = F.to(device)
    P, D = F.shape[:2]
    x = torch.full((P, D), 0.5, dtype=F.dtype, device=device)
    zero = torch.zeros(P, dtype=F.dtype, device=device)
    rate = torch.linspace(-2, 2, P * D * D, dtype=F.dtype, device=device).reshape(P, D, D).sin()
    state = mpm.State(
        **{"x": x, "v": 0 * x, "mass": zero + 1, "volume": zero + 1e-3, "C": 3 * rate, "F": F},
        J=torch.linalg.det(F),
        temperature=zero + 20.0,
        material=torch.arange(P, dtype=torch.int32, device=device) % 3,
    )
    extra = {"activation": zero + 500.0, LIQUID: zero + 0.3, **(history or {})}
    return dataclasses.replace(state, extra=extra, **fields)


def step_of(law, dim):
    return mpm.Step(mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim), law)


def random_deformations(dim=2, size=0.1, count=12):
    noise = torch.randn(count, dim, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    return 0.95 * torch.eye(dim, dtype=torch.float64) + size * noise


def padded(F):
    whole = torch.zeros(len(F), 3, 3, dtype=F.dtype)
    whole[:, :2, :2], whole[:, 2, 2] = F, 1
    return whole


@pytest.mark.parametrize("name", ELASTIC)
def test_the_out_of_plane_stress_is_that_of_the_law_in_3d(name, device):
    """For F with F_zz = 1; the in-plane stress equals that in 2-D."""
    F, law = random_deformations(size=0.05), ELASTIC[name]()
    flat, whole = state_of(F, device), state_of(padded(F), device)
    if "log_plastic_volume" in law.extra_fields:
        for state in (flat, whole):
            state.extra["log_plastic_volume"] = torch.linspace(-0.1, 0.1, len(F), dtype=F.dtype, device=device)
    tau = law.stress(whole)
    torch.testing.assert_close(law.stress(flat), tau[:, :2, :2], rtol=1e-9, atol=1e-7)
    torch.testing.assert_close(law.out_of_plane_stress(flat), tau[:, 2, 2], rtol=1e-9, atol=1e-7)
    torch.testing.assert_close(law.volume_ratio(flat), law.volume_ratio(whole))
    assert tau[:, 2, 2].abs().max() > 1
    for measure in ("von_mises_stress", "pressure"):
        expected = field(step_of(law, 3), whole, measure)
        torch.testing.assert_close(field(step_of(law, 2), flat, measure), expected, rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize(*in_pairs(output=MEASURES, dim=[2, 3], name=[*ELASTIC, *OTHERS]))
def test_fields_of_all_laws(name, dim, output, device):
    """Each has its shape, and all follow from the Kirchhoff stress, J and the out-of-plane stress."""
    law = (ELASTIC | OTHERS)[name](**({"direction": (0.6, 0.8, 0.0)[:dim]} if name == "active" else {}))
    step, state = step_of(law, dim), state_of(random_deformations(dim), device)
    if output == "out_of_plane_stress" and dim == 3:
        with pytest.raises(ValueError, match="out_of_plane_stress is for 2-D"):
            field(step, state, output)
        return
    value = field(step, state, output)
    assert value.shape == (len(state), *(dim,) * RANKS[output]) and value.isfinite().all()
    tau, J = law.stress(state), law.volume_ratio(state)
    sigma = torch.zeros(len(state), 3, 3, dtype=tau.dtype, device=device)
    sigma[:, :dim, :dim] = tau / J[:, None, None]
    if dim == 2:
        sigma[:, 2, 2] = law.out_of_plane_stress(state) / J
    pressure = -sigma.diagonal(dim1=1, dim2=2).mean(1)
    deviator = sigma + pressure[:, None, None] * torch.eye(3, dtype=tau.dtype, device=device)
    expected = {
        **{"kirchhoff_stress": tau, "cauchy_stress": sigma[:, :dim, :dim], "stress": sigma[:, :dim, :dim]},
        **{"out_of_plane_stress": sigma[:, 2, 2], "pressure": pressure},
        "von_mises_stress": (1.5 * deviator.square().sum((1, 2))).sqrt(),
    }[output]
    torch.testing.assert_close(value, expected, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "along", "across"),
    [
        ("neo_hookean", lambda s: (MU * (s * s - 1) + LAM * math.log(s)) / s, lambda s: LAM * math.log(s) / s),
        ("fixed_corotated", lambda s: (2 * MU + LAM) * (s - 1), lambda s: LAM * (s - 1)),
        ("hencky", lambda s: (2 * MU + LAM) * math.log(s) / s, lambda s: LAM * math.log(s) / s),
    ],
)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_uniaxial_strain_by_hand(name, along, across, dim, angle, device):
    """Also turned by an angle, which turns the stress and leaves its invariants."""
    s = 0.8
    F = torch.eye(dim, dtype=torch.float64)[None].clone()
    F[0, 0, 0] = s
    R = torch.eye(dim, dtype=torch.float64)
    turned = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    R[:2, :2] = torch.tensor(turned, dtype=torch.float64)
    step, state = step_of(ELASTIC[name](), dim), state_of(R @ F, device)
    expected = torch.full((dim,), across(s), dtype=torch.float64)
    expected[0] = along(s)
    sigma = field(step, state, "stress")[0].cpu()
    torch.testing.assert_close(sigma, R @ torch.diag(expected) @ R.mT)
    assert float(field(step, state, "pressure")) == pytest.approx(-(along(s) + 2 * across(s)) / 3, rel=1e-9)
    assert float(field(step, state, "von_mises_stress")) == pytest.approx(abs(along(s) - across(s)), rel=1e-9)
    if dim == 2:
        assert float(field(step, state, "out_of_plane_stress")) == pytest.approx(across(s), rel=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_fluids_by_hand(dim, device):
    """Tait's pressure, and √3 times the shear stress η γ."""
    J, eta, rate = 0.97, 1.0, 5.0
    p = 1e4 / 7 * (J**-7 - 1)
    C = torch.zeros(1, dim, dim, dtype=torch.float64, device=device)
    C[0, 0, 1] = rate
    F = torch.eye(dim, dtype=torch.float64)[None] * J ** (1 / dim)
    state = state_of(F, device, C=C)
    for law, shear in ((OTHERS["water"](), 0.0), (OTHERS["fluid"](), eta * rate)):
        step = step_of(law, dim)
        assert float(field(step, state, "pressure")) == pytest.approx(p, rel=1e-9)
        von_mises = field(step, state, "von_mises_stress")
        assert float(von_mises) == pytest.approx(math.sqrt(3) * shear, rel=1e-9, abs=1e-6 * p)
        sigma = field(step, state, "cauchy_stress")[0]
        assert float(sigma[0, 1]) == pytest.approx(shear, abs=1e-9) and float(sigma[0, 0]) == pytest.approx(-p)
        if dim == 2:
            assert float(field(step, state, "out_of_plane_stress")) == pytest.approx(-p, rel=1e-9)


def test_plastic_flow_in_the_plane(device):
    """A sheared metal yields in the plane at σ_y, and out of it bears λ ln J: nothing flows there."""
    limit = 300.0
    F = random_deformations(size=0.3)
    F = F[torch.linalg.det(F) > 0.3]
    law = mpm.VonMises(**MODULI, yield_stress=limit)
    state = state_of(F, device)
    tau, J = law.stress(state).cpu(), torch.linalg.det(F)
    half = (tau[:, 0, 0] - tau[:, 1, 1]) / 2
    torch.testing.assert_close((3 * (half**2 + tau[:, 0, 1] ** 2)).sqrt(), torch.full_like(J, limit))
    torch.testing.assert_close(law.out_of_plane_stress(state).cpu(), LAM * J.log(), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", ["snow", "cam_clay"])
def test_the_volume_of_what_compacts(name, dim, device):
    """The volume ratio is that of the motion, before and after the return map, through steps of compression."""
    law = {
        "snow": mpm.Snow(**MODULI),
        "cam_clay": mpm.CamClay(**MODULI, critical_slope=1.2, consolidation=50.0, hardening=2.0),
    }[name]
    state, motion = state_of(torch.eye(dim, dtype=torch.float64).repeat(4, 1, 1), device), 1.0
    for _ in range(5):
        F = state.F.clone()
        F[:, 0] *= 0.96
        state, motion = state.replace(F=F), motion * 0.96
        torch.testing.assert_close(law.volume_ratio(state).cpu(), torch.full((4,), motion, dtype=torch.float64))
        fields, tau = law.update(state)
        torch.testing.assert_close(field(step_of(law, dim), state, "stress"), tau / motion)
        history = {"log_plastic_volume": fields["log_plastic_volume"]}
        state = state.replace(F=fields["F"], extra={**state.extra, **history})
    assert float(torch.linalg.det(state.F)[0]) > motion + 0.05


@pytest.mark.parametrize("dim", [2, 3])
def test_expansion_and_melting_by_hand(dim, device):
    """A body that has expanded freely has no stress; half molten, it has half of that of solid and liquid."""
    growth, eye = 1.02, torch.eye(dim, dtype=torch.float64)[None]
    expanding = mpm.ThermalExpansion(mpm.NeoHookean(**MODULI), 1e-3)
    state = state_of(growth * eye, device)
    step = step_of(expanding, dim)
    assert float(expanding.volume_ratio(state)) == pytest.approx(growth**dim, rel=1e-12)
    for name in ("pressure", "von_mises_stress"):
        assert float(field(step, state, name)) == pytest.approx(0, abs=1e-8)
    squeezed = state_of(0.9 * growth * eye, device)
    ln_J = dim * math.log(0.9)
    sigma = (MU * (0.81 - 1) + LAM * ln_J) / (0.9 * growth) ** dim
    assert float(field(step, squeezed, "stress")[0, 0, 0]) == pytest.approx(sigma, rel=1e-9)
    if dim == 2:
        expected = LAM * ln_J / (0.9 * growth) ** 2
        assert float(field(step, squeezed, "out_of_plane_stress")) == pytest.approx(expected, rel=1e-9)
    J, f = 0.9**dim, 0.3
    state = state_of(0.9 * eye, device)
    solid = LAM * J * (J - 1)
    liquid = -J * 1e4 / 7 * (J**-7 - 1)
    if dim == 2:
        out = float(field(step_of(OTHERS["melting"](), 2), state, "out_of_plane_stress"))
        assert out == pytest.approx(((1 - f) * solid + f * liquid) / J, rel=1e-9)


def test_what_is_turned_inside_out_has_no_stress(device):
    F = torch.diag_embed(torch.tensor([[-0.5, 1.0], [0.9, 1.0]], dtype=torch.float64))
    state = state_of(F, device)
    for name in MEASURES:
        value = field(step_of(mpm.NeoHookean(**MODULI), 2), state, name)
        assert (value[0] == 0).all() and value[1].abs().max() > 100


@pytest.mark.parametrize("law", ["custom", "mixture"])
def test_a_law_of_the_plane_alone_says_so(law):
    """A user's law has its stress, and is named where more is needed."""

    def neo_hookean(F):
        return MU * (F @ F.mT - torch.eye(F.shape[1], dtype=F.dtype))

    custom = mpm.CustomLaw(neo_hookean)
    chosen = custom if law == "custom" else mpm.Mixture([mpm.NeoHookean(**MODULI), custom, custom])
    state = state_of(random_deformations(), "cpu")
    assert field(step_of(chosen, 2), state, "cauchy_stress").shape == (12, 2, 2)
    for name in ("out_of_plane_stress", "von_mises_stress", "pressure"):
        with pytest.raises(NotImplementedError, match=r"CustomLaw has no out-of-plane stress.*define out_of_plane_"):
            field(step_of(chosen, 2), state, name)
    whole = state_of(random_deformations(3), "cpu")
    assert field(step_of(chosen, 3), whole, "pressure").shape == (12,)


def test_a_column_bears_its_weight():
    """The Cauchy stress of a gel under its own weight is that weight; across, that of uniaxial strain."""
    from torch_mpm.implicit import Implicit, equilibrium

    grid = mpm.Grid(dx=0.05, lower=(0, 0), upper=(0.25, 1.2))
    points = mpm.seed.box((0, 0), (0.25, 1.0), grid, per_cell=4, dtype=torch.float64)
    gel = mpm.State.at_rest(points, 1000.0, dtype=torch.float64)
    law = mpm.NeoHookean(E=3e4, nu=0.3)
    step = mpm.Step(grid, law, (0, -9.81), "mirror", integrator=Implicit(tolerance=1e-8))
    rest = equilibrium(step, gel, 1e2)
    sigma, J = field(step, rest, "stress"), torch.linalg.det(rest.F)
    weight = -9810 * (1 - gel.x[:, 1])
    low = gel.x[:, 1] < 0.7
    assert float(J[low].min()) < 0.85
    torch.testing.assert_close(sigma[low, 1, 1], weight[low], rtol=0, atol=98.1)  # 1% of the whole weight
    lam = 3e4 * 0.3 / (1.3 * 0.4)
    across = lam * J.log() / J
    torch.testing.assert_close(field(step, rest, "out_of_plane_stress")[low], across[low], rtol=1e-6, atol=0)
    torch.testing.assert_close(field(step, rest, "pressure")[low], -(weight + 2 * across)[low] / 3, rtol=0, atol=98.1)


@pytest.mark.parametrize(
    ("name", "near"),
    [("strees", "stress"), ("presure", "pressure"), ("velocty", "velocity"), ("mass!", None), (3, None)],
)
def test_unknown_fields(name, near):
    step = mpm.Step(mpm.Grid(0.1, (0, 0), (1, 1)), mpm.NeoHookean(E=1e4, nu=0.3))
    state = step.prepare(mpm.State.at_rest(mpm.seed.box((0.3, 0.3), (0.5, 0.5), 0.1), 1000.0))
    with pytest.raises(ValueError, match=r"name of a field must be one of position, .* got ") as error:
        field(step, state, name)
    assert near is None or str(error.value).endswith(f"did you mean {near!r}?")
