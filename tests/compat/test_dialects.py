"""Descendants of PhysGaussian's simulator: every call against the step restated in NumPy, or converted parameters."""

import json
from functools import partial

import numpy as np
import pytest
import torch
from compat.restated import EYE, Weights, from_grid, lame, rotations_svd, times, to_grid
from compat.restated_simulator import DT, DX, LIM, N, Restated, blob, bounding_box, floor, pair, run, shear

from torch_mpm.compat.physgaussian import (
    BatchedSimulator,
    MPM_Simulator_WARP,
    decode_param_json,
    set_boundary_conditions,
    substeps,
)
from torch_mpm.compat.physgaussian.clay import NonAssociativeCamClay
from torch_mpm.compat.physgaussian.dialects import DIALECTS
from torch_mpm.state.state import State

COMMON = {"density": 500.0, "nu": 0.3, "g": [0.0, 0.0, -9.8]}


class Descendant(Restated):
    """Stresses of descendants, and positions two cells away from the faces in MotionPhysics."""

    inside = False

    def stress(self, dt):
        if not hasattr(self, f"_{self.material}"):
            return super().stress(dt)
        return getattr(self, f"_{self.material}")(dt)

    def _fluid(self, dt):
        J = np.linalg.det(self.F)
        return (-J * self.options["bulk"] * (J**-1.1 - 1))[:, None, None] * EYE

    def _newtonian(self, dt):
        mu, bulk = self.options["moduli"]
        J, b = np.linalg.det(self.F)[:, None, None], self.F @ self.F.transpose(0, 2, 1)
        dev = b - np.trace(b, axis1=1, axis2=2)[:, None, None] / 3 * EYE
        return bulk / 2 * (J**2 - 1) * EYE + mu * J ** (-2 / 3) * dev

    def _viscous(self, dt):
        """PhysGaussian's jelly with the branch of Physics3D; its deformation F_N moves with F."""
        self.material = "jelly"
        elastic = super().stress(dt)
        self.material = "viscous"
        mu, lam, eta = self.options["branch"]
        U, s, Vh = rotations_svd(self.F_N.copy())
        alpha = 2 * mu / eta
        beta = 2 * (2 * mu + 3 * lam) / (9 * eta) - 2 * mu / (3 * eta)
        e = np.log(np.maximum(s, 0.01))
        trace = e.sum(1, keepdims=True)
        new = (e - dt * beta / (1 + dt * (alpha + 3 * beta)) * trace) / (1 + dt * alpha)
        self.F_N = times(U, np.exp(new), Vh)
        turned = times(U, 2 * mu * new + lam * trace, Vh)
        return elastic + (turned + turned.transpose(0, 2, 1)) / 2

    def p2g2p(self, dt):
        before = self.x.copy()
        super().p2g2p(dt)
        if self.material == "viscous":
            grad = (self.F - self.old) @ np.linalg.inv(self.old) if hasattr(self, "old") else self.F - EYE
            self.F_N = (EYE + grad) @ self.F_N
            self.old = self.F.copy()
        if self.inside:
            self.x = np.clip(self.x, 2 * DX, LIM - 2 * DX)
        assert before.shape == self.x.shape


def twins(dialect, parameters, own_parameters, device="cpu", closed=True):
    """The simulator in a dialect and the restated step, on a floor, in a closed domain."""
    sim, _ = pair(COMMON | parameters, shear, device, dialect=dialect)
    x, volume = blob()
    own = Descendant(x, volume, **COMMON | {"g": (0, 0, -9.8)} | own_parameters)
    own.v, own.F_N = shear(x), np.tile(EYE, (len(x), 1, 1))
    sim.add_surface_collider((0.5, 0.5, 0.33), (0.0, 0.0, 1.0))
    own.on_nodes.append(floor(0.33))
    if closed:
        sim.add_bounding_box()
        own.on_nodes.append(bounding_box)
    return sim, own


def step_both(sim, own, steps, dt=DT):
    for k in range(steps):
        sim.p2g2p(dt) if sim.dialect.name == "motionphysics" else sim.p2g2p(k, dt)
        own.p2g2p(dt)
    return sim.export_particle_x_to_torch().detach().cpu().numpy()


SI = {"E": 1e5, "yield_stress": 2e3, "plastic_viscosity": 20.0}
UNITS = {"E": 1e-2, "yield_stress": 2e-2, "plastic_viscosity": 2e-3}
SAME = [
    ("dreamphysics", "jelly", {"E": 1e-2}, {"E": 1e5}),
    ("physflow", "elastic", {"E": 1e-2, "mu_N": 5, "lam_N": 5, "viscosity": 0.1}, {"E": 1e5}),
    ("physflow", "metal", UNITS | {"hardening": 0, "xi": 0.05}, SI | {"hardening": 1, "xi": 0.05}),
    ("physflow", "foam", UNITS, SI),
    ("physflow", "non_newtonian", UNITS, SI | {"material": "foam"}),
    ("physflow", "sand", {"E": 1e-2, "friction_angle": 30.0}, {"E": 1e5, "friction_angle": 30.0}),
    ("motionphysics", "foam", UNITS | {"viscosity": 0.1}, SI),
    ("neoworld", "jelly", {"E": 1e5}, {"E": 1e5}),
    ("zeshunzong", "sand", {"E": 1e5, "friction_angle": 30.0}, {"E": 1e5, "friction_angle": 30.0}),
    ("pixie", "metal", SI, SI),
]


