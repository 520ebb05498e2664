"""Tables of laws that read the temperature, as the fused op takes them: made once, as long as nothing changes, and
without waiting for the device."""

import pytest
import torch
from heat_scenes import DT, SOFTENING, held, terms, thermal

import torch_mpm as mpm
from torch_mpm import heat_boundaries

EXPANSION = mpm.Table([0.0, 5.0], [1e-3, 2e-3])


def wax(coefficient=1e-3, E=SOFTENING, viscosity=5.0):
    liquid = mpm.WeaklyCompressible(1e5, viscosity=viscosity)
    return mpm.ThermalExpansion(mpm.Melting(mpm.NeoHookean(E=E, nu=0.3), liquid, 0.5), coefficient)


def of_wax(device="cpu", dtype=torch.float64, scenes=1, **values):
    """A step and a state of a material that expands and melts, on a plate that is held hot, and which radiates."""
    step, state = thermal(["wax"], dim=2, dtype=dtype, scenes=scenes, deterministic=True)
    step.law = wax(**values)
    plate = mpm.Box((0.5, 0.05), (1.0, 0.45), "sticky")
    step.boundaries = [plate]
    held(step, (heat_boundaries.FixedSurface, plate, torch.linspace(20.0, 30.0, scenes, dtype=torch.float64)))
    exchange = terms(scenes)
    step.heat.boundaries = [*step.heat.boundaries.entries, *exchange["convection"], *exchange["radiation"]]
    return step.to(device), state.to(device=device)


def tables(step, state):
    return mpm.substeps_arguments(step, state, 2, DT)["tables"]


@pytest.mark.parametrize("coefficient", ["number", "tensor", "table"])
def test_tables_are_those_of_the_previous_call(coefficient, device):
    of = {"number": 1e-3, "tensor": torch.tensor(1e-3, dtype=torch.float64), "table": EXPANSION}
    step, state = of_wax(device, torch.float32, coefficient=of[coefficient])
    first = tables(step, state)
    assert len(first) == 4 and all(t.dtype == torch.float32 and t.device == state.x.device for t in first)
    with torch.inference_mode():  # as data are generated
        state = mpm.rollout(step, state, 2, DT)
        again = tables(step, state)
    assert all(a is b for a, b in zip(tables(step, state), first, strict=True))
    assert all(a is b for a, b in zip(again, first, strict=True))
    assert not any(t.is_inference() for t in first)


def test_tables_of_another_dtype():
    """Those of the particles, each in its precision."""
    step, state = of_wax(coefficient=1e-3)
    one, state = tables(step, state), state.to(dtype=torch.float32)
    other = tables(step, state)
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a.float(), b) and b.dtype == torch.float32


@pytest.mark.parametrize("material", ["melts", "expands", "both"])
def test_diagnostics_are_those_of_the_law(material, device):
    """The values of a step, whose parts are computed once for all of them, and those of the methods of the law, which
    are computed one by one; for solid, softened, flowing and hot particles."""
    step, state = of_wax(device, coefficient=EXPANSION, viscosity=mpm.Table([0.0, 5.0], [10.0, 1.0]))
    law = {"melts": step.law.law, "expands": mpm.ThermalExpansion(step.law.law.solid, EXPANSION), "both": step.law}
    step.law = law[material]
    generator = torch.Generator(device).manual_seed(0)
    spread = torch.rand(len(state), generator=generator, dtype=torch.float64, device=device)
    state = step.prepare(state).replace(temperature=8 * spread - 1, J=1 + 0.1 * spread)
    state.extra["liquid"] = (2 * spread - 0.5).clamp(0, 1)
    found = step.diagnostics(state)
    values = step.law.stress(state), step.law.stiffness(state), step.law.energy_density(state)
    for value, expected in zip(found, values, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("trained", ["expansion", "table of the expansion", "modulus", "viscosity"])
def test_gradients_reach_the_values_after_calls_without(trained, device):
    """A table that was kept without gradients does not stand in their way, nor does a previous call with them."""
    number = torch.tensor(1e-3, dtype=torch.float64, device=device, requires_grad=True)
    values = {
        "table of the expansion": [1e-3, 2e-3], "modulus": [2e5, 1e5, 1e4], "viscosity": [10.0, 1.0]
    }.get(trained, [])  # fmt: skip
    leaf = torch.tensor(values, dtype=torch.float64, device=device, requires_grad=True) if values else number
    name = {"modulus": "E", "viscosity": "viscosity"}.get(trained, "coefficient")
    knots = [-10.0, 2.0, 20.0] if len(values) == 3 else [0.0, 5.0]
    step, state = of_wax(device, **{name: mpm.Table(knots, leaf) if values else leaf})
    if trained == "viscosity":
        state = state.replace(extra=state.extra | {"liquid": torch.ones_like(state.mass)})
    with torch.no_grad():
        mpm.rollout(step, state, 3, DT)
    grads = []
    for _ in range(2):
        end = mpm.rollout(step, state, 3, DT)
        (grad,) = torch.autograd.grad(end.v.square().sum(), leaf)
        grads.append(grad)
    assert grads[0].abs().max() > 0
    torch.testing.assert_close(grads[1], grads[0], rtol=1e-9, atol=0)
    with torch.no_grad():
        assert not any(t.requires_grad for t in tables(step, state))
    leaf.requires_grad_(False)
    assert not mpm.rollout(step, state, 3, DT).x.requires_grad


def test_a_function_between_knots_is_refused_with_gradients_too():
    """As without: the square of a linear function is none."""
    value = torch.tensor([1e2, 1e3], dtype=torch.float64, requires_grad=True)

    class Squared(mpm.NeoHookean):
        def values(self):
            mu, lam = super().values()
            return mu * mu, lam

    step, state = thermal(["softening"], dim=2)
    step.law = Squared(E=mpm.Table([0.0, 10.0], value), nu=0.3)
    with pytest.raises(ValueError, match="a parameter of the law is a function"):
        tables(step, state)


# ---- on a GPU


@pytest.mark.parametrize("trained", [False, True])
def test_a_rollout_of_melting_material_asks_the_device_nothing(trained, device):
    """Neither do the sorting and the report between its calls."""
    if device == "cpu":
        pytest.skip("the CPU does not wait for itself")
    expansion = torch.tensor([1e-3, 2e-3], device=device, requires_grad=trained)
    viscosity = mpm.Table([0.0, 5.0], [10.0, 1.0])
    step, state = of_wax(
        device, torch.float32, 3, coefficient=mpm.Table([0.0, 5.0], expansion), E=SOFTENING, viscosity=viscosity
    )

    def calls(state):
        with torch.set_grad_enabled(trained):
            end = mpm.rollout(step, state, 8, DT)
            if trained:
                torch.autograd.grad(end.v.square().sum(), expansion)
        with torch.no_grad():
            end = step.sorted(end.detach())
            return end, step.stability_report(end)

    for _ in range(2):
        state, _ = calls(state)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        calls(state)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    step.check()
