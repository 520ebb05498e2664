"""Rigid bodies, coupled with the material in both directions (docs/bodies.md).

`RigidBodies` is the exchange with any simulator, `couple` the coupling with MuJoCo. `FreeBodies` are rigid bodies that
need no simulator.
"""

from .body import Body, Driven, Hinge, Joint, Slider
from .coupling import MujocoCoupling, couple
from .exchange import Part, RigidBodies, moved, with_velocities
from .free_bodies import BodyReport, FreeBodies

__all__ = [
    "Body",
    "BodyReport",
    "Driven",
    "FreeBodies",
    "Hinge",
    "Joint",
    "MujocoCoupling",
    "Part",
    "RigidBodies",
    "Slider",
    "couple",
    "moved",
    "with_velocities",
]
