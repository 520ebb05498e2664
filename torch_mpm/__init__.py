"""torch_mpm: differentiable Material Point Method operators for PyTorch."""

from . import _library as _library
from . import ops, seed
from .boundaries import SDF, Box, Capsule, Plane, Sphere, Walls
from .cfl import stable_dt
from .errors import GridOverflowError, SimulationError
from .grid import Blocks, Grid
from .materials import CustomLaw, Material, Mixture, NeoHookean, WeaklyCompressible
from .ops import advance, g2p, gather, grid_update, p2g, scatter
from .state import State
from .step import Step, rollout

__all__ = [
    "SDF",
    "Blocks",
    "Box",
    "Capsule",
    "CustomLaw",
    "Grid",
    "GridOverflowError",
    "Material",
    "Mixture",
    "NeoHookean",
    "Plane",
    "SimulationError",
    "Sphere",
    "State",
    "Step",
    "Walls",
    "WeaklyCompressible",
    "advance",
    "g2p",
    "gather",
    "grid_update",
    "ops",
    "p2g",
    "rollout",
    "scatter",
    "seed",
    "stable_dt",
]
