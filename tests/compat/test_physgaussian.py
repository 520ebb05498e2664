"""The class of PhysGaussian's simulator against its published step, restated in NumPy."""

import json

import numpy as np
import pytest
import torch
from compat.restated import lame, rotations_svd
from compat.restated_simulator import DT, LIM, N, Restated, blob, bounding_box, floor, pair, run, shear

import torch_mpm as mpm
from torch_mpm.compat.physgaussian import MPM_Simulator_WARP, decode_param_json, set_boundary_conditions

MATERIALS = {
    "jelly": {},
    "metal": {"yield_stress": 2e3, "hardening": 1, "xi": 0.05},
    "plasticine": {"yield_stress": 2e3, "softening": 2e4},
    "foam": {"yield_stress": 1e3, "plastic_viscosity": 10.0},
    "sand": {"friction_angle": 30},
}


@pytest.mark.parametrize("material", MATERIALS)
def test_trajectories_of_the_materials(material, device):
    """A sheared cube falls on a sticky floor: 100 substeps, much closer than 1e-4 of the domain."""
    common = {"material": material, "E": 1e5, "nu": 0.3, "density": 500.0, "g": [0, 0, -9.8]}
    sim, own = pair(common | MATERIALS[material], shear, device)
    sim.add_surface_collider((0.5, 0.5, 0.33), (0.0, 0.0, 2.0))
    sim.add_bounding_box()
    sim.finalize_mu_lam()
    own.on_nodes += [floor(0.33), bounding_box]
    x = run(sim, own)
    moved = np.abs(own.x - blob()[0]).max()
    error = np.abs(x - own.x).max()
    assert moved > 0.03 and error < 1e-11 * LIM
    if material in ("metal", "plasticine"):
        assert np.abs(own.limit - MATERIALS[material]["yield_stress"]).max() > 1  # it has flowed
        np.testing.assert_allclose(sim.state.extra["yield_stress"].cpu().numpy(), own.limit, rtol=1e-6)
    if material == "plasticine":
        assert 0 < (own.mu == 0).sum() < len(x)  # and some of it is broken
    sim.step.check(sim.state)


def test_operations_on_particles_and_nodes(device):
    """Impulses, held and turning particles, sequential release, a moving cuboid with reset, RPIC and damped nodes."""
    parameters = {"E": 1e5, "nu": 0.3, "density": 500.0, "g": [0.0, 0.0, -3.0]}
    damping = {"rpic_damping": 0.3, "grid_v_damping_scale": 0.998}
    sim, own = pair(parameters | damping, shear, device)
    x0 = own.x.copy()
    sim.add_impulse_on_particles([0.5, 0.0, 0.2], DT, [0.4, 0.5, 0.5], [0.1, 1, 1], num_dt=10, start_time=0.002)
    sim.enforce_particle_velocity_translation([0.5, 0.5, 0.6], [1, 1, 0.05], [0.0, 0.4, 0.0], 0.0, 0.01)
    sim.enforce_particle_velocity_rotation([0.5, 0.5, 0.36], [0, 0, 3.0], [0.05, 0.2], 5.0, 0.3, 0.004, 0.016)
    sim.release_particles_sequentially([0, 1, 0], 0.6, 0.35, 7, 0.0, 0.01)
    sim.set_velocity_on_cuboid([0.3, 0.475, 0.475], [0.1, 0.1, 0.1], [1.0, 0, 0], 0.001, 0.012, reset=1)
    sim.add_bounding_box()
    sim.finalize_mu_lam()

    def push(sim, dt):
        if 0.002 <= sim.time < 0.002 + 10 * DT:
            chosen = np.abs(x0[:, 0] - 0.4) < 0.1
            sim.v[chosen] += dt * np.array([0.5, 0.0, 0.2]) / sim.mass[chosen, None]

    def slide(sim, dt):
        if sim.time < 0.01:
            sim.v[np.abs(x0[:, 2] - 0.6) < 0.05] = [0, 0.4, 0]

    def turn(sim, dt):
        first = x0 - [0.5, 0.5, 0.36]
        chosen = (np.abs(first[:, 2]) < 0.05) & (np.hypot(first[:, 0], first[:, 1]) < 0.2)
        if 0.004 <= sim.time < 0.016:
            arm = sim.x - [0.5, 0.5, 0.36]
            turned = np.stack([5 * arm[:, 1], -5 * arm[:, 0], 0 * arm[:, 0] + 0.3], 1)
            sim.v[chosen] = turned[chosen]

    def layers(sim, dt):
        for k in range(50):
            inside = (np.abs(x0[:, 1] - 0.35) < 0.25 / 50 * (50 - k)) & (np.abs(x0[:, [0, 2]] - 1) < 1).all(1)
            if sim.time < 0.01 / 50 * (k + 1):
                sim.v[inside] = 0

    def cuboid(sim, v, dt):
        if 0.001 <= sim.time < 0.012:
            centre = np.array([0.3 + (sim.time - 0.001), 0.475, 0.475])
            v[(np.abs(sim.nodes - centre) < 0.1 - 1e-9).all(1)] = [1.0, 0, 0]
        elif sim.time < 0.012 + 15 * dt:
            v[:] = 0

    own.options |= damping
    own.before += [push, slide, turn, layers]
    own.on_nodes += [cuboid, bounding_box]
    x = run(sim, own)
    assert np.abs(x - own.x).max() < 1e-8
    assert np.abs(own.x - x0).max() > 5e-3
    assert sim.time == pytest.approx(own.time, rel=1e-12)


