"""Substeps that are computed together later: writes in between, copies of given tensors, and times."""

import numpy as np
import pytest
import torch
from compat.restated_simulator import DT, LIM, N, blob

from torch_mpm.compat.physgaussian import MPM_Simulator_WARP
from torch_mpm.compat.warp_mpm import MPMModelStruct, MPMStateStruct, MPMWARPDiff

DENSITY = 500.0


class PhysGaussian:
    """The simulator with particles at rest and no gravity."""

    def __init__(self, device):
        x, volume = (torch.tensor(a, device=device) for a in blob())
        self.sim = MPM_Simulator_WARP(len(x))
        self.sim.load_initial_data_from_torch(x, volume, n_grid=N, grid_lim=LIM)
        self.sim.set_parameters_dict({"material": "jelly", "E": 1e5, "nu": 0.3, "density": DENSITY})
        self.sim.finalize_mu_lam()
        self.state = self.sim.mpm_state

    def step(self):
        self.sim.p2g2p(0, DT)

    def push(self, force, num_dt):
        self.sim.add_impulse_on_particles(force, DT, (0.5,) * 3, (1.0,) * 3, num_dt, self.sim.time)


class WarpMPM:
    """The same with structs."""

    def __init__(self, device):
        x, volume = (torch.tensor(a, device=device) for a in blob())
        self.state, self.model, self.sim = MPMStateStruct(), MPMModelStruct(), MPMWARPDiff(len(x))
        self.state.init(len(x), device=device)
        self.state.from_torch(x, volume, None, torch.zeros_like(x), n_grid=N, grid_lim=LIM)
        self.model.init(len(x), device=device)
        self.model.init_other_params(n_grid=N, grid_lim=LIM, device=device)
        self.sim.set_parameters_dict(self.model, self.state, {"material": "jelly", "density": DENSITY})
        self.sim.set_E_nu(self.model, 1e5, 0.3, device)
        self.sim.prepare_mu_lam(self.model, self.state, device)

    def step(self):
        self.sim.p2g2p(self.model, self.state, 0, DT)

    def push(self, force, num_dt):
        self.sim.add_impulse_on_particles(self.state, force, DT, (0.5,) * 3, (1.0,) * 3, num_dt, self.sim.time)


DOORS = [PhysGaussian, WarpMPM]


@pytest.mark.parametrize(
    "name", ["particle_x", "particle_v", "particle_F", "particle_C", "particle_vol", "particle_mass"]
)
@pytest.mark.parametrize("door", DOORS)
def test_arrays_that_are_written_to_before_pending_substeps(door, name, device):
    """The write came after the substep, which would be computed with the new values."""
    one = door(device)
    array = getattr(one.state, name)
    one.step()
    array.mul_(1.01)
    with pytest.raises(RuntimeError, match=f"mpm_state.{name}.* must not be written to while 1 substeps are pending"):
        _ = one.state.particle_x


@pytest.mark.parametrize("door", DOORS)
def test_arrays_may_be_written_to_after_substeps(door, device):
    one, other = door(device), door(device)
    one.step()
    one.state.particle_v.add_(0.5)
    one.step()
    other.step()
    other.state.particle_v = other.state.particle_v + 0.5
    other.step()
    assert torch.equal(one.state.particle_x, other.state.particle_x)


@pytest.mark.parametrize("name", "xvFC")
def test_imported_tensors_are_copied(name, device):
    """A buffer of the caller may change after the import, as with the `clone` of the original."""
    one = PhysGaussian(device)
    value = getattr(one.state, f"particle_{name}").clone() + 0.01
    expected, put = value.clone(), getattr(one.sim, f"import_particle_{name}_from_torch")
    put(value)
    value.zero_()
    assert torch.equal(getattr(one.state, f"particle_{name}"), expected)
    put(value, clone=False)
    value.add_(1.0)
    assert torch.equal(getattr(one.state, f"particle_{name}"), value)


@pytest.mark.parametrize("which", [0, 1])
def test_loaded_tensors_are_copied(which):
    """A buffer of positions or volumes may be filled with those of the next simulation."""
    given = [torch.tensor(a) for a in blob()]
    expected, sim = [t.clone() for t in given], MPM_Simulator_WARP(len(given[0]))
    sim.load_initial_data_from_torch(*given, n_grid=N, grid_lim=LIM)
    given[which].zero_()
    assert torch.equal((sim.mpm_state.particle_x, sim.mpm_state.particle_vol)[which], expected[which])


@pytest.mark.parametrize("before", range(1, 13))
@pytest.mark.parametrize("door", DOORS)
def test_impulses_from_the_present_time_act_in_their_number_of_substeps(door, before):
    """v = n dt f/m of a body that is free; its time after some pending substeps is their sum."""
    one, force, count = door("cpu"), np.array([0.01, 0.0, 0.02]), 3
    for _ in range(before):
        one.step()
    assert one.sim.time == sum([DT] * before)
    one.push(force.tolist(), count)
    for _ in range(count + 2):
        one.step()
    momentum = (one.state.particle_mass[:, None] * one.state.particle_v).sum(0).numpy()
    np.testing.assert_allclose(momentum, len(one.state.particle_x) * count * DT * force, rtol=1e-9, atol=1e-15)
