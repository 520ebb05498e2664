"""Files of simulations: trajectories, and their conversion to other formats."""

from .trajectory import Trajectory

__all__ = ["Trajectory"]
