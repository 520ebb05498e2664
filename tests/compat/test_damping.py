"""`rpic_damping` and `grid_v_damping_scale` of every simulator that has them, against the published step in torch."""

import functools

import pytest
import torch

from torch_mpm.compat.physgaussian import DIALECTS, MPM_Simulator_WARP
from torch_mpm.compat.warp_mpm import MPMModelStruct, MPMStateStruct, MPMWARPDiff

N, DT, E, NU, RHO = 20, 5e-4, 1e5, 0.3, 500.0
DX = 1 / N
G, PULL = (0.0, 1.0, -9.8), (0.5, 0.0, 0.2)
STEPS = 100


def cube(dtype=torch.float64):
    """Positions [P, 3], volumes [P] and velocities [P, 3]."""
    axis = 0.36 + 0.06 * torch.arange(4, dtype=torch.float64)
    x = torch.cartesian_prod(axis, axis, axis)
    x = x + 0.01 * torch.sin(37 * x.roll(1, 1))
    v = 3 * torch.stack([x[:, 1] - 0.45, 0.45 - x[:, 0] + x[:, 2], 0.4 - x[:, 2]], 1)
    return x.to(dtype), torch.full((len(x),), 0.06**3, dtype=dtype), v.to(dtype)


def stress_of(F):
    """Fixed corotated Kirchhoff stress."""
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    U, _, Vh = torch.linalg.svd(F)
    J = torch.linalg.det(F)[:, None, None]
    return 2 * mu * (F - U @ Vh) @ F.mT + lam * J * (J - 1) * torch.eye(3, dtype=F.dtype)


def published(x, volume, v, damping, scale, clipped=False, steps=STEPS):
    """Positions after some steps: quadratic splines, forces by ∇N, APIC, a region with a given velocity."""
    nodes = DX * torch.cartesian_prod(*[torch.arange(N, dtype=x.dtype)] * 3)
    inside = ((nodes - torch.tensor([0.5, 0.5, 0.3])).abs() < torch.tensor([9.0, 9.0, 0.11])).all(1)
    g, pull, eye = (torch.tensor(a, dtype=x.dtype) for a in (G, PULL, torch.eye(3).tolist()))
    C, F = torch.zeros(len(x), 3, 3, dtype=x.dtype), eye.repeat(len(x), 1, 1)
    i, j, k = corners = torch.cartesian_prod(*[torch.arange(3)] * 3).T  # The 27 nodes of a particle.
    for _ in range(steps):
        base = (x / DX - 0.5).long()
        f = x / DX - base
        w = torch.stack([(1.5 - f) ** 2 / 2, 0.75 - (f - 1) ** 2, (f - 0.5) ** 2 / 2])
        d = torch.stack([f - 1.5, 2 - 2 * f, f - 0.5]) / DX
        a, b, c = w[i, :, 0], w[j, :, 1], w[k, :, 2]
        weight = a * b * c  # [27, P]
        slope = torch.stack([d[i, :, 0] * b * c, a * d[j, :, 1] * c, a * b * d[k, :, 2]], 2)
        arm = (corners.T[:, None] - f) * DX
        node = ((base + corners.T[:, None]) * torch.tensor([N * N, N, 1])).sum(2)
        blended = 0 * C if damping < -0.001 else (1 - damping) * C + damping / 2 * (C - C.mT)
        moving = v + torch.einsum("pab,ipb->ipa", blended, arm)
        force = -torch.einsum("p,pab,ipb->ipa", volume, stress_of(F), slope)
        momentum = (RHO * volume * weight)[:, :, None] * moving + DT * force
        mass = x.new_zeros(N**3).index_add(0, node.flatten(), (RHO * volume * weight).flatten())
        total = x.new_zeros(N**3, 3).index_add(0, node.flatten(), momentum.flatten(0, 1))
        full = mass > 1e-15
        grid = torch.where(full[:, None], total / torch.where(full, mass, 1)[:, None] + DT * g, 0)
        grid = torch.where(inside[:, None], pull, scale * grid if scale < 1 else grid)
        u = grid[node]
        v = (weight[:, :, None] * u).sum(0)
        C = 4 / DX**2 * torch.einsum("ip,ipa,ipb->pab", weight, u, arm)
        x, F = x + DT * v, (eye + DT * torch.einsum("ipa,ipb->pab", u, slope)) @ F
        x = x.clamp(2 * DX, 1 - 2 * DX) if clipped else x
    return x


@functools.lru_cache
def expected_after(damping, scale, clipped=False, steps=STEPS):
    """`published` in float64, which several tests compare with."""
    return published(*cube(), damping, scale, clipped, steps)


def simulator(dialect, damping, scale, dtype=torch.float64):
    x, volume, v = cube(dtype)
    sim = MPM_Simulator_WARP(10, dialect=dialect)
    sim.load_initial_data_from_torch(x, volume, n_grid=N)
    sim.import_particle_v_from_torch(v)
    given = {"nu": NU, "density": RHO, "g": list(G), "rpic_damping": damping, "grid_v_damping_scale": scale}
    sim.set_parameters_dict(given | {"material": "jelly", "E": E / DIALECTS[dialect].units.get("E", 1.0)})
    sim.set_velocity_on_cuboid([0.5, 0.5, 0.3], [9.0, 9.0, 0.11], list(PULL))
    sim.finalize_mu_lam()
    return sim


