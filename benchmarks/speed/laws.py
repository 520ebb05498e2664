"""Times of the laws: `python -m benchmarks.speed.laws [--device cuda]`.

Cases: float32, 3-D, structure of arrays; about half of the states flow. Timed are the return map with stress and
history, the same with the dissipated energy, and its backward pass with the gradients of F, parameters and history.
"of memory": lower bound over the time of the update; the bound is the time in which the faster of a copy and a read
moves the bytes that the update must read and write.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

import torch_mpm as mpm  # noqa: F401  (registers the ops)
from torch_mpm.ops import LAWS

from .. import common, regressions
from .svd import structure_of_arrays
from .timing import Clock, memory_ms

SIZES = {"cpu": 100_000, "cuda": 1_000_000}
TIMED = ("update", "with details", "backward", "stiffness")
PARAMETERS: dict[str, tuple[float, ...]] = {
    "hencky": (4e4, 6e4),
    "fixed_corotated": (4e4, 6e4),
    "von_mises": (4e4, 6e4, 6e3, 1e3),
    "herschel_bulkley": (4e4, 6e4, 2.5e3, 20.0, 0.5, 1e-4),
    "snow": (4e4, 6e4, 0.1, 0.1, 10.0),
    "cam_clay": (4e4, 6e4, 1.2, 1e4, 10.0, 0.3),
}


def times(device: str, count: int, clock: Clock) -> Iterator[dict[str, Any]]:
    """One row per law: milliseconds of update and backward, the share of particles that flow."""
    noise = torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0))
    F = structure_of_arrays((torch.eye(3) + 0.05 * noise).to(device))
    ops, grad = torch.ops.torch_mpm, torch.randn_like(F)
    for law, values in PARAMETERS.items():
        parameters = [torch.tensor(v, device=device) for v in values]
        history = [torch.zeros(count, device=device) for _ in LAWS[law].history]
        given, plastic = (parameters, history, None, law, 3), LAWS[law].plastic
        grad_history = torch.ones(len(history), count, device=device).T
        adjoint = (grad if plastic else None, grad, grad_history if history else None, None, None)
        runs: tuple[tuple[str, Callable[[], object]], ...] = (
            ("update", lambda given=given: ops.law_update(F, None, *given, 0, 0)),
            ("with details", lambda given=given: ops.law_update(F, None, *given, 0, 5)),
            ("backward", lambda given=given, a=adjoint: ops.law_update_backward(*a, F, None, *given, 0, 13)),
            ("stiffness", lambda given=given: ops.law_stiffness(F, *given)),
        )
        row: dict[str, Any] = {
            "law": law,
            "flowing": float((ops.law_update(F, None, *given, 0, 4)[5] == 1).float().mean()),
        }
        for name, run in runs:
            row[name] = clock.op(run).ms
        moved = 4 * count * (18 + 9 * plastic + 2 * len(history))
        row["of memory"] = memory_ms(clock, moved) / row["update"]
        row["backward / update"] = row["backward"] / row["update"]
        yield row


def text(result: dict[str, Any]) -> str:
    columns = ("law", "flowing", *TIMED, "of memory", "backward / update")
    header = [f"{c} [ms]" if c in TIMED else c for c in columns]
    rows = [[f"{row[c]:.0%}" if c == "of memory" else row[c] for c in columns] for row in result["laws"]]
    table = common.table(header, rows)
    title = f"# Laws in principal strains, {result['particles']} particles"
    return "\n\n".join((title, common.describe(result["environment"]), table))


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Milliseconds by law and op, for `regressions`."""
    for row in result["laws"]:
        for op in TIMED:
            yield f"{row['law']}, {op}, {result['particles']} particles", row[op]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="a small size, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    device, count = arguments.device, 2000 if arguments.quick else SIZES[arguments.device]
    if device == "cpu":
        common.use_all_cores()
    clock = Clock(device, **({"samples": 3, "budget": 0.1} if arguments.quick else {}))
    with clock, torch.no_grad():
        result: dict[str, Any] = {
            "environment": common.environment(device),
            "particles": count,
            "laws": list(times(device, count, clock)),
        }
    print(text(result))
    name = f"laws_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed)
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
