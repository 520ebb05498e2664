"""The solver and the models of MPM-PyTorch against their published step, restated in NumPy."""

import math

import numpy as np
import pytest
import torch
from compat.restated import EYE, Weights, corotated, from_grid, lame, nodes_of, rotations_svd, times, to_grid

from torch_mpm.compat.mpm_pytorch import MPMSolver, get_constitutive, set_boundary_conditions
from torch_mpm.compat.mpm_pytorch import constitutive_models as models

N, DT = 25, 3e-4


class Restated:
    def __init__(self, x, damping=1.0, clip_bound=0.5, size=(1, 1, 1)):
        self.x, self.v, self.C = x.copy(), np.zeros_like(x), np.zeros((len(x), 3, 3))
        self.F = np.tile(EYE, (len(x), 1, 1))
        self.volume = np.full(len(x), np.prod(size) / len(x))
        self.mass, self.g, self.damping, self.clip = (
            1000.0 * self.volume,
            np.array([0, 0, -9.8]),
            damping,
            clip_bound / N,
        )
        self.time, self.nodes = 0.0, nodes_of(N, 1 / N)
        self.before, self.on_nodes = [], []

    def step(self, stress):
        weights = Weights(self.x, 1 / N, N)
        for act in self.before:
            act(self)
        m, mv = to_grid(weights, N, self.mass, self.v, self.C, self.volume, stress, DT, False, 1 / N)
        v = self.damping * (mv / np.where(m > 1e-15, m, 1)[:, None] + DT * self.g)
        for act in self.on_nodes:
            act(self, v)
        self.v, self.C, grad = from_grid(weights, v, 1 / N)
        self.x = np.clip(self.x + DT * self.v, self.clip, 1 - self.clip)
        self.F = np.clip((EYE + DT * grad) @ self.F, -2, 2)
        self.time += DT


def elasticity(name, F, E, nu):
    mu, lam = lame(E, nu)
    J = np.linalg.det(F)
    volume = (lam * J * (J - 1))[:, None, None] * EYE
    if name == "CorotatedElasticity":
        return corotated(F, mu, lam)
    if name in ("FluidElasticity", "VolumeElasticity"):
        return volume
    if name == "StVKElasticity":
        return 2 * mu * F @ (0.5 * (F.transpose(0, 2, 1) @ F - EYE)) + volume
    U, s, _ = rotations_svd(F)
    e = np.log(s)
    return times(U, 2 * mu * e + lam * e.sum(1, keepdims=True), U.transpose(0, 2, 1))


def plasticity(name, F, E, nu, limit=1e3, angle=25.0, cohesion=0.0):
    mu, lam = lame(E, nu)
    if name == "IdentityPlasticity":
        return F
    if name == "SigmaPlasticity":
        return np.clip(np.linalg.det(F), 0.05, 1.2)[:, None, None] ** (1 / 3) * EYE
    U, s, Vh = rotations_svd(F)
    e = np.log(np.maximum(s, 0.05))
    dev = e - e.mean(1, keepdims=True)
    size = np.maximum(np.linalg.norm(dev, axis=1, keepdims=True), 1e-10)
    if name == "VonMisesPlasticity":
        gamma = size - limit / (2 * mu)
        return np.where((gamma > 0)[:, :, None], times(U, np.exp(e - gamma / size * dev), Vh), F)
    sin = math.sin(math.radians(angle))
    alpha = math.sqrt(2 / 3) * 2 * sin / (3 - sin)
    shifted = e.sum(1, keepdims=True) - 3 * cohesion
    gamma = np.maximum(size + (3 * lam + 2 * mu) / (2 * mu) * shifted * alpha, 0)
    return times(U, np.exp(np.where(shifted < 0, e - gamma / size * dev, cohesion)), Vh)


def strained(count=200, size=0.2, seed=2):
    F = EYE + size * np.random.default_rng(seed).normal(size=(count, 3, 3))
    F = F[np.linalg.det(F) > 0.2]
    F[0], F[1] = EYE, np.diag([1.1, 1.1, 0.9])
    return F


NAMES = [name for name in models.__all__ if name not in ("Elasticity", "Plasticity", "get_constitutive")]


