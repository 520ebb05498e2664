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
    """Approximate number of substeps of a scene.

    Raises:
        SceneError: for more than `MOST_SUBSTEPS`, which would take too long.
    """
    dt, substeps = time_step(scene, built, built.state)
    if substeps <= MOST_SUBSTEPS:
        return round(substeps)
    key = "cfl" if scene.dt is None else "dt"
    speed = float(built.state.v.double().norm(dim=1).amax()) if len(built.state) else 0.0
    many = f"about {substeps:.2g} substeps of {dt:.2g} s would be taken, and {MOST_SUBSTEPS:.0e} are allowed"
    raise SceneError([f"{key}: {many}; particles start with up to {speed:.3g} m/s"], scene.source)


def time_step(scene: Scene, built: Built, state: State) -> tuple[float, float]:
    """Time step [s] of a state, and number of substeps of the scene with it; infinite without a time step."""
    dt = float(built.step.stable_dt(state, scene.cfl).min()) if scene.dt is None else scene.dt
    return dt, max(float(scene.frames), scene.duration / dt if dt > 0 else math.inf)
