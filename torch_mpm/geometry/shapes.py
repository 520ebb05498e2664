"""Shapes of bodies, obstacles, held surfaces and pictures.

A shape has local coordinates; an `Obstacle` adds a pose, a `seed.Region` a position. A user shape is a subclass of
`Shape` with a `surface`:

    class Torus(Shape):
        name = "torus"
        def __init__(self, ring, radius):  # [m]
            self.ring, self.radius = ring, radius
        def surface(self, x, scene=None):
            away = norm(x[:, ::2])
            across = torch.stack([away - self.ring, x[:, 1]], 1)
            u = unit(across)
            radial = unit(x[:, ::2]) * u[:, :1]
            return norm(across) - self.radius, torch.stack([radial[:, 0], u[:, 1], radial[:, 1]], 1)

`Obstacle(Torus(0.3, 0.1), position)` is an obstacle, in torch operations; `torch_mpm.ops.contact` lists the shapes that
act in a kernel.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..cuda_graphs.capture import is_traced, is_transformed
from ..errors import check_number, check_vector, shape_of
from ..meshes import closed, terrain
from ..meshes.index import MeshIndex
from ..meshes.nearest import nearest_on_triangles
from ..ops.autograd import graph_at_once
from ..ops.pointwise import fuses, pointwise
from . import surface_mesh
from .per_scene import SceneParameters, Value, constant, direction, extent, floats
from .surface_mesh import Array, SurfaceMesh
from .vectors import norm, unit

PAIRS = 2**20
"""Number of point-triangle pairs that are compared at once, which bounds the memory."""
UNLIKE = 1e-3
"""Relative difference between the volume inside a mesh and that by its normals from which on it is reported."""


class Faces(NamedTuple):
    """Faces of a shape as points see them.

    Attributes:
        height: of the points above the surface that carries each face [N, F] [m], negative inside.
        normal: unit normals of these, out of the shape [N, F, D].
        beyond: about how far the foot of each point is from the face itself [N, F] [m].
        flat: whether heights are linear in the position.
    """

    height: Tensor
    normal: Tensor
    beyond: Tensor
    flat: bool


class Shape(SceneParameters):
    """Closed region. Base class of all shapes; only `surface` must be defined.

    Parameters are numbers or tensors, one for all scenes or one per scene of a batch; `scene` selects them.
    """

    name: str = "shape"
    """Name in scene files."""

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

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh] | None:
        """Surface as a mesh, or None where only its distance is known.

        Args:
            lower, upper: corners [D] [m] of the region of interest, to which an infinite shape is clipped.
            scene: index of the scene of the parameters.
        """
        return None


class Plane(Shape):
    """Half-space behind a plane through the origin.

    Args:
        normal: direction out of the half-space: D numbers, or a tensor [D] or [B, D]; of any length but zero.
    """

    name = "plane"
    RANKS: ClassVar = {"normal": 1}

    def __init__(self, normal: Value) -> None:
        self.normal = direction("normal", normal)

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        normal = unit(self.at_nodes("normal", x, x.shape[1:], scene))
        return (x * normal).sum(1), normal.expand_as(x)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        return _one_face(*self.surface(x, scene), True)

    def volume(self, dim: int, scene: int = 0) -> float:
        return math.inf

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return _around_origin(torch.full((dim,), math.inf, dtype=torch.float64))

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        normal = self.of_scene("normal", 1, scene).numpy()
        middle = 0.5 * (lower + upper)
        foot = middle - (middle @ normal) / (normal @ normal) * normal
        return [surface_mesh.plate(foot, normal, float(np.linalg.norm(upper - lower)))]


class Sphere(Shape):
    """A ball around the origin; a disc in 2-D.

    Args:
        radius: [m], a number, or a tensor [] or [B].
    """

    name = "sphere"
    RANKS: ClassVar = {"radius": 0}

    def __init__(self, radius: float | Tensor) -> None:
        self.radius = extent("radius", radius)

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return self.signed_distance(x, scene), unit(x)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        return _one_face(*self.surface(x, scene), False)

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        return norm(x) - self.at_nodes("radius", x, (), scene)

    def contains(self, x: Tensor) -> Tensor:
        return norm(x) <= self.at_nodes("radius", x, (), None)

    def volume(self, dim: int, scene: int = 0) -> float:
        return ball_volume(dim, float(self.of_scene("radius", 0, scene)))

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return _around_origin(self.of_scene("radius", 0, scene).expand(dim))

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        return [surface_mesh.capsule(0.0, float(self.of_scene("radius", 0, scene)), np.eye(len(lower))[1])]


class Box(Shape):
    """A box around the origin with edges along the axes.

    Args:
        size: edge lengths [m]: D numbers, or a tensor [D] or [B, D].
    """

    name = "box"
    RANKS: ClassVar = {"size": 1}

    def __init__(self, size: Value) -> None:
        self.size = extent("size", size)

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The normal is that of the nearest face, inside the one of the axis with the least negative distance."""
        depth = self._depth(x, scene)
        nearest = torch.arange(x.shape[1], device=x.device) == depth.argmax(1, keepdim=True)
        return self._distance(depth), nearest * torch.where(x < 0, -1, 1).to(x.dtype)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        """The lower and the upper one of each axis in turn."""
        half = 0.5 * self.at_nodes("size", x, x.shape[1:], scene)
        height = torch.stack([-x - half, x - half], 2).flatten(1)
        axes = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
        normal = torch.stack([-axes, axes], 1).flatten(0, 1)
        return Faces(height, normal.expand(len(x), -1, -1), torch.zeros_like(height), True)

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        size = self.at_nodes("size", x, x.shape[1:], scene)
        if fuses(x, size):
            return pointwise("box_distance", x.shape[1], x, size)[0]
        return self._distance(self._depth(x, scene))

    def contains(self, x: Tensor) -> Tensor:
        return (self._depth(x, None) <= 0).all(1)

    def _depth(self, x: Tensor, scene: Tensor | None) -> Tensor:
        """Distances of points behind the faces of each axis [N, D] [m], negative inside."""
        return x.abs() - 0.5 * self.at_nodes("size", x, x.shape[1:], scene)

    def _distance(self, depth: Tensor) -> Tensor:
        """Normal by the distances behind the faces."""
        return norm(depth.clamp_min(0)) + depth.amax(1).clamp_max(0)

    def volume(self, dim: int, scene: int = 0) -> float:
        return float(self.of_scene("size", 1, scene).prod())

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return _around_origin(0.5 * self.of_scene("size", 1, scene))

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        return [surface_mesh.cuboid(self.of_scene("size", 1, scene).numpy())]


