"""Calls of descendants with their own argument names: a script passes them by name or by position."""

import inspect

import pytest

from torch_mpm.compat import mpm_pytorch, taichi_elements, warp_mpm
from torch_mpm.compat.physgaussian import DIALECTS, BatchedSimulator, MPM_Simulator_WARP
from torch_mpm.compat.physgaussian.views import ModelView, ParticleView

SIMULATOR = {
    "print_time_profile": "",
    "reset_pos_from_torch": "tensor_x tensor_volume tensor_cov device",
    "enforce_grid_velocity_by_mask": "selection_mask",
    "release_particles_sequentially_size": (
        "normal start_position end_position num_layers start_time end_time size point"
    ),
    "set_E_nu": "E nu device",
    "set_E_nu_from_torch": "E nu device",
    "add_impulse_on_particles_with_mask": "force particle_mask start_time end_time point size",
    "tear_object": "force dt num_dt bbox axis start_time device",
    "add_impulse_on_object": "force dt point size num_dt start_time device",
    "enforce_scene_velocity_translation": "velocity start_time end_time device",
    "finalize_mu_lam_bulk": "device",
    "export_particle_stress_to_torch": "",
    "debug_particle_positions": "step_name",
    "p2g2p": "step dt device flip_pic_ratio flip_pic",
    "set_velocity_by_index": "point size velocity start_time end_time reset",
    "material_2_num": "material",
    "add_constant_force": "force point radius start_time end_time",
}
BATCHED = {
    "initialize": "n_particles batch_size dx grid_lim device",
    "load_from_sampling": "sampling_h5 batch_size dx grid_lim fps device",
    "load_initial_data_from_torch": "tensor_x tensor_volume tensor_cov batch_size dx grid_lim device",
}
STATE = {
    "init": "shape device requires_grad",
    "init_grid": "grid_res device requires_grad",
    "from_torch": "tensor_x tensor_volume tensor_cov tensor_velocity n_grid grid_lim device requires_grad",
    "reset_state": "tensor_x tensor_cov tensor_velocity tensor_density selection_mask device requires_grad",
    "continue_from_torch": "tensor_x tensor_velocity tensor_F tensor_C device requires_grad",
    "reset_density": "tensor_density selection_mask device requires_grad update_mass",
    "partial_clone": "device requires_grad",
    "set_require_grad": "requires_grad",
}
MODEL = {
    "init": "shape device requires_grad",
    "init_other_params": "n_grid grid_lim device",
    "from_torch": "tensor_E tensor_nu device requires_grad",
    "finalize_mu_lam": "n_particles device",
    "set_require_grad": "requires_grad",
}
SOLVER = {
    "set_parameters_dict": "mpm_model mpm_state kwargs device",
    "set_E_nu": "mpm_model E nu device",
    "set_E_nu_from_torch": "mpm_model E nu gamma kappa device",
    "prepare_mu_lam": "mpm_model mpm_state device",
    "p2g2p_differentiable": "mpm_model mpm_state next_state dt device",
    "p2g2p": "mpm_model mpm_state step dt device",
    "enforce_particle_velocity_by_mask": "mpm_state selection_mask velocity start_time end_time",
    "enforce_grid_velocity_by_mask": "selection_mask",
    "add_impulse_on_particles_with_mask": ("mpm_state force dt particle_mask point size end_time start_time device"),
    "restart_and_compute_F_C": "mpm_model mpm_state target_pos device",
}
ELEMENTS = {
    "add_cube": "lower_corner cube_size material color sample_density velocity",
    "add_ellipsoid": "center radius material color sample_density velocity",
    "add_ngon": "sides center radius angle material color sample_density velocity",
    "add_particles": "particles material color velocity emmiter_id",
    "add_surface_collider": "point normal surface friction",
    "add_sphere_collider": "center radius surface",
    "step": "frame_dt print_stat smry_writer",
    "particle_info": "",
    "add_mesh": "triangles material color sample_density velocity translation emmiter_id",
    "read_restart": "num_particles pos vel material color",
    "write_particles": "fn slice_size",
    "write_particles_ply": "fn",
}
CLASSES = [
    (MPM_Simulator_WARP, SIMULATOR),
    (BatchedSimulator, BATCHED),
    (warp_mpm.MPMStateStruct, STATE),
    (warp_mpm.MPMModelStruct, MODEL),
    (warp_mpm.MPMWARPDiff, SOLVER),
    (taichi_elements.MPMSolver, ELEMENTS),
    (mpm_pytorch.MPMModel, {"__init__": "sim_params material_params init_pos enable_train device"}),
]


@pytest.mark.parametrize(("owner", "calls"), CLASSES, ids=lambda v: getattr(v, "__name__", ""))
def test_arguments(owner, calls):
    for name, arguments in calls.items():
        found = list(inspect.signature(getattr(owner, name)).parameters)[1:]
        assert found == arguments.split(), name


def test_arrays_and_numbers():
    """Names of `mpm_state` and `mpm_model` that scripts of descendants read."""
    state = "particle_x particle_cov particle_R particle_F particle_Jp particle_material particle_density"
    model = "E nu mu lam bulk yield_stress friction_angle plastic_viscosity material n_grid inv_dx mu_N lam_N viscosity"
    assert {*state.split(), "object_selection", "particle_selection"} <= {*ParticleView._names}
    assert {*model.split(), "beta"} <= {*ModelView._names}


def test_every_material_has_a_number():
    for dialect in DIALECTS.values():
        assert set(dialect.materials) <= set(dialect.codes), dialect.name
