"""Implicit steps: convergence, costs, and errors.

    python -m benchmarks.implicit               # all studies, some half an hour on 2 cores
    python -m benchmarks.implicit --only cost   # one of them
    python -m benchmarks.implicit --quick       # seconds

Each study is a module of this package, described in its docstring.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import common
from . import cost, crossover, figures, multigrid, order, quasistatic, sand, stability, vibration

Result = dict[str, Any]


def of_stability(quick: bool, device: str, out: Path) -> Result:
    return {"Stability": stability.stability(quick)}


def of_vibration(quick: bool, device: str, out: Path) -> Result:
    return {"Waves and rotation": vibration.vibration(quick)}


def of_quasistatic(quick: bool, device: str, out: Path) -> Result:
    rows = quasistatic.squeeze(quick)
    figures.draw_work(rows, out / "implicit_work.png")
    return {"Gripper": rows, "Gripper, at equal error": quasistatic.at_equal_error(rows),
            "Settling": quasistatic.settling(quick)}  # fmt: skip


def of_crossover(quick: bool, device: str, out: Path) -> Result:
    rows = crossover.crossover(device, quick)
    return {"Steps of slow motion": rows, "Costs": crossover.fitted(rows)}


def of_order(quick: bool, device: str, out: Path) -> Result:
    in_time, in_space = order.in_time(quick), order.in_space(quick)
    figures.draw_order(in_time, in_space, out / "implicit_order.png")
    return {"Order in dt": in_time, "Order in dx": in_space}


def of_sand(quick: bool, device: str, out: Path) -> Result:
    clump, collapse = sand.clump(quick), sand.collapse(quick)
    figures.draw_sand(clump, collapse, out / "implicit_sand.png")
    return {"Cohesion": sand.cohesion(), "Clump": sand.without_states(clump),
            "Collapse": sand.without_states(collapse)}  # fmt: skip


def of_cost(quick: bool, device: str, out: Path) -> Result:
    return {"Cost, in units of a gather and a scatter": cost.cost(device, quick),
            "Steps": cost.steps(device, quick), "Beside a fluid": cost.beside_a_fluid(device, quick),
            "Batches": cost.batches(device, quick)}  # fmt: skip


def of_multigrid(quick: bool, device: str, out: Path) -> Result:
    return {"Linear solves": multigrid.linear_solves(quick), "Steps": multigrid.steps(quick)}


STUDIES: dict[str, tuple[Any, Callable[[bool, str, Path], Result]]] = {
    "stability": (stability, of_stability),
    "vibration": (vibration, of_vibration),
    "quasistatic": (quasistatic, of_quasistatic),
    "crossover": (crossover, of_crossover),
    "order": (order, of_order),
    "sand": (sand, of_sand),
    "cost": (cost, of_cost),
    "multigrid": (multigrid, of_multigrid),
}
ON_DEVICE = ("cost", "crossover")
"""Studies of speed only, which run on CUDA; the others study the method, on the CPU."""


def text(name: str, result: Result) -> str:
    about = (STUDIES[name][0].__doc__ or "").strip()
    tables = [f"## {title}\n\n{common.table(list(rows[0]), [list(row.values()) for row in rows])}"
              for title, rows in result.items() if title != "environment"]  # fmt: skip
    return "\n\n".join([f"# Implicit steps: {name}", common.describe(result["environment"]), about, *tables])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few and small cases, to see that it works")
    parser.add_argument("--only", choices=STUDIES, help="one study")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    quick, device = arguments.quick, arguments.device
    machine = "" if quick else f"_{common.slug(common.device_name(device))}"
    names = [arguments.only] if arguments.only else list(STUDIES if device == "cpu" else ON_DEVICE)
    for name in names:
        result = {"environment": common.environment(device), **STUDIES[name][1](quick, device, arguments.out)}
        print(text(name, result))
        common.write(arguments.out, f"implicit_{name}{machine}", result, text(name, result))


if __name__ == "__main__":
    main()
