"""Find the throw that lands a soft ball on a target, by gradient descent through the whole simulation."""

import argparse

import torch

import torch_mpm as mpm


def main(iterations: int = 12) -> float:
    """Returns the distance of the best throw from the target [m]."""
    target = torch.tensor([0.8, 0.2])
    grid = mpm.Grid(dx=0.04, lower=(0, 0), upper=(1, 1))
    ball = mpm.State.at_rest(mpm.seed.sphere((0.2, 0.3), 0.1, grid, per_cell=4), density=1000.0)
    step = mpm.Step(grid, mpm.NeoHookean(E=5e4, nu=0.3), gravity=(0, -9.8), walls="separate")

    velocity = torch.tensor([1.0, 1.0], requires_grad=True)
    optimizer = torch.optim.Adam([velocity], lr=0.3)
    slower = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.85)
    best = float("inf")
    for k in range(iterations):
        thrown = ball.replace(v=ball.v + velocity)
        landed = mpm.rollout(step, thrown, n=200, dt=1.5e-3, checkpoint=14)
        miss = (landed.x.mean(0) - target).norm()
        best = min(best, miss.item())
        print(f"{k:3d}  velocity {velocity.tolist()}  miss {miss.item():.4f} m", flush=True)
        optimizer.zero_grad()
        miss.backward()
        optimizer.step()
        slower.step()
    return best


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=25)
    print(f"best miss {main(parser.parse_args().iterations):.4f} m")
