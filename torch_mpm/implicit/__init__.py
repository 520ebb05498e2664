"""Implicit steps: backward Euler on the node velocities."""

from .comparison import Comparison, compare
from .equilibrium import equilibrium
from .implicit import Implicit, ImplicitReport

__all__ = ["Comparison", "Implicit", "ImplicitReport", "compare", "equilibrium"]
