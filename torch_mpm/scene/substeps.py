"""Number of substeps of a scene, before the simulation."""

from __future__ import annotations

import math

from ..state.state import State
from .build import Built
from .explain import SceneError
from .scene import Scene

MOST_SUBSTEPS = 10**9
"""Maximum number of substeps of a scene: more take months."""


def check_substeps(scene: Scene, built: Built) -> int:
    """Approximate number of substeps of a scene. Emitted particles have the time step of their emission.

    Raises:
        SceneError: for more than `MOST_SUBSTEPS`, which would take too long, and for a fixed dt above the stability
            limit of the first state or of emitted particles.
    """
    later = emitting(built)
    _check_dt(scene, built, later)
    dt, substeps = time_step(scene, built, built.state)
    if built.nozzles:
        start = min(nozzle.times[0] for nozzle in built.nozzles)
        dt, whole = time_step(scene, built, later)
        share = min(1.0, start / scene.duration)
        substeps = max(substeps * share + whole * (1 - share), len(built.emissions()))
    if substeps <= MOST_SUBSTEPS:
        return round(substeps)
    key = "cfl" if scene.dt is None else "dt"
    speed = float(later.v.double().norm(dim=1).amax()) if len(later) else 0.0
    many = f"about {substeps:.2g} substeps of {dt:.2g} s would be taken, and {MOST_SUBSTEPS:.0e} are allowed"
    raise SceneError([f"{key}: {many}; particles start with up to {speed:.3g} m/s"], scene.source)


def emitting(built: Built) -> State:
    """First state and one layer of each emitter."""
    layers = [nozzle.layer for nozzle in built.nozzles]
    return State.concatenate([built.state, *layers]) if layers else built.state


def _check_dt(scene: Scene, built: Built, state: State) -> None:
    if scene.dt is None:
        return
    limits = built.step.stable_dt(state, 1.0).reshape(-1).tolist()
    limit = min(limits)
    if scene.dt > limit:
        name = built.scenes[limits.index(limit)]
        problem = f"{scene.dt:g} s is above the stability limit {limit:.3g} s{f' of {name}' if name else ''}"
        raise SceneError([f"dt: {problem}; use {0.5 * limit:.2g}, or remove dt and set cfl = 0.5"], scene.source)


def time_step(scene: Scene, built: Built, state: State) -> tuple[float, float]:
    """Time step [s] of a state, and number of substeps of the scene with it; infinite without a time step."""
    dt = float(built.step.stable_dt(state, scene.cfl).min()) if scene.dt is None else scene.dt
    return dt, max(float(scene.frames), scene.duration / dt if dt > 0 else math.inf)
