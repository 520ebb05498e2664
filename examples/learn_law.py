"""A network learns the law of an unknown material from the motion of blocks, and simulates another shape with it.

The material is a tissue that stiffens as it is deformed. Four blocks of it are thrown on the floor and against walls,
and only the positions of their particles are measured: no stress, no strain. The network gives an elastic energy; it is
called in every step, and its weights get their gradient through the simulation. Then it simulates a ring, which is
thrown harder and for longer than the blocks were.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

import torch_mpm as mpm

DX, DT = 1 / 20, 1.5e-3  # [m], [s]
EVERY = 15  # steps between two measurements
SIZE = 0.5  # diameter of the ring [m]
SCALE = 1e4  # [Pa], of the moduli before training
Law = Callable[[Tensor], Tensor]


# ---- laws


class Energy(nn.Module):
    """An isotropic law F [P, 2, 2] -> Kirchhoff stress [P, 2, 2] [Pa], by its energy ψ = m(s, a) s + k(s, a) a²/2.

    s = tr(F Fᵀ)/J − 2 measures shear and a = ln J the change of area; there is no stress at rest, and both moduli are
    positive for any weights.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(2, 16), nn.Tanh(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, 2))

    def energy(self, s: Tensor, a: Tensor) -> Tensor:
        m, k = self.layers(torch.stack([s, a], -1)).exp().unbind(-1)
        return SCALE * (m * s + k * a.square() / 2)

    def forward(self, F: Tensor) -> Tensor:
        return stress_of(self.energy, F)


def tissue(F: Tensor) -> Tensor:
    """The true law: its shear modulus grows exponentially with the deformation (after Fung 1967)."""
    return stress_of(lambda s, a: 5e3 * torch.expm1(1.5 * s) / 1.5 + 3e4 * a.square() / 2, F)


def stress_of(energy: Callable[[Tensor, Tensor], Tensor], F: Tensor) -> Tensor:
    """τ = 2 ∂ψ/∂s dev(F Fᵀ)/J + ∂ψ/∂a 1 for an energy ψ(s, a), see `Energy`."""
    J = F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
    b = F @ F.mT / J[:, None, None]
    trace = b.diagonal(dim1=1, dim2=2).sum(1)
    by_s, by_a = torch.func.grad(lambda s, a: energy(s, a).sum(), (0, 1))(trace - 2, J.log())
    one = torch.eye(2, dtype=F.dtype, device=F.device)
    return (2 * by_s)[:, None, None] * b + (by_a - by_s * trace)[:, None, None] * one


# ---- experiments


def thrown_blocks(device: str) -> mpm.State:
    """Four scenes: width and height, position [m] and velocity [m/s] of a block each."""
    scenes = []
    for (width, height), (x, y), velocity in (
        ((0.3, 0.3), (0.5, 0.2), (0.0, -3.0)),
        ((0.3, 0.3), (0.3, 0.3), (-2.0, -2.0)),
        ((0.2, 0.4), (0.7, 0.3), (2.0, -1.0)),
        ((0.4, 0.2), (1.3, 0.3), (3.0, -1.0)),
    ):
        corners = (x - width / 2, y - height / 2), (x + width / 2, y + height / 2)
        points = mpm.seed.box(*corners, DX, per_cell=4)
        scenes.append(mpm.State.at_rest(points, velocity=velocity, dtype=torch.float64, device=device))
    return mpm.State.concatenate(scenes, scene=True)


def thrown_ring(device: str) -> mpm.State:
    center = (0.7, 0.3)
    disc = mpm.seed.sphere(center, SIZE / 2, DX, per_cell=6)
    kept = (disc.x - torch.tensor(center)).norm(dim=1) > SIZE / 4
    points = mpm.seed.Points(disc.x[kept], disc.volume[kept])
    return mpm.State.at_rest(points, velocity=(3.0, -3.0), dtype=torch.float64, device=device)


class Experiment(nn.Module):
    """Measurements of scenes simulated with a law: positions [P, steps / EVERY + 1, 2] [m]."""

    def __init__(self, law: Law, scenes: int, steps: int) -> None:
        super().__init__()
        grid = mpm.Grid(DX, lower=(0, 0), upper=(1.5, 1), scenes=scenes, max_blocks=70 * scenes)  # all scenes
        self.step = mpm.Step(grid, law, gravity=(0, -9.8), walls="sticky")
        self.steps = steps

    def forward(self, start: mpm.State, dt: float = DT) -> mpm.State:
        """State at the end, with the measurements in `extra`."""
        frames = mpm.frames(self.step, start, self.steps, dt, EVERY, fields=["x"])
        return frames.end.replace(extra={"measured": frames.fields["x"].movedim(0, 1)})


