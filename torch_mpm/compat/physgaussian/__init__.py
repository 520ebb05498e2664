"""`MPM_Simulator_WARP` of PhysGaussian (Xie et al. 2024, arXiv 2311.12198) and its JSON configurations."""

from .configuration import decode_param_json, set_boundary_conditions
from .simulator import MPM_Simulator_WARP

__all__ = ["MPM_Simulator_WARP", "decode_param_json", "set_boundary_conditions"]
