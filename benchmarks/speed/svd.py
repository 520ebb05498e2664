"""Times of singular values and the return map of sand: `python -m benchmarks.speed.svd [--device cuda]`.

float32, 3-D, deformations I + 0.1 G. Compared with torch.linalg.svd and, where it is installed, Warp, on the same
matrices in the same run. Errors: benchmarks/accuracy/svd.py.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm  # noqa: F401  (registers the ops)
from torch_mpm.ops.sand import law_name

from .. import common, regressions
from .timing import Clock

SIZES = {"cpu": 100_000, "cuda": 1_000_000}
MOST_SLOW = {"cpu": 100_000, "cuda": 100_000}
"""Number of matrices for torch.linalg.svd, which takes 0.2 s for a million on a GPU."""


FORMS = (
    ("unilateral", "radial"),
    ("full", "radial"),
    ("hencky", "radial"),
    ("unilateral", "exact"),
    ("full", "exact"),
)


def rotations(count: int) -> Tensor:
    Q = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64))[0]
    return Q * torch.linalg.det(Q).sign()[:, None, None]


def structure_of_arrays(F: Tensor) -> Tensor:
    return F.permute(1, 2, 0).contiguous().permute(2, 0, 1)


def warp_arrays(F: Tensor) -> tuple[Callable[[], object], Callable[[], tuple[Tensor, Tensor, Tensor]]] | None:
    """A call of Warp's svd3 on all matrices (on CPUs in one thread) and a function that returns U, σ, V; or None
    without Warp.
    """
    try:
        import warp as wp
    except ImportError:
        return None
    wp.config.quiet = True
    wp.init()

    @wp.kernel(enable_backward=False)
    def decompose(
        A: wp.array(dtype=wp.mat33),
        U: wp.array(dtype=wp.mat33),
        s: wp.array(dtype=wp.vec3),
        V: wp.array(dtype=wp.mat33),
    ):  # type: ignore[no-untyped-def]
        i = wp.tid()
        u, d, v = wp.svd3(A[i])
        U[i] = u
        s[i] = d
        V[i] = v

    A = wp.from_torch(F, dtype=wp.mat33)
    out = [wp.empty(len(F), dtype=t, device=A.device) for t in (wp.mat33, wp.vec3, wp.mat33)]

    def run() -> None:
        stream = wp.stream_from_torch(torch.cuda.current_stream()) if F.is_cuda else None
        wp.launch(decompose, dim=len(F), inputs=[A, *out], stream=stream, device=A.device)

    def read() -> tuple[Tensor, Tensor, Tensor]:
        U, sigma, V = (wp.to_torch(t) for t in out)
        return U, sigma, V

    return run, read


def times(device: str, count: int, clock: Clock) -> Iterator[dict[str, Any]]:
    """Median milliseconds of every op."""
    F = structure_of_arrays((torch.eye(3) + 0.1 * torch.randn(count, 3, 3)).to(device))
    rows_first = F.contiguous()
    slow = rows_first[: MOST_SLOW[device]]
    mu, lam, alpha = (torch.tensor(v, device=device) for v in (1e5, 1.5e5, 0.33))
    ops = torch.ops.torch_mpm
    grad = torch.randn_like(F)
    runs: list[tuple[str, int, Callable[[], object]]] = [
        ("svd3", count, lambda: ops.svd3(F)),
        ("svd3, matrices row by row", count, lambda: ops.svd3(rows_first)),
        ("polar", count, lambda: ops.polar(F)),
        ("torch.linalg.svd", len(slow), lambda: torch.linalg.svd(slow)),
    ]
    warp = warp_arrays(rows_first)
    if warp is not None:
        runs.append(("Warp svd3", count, warp[0]))
    zero = torch.zeros((), device=F.device)
    grads = (grad, grad, None, None, None)
    for energy, flow in (
        ("unilateral", "radial"),
        ("full", "radial"),
        ("hencky", "radial"),
        ("unilateral", "exact"),
        ("full", "exact"),
    ):
        given = (F, None, [mu, lam, alpha, zero, zero], [], None, law_name(energy, flow, 3), 3, 0)
        name = energy if flow == "radial" else f"{energy}, exact flow"
        runs.append((f"return map with stress, {name}", count, lambda g=given: ops.law_update(*g, 0)))
        runs.append(
            (
                f"its backward, {name}",
                count,
                lambda g=given: ops.law_update_backward(*grads, *g, 5),
            )
        )
    for name, matrices_in, run in runs:
        time = clock.op(run)
        yield {
            "name": name,
            "matrices": matrices_in,
            "ms": time.ms,
            "fastest_ms": time.fastest_ms,
            "ns": time.ms / matrices_in * 1e6,
        }


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = ["# Small matrices and sand", "", common.describe(result["environment"]), ""]
    header = ("op", "matrices", "median ms", "least ms", "ns per matrix")
    rows = [(r["name"], r["matrices"], r["ms"], r["fastest_ms"], r["ns"]) for r in result["times"]]
    return "\n".join([*lines, common.table(header, rows)])


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Milliseconds by op, for `regressions`."""
    for row in result["times"]:
        yield f"{row['name']}, {row['matrices']} matrices", row["fastest_ms"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="a small size, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    device, count = arguments.device, 2000 if arguments.quick else SIZES[arguments.device]
    if device == "cpu":
        common.use_all_cores()
    clock = Clock(device, **({"samples": 3, "budget": 0.1} if arguments.quick else {}))
    with clock, torch.no_grad():
        result: dict[str, Any] = {
            "environment": common.environment(device),
            "times": list(times(device, count, clock)),
        }
    print(text(result))
    name = f"svd_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed)
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
