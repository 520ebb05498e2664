"""Find Young's modulus, Poisson's ratio and a friction angle from measured motions.

A jelly cube is thrown on the floor, and a column of sand collapses. For both, the positions of the particles are known
at some times, with measurement errors. The parameters start far off and follow the gradient of the misfit through the
whole simulation.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

import torch_mpm as mpm

GRID = mpm.Grid(dx=1 / 32, lower=(0, 0), upper=(1, 1))
DT = 1e-3  # [s]
NOISE = 1e-3  # deviation of the measured positions [m]: a thirtieth of a cell


@dataclass
class Experiment:
    """A moving body, and the parameters of its law by name: true ones, guesses, and bounds above (0 below)."""

    name: str
    start: mpm.State
    law: Callable[..., mpm.Material]
    true: dict[str, float]
    guess: dict[str, float]
    bounds: dict[str, float]
    seconds: float
    data: Tensor = field(init=False)
    found: list[dict[str, float]] = field(init=False)

    def observed(self, values: Sequence[float | Tensor]) -> Tensor:
        """Positions [13, P, 2] [m] of the particles over time, for some values of the parameters."""
        law = self.law(**dict(zip(self.true, values, strict=True)))
        step = mpm.Step(GRID, law, gravity=(0, -9.8), walls=mpm.Walls("separate", friction=0.5))
        every = round(self.seconds / DT / 12)
        return mpm.frames(step, self.start, 12 * every, DT, every, fields=["x"]).fields["x"]

    def measure(self) -> None:
        with torch.no_grad():
            exact = self.observed(list(self.true.values()))
        self.data = exact + NOISE * torch.randn_like(exact)

    def recover(self, iterations: int) -> None:
        """Minimise the misfit by L-BFGS over the logits of the parameters, so that these stay within their bounds."""
        guess, bounds = (self.start.x.new_tensor(list(values.values())) for values in (self.guess, self.bounds))
        logits = (guess / bounds).logit().requires_grad_()
        optimizer = torch.optim.LBFGS([logits], max_iter=1, max_eval=20, line_search_fn="strong_wolfe")
        self.found = [self.guess]

        def closure() -> Tensor:
            optimizer.zero_grad()
            misfit = (self.observed((bounds * logits.sigmoid()).unbind()) - self.data).square().mean() / NOISE**2
            misfit.backward()
            return misfit

        for k in range(iterations):
            misfit = optimizer.step(closure).item()
            self.found.append(dict(zip(self.guess, (bounds * logits.sigmoid()).tolist(), strict=True)))
            values = "  ".join(f"{name} {value:.5g}" for name, value in self.found[-1].items())
            print(f"{self.name} {k:3d}  misfit {misfit:9.3f}  {values}", flush=True)

    def errors(self) -> dict[str, list[float]]:
        """Relative error of each parameter before the first iteration and after each."""
        return {name: [abs(now[name] / value - 1) for now in self.found] for name, value in self.true.items()}


def jelly(device: str) -> Experiment:
    points = mpm.seed.box((0.2, 0.15), (0.5, 0.45), GRID, per_cell=4)
    start = mpm.State.at_rest(points, density=1000.0, velocity=(1.0, -1.0), dtype=torch.float64, device=device)
    true, guess, bounds = {"E": 3e4, "nu": 0.3}, {"E": 1e4, "nu": 0.15}, {"E": 1e5, "nu": 0.5}
    return Experiment("jelly", start, mpm.NeoHookean, true, guess, bounds, 0.36)


def sand(device: str) -> Experiment:
    points = mpm.seed.box((0.0, 0.0), (0.2, 0.4), GRID, per_cell=4)
    start = mpm.State.at_rest(points, density=1600.0, dtype=torch.float64, device=device)

    def law(friction_angle: float | Tensor) -> mpm.Material:
        return mpm.QuarticSand(E=1e5, nu=0.3, friction_angle=friction_angle)

    true, guess, bound = ({"friction_angle": math.radians(angle)} for angle in (35, 20, 90))
    return Experiment("sand", start, law, true, guess, bound, 0.6)


def draw(experiments: Sequence[Experiment], path: Path) -> None:
    """Plot of the measured and the simulated final positions, and the errors of the parameters."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.5), dpi=100)
    *maps, curve = figure.subplots(1, len(experiments) + 1)
    for axes, experiment in zip(maps, experiments, strict=True):
        axes.scatter(*experiment.data[-1].T.cpu(), s=14, color="0.75", label="measured")
        for name, values, color in (("guess", experiment.found[0], "#E69F00"), ("found", experiment.found[-1], "k")):
            with torch.no_grad():
                x = experiment.observed(list(values.values()))[-1].cpu()
            axes.scatter(*x.T, s=2, color=color, label=name)
        axes.set(title=f"{experiment.name} after {experiment.seconds:.2f} s", xlabel="x [m]", ylabel="y [m]")
        axes.set(aspect="equal", xlim=(0, 1), ylim=(0, 0.62))
        axes.legend(loc="upper left", markerscale=2)
        for name, errors in experiment.errors().items():
            label = {"E": "Young's modulus", "nu": "Poisson's ratio"}.get(name, "friction angle")
            curve.semilogy(errors, ".-", label=label)
    curve.axhline(0.01, color="0.6", lw=1, ls="--")
    curve.xaxis.get_major_locator().set_params(integer=True)
    curve.set(title="error of the parameters", xlabel="iteration", ylabel="relative error", ylim=(None, 20))
    curve.legend()
    figure.tight_layout()
    figure.savefig(path)


def main(out: Path, device: str = "cpu", iterations: int = 14) -> dict[str, float]:
    """Returns the relative error of each parameter."""
    torch.manual_seed(0)
    experiments = [jelly(device), sand(device)]
    for experiment in experiments:
        experiment.measure()
        experiment.recover(iterations)
    out.mkdir(parents=True, exist_ok=True)
    draw(experiments, out / "recover_parameters.png")
    return {name: errors[-1] for experiment in experiments for name, errors in experiment.errors().items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/recover_parameters"), help="folder of the picture")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--iterations", type=int, default=14)
    torch.set_num_threads(1)  # A few hundred particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    found = main(options.out, options.device, options.iterations)
    print("relative errors: " + ", ".join(f"{name} {error:.2%}" for name, error in found.items()))
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'recover_parameters.png'}")
