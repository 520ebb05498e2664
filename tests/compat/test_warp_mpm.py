"""`MPMWARPDiff` and its structs against the published step, restated in NumPy, and gradients against differences."""

import numpy as np
import pytest
import torch
from compat.restated import Weights, from_grid, nodes_of, rotations_svd, times, to_grid
from compat.restated_simulator import DT, DX, LIM, N, Restated, blob, bounding_box, floor, shear

from torch_mpm.compat import warp_mpm
from torch_mpm.compat.warp_mpm import MPMModelStruct, MPMStateStruct, MPMWARPDiff

E, NU, RHO = 1e5, 0.3, 500.0


class Clipped(Restated):
    """The step of PhysGaussian with positions two cells away from the faces, and the neo-Hookean solid."""

    def stress(self, dt):
        if self.material != "neo-hookean":
            return super().stress(dt)
        U, s, Vh = rotations_svd(self.F)
        J, b = s.prod(1)[:, None], s**2
        dev = b - b.mean(1, keepdims=True)
        tau = self.mu[:, None] * J ** (-2 / 3) * dev + self.lam[:, None] / 2 * (J**2 - 1)
        return times(U, tau, Vh) @ self.F.transpose(0, 2, 1)

    def p2g2p(self, dt):
        super().p2g2p(dt)
        self.x = np.clip(self.x, 2 * DX, LIM - 2 * DX)


def made(parameters=None, device="cpu", moduli=(E, NU)):
    """Solver, model and state of a sheared cube."""
    x, volume = (torch.tensor(a, device=device) for a in blob())
    state, model = MPMStateStruct(), MPMModelStruct()
    state.init(len(x), device=device, requires_grad=True)
    state.from_torch(x, volume, None, torch.tensor(shear(blob()[0]), device=device), n_grid=N, grid_lim=LIM)
    model.init(len(x), device=device, requires_grad=True)
    model.init_other_params(n_grid=N, grid_lim=LIM, device=device)
    solver = MPMWARPDiff(len(x), n_grid=N, grid_lim=LIM, device=device)
    given = {"material": "jelly", "g": [0.0, 0.0, -9.8], "density": RHO}
    solver.set_parameters_dict(model, state, given | (parameters or {}))
    solver.set_E_nu_from_torch(model, *(torch.tensor(m, dtype=torch.float64) for m in moduli), device)
    solver.prepare_mu_lam(model, state, device)
    return solver, model, state


def restated(parameters=None):
    x, volume = blob()
    own = Clipped(x, volume, RHO, E=E, nu=NU, **{"g": (0, 0, -9.8)} | (parameters or {}))
    own.v = shear(x)
    return own


def stepped(solver, model, state, steps):
    """The last of a chain of states."""
    for _ in range(steps):
        after = state.partial_clone(requires_grad=True)
        solver.p2g2p_differentiable(model, state, after, DT)
        state = after
    return state


MATERIALS = {
    "jelly": {},
    "neo-hookean": {},
    "metal": {"yield_stress": 2e3, "hardening": 1, "xi": 0.05},
    "plasticine": {"yield_stress": 2e3, "softening": 2e4},
    "foam": {"yield_stress": 1e3, "plastic_viscosity": 10.0},
    "sand": {"friction_angle": 30.0},
}


@pytest.mark.parametrize("material", MATERIALS)
def test_trajectories_of_the_materials(material, device):
    """Steps of one state to the next, and steps in place, which are computed together."""
    parameters = {"material": material, "grid_v_damping_scale": 0.999, "rpic_damping": 0.1} | MATERIALS[material]
    own = restated(parameters)
    own.on_nodes += [floor(0.33), bounding_box]
    for _ in range(15):
        own.p2g2p(DT)
    for in_place in (False, True):
        solver, model, state = made(parameters, device)
        solver.add_surface_collider((0.5, 0.5, 0.33), (0.0, 0.0, 2.0))
        solver.add_bounding_box()
        if in_place:
            for k in range(15):
                solver.p2g2p(model, state, k, DT)
            assert solver.time == pytest.approx(15 * DT)
        else:
            state = stepped(solver, model, state, 15)
        assert np.abs(state.particle_x.cpu().numpy() - own.x).max() < 1e-9
        np.testing.assert_allclose(state.particle_F_trial.cpu().numpy(), own.F, atol=1e-7)
        if material == "metal":
            np.testing.assert_allclose(state.history["yield_stress"].cpu().numpy(), own.limit, rtol=1e-6)
    assert np.abs(own.x - blob()[0]).max() > 2e-3