@pytest.mark.parametrize(("dialect", "material", "given", "si"), SAME)
def test_units_and_materials(dialect, material, given, si, device):
    """Parameters of a dialect give the motion of the restated step with those in SI units."""
    renamed = {"material": "jelly" if material == "elastic" else material} | si
    sim, own = twins(dialect, {"material": material} | given, renamed, device)
    sim.finalize_mu_lam()
    assert np.abs(step_both(sim, own, 15) - own.x).max() < 1e-9


MU, LAM = lame(1e5, 0.3)
NEW = [
    ("physflow", "newtonian", {"E": 1e-2}, {"material": "newtonian", "moduli": (MU, LAM + 2 / 3 * MU)}, 1e-9),
    ("motionphysics", "newtonian", {"mu": 4e-3, "bulk": 0.8}, {"material": "newtonian", "moduli": (4e4, 8e4)}, 1e-9),
    ("motionphysics", "fluid", {"bulk": 0.8}, {"material": "fluid", "bulk": 8e4}, 1e-4),
    ("pixie", "fluid", {"bulk_modulus": 8e4}, {"material": "fluid", "bulk": 8e4}, 1e-4),
    ("zeshunzong", "fluid", {"E": 1e5}, {"material": "fluid", "bulk": LAM + 2 / 3 * MU}, 1e-4),
    ("physics3d", "jelly", {"E": 1e-2, "mu_N": 2e4, "lam_N": 3e4, "viscosity": 50.0},
     {"material": "viscous", "E": 1e5, "branch": (2e4, 3e4, 50.0)}, 1e-7),
]  # fmt: skip


@pytest.mark.parametrize(("dialect", "material", "given", "own_parameters", "bound"), NEW)
def test_materials_of_descendants(dialect, material, given, own_parameters, bound, device):
    """Fluids move J by the trace of the velocity gradient, the originals F: within 1e-4 of the domain."""
    sim, own = twins(dialect, {"material": material} | given, own_parameters, device)
    finalize = sim.finalize_mu_lam_bulk if dialect == "zeshunzong" else sim.finalize_mu_lam
    if "E" in given:
        finalize()
    x = step_both(sim, own, 40)
    assert np.abs(x - own.x).max() < bound * LIM and np.abs(own.x - blob()[0]).max() > 0.01
    stress = sim.export_particle_stress_to_torch()
    assert stress.shape == (len(x), 3, 3) and float(stress.abs().max()) > 100


def camclay(sigma, log_J, mu, kappa, M, beta, xi):
    """Return map of one particle by Wolper et al. 2019, with hardening."""
    p0 = kappa * (1e-5 + np.sinh(xi * max(-log_J, 0)))
    J = sigma.prod()
    s = mu * J ** (-2 / 3) * (sigma**2 - (sigma**2).mean())
    p = -kappa / 2 * (J - 1 / J) * J
    half, bound = 1.5 * (1 + 2 * beta), M**2 * (p + beta * p0) * (p - p0)
    if p > p0 or p < -beta * p0:
        Je = np.sqrt(1 - 2 * p0 / kappa) if p > p0 else np.sqrt(1 + 2 * beta * p0 / kappa)
        return np.full(3, Je ** (1 / 3)), log_J + np.log(J / Je)
    if half * s @ s + bound < 1e-4:
        return sigma, log_J
    size = np.sqrt(s @ s)
    new = np.sqrt(J ** (2 / 3) / mu * np.sqrt(-bound / half) * s / size + (sigma**2).mean())
    if not (p0 > 1e-4 and 1e-4 - beta * p0 < p < p0 - 1e-4):
        return new, log_J
    centre, q = (p0 - beta * p0) / 2, np.sqrt(1.5) * size
    d = np.array([centre - p, -q]) / np.hypot(centre - p, q)
    C = M**2 * (centre + beta * p0) * (centre - p0)
    B = M**2 * d[0] * (2 * centre - p0 + beta * p0)
    A = M**2 * d[0] ** 2 + (1 + 2 * beta) * d[1] ** 2
    roots = [(-B + sign * np.sqrt(B**2 - 4 * A * C)) / (2 * A) for sign in (1, -1)]
    first, second = (centre + root * d[0] for root in roots)
    meets = first if (p - centre) * (first - centre) > 0 else second
    Je = np.sqrt(abs(1 - 2 * meets / kappa))
    return new, log_J + (np.log(J / Je) if Je > 1e-4 else 0)


