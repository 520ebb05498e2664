"""Implicit steps: where they converge, what they cost, and how wrong they are: `python -m benchmarks.implicit`.

Stability: a bar of 8 × 4 cells in 2-D, float64, first compressed to 80%, stretched to five times its length, or
spinning by a radian per step; three steps of dt times the explicit limit of the bar at rest. Newton's and all conjugate
gradients iterations of the worst step. "no" did not converge in 30 Newton iterations; every result was finite.

Work and precision: the same bar vibrates in its first mode for a period (E = 1e5 Pa, FLIP, which does not damp): RMS
error of positions over the amplitude, and wall clock, beside explicit steps. Then a bar of E = 1e8 Pa turns by a
radian: there the elastic waves need not be resolved, and the error is that of the motion as a whole.

Cohesion: a block of sand is pulled apart at 2 /s in one step; share of the rate that is left, 1 without cohesion.

Cost: a product of the Hessian, an iteration of conjugate gradients and the node blocks, beside a gather and a scatter
of D channels with their moments; and a batch of small scenes beside the same scenes one by one.
"""

from __future__ import annotations

import argparse
import itertools
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import ops
from torch_mpm.implicit import Implicit

from . import common
from .speed.timing import Clock

MODULI, RATIOS = (1e3, 1e6, 1e10), (0.0, 0.3, 0.499)
MULTIPLES = (1.0, 10.0, 100.0, 1e4)
STARTS = ("compressed", "stretched", "spinning")


def bar(E: float, nu: float = 0.3, dx: float = 0.125) -> tuple[mpm.Grid, mpm.State, mpm.NeoHookean, float]:
    """8 × 4 cells in the middle of a box, and its explicit limit [s]."""
    grid = mpm.Grid(dx, (-4.0, -4.0), (5.0, 5.0))
    points = mpm.seed.box((0.0, 0.25), (1.0, 0.75), grid, per_cell=4)
    state = mpm.State.at_rest(points, density=1000.0, dtype=torch.float64)
    law = mpm.NeoHookean(E=E, nu=nu)
    return grid, state, law, float(mpm.Step(grid, law).stable_dt(state, cfl=1.0)[0])


def turning(state: mpm.State, rate: float) -> mpm.State:
    C = torch.zeros(len(state), 2, 2, dtype=torch.float64)
    C[:, 0, 1], C[:, 1, 0] = -rate, rate
    r = state.x - state.x.mean(0)
    return state.replace(v=(C @ r[:, :, None])[:, :, 0], C=C)


def started(state: mpm.State, start: str, dt: float) -> mpm.State:
    if start == "spinning":
        return turning(state, 1.0 / dt)
    share = {"compressed": 0.8, "stretched": 5.0}[start]
    F = torch.eye(2, dtype=torch.float64).repeat(len(state), 1, 1)
    F[:, 0, 0] = share
    x = state.x.clone()
    x[:, 0] *= share
    return state.replace(x=x, F=F)


def stability(quick: bool) -> list[dict[str, Any]]:
    rows = []
    choices = itertools.product(MODULI[1:2] if quick else MODULI, RATIOS[1:2] if quick else RATIOS, STARTS)
    for E, nu, start in choices:
        row: dict[str, Any] = {"E": E, "nu": nu, "start": start}
        for multiple in MULTIPLES[1:3] if quick else MULTIPLES:
            grid, state, law, limit = bar(E, nu)
            step = mpm.Step(grid, law, integrator="implicit")
            state = started(state, start, multiple * limit)
            worst, converged = (0, 0), True
            for _ in range(3):
                state = step(state, multiple * limit)
                report = step.solve_report
                assert report is not None and bool(state.x.isfinite().all() & state.v.isfinite().all())
                converged = converged and bool(report.converged.all())
                worst = max(worst, (int(report.iterations[0]), int(report.cg_iterations[0])))
            row[f"{multiple:g}"] = f"{worst[0]}, {worst[1]}" if converged else "no"
        rows.append(row)
    return rows


def timed(step: mpm.Step, state: mpm.State, n: int, dt: float) -> tuple[mpm.State, float]:
    step(state, dt)
    start = time.perf_counter()
    end = mpm.rollout(step, state, n, dt)
    return end, time.perf_counter() - start


def work(quick: bool) -> list[dict[str, Any]]:
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


def cohesion() -> list[dict[str, Any]]:
    rows = []
    for E, dt in itertools.product((1e6, 1e7), (1e-3, 1e-2, 5e-2)):
        grid = mpm.Grid(0.125, (0, 0), (2, 1.5))
        points = mpm.seed.box((0.5, 0.5), (1.0, 0.75), grid, per_cell=4)
        state = mpm.State.at_rest(points, density=1600.0, dtype=torch.float64)
        C = torch.zeros(len(state), 2, 2, dtype=torch.float64)
        C[:, 0, 0] = 2.0
        r = state.x - state.x.mean(0)
        state = state.replace(v=(C @ r[:, :, None])[:, :, 0], C=C)
        row: dict[str, Any] = {"E": E, "dt [s]": dt, "strain": 2 * dt}
        for energy in ("full", "unilateral"):
            law = mpm.QuarticSand(E=E, nu=0.3, friction_angle=0.6, energy=energy)
            after = mpm.Step(grid, law, integrator=Implicit(1e-8))(state, dt)
            assert after.C is not None
            row[energy] = float(after.C[:, 0, 0].mean()) / 2
        rows.append(row)
    return rows


