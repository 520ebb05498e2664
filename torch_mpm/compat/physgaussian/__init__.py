"""`MPM_Simulator_WARP` of PhysGaussian (Xie et al. 2024, arXiv 2311.12198) and its descendants, and their JSON
configurations.
"""

from .batched import BatchedSimulator
from .configuration import decode_param_json, set_boundary_conditions
from .dialects import DIALECTS, Dialect
from .simulator import MPM_Simulator_WARP

__all__ = [
    "DIALECTS",
    "BatchedSimulator",
    "Dialect",
    "MPM_Simulator_WARP",
    "decode_param_json",
    "set_boundary_conditions",
]