def test_conditions_on_particles_and_nodes(device):
    """Impulses, accelerations, held and turning particles, a cuboid, held nodes and particles that are left out."""
    parameters = {"g": [0.0, 0.0, -3.0]}
    solver, model, state = made(parameters, device)
    own = restated({"g": (0, 0, -3.0)})
    x0 = own.x.copy()
    odd = np.arange(len(x0)) % 2 == 1
    mask = torch.tensor(odd, device=device)
    solver.add_impulse_on_particles(state, [0.5, 0.0, 0.2], DT, [0.4, 0.5, 0.5], [0.1, 1, 1], 10, 0.002)
    solver.add_impulse_on_particles_with_mask(state, [0.0, 40.0, 0.0], DT, mask.int(), end_time=0.003)
    solver.enforce_particle_velocity_translation(state, [0.5, 0.5, 0.6], [1, 1, 0.05], [0.0, 0.4, 0.0], 0.0, 0.004)
    solver.enforce_particle_velocity_rotation(state, [0.5, 0.5, 0.36], [0, 0, 3.0], [0.05, 0.2], 5.0, 0.3, 0.002, 0.006)
    corner = torch.tensor((x0 < 0.42).all(1), device=device)
    solver.enforce_particle_velocity_by_mask(state, corner, [0.1, 0.0, 0.0], 0.001, 0.005)
    solver.set_velocity_on_cuboid([0.3, 0.475, 0.475], [0.1, 0.1, 0.1], [1.0, 0, 0], 0.001, 0.005, reset=0)
    nodes = torch.zeros(N, N, N, dtype=torch.int32, device=device)
    nodes[:, :, 11:] = 1
    solver.enforce_grid_velocity_by_mask(nodes)
    selection = torch.tensor(np.arange(len(x0)) == 7, device=device).int()
    state.particle_selection = selection

    def push(sim, dt):
        if 0.002 <= sim.time < 0.002 + 10 * DT:
            chosen = np.abs(x0[:, 0] - 0.4) < 0.1
            sim.v[chosen] += dt * np.array([0.5, 0.0, 0.2]) / sim.mass[chosen, None]
        if sim.time < 0.003:
            sim.v[odd] += dt * np.array([0.0, 40.0, 0.0])

    def move(sim, dt):
        if sim.time < 0.004:
            sim.v[np.abs(x0[:, 2] - 0.6) < 0.05] = [0, 0.4, 0]
        first = x0 - [0.5, 0.5, 0.36]
        chosen = (np.abs(first[:, 2]) < 0.05) & (np.hypot(first[:, 0], first[:, 1]) < 0.2)
        if 0.002 <= sim.time < 0.006:
            arm = sim.x - [0.5, 0.5, 0.36]
            sim.v[chosen] = np.stack([5 * arm[:, 1], -5 * arm[:, 0], 0 * arm[:, 0] + 0.3], 1)[chosen]
        if 0.001 <= sim.time < 0.005:
            sim.v[corner.cpu().numpy()] = [0.1, 0, 0]

    def hold(sim, v, dt):
        if 0.001 <= sim.time < 0.005:
            centre = np.array([0.3 + (sim.time - 0.001), 0.475, 0.475])
            v[(np.abs(sim.nodes - centre) < 0.1 - 1e-9).all(1)] = [1.0, 0, 0]
        v[sim.nodes[:, 2] > 10.5 * DX] = 0

    own.before += [push, move]
    own.on_nodes.append(hold)
    keep = np.arange(len(x0)) != 7
    for name in ("x", "v", "C", "F", "mass", "volume", "mu", "lam"):
        setattr(own, name, getattr(own, name)[keep])
    x0, odd, corner = x0[keep], odd[keep], corner[torch.tensor(keep)]
    for _ in range(40):
        own.p2g2p(DT)
    after = stepped(solver, model, state, 40)
    assert np.abs(after.particle_x.cpu().numpy()[keep] - own.x).max() < 1e-9
    assert torch.equal(after.particle_x[7], state.particle_x[7])
    assert np.abs(own.x - x0).max() > 2e-3


