"""MPM-PyTorch (Lin et al. 2025) on torch_mpm: its solver, constitutive models and boundary conditions."""

from .boundary_condition import set_boundary_conditions
from .constitutive_models import get_constitutive
from .mpm_solver import MPMSolver

__all__ = ["MPMSolver", "get_constitutive", "set_boundary_conditions"]