def test_the_clay_of_gaussianfluent():
    """Every branch of the return map of "watermelon", and its stress."""
    rng = np.random.default_rng(0)
    P, beta, xi, M = 60, 0.6, 1.5, 6 * np.sin(0.6) / (3 - np.sin(0.6))
    F = EYE + rng.uniform(-1, 1, (P, 3, 3)) * rng.choice([1e-4, 0.02, 0.2], P)[:, None, None]
    log_J = rng.uniform(-0.3, 0.02, P)
    law = NonAssociativeCamClay(1e5, 0.3, M, beta, xi, 0.0, True)
    zeros = torch.zeros(P, 3, dtype=torch.float64)
    state = State(
        x=zeros, v=zeros, mass=zeros[:, 0] + 1, volume=zeros[:, 0] + 1, F=torch.tensor(F),
        extra={"log_plastic_volume": torch.tensor(log_J)},
    )  # fmt: skip
    fields, stress = law.update(state)
    kappa, branches = LAM + 2 / 3 * MU, set()
    U, s, Vh = rotations_svd(F.copy())
    for p in range(P):
        new, log_new = camclay(s[p], log_J[p], MU, kappa, M, beta, xi)
        J = new.prod()
        tau = MU * J ** (-2 / 3) * (new**2 - (new**2).mean()) + kappa / 2 * (J**2 - 1)
        np.testing.assert_allclose(fields["F"][p].numpy(), U[p] @ np.diag(new) @ Vh[p], atol=1e-9)
        np.testing.assert_allclose(stress[p].numpy(), U[p] @ np.diag(tau) @ U[p].T, atol=1e-4)
        assert float(fields["log_plastic_volume"][p]) == pytest.approx(log_new, abs=1e-9)
        branches.add((bool(np.allclose(new, s[p])), bool(np.allclose(new, new[0]))))
    assert {(True, False), (False, True), (False, False)} <= branches


def test_flip_of_gaussianfluent(device):
    """A blend of FLIP and PIC with forces times the weights, and APIC without."""
    material = {"material": "watermelon", "E": 1e5, "beta": 2.0, "hardening": 1, "xi": 3.0}
    sim, own = twins("gaussianfluent", material, {"E": 1e5}, device)
    sim.set_parameters_dict({"material": "jelly"})
    sim.finalize_mu_lam()
    share = 0.7

    def flip(dt):
        weights = Weights(own.x, DX, N)
        stress = own.stress(dt)
        old = to_grid(weights, N, own.mass, own.v, 0 * own.F, own.volume, 0 * own.F, dt, False, DX)
        m, old = old
        mv = old.copy()
        for w, dw, _, node in weights:
            np.add.at(mv, node, -dt * (own.volume * w)[:, None] * np.einsum("pij,pj->pi", stress, dw))
        inverse = np.where(m > 1e-15, 1 / np.maximum(m, 1e-300), 0)[:, None]
        v = np.where(m[:, None] > 1e-15, mv * inverse + dt * own.g, 0)
        for act in own.on_nodes:
            act(own, v, dt)
        new, _, grad = from_grid(weights, v, DX)
        own.v = share * own.v + new - share * from_grid(weights, old * inverse, DX)[0]
        own.x, own.F, own.time = own.x + dt * new, (EYE + dt * grad) @ own.F, own.time + dt

    for k in range(20):
        sim.p2g2p(k, DT, flip_pic_ratio=share, flip_pic=True)
        flip(DT)
    assert np.abs(sim.export_particle_x_to_torch().cpu().numpy() - own.x).max() < 1e-9
    own.v, own.C = sim.state.v.cpu().numpy(), 0 * own.F
    for k in range(5):
        sim.p2g2p(k, DT, flip_pic=False)
        own.p2g2p(DT)
    assert np.abs(sim.export_particle_x_to_torch().cpu().numpy() - own.x).max() < 1e-9
    assert sim.material_2_num("watermelon") == 7
    with pytest.raises(NotImplementedError, match="set_velocity_by_index has no index"):
        sim.set_velocity_by_index([0] * 3, [1] * 3, [0] * 3)
    with pytest.raises(ValueError, match="flip_pic_ratio and flip_pic need dialect='gaussianfluent'"):
        MPM_Simulator_WARP(2).p2g2p(0, DT, flip_pic=True)


