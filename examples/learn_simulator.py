"""A graph network learns to simulate sand, from a data set on disk or from scenes that are simulated during training.

    python examples/learn_simulator.py             # generates a small data set, trains for some minutes on two cores
    python examples/learn_simulator.py --online    # trains on other scenes, without a data set of them

The inputs of the network are the last five velocities of each particle and the positions of its neighbours and the
walls; its output is the acceleration (Sanchez-Gonzalez et al. 2020, smaller). Its rollouts are compared with the truth
on unseen scenes, and with the baseline that each particle keeps its velocity.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from torch_mpm import render
from torch_mpm.data import DatasetFolder, OnlineStream, WindowDataset, WindowStream, pack, simulator
from torch_mpm.data.configuration import Configuration
from torch_mpm.data.generate import generate
from torch_mpm.data.metadata import connectivity_radius
from torch_mpm.data.statistics import Motion

HISTORY = 6  # positions that the network sees: five velocities
NOISE = 0.2  # of the velocities it is trained with, in units of their deviation; more than gravity changes in a frame,
# or the network would take the acceleration from the past instead of from its cause, and brake in the air
WIDTH, LAYERS = 48, 4


@dataclass
class Domain:
    """Scales of the inputs: bounds [D] and radius of neighbours [m], moments of velocities and accelerations [D]."""

    lower: Tensor
    upper: Tensor
    radius: float
    velocity: Tensor
    acceleration_mean: Tensor
    acceleration: Tensor

    @classmethod
    def of(cls, data: DatasetFolder, motion: Motion, device: torch.device) -> Domain:
        def vector(values: Iterable[float]) -> Tensor:
            return torch.tensor(list(values), dtype=torch.float32, device=device)

        v, a = motion.velocity, motion.acceleration
        bounds = vector(data.record.lower), vector(data.record.upper)
        return cls(*bounds, connectivity_radius(data), vector(v.std), vector(a.mean), vector(a.std))


# ---- the network


def perceptron(inputs: int, outputs: int, norm: bool = True) -> nn.Sequential:
    layers = [nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, outputs)]
    return nn.Sequential(*layers, *([nn.LayerNorm(outputs)] if norm else []))


class Simulator(nn.Module):
    """Network from the positions of a few frames to the next positions."""

    def __init__(self, domain: Domain) -> None:
        super().__init__()
        dim = len(domain.lower)
        self.domain = domain
        self.encode_nodes = perceptron((HISTORY - 1) * dim + 2 * dim, WIDTH)
        self.encode_edges = perceptron(dim + 1, WIDTH)
        self.edge_layers = nn.ModuleList(perceptron(3 * WIDTH, WIDTH) for _ in range(LAYERS))
        self.node_layers = nn.ModuleList(perceptron(2 * WIDTH, WIDTH) for _ in range(LAYERS))
        self.decode = perceptron(WIDTH, dim, norm=False)

    def forward(self, position: Tensor, scene: Tensor) -> Tensor:
        """Normalised accelerations [N, D] from positions [N, HISTORY, D] (m) and the scene [N] of each particle."""
        domain, x = self.domain, position[:, -1]
        velocity = position.diff(dim=1) / domain.velocity
        walls = (torch.cat([x - domain.lower, domain.upper - x], 1) / domain.radius).clamp(-1, 1)
        nodes = self.encode_nodes(torch.cat([velocity.flatten(1), walls], 1))
        sender, receiver = neighbours(x, scene, domain.radius)
        offset = (x[sender] - x[receiver]) / domain.radius
        edges = self.encode_edges(torch.cat([offset, offset.norm(dim=1, keepdim=True)], 1))
        for edge_layer, node_layer in zip(self.edge_layers, self.node_layers, strict=True):
            edges = edges + edge_layer(torch.cat([edges, nodes[sender], nodes[receiver]], 1))
            gathered = torch.zeros_like(nodes).index_add(0, receiver, edges)
            nodes = nodes + node_layer(torch.cat([nodes, gathered], 1))
        return self.decode(nodes)

    def loss(self, window: Tensor, scene: Tensor, noise: float = NOISE) -> Tensor:
        """Huber's loss of the normalised acceleration for windows [N, HISTORY + 1, D]."""
        domain = self.domain
        steps = torch.randn_like(window[:, 1:-1]) * noise * domain.velocity / (HISTORY - 1) ** 0.5
        moved = torch.cat([torch.zeros_like(window[:, :1]), steps.cumsum(1).cumsum(1)], 1)
        history = window[:, :-1] + moved
        following = window[:, -1] + moved[:, -1]  # The noise in the last velocity is to be corrected.
        acceleration = following - 2 * history[:, -1] + history[:, -2]
        wanted = (acceleration - domain.acceleration_mean) / domain.acceleration
        return nn.functional.smooth_l1_loss(self(history, scene), wanted, beta=1.0)

    @torch.no_grad()
    def rollout(self, first: Tensor, frames: int) -> Tensor:
        """Positions [N, frames, D] after the first HISTORY given ones."""
        positions, scene = list(first.unbind(1)), torch.zeros(len(first), dtype=torch.long, device=first.device)
        for _ in range(frames - HISTORY):
            normalised = self(torch.stack(positions[-HISTORY:], 1), scene)
            acceleration = normalised * self.domain.acceleration + self.domain.acceleration_mean
            following = 2 * positions[-1] - positions[-2] + acceleration
            positions.append(following.clamp(self.domain.lower, self.domain.upper))
        return torch.stack(positions, 1)


