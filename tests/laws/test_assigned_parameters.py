"""Parameters that are assigned to a law are those that its constructor would take, or the same error."""

import copy
import pickle

import pytest
import torch
from torch import nn

import torch_mpm as mpm
from benchmarks.catalogue.laws import LAWS
from benchmarks.catalogue.scenes import blob, unit_box
from torch_mpm.laws import CompiledLaw
from torch_mpm.laws.compiled import MODULI

NAMES = [name for name, law in LAWS.items() if isinstance(law(), CompiledLaw)]


def parameters(law):
    """Attributes of a law that hold its parameters."""
    return [name for name in law._stored() if law._range(name) is not None]


def stress(law, **changes):
    step = mpm.Step(unit_box(2), law)
    state = step.prepare(blob("cpu", 2, 40).replace(**changes))
    F = state.F if state.F is None else state.F + 0.02 * torch.rand(40, 2, 2, dtype=torch.float64)
    return law.stress(state.replace(F=F, J=state.J if state.J is None else state.J * 0.98))


@pytest.mark.parametrize("name", NAMES)
def test_bad_values_are_errors(name):
    law = LAWS[name]()
    assert parameters(law)
    for parameter in parameters(law):
        before = getattr(law, parameter)
        bad = [float("nan"), float("inf"), torch.tensor(float("nan")), torch.zeros(2, 2), torch.tensor(3)]
        bad += [] if parameter == "lam" else [-2.0, torch.tensor([0.1, -2.0], dtype=torch.float64)]
        label = "viscosity" if parameter == "eta" else parameter
        for value in bad:
            with pytest.raises(ValueError, match=f"^{label} must be"):
                setattr(law, parameter, value)
        for value in ("1", None, [1.0], law):
            with pytest.raises((TypeError, ValueError), match=f"^{label} must be"):
                setattr(law, parameter, value)
        assert getattr(law, parameter) is before


@pytest.mark.parametrize("form", ["number", "tensor", "leaf", "per particle", "table"])
@pytest.mark.parametrize("name", NAMES)
def test_assigned_values_are_those_of_the_constructor(name, form):
    """In the stress, in each form, after a value of each other form."""
    law = LAWS[name]()
    parameter = "E" if "E" in parameters(law) else parameters(law)[0]
    number = 1.3 * float(getattr(law, parameter))
    values = {
        "number": number,
        "tensor": torch.tensor(number, dtype=torch.float64),
        "leaf": nn.Parameter(torch.tensor(number, dtype=torch.float64)),
        "per particle": torch.full((40,), number, dtype=torch.float64),
        "table": mpm.Table([0.0, 1.0], [number, number]),
    }
    torch.manual_seed(1)
    temperature = torch.full((40,), 0.5, dtype=torch.float64)
    made = LAWS[name].make(**(LAWS[name].arguments() | {parameter: number}))
    expected = stress(made, temperature=temperature)
    for value in (*values.values(), values[form]):
        setattr(law, parameter, value)
    assert law.has_functions == (form == "table")
    assert (parameter in dict(law.named_parameters())) == (form == "leaf")
    assert (parameter in dict(law.named_buffers())) == (form in ("tensor", "per particle"))
    torch.manual_seed(1)
    torch.testing.assert_close(stress(law, temperature=temperature).detach(), expected)


def test_a_fluid_becomes_viscous():
    law = mpm.WeaklyCompressible(1e4)
    assert not law.viscous
    law.eta = 5.0
    assert law.viscous and law.values()[-1] == 5.0
    with pytest.raises(AttributeError, match="assign the parameter as eta"):
        law.viscosity = 5.0


def test_laws_are_copied_and_pickled():
    for law in (mpm.QuarticSand(E=1e4, nu=0.3, hardening=(0.6, 0.1, 0.2, 0.3)), mpm.WeaklyCompressible(1e4, 7.0, 1.0)):
        law.__setattr__(parameters(law)[0], 2e4)
        for other in (copy.deepcopy(law), pickle.loads(pickle.dumps(law))):
            assert other.values() == law.values() and other.name == law.name


def test_ranges_of_moduli_are_those_of_the_constructor():
    for name, (_, holds) in MODULI.items():
        assert bool(holds(0.2)) and (name == "lam" or not bool(holds(-1.5)))
