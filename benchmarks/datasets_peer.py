"""Scenes of a data set in Taichi, one after the other, as in scripts: `python -m benchmarks.datasets_peer sand`.

MLS-MPM with APIC transfers on a dense grid in two dimensions: update of the deformation, stress and P2G with atomic
adds, grid update with walls, G2P and advection, one call of a kernel per substep; positions go to an array after each
frame, and the array into a file after each scene. Water has a linear pressure of J; sand has Hencky elasticity and the
Drucker-Prager return map of Klar et al. (2016). Prints the time per frame of scenes after the first as a line of JSON.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

N, WALL = 80, 8
"""Cells along each axis of the unit square, and those behind each wall: dx = .0125 m in a domain from .1 to .9 m."""
INTERVAL = 2.5e-3
MATERIALS = {"water": {"density": 1e3, "substeps": 19}, "sand": {"density": 1.6e3, "substeps": 30}}
"""Substeps per frame chosen by torch_mpm for the presets water_drop and sand."""
BULK, E, NU, FRICTION_ANGLE, WALL_FRICTION = 5e5, 5e6, 0.3, 32.5, 0.5


def program(material: str, device: str, particles: int) -> tuple[Callable[[], None], Any, Any, Callable[[], None]]:
    """One substep, positions, velocities, and a function that resets the other fields to the start of a scene."""
    import taichi as ti

    ti.init(arch=ti.cpu if device == "cpu" else ti.cuda, offline_cache=False, log_level=ti.WARN)
    sand, substeps = material == "sand", int(MATERIALS[material]["substeps"])
    dx, inv, dt, gravity, volume = 1 / N, float(N), INTERVAL / substeps, 9.8, (0.5 / N) ** 2
    mass, bulk = volume * MATERIALS[material]["density"], BULK
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    sine = np.sin(np.radians(FRICTION_ANGLE))
    alpha = float(np.sqrt(2 / 3) * 2 * sine / (3 - sine))
    wall, friction = WALL, WALL_FRICTION if sand else 0.0
    x, v = ti.Vector.field(2, ti.f32, particles), ti.Vector.field(2, ti.f32, particles)
    C, F, J = (
        ti.Matrix.field(2, 2, ti.f32, particles),
        ti.Matrix.field(2, 2, ti.f32, particles),
        ti.field(ti.f32, particles),
    )
    velocity, node_mass = ti.Vector.field(2, ti.f32, (N, N)), ti.field(ti.f32, (N, N))

    @ti.kernel
    def start():  # type: ignore[no-untyped-def]
        for p in x:
            C[p], F[p], J[p] = ti.zero(C[p]), ti.Matrix.identity(ti.f32, 2), 1.0

    @ti.func
    def sand_stress(p):  # type: ignore[no-untyped-def]
        U, S, V = ti.svd((ti.Matrix.identity(ti.f32, 2) + dt * C[p]) @ F[p])
        strain = ti.Vector([ti.log(ti.max(S[0, 0], 1e-4)), ti.log(ti.max(S[1, 1], 1e-4))])
        mean = strain.sum()
        deviator = strain - mean / 2
        size = deviator.norm() + 1e-20
        if mean > 0:
            strain = ti.Vector([0.0, 0.0])
        else:
            excess = size + (lam + mu) / mu * mean * alpha
            if excess > 0:
                strain -= excess / size * deviator
        F[p] = U @ ti.Matrix([[ti.exp(strain[0]), 0.0], [0.0, ti.exp(strain[1])]]) @ V.transpose()
        tau = 2 * mu * strain + lam * strain.sum()
        return U @ ti.Matrix([[tau[0], 0.0], [0.0, tau[1]]]) @ U.transpose()

    @ti.kernel
    def step():  # type: ignore[no-untyped-def]
        for i in ti.grouped(node_mass):
            velocity[i] = ti.zero(velocity[i])
            node_mass[i] = 0
        for p in x:
            position = x[p] * inv
            base = ti.cast(position - 0.5, ti.i32)
            fx = position - base
            weights = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            tau = ti.Matrix.identity(ti.f32, 2)
            if ti.static(sand):
                tau = sand_stress(p)
            else:
                J[p] *= 1 + dt * C[p].trace()
                tau *= bulk * (J[p] - 1) * J[p]
            A = mass * C[p] - dt * volume * 4 * inv * inv * tau
            for o in ti.static(ti.grouped(ti.ndrange(3, 3))):
                weight = weights[o[0]][0] * weights[o[1]][1]
                velocity[base + o] += weight * (mass * v[p] + A @ ((o - fx) * dx))
                node_mass[base + o] += weight * mass
        for i in ti.grouped(node_mass):
            if node_mass[i] > 0:
                u = velocity[i] / node_mass[i]
                u[1] -= dt * gravity
                for k in ti.static(range(2)):
                    into = 0.0
                    if i[k] <= wall and u[k] < 0:
                        into = -u[k]
                    if i[k] >= N - wall and u[k] > 0:
                        into = u[k]
                    if into > 0:
                        u[k] = 0
                        along = u[1 - k]
                        u[1 - k] = ti.math.sign(along) * ti.max(ti.abs(along) - friction * into, 0)
                velocity[i] = u
        for p in x:
            position = x[p] * inv
            base = ti.cast(position - 0.5, ti.i32)
            fx = position - base
            weights = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            new_v, new_C = ti.zero(v[p]), ti.zero(C[p])
            for o in ti.static(ti.grouped(ti.ndrange(3, 3))):
                weight = weights[o[0]][0] * weights[o[1]][1]
                g = velocity[base + o]
                new_v += weight * g
                new_C += 4 * inv * weight * g.outer_product(o - fx)
            v[p] = new_v
            C[p] = new_C
            x[p] += dt * new_v

    return step, x, v, start


def scene(rng: np.random.Generator, particles: int) -> np.ndarray:
    """A square block of about 4 particles per cell somewhere in the box, [P, 2] [m]."""
    side = np.sqrt(particles) * 0.5 / N
    corner = 0.12 + rng.random(2) * (0.88 - 0.12 - side)
    return (corner + side * rng.random((particles, 2))).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("material", choices=sorted(MATERIALS))
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=101)
    parser.add_argument("--scenes", type=int, default=4)
    arguments = parser.parse_args()
    rng, seconds = np.random.default_rng(0), []
    step, x, v, start = program(arguments.material, arguments.device, arguments.particles)
    with tempfile.TemporaryDirectory() as folder:
        for number in range(arguments.scenes):
            positions, speed = scene(rng, arguments.particles), rng.uniform(-1.5, 1.5, 2)
            begin = time.perf_counter()
            x.from_numpy(positions)
            v.from_numpy(np.tile(speed.astype(np.float32), (arguments.particles, 1)))
            start()
            recorded = np.empty((arguments.frames, arguments.particles, 2), np.float32)
            recorded[0] = positions
            for frame in range(1, arguments.frames):
                for _ in range(int(MATERIALS[arguments.material]["substeps"])):
                    step()
                recorded[frame] = x.to_numpy()
            np.savez(Path(folder) / f"{number}.npz", position=recorded)
            seconds.append((time.perf_counter() - begin) / (arguments.frames - 1))
    assert np.isfinite(recorded).all() and recorded.min() > 0.09 and recorded.max() < 0.91
    print(json.dumps({**vars(arguments), "s_per_frame": float(np.median(seconds[1:]))}))


if __name__ == "__main__":
    main()
