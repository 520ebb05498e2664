"""float32 gradients of the return map of sand against float64: `python -m benchmarks.accuracy.sand_gradient`.

Random trial states outside the cone with two singular values that differ by a given gap, with random axes: |p| over a
decade below a given size, deviators of 0.3 to 30 |p|, all angles of loading. The gradient of random linear functions of
the new F and of the stress, each on its own, at the float32 F; the reference is the float64 op at the same F. The error
is relative to the norm of the gradient, and to its usual norm: the root mean square over random weights w of the same
norm, |J| |w| / 3 with the Jacobian J of the 9 components. For comparison the change of the float64 gradient by one unit
in the last place of F is given: an error far below is not an accident of the states.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_mpm.ops import quartic_return_map
from torch_mpm.ops.sand import CONE

from .. import common

GAPS = (1e-2, 1e-4, 1e-6, 0.0)
SIZES = (0.2, 1e-2, 1e-3)
RESULTS = ("F", "stress")
ALLOWED = 1e-6
CASES = (
    ("unilateral", "radial"),
    ("full", "radial"),
    ("mixed", "radial"),
    ("hencky", "radial"),
    ("unilateral", "exact"),
    ("full", "exact"),
)
PARAMETERS = (1.0, 1.5, None, 0.25)
"""μ, λ, no friction angle, α."""


def rotations(count: int, generator: torch.Generator) -> Tensor:
    Q, R = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64, generator=generator))
    Q = Q * R.diagonal(dim1=1, dim2=2).sign()[:, None, :]
    Q[:, :, 0] *= torch.linalg.det(Q).sign()[:, None]
    return Q


def deformations(count: int, gap: float, size: float, generator: torch.Generator) -> Tensor:
    """float32 [P, 3, 3] with two singular values that differ by `gap`, before F is rounded."""

    def uniform() -> Tensor:
        return torch.rand(count, 1, generator=generator, dtype=torch.float64)

    mean, radius = -size * 10 ** (uniform() - 1), 10 ** (2 * uniform() - 0.5)
    direction = torch.tensor([1.0, 1.0, -2.0], dtype=torch.float64) / math.sqrt(6)
    h = mean + mean.abs() * radius * torch.where(uniform() < 0.5, direction, -direction)
    h = h / h.abs().amax(1, keepdim=True).clamp_min(1)  # stretches of at most e
    sigma = h.exp()
    sigma[:, 1] = sigma[:, 0] - gap
    return ((rotations(count, generator) * sigma[:, None, :]) @ rotations(count, generator)).float()


def gradient(F: Tensor, weights: Tensor, energy: str, flow: str, result: int) -> tuple[Tensor, Tensor]:
    """float64 [P, 3, 3] of the sum of weights times F (result 0) or stress (1), and whether on the cone [P]."""
    leaf = F.clone().requires_grad_()
    mapped = quartic_return_map(leaf, *PARAMETERS, energy=energy, flow=flow)
    (grad,) = torch.autograd.grad((mapped[result] * weights.to(F)).sum(), leaf)
    return grad.double(), mapped.branch == CONE


def usual_norm(F: Tensor, weights: Tensor, energy: str, flow: str, result: int) -> Tensor:
    """float64 [P]: the root mean square of the gradient's norm over weights of the same norm."""
    squares = torch.zeros(len(F), dtype=torch.float64)
    for unit in torch.eye(9, dtype=torch.float64).view(9, 3, 3):
        squares += gradient(F.double(), unit.expand(F.shape), energy, flow, result)[0].square().sum((1, 2))
    return (squares / 9).sqrt() * weights.double().norm(dim=(1, 2))