class Capsule(Shape):
    """All points within a radius of a segment around the origin.

    Args:
        half_axis: one end of the segment [m]: D numbers, or a tensor [D] or [B, D]. The other end is opposite.
        radius: [m], a number, or a tensor [] or [B].
    """

    name = "capsule"
    RANKS: ClassVar = {"half_axis": 1, "radius": 0}

    def __init__(self, half_axis: Value, radius: float | Tensor) -> None:
        self.half_axis, self.radius = constant("half_axis", half_axis), extent("radius", radius)

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        offset = self._offset(x, scene)
        return self._distance(offset, scene), unit(offset)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        return _one_face(*self.surface(x, scene), False)

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        return self._distance(self._offset(x, scene), scene)

    def _distance(self, offset: Tensor, scene: Tensor | None) -> Tensor:
        return norm(offset) - self.at_nodes("radius", offset, (), scene)

    def _offset(self, x: Tensor, scene: Tensor | None) -> Tensor:
        """Vectors from the nearest points of the segment to points [N, D] [m]."""
        axis = self.at_nodes("half_axis", x, x.shape[1:], scene)
        squared = (axis * axis).sum(-1, keepdim=True)
        along = (x * axis).sum(1, keepdim=True) / torch.where(squared > 0, squared, 1)
        return x - along.clamp(-1, 1) * axis

    def volume(self, dim: int, scene: int = 0) -> float:
        radius = float(self.of_scene("radius", 0, scene))
        length = 2 * float(self.of_scene("half_axis", 1, scene).norm())
        return ball_volume(dim - 1, radius) * length + ball_volume(dim, radius)

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return _around_origin(self.of_scene("half_axis", 1, scene).abs() + self.of_scene("radius", 0, scene))

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        half = self.of_scene("half_axis", 1, scene).numpy()
        length = float(np.linalg.norm(half))
        axis = half / length if length > 0 else np.eye(len(lower))[1]
        return [surface_mesh.capsule(length, float(self.of_scene("radius", 0, scene)), axis)]


