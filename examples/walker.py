"""A soft walker learns to walk: the controller of its muscles is trained through the simulation.

The walker is a torso on two legs, each of two muscles side by side. The inputs of a small network are a clock and the
pose and motion of the walker; it sets the length of each muscle 50 times a second. A muscle changes its stress-free
shape (active strain, Nardinocchi and Teresi 2007): with F = F_elastic diag(1/λ, λ) it tends to λ times its length. The
reward is the speed of the upright walker in the first one or two seconds. Then it walks for twice as long.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch
from torch import Tensor, nn

import torch_mpm as mpm
from torch_mpm import render

LOWER, UPPER = (0.0, 0.0), (4.4, 0.5)  # of the domain [m]
GRID = mpm.Grid(dx=1 / 40, lower=LOWER, upper=UPPER)
DT, EVERY = 1e-3, 20  # time step [s]; steps between two controls
STRETCH = 0.2  # muscles change their length by up to this share
FREQUENCY = 3.0  # of the clock [Hz]
MUSCLES = 4


def walker(device: str) -> mpm.State:
    """The walker at rest. extra["part"]: muscle 0 to 3 of each particle, or 4 for the torso; "length": λ [P]."""
    corners = [((x, 0.0), (x + 0.05, 0.1)) for x in (0.2, 0.25, 0.4, 0.45)] + [((0.2, 0.1), (0.5, 0.2))]
    parts = []
    for k, (lower, upper) in enumerate(corners):
        part = mpm.State.at_rest(mpm.seed.box(lower, upper, GRID, per_cell=4), density=1000.0, device=device)
        extra = {"part": torch.full_like(part.mass, k, dtype=torch.long), "length": torch.ones_like(part.mass)}
        parts.append(part.replace(extra=extra))
    return mpm.State.concatenate(parts)


class Controller(nn.Module):
    """Lengths λ [MUSCLES] of the muscles, over those at rest, for a state of the walker."""

    def __init__(self, start: mpm.State) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(22, 32), nn.Tanh(), nn.Linear(32, MUSCLES), nn.Tanh())
        belongs = nn.functional.one_hot(start.extra["part"], MUSCLES + 1).to(start.x)
        self.register_buffer("shares", (belongs / belongs.sum(0)).T.contiguous())  # [5, P], for the mean of each part
        self.register_buffer("phases", 0.5 * math.pi * torch.arange(4).to(start.x))

    def forward(self, state: mpm.State) -> Tensor:
        clock = torch.sin(2 * math.pi * FREQUENCY * state.time + self.phases)
        x, v = self.shares @ state.x, self.shares @ state.v
        pose = (x[:MUSCLES] - x[MUSCLES]) / 0.1
        return 1 + STRETCH * self.layers(torch.cat([clock, pose.flatten(), v.flatten()]))


def walk(controller: Controller, start: mpm.State, seconds: float) -> mpm.Frames:
    """Positions "x" and muscle lengths "length" of the particles every EVERY steps."""
    step = mpm.Step(GRID, mpm.NeoHookean(E=4e4, nu=0.3), (0, -9.8), mpm.Walls("separate", friction=0.8))

    def contract(state: mpm.State, k: int) -> mpm.State:
        before = state.extra["length"]
        after = torch.cat([controller(state), before.new_ones(1)])[state.extra["part"]]
        change = torch.stack([after / before, before / after], 1)
        assert state.F is not None
        return state.replace(F=state.F * change[:, None], extra={**state.extra, "length": after})

    return mpm.frames(step, start, round(seconds / DT), DT, EVERY, ["x", "length"], contract)


def train(controller: Controller, start: mpm.State, iterations: int, seconds: float) -> list[float]:
    """Train for some seconds at first and for twice as long later; returns the speed of each iteration [m/s]."""
    optimizer = torch.optim.Adam(controller.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations, eta_min=1e-4)
    torso, middle = start.extra["part"] == MUSCLES, start.x[:, 0].mean()
    front, back = torso & (start.x[:, 0] > middle + 0.1), torso & (start.x[:, 0] < middle - 0.1)
    speeds = []
    for k in range(iterations):
        duration = seconds if k < 0.6 * iterations else 2 * seconds
        walked = walk(controller, start, duration)
        height = walked.fields["x"][..., 1]
        tilt = (height[:, front].mean(1) - height[:, back].mean(1)) / 0.25  # its sine
        speed = (walked.end.x - start.x)[:, 0].mean() / duration
        optimizer.zero_grad()
        (2 * tilt.square().mean() - speed).backward()
        nn.utils.clip_grad_norm_(controller.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        speeds.append(speed.item())
        if k % 10 == 0 or k + 1 == iterations:
            print(f"{k:3d}  {speeds[-1]:.3f} m/s over {duration:g} s", flush=True)
    return speeds


def draw(walked: mpm.Frames, speeds: list[float], part: Tensor, path: Path) -> None:
    """Plot of the walker every 0.8 s, its speed in training, and the lengths of the muscles."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.6), dpi=100)
    gait, growth, lengths = figure.subplot_mosaic([["gait", "gait"], ["growth", "lengths"]]).values()
    x, length = walked.fields["x"].cpu(), walked.fields["length"].cpu()
    for k in range(0, len(x), round(0.8 / DT / EVERY)):
        drawn = gait.scatter(*x[k].T, c=length[k], s=4, cmap="coolwarm", vmin=1 - STRETCH, vmax=1 + STRETCH)
    figure.colorbar(drawn, ax=gait, label="muscle length", fraction=0.02, pad=0.01)
    gait.set(
        title="every 0.8 s",
        xlabel="x [m]",
        ylabel="y [m]",
        aspect="equal",
        xlim=(0, float(x.max()) + 0.2),
        ylim=(0, 0.4),
    )
    growth.plot(speeds)
    growth.set(title="training", xlabel="iteration", ylabel="speed [m/s]")
    shown = walked.time < 1
    for k in range(MUSCLES):
        of_muscle = length[:, int((part == k).nonzero()[0])]
        lengths.plot(walked.time[shown], of_muscle[shown], label=f"muscle {k + 1}")
    lengths.set(title="the first second", xlabel="time [s]", ylabel="length over that at rest", ylim=(None, 1.4))
    lengths.legend(loc="upper right", ncols=2)
    figure.tight_layout()
    figure.savefig(path)