def cost(device: str, quick: bool) -> list[dict[str, Any]]:
    counts = (20_000,) if quick else (262_144,) if device == "cpu" else (1_000_000, 8_000_000)
    dtypes = (torch.float32, torch.float64) if device == "cpu" else (torch.float32,)
    return [cost_of(device, *choice) for choice in itertools.product(counts, dtypes)]


def cost_of(device: str, count: int, dtype: torch.dtype) -> dict[str, Any]:
    """A cube of compressed material on the device."""
    cells = round((count / 8) ** (1 / 3))
    grid = mpm.Grid(1.0 / cells, (-0.1,) * 3, (1.1,) * 3)
    state = mpm.State.at_rest(mpm.seed.box((0,) * 3, (1,) * 3, grid, per_cell=8), dtype=dtype, device=device)
    x, P, blocks = state.x, len(state), grid.activate(state.x)
    F = torch.empty_strided((P, 3, 3), (1, 3 * P, P), dtype=dtype, device=device)
    F.copy_(0.95 * torch.eye(3, dtype=dtype, device=device))
    one, weight = torch.ones((), dtype=dtype, device=device), 1e-6 * state.volume
    mass = mpm.p2g(blocks, x, state.mass, state.v)[:, 0].contiguous()
    v = torch.randn(blocks.node_count, 3, dtype=dtype, device=device)
    inverse = torch.diag_embed(torch.where(mass > 0, 1 / mass, 0)[:, None].expand(-1, 3)).contiguous()
    stress, nothing = F.clone(), (0 * one).expand(P, 3)
    relative, scale = torch.zeros(1, dtype=dtype, device=device), grid.inverse_inertia

    def tangents() -> Tensor:
        return ops.law_tangent("neo_hookean", F, F, weight, [one * 1e6, one * 2e6])

    tangent = tangents()

    def solve(n: int) -> Any:
        return ops.implicit_cg(blocks, x, v * mass[:, None], mass, inverse, tangent, relative, n)

    with Clock(device) as clock, torch.no_grad():
        gather = clock.op(lambda: ops.gather(blocks, x, v, True, False, scale)).ms
        scatter = clock.op(lambda: ops.scatter(blocks, x, nothing, stress, None, scale)).ms
        product = clock.op(lambda: ops.implicit_apply(blocks, x, v, tangent)).ms
        node_blocks = clock.op(lambda: ops.implicit_node_blocks(blocks, x, tangent)).ms
        law = clock.op(tangents).ms
        iteration = (clock.steps(lambda: solve(24), 1).ms - clock.steps(lambda: solve(8), 1).ms) / 16
    unit = gather + scatter
    return {"particles": P, "dtype": str(dtype)[6:], "gather + scatter [ms]": unit, "product": product / unit,
            "CG iteration": iteration / unit, "node blocks": node_blocks / unit, "tangents": law / unit}  # fmt: skip


def seconds_of(step: mpm.Step, state: mpm.State) -> float:
    """Wall clock of a step after a first one."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        step(state, 5e-3)
        if state.x.is_cuda:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return times[1]


def batches(device: str, quick: bool) -> list[dict[str, Any]]:
    """Scenes of 128 particles, each with a stiffness of its own; some of them one by one stand for all."""
    scenes, some = (64, 4) if quick else (1024, 16)

    def scene(E: Tensor, count: int) -> tuple[mpm.Step, mpm.State]:
        grid = mpm.Grid(0.125, (0, 0), (2, 1.5), scenes=count)
        points = mpm.seed.box((0.5, 0.0), (1.5, 0.5), grid, per_cell=4)
        one = mpm.State.at_rest(points, density=1000.0, device=device)
        each = [one.replace(scene=torch.full((len(one),), b, dtype=torch.int32, device=device)) for b in range(count)]
        state = mpm.State.concatenate(each) if count > 1 else one
        return mpm.Step(grid, mpm.NeoHookean(E=E, nu=0.3), (0, -9.8), "sticky", integrator="implicit"), state

    E = torch.logspace(4, 7, scenes, device=device)
    together = seconds_of(*scene(E, scenes))
    alone = sum(seconds_of(*scene(E[b], 1)) for b in range(0, scenes, scenes // some)) / some * scenes
    return [{"scenes": scenes, "together [s]": together, "one by one [s]": alone, "ratio": alone / together}]


def section(title: str, rows: list[dict[str, Any]]) -> str:
    return f"## {title}\n\n" + common.table(list(rows[0]), [list(row.values()) for row in rows])


def text(result: dict[str, Any]) -> str:
    lines = ["# Implicit steps", common.describe(result["environment"]), (__doc__ or "").split("\n\n", 1)[1].strip()]
    titles = {"stability": "Stability", "work": "Work and precision", "cohesion": "Cohesion of sand",
              "cost": "Cost, in units of a gather and a scatter", "batches": "Batches"}  # fmt: skip
    return "\n\n".join([*lines, *(section(title, result[key]) for key, title in titles.items() if key in result)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few and small cases, to see that it works")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    quick, device = arguments.quick, arguments.device
    result: dict[str, Any] = {"environment": common.environment(device)}
    if device == "cpu":
        result |= {"stability": stability(quick), "work": work(quick), "cohesion": cohesion()}
    result |= {"cost": cost(device, quick), "batches": batches(device, quick)}
    print(text(result))
    name = "implicit" if quick else f"implicit_{common.slug(common.device_name(device))}"
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
