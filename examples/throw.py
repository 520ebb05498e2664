"""Find the throw that lands a soft ball on a target, by gradient descent through the whole simulation."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from torch import Tensor

import torch_mpm as mpm

GRID = mpm.Grid(dx=0.04, lower=(0, 0), upper=(1, 1))
TARGET = (0.8, 0.2)  # of the centre of mass [m]
STEPS, EVERY, DT = 200, 10, 1.5e-3  # steps of a throw, frames of it, and the time step [s]


def draw(paths: list[Tensor], misses: list[float], before: Tensor, after: Tensor, path: Path) -> None:
    """Paths of the ball's centre, the ball at the end of the first and the best throw, and the misses."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), dpi=100)
    throws, curve = figure.subplots(1, 2)
    for k, way in enumerate(paths):
        throws.plot(*way.T.cpu(), color="C0", lw=1, alpha=0.2 + 0.8 * k / len(paths))
    for x, color, name in ((before, "0.8", "first throw"), (after, "C0", "best throw")):
        throws.scatter(*x.T.cpu(), s=4, color=color, label=name)
    throws.plot(*TARGET, "r+", ms=12, mew=2, label="target")
    throws.set(title="throws", xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=(0, 1), ylim=(0, 0.8))
    throws.legend(loc="upper left")
    curve.semilogy(misses, ".-")
    curve.set(title="distance from the target at the end", xlabel="iteration", ylabel="distance [m]")
    figure.tight_layout()
    figure.savefig(path)


def main(out: Path, device: str = "cpu", iterations: int = 8) -> float:
    """Returns the distance of the best throw from the target [m]."""
    ball = mpm.State.at_rest(mpm.seed.sphere((0.2, 0.3), 0.1, GRID, per_cell=4), density=1000.0, device=device)
    step = mpm.Step(GRID, mpm.NeoHookean(E=5e4, nu=0.3), gravity=(0, -9.8), walls="separate")
    velocity = torch.tensor([1.0, 1.0], device=device, requires_grad=True)
    optimizer = torch.optim.SGD([velocity], lr=4.0)
    misses: list[float] = []
    ways, ends = [], []
    for k in range(iterations):
        thrown = ball.replace(v=ball.v + velocity)
        flight = mpm.frames(step, thrown, STEPS, DT, EVERY, fields=["x"])
        miss = (flight.end.x.mean(0) - ball.x.new_tensor(TARGET)).norm()
        misses.append(miss.item())
        ways.append(flight.fields["x"].detach().mean(1))
        ends.append(flight.end.x.detach())
        print(f"{k:3d}  velocity ({velocity[0]:.3f}, {velocity[1]:.3f}) m/s  miss {misses[-1]:.4f} m", flush=True)
        optimizer.zero_grad()
        miss.square().backward()
        optimizer.step()
    best = min(range(iterations), key=misses.__getitem__)
    out.mkdir(parents=True, exist_ok=True)
    draw(ways, misses, ends[0], ends[best], out / "throw.png")
    return misses[best]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/throw"), help="folder of the picture")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--iterations", type=int, default=8)
    torch.set_num_threads(1)  # A few hundred particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    best = main(options.out, options.device, options.iterations)
    print(f"best miss {best:.4f} m")
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'throw.png'}")
