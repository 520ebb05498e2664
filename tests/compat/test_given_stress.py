"""Calls of a solver that replay a CUDA graph against calls that do not, with changes between them."""

import pytest
import torch

from torch_mpm.compat.given_stress import GivenStressSteps
from torch_mpm.compat.mpm_pytorch import MPMSolver, set_boundary_conditions
from torch_mpm.compat.nclaw import sim

N, DT, P = 20, 1e-3, 60
F64 = torch.float64


def particles(device):
    x = 0.4 + 0.2 * torch.rand(P, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    C = torch.zeros(P, 3, 3, dtype=F64)
    return tuple(t.to(device) for t in (x, torch.ones_like(x), C, torch.eye(3, dtype=F64).repeat(P, 1, 1)))


def stress_of(F):
    return 1e3 * (F @ F.mT - torch.eye(3, dtype=F.dtype, device=F.device))


def of_mpm_pytorch(device):
    """A call of the solver, changes of the solver, and particles."""
    state = particles(device)
    solver = MPMSolver(state[0], num_grids=N, dt=DT, device=device)

    def gravity_in_place():
        solver.gravity[0] = 3.0

    def other_gravity():
        solver.gravity = (0.0, 20.0, 0.0)

    def other_mass():
        solver.p_mass = torch.linspace(0.5, 1.0, P, dtype=F64, device=device)

    def mass_in_place():
        solver.p_mass.mul_(2.0)

    def damped():
        solver.damping = 0.9

    def held():
        set_boundary_conditions(
            solver, [{"type": "surface_collider", "point": [0.5, 0.5, 0.45], "normal": [0.0, 0.0, 1.0]}]
        )

    def free():
        solver.post_grid_process.clear()

    def fewer_cells():
        solver.clip_bound = 0.45

    changes = [None, gravity_in_place, other_gravity, other_mass, mass_in_place, damped, held, free, fewer_cells]
    return (lambda x, v, C, F: solver(x, v, C, F, stress_of(F))), changes, state


def of_nclaw(device, eps=0.0):
    state = particles(device)
    config = {"num_grids": N, "dt": DT, "bound": 3, "gravity": [0.0, 0.0, -9.8], "eps": eps, "bc": "freeslip"}
    model = sim.MPMModelBuilder().parse_cfg(config).finalize(device)
    statics = model.statics(P)
    statics.vol, statics.rho = (torch.full((P,), value, dtype=F64, device=device) for value in (1e-4, 1e3))
    statics.clip_bound = torch.full((P,), 0.5, dtype=F64, device=device)
    statics.enabled = torch.ones(P, dtype=torch.int32, device=device)
    solver = sim.MPMDiffSim(model)

    def some_enabled():
        statics.enabled[::3] = 0

    def denser():
        statics.rho = 2 * statics.rho

    def volume_in_place():
        statics.vol.mul_(0.5)

    def clipped():
        statics.clip_bound.fill_(8.5)

    changes = [None, some_enabled, denser, volume_in_place, clipped]
    return (lambda x, v, C, F: solver(statics, x, v, C, F, stress_of(F))), changes, state


SOLVERS = {
    "MPM-PyTorch": of_mpm_pytorch,
    "NCLaw": of_nclaw,
    "NCLaw, heavy nodes": lambda device: of_nclaw(device, 1e-4),
}


def history(make, device):
    """States after four steps at each change."""
    call, changes, state = make(device)
    found = []
    for change in changes:
        if change is not None:
            change()
        for _ in range(4):
            state = call(*state)
            found.append([t.clone() for t in state])
    return found


@pytest.mark.parametrize("name", SOLVERS)
def test_replays_are_the_steps(name, device, monkeypatch):
    """Results of earlier calls stay, and each change is seen by the next call."""
    replays = history(SOLVERS[name], device)
    monkeypatch.setattr(GivenStressSteps, "_kind_of", lambda *a: None)
    steps = history(SOLVERS[name], device)
    for k, (replayed, expected) in enumerate(zip(replays, steps, strict=True)):
        for a, b in zip(replayed, expected, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9, msg=lambda m, k=k: f"call {k}: {m}")
    moved = [(a[0] - b[0]).abs().max() for a, b in zip(replays, replays[4:], strict=False)]
    assert min(moved) > 1e-5


def test_a_gradient_after_replays(device):
    call, _, state = of_mpm_pytorch(device)
    with torch.no_grad():
        for _ in range(4):
            state = call(*state)
    v = state[1].clone().requires_grad_()
    after = call(state[0], v, *state[2:])[0]
    (grad,) = torch.autograd.grad(after.sum(), v)
    torch.testing.assert_close(grad.sum(), torch.tensor(3.0 * P * DT, dtype=F64, device=device))


def test_a_pool_that_grows_between_replays(device):
    """Particles that fly apart; none is lost."""
    x, _, C, F = particles(device)
    call, _, _ = of_mpm_pytorch(device)
    state = (x, 8 * (x - 0.5), C, F)
    for _ in range(60):
        state = call(*state)
    assert state[0].isfinite().all()
    torch.testing.assert_close(state[0].std(), x.std() * 1.48, rtol=0.2, atol=0)


@pytest.mark.cuda
def test_calls_of_one_kind_replay():
    call, _, state = of_mpm_pytorch("cuda")
    for _ in range(2):
        state = call(*state)
    step = call.__closure__[0].cell_contents._steps
    assert step._graph is not None
