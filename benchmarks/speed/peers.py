"""The same step in Warp and in Taichi, each in plain standard use: `python -m benchmarks.speed.peers warp`.

MLS-MPM with APIC transfers on a dense grid: F update, neo-Hookean stress and P2G in one kernel with atomic adds; grid
update; G2P and advection in one kernel. Warp replays a CUDA graph on GPUs; on CPUs it runs one thread. Prints a line of
JSON for each size. It runs in a separate process, so that peers do not disturb each other.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from . import work
from .work import DT, GRAVITY, LAM, MU

Program = tuple[Callable[[], None], Callable[[], None], Callable[[], tuple[np.ndarray, np.ndarray]]]
"""One step, synchronise, and present positions and velocities."""


def warp_program(w: work.Work, device: str) -> Program:
    import warp as wp

    wp.config.quiet = True
    wp.init()
    nx, ny, nz = w.cells
    inv, mass, volume = float(w.n), w.mass, w.volume
    mu, lam, gravity, dt = MU, LAM, GRAVITY, DT

    @wp.func
    def weight(fx: float, i: int):  # type: ignore[no-untyped-def]
        result = 0.5 * (1.5 - fx) * (1.5 - fx)
        if i == 1:
            result = 0.75 - (fx - 1.0) * (fx - 1.0)
        if i == 2:
            result = 0.5 * (fx - 0.5) * (fx - 0.5)
        return result

    @wp.kernel(enable_backward=False)
    def p2g(  # type: ignore[no-untyped-def]
        x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
        C: wp.array(dtype=wp.mat33), F: wp.array(dtype=wp.mat33),
        momentum: wp.array(dtype=wp.vec3, ndim=3), node_mass: wp.array(dtype=float, ndim=3),
        inv: float, dt: float, mass: float, volume: float, mu: float, lam: float,
    ):  # fmt: skip
        p = wp.tid()
        eye = wp.identity(n=3, dtype=float)
        position = x[p] * inv
        i0, j0, k0 = int(position[0] - 0.5), int(position[1] - 0.5), int(position[2] - 0.5)
        fx = position - wp.vec3(float(i0), float(j0), float(k0))
        f = F[p] + dt * C[p] * F[p]
        F[p] = f
        tau = mu * (f * wp.transpose(f) - eye) + lam * wp.log(wp.determinant(f)) * eye
        A = mass * C[p] - dt * volume * 4.0 * inv * inv * tau
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    offset = (wp.vec3(float(i), float(j), float(k)) - fx) / inv
                    N = weight(fx[0], i) * weight(fx[1], j) * weight(fx[2], k)
                    wp.atomic_add(momentum, i0 + i, j0 + j, k0 + k, N * (mass * v[p] + A * offset))
                    wp.atomic_add(node_mass, i0 + i, j0 + j, k0 + k, N * mass)

    @wp.kernel(enable_backward=False)
    def update(  # type: ignore[no-untyped-def]
        momentum: wp.array(dtype=wp.vec3, ndim=3), node_mass: wp.array(dtype=float, ndim=3),
        nx: int, ny: int, nz: int, fall: float,
    ):  # fmt: skip
        i, j, k = wp.tid()
        if node_mass[i, j, k] > 0.0:
            u = momentum[i, j, k] / node_mass[i, j, k] - wp.vec3(0.0, fall, 0.0)
            if i < 3 or j < 3 or k < 3 or i >= nx - 3 or j >= ny - 3 or k >= nz - 3:
                u = wp.vec3(0.0, 0.0, 0.0)
            momentum[i, j, k] = u

    @wp.kernel(enable_backward=False)
    def g2p(  # type: ignore[no-untyped-def]
        x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), C: wp.array(dtype=wp.mat33),
        velocity: wp.array(dtype=wp.vec3, ndim=3), inv: float, dt: float,
    ):  # fmt: skip
        p = wp.tid()
        position = x[p] * inv
        i0, j0, k0 = int(position[0] - 0.5), int(position[1] - 0.5), int(position[2] - 0.5)
        fx = position - wp.vec3(float(i0), float(j0), float(k0))
        new_v = wp.vec3()
        new_C = wp.mat33()
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    offset = wp.vec3(float(i), float(j), float(k)) - fx
                    N = weight(fx[0], i) * weight(fx[1], j) * weight(fx[2], k)
                    g = velocity[i0 + i, j0 + j, k0 + k]
                    new_v += N * g
                    new_C += wp.outer(g, offset) * (N * 4.0 * inv)
        v[p] = new_v
        C[p] = new_C
        x[p] = x[p] + dt * new_v

    P = w.particles
    x, v = (wp.array(a, dtype=wp.vec3, device=device) for a in (w.x, w.v))
    C = wp.zeros(P, dtype=wp.mat33, device=device)
    eyes = np.tile(np.eye(3, dtype=np.float32), (P, 1, 1))
    F = wp.array(eyes, dtype=wp.mat33, device=device)
    momentum = wp.zeros((nx, ny, nz), dtype=wp.vec3, device=device)
    node_mass = wp.zeros((nx, ny, nz), dtype=float, device=device)

    def launch() -> None:
        momentum.zero_()
        node_mass.zero_()
        wp.launch(p2g, P, [x, v, C, F, momentum, node_mass, inv, dt, mass, volume, mu, lam], device=device)
        wp.launch(update, (nx, ny, nz), [momentum, node_mass, nx, ny, nz, dt * gravity], device=device)
        wp.launch(g2p, P, [x, v, C, momentum, inv, dt], device=device)

    step = launch
    if device != "cpu":
        moving = (x, v, C, F)
        start = [wp.clone(array) for array in moving]
        launch()  # Compiles, which a capture must not.
        for array, initial in zip(moving, start, strict=True):
            wp.copy(array, initial)
        with wp.ScopedCapture(device=device) as capture:
            launch()

        def step() -> None:
            wp.capture_launch(capture.graph)

        step.launch = launch  # type: ignore[attr-defined]  # `--launches`; keeps the arrays, which the graph does not

    return step, wp.synchronize, lambda: (x.numpy(), v.numpy())


def taichi_program(w: work.Work, device: str) -> Program:
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
    return step, ti.sync, lambda: (x.to_numpy(), v.to_numpy())


PEERS = {"warp": (warp_program, "warp"), "taichi": (taichi_program, "taichi")}


def is_installed(peer: str) -> bool:
    return importlib.util.find_spec(PEERS[peer][1]) is not None


def measure(
    peer: str, w: work.Work, device: str, samples: int, steps: int, save: str | None = None, launches: bool = False
) -> dict[str, Any]:
    """Median and least time of one step, in samples of several steps that are synchronised together."""
    program, module = PEERS[peer]
    step, synchronize, result = program(w, device)
    if launches:
        step = getattr(step, "launch", step)
    for _ in range(steps):
        step()
    synchronize()
    if save:
        x, v = result()
        np.savez(save, x=x, v=v)
    times = []
    for _ in range(samples):
        begin = time.perf_counter()
        for _ in range(steps):
            step()
        synchronize()
        times.append((time.perf_counter() - begin) / steps * 1e3)
    version = __import__(module).__version__
    version = ".".join(map(str, version)) if isinstance(version, tuple) else str(version)
    return {
        "name": peer,
        "version": version,
        "particles": w.particles,
        "ms": statistics.median(times),
        "fastest_ms": min(times),
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
    parser.add_argument("--save", help="file for x and v of the first size after the first steps (.npz)")
    parser.add_argument("--launches", action="store_true", help="from Python, where Warp would replay a CUDA graph")
    arguments = parser.parse_args()
    if arguments.scenes > 1 and arguments.domain > 1:
        parser.error("--scenes makes a domain of its own: give no --domain")
    for i, side in enumerate(arguments.sides):
        save = arguments.save if i == 0 else None
        w = work.make(side)
        w = w.side_by_side(arguments.scenes) if arguments.scenes > 1 else w.in_domain(arguments.domain)
        result = measure(
            arguments.peer, w, arguments.device, arguments.samples, arguments.steps, save, arguments.launches
        )
        print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
