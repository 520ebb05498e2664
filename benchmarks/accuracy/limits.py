"""Losses of the method, measured on small problems: `python -m benchmarks.accuracy.limits`.

- Transfers: an elastic disc spins freely for 2000 steps; its momentum, angular momentum and energy at the end.
- Restitution: an elastic disc bounces off a wall without gravity; its energy afterwards.
- Friction: an elastic block on an incline of 30°, where tan 30° = 0.577; its speed after a second.
- Singular vectors: the gradient of R = U Vᵀ through `svd3` against that of `polar`, by the gap of two stretches.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common
from .precision import energy

DENSITY, E, NU, GRAVITY = 1000.0, 1e5, 0.3, 9.8
TRANSFERS = (("apic", 0.0), ("pic", 0.0), ("flip", 1.0), ("pic", 0.95), ("apic", 0.95))
"""Names of transfers and shares of FLIP."""


def angular_momentum(step: mpm.Step, state: mpm.State) -> float:
    """Angular momentum about the origin, with the affine velocities where they are transferred (Jiang et al. 2015) [kg
    m²/s].
    """
    x, v = state.x, state.v
    spin = x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]
    if step.transfer == "apic" and state.C is not None:
        spin = spin + (state.C[:, 1, 0] - state.C[:, 0, 1]) / step.grid.inverse_inertia
    return float((state.mass * spin).sum())


def disc(n: int, radius: float) -> tuple[mpm.Grid, mpm.State]:
    """A disc at rest in the middle of the unit square."""
    grid = mpm.Grid(dx=1 / n, lower=(0, 0), upper=(1, 1))
    return grid, mpm.State.at_rest(mpm.seed.sphere((0.5, 0.5), radius, grid, 4), DENSITY, dtype=torch.float64)


def spin(transfer: str, flip: float, stress_form: str, steps: int) -> dict[str, Any]:
    """Remaining momenta and energy of a spinning disc, whose rim moves at 1 m/s."""
    grid, state = disc(16, 0.25)
    arm = (state.x - 0.5) / 0.25
    spinning = torch.stack([-arm[:, 1], arm[:, 0]], 1)
    C = torch.tensor([[0.0, -4.0], [4.0, 0.0]], dtype=torch.float64).expand(len(state), 2, 2)
    state = state.replace(v=spinning, C=C if transfer == "apic" else None)
    step = mpm.Step(grid, mpm.NeoHookean(E=E, nu=NU), transfer=transfer, flip=flip, stress_form=stress_form)
    state = step.prepare(state)
    dt = 0.5 * float(step.stable_dt(state, 1.0))
    momentum = (state.mass @ state.v, angular_momentum(step, state), _total(step, state))
    end = mpm.rollout(step, state, steps, dt)
    step.check(end)
    scale = float((state.mass * state.v.norm(dim=1)).sum())
    return {
        "transfer": transfer + (f", {flip:g} FLIP" if flip else ""),
        "stress form": stress_form,
        "time": steps * dt,
        "momentum": float((end.mass @ end.v - momentum[0]).norm()) / scale,
        "angular momentum": angular_momentum(step, end) / momentum[1],
        "energy": _total(step, end) / momentum[2],
    }


def _total(step: mpm.Step, state: mpm.State) -> float:
    """Kinetic and elastic energy [J], including affine velocities where they are transferred."""
    seen = state if step.transfer == "apic" else state.replace(C=None)
    return energy(step, seen) - GRAVITY * float((state.mass * state.x[:, 1]).sum())


def bounce(n: int) -> dict[str, Any]:
    """Remaining energy after a disc has hit the floor at 1 m/s, a tenth of its speed of sound."""
    grid, state = disc(n, 0.2)
    state = state.replace(
        v=torch.tensor([0.0, -1.0], dtype=torch.float64).expand_as(state.x), x=state.x - state.x.new_tensor([0, 0.2])
    )
    step = mpm.Step(grid, mpm.NeoHookean(E=E, nu=NU), walls="separate")
    state = step.prepare(state)
    first, dt = _total(step, state), 0.5 * float(step.stable_dt(state, 1.0))
    state = mpm.rollout(step, state, math.ceil(0.5 / dt), dt)
    step.check(state)
    velocity = float(state.mass @ state.v[:, 1] / state.mass.sum())
    return {"n": n, "steps": math.ceil(0.5 / dt), "energy": _total(step, state) / first, "velocity": velocity}


def incline(n: int, modulus: float, frictions: Sequence[float], duration: float = 1.0) -> list[dict[str, Any]]:
    """Speed of blocks on a plane of 30° after some time [m/s], and that of a rigid block.

    They settle first, damped by PIC, under the part of gravity that is normal to the plane.
    """
    grid = mpm.Grid(dx=1 / n, lower=(0, 0), upper=(4, 0.5), scenes=len(frictions))
    points = mpm.seed.box((0.2, 0.125), (0.6, 0.325), grid, per_cell=4)
    block = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    state = mpm.State.concatenate([block] * len(frictions), scene=True)
    floor = mpm.Plane((0.0, 0.125), (0.0, 1.0), friction=torch.tensor(frictions, dtype=torch.float64))
    down = (GRAVITY * math.sin(math.radians(30)), -GRAVITY * math.cos(math.radians(30)))
    law = mpm.NeoHookean(E=modulus, nu=NU)
    settle = mpm.Step(grid, law, gravity=(0.0, down[1]), boundaries=[floor], transfer="pic")
    step = mpm.Step(grid, law, gravity=down, boundaries=[floor])
    state = settle.prepare(state)
    count = math.ceil(duration / (0.4 * float(step.stable_dt(state, 1.0).min())))
    state = mpm.rollout(settle, state, count // 2, duration / count)
    state = mpm.rollout(step, state.replace(v=torch.zeros_like(state.v)), count, duration / count)
    step.check(state)
    speeds = state.v[:, 0].view(len(frictions), -1).mean(1).tolist()
    rigid = [max(0.0, down[0] + mu * down[1]) * duration for mu in frictions]
    return [
        {"n": n, "E": modulus, "friction": mu, "speed": speed, "rigid": exact}
        for mu, speed, exact in zip(frictions, speeds, rigid, strict=True)
    ]


def vectors(gap: float, dtype: torch.dtype, count: int = 1000) -> dict[str, Any]:
    """Median relative error of the gradient of a random linear function of R = U Vᵀ through `svd3`."""
    generator = torch.Generator().manual_seed(0)

    def rotations() -> Tensor:
        return mpm.polar(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).R

    stretches = torch.tensor([1.2 + gap, 1.2, 0.8], dtype=torch.float64)
    F = ((rotations() * stretches) @ rotations().mT).to(dtype).requires_grad_()
    weight = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)

    def gradient(R: Tensor, F: Tensor) -> Tensor:
        return torch.autograd.grad((R * weight.to(R.dtype)).sum(), F)[0].double()

    U, _, V = mpm.svd3(F)
    through, exact = gradient(U @ V.mT, F), F.detach().double().requires_grad_()
    reference = gradient(mpm.polar(exact).R, exact)
    error = (through - reference).norm(dim=(1, 2)) / reference.norm(dim=(1, 2))
    finite = error[error.isfinite()]
    return {
        "gap": gap,
        "dtype": str(dtype).removeprefix("torch."),
        "finite": len(finite) / count,
        "error": float(finite.median()) if len(finite) else None,
        "polar": float(
            ((gradient(mpm.polar(F).R, F) - reference).norm(dim=(1, 2)) / reference.norm(dim=(1, 2))).median()
        ),
    }


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Markdown tables by subject."""
    spins = [list(row.values()) for row in result["spins"]]
    header = ("transfer", "stress form", "time [s]", "change of momentum", "angular momentum", "energy")
    bounces = [list(row.values()) for row in result["bounces"]]
    inclines = [list(row.values()) for row in result["inclines"]]
    gaps = [list(row.values()) for row in result["vectors"]]
    return {
        "Transfers": common.table(header, spins),
        "Restitution": common.table(("n", "steps", "energy left", "velocity afterwards [m/s]"), bounces),
        "Friction": common.table(("n", "E [Pa]", "μ", "speed [m/s]", "rigid block [m/s]"), inclines),
        "Singular vectors": common.table(("gap", "dtype", "finite", "error through svd3", "error of polar"), gaps),
    }