def compare(count: int, energy: str, flow: str, gap: float, result: int) -> dict[str, Any]:
    """Median and largest error of one result over all sizes, and the number of states on the cone."""
    generator = torch.Generator().manual_seed(0)
    errors, of_usual, inherent = [], [], []
    for size in SIZES:
        F = deformations(count, gap, size, generator)
        weights = torch.randn(count, 3, 3, generator=generator)
        towards = torch.where(torch.rand(F.shape, generator=generator) < 0.5, -torch.inf, torch.inf)
        neighbour = torch.nextafter(F, towards)
        found, here = gradient(F, weights, energy, flow, result)
        exact, there = gradient(F.double(), weights, energy, flow, result)
        changed, beside = gradient(neighbour.double(), weights, energy, flow, result)
        cone = here & there & beside
        error, norm = (found - exact).norm(dim=(1, 2)), exact.norm(dim=(1, 2))
        errors.append((error / norm)[cone])
        of_usual.append((error / usual_norm(F, weights, energy, flow, result))[cone])
        inherent.append(((changed - exact).norm(dim=(1, 2)) / norm)[cone])
    all_errors, usual, all_changes = (torch.cat(parts) for parts in (errors, of_usual, inherent))
    return {
        "gap": gap,
        "states": len(all_errors),
        "median": float(all_errors.median()),
        "largest": float(all_errors.max()),
        "above": int((all_errors > ALLOWED).sum()),
        "of the usual norm, median": float(usual.median()),
        "of the usual norm, largest": float(usual.max()),
        "one unit of F, median": float(all_changes.median()),
        "one unit of F, largest": float(all_changes.max()),
    }


def at_rest(energy: str, flow: str, result: int) -> float:
    """The largest error at F = I, relative to the weights where the gradient is zero."""
    F = torch.eye(3).repeat(1000, 1, 1)
    weights = torch.randn(1000, 3, 3, generator=torch.Generator().manual_seed(0))
    found, exact = (gradient(a, weights, energy, flow, result)[0] for a in (F, F.double()))
    size = exact.norm(dim=(1, 2))
    return float(((found - exact).norm(dim=(1, 2)) / torch.where(size > 0, size, weights.norm(dim=(1, 2)))).max())


def pair(case: dict[str, Any], prefix: str) -> str:
    return ", ".join(f"{case[prefix + name]:.1e}" for name in ("median", "largest"))


def text(result: dict[str, Any]) -> str:
    states = sum(case["states"] for row in result["rows"] for case in row["gaps"])
    above = sum(case["above"] for row in result["rows"] for case in row["gaps"])
    rows, usual, units = [], [], []
    for row in result["rows"]:
        name = f"{row['energy']}, {row['flow']}, {row['result']}"
        rows.append((name, *(pair(case, "") for case in row["gaps"]), f"{row['at rest']:.1e}"))
        usual.append((name, *(pair(case, "of the usual norm, ") for case in row["gaps"])))
        units.append((name, *(pair(case, "one unit of F, ") for case in row["gaps"])))
    header = ("energy, flow, gradient of", *(f"gap {gap:g}" for gap in GAPS))
    return "\n".join(
        [
            "# float32 gradients of the return map of sand",
            "",
            common.describe(result["environment"]),
            "",
            f"Error against float64 over the norm of the gradient, median and largest. Of {states} states on the cone",
            f"{above} are above {ALLOWED:g}.",
            "",
            common.table((*header, "F = I, largest"), rows),
            "",
            "Over the usual norm of the gradient, median and largest:",
            "",
            common.table(header, usual),
            "",
            "Change of the float64 gradient by one unit in the last place of F, median and largest:",
            "",
            common.table(header, units),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=50_000, help="of each case and size")
    parser.add_argument("--quick", action="store_true", help="few states, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    count = 500 if arguments.quick else arguments.states
    rows = [
        {
            "energy": energy,
            "flow": flow,
            "result": name,
            "at rest": at_rest(energy, flow, k),
            "gaps": [compare(count, energy, flow, gap, k) for gap in GAPS],
        }
        for energy, flow in CASES
        for k, name in enumerate(RESULTS)
    ]
    result: dict[str, Any] = {"environment": common.environment(), "allowed": ALLOWED, "rows": rows}
    print(text(result))
    common.write(arguments.out, "sand_gradient", result, text(result))


if __name__ == "__main__":
    main()
