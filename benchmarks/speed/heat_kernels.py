"""Bytes, operations and times of each kernel of a substep with heat on CUDA, for the roofline.

The substep is that of the row `heat` of `thermal.py`: 3-D, float32, quadratic, one scene (csrc/rollout/heat_steps.h).

- Bytes: the fields of the particles that a kernel reads and writes, and the rows of node tensors: those of active
  blocks, or all of the pool where a kernel passes over them. A sum is read and written. Tables of blocks are left out.
- Operations: those of csrc at the particles; a fused one counts as two, a root or a logarithm as one. The nodes have
  fewer operations than words.
- Times: torch.profiler, of a kernel from the end of the one before, because kernels of a chain are launched early.
- Limits: the time in which as many bytes are copied or read (`timing.memory_ms`), and the time of as many operations of
  a matrix product in float32 without tensor cores.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import torch

import torch_mpm as mpm

from .. import common
from . import work
from .step import Setup
from .timing import Clock, float32_rate, memory_ms

D, SUPPORT = 3, 3
"""Dimension, and nodes of a support along an axis."""
STEPS = 2
"""Steps of a heat solve at `work.DIFFUSION`, each with a product: `simple_steps` of csrc/heat/solve.h."""
SUBSTEPS = 8
"""Of a profiled call; more are replayed from CUDA graphs. Its activations are among the other kernels."""
CALLS = 5
"""Profiled calls; the median is reported."""

SCALARS = (
    "index", "mass", "rest_volume", "volume", "theta", "conductance", "blend", "capacity", "mean", "product",
    "increment",
)  # fmt: skip
WORDS = dict.fromkeys(SCALARS, 1) | {
    "x": D, "v": D, "gradient": D, "C": D * D, "F": D * D, "packed": D + 1, "nodes": D + 1, "updated": D + 1, "sums": 4,
}  # fmt: skip
"""Words of 4 bytes of a field of the particles or of the nodes, by its name in csrc."""


# ---- operations of a particle


def weights() -> int:
    """B-spline weights of the nodes along each axis: a difference and two products of each node."""
    return 3 * SUPPORT * D


def gathered(channels: int) -> int:
    """Sums of values and first moments, one axis after another (csrc/transfer/gather.cuh, `sum_axis`)."""
    of_lines = sum(SUPPORT**axis * (2 * SUPPORT - 1) * (1 + D - axis) for axis in range(D))
    return weights() + 2 * SUPPORT * D + channels * of_lines


def scattered(plain: int, linear: int) -> int:
    """Contributions to the nodes, by a thread for each leading node (csrc/transfer/scatter.cuh, `add_particle`)."""
    of_weights = 3 * SUPPORT * (D - 1) + SUPPORT * (4 + 2 * (D - 1))
    of_plain = SUPPORT * (1 + SUPPORT * (1 + 2 * SUPPORT))
    of_linear = 2 * D + SUPPORT * (5 + SUPPORT * (3 + 3 * SUPPORT))
    return of_weights + plain * of_plain + linear * of_linear


def applied() -> int:
    """Product with H (csrc/heat/cell.h, `add_particle`)."""
    value, slope = 2 * (SUPPORT - 1), 2 * (SUPPORT - 2) + 1
    of_weights = weights() + D * (2 * SUPPORT - 1 + 2 * (SUPPORT - 3))
    gradient = (SUPPORT**2 + SUPPORT) * (value + slope) + SUPPORT * value + 2 * value + slope
    at_nodes = (SUPPORT**2 - 1) * (2 * SUPPORT - 1) + SUPPORT**2 * 2 * (SUPPORT - 1)
    at_lines = (SUPPORT - 1) * (4 * (SUPPORT - 1) + 2) + 3 * (SUPPORT - 1)
    return of_weights + gradient + at_nodes + at_lines + 3 * D


MATRIX_PRODUCT, DETERMINANT, MATRIX_VECTOR = D * D * (2 * D - 1), D * (D + 1) + D - 1, D * (2 * D - 1)
LAW = MATRIX_PRODUCT + DETERMINANT + 1 + 5 * D * D
"""E = F Fᵀ − I and ln J, μ E + λ ln J I."""
MOMENTUM = D + 1 + D * D + 3 + 2 * D * D
"""m v, and m dx C − dt V D⁻¹ dx⁻¹ τ."""
MOTION = D * D + 2 * D
"""C from its moments, and x + dt v."""
DEFORMATION = MATRIX_PRODUCT + 2 * D * D + DETERMINANT + 1
"""F + dt C F, and the present volume."""
STRAIN_RATE = 4 * D * D + 1
"""|sym ∇v|."""
HEAT_WEIGHTS = 9 + 3 * (1 + D) + D
"""Capacity, conductance, diffusion number and blend, and what they add to the nodes."""
HEAT_UPDATE = 4 * (1 + D) + 2 * D + 2 * (MATRIX_VECTOR + D) + 2 * D
"""The blend of increment and average, and the transport of the gradient."""


# ---- kernels

PRODUCTS = "theta capacity product product capacity product product product"
"""Values of the nodes of active blocks that the products of the STEPS read and write: H θ, and H d."""


@dataclasses.dataclass(frozen=True)
class Size:
    """Number of particles, of nodes of active blocks, and of nodes of the pool."""

    particles: int
    active: int
    pool: int


@dataclasses.dataclass(frozen=True)
class Kernel:
    """A phase of a substep: parts of the names of its kernels, the fields of particles and nodes that they read and
    write, as often as they do, and the operations of a particle.
    """

    name: str
    symbols: tuple[str, ...]
    particles: str = ""
    active: str = ""
    pool: str = ""
    operations: int = 0

    def bytes(self, size: Size) -> int:
        fields = ((self.particles, size.particles), (self.active, size.active), (self.pool, size.pool))
        return 4 * sum(rows * sum(WORDS[name] for name in names.split()) for names, rows in fields)


KERNELS = (
    Kernel(
        "law and P2G", ("ReorderingSource",), "index x mass rest_volume v C F F volume", "nodes nodes",
        operations=DEFORMATION + LAW + MOMENTUM + scattered(1, D),
    ),
    Kernel("grid update", ("next_grid_kernel",), "", "nodes updated nodes"),
    Kernel(
        "G2P and P2G of heat", ("HeatAdvance",),
        "index x mass theta gradient volume v C x conductance blend packed",
        "updated sums sums",
        operations=gathered(D) + MOTION + STRAIN_RATE + HEAT_WEIGHTS + scattered(2, 2),
    ),
    Kernel("products with H", ("product_kernel",), " ".join(["packed"] * STEPS), PRODUCTS, "", STEPS * applied()),
    Kernel(
        "increments of the nodes", ("HeatFinishArguments",), "", "sums product product increment mean",
        "sums product product product",
    ),
    Kernel(
        "G2P of heat", ("HeatGather",), "index x C blend theta gradient theta gradient", "increment mean",
        operations=gathered(2) + HEAT_UPDATE,
    ),
)  # fmt: skip
"""In the order of their first launch in a substep."""


def kernel_of(name: str) -> Kernel | None:
    """The phase of a kernel by its name in a profile; None for those of a call."""
    return next((kernel for kernel in KERNELS if any(symbol in name for symbol in kernel.symbols)), None)


# ---- times


def own_times(spans: Iterable[tuple[str, float, float]]) -> Iterator[tuple[str, float]]:
    """Name and time of each kernel after the end of all before it, of (name, begin, end)."""
    busy = float("-inf")
    for name, begin, end in sorted(spans, key=lambda span: span[1]):
        yield name, max(0.0, end - max(begin, busy))
        busy = max(busy, end)


def profiled(s: Setup, state: mpm.State) -> list[tuple[str, float]]:
    """Kernels of a call of SUBSTEPS on CUDA, with their own times [us]."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        mpm.rollout(s.step, state, SUBSTEPS, work.DT)
        torch.cuda.synchronize()
    device = torch.autograd.DeviceType.CUDA
    events = [event for event in profile.events() if event.device_type == device]
    return list(own_times((e.name, e.time_range.start, e.time_range.end) for e in events))