def test_pic_and_boxes_of_material(device):
    """Without C in P2G, and with stiffness and density that differ in a box."""
    box = {"point": [0.5, 0.5, 0.6], "size": [1.0, 1.0, 0.12], "E": 4e5, "nu": 0.2, "density": 900.0}
    parameters = {"E": 1e5, "nu": 0.3, "density": 500.0, "rpic_damping": -1.0}
    sim, own = pair(parameters | {"additional_material_params": [box]}, shear, device)
    inside = np.abs(own.x[:, 2] - 0.6) < 0.12
    assert 0 < inside.sum() < len(inside)
    E, nu = np.where(inside, 4e5, 1e5), np.where(inside, 0.2, 0.3)
    own.mu, own.lam = lame(E, nu)
    own.mass = np.where(inside, 900.0, 500.0) * own.volume
    sim.finalize_mu_lam()
    assert np.abs(run(sim, own, 50) - own.x).max() < 1e-8


def test_exports_for_gaussians(device):
    """R transposed and F Σ Fᵀ of the current F, against NumPy; the pieces of the other exports."""
    sim, own = pair({"E": 1e4, "nu": 0.3, "density": 500.0}, shear, device)
    factors = np.random.default_rng(1).normal(size=(len(own.x), 3, 3))
    sigma = factors @ factors.transpose(0, 2, 1)
    upper = np.triu_indices(3)
    six = torch.tensor(sigma[:, upper[0], upper[1]], device=device)
    state = sim.state
    sim.load_initial_data_from_torch(state.x, state.volume, six, n_grid=N, grid_lim=LIM)
    sim.import_particle_v_from_torch(state.v)
    sim.set_parameters_dict({"E": 1e4, "nu": 0.3, "density": 500.0})
    sim.finalize_mu_lam()
    run(sim, own, 60)
    U, s, Vh = rotations_svd(own.F)
    assert np.abs(s - 1).max() > 0.01
    np.testing.assert_allclose(
        sim.export_particle_R_to_torch().cpu().numpy(), (U @ Vh).transpose(0, 2, 1).reshape(-1, 9), atol=1e-9
    )
    expected = own.F @ sigma @ own.F.transpose(0, 2, 1)
    np.testing.assert_allclose(
        sim.export_particle_cov_to_torch().cpu().numpy(), expected[:, upper[0], upper[1]].reshape(-1), atol=1e-8
    )
    for name, value in (("v", own.v), ("C", own.C.reshape(-1, 9)), ("F", own.F.reshape(-1, 9))):
        exported = getattr(sim, f"export_particle_{name}_to_torch")()
        np.testing.assert_allclose(exported.cpu().numpy(), value, atol=1e-7)


