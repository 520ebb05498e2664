"""Materials that depend on temperature: tables and functions as parameters, thermal expansion, melting."""

import numpy as np
import pytest
import torch
from cases.heat import FLOAT, block, grid_around
from helpers import relative_error

import torch_mpm as mpm
from benchmarks.catalogue import scenes
from torch_mpm.laws.parameters import evaluate
from torch_mpm.laws.thermal_calls import tables_of_expansion

KNOTS, VALUES = [0.0, 10.0, 50.0], [2e4, 1e4, 1e3]


def deformed(dim, device="cpu", particles=7, **fields):
    """A state with random F and J near rest and temperatures on both sides of the table."""
    generator = torch.Generator().manual_seed(1)

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    state = mpm.State(
        x=random(particles, dim),
        v=torch.zeros(particles, dim, dtype=torch.float64),
        mass=1 + random(particles),
        volume=1 + random(particles),
        F=torch.eye(dim, dtype=torch.float64) + 0.2 * (random(particles, dim, dim) - 0.5),
        J=0.9 + 0.2 * random(particles),
        temperature=80 * random(particles) - 10,
        **fields,
    )
    return state.to(device)


# ---- tables and functions of temperature


def test_table_interpolates_and_stays_constant_beyond_its_ends(device):
    theta = torch.linspace(-20, 80, 41, dtype=torch.float64, device=device)
    table = mpm.Table(KNOTS, VALUES).to(device)
    expected = np.interp(theta.cpu(), KNOTS, VALUES)
    np.testing.assert_allclose(table(theta).cpu(), expected, rtol=1e-14)
    assert table(theta.float()).dtype == torch.float32


def test_the_lists_of_a_table_follow_its_tensor(device):
    given = torch.tensor(KNOTS, dtype=torch.float64, device=device)
    for table in (mpm.Table(KNOTS, given.float()), mpm.Table(given, VALUES)):
        assert table.temperature.device == table.value.device == given.device


def test_an_expansion_by_a_table_follows_the_particles():
    """Values may be assigned on another device than that of the temperatures; meta stands for it."""
    table, x = mpm.Table(KNOTS, VALUES), torch.empty(5, 3, device="meta")
    table.value = torch.empty(3, device="meta")
    ((_, rows),) = tables_of_expansion(mpm.ThermalExpansion(mpm.NeoHookean(1e5, 0.3), table), x)
    assert rows.device == x.device and rows.shape == (2, 3)