def by_kernel(times: Iterable[tuple[str, float]]) -> dict[str, tuple[float, float]]:
    """Launches and time of a substep of each phase [us], and of "others" of the call.

    Raises:
        RuntimeError: for a phase without kernels, whose names have changed then.
    """
    found = {name: (0.0, 0.0) for name in (*(kernel.name for kernel in KERNELS), "others")}
    for name, us in times:
        kernel = kernel_of(name)
        key = kernel.name if kernel else "others"
        launches, sum_of_us = found[key]
        found[key] = launches + 1 / SUBSTEPS, sum_of_us + us / SUBSTEPS
    if absent := [kernel.name for kernel in KERNELS if not found[kernel.name][0]]:
        raise RuntimeError(f"the profile must have kernels of every phase, got none of: {', '.join(absent)}")
    return found


def size_of(s: Setup, state: mpm.State) -> Size:
    blocks = s.grid.activate(state.x)
    return Size(len(state), int(blocks.active_nodes().sum()), blocks.node_count)


def measure(s: Setup, clock: Clock) -> dict[str, Any]:
    """Parts of a substep in the form of `step.py`, for `roofline`."""
    state = s.state.sorted(s.grid)
    with torch.no_grad():
        mpm.rollout(s.step, state, SUBSTEPS, work.DT)
        calls = [by_kernel(profiled(s, state)) for _ in range(CALLS)]
    size = size_of(s, state)

    def median(name: str, column: int) -> float:
        return sorted(call[name][column] for call in calls)[CALLS // 2]

    with clock:
        rate = float32_rate(clock)
        parts = [
            {
                "name": kernel.name,
                "launches": median(kernel.name, 0),
                "ms": median(kernel.name, 1) * 1e-3,
                "bytes": kernel.bytes(size),
                "operations": kernel.operations * size.particles,
                "memory_ms": memory_ms(clock, kernel.bytes(size)),
                "arithmetic_ms": kernel.operations * size.particles / rate * 1e3,
            }
            for kernel in KERNELS
        ]
    return {**dataclasses.asdict(size), "rate": rate, "parts": parts, "others_ms": median("others", 1) * 1e-3}


# ---- the report


def limit_ms(part: dict[str, Any]) -> float:
    return max(part["memory_ms"], part["arithmetic_ms"])


def text(entry: dict[str, Any]) -> str:
    """The table of one size, and its sums."""
    header = ("kernel", "launches", "us", "GB/s", "of memory", "TFLOP/s", "of arithmetic", "limit")
    parts, share = entry["parts"], "{:.0%}".format
    rows = [
        (
            part["name"],
            part["launches"],
            part["ms"] * 1e3,
            part["bytes"] / part["ms"] * 1e-6,
            share(part["memory_ms"] / part["ms"]),
            part["operations"] / part["ms"] * 1e-9,
            share(part["arithmetic_ms"] / part["ms"]),
            "memory" if part["memory_ms"] >= part["arithmetic_ms"] else "arithmetic",
        )
        for part in parts
    ]
    spent, limits = (1e3 * sum(map(of, parts)) for of in (lambda part: part["ms"], limit_ms))
    title = f"Kernels of a substep with heat, {entry['particles']} particles:"
    notes = [
        f"Together {spent:.4g} us, {limits:.4g} us at the limits.",
        f"Other kernels of a call of {SUBSTEPS} substeps take {entry['others_ms'] * 1e3:.3g} us of each.",
        f"The limit of arithmetic is {entry['rate'] * 1e-12:.3g} TFLOP/s.",
    ]
    return "\n".join([title, "", common.table(header, rows), "", *notes])