def test_calls_of_motionphysics(device):
    """Masks, layers by size, moduli by particles, positions that stay inside, and starting again."""
    sim, own = twins("motionphysics", {"material": "elastic", "E": 1.0}, {"E": 1e5}, device, False)
    x0, odd = own.x.copy(), np.arange(len(own.x)) % 2 == 1
    E = torch.full((len(x0),), 1e-2, dtype=torch.float64, device=device)
    sim.set_E_nu_from_torch(E, torch.full_like(E, 0.3), device)
    sim.add_impulse_on_particles_with_mask([0.0, 40.0, 0.0], torch.tensor(odd, device=device).int(), 0.0005, 0.0021)
    sim.add_constant_force([50.0, 0.0, 0.0], [0.4, 0.4, 0.4], 0.15, 0.0, 0.003)
    sim.release_particles_sequentially_size([0, 0, 1], 0.5, 0.35, 4, 0.0, 0.004, [0.12, 0.12, 0], [0.4, 0.4, 0.4])
    mask = torch.zeros(N, N, N, dtype=torch.int32, device=device)
    mask[12:] = 2
    sim.enforce_grid_velocity_by_mask(mask)
    sim.finalize_mu_lam(device)

    def push(sim, dt):
        if 0.0005 <= sim.time < 0.0021:
            sim.v[odd] += dt * np.array([0, 40.0, 0])
        if sim.time < 0.003:
            sim.v[np.linalg.norm(x0 - 0.4, axis=1) < 0.15] += dt * np.array([50.0, 0, 0])
        for k in range(4):
            layer = (np.abs(x0 - [0.4, 0.4, 0.5]) < [0.12, 0.12, 0.15 / 4 * k]).all(1)
            if sim.time < 0.004 / 4 * (k + 1):
                sim.v[layer] = 0

    def hold(sim, v, dt):
        v[sim.nodes[:, 0] > 11.5 * DX] = 0

    own.before.append(push)
    own.on_nodes.append(hold)
    own.inside = True
    assert np.abs(step_both(sim, own, 25) - own.x).max() < 1e-9
    sim.import_particle_v_from_torch(sim.state.v + torch.tensor([0.0, -40.0, 0.0], device=device))
    own.v = own.v + [0, -40.0, 0]
    x = step_both(sim, own, 45)
    assert np.abs(x - own.x).max() < 1e-7 and x[:, 1].min() == pytest.approx(2 * DX)
    sim.reset_pos_from_torch(torch.tensor(x0), torch.tensor(own.volume), None, device)
    assert sim.time == 0 and float(sim.state.v.abs().max()) == 0
    with pytest.raises(TypeError, match="with dt alone, the simulator must have dialect='motionphysics'"):
        MPM_Simulator_WARP(2).p2g2p(DT)


def test_calls_of_neoworld(device):
    """Objects and scenes by their selections, which are written in place as there."""
    sim, own = pair(COMMON | {"E": 1e5}, shear, device, dialect="neoworld")
    own.g = np.array([0, 0, -9.8])
    x0, scene = own.x.copy(), own.x[:, 2] > 0.55
    sim.mpm_state.object_selection[:].fill_(1)
    sim.mpm_state.object_selection[torch.tensor(~scene, device=device)] = 0
    sim.tear_object([0.4, 0.0, 0.0], DT, 8, [[0.3, 0.7], [0, 1], [0, 1]], 0, 0.001, device)
    sim.add_impulse_on_object([0.0, 0.2, 0.0], DT, num_dt=3, start_time=0.0)
    sim.enforce_scene_velocity_translation([0.3, 0.0, 0.0], 0.0, 0.002)
    left_out = torch.zeros(len(x0), dtype=torch.int32, device=device)
    left_out[5] = 1
    sim.mpm_state.particle_selection = left_out
    sim.finalize_mu_lam()
    keep = np.arange(len(x0)) != 5
    for name in ("x", "v", "C", "F", "mass", "volume", "mu", "lam"):
        setattr(own, name, getattr(own, name)[keep])
    first, scene = x0[keep], scene[keep]

    def push(sim, dt):
        if 0.001 <= sim.time < 0.001 + 8 * DT:
            side = np.sign(first[:, 0] - 0.5) * ~scene
            sim.v += dt * side[:, None] * np.array([0.4, 0, 0]) / sim.mass[:, None]
        if sim.time < 3 * DT:
            sim.v[~scene] += dt * np.array([0, 0.2, 0]) / sim.mass[~scene, None]
        if sim.time < 0.002:
            sim.v[scene] = [0.3, 0, 0]

    own.before.append(push)
    x = run(sim, own, 20)
    assert np.abs(x[keep] - own.x).max() < 1e-9 and np.array_equal(x[5], x0[5])