def test_positions_stay_inside(device):
    """A body that flies against the bounds: the same in place, where steps are repeated with the bounds."""
    own = restated({"g": (0, 0, 0)})
    own.v = np.tile([-30.0, 0.0, 0.0], (len(own.x), 1))
    solver, model, state = made({"g": [0.0, 0.0, 0.0]}, device)
    state.particle_v = torch.tensor(own.v, device=device)
    whole, other, second = made({"g": [0.0, 0.0, 0.0]}, device)
    second.particle_v = state.particle_v
    for k in range(50):
        own.p2g2p(DT)
        whole.p2g2p(other, second, k, DT)
    state = stepped(solver, model, state, 50)
    assert float(state.particle_x[:, 0].min()) == pytest.approx(2 * DX)
    assert np.abs(state.particle_x.cpu().numpy() - own.x).max() < 1e-8
    torch.testing.assert_close(second.particle_x, state.particle_x, rtol=0, atol=1e-12)


def test_a_rollout_is_its_steps(device):
    solver, model, state = made(None, device)
    after = state.partial_clone()
    solver.rollout(model, state, after, 30, DT)
    other, model, state = made(None, device)
    last = stepped(other, model, state, 30)
    torch.testing.assert_close(after.particle_x, last.particle_x, rtol=0, atol=1e-13)
    assert solver.time == pytest.approx(other.time)
    solver.print_time_profile()


def test_deformation_from_a_displacement(device):
    """`restart_and_compute_F_C` against NumPy."""
    solver, model, state = made(None, device)
    x, volume = blob()
    target = x + 0.02 * np.sin(8 * x[:, [1, 2, 0]])
    solver.restart_and_compute_F_C(model, state, torch.tensor(target, device=device), device)
    weights, zero = Weights(x, DX, N), np.zeros((len(x), 3, 3))
    m, mv = to_grid(weights, N, RHO * volume, target - x, zero, volume, zero, 1.0, False, DX)
    u = np.where(m[:, None] > 0, mv / np.maximum(m, 1e-300)[:, None], 0)
    expected = np.eye(3) + from_grid(weights, u, DX)[2]
    np.testing.assert_allclose(state.particle_F_trial.cpu().numpy(), expected, atol=1e-10)
    np.testing.assert_allclose(state.particle_x.cpu().numpy(), target)
    assert len(nodes_of(N, DX)) == N**3


def simulated(kind, values, device):
    """Loss of `MPMDifferentiableSimulation...` by multiples of all its tensors."""
    scale = dict(zip(("x", "v", "E", "nu", "density"), values.unbind(), strict=True))
    solver, model, state = made(None, device)
    solver.add_surface_collider((0.5, 0.5, 0.33), (0.0, 0.0, 1.0))
    x, v = (torch.tensor(a, device=device) for a in (blob()[0], shear(blob()[0])))
    moduli = E * scale["E"], NU * scale["nu"]
    mask = torch.arange(len(x), device=device) % 2
    density = RHO * scale["density"]
    apply = getattr(warp_mpm, kind).apply
    if kind == "MPMDifferentiableSimulation":
        static = x + 0.01 * torch.sin(9 * x)
        arguments = 0, DT, 12, x * scale["x"], v * scale["v"], *moduli, density, mask, static
        return (apply(solver, state, model, *arguments) - 0.5).square().sum()
    F = torch.eye(3, dtype=x.dtype, device=device).repeat(len(x), 1, 1) * scale["x"]
    C = torch.zeros_like(F)
    arguments = DT, 12, x * scale["x"], v * scale["v"], F, C, *moduli, density, mask
    result = apply(solver, state, model, *arguments)
    return sum((w * part).square().sum() for w, part in zip((1.0, 0.1, 0.5, 1e-3, 1.0), result, strict=False))


KINDS = ("MPMDifferentiableSimulation", "MPMDifferentiableSimulationWCheckpoint", "MPMDifferentiableSimulationClean")


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_simulations(kind, device):
    values = torch.ones(5, dtype=torch.float64, device=device, requires_grad=True)
    (grad,) = torch.autograd.grad(simulated(kind, values, device), values)
    assert bool((grad != 0).all())
    with torch.no_grad():
        for k in range(5):
            h = 1e-6 * torch.nn.functional.one_hot(torch.tensor(k), 5).to(values)
            difference = (simulated(kind, values + h, device) - simulated(kind, values - h, device)) / 2e-6
            assert float(grad[k]) == pytest.approx(float(difference), rel=1e-4)


