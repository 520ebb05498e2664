"""The differentiable simulator of PhysDreamer (Zhang et al. 2024, arXiv 2404.13026) and its descendants, "warp_mpm"."""

from .interface import (
    MPMDifferentiableSimulation,
    MPMDifferentiableSimulationClean,
    MPMDifferentiableSimulationWCheckpoint,
)
from .mpm_data_structure import MPMModelStruct, MPMStateStruct
from .mpm_solver_diff import MPMWARPDiff

__all__ = [
    "MPMDifferentiableSimulation",
    "MPMDifferentiableSimulationClean",
    "MPMDifferentiableSimulationWCheckpoint",
    "MPMModelStruct",
    "MPMStateStruct",
    "MPMWARPDiff",
]
