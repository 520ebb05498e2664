"""What all shapes have: the distance of points, faces, and how a kernel and a scene file know them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from ..per_scene import SceneParameters
from ..surface_mesh import Array, SurfaceMesh
from ..vectors import unit


class Faces(NamedTuple):
    """Faces of a shape as points see them.

    Attributes:
        height: of the points above the surface that carries each face [N, F] [m], negative inside.
        normal: unit normals of these, out of the shape [N, F, D].
        beyond: about how far the foot of each point is from the face itself [N, F] [m].
        flat: whether heights are linear in the position; or how far each point is from where they are so [N, F] [m].
    """

    height: Tensor
    normal: Tensor
    beyond: Tensor
    flat: bool | Tensor


class SceneKey(NamedTuple):
    """Key of a shape in scene files.

    Attributes:
        kind: "point" [m], "vector", "length" [m], or "outline", pairs of distance from an axis and position along it.
        description: of messages and the JSON schema.
        optional: whether it may be absent, which is None.
    """

    kind: str
    description: str
    optional: bool = False


class SceneWords(NamedTuple):
    """A shape in scene files: what it is, and its keys beside those that all obstacles have."""

    summary: str
    keys: Mapping[str, SceneKey]


class Shape(SceneParameters):
    """Closed region. Base class of all shapes; only `surface` must be defined.

    Parameters are numbers or tensors, one for all scenes or one per scene of a batch; `scene` selects them.

    The class declares the rest: a subclass inherits no `number`, `words`, `is_smooth` nor `is_convex`, since it may
    have another surface.
    """

    name: str = "shape"
    """Name in scene files and messages."""
    arguments: ClassVar[tuple[str, ...]] = ()
    """Names of the arguments of the constructor, which are attributes, too."""
    is_smooth: ClassVar[bool] = False
    """Whether the surface has no edges."""
    is_convex: ClassVar[bool] = False
    number: ClassVar[int | None] = None
    """Number among the shapes of the kernel of contact (csrc/grid/shapes.h); None where contact acts in torch
    operations."""
    vector: ClassVar[str | None] = None
    """Name of the parameter [D] that the kernel has as the vector of the shape; a `radius` is its radius."""
    words: ClassVar[SceneWords | None] = None
    """The shape as an obstacle of scene files; None where these do not have it."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name in ("number", "words", "is_smooth", "is_convex"):
            if name not in vars(cls):
                setattr(cls, name, getattr(Shape, name))

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Signed distance [N] [m], negative inside, and unit normal out of the shape [N, D], of points x [N, D] [m].

        Differentiable. The distance is true near the surface on both sides, and away from it where the shape allows.
        The normal is the gradient of the distance inside, where contact uses it; where it is zero (as at the centre of
        a sphere), contact does not act on a node.

        Args:
            x: points in the coordinates of the shape.
            scene: scene of each point, int [N] (negative: none), or None for one scene.
        """
        raise NotImplementedError

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces | None:
        """The faces of the surface one by one, where they are known; None where `surface` is all there is.

        Contact of nodes at inner edges and at the seams of several obstacles looks at faces; those of other shapes are
        found from `surface` around a node. Arguments as `surface`.
        """
        return None

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        """Signed distance of `surface` alone [N] [m]."""
        return self.surface(x, scene)[0]

    def contains(self, x: Tensor) -> Tensor:
        """Whether points x [N, D] [m] are inside or on the surface, bool [N]."""
        return self.signed_distance(x) <= 0

    def volume(self, dim: int, scene: int = 0) -> float:
        """Volume [m³], in 2-D area [m²]."""
        raise NotImplementedError(f"the volume of a {self.name} is not known")

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        """Corners [D], [D] [m] of the smallest axis-aligned box around the shape, float64 on the CPU."""
        raise NotImplementedError(f"the bounds of a {self.name} are not known")

    def thinnest_wall(self) -> float:
        """Thickness [m] where the shape is thinnest, if it is used for walls: as far as numbers or tensors on the CPU
        show it; infinite for shapes that may be thin on purpose."""
        return math.inf

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh] | None:
        """Surface as a mesh, or None where only its distance is known.

        Args:
            lower, upper: corners [D] [m] of the region of interest, to which an infinite shape is clipped.
            scene: index of the scene of the parameters.
        """
        return None

    # -- as a row of the table of a kernel, and as words of a scene

    def data_count(self) -> int:
        """Number of entries of `data`."""
        return 0

    def data(self, like: Tensor) -> Tensor:
        """Numbers that the kernel reads beside the vector and the radius [n], in the dtype of `like`."""
        return like.new_zeros(0)

    @classmethod
    def from_row(cls, vector: Tensor, radius: Tensor, data: Tensor) -> Shape:
        """Shape by its vector [B, D], radius [B] and data [n] in a kernel; differentiable in the vector."""
        named = {} if cls.vector is None else {cls.vector: vector}
        return cls(**named, **({"radius": radius.detach()} if "radius" in cls.RANKS else {}))

    @classmethod
    def from_words(cls, words: Any) -> tuple[Shape, Any]:
        """Shape of an obstacle by the words of a scene, and the position of its origin."""
        return cls(**{name: getattr(words, name) for name in cls.arguments}), words.center


def one_face(height: Tensor, normal: Tensor, flat: bool) -> Faces:
    """A surface that is one face."""
    return Faces(height[:, None], normal[:, None], torch.zeros_like(height)[:, None], flat)


def split_along(x: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Positions along a unit vector [D] or [N, D], [N, 1], and the rest of x [N, D]."""
    along = (x * axis).sum(1, keepdim=True)
    return along, x - along * axis


def in_meridian(normal: Tensor, across: Tensor, axis: Tensor) -> Tensor:
    """Unit vectors [N, D] by their components [N, 2] along `across` [N, D] and a unit vector, the axis [D] or [N, D].
    Those of points on the axis, where `across` is zero, are along it or zero."""
    result = normal[:, :1] * unit(across) + normal[:, 1:] * axis
    return torch.where((across != 0).any(1, keepdim=True), result, unit(result))


def perpendicular(axis: Tensor) -> Tensor:
    """Unit vectors [..., D] that are perpendicular to given ones."""
    axes = torch.arange(axis.shape[-1], device=axis.device)
    least = (axis.abs().argmin(-1, keepdim=True) == axes).to(axis.dtype)
    return unit(least - (least * axis).sum(-1, keepdim=True) * axis)


def ball_volume(dim: int, radius: float) -> float:
    """Volume of a ball in 3-D, area of a disc in 2-D, length in 1-D; infinite where a power would raise."""
    return {1: 2.0, 2: math.pi, 3: 4 / 3 * math.pi}[dim] * math.prod([radius] * dim)


def around_origin(upper: Tensor) -> tuple[Tensor, Tensor]:
    return -upper, upper
