"""Shapes of bodies, obstacles, held surfaces and pictures.

A shape has local coordinates; an `Obstacle` adds a pose, a `seed.Region` a position. A user shape is a subclass of
`Shape` with a `surface`:

    class Tube(Shape):
        name = "tube"
        def __init__(self, radius, thickness):  # [m]
            self.radius, self.thickness = radius, thickness
        def surface(self, x, scene=None):
            across = x * x.new_tensor([1.0, 0.0, 1.0])
            beyond = norm(across) - self.radius
            return beyond.abs() - 0.5 * self.thickness, beyond.sign()[:, None] * unit(across)

`Obstacle(Tube(0.3, 0.1), position)` is an obstacle, in torch operations. Shapes with a `number` act in a kernel, and
those with `words` stand in scene files; see `torus.py` for all that such a shape declares.
"""

from .base import Faces, SceneKey, SceneWords, Shape, ball_volume
from .by_distance import SDF, Sampled, with_gradient
from .mesh import Mesh, Terrain
from .revolved import Cylinder, Revolved
from .simple import Box, Capsule, Plane, Sphere
from .torus import Torus

SHAPES = tuple(shape for shape in vars().values() if isinstance(shape, type) and issubclass(shape, Shape))
"""All shapes."""

__all__ = [
    "SDF",
    "SHAPES",
    "Box",
    "Capsule",
    "Cylinder",
    "Faces",
    "Mesh",
    "Plane",
    "Revolved",
    "Sampled",
    "SceneKey",
    "SceneWords",
    "Shape",
    "Sphere",
    "Terrain",
    "Torus",
    "ball_volume",
    "with_gradient",
]
