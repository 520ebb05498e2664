"""Find the stiffness of a soft beam from its sag under its weight: gradients of a static equilibrium.

A cantilever is measured at its tip, here in a simulation with a Young's modulus unknown to the search. One implicit
step without inertia is the equilibrium, and its gradient costs one more linear solve.
"""

import argparse

import torch

import torch_mpm as mpm
from torch_mpm.implicit import Implicit, equilibrium

LENGTH, HEIGHT, DX = 1.0, 0.1, 0.025  # [m]


def sag(E: torch.Tensor) -> torch.Tensor:
    """Displacement of the tip of the beam downwards [m]."""
    grid = mpm.Grid(dx=DX, lower=(-0.2, -0.8), upper=(1.1, 0.4))
    points = mpm.seed.box((-2 * DX, -HEIGHT / 2), (LENGTH, HEIGHT / 2), grid, per_cell=4)
    beam = mpm.State.at_rest(points, density=1000.0, dtype=torch.float64)
    clamp = mpm.Plane((0.0, 0.0), (1.0, 0.0), kind="sticky")
    law, solver = mpm.NeoHookean(E=E, nu=0.3), Implicit(tolerance=1e-8)
    step = mpm.Step(grid, law, gravity=(0, -9.8), boundaries=[clamp], integrator=solver)
    end = equilibrium(step, beam, dt=1e3)
    step.check()
    tip = beam.x[:, 0] > LENGTH - DX
    return (beam.x - end.x)[tip, 1].mean()


def main(iterations: int = 8) -> float:
    """Returns the relative error of the identified stiffness."""
    truth = 3e6
    measured = sag(torch.tensor(truth, dtype=torch.float64))
    log_E = torch.tensor(2e7, dtype=torch.float64).log().requires_grad_()
    for k in range(iterations):
        found = sag(log_E.exp())
        (slope,) = torch.autograd.grad(found.log(), log_E)
        print(f"{k:2d}  E = {log_E.exp().item():.4g} Pa  sag {found.item():.5f} m, measured {measured.item():.5f} m")
        with torch.no_grad():  # Newton's method for ln sag(ln E), nearly a straight line
            log_E -= (found.log() - measured.log()) / slope
    return abs(log_E.exp().item() / truth - 1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=8)
    print(f"the stiffness is off by {main(parser.parse_args().iterations):.1e}")
