"""Time of one explicit neo-Hookean step and of each of its parts, forward and backward, beside peers on the same work.

    python -m benchmarks.speed.step                        # CPU, 262144 particles, all cores
    python -m benchmarks.speed.step --device cuda          # 1 and 8 million particles; about 2 minutes
    python -m benchmarks.speed.step --device cuda --out DIRECTORY

It needs no network. Warp and Taichi are included where they are installed (`pip install torch-mpm[bench]`), unless
`--peers` has no name. Without git, the environment variable TORCH_MPM_COMMIT names the commit. A failed part is
reported at the end and does not stop the others.

Work: `benchmarks/speed/work.py`. Whole steps: wall clock of several steps in a row from particles in the order of their
cells, synchronised once, everything included: activation, stress, P2G, grid update, G2P, positions and F. On CUDA they
are replayed from a CUDA graph too.
Parts: median of single calls; on CUDA from a graph with the cache emptied before. Bytes: every tensor that an op needs
or makes once, node tensors by their active rows. Of memory: the least time in which as many bytes are copied or read,
whichever is faster, over that of the part. Errors: float32 against float64, the largest error over the largest value.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common, regressions
from . import peers, work
from .timing import Clock, Time, copy_ms, memory_ms

SIDES = {"cpu": [64], "cuda": [100, 200]}
STEPS = 10
REORDER = 32  # steps between two reorderings in a scene
SMALLEST = 4  # particles along a side of a cube that keeps no device busy
LARGE = 2**30  # bytes of a tensor that is in no cache
FIELDS = ("x", "v", "C", "F")


# ---- the work in torch_mpm


@dataclasses.dataclass
class Setup:
    """The common work as a state, its grid and its step."""

    state: mpm.State
    step: mpm.Step

    @property
    def grid(self) -> mpm.Grid:
        return self.step.grid


def setup(w: work.Work, device: str, dtype: torch.dtype = torch.float32) -> Setup:
    grid = mpm.Grid(dx=1 / w.n, lower=(0, 0, 0), upper=(1, 1, 1))
    law = mpm.NeoHookean(mu=work.MU, lam=work.LAM)
    step = mpm.Step(grid, law, gravity=(0, -work.GRAVITY, 0), walls="sticky")
    points = mpm.seed.Points(torch.from_numpy(w.x), torch.full((w.particles,), w.volume))
    state = mpm.State.at_rest(points, work.DENSITY, torch.from_numpy(w.v), dtype=dtype, device=device)
    zero = torch.zeros(3, 3, w.particles, dtype=dtype, device=device).permute(2, 0, 1)
    return Setup(step.prepare(state.replace(C=zero)), step)


# ---- whole steps


def whole_steps(clock: Clock, s: Setup) -> Iterator[tuple[str, Time]]:
    """Consecutive steps, and a step with its backward pass."""

    def forward(steps: int) -> mpm.State:
        state = s.state
        for _ in range(steps):
            state = s.step(state, work.DT)
        return state

    with torch.no_grad():
        yield "step", clock.steps(lambda: forward(STEPS), STEPS)
        reordered = clock.steps(lambda: forward(REORDER).sorted(s.grid), REORDER)
        yield f"step, with a reordering every {REORDER}", reordered
        if clock.cuda and (replay := clock.capture(lambda: roll(s, s.state))):
            yield "step, CUDA graph", dataclasses.replace(clock.steps(replay, STEPS), graph=True)
    with torch.inference_mode():
        yield "step, inference mode", clock.steps(lambda: forward(STEPS), STEPS)
    leaves = [getattr(s.state, name).detach().requires_grad_() for name in FIELDS]
    start = s.state.replace(**dict(zip(FIELDS, leaves, strict=True)))
    grads = [torch.ones_like(leaf) for leaf in leaves]

    def both() -> tuple[Tensor, ...]:
        end = s.step(start, work.DT)
        return torch.autograd.grad([getattr(end, name) for name in FIELDS], leaves, grads)

    yield "step, forward and backward", clock.steps(both, 1)
    if clock.cuda and (replay := clock.capture(both)):
        yield "step, forward and backward, CUDA graph", dataclasses.replace(clock.steps(replay, 1), graph=True)
    with torch.no_grad():
        yield "reorder particles (now and then)", clock.op(lambda: s.state.sorted(s.grid))


def roll(s: Setup, start: mpm.State) -> None:
    """STEPS steps whose result is stored in `start`, as required for the replay of a graph."""
    state = start
    for _ in range(STEPS):
        state = s.step(state, work.DT)
    for name in FIELDS:
        getattr(start, name).copy_(getattr(state, name))


# ---- the parts of a step


@dataclasses.dataclass
class Op:
    """A part of the step: a function of tensors, and example arguments."""

    name: str
    function: Callable[..., Any]
    inputs: tuple[Tensor, ...]
    differentiable: bool = True
    unread: tuple[int, ...] = ()
    """Inputs, by index, whose values the backward pass does not need."""


def parts(s: Setup) -> tuple[mpm.Blocks, list[Op]]:
    """Ops of a step in their order, on the blocks of a state after some motion."""
    grid, law = s.grid, s.step.law
    with torch.no_grad():
        state = mpm.rollout(s.step, s.state, STEPS, work.DT)
    x, v, mass, volume, C, F = state.x, state.v, state.mass, state.volume, state.C, state.F
    blocks = grid.activate(x)
    stress = law.stress(state)
    nodes = mpm.p2g(blocks, x, mass, v, C, stress, volume, work.DT)
    gravity = torch.tensor(s.step.gravity, dtype=x.dtype, device=x.device)

    def update(nodes: Tensor) -> Tensor:
        return mpm.grid_update(blocks, nodes, gravity, work.DT, s.step.walls)

    def p2g(x: Tensor, mass: Tensor, v: Tensor, C: Tensor, stress: Any = None, volume: Any = None) -> Tensor:
        return mpm.p2g(blocks, x, mass, v, C, stress, volume, work.DT)

    def g2p_advance(x: Tensor, velocity: Tensor, F: Tensor) -> Any:
        return mpm.g2p_advance(blocks, x, velocity, work.DT, F)[:4]

    return blocks, [
        Op("activate", lambda x: grid.activate(x).index, (x,), differentiable=False),
        Op("stress", lambda F: law.stress(state.replace(F=F)), (F,)),
        Op("p2g", p2g, (x, mass, v, C)),
        Op("p2g with stress", p2g, (x, mass, v, C, stress, volume)),
        Op("grid update", update, (nodes,)),
        Op("g2p", lambda x, velocity: mpm.g2p(blocks, x, velocity)[:2], (x, update(nodes))),
        Op("advance", lambda x, v, C, F: mpm.advance(x, v, work.DT, C, F)[:2], (x, v, C, F), unread=(1,)),
        Op("g2p and advance", g2p_advance, (x, update(nodes), F)),
    ]


def bytes_of(tensors: Sequence[Tensor], blocks: mpm.Blocks, active: int) -> int:
    """Size of tensors, node tensors by their active rows."""
    rows = [active if t.shape[0] == blocks.node_count else t.shape[0] for t in tensors]
    return sum(n * t.element_size() * t[0].numel() for n, t in zip(rows, tensors, strict=True))


def time_part(clock: Clock, op: Op, blocks: mpm.Blocks, active: int) -> Iterator[dict[str, Any]]:
    """Forward, then backward for every input."""

    def entry(name: str, time: Time, *tensors: Tensor) -> dict[str, Any]:
        size = bytes_of(tensors, blocks, active)
        return {"name": name, **dataclasses.asdict(time), "bytes": size, "memory_ms": memory_ms(clock, size)}

    with torch.no_grad():
        outputs = _tuple(op.function(*op.inputs))
        yield entry(op.name, clock.op(lambda: op.function(*op.inputs)), *op.inputs, *outputs)
    if not op.differentiable:
        return
    leaves = [t.detach().requires_grad_() for t in op.inputs]
    outputs = _tuple(op.function(*leaves))
    grads = [torch.ones_like(t) for t in outputs]

    def backward() -> tuple[Tensor, ...]:
        return torch.autograd.grad(outputs, leaves, grads, retain_graph=True)

    read = [leaf for i, leaf in enumerate(leaves) if i not in op.unread]
    given = {g.data_ptr() for g in grads}
    made = [g for g in backward() if g.data_ptr() not in given]  # Others are unchanged.
    yield entry(f"{op.name}, backward", clock.op(backward), *read, *grads, *made)


def _tuple(value: Any) -> tuple[Tensor, ...]:
    return value if isinstance(value, tuple) else (value,)


# ---- float32 against float64


def errors(s: Setup) -> dict[str, float]:
    """Largest error of p2g, g2p and their gradients, float32 against float64, over the largest value of the result."""
    with torch.no_grad():
        state = mpm.rollout(s.step, s.state, STEPS, work.DT)
    fields = [getattr(state, name) for name in ("x", "mass", "v", "C", "volume")] + [s.step.law.stress(state)]
    generator = torch.Generator().manual_seed(0)
    single, double = (
        _transfers(s.grid, [f.to(dtype) for f in fields], generator) for dtype in (torch.float32, torch.float64)
    )
    return {
        name: float((single[name].double() - value).abs().max() / value.abs().max()) for name, value in double.items()
    }


def _transfers(grid: mpm.Grid, fields: list[Tensor], generator: torch.Generator) -> dict[str, Tensor]:
    """Results and gradients of p2g and g2p; those on nodes as dense lattices, since slots of blocks may differ."""
    x, mass, v, C, volume, stress = (f.detach().requires_grad_() for f in fields)
    blocks = grid.activate(x)
    nodes = mpm.p2g(blocks, x, mass, v, C, stress, volume, work.DT)
    pull = _random_lattice(blocks.to_dense(nodes).shape, generator, nodes)
    velocity = blocks.from_dense(_random_lattice((*pull.shape[:-1], 3), generator, nodes)).requires_grad_()
    new_v, new_C, _ = mpm.g2p(blocks, x, velocity)
    inputs = {"x": x, "mass": mass, "v": v, "C": C, "volume": volume, "stress": stress}
    from_p2g = torch.autograd.grad(nodes, list(inputs.values()), blocks.from_dense(pull))
    from_g2p = torch.autograd.grad((new_v, new_C), (x, velocity), (v.detach(), C.detach()))
    return {
        "p2g mass": blocks.to_dense(nodes[:, :1]).detach(),
        "p2g momentum": blocks.to_dense(nodes[:, 1:]).detach(),
        **{f"p2g gradient of {name}": g for name, g in zip(inputs, from_p2g, strict=True)},
        "g2p v": new_v.detach(),
        "g2p C": new_C.detach(),
        "g2p gradient of x": from_g2p[0],
        "g2p gradient of velocity": blocks.to_dense(from_g2p[1]),
    }


def _random_lattice(shape: Sequence[int], generator: torch.Generator, like: Tensor) -> Tensor:
    """The same uniform numbers in [-1, 1] at every call for one dtype as for another, exact in float32."""
    generator.manual_seed(0)
    return (2 * torch.rand(*shape, generator=generator) - 1).to(like)


# ---- peers, each in a separate process


def run_peer(
    peer: str, device: str, sides: Sequence[int], samples: int, *options: str, steps: int = STEPS
) -> Iterator[dict[str, Any]]:
    command = [sys.executable, "-m", peers.__name__, peer, "--device", device, "--samples", str(samples)]
    command += ["--steps", str(steps), *options, "--sides", *map(str, sides)]
    done = subprocess.run(command, cwd=common.ROOT, capture_output=True, text=True, timeout=300)
    for line in done.stdout.splitlines():
        if line.startswith("{"):
            yield json.loads(line)
    if done.returncode:
        raise RuntimeError(f"{peer} ended with {done.returncode}: {done.stderr.strip()[-500:]}")


def difference(state: mpm.State, saved: Path) -> dict[str, float]:
    """Largest difference of each field that a peer has, in its unit, from that of the peer after the same steps."""
    with np.load(saved) as other:
        ours = {k: state.extra[k] if k in state.extra else getattr(state, k) for k in other.files}
        return {k: float(np.abs(field.detach().cpu().numpy() - other[k]).max()) for k, field in ours.items()}


# ---- the program


class Report:
    """Results so far, and failures."""

    def __init__(self, device: str) -> None:
        self.result: dict[str, Any] = {
            "environment": common.environment(device),
            "sizes": [],
            "host": [],
            "peers": [],
            "difference": {},
            "failures": [],
        }

    def attempt(self, name: str, part: Callable[[], object]) -> None:
        try:
            part()
        except Exception as error:
            traceback.print_exc()
            self.result["failures"].append(f"{name}: {type(error).__name__}: {str(error)[:300]}")
            if torch.cuda.is_available():
                torch.cuda.empty_cache()


def measure_size(report: Report, clock: Clock, side: int) -> None:
    """Everything about one size; fills the report as it goes."""
    w = work.make(side)
    device = str(clock.device)
    entry: dict[str, Any] = {"side": side, "particles": w.particles, "steps": [], "parts": [], "errors": {}}
    report.result["sizes"].append(entry)

    def steps() -> None:
        for name, time in whole_steps(clock, setup(w, device)):
            entry["steps"].append({"name": name, **dataclasses.asdict(time)})

    def ops() -> None:
        blocks, ops = parts(setup(w, device))
        entry["active_nodes"] = active = int(blocks.active_nodes().sum())
        for op in ops:
            report.attempt(op.name, lambda op=op: entry["parts"].extend(time_part(clock, op, blocks, active)))  # type: ignore[misc]

    with clock:
        report.attempt("whole steps", steps)
        report.attempt("parts", ops)
        report.attempt("errors", lambda: entry["errors"].update(errors(setup(w, device))))


def measure_host(report: Report, clock: Clock) -> None:
    """Steps of a scene so small that they take the time of the host alone."""
    w = work.make(SMALLEST)
    with clock:
        for name, time in whole_steps(clock, setup(w, str(clock.device))):
            report.result["host"].append({"name": name, "particles": w.particles, **dataclasses.asdict(time)})


def measure_peer(report: Report, peer: str, device: str, sides: Sequence[int], samples: int) -> None:
    """Times of a peer for all sizes, and the distance of its particles from ours."""
    if not peers.is_installed(peer):
        print(f"{peer} is not installed")
        return
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "moved.npz"
        for result in run_peer(peer, device, sides, samples, "--save", str(saved)):
            report.result["peers"].append(result)
        s = setup(work.make(sides[0]), device)
        with torch.no_grad():
            moved = mpm.rollout(s.step, s.state, STEPS, work.DT)
        report.result["difference"][peer] = difference(moved, saved)


def measure(
    device: str, sides: Sequence[int], peer_names: Sequence[str], samples: int = 20, budget: float = 1.0
) -> dict[str, Any]:
    common.use_all_cores()
    report = Report(device)
    clock = Clock(device, samples, budget)

    def copy() -> None:
        with clock:
            rate = 2 * LARGE / copy_ms(clock, 2 * LARGE) * 1e-6
            report.result["copy_GB_s"] = max(rate, report.result.get("copy_GB_s", 0.0))

    report.attempt("copy", copy)
    for side in sides:
        report.attempt(f"{side}^3 particles", lambda side=side: measure_size(report, clock, side))  # type: ignore[misc]
    report.attempt("copy", copy)
    report.attempt("host", lambda: measure_host(report, clock))
    for peer in peer_names:
        report.attempt(peer, lambda peer=peer: measure_peer(report, peer, device, sides, min(samples, 7)))  # type: ignore[misc]
    return report.result


# ---- the report


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    copy = result.get("copy_GB_s")
    lines = ["# Speed of a step", "", common.describe(result["environment"]), ""]
    lines += [
        f"Copy bandwidth of the device: {copy:.0f} GB/s." if copy else "The copy bandwidth could not be measured."
    ]
    lines += [f"The particles of {peer} are within {d['x']:.1e} m and {d['v']:.1e} m/s after {STEPS} steps."
              for peer, d in result["difference"].items()]  # fmt: skip
    for entry in result["sizes"]:
        lines += ["", f"## {entry['particles']} particles", "", *_size_tables(entry, result["peers"])]
    if result["host"]:
        lines += ["", f"## {result['host'][0]['particles']} particles: the host's part", ""]
        lines += [common.table(("whole step", "median ms", "least ms"),
                               [(r["name"], r["ms"], r["fastest_ms"]) for r in result["host"]])]  # fmt: skip
    lines += ["", *(f"Failed: {failure}" for failure in result["failures"])]
    return "\n".join(lines)


def _size_tables(entry: dict[str, Any], others: list[dict[str, Any]]) -> Iterator[str]:
    P = entry["particles"]
    rows = [
        *entry["steps"],
        *({**o, "name": f"{o['name']} {o['version']}, step"} for o in others if o["particles"] == P),
    ]
    ours = min((r["ms"] for r in entry["steps"] if r["name"] in ("step", "step, CUDA graph")), default=None)
    header = ("whole step", "median ms", "least ms", "M particles/s", "times the fastest step of torch_mpm")
    yield common.table(
        header, [(r["name"], r["ms"], r["fastest_ms"], P / r["ms"] * 1e-3, ours and r["ms"] / ours) for r in rows]
    )
    yield ""
    header = ("part", "median ms", "least ms", "G particles/s", "GB/s", "of memory", "timed")
    yield common.table(header, [_part_row(r, P) for r in entry["parts"]])
    yield ""
    yield common.table(("float32 against float64", "largest error"), entry["errors"].items())


def _part_row(r: dict[str, Any], particles: int) -> tuple[Any, ...]:
    rate, share = r["bytes"] / r["ms"] * 1e-6, f"{r['memory_ms'] / r['ms']:.0%}"
    timed = "graph" if r["graph"] else "call"
    return r["name"], r["ms"], r["fastest_ms"], particles / r["ms"] * 1e-6, rate, share, timed


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Milliseconds of the steps and of the parts, for `regressions`."""
    for entry in result["sizes"]:
        for rows, key in (("steps", "ms"), ("parts", "fastest_ms")):
            yield from ((f"{row['name']}, {entry['particles']} particles", row[key]) for row in entry[rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--sides", type=int, nargs="+", help="particles along a side of the cube (64; CUDA 100 200)")
    parser.add_argument("--peers", nargs="*", default=sorted(peers.PEERS), choices=sorted(peers.PEERS))
    parser.add_argument("--quick", action="store_true", help="a few samples of a small size, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    sides = arguments.sides or ([16] if arguments.quick else SIDES[arguments.device])
    effort = {"samples": 3, "budget": 0.1} if arguments.quick else {}
    result = measure(arguments.device, sides, arguments.peers, **effort)
    print(text(result))
    name = f"speed_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed)
    common.write(arguments.out, name, result, text(result))
    sys.exit(1 if result["failures"] else 0)


if __name__ == "__main__":
    main()
