"""Times of steps with heat, laws that read the temperature, hardening sand, and time steps that follow the limit.

    python -m benchmarks.speed.thermal                    # CPU, all cores
    python -m benchmarks.speed.thermal --device cuda
    python -m benchmarks.speed.thermal --out DIRECTORY

The cube of `benchmarks/speed/work.py`, 3-D, float32, one call of `torch_mpm.rollout`; each row beside another of the
same run. Heat has a diffusion number of `work.DIFFUSION`. `until a time` is `torch_mpm.rollout_to` beside the same
substeps of fixed length (see `UNTIL_A_TIME`). `forward and backward` is a loss and its gradients beside the same
substeps without gradients. Warp takes substeps with heat of the same cube (`heat_peer_warp.py`), on CPUs by one thread,
where it is installed (`pip install torch-mpm[bench]`). The sizes of the libraries are those of their files. On CUDA
each kernel of a substep with heat stands beside the limits of the memory and of the arithmetic (`heat_kernels.py`).
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import torch

import torch_mpm as mpm
from torch_mpm import _library
from torch_mpm.rollouts.until_time import SEGMENT

from .. import common, regressions
from . import heat_kernels, memory, peers, rollouts, work
from .step import LARGE, STEPS, Setup, difference, run_peer, setup
from .timing import Clock, copy_ms

SIDES = {"cpu": (22, 64), "cuda": (22, 46, 100, 200)}
TIMED_SIDES = {"cpu": (22, 40), "cuda": (40, 80, 200)}
"""Of `until a time`."""
KERNEL_SIDES = {"cpu": (), "cuda": (100, 200)}
"""Of the kernels of a substep with heat."""
BATCHES = {"cpu": ((64, 512),), "cuda": ((256, 2197), (1024, 2197))}
GRADIENT_SIDES = {"cpu": (22,), "cuda": (46,)}
GRADIENT_STEPS, GRADIENT_MEMORY = {"cpu": 100, "cuda": 1000}, 1.5e9
"""Substeps of a loss, and the limit of its stored states [bytes]."""
DIFFUSION = 1e-4
"""κ dt / (ρ c dx²) of heat."""
MOST_SUBSTEPS = 4096
"""Of a call `until a time`."""
UNTIL_A_TIME = (
    f"`until a time` chooses dt on the device before every {SEGMENT} substeps, which are one call of the fused op.\n"
    "It stands beside substeps of fixed dt: `times` is the ratio to one call of all of them by the fastest schedule, "
    "`of its schedule` to one call by the schedule of `until a time`, and `of its calls` to calls of that schedule of "
    f"{SEGMENT} substeps each.\n"
    "The latter two differ by the cost of calls: each has its own activation, and a schedule that computes G2P and the "
    "next P2G in one pass computes the first P2G and the last G2P of a call apart, as the next dt follows from the "
    "particles between them.\n"
    "The rest is the cost of the limit of the particles and of the choice."
)
"""Meaning of the rows `until a time`."""
EXPANSION, LATENT_HEAT = 1e-4, 2e4
"""[1/K], [J/kg]."""
SOFTENING = ((0.0, 5.0, 10.0), (1.2e5, 1e5, 4e4))
"""Temperatures [K] and E [Pa] of a law that softens."""
NU = 0.25


def heated(
    s: Setup,
    law: mpm.Material | None = None,
    melts: bool = False,
    diffusion: float = work.DIFFUSION,
    **options: Any,
) -> Setup:
    """A cube with the heat of `work.py`, and optionally another law."""
    grid = s.step.grid
    melting = {"melting_point": 5.0, "latent_heat": LATENT_HEAT} if melts else {}
    heat = mpm.Heat(grid, work.conductivity(grid.dx, diffusion), work.SPECIFIC_HEAT, **melting, **options)
    step = rollouts.changed(s, heat=heat, law=law or s.step.law)
    x = s.state.x.cpu().numpy()
    theta, gradient = (torch.from_numpy(f(x)).to(s.state.x) for f in (work.temperature, work.temperature_gradient))
    extra = {**s.state.extra, "temperature_gradient": gradient}
    return Setup(step.prepare(s.state.replace(temperature=theta, extra=extra, F=None, J=None)), step)


def alone(s: Setup) -> Setup:
    """The heat of a cube at rest, without its motion."""
    cube = heated(s)
    return dataclasses.replace(cube, step=cube.step.heat)


def softening() -> mpm.Material:
    return mpm.ThermalExpansion(mpm.NeoHookean(E=mpm.Table(*SOFTENING), nu=NU), EXPANSION)


def melting() -> mpm.Material:
    return mpm.Melting(mpm.NeoHookean(mu=work.MU, lam=work.LAM), mpm.WeaklyCompressible(work.LAM, viscosity=1.0))


def wax() -> mpm.Material:
    solid = mpm.NeoHookean(E=mpm.Table(*SOFTENING), nu=NU)
    return mpm.ThermalExpansion(mpm.Melting(solid, mpm.WeaklyCompressible(work.LAM, viscosity=1.0)), EXPANSION)


def sand(s: Setup, **options: Any) -> Setup:
    law = mpm.QuarticSand(mu=work.MU, lam=work.LAM, **options)
    step = rollouts.changed(s, law=law)
    return Setup(step.prepare(s.state.replace(F=None)), step)


ROWS: dict[str, tuple[str | None, Callable[[Setup], Setup]]] = {
    "neo-Hookean": (None, lambda s: s),
    "heat": ("neo-Hookean", heated),
    "heat alone, of a body at rest": ("heat", alone),
    "heat, E(T) and expansion": ("heat", lambda s: heated(s, softening())),
    "heat, melting": ("heat", lambda s: heated(s, melting(), melts=True)),
    "heat, melting, E(T) and expansion": ("heat", lambda s: heated(s, wax(), melts=True)),
    "heat, von Mises with plastic heating": (
        "heat",
        lambda s: heated(s, mpm.VonMises(mu=work.MU, lam=work.LAM, yield_stress=1e3), plastic_heating=0.9),
    ),
    "sand": (None, sand),
    "hardening sand": ("sand", lambda s: sand(s, hardening=(0.6, 0.16, 0.2, 0.17))),
}
"""Rows with the row that each stands beside, and cubes made from the neo-Hookean one."""


def beside_each_other(plain: Setup, names: Iterable[str], device: str, samples: int) -> Iterator[dict[str, Any]]:
    """Rows of ROWS for a neo-Hookean cube, or for a batch of them."""
    scenes, times = plain.step.grid.scenes, {}
    for name in names:
        beside, make = ROWS[name]
        row = rollouts.per_step(make(plain), device, samples)
        times[name] = row["us"]
        compared = {} if beside is None else {"beside": beside, "times": row["us"] / times[beside]}
        yield {"name": named(name, scenes), **row, **compared}


def named(name: str, scenes: int) -> str:
    return name if scenes == 1 else f"{name}, {scenes} scenes"


def of_peer(device: str, side: int, scenes: int, us: float) -> Iterator[dict[str, Any]]:
    """Warp's substep with heat of one cube or of cubes side by side, beside ours of `us`, with the differences from one
    of ours after STEPS of them.
    """
    if not peers.is_installed("warp"):
        return
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "moved.npz"
        options = ["--scenes", str(scenes)] if scenes > 1 else ["--save", str(saved)]
        (peer,) = run_peer("warp", device, [side], 7, "--heat", *options)
        row = {key: peer[key] for key in ("particles", "iterations", "residual")}
        if scenes == 1:
            row["difference"] = difference(after_steps(side, device), saved)
    spent = 1e3 * peer["fastest_ms"]
    row |= {"name": named(f"peer: Warp {peer['version']}", scenes), "steps": STEPS, "us": spent}
    yield {**row, "rate": row["particles"] / spent * 1e6, "beside": "heat", "times": spent / us}


def after_steps(side: int, device: str) -> mpm.State:
    """A cube with heat after STEPS substeps."""
    s = heated(setup(work.make(side), device))
    with torch.no_grad():
        return mpm.rollout(s.step, s.state, STEPS, work.DT)


def with_gradients(s: Setup, device: str, samples: int, steps: int) -> dict[str, Any]:
    """A loss of the temperatures and positions after some substeps and its gradients by the temperatures and
    velocities, beside these substeps without gradients."""
    state = s.state.sorted(s.step.grid)
    checkpoints = mpm.Checkpoints(memory=GRADIENT_MEMORY)

    def forward() -> mpm.State:
        with torch.no_grad():
            return mpm.rollout(s.step, state, steps, work.DT)

    def gradients() -> tuple[torch.Tensor, ...]:
        v, theta = (f.clone().requires_grad_() for f in (state.v, temperature_of(state)))
        end = mpm.rollout(s.step, state.replace(v=v, temperature=theta), steps, work.DT, checkpoints)
        loss = end.x.square().sum() + temperature_of(end).square().mean()
        return torch.autograd.grad(loss, (v, theta))

    taken = memory.of_cuda(gradients) if device == "cuda" else memory.of_returned_tensors(gradients)
    plain, both = (rollouts.least(device, work_, samples) / steps for work_ in (forward, gradients))
    rate = len(state) / both
    row = {"name": "heat, forward and backward", "particles": len(state), "steps": steps, "us": both * 1e6}
    return {**row, "rate": rate, "beside": f"heat, {plain * 1e6:.3g} us", "times": both / plain, "memory": taken}


def temperature_of(state: mpm.State) -> torch.Tensor:
    assert state.temperature is not None
    return state.temperature


def library_sizes() -> dict[str, int]:
    """Bytes of the library files of this installation."""
    files = (_library.CPU_LIBRARY, _library.CUDA_LIBRARY)
    return {file.name: file.stat().st_size for file in files if file.exists()}


def until_a_time(s: Setup, device: str, samples: int) -> dict[str, Any]:
    """Substeps whose length follows the limit, beside substeps of their mean length (`UNTIL_A_TIME`)."""
    state, scenes = s.state.sorted(s.step.grid), s.step.grid.scenes
    with torch.no_grad():
        dt = float(s.step.stable_dt(state).min()) / 2
        spent = rollouts.least(device, lambda: mpm.rollout(s.step, state, 64, dt), 2) / 64
        end = dt * max(64, min(MOST_SUBSTEPS, int(rollouts.SECONDS / spent)))
        result = mpm.rollout_to(s.step, state, end)
        substeps = int(result.substeps.max())
        best = rollouts.least(device, lambda: mpm.rollout_to(s.step, state, end), samples) / substeps
        fixed = with_fixed_dt(s.step, state, substeps, end / substeps, device, samples)
    row = {"name": named("until a time", scenes), "particles": len(state), "steps": substeps, "us": best * 1e6}
    row |= {"rate": len(state) / best, "beside": f"fixed dt, {fixed['fastest'] * 1e6:.3g} us"}
    ratios = {"times": "fastest", "of_schedule": "alike", "of_calls": "calls"}
    return row | {"fixed": fixed} | {name: best / fixed[other] for name, other in ratios.items()}


def with_fixed_dt(step: mpm.Step, state: mpm.State, n: int, dt: float, device: str, samples: int) -> dict[str, Any]:
    """Seconds of a substep of fixed dt in one call by the fastest schedule, in one call by the schedule of a segment of
    `torch_mpm.rollout_to`, and in calls of that schedule as long as a segment; and both schedules. A shorter last call
    has the fastest schedule: the other may not support it."""
    fastest = mpm.plan_rollout(step, state, n, dt).schedule
    own = mpm.plan_rollout(step, state, SEGMENT, torch.full((step.grid.scenes,), dt).to(state.x)).schedule

    def spent(schedule: str | None, most: int) -> float:
        def rolled() -> mpm.State:
            now = state
            for first in range(0, n, most):
                count = min(most, n - first)
                now = mpm.rollout(step, now, count, dt, schedule=schedule if count == most else None)
            return now

        return rollouts.least(device, rolled, samples) / n

    best = spent(None, n)
    times = {"fastest": best, "alike": best if own == fastest else spent(own, n), "calls": spent(own, SEGMENT)}
    return {**times, "schedule": fastest, "own_schedule": own}


def measure(device: str, quick: bool = False) -> dict[str, Any]:
    common.use_all_cores()
    samples = 1 if quick else 5
    rows: list[dict[str, Any]] = []
    for side in (6,) if quick else SIDES[device]:
        cubes = list(beside_each_other(setup(work.make(side), device), ROWS, device, samples))
        rows += [*cubes, *of_peer(device, side, 1, us_of("heat", cubes))]
    batches = ((4, 64),) if quick else BATCHES[device]
    for scenes, particles in batches:
        batch = rollouts.batched(scenes, particles, device)
        cubes = list(beside_each_other(batch, ("neo-Hookean", "heat"), device, samples))
        rows += [*cubes, *of_peer(device, rollouts.side_of(particles), scenes, us_of(named("heat", scenes), cubes))]
    for side in (6,) if quick else GRADIENT_SIDES[device]:
        cube, steps = heated(setup(work.make(side), device)), 10 if quick else GRADIENT_STEPS[device]
        rows.append(with_gradients(cube, device, min(samples, 2), steps))
    for side in (6,) if quick else TIMED_SIDES[device]:
        rows.append(until_a_time(setup(work.make(side), device), device, samples))
    rows += [until_a_time(rollouts.batched(*batch, device), device, samples) for batch in batches]
    result = {"environment": common.environment(device), "libraries": library_sizes(), "rows": rows}
    sides = KERNEL_SIDES[device][:1] if quick else KERNEL_SIDES[device]
    return result | (kernels(sides, samples) if sides else {})


def kernels(sides: Iterable[int], samples: int) -> dict[str, Any]:
    """Kernels of substeps with heat on CUDA, in the form of the parts of `step.py`, and the copy bandwidth."""
    clock = Clock("cuda", samples)
    with clock:
        rate = 2 * LARGE / copy_ms(clock, 2 * LARGE) * 1e-6
    sizes = [heat_kernels.measure(heated(setup(work.make(side), "cuda")), clock) for side in sides]
    return {"copy_GB_s": rate, "sizes": sizes}


def us_of(name: str, rows: Iterable[dict[str, Any]]) -> float:
    return next(r["us"] for r in rows if r["name"] == name)


def table(result: dict[str, Any]) -> str:
    header = ("", "particles", "us per substep", "M particles/s", "times", "that of")
    rows = [
        (r["name"], r["particles"], r["us"], r["rate"] * 1e-6, r.get("times", 1.0), r.get("beside", ""))
        for r in result["rows"]
    ]
    if any("fixed" in r for r in result["rows"]):
        header = (*header, "of its schedule", "of its calls", "schedule")
        rows = [(*row, *of_segments(r)) for row, r in zip(rows, result["rows"], strict=True)]
    return common.table(header, rows)


def of_segments(row: dict[str, Any]) -> tuple[Any, ...]:
    """Cells of a row `until a time` beside the same schedule; empty for the others."""
    return (row["of_schedule"], row["of_calls"], row["fixed"]["own_schedule"]) if "fixed" in row else ("", "", "")


def notes(result: dict[str, Any]) -> Iterator[str]:
    """Sentences on the rows, on the peer and on the libraries, where the result has them."""
    if any("fixed" in r for r in result["rows"]):
        yield UNTIL_A_TIME
    if by_peer := [r for r in result["rows"] if "residual" in r]:
        iterations, residual = by_peer[0]["iterations"], max(r["residual"] for r in by_peer)
        found = [r["difference"]["temperature"] for r in by_peer if "difference" in r]
        yield (
            f"The peer solves for heat by {iterations} iterations of conjugate gradients; they leave {residual:.1e} of "
            "the first residual at most."
        )
        yield f"Its temperatures, 0 to 10 K, are within {max(found):.1e} K of those of `heat` after {STEPS} substeps."
    for r in result["rows"]:
        if "memory" in r:
            yield f"Forward and backward of {r['steps']} substeps take {r['memory'] / 1e6:.0f} MB."
    if sizes := result.get("libraries"):
        yield "Libraries: " + ", ".join(f"{name} {size / 1e6:.1f} MB" for name, size in sizes.items()) + "."


def text(result: dict[str, Any]) -> str:
    title, place = "# Steps with heat, laws of temperature and hardening", common.describe(result["environment"])
    parts = [title, place, table(result), "\n".join(notes(result)), *map(heat_kernels.text, result.get("sizes", ()))]
    return "\n\n".join([*filter(None, parts), ""])


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Microseconds per substep, and of its kernels, for `regressions`."""
    for r in result["rows"]:
        yield f"{r['name']}, {r['particles']} particles", r["us"]
    for entry in result.get("sizes", ()):
        yield from ((f"{p['name']}, {entry['particles']} particles", p["ms"] * 1e3) for p in entry["parts"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    result = measure(arguments.device, arguments.quick)
    print(text(result))
    name = f"thermal_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed)
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