class Revolved(Shape):
    """Polygon revolved about an axis: a cone, a tube, a funnel, an hourglass, a drum. In 2-D, the polygon and its
    mirror image.

    Args:
        outline: corners of the polygon, K pairs of distance from the axis (≥ 0) and position along it [m] from the
            origin; without self-intersections. As a tensor [K, 2], anticlockwise.
        axis: direction of the axis: D numbers, or a tensor [D] or [B, D]; y by default.
    """

    name = "revolved"
    RANKS: ClassVar = {"axis": 1}

    def __init__(self, outline: Sequence[Sequence[float]] | Tensor, axis: Value | None = None) -> None:
        self.outline = extent("outline", outline) if isinstance(outline, Tensor) else _anticlockwise(outline)
        self.axis = None if axis is None else direction("axis", axis)

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The normal is that of the nearest edge of the polygon, also where a reentrant corner is nearest."""
        axis, along, across = self._split(x, scene)
        distance, normal = self._polygon(torch.cat([norm(across)[:, None], along], 1))
        return distance, normal[:, :1] * unit(across) + normal[:, 1:] * axis

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        """One of each edge of the polygon; those on the axis, which are inside the body, are infinitely high."""
        axis, along, across = self._split(x, scene)
        a = self.parameter("outline", x, (len(self.outline), 2))
        edge = a.roll(-1, 0) - a
        size = norm(edge)
        arm = torch.cat([norm(across)[:, None], along], 1)[:, None] - a
        plane = unit(torch.stack([edge[:, 1], -edge[:, 0]], 1))
        on_axis = ((a[:, 0] == 0) & (edge[:, 0] == 0)) | (size == 0)
        height = torch.where(on_axis, torch.inf, (arm * plane).sum(2))
        foot = (arm * edge).sum(2) / torch.where(size > 0, size, 1)
        normal = plane[:, :1] * unit(across)[:, None] + plane[:, 1:] * axis.expand_as(x)[:, None]
        return Faces(height, normal, torch.maximum(-foot, foot - size).clamp_min(0), x.shape[1] == 2)

    def _split(self, x: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """The axis [D] or [N, D], positions along it [N, 1], and the rest of x [N, D]."""
        if self.axis is None:
            axis = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)[1]
        else:
            axis = unit(self.at_nodes("axis", x, x.shape[1:], scene))
        along = (x * axis).sum(1, keepdim=True)
        return axis, along, x - along * axis

    def _polygon(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] of points [N, 2] from the polygon, and outward normal [N, 2] of the nearest edge."""
        a = self.parameter("outline", p, (len(self.outline), 2))
        edge = a.roll(-1, 0) - a
        arm = p[:, None] - a
        along = ((arm * edge).sum(2) / (edge * edge).sum(1))[..., None]
        # From a corner the distance is that to the next edge, so that both are the same and the first edge counts.
        offset = norm(torch.where(along < 1, arm - along.clamp_min(0) * edge, arm.roll(-1, 1)))
        # An edge on the axis is inside the body.
        on_axis = (a[:, 0] == 0) & (edge[:, 0] == 0)
        nearest = torch.where(on_axis, torch.inf, offset).argmin(1, keepdim=True)
        # An odd number of edges is crossed by the ray from the point away from the axis.
        straddles = (a[:, 1] > p[:, 1:]) != (a.roll(-1, 0)[:, 1] > p[:, 1:])
        crossing = straddles & ((edge[:, 0] * arm[..., 1] - edge[:, 1] * arm[..., 0]) * edge[:, 1].sign() > 0)
        inside = crossing.sum(1) % 2 == 1
        distance = offset.gather(1, nearest)[:, 0]
        normal = unit(torch.stack([edge[:, 1], -edge[:, 0]], 1))[nearest[:, 0]]
        return torch.where(inside, -distance, distance), normal

    def volume(self, dim: int, scene: int = 0) -> float:
        corners = self.of_scene("outline", 2, 0).tolist()
        if dim == 2:
            return 2 * _polygon_area(corners)
        # ∮ π r² dz over the edges
        edges = zip(corners, corners[1:] + corners[:1], strict=True)
        return math.pi / 3 * sum((q[1] - p[1]) * (p[0] * p[0] + p[0] * q[0] + q[0] * q[0]) for p, q in edges)

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        axis = torch.from_numpy(self._unit_axis(dim, scene))
        radius, height = self.of_scene("outline", 2, 0)[:, :, None].unbind(1)
        reach = radius * (1 - axis.square()).clamp_min(0).sqrt()
        return (height * axis - reach).amin(0), (height * axis + reach).amax(0)

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        return surface_mesh.ring(self.of_scene("outline", 2, 0).numpy(), self._unit_axis(len(lower), scene))

    def _unit_axis(self, dim: int, scene: int) -> Array:
        if self.axis is None:
            return np.eye(dim)[1]
        axis = self.of_scene("axis", 1, scene).numpy()
        return axis / np.linalg.norm(axis)


