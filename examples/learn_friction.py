"""A network learns the dependence of the friction of a floor on the speed from four blocks that slide to a stop.

The network acts on the grid: in every step it returns the coefficient at each node that the floor stops, and its
weights get their gradient through the simulation. The true law is that of lubricated contact, high near sticking and
low at speed (Stribeck). Only positions of particles are measured, with errors.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

import torch_mpm as mpm

DX, DT = 1 / 20, 2e-3  # [m], [s]
EVERY = 20  # steps between two measurements
SPEEDS = (0.2, 0.6, 1.4, 2.8)  # initial speed of the blocks [m/s]
NOISE = 1e-4  # deviation of the measured positions [m]
Law = Callable[[Tensor], Tensor]


def stribeck(speed: Tensor) -> Tensor:
    """The true coefficient of friction [N] at speeds [N] [m/s]."""
    return 0.2 + 0.3 * torch.exp(-speed / 0.6)


class Friction(nn.Module):
    """A coefficient of friction [N] > 0 at speeds [N] [m/s]."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(1, 16), nn.Tanh(), nn.Linear(16, 1))

    def forward(self, speed: Tensor) -> Tensor:
        seen = 2 * (4 * speed[:, None]).log1p() - 2  # finer at low speeds, between -2 and 3
        return 0.3 * self.layers(seen)[:, 0].exp()


class Floor(nn.Module):
    """Coulomb friction on nodes at y ≤ 0: they lose their velocity into the floor, and μ times as much along it."""

    def __init__(self, law: Law) -> None:
        super().__init__()
        self.law = law

    def forward(self, blocks: mpm.Blocks, velocity: Tensor, mass: Tensor, dt: float) -> Tensor:
        along, up = velocity.unbind(1)
        speed, stopped = along.abs(), (-up).clamp_min(0)
        kept = (speed - self.law(speed) * stopped).clamp_min(0)
        contact = blocks.node_positions(velocity.dtype)[:, 1:] < 1e-6
        return torch.where(contact, torch.stack([along.sign() * kept, up.clamp_min(0)], 1), velocity)


def sliding_blocks(device: str) -> mpm.State:
    """One scene for each speed."""
    points = mpm.seed.box((0.1, 0.0), (0.5, 0.15), DX, per_cell=4)
    scenes = [mpm.State.at_rest(points, 1000.0, (v, 0.0), torch.float64, device) for v in SPEEDS]
    return mpm.State.concatenate(scenes, scene=True)


class Experiment(nn.Module):
    """Measurements of blocks that slide by a law of friction: positions [P, steps / EVERY + 1, 2] [m]."""

    def __init__(self, law: Law, steps: int) -> None:
        super().__init__()
        grid = mpm.Grid(DX, lower=(0, 0), upper=(3, 0.5), scenes=len(SPEEDS), max_blocks=85 * len(SPEEDS))  # all blocks
        self.step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), gravity=(0, -9.8), on_grid=Floor(law))
        self.steps = steps

    def forward(self, start: mpm.State, dt: float = DT) -> mpm.State:
        """State at the end, with the measurements in `extra`."""
        frames = mpm.frames(self.step, start, self.steps, dt, EVERY, fields=["x"])
        return frames.end.replace(extra={"measured": frames.fields["x"].movedim(0, 1)})


def measured(simulated: Callable[[mpm.State], mpm.State], start: mpm.State) -> Tensor:
    """Positions [steps / EVERY + 1, P, 2] [m]."""
    return simulated(start).extra["measured"].movedim(1, 0)


def draw(x: Tensor, speeds: Tensor, laws: dict[str, Tensor], path: Path) -> None:
    """Plot of the sliding distances of the blocks, and the laws."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.3), dpi=100)
    motion, friction = figure.subplots(1, 2)
    for speed, way in zip(SPEEDS, (x - x[0])[..., 0].chunk(len(SPEEDS), 1), strict=True):
        motion.plot(DT * EVERY * torch.arange(len(x)), way.mean(1).cpu(), ".-", label=f"{speed} m/s")
    motion.set(title="blocks slide to a stop", xlabel="time [s]", ylabel="way [m]")
    motion.legend(title="thrown at")
    for (name, values), style in zip(laws.items(), ("0.6", "C1:", "C0--"), strict=True):
        friction.plot(speeds.cpu(), values.cpu(), style, lw=2, label=name)
    friction.set(title="law of friction", xlabel="speed [m/s]", ylabel="coefficient", ylim=(0, None))
    friction.legend()
    figure.tight_layout()
    figure.savefig(path)


def main(out: Path, device: str = "cpu", iterations: int = 30, steps: int = 300) -> float:
    """Returns the relative error of the learnt law over all speeds of the blocks, in the root mean square."""
    torch.manual_seed(0)
    start = sliding_blocks(device)
    with torch.no_grad():
        data = measured(Experiment(stribeck, steps), start)
    data = data + NOISE * torch.randn(data.shape, dtype=data.dtype).to(device)  # the same on any device
    network = Friction().to(device, torch.float64)
    experiment = Experiment(network, steps).to(device)
    # As one CUDA graph, where launching the kernels of each step takes longer than running them.
    simulated = mpm.captured(experiment, start, DT) if start.x.is_cuda else experiment
    speeds = torch.linspace(0, max(SPEEDS), 100, dtype=torch.float64, device=device)
    laws = {"true": stribeck(speeds), "before training": network(speeds).detach()}
    options = {"max_iter": 1, "max_eval": 10, "history_size": 30, "line_search_fn": "strong_wolfe"}
    optimizer = torch.optim.LBFGS(network.parameters(), **options)

    def closure() -> Tensor:
        optimizer.zero_grad()
        misfit = (measured(simulated, start) - data).square().mean() / NOISE**2
        misfit.backward()
        return misfit

    error = float("inf")
    for k in range(iterations):
        misfit = optimizer.step(closure).item()
        laws["learnt"] = network(speeds).detach()
        error = float((laws["learnt"] - laws["true"]).norm() / laws["true"].norm())
        print(f"{k:3d}  misfit {misfit:10.2f}  error of the law {error:.2%}", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    draw(data, speeds, laws, out / "learn_friction.png")
    return error


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/learn_friction"), help="folder of the picture")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--iterations", type=int, default=30)
    torch.set_num_threads(1)  # A few hundred particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    error = main(options.out, options.device, options.iterations)
    print(f"error of the law {error:.2%}")
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'learn_friction.png'}")