@pytest.mark.parametrize("name", NAMES)
def test_models_are_the_published_ones(name, device):
    """At strains of every size, at F = I and at equal stretches; and their gradients are finite there."""
    model = get_constitutive(name, device)
    for size in (0.2, 1e-3):
        F = strained(size=size)
        restated = elasticity if name.endswith("Elasticity") else plasticity
        expected = restated(name, F, 2e6, 0.4)
        leaf = torch.tensor(F, device=device, requires_grad=True)
        value = model(leaf)
        scale = np.abs(expected).max()
        assert np.abs(value.detach().cpu().numpy() - expected).max() < 1e-6 * scale  # E is a float32 logarithm
        if value.requires_grad:
            assert bool(torch.autograd.grad(value.square().sum(), leaf)[0].isfinite().all())


def test_models_with_other_parameters(device):
    """Cohesion, a yield stress, and log E and ν per particle with gradients."""
    F = strained(size=0.05)
    for cohesion in (0.02, 0.0):
        model = models.DruckerPragerPlasticity(1e6, 0.3, 35.0, cohesion).to(device)
        expected = plasticity("DruckerPragerPlasticity", F, 1e6, 0.3, angle=35.0, cohesion=cohesion)
        assert np.abs(model(torch.tensor(F, device=device)).cpu().numpy() - expected).max() < 1e-6
    E = np.geomspace(1e5, 1e6, len(F))
    log_E = torch.tensor(np.log(E), device=device, requires_grad=True)
    nu = torch.full((len(F),), 0.25, dtype=torch.float64, device=device)
    stress = models.CorotatedElasticity().to(device)(torch.tensor(F, device=device), log_E, nu)
    mu, lam = lame(E, 0.25)
    expected = corotated(F, mu[:, None, None], lam)
    assert np.abs(stress.detach().cpu().numpy() - expected).max() < 1e-9 * np.abs(expected).max()
    (grad,) = torch.autograd.grad((stress * torch.tensor(expected, device=device)).sum(), log_E)
    np.testing.assert_allclose(grad.cpu().numpy(), (expected**2).sum((1, 2)), rtol=1e-8)  # dτ/dlogE = τ


def cube(seed=0, count=4):
    rng = np.random.default_rng(seed)
    axis = np.linspace(0.3, 0.6, count)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return x + 0.01 * rng.uniform(-1, 1, x.shape)


def run(
    conditions, before=(), on_nodes=(), names=("CorotatedElasticity", "IdentityPlasticity"), device="cpu", **options
):
    """Largest error of positions after 100 steps, and how far particles went."""
    x0 = cube()
    v0 = np.stack([x0[:, 2] - 0.5, 0 * x0[:, 0], -1 - x0[:, 0]], 1)
    x, v = (torch.tensor(a, device=device) for a in (x0, v0))
    C = torch.zeros(len(x0), 3, 3, dtype=torch.float64, device=device)
    F = torch.eye(3, dtype=torch.float64, device=device).repeat(len(x0), 1, 1)
    solver = MPMSolver(x, size=(0.3, 0.3, 0.3), device=device, **options)
    set_boundary_conditions(solver, conditions)
    elastic, plastic = (get_constitutive(name, device=device) for name in names)
    own = Restated(x0, size=(0.3, 0.3, 0.3), **options)
    own.v = v0.copy()
    own.before += before
    own.on_nodes += on_nodes
    E = float(elastic.log_E.double().exp())
    for _ in range(100):
        x, v, C, F = solver(x, v, C, F, elastic(F))
        F = plastic(F)
        own.step(elasticity(names[0], own.F, E, 0.4))
        own.F = plasticity(names[1], own.F, E, 0.4)
    assert solver.time == pytest.approx(own.time)
    return np.abs(x.cpu().numpy() - own.x).max(), np.abs(own.x - x0).max()


FLOOR = {"type": "surface_collider", "point": [1, 1, 0.27], "normal": [0, 0, 1.0], "friction": 0.0}


@pytest.mark.parametrize("surface", ["sticky", "slip", "collide"])
def test_trajectories_on_surfaces(surface, device):
    def act(sim, v):
        behind = sim.nodes[:, 2] < 0.27
        v[behind] = {"sticky": 0, "slip": v[behind] * [1, 1, 0], "collide": v[behind] * [1, 1, -1]}[surface]

    condition = FLOOR | {"surface": surface, "start_time": 0.0, "end_time": 1e3}
    error, moved = run([condition], on_nodes=[act], device=device)
    assert error < 1e-6 and moved > 0.015


def test_trajectories_of_sand_and_clamps(device):
    """Sand on the bound of positions, with damped nodes."""
    names = ("StVKElasticity", "DruckerPragerPlasticity")
    error, moved = run(None, names=names, device=device, damping=0.999, clip_bound=7.2)
    assert error < 1e-6 and moved > 0.01


