"""A step of MPM by kernels of Warp inside an autograd Function, as in simulators for networks.

The algorithm is that of NCLaw (Ma et al. 2023): the stress is given, transfers are MLS-MPM with APIC on a dense grid by
atomic adds, F is updated by C, and the backward pass reruns the kernels, on a tape. Arrays are tensors of torch, so
that its allocator measures the memory.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


@functools.cache
def kernels() -> tuple[Any, Any, Any]:
    """P2G, the update of the grid, and G2P."""
    import warp as wp

    wp.config.quiet = True
    wp.init()

    @wp.func
    def weight(f: float, i: int):
        result = 0.5 * (1.5 - f) * (1.5 - f)
        if i == 1:
            result = 0.75 - (f - 1.0) * (f - 1.0)
        if i == 2:
            result = 0.5 * (f - 0.5) * (f - 0.5)
        return result

    @wp.kernel
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
        A = mass * C[p] - dt * volume * 4.0 * inv * inv * stress[p]
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    arm = (wp.vec3(float(i), float(j), float(k)) - f) / inv
                    N = weight(f[0], i) * weight(f[1], j) * weight(f[2], k)
                    wp.atomic_add(momentum, i0 + i, j0 + j, k0 + k, N * (mass * v[p] + A * arm))
                    wp.atomic_add(node_mass, i0 + i, j0 + j, k0 + k, N * mass)

    @wp.kernel
    def update(
        momentum: wp.array(dtype=wp.vec3, ndim=3), node_mass: wp.array(dtype=float, ndim=3), change: wp.vec3,
        velocity: wp.array(dtype=wp.vec3, ndim=3),
    ):  # fmt: skip
        i, j, k = wp.tid()
        if node_mass[i, j, k] > 0.0:
            velocity[i, j, k] = momentum[i, j, k] / node_mass[i, j, k] + change

    @wp.kernel
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
        u = wp.vec3()
        B = wp.mat33()
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    arm = wp.vec3(float(i), float(j), float(k)) - f
                    N = weight(f[0], i) * weight(f[1], j) * weight(f[2], k)
                    g = velocity[i0 + i, j0 + j, k0 + k]
                    u = u + N * g
                    B = B + wp.outer(g, arm) * (N * 4.0 * inv)
        new_v[p] = u
        new_C[p] = B
        new_F[p] = F[p] + dt * B * F[p]
        new_x[p] = x[p] + dt * u

    return p2g, update, g2p


class WarpSolver:
    """Steps of particles of one mass [kg] and volume [m³] in the unit cube with n³ nodes; gravity [m/s²], dt [s]."""

    def __init__(self, n: int, mass: float, volume: float, gravity: Sequence[float], dt: float) -> None:
        self.n, self.mass, self.volume, self.dt = n, mass, volume, dt
        self.change = [dt * g for g in gravity]

    def __call__(self, *particles: Tensor) -> tuple[Tensor, ...]:
        """x, v, C and F a step later, of x, v [P, 3], C, F and the Kirchhoff stress [P, 3, 3] [Pa], all float32."""
        results: tuple[Tensor, ...] = _Step.apply(self, *particles)
        return results

    def launch(self, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        """Kernels, with separate nodes; arrays of Warp."""
        import warp as wp

        p2g, update, g2p = kernels()
        x, v, C, F, stress = inputs
        n, inv, device, recorded = self.n, float(self.n), x.device, x.requires_grad
        like = wp.device_to_torch(device)
        momentum, velocity = (_array(torch.zeros(n, n, n, 3, device=like), wp.vec3, recorded) for _ in range(2))
        node_mass = _array(torch.zeros(n, n, n, device=like), wp.float32, recorded)
        given = [x, v, C, stress, inv, self.dt, self.mass, self.volume]
        wp.launch(p2g, len(x), given, [momentum, node_mass], device=device)
        wp.launch(update, (n, n, n), [momentum, node_mass, wp.vec3(*self.change)], [velocity], device=device)
        wp.launch(g2p, len(x), [x, F, velocity, inv, self.dt], outputs, device=device)


def _array(t: Tensor, kind: Any, recorded: bool) -> Any:
    """A tensor as an array of Warp, with a gradient of torch where it is recorded."""
    import warp as wp

    grad = wp.from_torch(torch.zeros_like(t), dtype=kind) if recorded else None
    return wp.from_torch(t, dtype=kind, requires_grad=recorded, grad=grad)


def arrays(tensors: Sequence[Tensor], recorded: bool) -> list[Any]:
    """Vectors [P, 3] and matrices [P, 3, 3] as arrays of Warp."""
    import warp as wp

    return [_array(t.detach().contiguous(), wp.vec3 if t.dim() == 2 else wp.mat33, recorded) for t in tensors]


def stream_of(like: Tensor) -> contextlib.AbstractContextManager[Any]:
    """Context in which Warp works on the stream of torch."""
    import warp as wp

    if not like.is_cuda:
        return contextlib.nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(like.device)))


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, solver: WarpSolver, *inputs: Tensor) -> tuple[Tensor, ...]:
        kernels()
        outputs = tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs[:4])
        with stream_of(inputs[0]):
            solver.launch(arrays(inputs, False), arrays(outputs, False))
        ctx.solver = solver
        ctx.save_for_backward(*inputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        import warp as wp

        saved = ctx.saved_tensors
        with stream_of(saved[0]):
            inputs = arrays(saved, True)
            outputs = arrays([torch.empty_like(g) for g in grads], True)
            with wp.Tape() as tape:
                ctx.solver.launch(inputs, outputs)
            tape.backward(grads=dict(zip(outputs, arrays(grads, False), strict=True)))
        return None, *(wp.to_torch(array.grad) for array in inputs)
