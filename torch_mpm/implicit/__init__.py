"""Implicit steps: backward Euler on the velocities of the nodes."""

from .equilibrium import equilibrium
from .implicit import Implicit, ImplicitReport

__all__ = ["Implicit", "ImplicitReport", "equilibrium"]