def film(walked: mpm.Frames, path: Path) -> None:
    limits = (1 - STRETCH, 1 + STRETCH)
    renderer = render.Renderer((LOWER, UPPER), (1200, 220), color_by="muscle length", range=limits, cmap="coolwarm")
    with render.VideoWriter(path, fps=1 / (DT * EVERY)) as video:
        for x, length, now in zip(walked.fields["x"], walked.fields["length"], walked.time, strict=True):
            video.append(renderer.frame(x, length, time=float(now)))


def main(out: Path, device: str = "cpu", iterations: int = 100, seconds: float = 1.0, shown: float = 4.0) -> float:
    """Returns the distance of the walk [m] in the displayed seconds, twice as many as in training."""
    torch.manual_seed(0)
    start = walker(device)
    controller = Controller(start).to(device)
    speeds = train(controller, start, iterations, seconds)
    with torch.no_grad():
        walked = walk(controller, start, shown)
    out.mkdir(parents=True, exist_ok=True)
    draw(walked, speeds, start.extra["part"], out / "walker.png")
    film(walked, out / "walker.mp4")
    return float((walked.end.x - start.x)[:, 0].mean())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/walker"), help="folder of the picture and the video")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--iterations", type=int, default=100)
    torch.set_num_threads(1)  # A few hundred particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    way = main(options.out, options.device, options.iterations)
    print(f"the walker, 0.3 m long, comes {way:.2f} m far in 4 s")
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'walker.png'} and {options.out / 'walker.mp4'}")
