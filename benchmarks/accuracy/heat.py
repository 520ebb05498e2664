"""Heat against analytic solutions: `python -m benchmarks.accuracy.heat [--quick] [--device cpu|cuda] [--out FOLDER]`.

Cosine mode in an insulated square, Bessel mode in an insulated disc, a bar with a flux at one end, a sine mode between
two walls that are held at a temperature, and a melting front from a hot wall (Stefan's problem), for both kernels and
all transfers of temperature, on a lattice that is not aligned with any of the bodies. Particles are regular, 4 per
cell, float64; the time step has a fixed diffusion number r, so that a method of second order shows order 2. Errors are
relative: RMS of the temperature, distance of the front. The hybrid is APIC for r of 1/4 and more; the error of PIC does
not shrink with dx but grows with 1/r.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.heat.boundaries import FixedSurface, Flux, Surface

from .. import common
from .convergence import fitted_order

SHIFT = 0.37
"""Offset of the bodies from the lattice, in cells."""
TRANSFERS = ("hybrid", "apic", "flip", "pic")
STEFAN = {0.1: 0.2200163, 0.5: 0.4647859, 1.0: 0.6200626}
"""λ with λ exp(λ²) erf λ = St/√π of each Stefan number St."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """A body with unit ρ, C and κ, and its exact temperature.

    `setup` makes (grid, state, boundaries, error of an end state) for n cells per length, a kernel and the end time.
    """

    name: str
    setup: Callable[..., Any]
    end: float
    number: float
    sizes: tuple[int, ...]
    melting: dict[str, float] = dataclasses.field(default_factory=dict)


def _relative(value: Tensor, exact: Tensor) -> float:
    return float(((value - exact).square().mean() / exact.square().mean()).sqrt())


def _state(points: mpm.seed.Points, dx: float, theta: Tensor, slope: Tensor, device: str) -> mpm.State:
    state = mpm.State.at_rest(points, 1.0, dtype=torch.float64)
    state = state.replace(x=state.x + SHIFT * dx, temperature=theta, extra={"temperature_gradient": slope})
    return state.to(device)


def cosine(n: int, kernel: str, end: float, device: str) -> Any:
    """θ = cos πx cos πy exp(−2π²t)."""
    dx, pi = 1 / n, math.pi
    points = mpm.seed.box((0, 0), (1, 1), dx, per_cell=4, dtype=torch.float64)
    x, y = points.x.unbind(1)
    theta = torch.cos(pi * x) * torch.cos(pi * y)
    slope = -pi * torch.stack([torch.sin(pi * x) * torch.cos(pi * y), torch.cos(pi * x) * torch.sin(pi * y)], 1)
    exact = (theta * math.exp(-2 * pi**2 * end)).to(device)
    grid = mpm.Grid(dx, (-0.5, -0.5), (1.5, 1.5), kernel=kernel)
    return grid, _state(points, dx, theta, slope, device), [], lambda state: _relative(state.temperature, exact)


def disc(n: int, kernel: str, end: float, device: str) -> Any:
    """θ = J0(k r) exp(−k²t) with k R = 3.8317, the first zero of J1."""
    dx, k = 1 / n, 3.8317059702075125 / 0.5
    points = mpm.seed.sphere((0, 0), 0.5, dx, per_cell=4, dtype=torch.float64)
    radius = points.x.norm(dim=1)
    theta = torch.special.bessel_j0(k * radius)
    slope = -k * (torch.special.bessel_j1(k * radius) / radius.clamp_min(1e-12))[:, None] * points.x
    exact = (theta * math.exp(-(k**2) * end)).to(device)
    grid = mpm.Grid(dx, (-1, -1), (1, 1), kernel=kernel)
    return grid, _state(points, dx, theta, slope, device), [], lambda state: _relative(state.temperature, exact)


def bar(n: int, kernel: str, end: float, device: str) -> Any:
    """θ = t + (3x² − 1)/6 − (2/π²) Σ (−1)^k exp(−k²π²t) cos(kπx)/k² with flux 1 at x = 1."""
    dx = 1 / n
    points = mpm.seed.box((0, 0), (1, 2 * dx), dx, per_cell=4, dtype=torch.float64)
    x = points.x[:, 0]
    k = torch.arange(1, 100, dtype=torch.float64)
    terms = (-1) ** k * torch.exp(-((k * math.pi) ** 2) * end) * torch.cos(k * math.pi * x[:, None]) / k**2
    exact = (end + (3 * x**2 - 1) / 6 - 2 / math.pi**2 * terms.sum(1)).to(device)
    heights = (torch.arange(4, dtype=torch.float64) + 0.5) * 0.5 * dx
    ends = torch.stack([torch.ones_like(heights), heights], 1) + SHIFT * dx
    flux = Flux(Surface(ends.to(device), 0.5 * dx), 1.0)
    grid = mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5), kernel=kernel)
    state = _state(points, dx, torch.zeros_like(x), torch.zeros_like(points.x), device)
    return grid, state, [flux], lambda state: _relative(state.temperature, exact)


def _wall(x: float, side: float, temperature: float) -> FixedSurface:
    """A held wall at x, with the body on one side of it."""
    return FixedSurface(mpm.Plane((x, 0.0), (side, 0.0)), temperature)


def walls(n: int, kernel: str, end: float, device: str) -> Any:
    """θ = sin πx exp(−π²t) between walls at 0."""
    dx, pi = 1 / n, math.pi
    points = mpm.seed.box((0, 0), (1, 2 * dx), dx, per_cell=4, dtype=torch.float64)
    x = points.x[:, 0]
    theta, slope = torch.sin(pi * x), torch.stack([pi * torch.cos(pi * x), torch.zeros_like(x)], 1)
    exact = (theta * math.exp(-(pi**2) * end)).to(device)
    grid = mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5), kernel=kernel)
    held = [_wall(SHIFT * dx, 1.0, 0.0), _wall(1 + SHIFT * dx, -1.0, 0.0)]
    return grid, _state(points, dx, theta, slope, device), held, lambda state: _relative(state.temperature, exact)


def front(n: int, kernel: str, end: float, device: str) -> Any:
    """s = 2 λ √t from a wall at 1 in a solid at its melting point 0; s by the latent heat that was taken up."""
    dx = 1 / n
    points = mpm.seed.box((0, 0), (1, dx), dx, per_cell=4, dtype=torch.float64)
    grid = mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5), kernel=kernel)
    state = _state(points, dx, torch.zeros_like(points.x[:, 0]), torch.zeros_like(points.x), device)

    def error(state: mpm.State) -> float:
        return abs(float((state.extra["liquid"] * state.volume).sum()) / dx / FRONT - 1)

    return grid, state, [_wall(SHIFT * dx, 1.0, 1.0)], error


FRONT = 0.4
"""Position of the melting front at the end."""

PROBLEMS = (
    Problem("cosine mode", cosine, 0.05, 0.1, (8, 16, 32, 48)),
    Problem("disc", disc, 0.01, 0.1, (8, 16, 32, 64)),
    Problem("heated bar", bar, 0.1, 0.1, (8, 16, 32, 64)),
    Problem("held walls", walls, 0.1, 0.1, (8, 16, 32, 64)),
    *(
        Problem(
            f"melting front, St = {stefan:g}", front, (FRONT / (2 * root)) ** 2, 0.5 if stefan == 1 else 2.0,
            (16, 32, 64, 128), {"melting_point": 0.0, "latent_heat": 1 / stefan},
        )
        for stefan, root in STEFAN.items()
    ),
)  # fmt: skip


def run(problem: Problem, n: int, kernel: str, transfer: str, device: str) -> dict[str, Any]:
    """Simulate a problem to its end."""
    grid, state, boundaries, error = problem.setup(n, kernel, problem.end, device)
    steps = max(1, round(problem.end * n**2 / problem.number))
    heat = mpm.Heat(grid, 1.0, 1.0, boundaries, transfer=transfer, **problem.melting)
    dt = problem.end / steps
    if transfer not in ("hybrid", "apic"):
        state = state.replace(extra={})
    begin = time.perf_counter()
    with torch.no_grad():
        end = mpm.rollout(heat, state, steps, dt)
    heat.check()
    seconds = time.perf_counter() - begin
    return {"n": n, "particles": len(state), "steps": steps, "seconds": seconds, "error": error(end)}


def small_steps(device: str) -> dict[str, Any]:
    """Share of the change that float32 loses in 200 steps with a diffusion number of 1e-5, by the reference of θ."""
    n, ends = 48, {}
    for name, dtype, offset in (
        ("exact", torch.float64, 0.0),
        ("relative to 300 K", torch.float32, 0.0),
        ("absolute", torch.float32, 300.0),
    ):
        points = mpm.seed.sphere((0.5, 0.5), 0.4, 1 / n, per_cell=4)
        ball = mpm.State.at_rest(points, 1.0, dtype=dtype, device=device)
        x = ball.x.double()
        theta = (torch.where(x[:, 0] < 0.45, 1.0, 0.0) + 0.2 * torch.sin(9 * x[:, 1]) + offset).to(dtype)
        heat = mpm.Heat(mpm.Grid(1 / n, (0, 0), (1, 1)), 1.0, 1.0)
        with torch.no_grad():
            end = mpm.rollout(heat, ball.replace(temperature=theta), 200, 1e-5 / n**2)
        ends[name] = end.temperature.double() - theta.double()
    exact = ends.pop("exact")
    return {name: float((change - exact).norm() / exact.norm()) for name, change in ends.items()}


def measure(problems: Iterable[Problem], kernels: Iterable[str], device: str) -> dict[str, Any]:
    common.use_all_cores()
    result: dict[str, Any] = {"environment": common.environment(device), "cases": []}
    run(PROBLEMS[0], 4, "quadratic", "hybrid", device)  # first calls are slow
    for problem in problems:
        for kernel in kernels:
            for transfer in TRANSFERS:
                rows = [run(problem, n, kernel, transfer, device) for n in problem.sizes]
                order = fitted_order(rows, "error")
                case = {"problem": problem.name, "kernel": kernel, "transfer": transfer, "number": problem.number}
                result["cases"].append({**case, "order": order, "rows": rows})
                last = rows[-1]
                print(f"{problem.name}, {kernel}, {transfer}: {last['error']:.2e}, order {order:.2f}, "
                      f"{sum(r['seconds'] for r in rows):.1f} s", flush=True)  # fmt: skip
    result["float32"] = small_steps(device)
    return result


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = ["# Heat", "", common.describe(result["environment"]), "", (__doc__ or "").split("\n\n", 2)[1], ""]
    header = ("problem", "kernel", "transfer", "r", "n", "error", "order", "seconds")
    rows = [
        (case["problem"], case["kernel"], case["transfer"], case["number"], row["n"], row["error"],
         f"{case['order']:.2f}" if row is case["rows"][-1] else "", row["seconds"])
        for case in result["cases"] for row in case["rows"]
    ]  # fmt: skip
    lines += [common.table(header, rows), "", "## float32", ""]
    lines += ["Share of the change lost in 200 steps with a diffusion number of 1e-5, temperatures around 300 K.", ""]
    return "\n".join([*lines, common.table(("temperatures", "lost"), result["float32"].items())])


def plot(result: dict[str, Any], path: Path) -> None:
    """Error over dx above and over run time below, one column per problem."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    problems = list(dict.fromkeys(case["problem"] for case in result["cases"]))
    figure, axes = plt.subplots(2, len(problems), figsize=(3.4 * len(problems), 7), squeeze=False)
    colors = dict(zip(TRANSFERS, ("tab:blue", "tab:orange", "tab:green", "tab:red"), strict=True))
    for problem, over_dx, over_time in zip(problems, *axes, strict=True):
        for case in (c for c in result["cases"] if c["problem"] == problem):
            style = {
                "color": colors[case["transfer"]],
                "linestyle": "-" if case["kernel"] == "quadratic" else "--",
                "marker": "o" if case["kernel"] == "quadratic" else "s",
                "markersize": 4,
                "label": f"{case['transfer']}, {case['kernel']}",
            }
            errors = [row["error"] for row in case["rows"]]
            over_dx.loglog([1 / row["n"] for row in case["rows"]], errors, **style)
            over_time.loglog([row["seconds"] for row in case["rows"]], errors, **style)
        sizes = np.array(sorted(1 / row["n"] for row in case["rows"]))
        start = min(c["rows"][0]["error"] for c in result["cases"] if c["problem"] == problem)
        over_dx.loglog(sizes, 0.5 * start * (sizes / sizes[-1]) ** 2, color="gray", linewidth=0.8, linestyle=":")
        over_dx.annotate("order 2", (sizes[0], 0.5 * start * (sizes[0] / sizes[-1]) ** 2), color="gray", fontsize=8)
        over_dx.set(xlabel="1 / n", title=problem, xticks=sizes, xticklabels=[f"1/{1 / size:.0f}" for size in sizes])
        over_dx.minorticks_off()
        over_time.set(xlabel="run time [s]")
    axes[0, 0].set_ylabel("relative error")
    axes[1, 0].set_ylabel("relative error")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="lower center", ncol=4, fontsize=8)
    figure.tight_layout(rect=(0, 0.07, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    print(f"wrote {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse lattices and one kernel, to see that it works")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    problems: Iterable[Problem] = PROBLEMS
    if arguments.quick:
        problems = [dataclasses.replace(p, sizes=(4, 8)) for p in (*PROBLEMS[:4], PROBLEMS[-1])]
    kernels = ("quadratic",) if arguments.quick else ("quadratic", "cubic")
    result = measure(problems, kernels, arguments.device)
    print(text(result).split("\n| ")[0])
    common.write(arguments.out, "heat", result, text(result))
    plot(result, arguments.out / "heat.png")


if __name__ == "__main__":
    sys.exit(main())
