"""The step of `step_peer_warp.py` with conduction of heat, in Warp: the substep of torch_mpm/heat/heat.py, hybrid.

P2G of temperature and its gradient, the implicit solve and G2P on the same dense grid, with atomic adds. The solve of
(M/dt + H) d = −H θ is by conjugate gradients without a matrix, preconditioned by M/dt. It has a fixed number of
iterations, so that the host reads nothing. In units of M/dt the spectrum lies between 1 and 1 + 4 r (csrc/heat/cell.h),
r being the diffusion number, and k iterations leave at most 2 r^k of the error (Saad 2003, section 6.11.3). At that of
`work.py` ITERATIONS is the least number that meets the tolerance of `torch_mpm.Heat`. The figures have the residual
after the last step.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from . import step_peer_warp, work
from .step_peer_warp import Cube
from .work import DT, SPECIFIC_HEAT

ITERATIONS = 2
"""2 DIFFUSION² is below 1e-6."""


class Kernels(NamedTuple):
    to_nodes: Any
    means: Any
    product: Any
    start: Any
    update: Any
    direct: Any
    to_particles: Any


@functools.cache
def kernels() -> Kernels:
    """In the order of a step: P2G; averages of nodes; H u; start, update and direction of the solve; G2P."""
    import warp as wp

    weight = step_peer_warp.kernels().weight

    @wp.kernel(enable_backward=False)
    def to_nodes(
        x: wp.array(dtype=wp.vec3), C: wp.array(dtype=wp.mat33), F: wp.array(dtype=wp.mat33),
        theta: wp.array(dtype=float), gradient: wp.array(dtype=wp.vec3),
        conductance: wp.array(dtype=float), blend: wp.array(dtype=float), sums: wp.array(dtype=wp.vec4),
        ny: int, nz: int, inv: float, dt: float, capacity: float, volume: float, conductivity: float,
    ):  # fmt: skip
        p = wp.tid()
        position = x[p] * inv
        i0, j0, k0 = int(position[0] - 0.5), int(position[1] - 0.5), int(position[2] - 0.5)
        fx = position - wp.vec3(float(i0), float(j0), float(k0))
        through = conductivity * volume * wp.determinant(F[p])
        strain = 0.5 * (C[p] + wp.transpose(C[p]))
        beta = wp.min(1.0, 4.0 * dt * through * inv * inv / capacity + dt * wp.sqrt(wp.ddot(strain, strain)))
        conductance[p] = through
        blend[p] = beta
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    offset = (wp.vec3(float(i), float(j), float(k)) - fx) / inv
                    N = weight(fx[0], i) * weight(fx[1], j) * weight(fx[2], k)
                    warm = theta[p] + wp.dot(gradient[p], offset)
                    row = ((i0 + i) * ny + j0 + j) * nz + k0 + k
                    wp.atomic_add(sums, row, N * capacity * wp.vec4(1.0, beta, warm, beta * warm))

    @wp.kernel(enable_backward=False)
    def means(sums: wp.array(dtype=wp.vec4), node_theta: wp.array(dtype=float)):
        i = wp.tid()
        s = sums[i]
        start = 0.0
        smooth = 0.0
        if s[0] > 0.0:
            start = s[2] / s[0]
        if s[1] > 0.0:
            smooth = s[3] / s[1]
        node_theta[i] = start
        sums[i] = wp.vec4(s[0], s[1], start, smooth)

    @wp.kernel(enable_backward=False)
    def product(
        x: wp.array(dtype=wp.vec3), conductance: wp.array(dtype=float), u: wp.array(dtype=float),
        Hu: wp.array(dtype=float), ny: int, nz: int, inv: float,
    ):  # fmt: skip
        p = wp.tid()
        position = x[p] * inv
        i0, j0, k0 = int(position[0] - 0.5), int(position[1] - 0.5), int(position[2] - 0.5)
        fx = position - wp.vec3(float(i0), float(j0), float(k0))
        flux = wp.vec3()
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    N = weight(fx[0], i) * weight(fx[1], j) * weight(fx[2], k)
                    slope = (wp.vec3(float(i), float(j), float(k)) - fx) * (N * 4.0 * inv)
                    flux += slope * u[((i0 + i) * ny + j0 + j) * nz + k0 + k]
        flux = flux * conductance[p]
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    N = weight(fx[0], i) * weight(fx[1], j) * weight(fx[2], k)
                    slope = (wp.vec3(float(i), float(j), float(k)) - fx) * (N * 4.0 * inv)
                    wp.atomic_add(Hu, ((i0 + i) * ny + j0 + j) * nz + k0 + k, wp.dot(slope, flux))

    @wp.kernel(enable_backward=False)
    def start(
        sums: wp.array(dtype=wp.vec4), dt: float, Ap: wp.array(dtype=float),
        r: wp.array(dtype=float), z: wp.array(dtype=float), p: wp.array(dtype=float), d: wp.array(dtype=float),
    ):  # fmt: skip
        i = wp.tid()
        residual = -Ap[i]
        direction = 0.0
        if sums[i][0] > 0.0:
            direction = residual * dt / sums[i][0]
        r[i] = residual
        z[i] = direction
        p[i] = direction
        Ap[i] = residual
        d[i] = 0.0

    @wp.kernel(enable_backward=False)
    def update(
        sums: wp.array(dtype=wp.vec4), dt: float, rz: wp.array(dtype=float), pAp: wp.array(dtype=float),
        Ap: wp.array(dtype=float), r: wp.array(dtype=float), z: wp.array(dtype=float), p: wp.array(dtype=float),
        d: wp.array(dtype=float),
    ):  # fmt: skip
        i = wp.tid()
        if sums[i][0] > 0.0 and pAp[0] > 0.0:
            alpha = rz[0] / pAp[0]
            residual = r[i] - alpha * Ap[i]
            d[i] = d[i] + alpha * p[i]
            r[i] = residual
            z[i] = residual * dt / sums[i][0]

    @wp.kernel(enable_backward=False)
    def direct(
        sums: wp.array(dtype=wp.vec4), dt: float, rz_before: wp.array(dtype=float), rz: wp.array(dtype=float),
        Ap: wp.array(dtype=float), z: wp.array(dtype=float), p: wp.array(dtype=float),
    ):  # fmt: skip
        i = wp.tid()
        direction = z[i]
        if rz_before[0] > 0.0:
            direction += rz[0] / rz_before[0] * p[i]
        p[i] = direction
        Ap[i] = sums[i][0] / dt * direction

    @wp.kernel(enable_backward=False)
    def to_particles(
        x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), C: wp.array(dtype=wp.mat33),
        blend: wp.array(dtype=float), sums: wp.array(dtype=wp.vec4), d: wp.array(dtype=float),
        ny: int, nz: int, inv: float, dt: float,
        theta: wp.array(dtype=float), gradient: wp.array(dtype=wp.vec3),
    ):  # fmt: skip
        p = wp.tid()
        position = x[p] * inv
        i0, j0, k0 = int(position[0] - 0.5), int(position[1] - 0.5), int(position[2] - 0.5)
        fx = position - wp.vec3(float(i0), float(j0), float(k0))
        value = wp.vec2()  # of the increment and of the average of the nodes
        slope = wp.vec3()
        smooth_slope = wp.vec3()
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    N = weight(fx[0], i) * weight(fx[1], j) * weight(fx[2], k)
                    arm = (wp.vec3(float(i), float(j), float(k)) - fx) * (N * 4.0 * inv)
                    row = ((i0 + i) * ny + j0 + j) * nz + k0 + k
                    value += N * wp.vec2(d[row], sums[row][3])
                    slope += arm * d[row]
                    smooth_slope += arm * sums[row][3]
        beta = blend[p]
        theta[p] = theta[p] + value[0] + beta * (value[1] - theta[p])
        g = gradient[p] + slope + beta * (smooth_slope - gradient[p])
        turned = dt * (wp.transpose(C[p]) * g)
        gradient[p] = g - turned + dt * (wp.transpose(C[p]) * turned)
        x[p] = x[p] + dt * v[p]

    return Kernels(to_nodes, means, product, start, update, direct, to_particles)


class HeatedCube(Cube):
    """A cube whose particles conduct, with a number of iterations of each solve."""

    def __init__(self, w: work.Work, device: str, diffusion: float, iterations: int) -> None:
        import warp as wp

        super().__init__(w, device)
        kernels()
        self.conductivity, self.iterations = work.conductivity(1 / w.n, diffusion), iterations
        self.theta = wp.array(work.temperature(w.x), dtype=float, device=device)
        self.gradient = wp.array(work.temperature_gradient(w.x), dtype=wp.vec3, device=device)
        self.conductance, self.blend = (wp.zeros(w.particles, dtype=float, device=device) for _ in range(2))
        self.nodes = int(np.prod(w.cells))
        self.sums = wp.zeros(self.nodes, dtype=wp.vec4, device=device)
        node_values = (wp.zeros(self.nodes, dtype=float, device=device) for _ in range(6))
        self.node_theta, self.Ap, self.r, self.z, self.p, self.d = node_values
        self.rz = [wp.zeros(1, dtype=float, device=device) for _ in range(iterations + 1)]
        self.pAp = wp.zeros(1, dtype=float, device=device)

    def moving(self) -> list[Any]:
        return [*super().moving(), self.theta, self.gradient]

    def launch(self) -> None:
        """A step. Particles move after their heat, which is conducted between their positions before the step."""
        import warp as wp

        w, k, device = self.w, kernels(), self.device
        rows = [*w.cells[1:], self.inv]
        self.to_nodes()
        self.to_particles(0.0)
        self.sums.zero_()
        particles = [self.x, self.C, self.F, self.theta, self.gradient, self.conductance, self.blend, self.sums]
        numbers = [DT, w.mass * SPECIFIC_HEAT, w.volume, self.conductivity]
        wp.launch(k.to_nodes, w.particles, [*particles, *rows, *numbers], device=device)
        wp.launch(k.means, self.nodes, [self.sums, self.node_theta], device=device)
        self.solve()
        given = [self.x, self.v, self.C, self.blend, self.sums, self.d, *rows, DT]
        wp.launch(k.to_particles, w.particles, [*given, self.theta, self.gradient], device=device)

    def solve(self) -> None:
        """Increments d of the node temperatures; `rz` becomes Σ r²/M dt before the first and after each iteration."""
        import warp as wp
        from warp.utils import array_inner

        k, device = kernels(), self.device
        vectors = [self.Ap, self.r, self.z, self.p]
        self.Ap.zero_()
        self.apply(self.node_theta)
        wp.launch(k.start, self.nodes, [self.sums, DT, *vectors, self.d], device=device)
        array_inner(self.r, self.z, out=self.rz[0])
        for i in range(self.iterations):
            if i > 0:
                given = [self.sums, DT, self.rz[i - 1], self.rz[i], self.Ap, self.z, self.p]
                wp.launch(k.direct, self.nodes, given, device=device)
            self.apply(self.p)
            array_inner(self.p, self.Ap, out=self.pAp)
            given = [self.sums, DT, self.rz[i], self.pAp, *vectors, self.d]
            wp.launch(k.update, self.nodes, given, device=device)
            array_inner(self.r, self.z, out=self.rz[i + 1])

    def apply(self, u: Any) -> None:
        """Ap += H u."""
        import warp as wp

        given = [self.x, self.conductance, u, self.Ap, *self.w.cells[1:], self.inv]
        wp.launch(kernels().product, self.w.particles, given, device=self.device)

    def fields(self) -> dict[str, np.ndarray]:
        heat = {"temperature": self.theta.numpy(), "temperature_gradient": self.gradient.numpy()}
        return super().fields() | heat

    def figures(self) -> dict[str, float]:
        """Iterations of each solve, and the residual of the latest one relative to its first."""
        first, last = (float(self.rz[i].numpy()[0]) for i in (0, -1))
        return {"iterations": self.iterations, "residual": math.sqrt(last / first) if first > 0 else 0.0}


def program(w: work.Work, device: str, diffusion: float = work.DIFFUSION, iterations: int = ITERATIONS) -> work.Program:
    import warp as wp

    cube = HeatedCube(w, device, diffusion, iterations)
    step = step_peer_warp.replayed(cube.launch, cube.moving(), device)
    return work.Program(step, wp.synchronize, cube.fields, cube.figures)
