"""Find the conductivity field of a plate from the change of its temperature in four experiments.

Each experiment starts from another temperature and is a scene of one batch; the conductivity is unknown on a coarse
mesh and bilinear between. The gradient of the misfit goes through every implicit step of the conduction.
"""

import argparse

import torch
from torch import Tensor

import torch_mpm as mpm

CELLS, MESH, STEPS, DT = 16, 5, 6, 5e-3


def interpolated(values: Tensor, x: Tensor) -> Tensor:
    """Bilinear field of mesh values [MESH, MESH] over the unit square at x [P, 2]."""
    points = (2 * x - 1).flip(1)[None, None]
    return torch.nn.functional.grid_sample(values[None, None], points, align_corners=True)[0, 0, 0]


def experiments() -> tuple[mpm.Grid, mpm.State]:
    """The same plate four times, with waves of temperature in four directions."""
    grid = mpm.Grid(1 / CELLS, (-0.2, -0.2), (1.2, 1.2), scenes=4)
    plate = mpm.State.at_rest(mpm.seed.box((0, 0), (1, 1), 1 / CELLS, per_cell=4), 1.0, dtype=torch.float64)
    x, y = plate.x.T * torch.pi
    waves = [torch.cos(2 * x), torch.cos(2 * y), torch.cos(x) * torch.cos(2 * y), torch.cos(2 * x) * torch.cos(y)]
    return grid, mpm.State.concatenate([plate.replace(temperature=wave) for wave in waves], scene=True)


def main(iterations: int = 4) -> float:
    """Returns the relative error of the conductivity."""
    grid, start = experiments()
    torch.manual_seed(1)
    true = interpolated(1 + 2 * torch.rand(MESH, MESH, dtype=torch.float64), start.x)

    def observed(conductivity: Tensor) -> Tensor:
        """Temperatures after every step [STEPS, P]."""
        heat, state, seen = mpm.Heat(grid, conductivity, 1.0), start, []
        for _ in range(STEPS):
            state = heat(state, DT)
            seen.append(state.temperature)
        return torch.stack(seen)

    with torch.no_grad():
        data = observed(true)
    logarithm = torch.zeros(MESH, MESH, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([logarithm], max_iter=10, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = (observed(interpolated(logarithm.exp(), start.x)) - data).square().mean() / data.square().mean()
        loss.backward()
        return loss

    error = float("inf")
    for k in range(iterations):
        loss = optimizer.step(closure).item()
        error = float((interpolated(logarithm.detach().exp(), start.x) - true).norm() / true.norm())
        print(f"{k:3d}  misfit {loss:.2e}  error of the conductivity {error:.2%}", flush=True)
    return error


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=8)
    print(f"error of the conductivity {main(parser.parse_args().iterations):.2%}")
