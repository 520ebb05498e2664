"""The step of PhysGaussian's simulator once more, in NumPy and float64, and particles for it."""

import math

import numpy as np
import torch
from compat.restated import EYE, Weights, corotated, from_grid, lame, nodes_of, rotations_svd, times, to_grid

from torch_mpm.compat.physgaussian import MPM_Simulator_WARP

N, LIM, DT = 20, 1.0, 2e-4
DX = LIM / N


class Restated:
    """Return map and stress of the trial F, gradient-form P2G with APIC, gravity, conditions on nodes, G2P."""

    def __init__(self, x, volume, density, material="jelly", E=1e5, nu=0.3, g=(0, 0, 0), **options):
        self.x, self.v, self.C = x.copy(), np.zeros_like(x), np.zeros((len(x), 3, 3))
        self.F, self.volume = np.tile(EYE, (len(x), 1, 1)), volume
        self.mass, self.material, self.g, self.time = density * volume, material, np.array(g, float), 0.0
        self.mu, self.lam = (np.broadcast_to(m, len(x)).copy() for m in lame(E, nu))
        self.limit = np.broadcast_to(options.get("yield_stress", 0.0), len(x)).copy()
        self.options = options
        self.before, self.on_nodes = [], []
        self.nodes = nodes_of(N, DX)

    def metal(self, F, breaks):
        U, s, Vh = rotations_svd(F)
        e = np.log(np.maximum(s, 0.01))
        mean = e.mean(1, keepdims=True)
        dev = e - mean
        for p in range(len(F)):
            size = np.linalg.norm(dev[p])
            if not 2 * self.mu[p] * size > self.limit[p] or (breaks and self.limit[p] <= 0):
                continue
            size += 1e-6
            gamma = size - self.limit[p] / (2 * self.mu[p])
            F[p] = U[p] @ np.diag(np.exp(e[p] - gamma / size * dev[p])) @ Vh[p]
            if breaks:
                self.limit[p] -= self.options["softening"] * np.linalg.norm(gamma / size * dev[p])
                if self.limit[p] <= 0:
                    self.mu[p] = self.lam[p] = 0
            if self.options.get("hardening") == 1:
                self.limit[p] += 2 * self.mu[p] * self.options["xi"] * gamma
        return F

    def foam(self, F, dt):
        U, s, Vh = rotations_svd(F)
        e = np.log(np.maximum(s, 0.01))
        dev = e - e.mean(1, keepdims=True)
        for p in range(len(F)):
            trial = 2 * self.mu[p] * np.linalg.norm(dev[p])
            beyond = trial - math.sqrt(2 / 3) * self.limit[p]
            if beyond > 0:
                rate = 2 * self.mu[p] * (s[p] ** 2).mean() * dt
                new = trial - beyond / (1 + self.options["plastic_viscosity"] / rate)
                F[p] = U[p] @ np.diag(np.exp(e[p].mean() + new / trial * dev[p])) @ Vh[p]
        return F

    def sand(self, F):
        sin = math.sin(math.radians(self.options["friction_angle"]))
        alpha = math.sqrt(2 / 3) * 2 * sin / (3 - sin)
        U, s, Vh = rotations_svd(F)
        e = np.log(np.abs(s))
        for p in range(len(F)):
            trace = e[p].sum()
            dev = e[p] - trace / 3
            gamma = np.linalg.norm(dev) + (3 * self.lam[p] + 2 * self.mu[p]) / (2 * self.mu[p]) * trace * alpha
            if gamma > 0:
                H = e[p] - gamma * dev / np.linalg.norm(dev) if trace <= 0 else np.zeros(3)
                F[p] = U[p] @ np.diag(np.exp(H)) @ Vh[p]
        return F

    def stress(self, dt):
        F = self.F
        if self.material in ("metal", "plasticine"):
            F = self.metal(F, self.material == "plasticine")
        elif self.material == "foam":
            F = self.foam(F, dt)
        elif self.material == "sand":
            F = self.sand(F)
        self.F = F
        mu, lam = self.mu[:, None], self.lam[:, None]
        if self.material in ("jelly", "plasticine"):
            return corotated(F, mu[:, :, None], self.lam)
        U, s, Vh = rotations_svd(F)
        e = np.log(np.maximum(s, 0.01)) if self.material != "sand" else np.log(s)
        tau = 2 * mu * e + lam * e.sum(1, keepdims=True)
        return times(U, tau / s if self.material == "sand" else tau, Vh) @ F.transpose(0, 2, 1)

    def p2g2p(self, dt):
        for act in self.before:
            act(self, dt)
        stress = self.stress(dt)
        weights = Weights(self.x, DX, N)
        d = self.options.get("rpic_damping", 0.0)
        C = (1 - d) * self.C + d / 2 * (self.C - self.C.transpose(0, 2, 1))
        m, mv = to_grid(weights, N, self.mass, self.v, 0 * C if d < 0 else C, self.volume, stress, dt, False, DX)
        v = np.where(m[:, None] > 1e-15, mv / np.maximum(m, 1e-300)[:, None] + dt * self.g, 0)
        v = v * min(self.options.get("grid_v_damping_scale", 1.0), 1.0)
        for act in self.on_nodes:
            act(self, v, dt)
        self.v, self.C, grad = from_grid(weights, v, DX)
        self.x = self.x + dt * self.v
        self.F = (EYE + dt * grad) @ self.F
        self.time += dt


def floor(height):
    def act(sim, v, dt):
        v[sim.nodes[:, 2] < height - 1e-9] = 0

    return act


def bounding_box(sim, v, dt):
    index = np.rint(sim.nodes / DX).astype(int)
    for k in range(3):
        v[(index[:, k] < 3) & (v[:, k] < 0), k] = 0
        v[(index[:, k] >= N - 3) & (v[:, k] > 0), k] = 0


def blob(count=4, low=0.35, high=0.6, seed=0):
    """Jittered particles in a cube, positions [P, 3] and volumes [P]."""
    rng = np.random.default_rng(seed)
    axis = np.linspace(low, high, count)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    x = x + 0.2 * (high - low) / count * rng.uniform(-1, 1, x.shape)
    return x, np.full(len(x), ((high - low) / count) ** 3)


def pair(parameters, velocity=None, device="cpu", dtype=torch.float64, **options):
    """Both simulators with the same particles and parameters."""
    x, volume = blob()
    sim = MPM_Simulator_WARP(10, **options)
    sim.load_initial_data_from_torch(
        torch.tensor(x, dtype=dtype), torch.tensor(volume, dtype=dtype), n_grid=N, grid_lim=LIM, device=device
    )
    sim.set_parameters_dict(parameters)
    own = Restated(x, volume, **{k: v for k, v in parameters.items() if k != "additional_material_params"})
    if velocity is not None:
        own.v = velocity(x)
        sim.import_particle_v_from_torch(torch.tensor(own.v, dtype=dtype, device=device))
    return sim, own


def run(sim, own, steps=100, dt=DT):
    for k in range(steps):
        sim.p2g2p(k, dt)
        own.p2g2p(dt)
    return sim.export_particle_x_to_torch().detach().cpu().numpy()


def shear(x):
    c = x - x.mean(0)
    return np.stack([4 * c[:, 2], -3 * c[:, 0], -2 - 2 * c[:, 2]], 1)
