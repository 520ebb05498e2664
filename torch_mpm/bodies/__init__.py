"""Rigid bodies of other simulators, coupled with the material in both directions (docs/bodies.md).

`RigidBodies` is the exchange with any simulator, `couple` the coupling with MuJoCo.
"""

from .coupling import MujocoCoupling, couple
from .exchange import Part, RigidBodies, moved, with_velocities

__all__ = ["MujocoCoupling", "Part", "RigidBodies", "couple", "moved", "with_velocities"]