def test_tensors_keep_their_gradients(device):
    """`.grad` of the model and of states on the way, and what is detached on demand."""
    solver, model, state = made(None, device)
    modulus = torch.full_like(state.particle_mass, E, requires_grad=True)
    model.from_torch(modulus, torch.full_like(modulus, NU))
    middle = state.partial_clone()
    solver.p2g2p_differentiable(model, state, middle, DT)
    assert middle.particle_x.requires_grad
    after = stepped(solver, model, middle, 3)
    after.particle_x.square().sum().backward()
    assert float(modulus.grad.abs().sum()) > 0 and float(middle.particle_x.grad.abs().sum()) > 0
    assert model.E is modulus
    after.set_require_grad(False)
    assert not after.particle_x.requires_grad
    state.set_require_grad(True)
    model.set_require_grad(True)
    assert state.particle_x.requires_grad and model.E.requires_grad
    state.reset_state(after.particle_x, requires_grad=False)
    assert not state.particle_x.requires_grad and torch.equal(state.particle_F, state.particle_F_trial)


def test_densities_of_a_mask(device):
    _, _, state = made(None, device)
    mask = (torch.arange(len(state.particle_x), device=device) % 3 == 0).int()
    density = torch.full_like(state.particle_mass, 900.0)
    state.reset_density(density, mask, update_mass=True)
    expected = torch.where(mask == 1, 900.0, RHO).to(state.particle_vol)
    torch.testing.assert_close(state.particle_mass, expected * state.particle_vol)
    before = state.particle_mass
    state.reset_state(state.particle_x, None, None, 2 * density, mask)
    assert torch.equal(state.particle_mass, before) and float(state.particle_density.max()) == 1800


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda s, m, p: s.set_parameters_dict(m, p, {"E": 1.0}), ValueError, "'E' is not supported: call set_E_nu"),
        (lambda s, m, p: s.set_parameters_dict(m, p, {"denstiy": 1.0}), ValueError, "nearest known key is 'density'"),
        (lambda s, m, p: s.set_parameters_dict(m, p, {"material": "water"}), TypeError, "material must be one of"),
        (lambda s, m, p: s.set_parameters_dict(m, p, {"kappa": 1.0}), ValueError, "law of MPMAvatar's cloth does not"),
        (lambda s, m, p: s.set_E_nu(m, -m.E, m.nu), ValueError, r"E must be .*, got -\S+ for particle 0$"),
        (lambda s, m, p: s.rollout(m, p, None, 1, DT), TypeError, "next_state must be an MPMStateStruct, got NoneType"),
        (lambda s, m, p: s.p2g2p(p, p, 0, DT), TypeError, "mpm_model must be an MPMModelStruct, got MPMStateStruct"),
        (lambda s, m, p: p.from_torch(torch.ones(64, 3).long(), p.particle_vol), TypeError, "tensor_x must be float32"),
        (lambda s, m, p: m.mass, AttributeError, "MPMModelStruct has no 'mass'"),
        (lambda s, m, p: setattr(p, "particle_y", 1), AttributeError, "nearest known name is 'particle_"),
        (lambda s, m, p: p.reset_state(p.particle_x, tensor_density=p.particle_mass), ValueError, "given together"),
        (lambda s, m, p: s.set_E_nu_from_torch(m, m.E, m.nu, m.E, m.E), NotImplementedError, "gamma and kappa"),
        (lambda s, m, p: s.release_particles_sequentially(), NotImplementedError, "enforce_particle_velocity_by_mask"),
        (lambda s, m, p: s.enforce_grid_velocity_by_mask(torch.ones(3)), ValueError, "selection_mask must have shape"),
    ],
)
def test_what_cannot_be_done_is_said(call, error, message):
    solver, model, state = made()
    with pytest.raises(error, match=message):
        call(solver, model, state)


def test_a_material_without_its_parameters():
    solver, model, state = made({"material": "metal"})
    with pytest.raises(ValueError, match=r"yield_stress of 'metal' must be positive, got 0 for particle 0$"):
        solver.rollout(model, state, state, 1, DT)
    solver, model, state = made()
    model.mu = torch.zeros_like(model.mu)
    with pytest.raises(ValueError, match="mu must be positive: call set_E_nu and prepare_mu_lam"):
        solver.rollout(model, state, state, 1, DT)
    solver, model, state = made()
    state.particle_vol = 0 * state.particle_vol
    with pytest.raises(ValueError, match="volumes of the particles must be positive"):
        solver.rollout(model, state, state, 1, DT)
    fresh = MPMStateStruct()
    fresh.init(2)
    with pytest.raises(ValueError, match="the state must have 64 particles, got 2"):
        solver.rollout(model, fresh, fresh, 1, DT)
