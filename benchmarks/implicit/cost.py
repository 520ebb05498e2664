"""Costs of the parts of an implicit step.

A product of the Hessian, an iteration of conjugate gradients and the node blocks, beside a gather and a scatter of D
channels with their moments; whole steps of a cube of rubber that lands on its face, many times as long as explicit ones
may be; those of a cube of rubber that lands on water, with the water in the solve and explicit; and a batch of small
scenes beside the same scenes one by one.
"""

from __future__ import annotations

import itertools
import time
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import ops
from torch_mpm.implicit import Implicit

from ..speed.timing import Clock


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


def steps(device: str, quick: bool) -> list[dict[str, Any]]:
    """A cube of 8 particles per cell that moves at 1 m/s against a sticky floor."""
    count = 2_000 if quick else 30_000 if device == "cpu" else 5_200_000
    cells = round((count / 8) ** (1 / 3))
    grid = mpm.Grid(1.0 / cells, (-0.5, 0.0, -0.5), (1.5, 1.5, 1.5))
    points = mpm.seed.box((0,) * 3, (1,) * 3, grid, per_cell=8)
    start = mpm.State.at_rest(points, velocity=(0.0, -1.0, 0.0), device=device)
    law = mpm.NeoHookean(E=1e6, nu=0.3)
    step = mpm.Step(grid, law, (0, -9.8, 0), "sticky", integrator="implicit")
    limit, rows = float(step.stable_dt(start, cfl=1.0)[0]), []
    for times in (3, 10, 30):
        seconds = seconds_of(step, start, times * limit)
        report = step.solve_report
        assert report is not None and bool(report.converged.all())
        shown = {"particles": len(start), "dt [ms]": 1e3 * times * limit, "over the explicit limit": times}
        work = {"Newton": int(report.iterations), "CG": int(report.cg_iterations)}
        rows.append({**shown, "step [s]": seconds, **work})
    return rows


def beside_a_fluid(device: str, quick: bool) -> list[dict[str, Any]]:
    """A cube of rubber that falls at 1 m/s on water of ten times its mass, in steps of half the limit of the water."""
    cells = 16 if quick else 64 if device == "cpu" else 192
    dx, side, level = 1.0 / cells, cells // 5 + 1, cells // 10
    grid = mpm.Grid(dx, (0.0,) * 3, (1.0, 0.75, 1.0))
    at, depth = dx * ((cells - side) // 2), dx * level
    water = mpm.State.at_rest(mpm.seed.box((0.0,) * 3, (1.0, depth, 1.0), grid, per_cell=8), device=device)
    ends = (at, depth, at), (at + dx * side, depth + dx * side, at + dx * side)
    rubber = mpm.State.at_rest(mpm.seed.box(*ends, grid, per_cell=8), velocity=(0.0, -1.0, 0.0), device=device)
    bodies = [s.replace(material=torch.full((len(s),), k).int().to(device)) for k, s in enumerate((rubber, water))]
    state, rows = mpm.State.concatenate(bodies), []
    for E in (1e7, 1e8, 1e9):
        law = mpm.Mixture([mpm.NeoHookean(E=E, nu=0.3), mpm.WeaklyCompressible(1e5)])
        steps = [
            mpm.Step(grid, law, (0, -9.8, 0), "slip", integrator=integrator)
            for integrator in ("implicit", Implicit(explicit=[1]), "explicit")
        ]
        dt, limit = (float(step.stable_dt(state)[0]) for step in steps[1:])
        landed = mpm.rollout(steps[1], state, 3, dt)
        whole, mixed, explicit = (seconds_of(s, landed, d) for s, d in zip(steps, (dt, dt, limit), strict=True))
        assert all(s.solve_report is None or bool(s.solve_report.converged.all()) for s in steps)
        counts = {"water": len(water), "rubber": len(rubber), "E [Pa]": E, "dt [ms]": 1e3 * dt}
        rows.append({**counts, "all in the solve [s]": whole, "water explicit [s]": mixed, "ratio": whole / mixed,
                     "explicit steps for the same time [s]": explicit * dt / limit})  # fmt: skip
    return rows


def seconds_of(step: mpm.Step, state: mpm.State, dt: float = 5e-3) -> float:
    """Wall clock of a step after a first one."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        step(state, dt)
        if state.x.is_cuda:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return times[1]


def batches(device: str, quick: bool) -> list[dict[str, Any]]:
    """Scenes of 128 particles with different stiffness; some of them one by one represent all."""
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
