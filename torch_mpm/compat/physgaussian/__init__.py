"""`MPM_Simulator_WARP` of PhysGaussian (Xie et al. 2024, arXiv 2311.12198) and its descendants, their JSON
configurations, and their files of frames.
"""

from .batched import BatchedSimulator
from .configuration import decode_param_json, set_boundary_conditions
from .dialects import DIALECTS, Dialect
from .engine_utils import particle_position_tensor_to_ply, particle_position_to_ply, save_data_at_frame
from .simulator import MPM_Simulator_WARP

__all__ = [
    "DIALECTS",
    "BatchedSimulator",
    "Dialect",
    "MPM_Simulator_WARP",
    "decode_param_json",
    "particle_position_tensor_to_ply",
    "particle_position_to_ply",
    "save_data_at_frame",
    "set_boundary_conditions",
]
