"""The same step in Warp and in Taichi, each in plain standard use: `python -m benchmarks.speed.peers warp`.

MLS-MPM with APIC transfers on a dense grid: F update, neo-Hookean stress and P2G in one kernel with atomic adds; grid
update; G2P and advection in one kernel. With `--heat` the cubes conduct heat too (`heat_peer_warp.py`). Warp replays a
CUDA graph on GPUs; on CPUs it runs one thread. Prints a line of JSON for each size. It runs in a separate process, so
that peers do not disturb each other.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import time
from typing import Any

import numpy as np

from . import heat_peer_warp, step_peer_warp, work
from .work import DT, GRAVITY, LAM, MU


def taichi_program(w: work.Work, device: str) -> work.Program:
    import taichi as ti

    options = {"arch": ti.cpu} if device == "cpu" else {"arch": ti.cuda, "device_memory_GB": 8}
    ti.init(**options, offline_cache=False, log_level=ti.WARN)
    cells, P = w.cells, w.particles
    dx, inv, mass, volume = 1 / w.n, float(w.n), w.mass, w.volume
    mu, lam, gravity, dt = MU, LAM, GRAVITY, DT
    x, v = ti.Vector.field(3, ti.f32, P), ti.Vector.field(3, ti.f32, P)
    C, F = ti.Matrix.field(3, 3, ti.f32, P), ti.Matrix.field(3, 3, ti.f32, P)
    velocity, node_mass = ti.Vector.field(3, ti.f32, cells), ti.field(ti.f32, cells)

    @ti.kernel
    def start():  # type: ignore[no-untyped-def]
        for p in F:
            F[p] = ti.Matrix.identity(ti.f32, 3)

    @ti.kernel
    def step():  # type: ignore[no-untyped-def]
        for i in ti.grouped(node_mass):
            velocity[i] = ti.zero(velocity[i])
            node_mass[i] = 0
        ti.loop_config(block_dim=128)
        for p in x:
            position = x[p] * inv
            base = ti.cast(position - 0.5, ti.i32)
            fx = position - base
            weights = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            f = F[p] + dt * C[p] @ F[p]
            F[p] = f
            eye = ti.Matrix.identity(ti.f32, 3)
            tau = mu * (f @ f.transpose() - eye) + lam * ti.log(f.determinant()) * eye
            A = mass * C[p] - dt * volume * 4 * inv * inv * tau
            for o in ti.static(ti.grouped(ti.ndrange(3, 3, 3))):
                N = weights[o[0]][0] * weights[o[1]][1] * weights[o[2]][2]
                velocity[base + o] += N * (mass * v[p] + A @ ((o - fx) * dx))
                node_mass[base + o] += N * mass
        for i in ti.grouped(node_mass):
            if node_mass[i] > 0:
                velocity[i] /= node_mass[i]
                velocity[i][1] -= dt * gravity
                if any(i < 3) or any(i >= ti.Vector(cells) - 3):
                    velocity[i] = ti.zero(velocity[i])
        ti.loop_config(block_dim=128)
        for p in x:
            position = x[p] * inv
            base = ti.cast(position - 0.5, ti.i32)
            fx = position - base
            weights = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            new_v, new_C = ti.zero(v[p]), ti.zero(C[p])
            for o in ti.static(ti.grouped(ti.ndrange(3, 3, 3))):
                N = weights[o[0]][0] * weights[o[1]][1] * weights[o[2]][2]
                g = velocity[base + o]
                new_v += N * g
                new_C += 4 * inv * N * g.outer_product(o - fx)
            v[p] = new_v
            C[p] = new_C
            x[p] += dt * new_v

    x.from_numpy(w.x)
    v.from_numpy(w.v)
    start()
    return work.Program(step, ti.sync, lambda: {"x": x.to_numpy(), "v": v.to_numpy()})


PEERS = {"warp": (step_peer_warp.program, "warp"), "taichi": (taichi_program, "taichi")}
HEAT = {"warp": heat_peer_warp.program}
"""Programs of steps with heat."""


def is_installed(peer: str) -> bool:
    return importlib.util.find_spec(PEERS[peer][1]) is not None


def measure(
    peer: str,
    w: work.Work,
    device: str,
    samples: int,
    steps: int,
    save: str | None = None,
    launches: bool = False,
    heat: bool = False,
) -> dict[str, Any]:
    """Median and least time of one step, in samples of several steps that are synchronised together."""
    make, module = PEERS[peer]
    program = (HEAT[peer] if heat else make)(w, device)
    step = getattr(program.step, "launch", program.step) if launches else program.step
    for _ in range(steps):
        step()
    program.synchronize()
    if save:
        np.savez(save, **program.fields())
    times = []
    for _ in range(samples):
        begin = time.perf_counter()
        for _ in range(steps):
            step()
        program.synchronize()
        times.append((time.perf_counter() - begin) / steps * 1e3)
    version = __import__(module).__version__
    version = ".".join(map(str, version)) if isinstance(version, tuple) else str(version)
    return {
        "name": peer,
        "version": version,
        "particles": w.particles,
        "ms": statistics.median(times),
        "fastest_ms": min(times),
        **program.figures(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer", choices=sorted(PEERS))
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--sides", type=int, nargs="+", default=[64], help="particles along a side of the cube")
    parser.add_argument("--scenes", type=int, default=1, help="such cubes, a power of two, side by side in one domain")
    parser.add_argument("--domain", type=int, default=1, help="unit cubes along a side of the domain of one cube")
    parser.add_argument("--samples", type=int, default=7)
    parser.add_argument("--steps", type=int, default=10, help="steps in a sample, and before the first")
    parser.add_argument("--save", help="file for the fields of the first size after the first steps (.npz)")
    parser.add_argument("--launches", action="store_true", help="from Python, where Warp would replay a CUDA graph")
    parser.add_argument("--heat", action="store_true", help="steps with conduction of heat")
    arguments = parser.parse_args()
    if arguments.heat and arguments.peer not in HEAT:
        parser.error(f"--heat is for {', '.join(HEAT)} only, got {arguments.peer}")
    if arguments.scenes > 1 and arguments.domain > 1:
        parser.error("--scenes makes a domain of its own: give no --domain")
    for i, side in enumerate(arguments.sides):
        save = arguments.save if i == 0 else None
        w = work.make(side)
        w = w.side_by_side(arguments.scenes) if arguments.scenes > 1 else w.in_domain(arguments.domain)
        effort = arguments.samples, arguments.steps
        result = measure(arguments.peer, w, arguments.device, *effort, save, arguments.launches, arguments.heat)
        print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