def measured(simulated: Callable[[mpm.State], mpm.State], start: mpm.State) -> Tensor:
    """Positions [steps / EVERY + 1, P, 2] [m]."""
    return simulated(start).extra["measured"].movedim(1, 0)


def train(network: Energy, blocks: mpm.State, steps: int, iterations: int) -> None:
    with torch.no_grad():
        data = measured(Experiment(tissue, 4, steps), blocks)
    experiment = Experiment(network, 4, steps)
    # As one CUDA graph, where launching the kernels of each step takes longer than running them.
    simulated = mpm.captured(experiment, blocks, DT) if blocks.x.is_cuda else experiment
    options = {"max_iter": 1, "max_eval": 10, "history_size": 30, "line_search_fn": "strong_wolfe"}
    optimizer = torch.optim.LBFGS(network.parameters(), **options)

    def closure() -> Tensor:
        optimizer.zero_grad()
        misfit = 1e6 * (measured(simulated, blocks) - data).square().sum(-1).mean()
        misfit.backward()
        return misfit

    for k in range(iterations):
        print(f"{k:3d}  positions are off by {optimizer.step(closure).item() ** 0.5:.3f} mm", flush=True)


# ---- the result


def draw(truth: Tensor, learnt: Tensor, errors: dict[str, Tensor], network: Energy, path: Path) -> None:
    """The ring at four times, the errors of its positions, and the stress in simple shear."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.8), dpi=100)
    panels = figure.subplot_mosaic([[f"ring {k}" for k in range(4)], ["error", "error", "shear", "shear"]])
    for k in range(4):
        ring, frame = panels[f"ring {k}"], k * (len(truth) - 1) // 3
        ring.scatter(*truth[frame].T.cpu(), s=9, color="0.75", label="true")
        ring.scatter(*learnt[frame].T.cpu(), s=1, color="#0072B2", label="learnt")
        ring.set(title=f"{frame * EVERY * DT:.2f} s", xlabel="x [m]", aspect="equal", xlim=(0.4, 1.5), ylim=(0, 0.8))
    panels["ring 0"].set(ylabel="y [m]")
    error, shear = panels["error"], panels["shear"]
    for name, values in errors.items():
        error.plot(DT * EVERY * torch.arange(len(values)), 100 * values.cpu(), label=name)
    error.set(
        title="error of the ring",
        xlabel="time [s]",
        ylabel="distance / diameter [%]",
        ylim=(0, None),
    )
    strain = torch.linspace(0, 1.2, 50, dtype=truth.dtype, device=truth.device)
    F = torch.eye(2, dtype=truth.dtype, device=truth.device).repeat(50, 1, 1)
    F[:, 0, 1] = strain
    laws: tuple[tuple[str, Law, str], ...] = (("true", tissue, "0.6"), ("learnt", network, "#0072B2"))
    for name, law, color in laws:
        stress = law(F)[:, 0, 1].detach() / 1e3
        shear.plot(strain.cpu(), stress.cpu(), "--" if name == "learnt" else "-", color=color, lw=2, label=name)
    shear.set(title="the law in simple shear", xlabel="shear strain", ylabel="shear stress [kPa]")
    for axes in (panels["ring 0"], error, shear):
        axes.legend()
    figure.tight_layout()
    figure.savefig(path)


def main(out: Path, device: str = "cpu", iterations: int = 60, steps: int = 165) -> float:
    """Returns the largest of the mean errors of the ring's positions at any time, over its diameter."""
    torch.manual_seed(0)
    ring = thrown_ring(device)
    network = Energy().to(device, torch.float64)
    with torch.no_grad():
        truth = measured(Experiment(tissue, 1, 2 * steps), ring)
        before = measured(Experiment(network, 1, 2 * steps), ring)
    train(network, thrown_blocks(device), steps, iterations)
    with torch.no_grad():
        learnt = measured(Experiment(network, 1, 2 * steps), ring)
    errors = {
        name: (x - truth).norm(dim=2).mean(1) / SIZE
        for name, x in (("before training", before), ("after training", learnt))
    }
    out.mkdir(parents=True, exist_ok=True)
    draw(truth, learnt, errors, network, out / "learn_law.png")
    return float(errors["after training"].max())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/learn_law"), help="folder of the picture")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--iterations", type=int, default=60)
    torch.set_num_threads(1)  # A few hundred particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    error = main(options.out, options.device, options.iterations)
    print(f"positions of the ring are off by at most {error:.2%} of its diameter, in the mean of its particles")
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'learn_law.png'}")
