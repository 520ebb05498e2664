"""torch_mpm: differentiable Material Point Method operators for PyTorch."""

from typing import TYPE_CHECKING, Any

from . import _library as _library
from . import containers, laws, ops, particle_operations, seed
from .adaptive import Arrival, rollout_to
from .boundaries import SDF, Box, Capsule, Plane, Revolved, Sphere, Walls, Waypoints
from .captured_steps import captured
from .cfl import stable_dt
from .checkpoints import Checkpoints
from .data.trajectory import Trajectory
from .environments import Environments
from .errors import (
    DamagedFileError,
    FrontWarning,
    GridOverflowError,
    LockingWarning,
    PrecisionWarning,
    SimulationError,
)
from .failures import Failures
from .gradient_norms import GradientNorms
from .grid import Blocks, Grid
from .heat import Heat
from .heat import boundaries as heat_boundaries
from .laws import *  # noqa: F403
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
from .parameters import PerMaterial, Table
from .recording import Frames, frames
from .rollout_estimate import RolloutEstimate, estimate_rollout
from .rollouts import RolloutPlan, plan_rollout, rollout, substeps_arguments
from .state import State
from .step import Step

if TYPE_CHECKING:
    from .scene import Scene as Scene

__all__ = [
    *laws.__all__,
    "SDF",
    "Arrival",
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
    "PerMaterial",
    "Plane",
    "PrecisionWarning",
    "Revolved",
    "RolloutEstimate",
    "RolloutPlan",
    "SimulationError",
    "Sphere",
    "State",
    "Step",
    "Table",
    "Trajectory",
    "Walls",
    "Waypoints",
    "advance",
    "captured",
    "estimate_rollout",
    "frames",
    "g2p",
    "g2p_advance",
    "gather",
    "grid_update",
    "heat_boundaries",
    "heat_cg",
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
    "stable_dt",
    "substeps_arguments",
    "svd3",
]

containers.register()


def __getattr__(name: str) -> Any:
    """`Scene` needs the extra `scene`, so it is imported on first use."""
    if name == "Scene":
        from .scene import Scene

        return Scene
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
