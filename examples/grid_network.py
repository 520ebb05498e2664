"""A small network acts on the grid: trained to blow a falling drop of jelly sideways onto a target.

The inputs of the network are position and velocity of each grid node, its output is an additional acceleration. It is
called inside the step, and its weights get their gradient through the simulation.
"""

import argparse

import torch
from torch import Tensor, nn

import torch_mpm as mpm


class Wind(nn.Module):
    """Acceleration of the nodes [m/s^2] from their positions and velocities."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(4, 32), nn.Tanh(), nn.Linear(32, 2))

    def forward(self, blocks: mpm.Blocks, velocity: Tensor, mass: Tensor, dt: float) -> Tensor:
        """Called by the step with node tensors [N, 2] and [N]."""
        features = torch.cat([blocks.node_positions(velocity.dtype), velocity], dim=1)
        return velocity + torch.where(mass[:, None] > 0, dt * 10 * self.layers(features), 0)


def main(iterations: int = 15) -> tuple[float, float]:
    """Returns the distance from the target before and after training [m]."""
    torch.manual_seed(0)
    target = torch.tensor([0.7, 0.3])
    grid = mpm.Grid(dx=0.05, lower=(0, 0), upper=(1, 1))
    drop = mpm.State.at_rest(mpm.seed.sphere((0.35, 0.7), 0.12, grid, per_cell=4), density=1000.0)
    wind = Wind()
    step = mpm.Step(grid, mpm.NeoHookean(E=2e4, nu=0.3), gravity=(0, -9.8), walls="separate", on_grid=wind)
    optimizer = torch.optim.Adam(wind.parameters(), lr=1e-2)
    misses = []
    for k in range(iterations):
        landed = mpm.rollout(step, drop, n=100, dt=3e-3, checkpoint=10)
        loss = (landed.x.mean(0) - target).square().sum()
        misses.append(loss.item() ** 0.5)
        print(f"{k:3d}  miss {misses[-1]:.4f} m", flush=True)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return misses[0], misses[-1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=40)
    first, last = main(parser.parse_args().iterations)
    print(f"miss {first:.4f} m before training, {last:.4f} m after")