def test_table_is_differentiable():
    values = torch.tensor(VALUES, dtype=torch.float64, requires_grad=True)
    theta = torch.tensor([-3.0, 4.0, 20.0, 90.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v, t: mpm.Table(KNOTS, v)(t), (values, theta))
    table = mpm.Table(KNOTS, torch.nn.Parameter(values.detach()))
    assert len(list(mpm.NeoHookean(E=table, nu=0.3).parameters())) == 1


@pytest.mark.parametrize(
    "knots,values,message",
    [
        ([0, 0], [1, 2], "must increase"),
        ([1, 0], [1, 2], "must increase"),
        ([0, float("nan")], [1, 2], "must be finite"),
        ([0, 1], [1, float("inf")], "finite"),
        ([0, 1], [1, 2, 3], "one length"),
        ([0], [1], "2 or more"),
    ],
)
def test_bad_tables(knots, values, message):
    with pytest.raises(ValueError, match=message):
        mpm.Table(knots, values)


@pytest.mark.parametrize("reordered", [False, True])
def test_function_parameter_is_the_same_parameter_per_particle(device, dim, reordered):
    """E from a table beside ν per particle, in the order of ids: as E per particle."""
    state = deformed(dim, device)
    E = torch.from_numpy(np.interp(state.temperature.cpu(), KNOTS, VALUES)).to(device)
    nu = torch.linspace(0.1, 0.4, len(state), dtype=torch.float64, device=device)
    if reordered:
        order = torch.tensor([3, 1, 6, 0, 2, 5, 4], device=device)
        state = state.replace(ids=torch.arange(7, device=device)).select(order)
    given, per_particle = mpm.NeoHookean(E=mpm.Table(KNOTS, VALUES), nu=nu).to(device), mpm.NeoHookean(E=E, nu=nu)
    for quantity in ("stress", "energy_density", "stiffness", "wave_modulus"):
        torch.testing.assert_close(getattr(given, quantity)(state), getattr(per_particle, quantity)(state))


def test_function_parameters_in_a_mixture_and_of_a_fluid():
    """Each law of a mixture sees the temperatures of its own particles."""
    viscosity = mpm.Table([0.0, 60.0], [5.0, 1.0])
    laws = [mpm.NeoHookean(E=mpm.Table(KNOTS, VALUES), nu=0.3), mpm.WeaklyCompressible(1e4, viscosity=viscosity)]
    state = deformed(2).replace(material=torch.tensor([0, 1, 1, 0, 1, 0, 1], dtype=torch.int32))
    state.C = torch.randn(7, 2, 2, dtype=torch.float64)
    stress = mpm.Mixture(laws).stress(state)
    for k, law in enumerate(laws):
        mine = (state.material == k).nonzero()[:, 0]
        torch.testing.assert_close(stress[mine], law.stress(state.select(mine)))


def test_network_as_parameter_gets_gradients():
    network = torch.nn.Sequential(torch.nn.Linear(1, 4), torch.nn.Softplus(), torch.nn.Linear(4, 1)).double()
    law = mpm.NeoHookean(mu=lambda theta: 1 + network(theta[:, None] / 50)[:, 0] ** 2, lam=1.0)
    state = deformed(3)
    weight = network[0].weight

    def loss():
        return law.stress(state).square().sum()

    (gradient,) = torch.autograd.grad(loss(), weight)
    with torch.no_grad():
        weight[1, 0] += 1e-5
        above = loss()
        weight[1, 0] -= 2e-5
        below = loss()
    assert float(gradient[1, 0]) == pytest.approx(float(above - below) / 2e-5, rel=1e-6)


def test_bad_parameters():
    state = deformed(2)
    with pytest.raises(ValueError, match="temperature is None"):
        mpm.NeoHookean(E=mpm.Table(KNOTS, VALUES), nu=0.3).stress(state.replace(temperature=None))
    with pytest.raises(
        ValueError, match=r"E as a function of temperature must return shape \[P\] = \[7\], got \[7, 1\]"
    ):
        mpm.NeoHookean(E=lambda theta: theta[:, None], nu=0.3).stress(state)
    with pytest.raises(ValueError, match=r"kappa must have shape \[\], \[1\], \[B\] or \[P\] = \[7\], got \[3\]"):
        evaluate("kappa", torch.ones(3), state)


# ---- thermal expansion


def test_constrained_bar(dim):
    """σ_xx = −E α ΔT of a bar that is held along x and free across, for small strains."""
    E, alpha, rise = 1e7, 1e-5, 10.0
    law = mpm.ThermalExpansion(mpm.NeoHookean(E=E, nu=0.3 if dim == 3 else 0.0), alpha)
    state = deformed(dim, particles=1).replace(temperature=torch.full((1,), rise, dtype=torch.float64))
    across = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    for _ in range(5):  # Newton's iteration for the stretch across that leaves no stress there

        def stress(s):
            F = torch.diag_embed(torch.stack([torch.ones_like(s), *[s] * (dim - 1)]))[None]
            return law.stress(state.replace(F=F))[0]

        residual = stress(across)[1, 1]
        (slope,) = torch.autograd.grad(residual, across)
        across = (across - residual / slope).detach().requires_grad_()
    across = across.detach()
    assert abs(float(stress(across)[1, 1])) < 1e-6 * E * alpha * rise
    assert float(stress(across)[0, 0]) == pytest.approx(-E * alpha * rise, rel=3 * alpha * rise)


def test_bar_between_walls_is_under_pressure_and_a_free_one_is_not():
    """The same in a rollout: 2-D, ν = 0, so that the stress along the bar is −E α ΔT for any motion across it."""
    E, alpha, rise = 1e5, 1e-4, 50.0
    law = mpm.ThermalExpansion(mpm.NeoHookean(E=E, nu=0.0), alpha)
    bar = scenes.block((0, 0.4), (1, 0.6), 0.1)
    bar = bar.replace(temperature=torch.full_like(bar.mass, rise))
    for lower, expected in ((0.0, -E * alpha * rise), (-1.0, 0.0)):
        step = mpm.Step(mpm.Grid(0.1, (lower, 0), (1 - lower, 1)), law, walls="slip", transfer="pic")
        with torch.no_grad():
            end = mpm.rollout(step, bar, 2000, 4e-3)
        stress = float(law.stress(end)[:, 0, 0].mean())
        assert stress == pytest.approx(expected, rel=0.02, abs=0.02 * E * alpha * rise)
    width = end.x[:, 0].max() - end.x[:, 0].min()
    grown = width / (bar.x[:, 0].max() - bar.x[:, 0].min()) - 1
    assert float(grown) == pytest.approx(alpha * rise, rel=0.03)


def test_expansion_of_a_fluid_keeps_its_pressure_at_the_expanded_volume():
    law = mpm.ThermalExpansion(mpm.WeaklyCompressible(1e4), mpm.Table([0.0, 100.0], [0.0, 1e-3]))
    state = deformed(3)
    alpha = 1e-3 * (state.temperature / 100).clamp(0, 1)
    rest = state.replace(J=(1 + alpha * state.temperature) ** 3)
    assert float(law.stress(rest).abs().max()) < 1e-8


def test_plastic_law_inside_expansion_and_melting():
    """F_e from the law is returned as F, and its dissipation too, except for particles that flow."""

    class Returned(mpm.Material):
        def update(self, state):
            fields = {"F": 0.9 * state.F, "dissipated": torch.ones_like(state.mass)}
            return fields, 0.9 * state.F

    state = deformed(2)
    fields, _ = mpm.ThermalExpansion(Returned(), 1e-3).update(state)
    torch.testing.assert_close(fields["F"], 0.9 * state.F)
    assert float(fields["dissipated"].sum()) == len(state)
    state.extra["liquid"] = torch.tensor([0, 0, 0, 0, 0.5, 0.9, 1], dtype=torch.float64)
    fields, _ = mpm.Melting(Returned(), mpm.WeaklyCompressible(1e4)).update(state)
    torch.testing.assert_close(fields["F"][:5], 0.9 * state.F[:5])
    assert fields["dissipated"].tolist() == [1] * 5 + [0] * 2
    mixed = state.replace(material=torch.tensor([0, 1, 1, 0, 1, 1, 0], dtype=torch.int32))
    fields, _ = mpm.Mixture([Returned(), mpm.NeoHookean(E=1.0, nu=0.3)]).update(mixed)
    assert fields["dissipated"].tolist() == [1, 0, 0, 1, 0, 0, 1]


# ---- melting


def melting_state(dim, device="cpu"):
    state = deformed(dim, device)
    fraction = torch.tensor([0.0, 0.3, 0.79, 0.8, 0.95, 1.0, 0.0], dtype=torch.float64, device=device)
    return state.replace(extra={"liquid": fraction})


def test_melting_mixes_solid_and_liquid(device, dim):
    solid, liquid = mpm.NeoHookean(E=1e4, nu=0.3), mpm.WeaklyCompressible(2e4, gamma=3.0)
    state = melting_state(dim, device)
    fields, stress = mpm.Melting(solid, liquid, coherency=0.8).update(state)
    volume = torch.linalg.det(state.F)
    for p, f in enumerate(state.extra["liquid"].tolist()):
        J = state.J[p] if f >= 0.8 else volume[p]
        of_liquid = liquid.stress(state.replace(J=J.expand(7)))[p]
        weight = 1.0 if f >= 0.8 else f
        torch.testing.assert_close(stress[p], (1 - weight) * solid.stress(state)[p] + weight * of_liquid)
        kept = J ** (1 / dim) * torch.eye(dim, dtype=J.dtype, device=device) if f >= 0.8 else state.F[p]
        torch.testing.assert_close(fields["F"][p], kept)
        torch.testing.assert_close(torch.linalg.det(fields["F"][p]), fields["J"][p])


def test_what_freezes_has_no_shear_and_keeps_its_volume(dim):
    law = mpm.Melting(mpm.NeoHookean(E=1e4, nu=0.3), mpm.WeaklyCompressible(1e4))
    state = melting_state(dim)
    melted = state.replace(extra={"liquid": torch.ones(7, dtype=torch.float64)})
    fields, _ = law.update(melted)
    frozen = state.replace(**fields, extra={"liquid": torch.zeros(7, dtype=torch.float64)})
    stress = law.stress(frozen)
    pressure = stress.diagonal(dim1=1, dim2=2).mean(1)
    assert relative_error(stress, pressure[:, None, None] * torch.eye(dim, dtype=torch.float64)) < 1e-12
    torch.testing.assert_close(torch.linalg.det(frozen.F), state.J)


def test_gradients_through_melting_and_expansion(dim):
    state = melting_state(dim)
    fraction = state.extra["liquid"] * 0.7  # apart from the collapse, where the stress jumps

    def stress(F, J, theta, fraction, E, alpha):
        solid = mpm.ThermalExpansion(mpm.NeoHookean(E=E, nu=0.3), alpha)
        law = mpm.Melting(solid, mpm.WeaklyCompressible(1e4, gamma=2.0), coherency=0.69)
        given = state.replace(F=F, J=J, temperature=theta, extra={"liquid": fraction})
        fields, stress = law.update(given)
        return stress, fields["F"], fields["J"]

    inputs = [state.F, state.J, state.temperature, fraction]
    inputs += [torch.tensor(a, dtype=torch.float64) for a in (1e4, 1e-4)]
    assert torch.autograd.gradcheck(stress, [t.clone().requires_grad_() for t in inputs], rtol=1e-4)


def test_bad_melting():
    solid, liquid = mpm.NeoHookean(E=1e4, nu=0.3), mpm.WeaklyCompressible(1e4)
    with pytest.raises(ValueError, match="solid with the field F and a liquid with the field J"):
        mpm.Melting(liquid, solid)
    with pytest.raises(ValueError, match="coherency"):
        mpm.Melting(solid, liquid, coherency=0.0)
    with pytest.raises(ValueError, match="liquid"):
        mpm.Melting(solid, liquid).stress(deformed(2))
    state = melting_state(2)
    state.F[1] = torch.diag(torch.tensor([-1.0, 1.0]))
    state.J[5] = -1
    assert mpm.Melting(solid, liquid).invalid(state).tolist() == [False, True, False, False, False, True, False]


def test_functions_of_another_dtype(device):
    """A function of the temperature may return integers or float32."""
    state, grid = block(2, device=device), grid_around(2)
    state = state.replace(temperature=torch.linspace(0, 1, len(state), dtype=FLOAT, device=device))

    def steps(high, low, dtype):
        specific_heat = lambda t: torch.where(t > 0.5, high, low).to(dtype)  # noqa: E731
        heat = mpm.Heat(grid, lambda t: 1 + 0 * t.float(), specific_heat)
        return heat(state, 0.01).temperature

    integers, numbers = steps(4, 2, torch.int64), steps(4.0, 2.0, torch.float64)
    assert torch.allclose(integers, numbers, rtol=1e-12, atol=0)


def test_table_in_inference_mode():
    with torch.inference_mode():
        table = mpm.Table([0.0, 1.0], [1.0, 3.0])
        assert float(table(torch.tensor([0.5]))) == 2.0
    assert float(table(torch.tensor([0.25]))) == 1.5


def test_table_as_a_path():
    """Tables have forward mode, which the velocity of an obstacle on a path takes."""
    table = mpm.Table([0.0, 1.0, 2.0], [0.0, 2.0, 2.0])
    ball = mpm.Sphere(lambda t: torch.stack([table(t), 0 * t]), 0.1)
    still = ball.velocity_at(torch.zeros(1, 2, dtype=torch.float64), None, 0.5)
    assert still.reshape(-1).tolist() == [2.0, 0.0]