@pytest.mark.parametrize("material", ["jelly", "metal", "foam"])
def test_gradients_reach_the_parameters_and_the_start(material, device):
    """By E and by the initial velocity, against central differences of the whole run."""
    x, volume = blob(4)
    x, volume = torch.tensor(x, device=device), torch.tensor(volume, device=device)
    start = torch.tensor(shear(x.cpu().numpy()), device=device)

    def loss(E, push):
        sim = MPM_Simulator_WARP(10)
        sim.load_initial_data_from_torch(x, volume, n_grid=N, grid_lim=LIM)
        sim.import_particle_v_from_torch(start * push)
        options = {"E": E, "nu": 0.3, "density": 500.0, "yield_stress": 1e3, "plastic_viscosity": 10.0}
        sim.set_parameters_dict({"material": material, **options})
        sim.finalize_mu_lam()
        for k in range(10):
            sim.p2g2p(k, 2e-3)
        return (sim.export_particle_x_to_torch() ** 2 * torch.arange(1.0, 4.0, device=device)).sum()

    E = torch.tensor(1e5, dtype=torch.float64, device=device, requires_grad=True)
    push = torch.tensor(1.0, dtype=torch.float64, device=device, requires_grad=True)
    grads = torch.autograd.grad(loss(E, push), (E, push))
    with torch.no_grad():
        for k, (value, grad) in enumerate(zip((E, push), grads, strict=True)):
            h = 1e-5 * value
            arguments = [(E + h, push), (E - h, push)] if k == 0 else [(E, push + h), (E, push - h)]
            plus, minus = (loss(*a) for a in arguments)
            assert float(grad) == pytest.approx(float((plus - minus) / (2 * h)), rel=2e-4)


def test_configuration_runs_as_it_stands(tmp_path, device):
    """A JSON file in the published form, its defaults, and a float32 run beside the restated one."""
    file = tmp_path / "config.json"
    conditions = [
        {"type": "bounding_box"},
        {"type": "cuboid", "point": [0.5, 0.5, 0.35], "size": [0.5, 0.5, 0.05], "velocity": [0, 0, 0], "reset": 1},
        {"type": "particle_impulse", "force": [-0.2, 0.0, 0.0], "num_dt": 3},
    ]
    words = {"E": 2e5, "n_grid": N, "grid_lim": LIM, "g": [0, 0, -1], "substep_dt": DT, "frame_dt": 5e-3}
    file.write_text(json.dumps(words | {"boundary_conditions": conditions, "frame_num": 4}))
    material, boundaries, time, preprocessing, camera = decode_param_json(file)
    assert material["material"] == "jelly" and material["nu"] == 0.4 and material["density"] == 200.0
    assert time == {"substep_dt": DT, "frame_dt": 5e-3, "frame_num": 4}
    assert preprocessing["opacity_threshold"] == 0.02 and camera["default_camera_index"] == 0

    x, volume = blob()
    sim = MPM_Simulator_WARP(10)
    sim.load_initial_data_from_torch(
        torch.tensor(x, dtype=torch.float32, device=device),
        torch.tensor(volume, dtype=torch.float32, device=device),
        n_grid=material["n_grid"],
        grid_lim=material["grid_lim"],
    )
    sim.set_parameters_dict(material)
    set_boundary_conditions(sim, boundaries, time)
    sim.finalize_mu_lam()
    own = Restated(x, volume, 200.0, E=2e5, nu=0.4, g=(0, 0, -1))

    def push(sim, dt):
        if sim.time < 3 * DT:
            sim.v += dt * np.array([-0.2, 0, 0]) / sim.mass[:, None]

    def hold(sim, v, dt):
        v[(np.abs(sim.nodes - [0.5, 0.5, 0.35]) < np.array([0.5, 0.5, 0.05]) - 1e-9).all(1)] = 0

    own.before.append(push)
    own.on_nodes += [bounding_box, hold]
    assert np.abs(run(sim, own) - own.x).max() < 1e-5


def test_a_cut_and_reset_before_the_start(device):
    """The surface "cut" lets part of the nodes move; a cuboid with reset holds all nodes before it starts."""
    sim, own = pair({"E": 1e5, "nu": 0.3, "density": 500.0, "g": [20.0, 9.0, -60.0]}, shear, device)
    sim.add_surface_collider((0.45, 0.5, 0.5), (-1.0, 0.0, 0.0), "cut")
    sim.set_velocity_on_cuboid((0.1, 0.1, 0.1), (0.04, 0.04, 0.04), (0.0, 0.0, 0.0), 0.004, 0.014, reset=1)
    sim.finalize_mu_lam()

    def cut(sim, v, dt):
        behind = 0.45 - sim.nodes[:, 0] < -1e-9
        between = (sim.nodes[:, 2] >= 0.4 - 1e-9) & (sim.nodes[:, 2] <= 0.53)
        v[behind & between] *= [0.3, 0, 0.3]
        v[behind & ~between] = 0

    def hold(sim, v, dt):
        if not 0.004 <= sim.time < 0.014 and sim.time < 0.014 + 15 * dt:
            v[:] = 0

    own.on_nodes += [cut, hold]
    assert np.abs(run(sim, own) - own.x).max() < 1e-8
    assert np.abs(own.x - blob()[0]).max() > 1e-3


