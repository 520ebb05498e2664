"""Random states through the return map of sand and its gradient: `python -m benchmarks.stability.sand [--millions 1]`.

Deformations next to the identity, of any size and shape from 1e-10 to 1e10, with stretches up to e²⁰, and nearly
spherical; friction angles 0° to 89°, ν from 0 to 0.4999, μ from 1 to 1e8 Pa. Counts results that are not finite, roots
that were not found, and states of clearly positive determinant that were reported as invalid; the exit status is zero
if all counts are. Roots that were not found on steep cones of the unilateral energy (3-D, φ above asin(3/5) = 36.87°),
where some directions have none, are counted separately and are not failures: the op reports them.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm  # noqa: F401  (registers the ops)
from torch_mpm.ops.sand import friction_alpha, law_name

from .. import common

BATCH = 200_000
FORMS = (
    ("full", "radial", "zero"),
    ("unilateral", "radial", "zero"),
    ("unilateral", "radial", "keep"),
    ("hencky", "radial", "zero"),
    ("mixed", "radial", "zero"),
    ("full", "exact", "zero"),
    ("unilateral", "exact", "zero"),
)
DTYPES = (torch.float32, torch.float64)
COUNTS = ("not finite", "not converged", "wrongly invalid", "gradient not finite")
STEEP = "not converged, steep cone"
STEEP_ANGLE = math.asin(3 / 5)
"""Friction angle above which some directions have no root with the unilateral energy."""


def deformations(kind: int, dim: int, generator: torch.Generator) -> Tensor:
    """[P, D, D], structure of arrays."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    noise, eye = torch.randn(dim, dim, BATCH, generator=generator), torch.eye(dim)[:, :, None]
    if kind == 0:
        F = eye + 10 ** (-8 * uniform(1, 1, BATCH)) * noise
    elif kind == 1:
        F = 10 ** (-10 + 20 * uniform(1, 1, BATCH)) * noise
    elif kind == 2:
        F = eye * (10 ** (-3 + 4 * uniform(1, BATCH)) * noise[0]).clamp(-20, 20).exp()
    else:
        F = eye * (1 + 0.3 * noise[:1, :1]) + 10 ** (-6 * uniform(1, 1, BATCH)) * noise
    return F.permute(2, 0, 1)


def count_failures(dim: int, dtype: torch.dtype, energy: str, flow: str, apex: str, batches: int) -> list[int]:
    """The COUNTS and STEEP over `batches` times BATCH states."""
    generator = torch.Generator().manual_seed(0)
    counts = torch.zeros(len(COUNTS) + 1, dtype=torch.int64)
    for batch in range(batches):
        F = deformations(batch % 4, dim, generator).to(dtype)
        random = torch.rand(3, BATCH, generator=generator, dtype=torch.float64)
        mu, nu, angle = 10 ** (8 * random[0]), 0.4999 * random[1], torch.deg2rad(89 * random[2])
        alpha = friction_alpha(angle, dim)
        zero = torch.zeros((), dtype=dtype)
        parameters = [mu.to(dtype), (mu * 2 * nu / (1 - 2 * nu)).to(dtype), alpha.to(dtype), zero, zero]
        rest = (parameters, [], None, law_name(energy, flow, dim), dim, int(apex == "keep"))
        *values, _, dissipated, multiplier, code = torch.ops.torch_mpm.law_update(F, None, *rest, 7)
        finite = multiplier.isfinite() & dissipated.isfinite()
        for value in values:
            finite &= value.isfinite().all(2).all(1)
        size = F.double().abs().amax((1, 2))
        regular = torch.linalg.det(F.double() / size[:, None, None]) > 1e-12
        ones = torch.ones_like(F)
        gradient = torch.ops.torch_mpm.law_update_backward(ones, *(None,) * 4, F, None, *rest, 5)[0]
        smooth = gradient.isfinite().all(2).all(1)
        steep = (angle > STEEP_ANGLE) & (energy == "unilateral" and dim == 3)
        failed = (~finite, (code > 3) & ~steep, (code == 3) & regular, ~smooth, (code > 3) & steep)
        counts += torch.tensor([int(f.sum()) for f in failed])
    return counts.tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--millions", type=float, default=100, help="states, over all cases")
    parser.add_argument("--quick", action="store_true", help="four batches of each case")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    cases = [c for c in itertools.product((2, 3), DTYPES, FORMS) if c[0] == 3 or c[2][1] == "radial"]
    batches = 4 if arguments.quick else max(4, round(arguments.millions * 1e6 / BATCH / len(cases)))
    common.use_all_cores()
    rows: list[dict[str, Any]] = []
    for dim, dtype, (energy, flow, apex) in cases:
        begin = time.perf_counter()
        counts = count_failures(dim, dtype, energy, flow, apex, batches)
        name = f"{dim}-D, {energy}, {flow} flow, apex {apex}, {str(dtype).split('.')[1]}"
        rows.append({"name": name, "states": batches * BATCH, **dict(zip((*COUNTS, STEEP), counts, strict=True))})
        print(f"{rows[-1]} in {time.perf_counter() - begin:.0f} s", flush=True)
    result = {"environment": common.environment(), "rows": rows}
    header = ("case", "states", *COUNTS, STEEP)
    table = common.table(header, [[row[key] for key in ("name", *header[1:])] for row in rows])
    common.write(
        arguments.out,
        "sand",
        result,
        "\n\n".join(("# Random states of sand", common.describe(result["environment"]), table)),
    )
    sys.exit(any(row[key] for row in rows for key in COUNTS))


if __name__ == "__main__":
    main()