def stepped(sim, steps=STEPS):
    for k in range(steps):
        sim.p2g2p(DT) if sim.dialect.name == "motionphysics" else sim.p2g2p(k, DT)
    return sim.export_particle_x_to_torch()


def diff_simulator(damping, scale, dtype=torch.float64, steps=STEPS):
    x, volume, v = cube(dtype)
    state, model, solver = MPMStateStruct(), MPMModelStruct(), MPMWARPDiff(len(x), n_grid=N)
    state.init(len(x))
    state.from_torch(x, volume, None, v, n_grid=N)
    model.init(len(x))
    model.init_other_params(n_grid=N)
    given = {"material": "jelly", "density": RHO, "g": list(G)}
    solver.set_parameters_dict(model, state, given | {"rpic_damping": damping, "grid_v_damping_scale": scale})
    solver.set_E_nu(model, torch.tensor(E, dtype=dtype), torch.tensor(NU, dtype=dtype))
    solver.prepare_mu_lam(model, state)
    solver.set_velocity_on_cuboid([0.5, 0.5, 0.3], [9.0, 9.0, 0.11], list(PULL))
    solver.rollout(model, state, state, steps, DT)
    return state.particle_x


PAIRS = [(0.35, 0.995), (1.0, 1.0), (0.0, 0.99), (-0.0005, 1.5), (-0.01, 0.998)]
"""Blend, RPIC, damped nodes, a small negative share that is no PIC, and PIC."""


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
@pytest.mark.parametrize(("damping", "scale"), PAIRS)
def test_trajectories(damping, scale, dtype, bound):
    """100 steps, and a change that is far above the difference."""
    expected = expected_after(damping, scale)
    found = stepped(simulator("physgaussian", damping, scale, dtype))
    assert found.dtype == dtype and float((found - expected).abs().max()) < bound
    assert float((expected - expected_after(0.0, 1.0)).abs().max()) > (1e-6 if damping == -0.0005 else 1e-3)


OTHERS = [name for name in DIALECTS if name not in ("physgaussian", "physics3d", "kywind", "warp_mpm")]


@pytest.mark.parametrize("dialect", OTHERS)
def test_every_dialect_has_both(dialect):
    """All but kywind's, where C is not blended, and the jelly of Physics3D, which is another one."""
    sim = simulator(dialect, 0.35, 0.995)
    if dialect == "gaussianfluent":
        flip, sim.p2g2p = sim.p2g2p, lambda k, dt: flip(k, dt, flip_pic=False)
    expected = expected_after(0.35, 0.995, dialect == "motionphysics", 20)
    assert float((stepped(sim, 20) - expected).abs().max()) < 1e-10


@pytest.mark.parametrize(("damping", "scale"), PAIRS[:2])
def test_the_differentiable_simulator(damping, scale):
    expected = expected_after(damping, scale, clipped=True)
    with torch.no_grad():
        assert float((diff_simulator(damping, scale) - expected).abs().max()) < 1e-10


RUNS = {
    "MPM_Simulator_WARP": lambda *values: stepped(simulator("physgaussian", *values), 10),
    "MPMWARPDiff": lambda *values: diff_simulator(*values, steps=10),
}


@pytest.mark.parametrize("name", ["damping", "scale"])
@pytest.mark.parametrize("run", RUNS.values(), ids=RUNS)
def test_gradients_are_those_of_the_published_step(run, name):
    """By the gradient that torch computes of the step above, and by a central difference."""
    x, volume, v = cube()
    values = {"damping": 0.35, "scale": 0.97}
    weight = torch.sin(torch.arange(x.numel(), dtype=x.dtype)).reshape(x.shape)

    def of(step, value):
        return (weight * step(*(values | {name: value}).values())).sum()

    gradients = []
    for step in (run, lambda *a: published(x, volume, v, *a, steps=10)):
        given = torch.tensor(values[name], dtype=torch.float64, requires_grad=True)
        gradients += torch.autograd.grad(of(step, given), given)
    assert float(gradients[0]) == pytest.approx(float(gradients[1]), rel=1e-7) and float(gradients[0]) != 0
    with torch.no_grad():
        plus, minus = (of(run, values[name] + h) for h in (1e-5, -1e-5))
    assert float(gradients[0]) == pytest.approx(float(plus - minus) / 2e-5, rel=1e-4)


@pytest.mark.parametrize(
    ("damping", "scale", "words"),
    [
        (0.35, 1.0, "on_particles, DampedAffine"),
        (0.0, 0.9, "all steps in one op"),
        (0.0, torch.tensor(0.9), "torch operations, Damping"),
    ],
)
def test_explain_names_what_acts_step_by_step(damping, scale, words):
    sim = simulator("physgaussian", damping, scale)
    assert words in sim.step.explain(sim.state, DT)