class Cylinder(Revolved):
    """A solid cylinder with flat ends around the origin; 3-D only.

    Args:
        half_axis: centre of one end [m], 3 numbers. The other end is opposite.
        radius: [m], positive.
    """

    name = "cylinder"

    def __init__(self, half_axis: Sequence[float], radius: float) -> None:
        axis = floats("half_axis", direction("half_axis", half_axis))
        if len(axis) != 3:
            raise ValueError("a cylinder needs three dimensions; in 2-D use a sphere (a disc) or a box")
        check_number("radius", radius, "positive", lambda v: 0 < v < math.inf)
        half = math.hypot(*axis)
        super().__init__(((0, -half), (radius, -half), (radius, half), (0, half)), axis)


class Mesh(Shape):
    """Inside of a closed triangle mesh, scaled about its origin: points of non-zero winding number.

    So parts may overlap, and each may be inside out; a part of opposite orientation inside another is a cavity. Files
    with textures or normals have several vertices at a position, which are merged. On the CPU search trees are used. On
    other devices, and where torch traces or transforms a function, every point is compared with every triangle, which
    suits small meshes only.

    Args:
        source: a file that trimesh reads (.obj, .ply, .stl, .glb, ...) or a `trimesh.Trimesh`.
        scale: factor on its coordinates.

    Attributes:
        changes: sentences on the repairs that closed the mesh (see `torch_mpm.meshes.closed.load`).

    Raises:
        ImportError: without trimesh.
        OSError: for a file that cannot be read.
        ValueError: for a mesh that is not closed, or a scale that is not positive.
    """

    name = "mesh"

    def __init__(self, source: str | Path | Any, scale: float = 1.0) -> None:
        scale = float(check_number("scale", scale, "positive", lambda v: 0 < v < math.inf))
        vertices, faces, changes = closed.load(source)
        signed, filled = self._set(source, closed.ClosedMesh(vertices * scale, faces, changes))
        if abs(filled - abs(signed)) > UNLIKE * filled:
            warnings.warn(
                f"mesh {source}: parts overlap or are inside out one against another: the volume inside is "
                f"{filled:.4g} m³, which bodies get, and that by the normals {abs(signed):.4g} m³",
                stacklevel=2,
            )

    def _set(self, source: Any, mesh: closed.ClosedMesh) -> tuple[float, float]:
        """Set the vertices and triangles, and return the volume by the normals and the volume inside [m³]."""
        self.vertices, self.faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
        self.changes, self._index = mesh.changes, MeshIndex(self.vertices, self.faces)
        signed, filled = self._index.volumes
        check_number(f"the volume of {self.name} {source}", filled, "positive", lambda v: 0 < v < math.inf)
        return signed, filled

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        index, corners = self._searched(x), self._corners(x)
        if index is not None:
            nearest = nearest_on_triangles(x, corners[index.nearest(x)])
        else:
            nearest = torch.cat([_nearest_of_all(part, corners) for part in self._chunks(x)])
        offset = x - nearest
        side = torch.where(self.contains(x.detach()), -1, 1).to(x.dtype)
        return side * norm(offset), side[:, None] * unit(offset)

    def contains(self, x: Tensor) -> Tensor:
        """Whether the winding number is above 1/2 (Jacobson et al. 2013; angles: Van Oosterom and Strackee 1983)."""
        if (index := self._searched(x)) is not None:
            return index.inside(x)
        corners = self._corners(x)
        return torch.cat([_winding_number(part, corners).abs() > 0.5 for part in self._chunks(x)])

    def volume(self, dim: int, scene: int = 0) -> float:
        """Volume inside [m³], exact where parts do not overlap, otherwise to 1e-4."""
        return self._current_index().volumes[1]

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return self.vertices.cpu().amin(0), self.vertices.cpu().amax(0)

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        return [SurfaceMesh(self.vertices.cpu().numpy(), self.faces.cpu().numpy())]

    def _searched(self, x: Tensor) -> MeshIndex | None:
        """Search trees for points; None where each is compared with every triangle."""
        hidden = x.device.type != "cpu" or is_traced(x) or is_transformed()
        return None if hidden else self._current_index()

    def _current_index(self) -> MeshIndex:
        """Rebuilt where the vertices or triangles have changed."""
        vertices, faces = self.vertices.detach().to("cpu", torch.float64), self.faces.cpu()
        if not self._index.describes(vertices, faces):
            self._index = MeshIndex(vertices, faces)
        return self._index

    def _corners(self, like: Tensor) -> Tensor:
        """[T, 3, 3]"""
        return self.vertices.to(like)[self.faces.to(like.device)]

    def _chunks(self, x: Tensor) -> Sequence[Tensor]:
        return x.split(max(1, PAIRS // len(self.faces)))


class Terrain(Mesh):
    """Ground below an open height surface, or space above it; 3-D only.

    Vertical sides and a flat face close it. As an obstacle it should extend 3 cells beyond open faces of the domain.
    `Sampled.of(terrain, lower, upper, spacing)`, with corners outside the closed body, acts in the kernel.

    Args:
        source: heights [X, Y] [m] at the nodes of a horizontal lattice, a tensor or an array; or an open surface, a
            file that trimesh reads or a `trimesh.Trimesh`, without vertical or overhanging parts.
        level: coordinate of the flat face [m]. Where it is below the whole surface, the body is the ground; where it is
            above, the space over the ground.
        lower: the first node of the lattice of heights [m], 2 numbers.
        spacing: distance of the nodes of heights [m].
        axis: the vertical axis, 0, 1 or 2. The lattice of heights lies along the other two, in their order.
        scale: factor on the coordinates of a file, applied before `level`.

    Raises:
        ImportError, OSError: as `Mesh`.
        TypeError, ValueError: for other arguments, a level between the heights, or several heights at one position.
    """

    name = "terrain"

    def __init__(
        self,
        source: Tensor | Array | str | Path | Any,
        level: float,
        lower: Sequence[float] | None = None,
        spacing: float | None = None,
        axis: int = 2,
        scale: float = 1.0,
    ) -> None:
        level = float(check_number("level", level))
        scale = float(check_number("scale", scale, "positive", lambda v: 0 < v < math.inf))
        if axis not in (0, 1, 2):
            raise ValueError(f"axis must be 0, 1 or 2, got {axis}")
        if isinstance(source, Tensor | np.ndarray):
            heights = torch.as_tensor(source).detach().to("cpu", torch.float64)
            if heights.dim() != 2 or min(heights.shape) < 2 or not bool(heights.isfinite().all()):
                raise ValueError(f"heights must be finite numbers [X, Y], 2 or more each, got {shape_of(heights)}")
            if lower is None or spacing is None:
                raise ValueError("heights need the first node of their lattice, lower, and its spacing")
            step = float(check_number("spacing", spacing, "positive", lambda v: 0 < v < math.inf))
            name: Any = "heights"
            surface = terrain.on_lattice(heights.numpy(), check_vector("lower", lower, 2), step, axis)
        else:
            if lower is not None or spacing is not None:
                raise ValueError("lower and spacing belong to heights on a lattice, not to a mesh")
            name, surface = source, closed.triangles(source)
        signed, filled = self._set(name, terrain.closed_to(name, surface[0] * scale, surface[1], level, axis))
        if abs(filled - abs(signed)) > UNLIKE * filled:
            raise ValueError(f"terrain {name} has several heights over a place: parts of it lie above each other")


class SDF(Shape):
    """Shape given by its signed distance.

    Args:
        distance: function of points [N, D] [m] that returns distances [N] [m], negative inside. Torch operations; it
            need not be exact away from its zero level.
        normal: function of the same points that returns outward normals [N, D]; None for the gradient of `distance` by
            automatic differentiation. Of any length.
    """

    name = "sdf"

    def __init__(self, distance: Callable[[Tensor], Tensor], normal: Callable[[Tensor], Tensor] | None = None) -> None:
        for name, function in (("distance", distance), ("normal", normal)):
            if not callable(function) and (name == "distance" or function is not None):
                raise TypeError(f"{name} must be a function of positions [N, D], got {shape_of(function)}")
        self.distance, self.normal = distance, normal

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if self.normal is not None:
            distance, normal = self.distance(x), self.normal(x)
        else:
            distance, normal = with_gradient(self.distance, x)
        self._check(distance, normal, x)
        return distance, unit(normal)

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        distance = self.distance(x)
        self._check(distance, x, x)
        return distance

    @staticmethod
    def _check(distance: Tensor, normal: Tensor, x: Tensor) -> None:
        if distance.shape != x.shape[:1] or normal.shape != x.shape:
            raise ValueError(
                f"distance and normal of an SDF must have shape [N] and [N, D] = {list(x.shape)}, "
                f"got {shape_of(distance)} and {shape_of(normal)}"
            )


class Sampled(Shape):
    """Shape given by its signed distance at the nodes of a lattice, multilinear between them.

    Its obstacles act in the kernel, while those of `SDF` and `Mesh` act by torch operations; `Sampled.of` converts
    them. The error of a curved surface is about spacing²/(8 radius), and edges are rounded.

    Args:
        values: signed distances [m], negative inside, positive on the border: [X, Y] or [X, Y, Z], at least 2 of each.
            Values that are steeper than distances are divided by their largest slope between nodes of a cell, which
            preserves their zero level.
        lower: the first node in the coordinates of the shape [m], D numbers.
        spacing: distance of the nodes [m].

    Raises:
        TypeError, ValueError: for values of another type or shape, not finite, or not positive on the border.
    """

    name = "sampled"

    def __init__(self, values: Tensor, lower: Sequence[float], spacing: float) -> None:
        if not isinstance(values, Tensor) or values.dim() not in (2, 3) or min(values.shape) < 2:
            raise ValueError(f"values must be a tensor [X, Y] or [X, Y, Z] of 2 or more each, got {shape_of(values)}")
        self.lower = check_vector("lower", lower, values.dim())
        self.spacing = float(check_number("spacing", spacing, "positive", lambda v: 0 < v < math.inf))
        if values.requires_grad:
            raise ValueError("values must not require grad: which nodes are inside is not differentiable")
        values = values.to("cpu", torch.float64)
        if not bool(values.isfinite().all()):
            raise ValueError("values must be finite")
        if any(bool((values.select(axis, end) <= 0).any()) for axis in range(values.dim()) for end in (0, -1)):
            raise ValueError("values must be positive on the border of the lattice: enlarge it")
        self.values = values / max(1.0, _steepest(values) / self.spacing)

    @classmethod
    def of(cls, shape: Shape, lower: Sequence[float], upper: Sequence[float], spacing: float) -> Sampled:
        """Sample a shape between two corners [m] of a box around it."""
        first, last = check_vector("lower", lower), check_vector("upper", upper, len(lower))
        counts = [max(2, math.ceil((b - a) / spacing - 1e-9) + 1) for a, b in zip(first, last, strict=True)]
        axes = [a + spacing * torch.arange(n, dtype=torch.float64) for a, n in zip(first, counts, strict=True)]
        nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        return cls(shape.signed_distance(nodes.reshape(-1, len(counts))).reshape(counts), first, spacing)

    @classmethod
    def from_data(cls, data: Tensor, dim: int) -> Sampled:
        """Inverse of `data`."""
        shape = cls.__new__(cls)
        shape.lower, shape.spacing = tuple(data[:dim].tolist()), float(data[dim])
        shape.values = data[2 * dim + 1 :].reshape([int(n) for n in data[dim + 1 : 2 * dim + 1]])
        return shape

    def data(self, like: Tensor) -> Tensor:
        """Lower corner, spacing, numbers of nodes and values [n], as arguments of the kernel."""
        numbers = [*self.lower, self.spacing, *self.values.shape]
        return torch.cat([self.values.new_tensor(numbers), self.values.reshape(-1)]).to(like)

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        values, counts = self.values.to(x), self.values.shape
        along = (x - x.new_tensor(self.lower)) / self.spacing
        last = x.new_tensor([n - 1 for n in counts])
        inside = torch.minimum(along.clamp_min(0), last)
        cell = torch.minimum(inside.detach().nan_to_num().floor(), last - 1).long()
        weight = inside - cell
        distance, gradient = torch.zeros_like(x[:, 0]), [torch.zeros_like(x[:, 0]) for _ in counts]
        for corner in itertools.product((0, 1), repeat=len(counts)):
            value = values[tuple((cell + torch.tensor(corner, device=x.device)).unbind(1))]
            parts = [weight[:, i] if upper else 1 - weight[:, i] for i, upper in enumerate(corner)]
            distance = distance + math.prod(parts[1:], start=parts[0]) * value
            for i, upper in enumerate(corner):
                rest = math.prod(parts[:i] + parts[i + 1 :], start=torch.ones_like(value))
                gradient[i] = gradient[i] + (value if upper else -value) * rest
        beyond = (along - inside) * self.spacing
        far, away = (beyond != 0).any(1), norm(torch.cat([distance[:, None], beyond], 1))
        return torch.where(far, away, distance), unit(torch.stack(gradient, 1))

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        lower = torch.tensor(self.lower, dtype=torch.float64, device="cpu")
        return lower, lower + self.spacing * (torch.tensor(self.values.shape, dtype=torch.float64, device="cpu") - 1)


# ---- geometry


def _steepest(values: Tensor) -> float:
    """Largest slope between two nodes of one cell of a lattice of unit spacing; at most 1 where values are distances.

    The interpolant of these values has at most this slope along each axis, on which the kernel relies (csrc/grid/
    obstacle.h).
    """
    most = 0.0
    for step in itertools.product((-1, 0, 1), repeat=values.dim()):
        if step > (0,) * values.dim():  # One of each pair of opposite steps.
            starts = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, values.shape, strict=True))
            ends = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, values.shape, strict=True))
            most = max(most, float((values[ends] - values[starts]).abs().max()) / math.hypot(*step))
    return most


