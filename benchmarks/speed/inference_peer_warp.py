"""Substeps of MPM by kernels of Warp without gradients, as in simulators that move Gaussians.

The algorithm is that of PhysGaussian (Xie et al. 2024) for its "jelly": fixed corotated stress of a decomposition, P2G
by the gradient of quadratic B-splines with APIC and atomic adds onto a dense grid, F updated by ∇v; a launch for each.
Arrays are tensors of torch, so that its allocator measures the memory.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .training_peer_warp import arrays, stream_of


@functools.cache
def kernels() -> tuple[Any, Any, Any, Any]:
    """Stress, P2G, the update of the grid, and G2P."""
    import warp as wp

    wp.config.quiet = True
    wp.init()

    @wp.func
    def weights(f: float):
        return wp.vec3(0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5))

    @wp.func
    def slopes(f: float):
        return wp.vec3(f - 1.5, -2.0 * (f - 1.0), f - 0.5)

    @wp.kernel(enable_backward=False)
    def corotated(
        F: wp.array(dtype=wp.mat33), mu: float, lam: float, stress: wp.array(dtype=wp.mat33)
    ):  # fmt: skip
        p = wp.tid()
        U, s, V = wp.svd3(F[p])
        J = s[0] * s[1] * s[2]
        R = U * wp.transpose(V)
        stress[p] = 2.0 * mu * (F[p] - R) * wp.transpose(F[p]) + lam * J * (J - 1.0) * wp.identity(n=3, dtype=float)

    @wp.kernel(enable_backward=False)
    def p2g(
        x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
        C: wp.array(dtype=wp.mat33), stress: wp.array(dtype=wp.mat33),
        inv: float, dt: float, mass: float, volume: float,
        momentum: wp.array(dtype=wp.vec3, ndim=3), node_mass: wp.array(dtype=float, ndim=3),
    ):  # fmt: skip
        p = wp.tid()
        position = x[p] * inv
        i0, j0, k0 = int(position[0] - 0.5), int(position[1] - 0.5), int(position[2] - 0.5)
        f = position - wp.vec3(float(i0), float(j0), float(k0))
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx, dy, dz = slopes(f[0]), slopes(f[1]), slopes(f[2])
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    arm = (wp.vec3(float(i), float(j), float(k)) - f) / inv
                    N = wx[i] * wy[j] * wz[k]
                    gradient = wp.vec3(dx[i] * wy[j] * wz[k], wx[i] * dy[j] * wz[k], wx[i] * wy[j] * dz[k]) * inv
                    added = N * mass * (v[p] + C[p] * arm) - dt * volume * (stress[p] * gradient)
                    wp.atomic_add(momentum, i0 + i, j0 + j, k0 + k, added)
                    wp.atomic_add(node_mass, i0 + i, j0 + j, k0 + k, N * mass)

    @wp.kernel(enable_backward=False)
    def update(
        momentum: wp.array(dtype=wp.vec3, ndim=3), node_mass: wp.array(dtype=float, ndim=3), change: wp.vec3,
        velocity: wp.array(dtype=wp.vec3, ndim=3),
    ):  # fmt: skip
        i, j, k = wp.tid()
        if node_mass[i, j, k] > 0.0:
            velocity[i, j, k] = momentum[i, j, k] / node_mass[i, j, k] + change

    @wp.kernel(enable_backward=False)
    def g2p(
        x: wp.array(dtype=wp.vec3), F: wp.array(dtype=wp.mat33), velocity: wp.array(dtype=wp.vec3, ndim=3),
        inv: float, dt: float,
        new_x: wp.array(dtype=wp.vec3), new_v: wp.array(dtype=wp.vec3),
        new_C: wp.array(dtype=wp.mat33), new_F: wp.array(dtype=wp.mat33),
    ):  # fmt: skip
        p = wp.tid()
        position = x[p] * inv
        i0, j0, k0 = int(position[0] - 0.5), int(position[1] - 0.5), int(position[2] - 0.5)
        f = position - wp.vec3(float(i0), float(j0), float(k0))
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx, dy, dz = slopes(f[0]), slopes(f[1]), slopes(f[2])
        u = wp.vec3()
        B = wp.mat33()
        grad = wp.mat33()
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    arm = wp.vec3(float(i), float(j), float(k)) - f
                    N = wx[i] * wy[j] * wz[k]
                    gradient = wp.vec3(dx[i] * wy[j] * wz[k], wx[i] * dy[j] * wz[k], wx[i] * wy[j] * dz[k]) * inv
                    g = velocity[i0 + i, j0 + j, k0 + k]
                    u += N * g
                    B += wp.outer(g, arm) * (N * 4.0 * inv)
                    grad += wp.outer(g, gradient)
        new_v[p] = u
        new_C[p] = B
        new_F[p] = F[p] + dt * grad * F[p]
        new_x[p] = x[p] + dt * u

    return corotated, p2g, update, g2p


class WarpSimulator:
    """Substeps of particles of one mass [kg] and volume [m³] in the unit cube with n³ nodes; moduli [Pa], dt [s]."""

    def __init__(
        self, n: int, mass: float, volume: float, mu: float, lam: float, gravity: Sequence[float], dt: float
    ) -> None:
        self.n, self.mass, self.volume, self.mu, self.lam, self.dt = n, mass, volume, mu, lam, dt
        self.change = [dt * g for g in gravity]

    def __call__(self, *particles: Tensor) -> tuple[Tensor, ...]:
        """x, v [P, 3], C and F [P, 3, 3] a substep later, float32."""
        import warp as wp

        corotated, p2g, update, g2p = kernels()
        after = tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in particles)
        n, P, inv = self.n, len(after[0]), float(self.n)
        like = particles[0]
        with stream_of(like):
            x, v, C, F = arrays(particles, False)
            (stress,) = arrays([torch.empty_like(after[3])], False)
            momentum, velocity = (wp.from_torch(like.new_zeros(n, n, n, 3), dtype=wp.vec3) for _ in range(2))
            node_mass = wp.from_torch(like.new_zeros(n, n, n), dtype=wp.float32)
            where = x.device
            wp.launch(corotated, P, [F, self.mu, self.lam], [stress], device=where)
            given = [x, v, C, stress, inv, self.dt, self.mass, self.volume]
            wp.launch(p2g, P, given, [momentum, node_mass], device=where)
            wp.launch(update, (n, n, n), [momentum, node_mass, wp.vec3(*self.change)], [velocity], device=where)
            wp.launch(g2p, P, [x, F, velocity, inv, self.dt], arrays(after, False), device=where)
        return after
