"""The step of `peers.py` in Warp: its kernels, the arrays of a cube, and the replay of a CUDA graph.

MLS-MPM with APIC on a dense grid: F update, neo-Hookean stress and P2G in one kernel with atomic adds; grid update; G2P
and advection in one kernel.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .work import DT, GRAVITY, LAM, MU, Program, Work


class Kernels(NamedTuple):
    """The weight of a node, a function; P2G, the update of the grid, and G2P."""

    weight: Any
    p2g: Any
    update: Any
    g2p: Any


@functools.cache
def kernels() -> Kernels:
    import warp as wp

    wp.config.quiet = True
    wp.init()

    @wp.func
    def weight(fx: float, i: int):
        result = 0.5 * (1.5 - fx) * (1.5 - fx)
        if i == 1:
            result = 0.75 - (fx - 1.0) * (fx - 1.0)
        if i == 2:
            result = 0.5 * (fx - 0.5) * (fx - 0.5)
        return result

    @wp.kernel(enable_backward=False)
    def p2g(
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
    def update(
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
    def g2p(
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

    return Kernels(weight, p2g, update, g2p)


class Cube:
    """The particles of a work, its grid, and the launches of a step, on a device of Warp."""

    def __init__(self, w: Work, device: str) -> None:
        import warp as wp

        kernels()
        self.w, self.device, self.inv = w, device, float(w.n)
        self.x, self.v = (wp.array(a, dtype=wp.vec3, device=device) for a in (w.x, w.v))
        self.C = wp.zeros(w.particles, dtype=wp.mat33, device=device)
        eyes = np.tile(np.eye(3, dtype=np.float32), (w.particles, 1, 1))
        self.F = wp.array(eyes, dtype=wp.mat33, device=device)
        self.momentum = wp.zeros(w.cells, dtype=wp.vec3, device=device)
        self.mass = wp.zeros(w.cells, dtype=float, device=device)

    def moving(self) -> list[Any]:
        """Arrays that a step changes and the next one reads."""
        return [self.x, self.v, self.C, self.F]

    def to_nodes(self) -> None:
        import warp as wp

        self.momentum.zero_()
        self.mass.zero_()
        particles, nodes = [self.x, self.v, self.C, self.F], [self.momentum, self.mass]
        numbers = [self.inv, DT, self.w.mass, self.w.volume, MU, LAM]
        wp.launch(kernels().p2g, self.w.particles, [*particles, *nodes, *numbers], device=self.device)
        wp.launch(kernels().update, self.w.cells, [*nodes, *self.w.cells, DT * GRAVITY], device=self.device)

    def to_particles(self, dt: float) -> None:
        """Velocities and affine fields; positions after dt."""
        import warp as wp

        given = [self.x, self.v, self.C, self.momentum, self.inv, dt]
        wp.launch(kernels().g2p, self.w.particles, given, device=self.device)

    def fields(self) -> dict[str, np.ndarray]:
        return {"x": self.x.numpy(), "v": self.v.numpy()}


def replayed(launch: Callable[[], None], moving: Sequence[Any], device: str) -> Callable[[], None]:
    """The launches of a step, which changes the arrays `moving`: by a CUDA graph on a GPU, whose attribute `launch` has
    those from Python.
    """
    import warp as wp

    if device == "cpu":
        return launch
    start = [wp.clone(array) for array in moving]
    launch()  # Compiles, which a capture must not.
    for array, initial in zip(moving, start, strict=True):
        wp.copy(array, initial)
    with wp.ScopedCapture(device=device) as capture:
        launch()

    def step() -> None:
        wp.capture_launch(capture.graph)

    step.launch = launch  # type: ignore[attr-defined]  # `--launches`; keeps the arrays, which the graph does not
    return step


def program(w: Work, device: str) -> Program:
    import warp as wp

    cube = Cube(w, device)

    def launch() -> None:
        cube.to_nodes()
        cube.to_particles(DT)

    return Program(replayed(launch, cube.moving(), device), wp.synchronize, cube.fields)
