"""Gradients of whole rollouts: against differences in float64, and float32 against float64, over their length.

    python -m benchmarks.accuracy.rollout_gradients             # minutes on 2 cores
    python -m benchmarks.accuracy.rollout_gradients --quick     # seconds

Three problems in two dimensions, each with a loss of the end and several causes together:

- contact: an elastic block falls on a moving ball with friction and then to the floor; causes are its velocities, its
  stiffness, gravity, the place and the velocity of the ball, and the time step.
- sand: a column of sand collapses on a rough floor; causes are its positions, its stiffness, its friction angle and
  gravity.
- heat: a hot elastic block that cools at its surface, expands and falls; causes are its temperatures, its conductivity,
  its expansion and its velocities.

Each cause has a scale. The directional derivative is that along a random direction of all causes together, times their
scales, against central differences in float64. The error of float32 is the distance of the gradients times the scales,
relative to that of float64; both begin with the same numbers, exact in float32. Growth is the largest norm of the
gradient by an intermediate state over that at the end, as in `GradientNorms`.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.heat.boundaries import Convection, FreeSurface

from .. import common

DX = 0.05
F64 = torch.float64
Values = dict[str, Tensor]


@dataclasses.dataclass
class Problem:
    """Causes with their scales, and the end of a rollout from them.

    Attributes:
        causes: values in float64 that float32 has too.
        scales: of the causes.
        make: a step, a state and a time step from the causes.
    """

    causes: Values
    scales: dict[str, float]
    make: Callable[[Values], tuple[mpm.Step, mpm.State, Any]]

    def to(self, device: str) -> Problem:
        """The same on another device."""
        return dataclasses.replace(self, causes={name: value.to(device) for name, value in self.causes.items()})

    def loss(self, causes: Values, n: int, **options: Any) -> Tensor:
        """A smooth function of the positions and velocities of the particles after n steps, of the order of one."""
        step, state, dt = self.make(causes)
        end = mpm.rollout(step, state, n, dt, **options)
        weights = torch.linspace(-1, 1, len(end), dtype=F64).to(end.x)
        place = ((weights[:, None] + 0.5) * (end.x / DX).sin()).mean()
        return place + (weights[:, None] * end.v).mean() + 0.1 * end.v.square().mean()

    def gradient(self, n: int, dtype: torch.dtype = F64, **options: Any) -> Tensor:
        """Gradient of the loss by all causes times their scales, one after another."""
        leaves = {name: value.to(dtype).requires_grad_() for name, value in self.causes.items()}
        grads = torch.autograd.grad(self.loss(leaves, n, **options), list(leaves.values()))
        return torch.cat([self.scales[k] * g.reshape(-1).double() for k, g in zip(leaves, grads, strict=True)])

    @torch.no_grad()
    def difference(self, n: int, direction: Tensor, share: float = 1e-5) -> float:
        """The derivative of the loss along a direction of all causes by central differences of fourth order."""
        parts = dict(zip(self.causes, direction.split([v.numel() for v in self.causes.values()]), strict=True))

        def at(s: float) -> float:
            moved = {k: v + s * self.scales[k] * parts[k].view_as(v) for k, v in self.causes.items()}
            return float(self.loss(moved, n))

        near, far = at(share) - at(-share), at(2 * share) - at(-2 * share)
        return (8 * near - far) / (12 * share)


def _block(cells: int, low: Sequence[float], dtype: torch.dtype) -> mpm.State:
    grid = mpm.Grid(DX, (0, 0), (1, 1))
    high = [a + cells * DX for a in low]
    return mpm.State.at_rest(mpm.seed.box(tuple(low), tuple(high), grid, per_cell=4), 1000.0, dtype=dtype)


def _exact(value: Any) -> Tensor:
    """float64 values that are exact in float32."""
    return torch.as_tensor(value, dtype=torch.float32).double()


def contact(cells: int) -> Problem:
    state = _block(cells, (0.35, 0.3), F64)
    causes = {
        "v": state.v + torch.tensor([0.2, -2.0]),
        "E": 3e4,
        "gravity": [0.0, -9.8],
        "position": [0.4, 0.15],
        "velocity": [0.3, 0.2],
        "dt": [5e-4],
    }
    scales = {"v": 1.0, "E": 1e4, "gravity": 1.0, "position": 0.01, "velocity": 0.1, "dt": 1e-5}

    def make(c: Values) -> tuple[mpm.Step, mpm.State, Any]:
        ball = mpm.Sphere(c["position"], 0.12, velocity=c["velocity"], friction=0.3)
        law = mpm.NeoHookean(E=c["E"], nu=0.3)
        step = mpm.Step(mpm.Grid(DX, (0, 0), (1, 1)), law, c["gravity"], "separate", [ball])
        return step, state.to(c["v"].device, c["v"].dtype).replace(v=c["v"]), c["dt"]

    return Problem({name: _exact(value) for name, value in causes.items()}, scales, make)


def sand(cells: int) -> Problem:
    state = _block(cells, (0.3, 0.0), F64)
    causes = {"x": state.x, "E": 1e6, "friction_angle": 0.5, "gravity": [0.5, -9.8]}
    scales = {"x": 0.1 * DX, "E": 1e5, "friction_angle": 0.05, "gravity": 1.0}

    def make(c: Values) -> tuple[mpm.Step, mpm.State, Any]:
        law = mpm.QuarticSand(E=c["E"], nu=0.3, friction_angle=c["friction_angle"], energy="unilateral", flow="exact")
        walls = mpm.Walls("separate", friction=0.4)
        step = mpm.Step(mpm.Grid(DX, (0, 0), (1, 1)), law, c["gravity"], walls)
        return step, state.to(c["x"].device, c["x"].dtype).replace(x=c["x"]), 5e-4

    return Problem({name: _exact(value) for name, value in causes.items()}, scales, make)


def heat(cells: int) -> Problem:
    state = _block(cells, (0.3, 0.1), F64)
    warm = 40 + 20 * (state.x[:, 0] / DX).sin()
    causes = {"temperature": warm, "conductivity": 400.0, "expansion": 1e-3, "v": state.v + torch.tensor([0.3, -2.0])}
    scales = {"temperature": 10.0, "conductivity": 100.0, "expansion": 1e-4, "v": 1.0}

    def make(c: Values) -> tuple[mpm.Step, mpm.State, Any]:
        grid = mpm.Grid(DX, (0, 0), (1, 1))
        law = mpm.ThermalExpansion(mpm.NeoHookean(E=3e4, nu=0.3), c["expansion"])
        cooling = Convection(FreeSurface(), coefficient=2e3, ambient=0.0)
        tolerance = 1e-12 if c["v"].dtype == F64 else 1e-6
        air = mpm.Heat(grid, c["conductivity"], specific_heat=10.0, boundaries=[cooling], tolerance=tolerance)
        step = mpm.Step(grid, law, (0.0, -9.8), "separate", heat=air)
        return step, state.to(c["v"].device, c["v"].dtype).replace(v=c["v"], temperature=c["temperature"]), 5e-4

    return Problem({name: _exact(value) for name, value in causes.items()}, scales, make)


PROBLEMS = {"contact": contact, "sand": sand, "heat": heat}


def directional_error(problem: Problem, n: int, gradient: Tensor) -> float:
    """Relative distance of the derivative along a random direction from that by differences, in float64."""
    direction = torch.randn(len(gradient), generator=torch.Generator().manual_seed(2), dtype=F64).to(gradient.device)
    expected = problem.difference(n, direction)
    return abs(float(gradient @ direction) - expected) / abs(expected)


def growth(problem: Problem, n: int) -> tuple[float, int | None]:
    """Largest norm of the gradient by an intermediate state over that at the end, and the suggested truncation."""
    norms = mpm.GradientNorms(every=max(n // 50, 1))
    problem.gradient(n, norms=norms)
    total = norms.total()[:, 0]
    return float(total.nan_to_num(0.0).max() / total[-1]), norms.truncation()


def measure(lengths: Sequence[int], cells: int) -> dict[str, Any]:
    common.use_all_cores()
    result: dict[str, Any] = {"environment": common.environment(), "dx": DX, "cases": []}
    for name, make in PROBLEMS.items():
        problem, rows = make(cells), []
        for n in lengths:
            exact, single = problem.gradient(n), problem.gradient(n, torch.float32)
            largest, truncation = growth(problem, n)
            rows.append({
                "steps": n,
                "difference": directional_error(problem, n, exact),
                "float32": float((single - exact).norm() / exact.norm()),
                "growth": largest,
                "truncation": truncation,
            })  # fmt: skip
            print(name, rows[-1], flush=True)
        particles = len(problem.make(problem.causes)[1])
        result["cases"].append({"name": name, "particles": particles, "rows": rows})
    return result


def text(result: dict[str, Any]) -> str:
    lines = ["# Gradients of rollouts", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), "", "![](rollout_gradients.png)", ""]
    header = ("steps", "float64 against differences", "float32 against float64", "growth", "suggested truncation")
    for case in result["cases"]:
        keys = ("steps", "difference", "float32", "growth", "truncation")
        rows = [["none" if row[k] is None else row[k] for k in keys] for row in case["rows"]]
        lines += [f"## {case['name'].capitalize()}, {case['particles']} particles", "", common.table(header, rows), ""]
    return "\n".join(lines)


def plot(result: dict[str, Any], path: Path) -> None:
    """Both errors over the length of the rollout."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, places = plt.subplots(1, 2, figsize=(10, 4), sharex=True, layout="constrained")
    for case in result["cases"]:
        steps = [row["steps"] for row in case["rows"]]
        for place, key in zip(places, ("float32", "difference"), strict=True):
            place.loglog(steps, [row[key] for row in case["rows"]], "o-", label=case["name"])
    places[0].set(title="float32 against float64", xlabel="steps", ylabel="relative error of the gradient")
    places[1].set(title="float64 against differences", xlabel="steps", ylabel="relative error of a derivative")
    for place in places:
        place.grid(alpha=0.3)
        place.legend()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="short rollouts of small blocks, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    result = measure([4], 3) if arguments.quick else measure([10, 20, 50, 100, 200, 400], 6)
    common.write(arguments.out, "rollout_gradients", result, text(result))
    plot(result, arguments.out / "rollout_gradients.png")


if __name__ == "__main__":
    main()
