"""Work and precision where elastic waves matter, and where a stiff body only turns.

A bar vibrates in its first mode for a period (E = 1e5 Pa, FLIP, which does not damp): RMS error of positions over the
amplitude, and processor time on one thread, beside explicit steps. Then a bar of E = 1e8 Pa turns by a radian: there
the elastic waves need not be resolved, and the error is that of the motion as a whole.
"""

from __future__ import annotations

import itertools
import time
from typing import Any

import torch

import torch_mpm as mpm

from ..common import one_thread
from .stability import bar, turning


def timed(step: mpm.Step, state: mpm.State, n: int, dt: float) -> tuple[mpm.State, float]:
    step(state, dt)
    start = time.process_time()
    end = mpm.rollout(step, state, n, dt)
    return end, time.process_time() - start


@one_thread()
def vibration(quick: bool) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for motion in ("vibrating", "turning"):
        grid, state, law, limit = bar(1e5 if motion == "vibrating" else 1e8)
        if motion == "vibrating":
            speed = 0.2 * torch.sin(torch.pi * (state.x[:, 0] - 0.5))
            state = state.replace(v=torch.stack([speed, 0 * speed], 1))
            duration, amplitude = 0.2, 0.2 * 0.1 / torch.pi
            exact = mpm.rollout(mpm.Step(grid, law, transfer="flip"), state, 4000, duration / 4000).x
            transfer = "flip"
        else:
            duration, amplitude, transfer = 0.5, 0.5, "apic"
            state = turning(state, 2.0)
            r = state.x - state.x.mean(0)
            c, s = torch.tensor(1.0).cos(), torch.tensor(1.0).sin()
            exact = state.x.mean(0) + torch.stack([c * r[:, 0] - s * r[:, 1], s * r[:, 0] + c * r[:, 1]], 1)
        for kind, multiple in itertools.chain(
            (("explicit", m) for m in (0.5, 0.25)), (("implicit", m) for m in (0.5, 2.0, 8.0, 32.0, 128.0, 512.0))
        ):
            n = max(1, round(duration / (multiple * limit)))
            if (quick and n > 40) or (motion == "vibrating" and multiple > 8) or (kind == "implicit" and n > 400):
                continue
            step = mpm.Step(grid, law, transfer=transfer, integrator=kind)
            end, seconds = timed(step, state, n, duration / n)
            error = float((end.x - exact).norm() / len(end) ** 0.5) / amplitude
            rows.append({"motion": motion, "integrator": kind, "dt / limit": multiple, "steps": n, "error": error,
                         "time [s]": seconds})  # fmt: skip
    return rows
