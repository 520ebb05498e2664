"""`MPMSolver` of taichi_elements (Hu et al.), in 2-D and 3-D."""

from .mpm_solver import MPMSolver

__all__ = ["MPMSolver"]
