"""Requirements of a scene: for `torch-mpm check` and `torch-mpm info SCENE`."""

from __future__ import annotations

import math
import time
from typing import Any

import torch
from torch import Tensor

from ..state.state import PARTICLE_FIELDS, State
from .build import Built
from .run import LONGEST_SEGMENT, Simulation, joined
from .scene import Scene
from .substeps import check_substeps, time_step

TRIAL_STEPS = 3


def describe(scene: Scene, built: Built) -> dict[str, Any]:
    """Fields in use with their bytes per particle, estimated time step and run time, size of the trajectory, and the
    plan of the substeps: executor, schedule and the reason against each of the others.

    The run time is that of a few substeps with half of the emitted particles, times the number of substeps for the
    stability limit of the first state.
    """
    check_substeps(scene, built)
    state = halfway(built)
    dt, substeps = time_step(scene, built, state)
    after, seconds = _trial(built, state, dt)
    materials = {m.name: m.words.law for m in built.materials}
    return {
        "title": scene.title or "(none)",
        "dimension": scene.dim,
        "scenes": len(built.scenes),
        "device": str(state.x.device),
        "precision": scene.precision,
        "rounding of positions [dx]": built.grid.rounding(state.x.dtype) / built.grid.dx,
        "particles": built.particles,
        "mass [kg]": float(built.statics()["mass"].double().sum()),
        "materials": materials,
        "obstacles": len(built.step.boundaries),
        "emitters": len(built.nozzles),
        "fields": _bytes_of(after),
        "bytes per particle": sum(_bytes_of(after).values()),
        "frames": scene.frames + 1,
        "time step [s]": dt,
        "substeps": round(substeps),
        "estimated run time [s]": seconds * substeps,
        "trajectory [MB]": Simulation(scene, built).layout("", "").bytes / 1e6,
        **plan_in_words(scene, built, after, dt, substeps),
    }


@torch.no_grad()
def plan_in_words(scene: Scene, built: Built, state: State, dt: float, substeps: float) -> dict[str, str]:
    """`Step.explain` for the longest rollout of a run: "plan" with executor and schedule, and "not NAME" with the
    reason against each other executor and schedule.

    Args:
        state: sorted particles.
        dt: time step [s].
        substeps: number of substeps of the scene.
    """
    steps = min(math.ceil(substeps / max(scene.frames, 1)), LONGEST_SEGMENT[state.x.device.type])
    plan, *others = built.step.explain(state, dt, n=steps).splitlines()
    return {"plan": plan, **dict(line.split(": ", 1) for line in others)}


def halfway(built: Built) -> State:
    """First state and half of the emitted particles, at the positions of their emission."""
    state = built.state
    for nozzle in built.nozzles:
        layer = State.concatenate([nozzle.layer] * math.ceil(len(nozzle.times) / 2))
        state = joined(state, layer.replace(ids=len(state) + torch.arange(len(layer), device=layer.x.device)))
    return state


@torch.no_grad()
def _trial(built: Built, state: State, dt: float) -> tuple[State, float]:
    state = built.step(state.sorted(built.grid), dt)
    begin = time.perf_counter()
    for _ in range(TRIAL_STEPS):
        state = built.step(state, dt)
    built.step.check()  # Also waits for the device.
    seconds = (time.perf_counter() - begin) / TRIAL_STEPS
    built.step.reset()
    return state, seconds


def _bytes_of(state: State) -> dict[str, int]:
    fields = {name: getattr(state, name) for name in PARTICLE_FIELDS} | state.extra
    tensors = {name: value for name, value in fields.items() if isinstance(value, Tensor)}
    return {name: t[0].numel() * t.element_size() if len(t) else 0 for name, t in tensors.items()}
