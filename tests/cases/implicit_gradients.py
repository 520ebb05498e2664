"""Implicit steps whose gradients are compared."""

import torch

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block
from torch_mpm.implicit import Implicit

TIGHT = {"tolerance": 1e-12, "adjoint_tolerance": 1e-12}
NAMES = ("x", "v", "F", "C", "mass", "volume", "mu", "lam", "gravity", "dt")


def inputs(dim, device, dtype=torch.float64):
    """A deformed block on the floor, with all that a step reads."""
    grid = mpm.Grid(0.25, (0,) * dim, (1.5,) * dim)
    state = block((0.25, 0.0, 0.25)[:dim], (0.75, 0.5, 0.5)[:dim], grid)

    def normal(*shape):
        return torch.randn(*shape, dtype=torch.float64)

    P = len(state)
    values = {
        "x": state.x + 0.02 * normal(P, dim),
        "v": 0.5 * normal(P, dim),
        "F": torch.eye(dim, dtype=torch.float64) + 0.05 * normal(P, dim, dim),
        "C": 0.5 * normal(P, dim, dim),
        "mass": state.mass,
        "volume": state.volume,
        "mu": torch.tensor(3e4, dtype=torch.float64),
        "lam": torch.tensor(5e4, dtype=torch.float64),
        "gravity": torch.tensor([0.0, -9.8, 0.0][:dim], dtype=torch.float64),
        "dt": torch.tensor(0.02, dtype=torch.float64),
    }
    return grid, {name: value.to(device, dtype) for name, value in values.items()}


def run(grid, values, law=mpm.NeoHookean, n=1, options=None, **arguments):
    step = mpm.Step(
        grid,
        law(mu=values["mu"], lam=values["lam"]),
        gravity=values["gravity"],
        integrator=Implicit(**(options or TIGHT)),
        **arguments,
    )
    fields = {name: values[name] for name in ("x", "v", "F", "C", "mass", "volume")}
    state = mpm.State(**fields)
    for _ in range(n):
        state = step(state, values["dt"])
    assert bool(step.solve_report.converged.all())
    return step, state