def text(result: dict[str, Any]) -> str:
    lines = ["# Losses of the method", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 1)[1].strip()]
    lines += [f"\n## {title}\n\n{table}" for title, table in tables(result).items()]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few steps, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quick, begin = arguments.quick, time.perf_counter()
    result: dict[str, Any] = {"environment": common.environment()}
    with torch.no_grad():
        result["spins"] = [
            spin(transfer, flip, form, 50 if quick else 2000)
            for transfer, flip in TRANSFERS
            for form in ("mls", "gradient")
        ]
        result["bounces"] = [bounce(n) for n in ((16,) if quick else (16, 32, 64))]
        frictions = (0.3, 0.5, 0.55, 0.6, 0.65, 0.7, 1.0)
        blocks = ((8, 1e6),) if quick else ((8, 1e5), (8, 1e6), (16, 1e5), (16, 1e6))
        result["inclines"] = [row for block in blocks for row in incline(*block, frictions)]
    gaps = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 0.0)
    result["vectors"] = [vectors(gap, dtype) for dtype in (torch.float32, torch.float64) for gap in gaps]
    result["seconds"] = time.perf_counter() - begin
    print(*tables(result).values(), sep="\n\n")
    common.write(arguments.out, "limits", result, text(result))


if __name__ == "__main__":
    main()
