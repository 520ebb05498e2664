"""torch_mpm: differentiable Material Point Method operators for PyTorch."""

import importlib
from typing import TYPE_CHECKING, Any

from . import _interrupted_start as _interrupted_start  # First, as the imports below take a second or more.
from . import _library as _library
from . import _moved, laws, ops, splats
from .bodies import RigidBodies, couple
from .boundaries import SDF, Box, Capsule, Obstacle, Plane, Revolved, Sphere, Walls, Waypoints
from .data.trajectory import Trajectory
from .errors import (
    DamagedFileError,
    FrontWarning,
    GridOverflowError,
    LockingWarning,
    PrecisionWarning,
    SimulationError,
    ThinWallWarning,
)
from .geometry import seed, shapes
from .grid.grid import Blocks, Grid
from .heat import Heat
from .heat import boundaries as heat_boundaries
from .implicit import Implicit
from .laws import *  # noqa: F403
from .laws.parameters import PerMaterial, Table
from .ops import (
    HeatSolve,
    advance,
    g2p,
    g2p_advance,
    gather,
    grid_update,
    heat_cg,
    p2g,
    polar,
    quartic_return_map,
    scatter,
    svd3,
)
from .rollouts import RolloutPlan, plan_rollout, rollout, substeps_arguments
from .rollouts.checkpoints import Checkpoints
from .rollouts.environments import Environments
from .rollouts.estimate import RolloutEstimate, estimate_rollout
from .rollouts.frames import Frames, frames
from .rollouts.gradient_norms import GradientNorms
from .rollouts.graph_segments import make_graphed_step
from .rollouts.until_time import RolloutToResult, rollout_to
from .state import pytree
from .state.state import State
from .step import particle_operations
from .step.failures import Failures
from .step.stability import stable_dt
from .step.step import Step

if TYPE_CHECKING:
    from .scene import Scene as Scene

__all__ = [
    *laws.__all__,
    "SDF",
    "Blocks",
    "Box",
    "Capsule",
    "Checkpoints",
    "DamagedFileError",
    "Environments",
    "Failures",
    "Frames",
    "GradientNorms",
    "Grid",
    "FrontWarning",
    "GridOverflowError",
    "LockingWarning",
    "Heat",
    "HeatSolve",
    "Implicit",
    "Obstacle",
    "PerMaterial",
    "Plane",
    "PrecisionWarning",
    "Revolved",
    "RigidBodies",
    "RolloutEstimate",
    "RolloutPlan",
    "RolloutToResult",
    "SimulationError",
    "Sphere",
    "State",
    "Step",
    "Table",
    "ThinWallWarning",
    "Trajectory",
    "Walls",
    "Waypoints",
    "advance",
    "captured",
    "couple",
    "estimate_rollout",
    "frames",
    "g2p",
    "g2p_advance",
    "gather",
    "grid_update",
    "heat_boundaries",
    "heat_cg",
    "make_graphed_step",
    "ops",
    "p2g",
    "particle_operations",
    "plan_rollout",
    "polar",
    "quartic_return_map",
    "rollout",
    "rollout_to",
    "scatter",
    "seed",
    "shapes",
    "splats",
    "stable_dt",
    "substeps_arguments",
    "svd3",
]

captured = make_graphed_step
"""Older name."""

pytree.register()
_moved.install()


def __getattr__(name: str) -> Any:
    """`Scene`, imported on first use since it needs the extra `scene`, and old names."""
    if name == "Scene":
        from .scene import Scene

        return Scene
    if name in _moved.RENAMED:
        return _moved.renamed(name)
    if name in _moved.MOVED:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
