"""Rigid bodies of other simulators, coupled with the material in both directions (docs/bodies.md)."""

from .exchange import Part, RigidBodies, with_velocities

__all__ = ["Part", "RigidBodies", "with_velocities"]