def _one_face(height: Tensor, normal: Tensor, flat: bool) -> Faces:
    """A surface that is one face."""
    return Faces(height[:, None], normal[:, None], torch.zeros_like(height)[:, None], flat)


def ball_volume(dim: int, radius: float) -> float:
    """Volume of a ball in 3-D, area of a disc in 2-D, length in 1-D; infinite where a power would raise."""
    return {1: 2.0, 2: math.pi, 3: 4 / 3 * math.pi}[dim] * math.prod([radius] * dim)


def _around_origin(upper: Tensor) -> tuple[Tensor, Tensor]:
    return -upper, upper


def _anticlockwise(outline: Any) -> tuple[tuple[float, ...], ...]:
    """Polygon around the axis, checked."""
    if not isinstance(outline, Sequence):
        raise TypeError(f"outline must be at least 3 pairs, got {shape_of(outline)}")
    corners = tuple(floats("outline", corner) for corner in outline)
    if len(corners) < 3 or any(len(c) != 2 or c[0] < 0 or not all(map(math.isfinite, c)) for c in corners):
        raise ValueError(f"outline must be at least 3 pairs (distance >= 0, position along the axis), got {outline}")
    area = _polygon_area(corners)
    if area == 0:
        raise ValueError(f"outline must enclose an area, got {outline}")
    return corners if area > 0 else corners[::-1]