def test_materials_of_particles_in_pixie(device):
    """A material for each box, particles at rest, and an offset of all positions."""
    low = {"point": [0.5, 0.5, 0.4], "size": [1, 1, 0.1], "E": 1e5, "nu": 0.3, "density": 500.0, "material": "sand"}
    fixed = low | {"point": [0.4, 0.5, 0.6], "size": [0.1, 1, 0.06], "material": "stationary"}
    parameters = COMMON | {"material": "jelly", "E": 1e5, "friction_angle": 30, "spawn_offset": [0.01, 0.0, 0.02]}
    x, volume = (torch.tensor(a, device=device) for a in blob())
    sim = MPM_Simulator_WARP(10, dialect="pixie")
    sim.load_initial_data_from_torch(x, volume, n_grid=N, grid_lim=LIM)
    sim.set_parameters_dict(parameters | {"additional_material_params": [low, fixed]})
    sim.finalize_mu_lam_bulk(device)
    sim.add_bounding_box()
    codes = sim.mpm_state.particle_material
    assert codes.unique().tolist() == [0, 2, 6]
    assert torch.equal(sim.mpm_state.particle_density, torch.full_like(sim.state.mass, 500.0))
    start = sim.export_particle_x_to_torch().clone()
    torch.testing.assert_close(start, x + torch.tensor([0.01, 0.0, 0.02], device=device).to(x))
    for k in range(30):
        sim.p2g2p(k, 5e-4)
    after, still = sim.export_particle_x_to_torch(), codes == 6
    assert torch.equal(after[still], start[still]) and float((after - start)[~still].abs().max()) > 1e-3
    F = sim.state.F
    assert torch.equal(F[still], torch.eye(3).to(F).expand(int(still.sum()), 3, 3))
    assert not sim.debug_particle_positions("after")
    sim.mpm_state.particle_x = after - torch.tensor([0.5, 0.0, 0.0], device=device)
    assert sim.debug_particle_positions("moved")
    sim.mpm_state.particle_material = torch.zeros_like(codes)
    assert sim.mpm_model.material.eq(0).all()
    sim.mpm_model.E = 2e5
    assert float(sim.mpm_model.E[0]) == 2e5