def test_operations_on_particles_and_nodes(device):
    x0 = cube()
    held = {"point": [0.5, 0.5, 0.6], "size": [1, 1, 0.04], "velocity": [0, 1, 0], "start_time": 0.0, "end_time": 0.01}
    box = {"point": [0.6, 0.6, 0.6], "size": [0.1, 0.1, 0.1], "velocity": [0, 0, 1], "start_time": 0.006}
    conditions = [
        {
            "type": "particle_impulse",
            "force": [90.0, 0, 0],
            "point": [0.3, 0.5, 0.5],
            "size": [0.05, 1, 1],
            "num_dt": 8,
        },
        {"type": "enforce_particle_translation", **held},
        {"type": "sdf_collider", "bound": 0.29, "dim": 2, "start_time": 0.0, "end_time": 1.0},
        {"type": "cuboid", "end_time": 0.018, "reset": True, **box},
    ]

    def push(sim):
        if sim.time < 8 * DT:
            chosen = np.abs(x0[:, 0] - 0.3) < 0.05
            sim.v[chosen] += DT * np.array([90.0, 0, 0]) / sim.mass[0]

    def slide(sim):
        if sim.time < 0.01:
            sim.v[np.abs(x0[:, 2] - 0.6) < 0.04] = [0, 1, 0]

    def project(sim):
        shift = np.clip(sim.x[:, 2], 0.29, 0.71) - sim.x[:, 2]
        sim.x[:, 2] += shift
        sim.v[:, 2] += shift / DT

    def cuboid(sim, v):
        inside = (np.abs(sim.nodes - 0.6) < 0.1 - 1e-12).all(1)
        if 0.006 <= sim.time <= 0.018:
            v[inside] = [0, 0, 1]
        elif sim.time < 0.018 + 15 * DT:
            v[inside] = 0

    error, _ = run(conditions, before=[push, slide, project], on_nodes=[cuboid], device=device)
    assert error < 1e-6


def test_gradients_pass_through_steps(device):
    """By a stiffness that a model takes in its call, against a central difference."""
    x0 = torch.tensor(cube(count=4), device=device)
    start = 2 * (x0 - x0.mean(0)) * torch.tensor([1.0, -1.0, 0.5], device=device)

    def loss(log_E):
        solver = MPMSolver(x0, size=(0.3, 0.3, 0.3))
        x, v, C = x0, start, torch.zeros(len(x0), 3, 3, dtype=x0.dtype, device=device)
        F = torch.eye(3, dtype=x0.dtype, device=device).repeat(len(x0), 1, 1)
        model = models.SigmaElasticity().to(device)
        for _ in range(20):
            x, v, C, F = solver(x, v, C, F, model(F, log_E=log_E))
        return (x**2).sum()

    log_E = torch.tensor(math.log(2e6), dtype=torch.float64, device=device, requires_grad=True)
    (grad,) = torch.autograd.grad(loss(log_E), log_E)
    with torch.no_grad():
        difference = (loss(log_E + 1e-5) - loss(log_E - 1e-5)) / 2e-5
    assert float(grad) == pytest.approx(float(difference), rel=1e-5)


def test_bad_input_is_named():
    x = torch.full((4, 3), 0.5)
    with pytest.raises(ValueError, match=r"init_pos must have shape \[P, 3\], got \[4\]"):
        MPMSolver(x[:, 0])
    with pytest.raises(ValueError, match="damping must be between 0 and 1, got 2"):
        MPMSolver(x, damping=2)
    solver = MPMSolver(x)
    with pytest.raises(TypeError, match="type of a boundary condition must be one of"):
        set_boundary_conditions(solver, [{"type": "wind"}])
    with pytest.raises(TypeError, match="surface must be 'sticky', 'slip' or 'collide', got 'cut'"):
        set_boundary_conditions(solver, [FLOOR | {"surface": "cut"}])
    with pytest.raises(ValueError, match=r"constitutive_name must be one of .*, got 'Jelly'"):
        get_constitutive("Jelly")
    C = torch.zeros(4, 3, 3)
    with pytest.raises(ValueError, match=r"stress must have shape \[P, 3, 3\]"):
        solver(x, 0 * x, C, C, C[:2])
    empty = MPMSolver(x[:0])
    after = empty(x[:0], x[:0], C[:0], C[:0], C[:0])
    assert [tuple(t.shape) for t in after] == [(0, 3), (0, 3), (0, 3, 3), (0, 3, 3)]
