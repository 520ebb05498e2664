"""Singular value decompositions of 3x3 matrices: `python -m benchmarks.accuracy.svd`.

float32, on the CPU: svd3, Warp's svd3 where it is installed, and torch.linalg.svd on the same matrices, against
torch.linalg.svdvals in float64. Condition numbers 1 to 1e12 with one or two small singular values, entries of 1e-30 to
1e30, and neighbours of the identity. Errors: of the singular values relative to themselves, of U diag(σ) Vᵀ relative to
the largest singular value, and |UᵀU − I| with |VᵀV − I|.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common
from ..speed.svd import rotations, warp_arrays

CONDITIONS = (1.0, 1e1, 1e2, 1e4, 1e6, 1e8, 1e12)
SCALES = (1e-30, 1e-15, 1e15, 1e30)
MEASURES = ("singular values", "product", "axes")


def families(count: int) -> Iterator[tuple[str, Tensor]]:
    """Names and matrices [P, 3, 3] float32."""
    for size in (0.1, 1e-3):
        yield f"I + {size:g} G", torch.eye(3) + size * torch.randn(count, 3, 3)
    for condition in CONDITIONS:
        yield f"condition {condition:.0e}", of_condition(condition, 1, count)
        if condition > 1:
            yield f"condition {condition:.0e}, two small", of_condition(condition, 2, count)
    for scale in SCALES:
        yield f"{scale:.0e} times condition 1e+01", (scale * of_condition(10.0, 1, count).double()).float()


def of_condition(condition: float, small: int, count: int) -> Tensor:
    sigma = torch.ones(count, 3, dtype=torch.float64)
    if condition > 1:
        sigma = sigma * (0.5 + torch.rand(count, 3, dtype=torch.float64))
        sigma[:, 3 - small :] /= condition
    return (rotations(count) * sigma[:, None, :] @ rotations(count).mT).float()


def decompositions(F: Tensor) -> Iterator[tuple[str, tuple[Tensor, Tensor, Tensor]]]:
    yield "svd3", mpm.svd3(F)
    if (warp := warp_arrays(F)) is not None:
        run, read = warp
        run()
        yield "Warp svd3", read()
    U, sigma, Vh = torch.linalg.svd(F)
    yield "torch.linalg.svd", (U, sigma, Vh.mT)


def errors(F: Tensor, U: Tensor, sigma: Tensor, V: Tensor) -> dict[str, list[float]]:
    """Median and maximum of each of MEASURES."""
    exact = torch.linalg.svdvals(F.double())
    U, sigma, V = (t.cpu().double() for t in (U, sigma, V))
    largest = exact[:, 0]
    values = (sigma.abs().sort(descending=True).values / exact - 1).abs().amax(1)
    product = ((U * sigma[:, None, :]) @ V.mT - F.double()).abs().amax((1, 2)) / largest
    eye = torch.eye(3, dtype=torch.float64)
    axes = torch.maximum(*((A.mT @ A - eye).abs().amax((1, 2)) for A in (U, V)))
    return {n: [float(e.median()), float(e.max())] for n, e in zip(MEASURES, (values, product, axes), strict=True)}


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = ["# Singular value decompositions", "", common.describe(result["environment"]), ""]
    names = list(result["rows"][0]["errors"])
    header = ("matrices", *(f"{name}, {word}" for name in names for word in ("median", "largest")))
    for measure in MEASURES:
        rows = [(r["matrices"], *(v for n in names for v in r["errors"][n][measure])) for r in result["rows"]]
        lines += [f"Error of the {measure}:", "", common.table(header, rows), ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few matrices, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    rows = [
        {"matrices": name, "errors": {method: errors(F, *parts) for method, parts in decompositions(F)}}
        for name, F in families(200 if arguments.quick else 20_000)
    ]
    result = {"environment": common.environment(), "rows": rows}
    print(text(result))
    common.write(arguments.out, "svd_accuracy", result, text(result))


if __name__ == "__main__":
    main()
