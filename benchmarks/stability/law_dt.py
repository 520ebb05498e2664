"""Largest stable time step of every law: `python -m benchmarks.stability.law_dt [--device cuda]`.

As benchmarks.stability.stable_dt, in one setting (APIC, MLS, quadratic kernel, 2 particles per axis of a cell). A law
with a return map moves the uniform deformation to its yield surface in the first step, which preserves uniformity; the
estimate is that of the previous state.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common
from .stable_dt import LAWS, Case, measure, ratio

VARIED = ("law", "dim", "E", "nu", "stretch")
"""Fields that differ between cases."""


def all_cases(quick: bool) -> list[Case]:
    stiffness = (1e6,) if quick else (1e3, 1e6, 1e9)
    ratios = (0.0, 0.49) if quick else (0.0, 0.2, 0.4, 0.49)
    stretches = (0.5, 2.0) if quick else (0.2, 0.5, 0.9, 1.0, 1.1, 2.0, 5.0)
    values = itertools.product(LAWS, (2,) if quick else (2, 3), stretches, ratios, stiffness)
    return [Case(dim, E, nu, stretch, law=law) for law, dim, stretch, nu, E in values if law != "neo-Hookean"]


def elliptic(case: Case, directions: int = 300, step: float = 1e-6) -> bool:
    """Whether plane waves have real speeds: the acoustic tensor of the deformation is positive in all directions.

    By differences of the stress, of elastic laws; return maps keep elastic strains small.
    """
    if case.law not in ("fixed corotated", "Hencky"):
        return True
    law = LAWS[case.law](torch.tensor(case.E, dtype=torch.float64), torch.tensor(case.nu, dtype=torch.float64))
    F, dim = case.deformation(), case.dim
    n = torch.randn(directions, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    n = n / n.norm(dim=1, keepdim=True)

    def stress(F: Tensor) -> Tensor:
        one = torch.ones(len(F), dtype=F.dtype)
        return law.stress(mpm.State(x=F[:, 0], v=F[:, 0], mass=one, volume=one, F=F))

    columns = []
    for k in range(dim):
        G = torch.zeros(directions, dim, dim, dtype=torch.float64)
        G[:, k] = n
        change = (stress(F + step * G @ F) - stress(F - step * G @ F)) / (2 * step)
        columns.append(((change - stress(F[None]) @ G.mT) @ n[:, :, None])[:, :, 0])
    Q = torch.stack(columns, 2)
    return bool((torch.linalg.eigvalsh(Q + Q.mT) > 0).all())


def text(result: dict[str, Any]) -> str:
    cases = result["cases"]
    limited = [c["stable"] for c in cases if c["elliptic"]]
    lines = [
        "# Largest stable time step of every law",
        "",
        f"{common.describe(result['environment'])}; {result['seconds']:.0f} s.",
        "",
        "The largest stable time step in multiples of the estimate `step.stable_dt(state, cfl=1)`: the lower end of a",
        f"bracket 3% wide. The smallest of {len(limited)} cases is {min(limited):.2f}; {len(cases) - len(limited)}",
        "more (in brackets) are not elliptic, so that disturbances grow for every step; with – they did. Of the",
        f"values of E from 1e3 to 1e9 Pa the smallest; they differ by at most {spread(cases):.2g}. s < 1 is F = s I,",
        "s > 1 is F = diag(s, ...) with det F = 1.",
        "",
    ]
    for dim in sorted({c["dim"] for c in cases}):
        mine = [c for c in cases if c["dim"] == dim]
        stretches = sorted({c["stretch"] for c in mine})
        rows = []
        for law, nu in dict.fromkeys((c["law"], c["nu"]) for c in mine):
            same = [c for c in mine if (c["law"], c["nu"]) == (law, nu)]
            rows.append([law, f"{nu:g}", *(cell([c for c in same if c["stretch"] == s]) for s in stretches)])
        header = ["law", "ν", *(f"s={s:g}" for s in stretches)]
        lines += [f"## {dim}-D", "", common.table(header, rows), ""]
    return "\n".join(lines)


def cell(cases: list[dict[str, Any]]) -> str:
    value = ratio(min(c["stable"] for c in cases))
    return value if all(c["elliptic"] for c in cases) else f"({value})"


def spread(cases: list[dict[str, Any]]) -> float:
    """Largest difference between the multiples of cases that differ only in E."""
    groups: dict[tuple[Any, ...], list[float]] = {}
    for c in cases:
        groups.setdefault((c["law"], c["dim"], c["nu"], c["stretch"]), []).append(c["stable"])
    return max(max(g) - min(g) for g in groups.values())


def case_of(row: dict[str, Any]) -> Case:
    return Case(**{name: row[name] for name in VARIED})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few cases, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--again", type=Path, help="earlier result; only its unstable cases are measured again")
    arguments = parser.parse_args()
    common.use_all_cores()
    begin = time.perf_counter()
    result: dict[str, Any] = {"environment": common.environment(arguments.device)}
    if arguments.again:
        result = json.loads(arguments.again.read_text())
        again = [c for c in result["cases"] if c["stable"] < 1]
        measured = measure([case_of(c) for c in again], arguments.device)
        for c, new in zip(again, measured, strict=True):
            c["stable"] = new["stable"]
        result["again"] = common.environment(arguments.device)
    else:
        cases = all_cases(arguments.quick)
        result["cases"] = [{key: row[key] for key in (*VARIED, "stable")} for row in measure(cases, arguments.device)]
        result["seconds"] = time.perf_counter() - begin
    for c in result["cases"]:
        c["elliptic"] = elliptic(case_of(c))
    print(text(result))
    common.write(arguments.out, "stability_laws", result, text(result))


if __name__ == "__main__":
    sys.exit(main())
