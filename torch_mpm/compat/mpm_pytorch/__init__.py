"""MPM-PyTorch (Lin et al. 2025) on torch_mpm: its solver, constitutive models and boundary conditions,
and `MPMModel` of OmniPhysGS."""

from .boundary_condition import set_boundary_conditions
from .constitutive_models import get_constitutive
from .mpm_model import MPMModel
from .mpm_solver import MPMSolver

__all__ = ["MPMModel", "MPMSolver", "get_constitutive", "set_boundary_conditions"]