def neighbours(x: Tensor, scene: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Pairs of particles of one scene within the radius."""
    near = (torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist") < radius) & (scene[:, None] == scene)
    near.fill_diagonal_(False)
    sender, receiver = near.nonzero(as_tuple=True)
    return sender, receiver


# ---- training and comparison


def train(
    model: Simulator, batches: Iterator[dict[str, Tensor]], steps: int, report: Callable[[str], None] = print
) -> list[float]:
    """Train for some steps; returns the loss of each."""
    optimizer = torch.optim.Adam(model.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=1e-5)
    device, losses, begin = model.domain.lower.device, [], time.perf_counter()
    for step, batch in enumerate(itertools.islice(batches, steps), 1):
        loss = model.loss(batch["position"].to(device), batch["scene"].to(device))
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        losses.append(loss.detach())
        if step % max(1, steps // 20) == 0:
            mean = float(torch.stack(losses[-max(1, steps // 20) :]).mean())
            report(f"step {step:5d} of {steps}  loss {mean:.4f}  {time.perf_counter() - begin:.0f} s")
    return torch.stack(losses).tolist()


def constant_velocity(first: Tensor, frames: int, domain: Domain) -> Tensor:
    """The baseline [N, frames, D]: particles keep their velocity, up to the walls."""
    velocity = first[:, -1:] - first[:, -2:-1]
    ahead = torch.arange(1, frames - HISTORY + 1, device=first.device)[:, None]
    return torch.cat([first, (first[:, -1:] + velocity * ahead).clamp(domain.lower, domain.upper)], 1)


def errors(predicted: Tensor, truth: Tensor) -> Tensor:
    """Mean distance [frames] (m) of particles [N, frames, D] from their true positions."""
    return (predicted - truth).norm(dim=2).mean(0)


@torch.no_grad()
def mean_loss(model: Simulator, windows: WindowDataset, count: int = 64) -> float:
    """Mean loss without noise over windows that are spread over a split."""
    items = [windows[int(k)] for k in np.linspace(0, len(windows) - 1, count)]
    device = model.domain.lower.device
    batches = [pack(items[k : k + 8]) for k in range(0, count, 8)]
    losses = [model.loss(b["position"].to(device), b["scene"].to(device), noise=0.0) for b in batches]
    return float(torch.stack(losses).mean())


def compare(model: Simulator, data: DatasetFolder, out: Path) -> dict[str, Tensor]:
    """Roll out the test scenes; draws ``errors.png`` and ``rollout.mp4``, and returns mean errors [frames] (m)."""
    found: dict[str, list[Tensor]] = {"network": [], "constant velocity": []}
    clips: dict[str, Tensor] = {}
    for scene in data.scenes("test"):
        truth = torch.from_numpy(data.scene(scene.id)["position"]).transpose(0, 1).to(model.domain.lower.device)
        first, frames = truth[:, :HISTORY], truth.shape[1]
        rolled = {
            "network": model.rollout(first, frames),
            "constant velocity": constant_velocity(first, frames, model.domain),
        }
        for name, position in rolled.items():
            found[name].append(errors(position, truth).cpu())
        if not clips or len(truth) > len(clips["truth"]):
            clips = {"truth": truth, **rolled}
    draw_errors(found, data.record.frame_interval, out / "errors.png")
    draw_video(clips, data, out / "rollout.mp4")
    return {name: torch.stack(values).mean(0) for name, values in found.items()}


def draw_errors(found: dict[str, list[Tensor]], interval: float, path: Path) -> None:
    """Errors over time: a thin line for each scene, a thick one for their mean."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), dpi=120)
    axes = figure.add_subplot()
    for (name, values), color in zip(found.items(), ("#0072B2", "#D55E00"), strict=True):
        time_axis = interval * np.arange(len(values[0]))
        for value in values:
            axes.plot(time_axis, value, color=color, lw=0.6, alpha=0.5)
        axes.plot(time_axis, torch.stack(values).mean(0), color=color, lw=2.5, label=name)
    axes.set(xlabel="time [s]", ylabel="mean distance from the truth [m]", ylim=(0, None))
    axes.legend()
    figure.tight_layout()
    figure.savefig(path)


def draw_video(clips: dict[str, Tensor], data: DatasetFolder, path: Path) -> None:
    """The truth and the predictions [N, frames, D] side by side."""
    bounds = (data.record.lower, data.record.upper)
    with render.VideoWriter(path, 0.5 / data.record.frame_interval) as video:
        renderers = [render.Renderer(bounds, (420, 380), color_by=None) for _ in clips]
        for k in range(data.record.frames):
            shown = zip(renderers, clips.items(), strict=True)
            pictures = [r.frame(x[:, k], title=name, time=k * data.record.frame_interval) for r, (name, x) in shown]
            video.append(render.contact_sheet(pictures, len(pictures)))


def configuration(scenes: int) -> Configuration:
    """A block of soft sand, thrown: coarser than the preset, and impacts take some frames of its longer intervals."""
    words = ["body[0].count=1", "material.sand.E=1e5", "grid.dx=0.04"]
    words += ["dataset.frames=61", "dataset.interval=0.01", "dataset.scenes_per_shard=20"]
    return Configuration.preset("sand", [*words, f"dataset.splits={{train={scenes}, valid=4, test=6}}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/learn_simulator"), help="folder of data set and results")
    parser.add_argument("--online", action="store_true", help="train on scenes that are simulated meanwhile")
    parser.add_argument(
        "--scenes", type=int, default=120, help="training scenes of the data set; of a round, online: 20"
    )
    parser.add_argument("--steps", type=int, default=5000, help="training steps")
    parser.add_argument("--batch", type=int, default=4, help="windows of a batch")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    torch.manual_seed(0)
    config, folder = configuration(options.scenes), options.out / "data"
    generate(config, folder, device=options.device)  # Missing shards only.
    data = DatasetFolder(folder)
    domain = Domain.of(data, data.motion("train"), torch.device(options.device))
    model = Simulator(domain).to(options.device)
    if options.online:
        made = simulator(config, options.device)
        batches = iter(OnlineStream(made, options.batch, scenes=20, first=config.scenes, device=options.device))
    else:
        batches = WindowStream(WindowDataset(data, "train", HISTORY + 1), options.batch).loader()
    train(model, batches, options.steps)
    print(f"held-out loss {mean_loss(model, WindowDataset(data, 'valid', HISTORY + 1)):.4f}")
    results = options.out / ("online" if options.online else "disk")
    results.mkdir(parents=True, exist_ok=True)
    found = compare(model, data, results)
    means = {name: float(values[HISTORY:].mean()) for name, values in found.items()}
    ratio = means["constant velocity"] / means["network"]
    print("mean error over the rollouts: " + ", ".join(f"{name} {value:.4f} m" for name, value in means.items()))
    print(f"the network is {ratio:.1f} times as accurate; see {results / 'errors.png'} and {results / 'rollout.mp4'}")


if __name__ == "__main__":
    main()