def _polygon_area(corners: Sequence[Sequence[float]]) -> float:
    """Signed area, positive if anticlockwise."""
    edges = zip(corners, [*corners[1:], corners[0]], strict=True)
    return 0.5 * sum(a[0] * b[1] - b[0] * a[1] for a, b in edges)


def _winding_number(x: Tensor, corners: Tensor) -> Tensor:
    """Solid angles of triangles [T, 3, 3] from points [N, 3], [N]."""
    a, b, c = (corners[None, :, k] - x[:, None] for k in range(3))
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    determinant = (a * torch.linalg.cross(b, c)).sum(-1)
    denominator = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return torch.atan2(determinant, denominator).sum(1) / (2 * math.pi)


def _nearest_of_all(x: Tensor, corners: Tensor) -> Tensor:
    """Nearest point of triangles [T, 3, 3] to each of the points [N, 3], [N, 3]."""
    candidates = nearest_on_triangles(x[:, None], corners[None])
    nearest = (x[:, None] - candidates).square().sum(-1).argmin(1)
    return candidates[torch.arange(len(x), device=x.device), nearest]


def with_gradient(function: Callable[[Tensor], Tensor], points: Tensor) -> tuple[Tensor, Tensor]:
    """Values [N] of a function of points [N, D], each depending on its own point, and their gradients;
    differentiable.
    """
    if torch.compiler.is_compiling() or torch._C._autograd._top_saved_tensors_default_hooks(False) is None:
        values, pull_back, *_ = torch.func.vjp(function, points)
        return values, pull_back(torch.ones_like(values))[0]
    # torch.func refuses the hooks of checkpointing, which would recompute its steps for a gradient taken in them.
    differentiable = torch.is_grad_enabled()
    with torch.enable_grad(), graph_at_once():
        leaf = points.view_as(points)
        leaf = leaf if leaf.requires_grad else leaf.requires_grad_()
        values = function(leaf)
        (gradient,) = torch.autograd.grad(values, leaf, torch.ones_like(values), create_graph=differentiable)
    return values, gradient
