"""A graph network learns to simulate sand, from a data set on disk or from scenes that are simulated meanwhile.

    torch-mpm generate --preset sand -o out/sand ...      # or leave it to this script, which does so first
    python examples/learn_simulator.py                    # some minutes on two cores; out/learn_simulator has the results
    python examples/learn_simulator.py --online           # the same without a data set to train on

The network sees the last five velocities of each particle and where its neighbours and the walls are, and predicts the
acceleration (Sanchez-Gonzalez et al. 2020, smaller). It is rolled out beside the truth on scenes that it has not seen,
and beside the baseline that each particle keeps its velocity.
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

from torch_mpm.data import DatasetFolder, OnlineStream, WindowDataset, WindowStream
from torch_mpm.data.metadata import connectivity_radius
from torch_mpm.data.statistics import Motion

HISTORY = 6  # positions that the network sees: five velocities
NOISE = 0.01  # of the velocities it is trained with, in units of their deviation, so that it bears its own errors
WIDTH, LAYERS = 64, 4


@dataclass
class Domain:
    """What scales the inputs: bounds [D] and connectivity radius [m], deviations of velocities and accelerations [D]."""

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
    """From the positions of a few frames to the next positions."""

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

    def loss(self, window: Tensor, scene: Tensor) -> Tensor:
        """Huber's loss of the normalised acceleration for windows [N, HISTORY + 1, D], with noise."""
        domain = self.domain
        steps = torch.randn_like(window[:, 1:-1]) * NOISE * domain.velocity / (HISTORY - 1) ** 0.5
        noise = torch.cat([torch.zeros_like(window[:, :1]), steps.cumsum(1).cumsum(1)], 1)
        history = window[:, :-1] + noise
        following = window[:, -1] + noise[:, -1]  # the noise in the last velocity is to be corrected
        acceleration = following - 2 * history[:, -1] + history[:, -2]
        wanted = (acceleration - domain.acceleration_mean) / domain.acceleration
        return nn.functional.smooth_l1_loss(self(history, scene), wanted, beta=0.1)

    @torch.no_grad()
    def rollout(self, first: Tensor, frames: int) -> Tensor:
        """Positions [N, frames, D] that follow the first HISTORY of them, which are given."""
        positions, scene = list(first.unbind(1)), torch.zeros(len(first), dtype=torch.long, device=first.device)
        for _ in range(frames - HISTORY):
            normalised = self(torch.stack(positions[-HISTORY:], 1), scene)
            acceleration = normalised * self.domain.acceleration + self.domain.acceleration_mean
            following = 2 * positions[-1] - positions[-2] + acceleration
            positions.append(following.clamp(self.domain.lower, self.domain.upper))
        return torch.stack(positions, 1)


def neighbours(x: Tensor, scene: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Pairs of particles of one scene that are nearer than the radius."""
    near = (torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist") < radius) & (scene[:, None] == scene)
    near.fill_diagonal_(False)
    sender, receiver = near.nonzero(as_tuple=True)
    return sender, receiver


# ---- training and comparison


def train(
    model: Simulator, batches: Iterator[dict[str, Tensor]], steps: int, told: Callable[[str], None] = print
) -> list[float]:
    """Train for some steps; returns the loss of each."""
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
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
            told(f"step {step:5d} of {steps}  loss {mean:.4f}  {time.perf_counter() - begin:.0f} s")
    return torch.stack(losses).tolist()


def constant_velocity(first: Tensor, frames: int, domain: Domain) -> Tensor:
    """The baseline [N, frames, D]: particles keep their velocity, up to the walls."""
    velocity = first[:, -1:] - first[:, -2:-1]
    ahead = torch.arange(1, frames - HISTORY + 1, device=first.device)[:, None]
    return torch.cat([first, (first[:, -1:] + velocity * ahead).clamp(domain.lower, domain.upper)], 1)


def errors(predicted: Tensor, truth: Tensor) -> Tensor:
    """Mean distance [frames] (m) of particles [N, frames, D] from where they should be."""
    return (predicted - truth).norm(dim=2).mean(0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("out/learn_simulator/data"), help="folder of the data set")
    parser.add_argument("--out", type=Path, default=Path("out/learn_simulator"), help="folder of the results")
    parser.add_argument("--online", action="store_true", help="train on scenes that are simulated meanwhile")
    parser.add_argument("--steps", type=int, default=2000, help="training steps")
    parser.add_argument("--batch", type=int, default=4, help="windows of a batch")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    torch.manual_seed(0)
    data = DatasetFolder(options.data)
    domain = Domain.of(data, data.motion("train"), torch.device(options.device))
    model = Simulator(domain).to(options.device)
    stream = WindowStream(WindowDataset(data, "train", HISTORY + 1), options.batch)
    train(model, stream.loader(), options.steps)
    for scene in data.scenes("test"):
        truth = torch.from_numpy(data.scene(scene.id)["position"]).transpose(0, 1).to(options.device)
        t = time.perf_counter()
        ours = model.rollout(truth[:, :HISTORY], truth.shape[1])
        e, b = errors(ours, truth), errors(constant_velocity(truth[:, :HISTORY], truth.shape[1], domain), truth)
        print(
            scene.id,
            scene.particles,
            "network",
            e[[10, 30, 60, -1]].tolist(),
            "baseline",
            b[[10, 30, 60, -1]].tolist(),
            "ratio of means",
            float(b.mean() / e.mean()),
            time.perf_counter() - t,
        )


if __name__ == "__main__":
    main()
