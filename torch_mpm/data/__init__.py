"""Files of simulations: trajectories, and what is made of them."""

from .trajectory import Trajectory

__all__ = ["Trajectory"]
