"""Largest stable time step of every law: `python -m benchmarks.stability.law_dt [--device cuda]`.

As benchmarks.stability.stable_dt, in one setting (APIC, MLS, quadratic kernel, 2 particles per axis of a cell). A law
with a return map takes the uniform deformation to its yield surface in the first step, which keeps it uniform; the
estimate is that of the state before.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path
from typing import Any

from .. import common
from .stable_dt import LAWS, Case, measure, ratio


def all_cases(quick: bool) -> list[Case]:
    stiffness = (1e6,) if quick else (1e3, 1e6, 1e9)
    ratios = (0.0, 0.49) if quick else (0.0, 0.2, 0.4, 0.49)
    stretches = (0.5, 2.0) if quick else (0.2, 0.5, 0.9, 1.0, 1.1, 2.0, 5.0)
    values = itertools.product(LAWS, (2,) if quick else (2, 3), stretches, ratios, stiffness)
    return [Case(dim, E, nu, stretch, law=law) for law, dim, stretch, nu, E in values if law != "neo-Hookean"]


def text(result: dict[str, Any]) -> str:
    cases = result["cases"]
    limited = [c["stable"] for c in cases if c["stable"] > 0]
    lines = [
        "# Largest stable time step of every law",
        "",
        f"{common.describe(result['environment'])}; {result['seconds']:.0f} s.",
        "",
        "The largest stable time step in multiples of the estimate `step.stable_dt(state, cfl=1)`: the lower end of a",
        f"bracket 2% wide. The smallest of {len(limited)} cases is {min(limited):.2f}; {len(cases) - len(limited)} are",
        "unstable whatever the step (–), by prestress. Of the values of E from 1e3 to 1e9 Pa the smallest; they differ",
        f"by at most {spread(cases):.2g}. s < 1 is F = s I, s > 1 is F = diag(s, ...) with det F = 1.",
        "",
    ]
    for dim in sorted({c["dim"] for c in cases}):
        mine = [c for c in cases if c["dim"] == dim]
        stretches = sorted({c["stretch"] for c in mine})
        rows = []
        for law, nu in dict.fromkeys((c["law"], c["nu"]) for c in mine):
            same = [c for c in mine if (c["law"], c["nu"]) == (law, nu)]
            limits = [min(c["stable"] for c in same if c["stretch"] == s) for s in stretches]
            rows.append([law, f"{nu:g}", *(ratio(value) for value in limits)])
        header = ["law", "ν", *(f"s={s:g}" for s in stretches)]
        lines += [f"## {dim}-D", "", common.table(header, rows), ""]
    return "\n".join(lines)


def spread(cases: list[dict[str, Any]]) -> float:
    """The largest difference between the multiples of cases that differ in E alone."""
    groups: dict[tuple[Any, ...], list[float]] = {}
    for c in cases:
        groups.setdefault((c["law"], c["dim"], c["nu"], c["stretch"]), []).append(c["stable"])
    return max(max(g) - min(g) for g in groups.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few cases, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    common.use_all_cores()
    begin = time.perf_counter()
    result: dict[str, Any] = {"environment": common.environment(arguments.device)}
    result["cases"] = measure(all_cases(arguments.quick), arguments.device)
    result["seconds"] = time.perf_counter() - begin
    print(text(result))
    common.write(arguments.out, "stability_laws", result, text(result))


if __name__ == "__main__":
    sys.exit(main())
