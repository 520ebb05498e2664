"""Boundaries, which change the velocity of grid nodes: the walls of the domain, obstacles that may move, and
damping.

The list of boundaries of a `Step` may contain any `nn.Module` with the arguments below, or any object with a method
`apply` of these arguments. It is ordinary torch code on the nodes, differentiated by autograd. This one accelerates the
upper half of the domain:

    class Wind(torch.nn.Module):
        def __init__(self, acceleration):  # [D]
            super().__init__()
            self.acceleration = torch.nn.Parameter(acceleration)
        def forward(self, velocity, positions, scene, time, dt):
            return velocity + torch.where(positions[:, 1:2] > 0.5, dt * self.acceleration, 0.0)

The step finds the parameters of modules, and so does an optimizer that is given `step.parameters()`.
Choose with `torch.where` rather than a mask as index, which synchronises with the device.
"""

from .damping import Damping
from .list import BoundaryList, call_boundary
from .motion import Pose, rotation_matrix
from .obstacles import SDF, Box, Capsule, Obstacle, Plane, Revolved, Sphere
from .walls import CONTACTS, LEAST_BETWEEN_MIRRORS, WALL_KINDS, Face, Walls
from .waypoints import Waypoints

__all__ = [
    "CONTACTS",
    "LEAST_BETWEEN_MIRRORS",
    "SDF",
    "WALL_KINDS",
    "BoundaryList",
    "Box",
    "Capsule",
    "Damping",
    "Face",
    "Obstacle",
    "Plane",
    "Pose",
    "Revolved",
    "Sphere",
    "Walls",
    "Waypoints",
    "call_boundary",
    "rotation_matrix",
]
