"""Find the stiffness of every particle of a plate from its motion in four experiments.

The plate is stiffer in one disc and softer in another. It is set in motion four times, each time with other
velocities, as the four scenes of one batch, and the positions of its particles are measured at some times. The
stiffness of every particle is an unknown; the gradient of the misfit with respect to all of them comes from one
backward pass.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch
from torch import Tensor

import torch_mpm as mpm

DT, STEPS, EVERY = 2e-3, 60, 10  # time step [s]; steps between two measurements
NOISE = 1e-4  # deviation of the measured positions [m]
GUESS = 1.5e4  # Young's modulus before the first iteration [Pa]


def plate(cells: int, device: str) -> tuple[mpm.Grid, mpm.State]:
    """A plate of 1 m x 1 m in free flight four times: it is stretched along x, along y, sheared, and bent."""
    dx = 1 / cells
    grid = mpm.Grid(dx, lower=(-0.5, -0.5), upper=(1.5, 1.5), scenes=4)
    one = mpm.State.at_rest(mpm.seed.box((0, 0), (1, 1), dx, per_cell=4), dtype=torch.float64, device=device)
    x, y = math.pi * one.x.T
    zero = torch.zeros_like(x)
    motions = [(x.cos(), zero), (zero, y.cos()), (y.cos(), x.cos()), ((2 * x).cos() * y.cos(), x.cos() * (2 * y).cos())]
    scenes = [one.replace(v=0.5 * torch.stack(motion, 1)) for motion in motions]
    return grid, mpm.State.concatenate(scenes, scene=True)


def true_stiffness(x: Tensor) -> Tensor:
    """Young's modulus [P] [Pa] at positions [P, 2] before the deformation."""

    def inside(center: tuple[float, float], radius: float) -> Tensor:
        return torch.sigmoid((radius - (x - x.new_tensor(center)).norm(dim=1)) / 0.04)

    return 2e4 * (1 + inside((0.3, 0.65), 0.17) - 0.5 * inside((0.7, 0.3), 0.17))


def draw(x: Tensor, true: Tensor, found: Tensor, path: Path) -> None:
    """True and found stiffness, and the difference."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.1), dpi=100)
    stiffness = {"cmap": "viridis", "vmin": 10, "vmax": 40}
    error = {"cmap": "coolwarm", "vmin": -5, "vmax": 5}
    panels = (
        ("true stiffness [kPa]", true / 1e3, stiffness),
        ("found stiffness [kPa]", found / 1e3, stiffness),
        ("error [%]", 100 * (found / true - 1), error),
    )
    for axes, (title, values, colors) in zip(figure.subplots(1, 3), panels, strict=True):
        drawn = axes.scatter(*x.T.cpu(), c=values.cpu(), s=3e4 / len(x), marker="s", linewidths=0, **colors)
        figure.colorbar(drawn, ax=axes)
        axes.set(title=title, xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=(0, 1), ylim=(0, 1))
        axes.set(xticks=(0, 0.5, 1), yticks=(0, 0.5, 1))
    figure.tight_layout()
    figure.savefig(path)


def main(out: Path, device: str = "cpu", cells: int = 24, iterations: int = 50) -> float:
    """Returns the relative error of the stiffness, in the root mean square."""
    torch.manual_seed(0)
    grid, start = plate(cells, device)
    rest = start.x[start.scene == 0]
    true = true_stiffness(rest)

    def observed(stiffness: Tensor) -> Tensor:
        """Positions [STEPS / EVERY + 1, 4 P, 2] [m] for a stiffness [P] [Pa]."""
        step = mpm.Step(grid, mpm.NeoHookean(E=stiffness.repeat(4), nu=0.3))
        return mpm.frames(step, start, STEPS, DT, EVERY, fields=["x"]).fields["x"]

    with torch.no_grad():
        data = observed(true)
    data = data + NOISE * torch.randn_like(data)
    # Regions that no experiment strains, such as the corners, get the mean level.
    level, deviation = start.x.new_zeros(1, requires_grad=True), start.x.new_zeros(len(rest), requires_grad=True)
    optimizer = torch.optim.LBFGS([level, deviation], max_iter=1, max_eval=10, line_search_fn="strong_wolfe")

    def found() -> Tensor:
        return GUESS * (level + deviation).exp()

    def closure() -> Tensor:
        optimizer.zero_grad()
        misfit = (observed(found()) - data).square().mean() / NOISE**2
        misfit.backward()
        return misfit

    error = math.inf
    for k in range(iterations):
        misfit = optimizer.step(closure).item()
        with torch.no_grad():
            error = float((found() - true).norm() / true.norm())
        print(f"{k:3d}  misfit {misfit:9.3f}  error of the stiffness {error:.2%}", flush=True)
        if misfit < 1.005:  # The rest is noise.
            break
    out.mkdir(parents=True, exist_ok=True)
    draw(rest, true, found().detach(), out / "recover_stiffness_field.png")
    return error


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/recover_stiffness_field"), help="folder of the picture")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--iterations", type=int, default=50)
    torch.set_num_threads(1)  # A few hundred particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    error = main(options.out, options.device, iterations=options.iterations)
    print(f"error of the stiffness {error:.2%}")
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'recover_stiffness_field.png'}")