def test_a_sampling_file_is_loaded(tmp_path):
    h5py = pytest.importorskip("h5py")
    x, volume = blob()
    with h5py.File(tmp_path / "points.h5", "w") as file:
        file["x"], file["particle_volume"] = x.T, volume[None]
    sim = MPM_Simulator_WARP(10)
    sim.load_from_sampling(str(tmp_path / "points.h5"), n_grid=N)
    np.testing.assert_allclose(sim.export_particle_x_to_torch().numpy(), x, rtol=1e-6)
    assert sim.state.volume.numpy() == pytest.approx(volume) and sim.parameters["n_grid"] == N


def test_substeps_are_taken_together(device):
    """They run in one op, results read in between are correct, and a change acts from its time on."""
    sim, _ = pair({"E": 1e5, "nu": 0.3, "density": 500.0}, shear, device)
    sim.finalize_mu_lam()
    sim.add_bounding_box()
    other, _ = pair({"E": 1e5, "nu": 0.3, "density": 500.0}, shear, device)
    other.finalize_mu_lam()
    other.add_bounding_box()
    assert sim.step.explain(sim.state, DT).startswith("all steps in one op")
    for k in range(30):
        sim.p2g2p(k, DT)
        other.p2g2p(k, DT)
        other.export_particle_x_to_torch()
        if k == 20:
            for one in (sim, other):
                one.set_parameters_dict({"g": [0, 0, -9.8]})
    assert sim.time == pytest.approx(30 * DT)
    torch.testing.assert_close(sim.export_particle_x_to_torch(), other.export_particle_x_to_torch(), rtol=0, atol=1e-13)


def test_what_cannot_be_done_is_said():
    x, volume = (torch.tensor(a) for a in blob(2))
    sim = MPM_Simulator_WARP(10)
    with pytest.raises(ValueError, match="call load_initial_data_from_torch first"):
        sim.export_particle_x_to_torch()
    with pytest.raises(ValueError, match=r"tensor_x must have shape \[P, 3\], got \[8, 2\]"):
        sim.load_initial_data_from_torch(x[:, :2], volume)
    sim.load_initial_data_from_torch(x, volume)
    with pytest.raises(ValueError, match="call set_parameters_dict and finalize_mu_lam before p2g2p"):
        sim.p2g2p(0, 1e-4)
    sim.set_parameters_dict({"E": 1e4, "nu": 0.3, "material": "snow"})
    with pytest.raises(ValueError, match="'snow' has no stress"):
        sim.finalize_mu_lam()
    sim.set_parameters_dict({"material": "jello"})
    with pytest.raises(TypeError, match=r"material must be one of .*, got 'jello'"):
        sim.finalize_mu_lam()
    sim.set_parameters_dict({"material": mpm.Snow(E=1e4, nu=0.2)})
    sim.finalize_mu_lam()
    with pytest.raises(ValueError, match="no mass: give density"):
        sim.p2g2p(0, 1e-4)
    with pytest.raises(TypeError, match=r"g must be three numbers, got 9.8"):
        sim.set_parameters_dict({"g": 9.8})
    with pytest.raises(ValueError, match=r"friction must be 0 on sticky surfaces, got 0.5"):
        sim.add_surface_collider((0, 0, 0), (0, 0, 1), friction=0.5)
    with pytest.warns(UserWarning, match="stops the nodes behind it"):
        sim.add_surface_collider((0, 0, 0), (0, 0, 1), "slip")
    with pytest.raises(TypeError, match=r"type of a boundary condition must be one of .*, got 'wind'"):
        set_boundary_conditions(sim, [{"type": "wind"}], {})
    with pytest.raises(ValueError, match="a boundary condition cuboid must have size"):
        set_boundary_conditions(sim, [{"type": "cuboid", "point": [0, 0, 0], "velocity": [0, 0, 0]}], {})


def test_no_particles_at_all(device):
    sim = MPM_Simulator_WARP(0)
    nothing = torch.zeros(0, 3, device=device)
    sim.load_initial_data_from_torch(nothing, nothing[:, 0])
    sim.set_parameters_dict({"E": 1e4, "nu": 0.3, "density": 1.0})
    sim.add_impulse_on_particles([1, 0, 0], 1e-4)
    sim.finalize_mu_lam()
    sim.p2g2p(0, 1e-4)
    assert sim.export_particle_x_to_torch().shape == (0, 3) and sim.export_particle_R_to_torch().shape == (0, 9)
    assert sim.export_particle_cov_to_torch().shape == (0,)
