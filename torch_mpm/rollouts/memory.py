"""Measured cost of a step: memory for the backward pass, and time."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..state.state import CONSTANTS, State
from ..step.status import aside

StepFunction = Callable[[State, "float | Tensor"], State]


def state_bytes(state: State) -> int:
    """Size of the tensors that steps change, as the ops return them [bytes]."""
    fields = [getattr(state, f.name) for f in dataclasses.fields(state) if f.name not in (*CONSTANTS, "extra")]
    return sum(_bytes(t, len(state)) for t in [*fields, *state.extra.values()] if isinstance(t, Tensor))


def _bytes(t: Tensor, particles: int) -> int:
    of_particles = t.dim() > 0 and len(t) == particles > 0
    return rows_bytes(t, particles, t.numel() // particles) if of_particles else t.numel() * t.element_size()


def rows_bytes(like: Tensor, particles: int, columns: int) -> int:
    """Size of a structure of arrays: columns of the particles with their padding, `particle_pitch` in
    csrc/common/tensors.h [bytes]."""
    used = particles * like.element_size()
    if not like.is_cuda:
        line, page, shift = 64, 64, 23
        used = ((-(-used // line) + page - 1 - shift) // page * page + shift) * line
    return columns * used


def step_bytes(step: StepFunction, state: State, dt: float | Tensor) -> int:
    """Memory that autograd stores for one step from Python, including its state, without what all steps share
    [bytes].
    """
    start = differentiable(state)
    parameters = [*step.parameters(), *step.buffers()] if isinstance(step, torch.nn.Module) else []
    constants = [t for name in CONSTANTS if (t := getattr(start, name)) is not None]
    known = {t.untyped_storage().data_ptr() for t in [*constants, *parameters]}
    kept: dict[int, int] = {}

    def pack(t: Tensor) -> Tensor:
        place = t.untyped_storage().data_ptr()
        if place not in known:
            kept[place] = max(kept.get(place, 0), t.untyped_storage().nbytes())
        return t

    with aside(step, state.x), torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
        end = step(start, dt)
    del end
    return sum(kept.values())


def differentiable(state: State) -> State:
    """Separate state whose positions, velocities and dependent fields have gradients."""
    state = state.detach()
    return state.replace(x=state.x.clone().requires_grad_(), v=state.v.clone().requires_grad_())


def seconds(work: Callable[[], Any], device: torch.device) -> float:
    """Minimum time of two calls after a first one [s]."""
    work()
    times = []
    for _ in range(2):
        _wait(device)
        begin = time.perf_counter()
        work()
        _wait(device)
        times.append(time.perf_counter() - begin)
    return min(times)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