def test_a_mixture_is_its_parts(device):
    """Particles of two materials far apart move as in two simulators."""
    x, volume = (torch.tensor(a, device=device) for a in blob(3, 0.2, 0.35))
    both = torch.cat([x, x + 0.45])
    box = {"point": [0.72] * 3, "size": [0.15] * 3, "E": 1e5, "nu": 0.3, "density": 500.0, "material": "metal"}
    values = COMMON | {"E": 1e5, "yield_stress": 500.0, "material": "jelly"}

    def moved(positions, parameters):
        sim = MPM_Simulator_WARP(10, dialect="pixie")
        sim.load_initial_data_from_torch(positions, volume.repeat(len(positions) // len(volume)), n_grid=N)
        sim.import_particle_v_from_torch(3 * torch.sin(20 * positions))
        sim.set_parameters_dict(parameters)
        sim.finalize_mu_lam()
        for k in range(15):
            sim.p2g2p(k, 5e-4)
        return sim.export_particle_x_to_torch()

    mixed = moved(both, values | {"additional_material_params": [box]})
    torch.testing.assert_close(mixed[: len(x)], moved(x, values), rtol=0, atol=1e-9)
    torch.testing.assert_close(mixed[len(x) :], moved(x + 0.45, values | {"material": "metal"}), rtol=0, atol=1e-9)


# ---- views


def test_arrays_are_read_and_assigned(device):
    sim, _ = pair(COMMON | {"E": 1e5}, shear, device)
    sim.finalize_mu_lam()
    state, model = sim.mpm_state, sim.mpm_model
    shapes = {"x": (64, 3), "v": (64, 3), "F": (64, 3, 3), "C": (64, 3, 3), "R": (64, 3, 3), "cov": (384,)}
    for name, shape in shapes.items():
        assert getattr(state, f"particle_{name}").shape == shape
    torch.testing.assert_close(state.particle_R.reshape(-1, 9), sim.export_particle_R_to_torch())
    assert float(model.mu[0]) == pytest.approx(MU) and float(model.lam[0]) == pytest.approx(LAM)
    assert model.n_grid == N and model.inv_dx == pytest.approx(N / LIM) and model.material == 0
    for name in ("particle_v", "particle_C", "particle_F_trial", "particle_vol", "particle_init_cov", "particle_mass"):
        value = 2 * getattr(state, name) + 0.1
        setattr(state, name, value)
        torch.testing.assert_close(getattr(state, name), value)
    state.particle_density = torch.full_like(sim.state.mass, 7.0)
    torch.testing.assert_close(state.particle_mass, 7.0 * state.particle_vol)
    for name, value in {"friction_angle": 12.0, "hardening": 1, "grid_v_damping_scale": 0.9, "n_grid": 30}.items():
        setattr(model, name, value)
        assert getattr(model, name) == value
    model.mu = torch.full_like(sim.state.mass, 5e4)
    assert float(model.mu[3]) == pytest.approx(5e4) and float(model.lam[3]) == pytest.approx(LAM)
    model.material = 2
    assert sim.parameters["material"] == "sand" and model.gravitational_accelaration[2] == -9.8
    assert 0.1 < float(model.alpha) < 0.3 and "particle_x" in dir(state)
    for call, message in (
        (lambda: state.grid_v_out, "grid_v_out is not stored"),
        (lambda: state.particle_y, "ParticleView has no 'particle_y', the nearest known name is 'particle_"),
        (lambda: setattr(state, "particle_R", 1), "particle_R is a result"),
        (lambda: setattr(model, "dx", 1), "dx follows from other values"),
    ):
        with pytest.raises(AttributeError, match=message):
            call()


def test_arrays_are_written_in_place(device):
    """Materials and selections of particles, between substeps; parameters not while substeps are pending."""
    parameters = COMMON | {"material": "jelly", "E": 1e5, "yield_stress": 100.0}
    sim, _ = pair(parameters, shear, device, dialect="pixie")
    other, _ = pair(parameters, shear, device, dialect="pixie")
    for one in (sim, other):
        one.finalize_mu_lam()
        for k in range(5):
            one.p2g2p(k, DT)
    sim.mpm_state.particle_material[:] = 1
    sim.mpm_state.particle_selection[3] = 1
    other.set_parameters_dict({"material": "metal"})
    other.mpm_state.particle_selection = torch.arange(64, device=device).eq(3).int()
    for one in (sim, other):
        before = one.export_particle_x_to_torch()[3].clone()
        for k in range(5):
            one.p2g2p(k, DT)
        assert torch.equal(one.export_particle_x_to_torch()[3], before)
    torch.testing.assert_close(sim.state.x, other.state.x, rtol=0, atol=1e-12)
    assert "yield_stress" in sim.state.extra
    E = sim.mpm_model.E
    sim.p2g2p(0, DT)
    E *= 2
    with pytest.raises(RuntimeError, match="E must not be written to while 1 substeps are pending"):
        sim.export_particle_x_to_torch()


@pytest.mark.parametrize(
    ("dialect", "given", "message"),
    [
        ("physflow", {"mu_N": 1.0}, "mu_N must not require grad: it has no effect"),
        ("motionphysics", {"viscosity": 1.0}, "viscosity must not require grad: it has no effect"),
        ("gaussianfluent", {"flip_pic_ratio": 0.5}, "flip_pic_ratio must not require grad"),
        ("pixie", {"material": "fluid", "bulk_modulus": 1e5, "E": 1e5}, "E must not require grad: it has no effect on"),
    ],
)
def test_gradients_that_would_be_lost(dialect, given, message):
    sim, _ = pair(COMMON | {"E": 0.1}, dialect=dialect)
    name = next(iter(given)) if "E" not in given else "E"
    given = given | {name: torch.tensor(given[name], requires_grad=True)}
    with pytest.raises(ValueError, match=message):
        sim.set_parameters_dict(given)
        sim.finalize_mu_lam()


@pytest.mark.parametrize("name", ["E", "mu"])
def test_gradients_of_the_model(name, device):
    """`.grad` of a tensor of the model, against a difference; numbers become tensors that may require grad."""

    def loss(sim):
        for k in range(5):
            sim.p2g2p(k, DT)
        return sim.mpm_state.particle_x.square().sum() + 0.1 * sim.mpm_state.particle_cov.square().sum()

    def made(value=None):
        sim, _ = pair(COMMON | {"E": 1e5}, shear, device)
        sim.mpm_state.particle_init_cov = torch.ones(384, dtype=torch.float64, device=device)
        sim.finalize_mu_lam()
        given = getattr(sim.mpm_model, name) if value is None else value
        return sim, given

    sim, given = made()
    if name == "mu":
        given = given.clone()
    given.requires_grad_()
    if name == "mu":
        sim.mpm_model.mu = given
    loss(sim).backward()
    assert sim.mpm_state.particle_x.grad is not None and sim.mpm_state.particle_cov.grad is not None
    values = []
    for sign in (1, -1):
        other, _ = made()
        setattr(other.mpm_model, name, given.detach() * (1 + sign * 1e-5))
        if name == "E":
            other.finalize_mu_lam()
        values.append(float(loss(other)))
    difference = (values[0] - values[1]) / 2e-5
    assert float((given.grad * given.detach()).sum()) == pytest.approx(difference, rel=1e-4) and difference != 0


# ---- when conditions act


def recorded(monkeypatch):
    """Rollouts of a simulator: numbers of steps, and whether something acts by torch operations."""
    found = []
    run = substeps.ClippedRollout.run

    def noted(self, state, n, dt, nodes, operations, *rest, **named):
        found.append((n, len(nodes), len(operations)))
        return run(self, state, n, dt, nodes, operations, *rest, **named)

    monkeypatch.setattr(substeps.ClippedRollout, "run", noted)
    return found


def test_conditions_cost_nothing_before_and_after(monkeypatch, capsys):
    """An impulse of one step, held particles and a reset: the other steps are computed together, without them."""
    sim, _ = pair(COMMON | {"E": 1e5}, shear)
    sim.finalize_mu_lam()
    sim.add_impulse_on_particles([0.1, 0, 0], DT)
    sim.enforce_particle_velocity_translation([0.5] * 3, [1, 1, 0.05], [0, 0.4, 0], 50 * DT, 60 * DT)
    found = recorded(monkeypatch)
    for k in range(100):
        sim.p2g2p(k, DT)
    sim.export_particle_x_to_torch()
    assert sum(n for n, _, _ in found) == 100
    assert sum(n for n, _, operations in found if operations) <= 14 and len(found) <= 5
    assert max(n for n, _, operations in found if not operations) >= 39
    assert sim.step.explain(sim.state, DT).startswith("all steps in one op")
    sim.print_time_profile()
    title, line = capsys.readouterr().out.splitlines()
    assert title == "MPM Time profile:" and float(line.split()[1]) > 0


@pytest.mark.parametrize("dialect", ["physgaussian", "gaussianfluent"])
def test_pic_is_computed_together(dialect, monkeypatch, device):
    """Without C, except in the last step, whose C is that of single steps."""
    sim, own = pair(COMMON | {"E": 1e5, "rpic_damping": -1.0}, shear, device, dialect=dialect)
    if dialect == "gaussianfluent":
        monkeypatch.setattr(sim, "p2g2p", partial(sim.p2g2p, flip_pic=False))
    sim.finalize_mu_lam()
    found = recorded(monkeypatch)
    assert np.abs(run(sim, own, 20) - own.x).max() < 1e-9
    assert found == [(19, 0, 0), (1, 0, 1)]
    np.testing.assert_allclose(sim.state.C.cpu().numpy(), own.C, atol=1e-7)


@pytest.mark.parametrize("strict", [False, True])
def test_nodes_on_a_face(strict):
    """A face at 0.3 is on a node plane: outside, or by the rounding of float32, as in the original."""
    sim = MPM_Simulator_WARP(10, strict=strict)
    x, volume = (torch.tensor(a, dtype=torch.float32) for a in blob(low=0.28, high=0.4))
    sim.load_initial_data_from_torch(x, volume, n_grid=N, grid_lim=LIM)
    sim.set_parameters_dict(COMMON | {"E": 1e4, "nu": 0.3})
    for height in (0.3, 0.35):
        sim.add_surface_collider((0.0, 0.0, height), (0.0, 0.0, 1.0), end_time=DT)
        sim.set_velocity_on_cuboid((0.0, 0.0, height - 0.1), (9.0, 9.0, 0.1), (0.0, 0.0, 0.0), end_time=DT)
        plane, box = sim._boundaries(sim._nodes)[-2:]
        nodes = torch.stack(torch.meshgrid(*[torch.arange(N) * DX] * 3, indexing="ij"), -1).reshape(-1, 3).float()
        on_face = (nodes[:, 2] - height).abs() < 1e-6
        dx, faces = np.float32(DX), np.float32([height, height - 0.1])
        offset = np.float32(round(height / DX)) * dx - faces
        expected = [bool(offset[0] < 0), bool(abs(offset[1]) < np.float32(0.1))] if strict else [False, False]
        for boundary, held in zip((plane, box), expected, strict=True):
            v = boundary(torch.ones_like(nodes), nodes, None, 0.0, DT)
            assert bool((v[on_face] == 0).all()) == held and bool((v[nodes[:, 2] > height + 0.01] == 1).all())


# ---- configurations


def test_a_configuration_of_motionphysics(tmp_path):
    """Its keys and times, six parts, frozen cells and arrows."""
    file = tmp_path / "config.json"
    conditions = [
        {"type": "add_constant_force", "force": [0, 0, 2.0], "point": [0.5] * 3, "radius": 0.1, "start_time": 0.0,
         "end_time": 0.5},
        {"type": "particle_impulse", "force": [1.0, 0, 0], "num_dt": 2},
    ]  # fmt: skip
    content = {
        "material": "elastic",
        "E": 1e-2,
        "n_grid": N,
        "grid_lim": LIM,
        "substep_perframe": 10,
        "total_time": 0.4,
    }
    file.write_text(json.dumps(content | {"frame_num": 8, "prompt": "wind", "boundary_conditions": conditions}))
    material, boundaries, time, _, _, optimisation = decode_param_json(file)
    assert time == {"substep_perframe": 10, "total_time": 0.4, "frame_num": 8}
    assert optimisation == {"reduction": "sum", "prompt": "wind"}
    sim = MPM_Simulator_WARP(10)
    sim.load_initial_data_from_torch(*(torch.tensor(a) for a in blob()), n_grid=N, grid_lim=LIM)
    with pytest.warns(UserWarning, match="parameters are those of MotionPhysics"):
        sim.set_parameters_dict(material)
    frozen = torch.tensor([[0.11, 0.13, 0.17]])
    first, second = set_boundary_conditions(sim, boundaries, time, freeze_pts=frozen, sim_pos=sim.state.x)
    assert first["end_frame"] == 10 and second["end_frame"] == 0
    torch.testing.assert_close(first["force"], torch.tensor([0, 0, 0.1], dtype=torch.float64))
    mask = sim._boundaries(sim._nodes)[0].mask
    assert mask.nonzero().tolist() == [[2, 2, 3]]
    other = MPM_Simulator_WARP(10, dialect="physflow")
    other.load_initial_data_from_torch(*(torch.tensor(a) for a in blob()), n_grid=N, grid_lim=LIM)
    with pytest.raises(ValueError, match="dialect must be that of the configuration, 'motionphysics', got 'physflow'"):
        other.set_parameters_dict(material)


@pytest.mark.parametrize("dialect", ["physics3d", "physflow", "gaussianfluent", "pixie", "zeshunzong", "dreamphysics"])
def test_defaults_of_a_configuration(dialect, tmp_path):
    """The parameters of an empty configuration are those that a simulator of the dialect takes."""
    file = tmp_path / "config.json"
    file.write_text("{}")
    parts = decode_param_json(file, dialect)
    assert len(parts) == (6 if dialect == "physflow" else 5)
    sim = MPM_Simulator_WARP(10, dialect=dialect)
    sim.load_initial_data_from_torch(*(torch.tensor(a) for a in blob(2)), n_grid=N)
    sim.set_parameters_dict(parts[0] | {"material": "jelly"})
    sim.finalize_mu_lam()
    assert {*DIALECTS[dialect].keys} - {"bulk_modulus", "spawn_offset"} <= {*sim.parameters}


# ---- batches


class MovingLeastSquares(Restated):
    """The step of kywind's warp-mpm: MLS-MPM with 3/4 of the stress, and F moved by C."""

    def p2g2p(self, dt):
        for act in self.before:
            act(self, dt)
        weights = Weights(self.x, DX, N)
        m, mv = to_grid(weights, N, self.mass, self.v, self.C, self.volume, 0.75 * self.stress(dt), dt, True, DX)
        v = np.where(m[:, None] > 1e-15, mv / np.maximum(m, 1e-300)[:, None] + dt * self.g, 0)
        for act in self.on_nodes:
            act(self, v, dt)
        self.v, self.C, _ = from_grid(weights, v, DX)
        self.x, self.F, self.time = self.x + dt * self.v, (EYE + dt * self.C) @ self.F, self.time + dt


@pytest.mark.parametrize("material", ["jelly", "metal"])
def test_a_batch_of_kywind(material, device):
    """Two scenes with velocities of their own, in [B, P, ...]."""
    x, volume = blob()
    parameters = COMMON | {"material": material, "E": 1e5, "yield_stress": 1e3}
    sim = BatchedSimulator()
    tensors = (torch.tensor(np.stack([a, a]), device=device) for a in (x, volume))
    sim.load_initial_data_from_torch(*tensors, batch_size=2, dx=DX, grid_lim=[1.0, 1.0, 1.0 + DX / 2], device=device)
    scenes = [MovingLeastSquares(x, volume, **parameters) for _ in range(2)]
    for k, own in enumerate(scenes):
        own.v = (k + 1) * shear(x)
        own.on_nodes += [floor(0.33), bounding_box]
    sim.import_particle_v_from_torch(torch.tensor(np.stack([own.v for own in scenes]), device=device))
    sim.set_parameters_dict(parameters)
    sim.add_surface_collider((0.5, 0.5, 0.33), (0.0, 0.0, 1.0))
    sim.add_bounding_box()
    sim.finalize_mu_lam()
    for k in range(25):
        sim.p2g2p(k, DT)
        for own in scenes:
            own.p2g2p(DT)
    assert np.abs(sim.export_particle_x_to_torch().cpu().numpy() - np.stack([own.x for own in scenes])).max() < 1e-9
    shapes = {"v": (2, 64, 3), "F": (2, 64, 9), "C": (2, 64, 9), "R": (2, 64, 9), "cov": (2, 384)}
    for name, shape in shapes.items():
        assert getattr(sim, f"export_particle_{name}_to_torch")().shape == shape
    assert sim.mpm_state.particle_x.shape == (2, 64, 3) and sim.mpm_model.n_grid_z == N
    assert sim.mpm_model.batch_size == 2 and float(sim.mpm_model.mu[0]) == pytest.approx(MU)
    with pytest.raises(ValueError, match="n_grid must not be given: kywind's warp-mpm has dx in its place"):
        sim.set_parameters_dict({"n_grid": 10})
    sim.set_parameters_dict({"dx": 0.1})
    assert sim.mpm_model.n_grid_x == 10


def test_a_batch_from_a_sampling(tmp_path):
    h5py = pytest.importorskip("h5py")
    x, volume = blob()
    with h5py.File(tmp_path / "points.h5", "w") as file:
        file["x"], file["particle_volume"] = x.T, volume[None]
    sim = BatchedSimulator()
    sim.load_from_sampling(str(tmp_path / "points.h5"), batch_size=3, dx=DX, fps=8)
    found = sim.export_particle_x_to_torch()
    assert found.shape == (3, 8, 3) and torch.equal(found[0], found[2])
    apart = torch.cdist(found[0], found[0]) + 9 * torch.eye(8)
    assert float(apart.min()) > 0.12
