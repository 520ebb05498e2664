"""A network as the conductivity law: it learns the dependence of the conductivity on temperature from one heated bar.

The network is called inside every step with the temperatures of the particles, and its weights get their gradient
through the implicit solves.
"""

import argparse

import torch
from torch import Tensor, nn

import torch_mpm as mpm
from torch_mpm.heat.boundaries import FixedSurface

CELLS, STEPS, DT = 32, 24, 4e-3


class Conductivity(nn.Module):
    """κ(θ) > 0 of temperatures [P] from 0 to 1."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(1, 16), nn.Tanh(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, 1))

    def forward(self, theta: Tensor) -> Tensor:
        return self.layers(2 * theta[:, None] - 1)[:, 0].exp()


def true_law(theta: Tensor) -> Tensor:
    """A conductivity that drops by half where the material changes phase, at 0.5."""
    return 1 - 0.5 * torch.sigmoid(12 * (theta - 0.5)) + 0.3 * theta


def main(iterations: int = 20) -> float:
    """Returns the relative error of the learnt law over all temperatures of the bar."""
    torch.manual_seed(0)
    dx = 1 / CELLS
    grid = mpm.Grid(dx, (-0.2, -0.2), (1.2, 0.4))
    bar = mpm.State.at_rest(mpm.seed.box((0, 0), (1, 2 * dx), dx, per_cell=4), 1.0, dtype=torch.float64)
    start = bar.replace(temperature=torch.zeros_like(bar.mass))
    hot = FixedSurface(mpm.Plane((0.0, 0.0), (1.0, 0.0)), 1.0)

    def observed(law: nn.Module) -> Tensor:
        """Temperatures after every step [STEPS, P]."""
        heat, state, seen = mpm.Heat(grid, law, 1.0, [hot]), start, []
        for _ in range(STEPS):
            state = heat(state, DT)
            seen.append(state.temperature)
        return torch.stack(seen)

    with torch.no_grad():
        data = observed(true_law)
    network = Conductivity().double()
    optimizer = torch.optim.LBFGS(
        network.parameters(), max_iter=10, tolerance_grad=0.0, tolerance_change=0.0, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = (observed(network) - data).square().mean()
        loss.backward()
        return loss

    theta = torch.linspace(0, 1, 101, dtype=torch.float64)
    error = float("inf")
    for k in range(iterations):
        loss = optimizer.step(closure).item()
        with torch.no_grad():
            error = float((network(theta) - true_law(theta)).norm() / true_law(theta).norm())
        print(f"{k:3d}  misfit {loss:.2e}  error of the law {error:.2%}", flush=True)
    return error


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=20)
    print(f"error of the law {main(parser.parse_args().iterations):.2%}")
