"""Prims of USD: particles as points or instanced grains, meshes, rigid bodies, a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data.trajectory import Array
from ..render.camera import Camera
from ..render.shapes import Shape
from ..surfaces.reconstruction import Surface
from .stage import Stage, child_path, pxr

APERTURE = 24.0
"""Height of the image of a camera [mm]; only its ratio to the focal length matters."""


class Points:
    """Particles as UsdGeomPoints.

    Args:
        stage: the stage.
        path: path of the prim.
        width: diameter of the particles [m].
        color: linear RGB.
    """

    def __init__(self, stage: Stage, path: str, width: float, color: Array) -> None:
        geometry = pxr("UsdGeom")
        prim = geometry.Points.Define(stage.stage, path)
        self._stage, self._width = stage, width
        self._points, self._velocities = prim.CreatePointsAttr(), prim.CreateVelocitiesAttr()
        self._ids, self._extent = prim.CreateIdsAttr(), prim.CreateExtentAttr()
        stage.set(prim.CreateWidthsAttr(), np.array([width]))
        prim.SetWidthsInterpolation(geometry.Tokens.constant)
        set_color(stage, prim, color)
        self._last: Array | None = None

    def write(self, frame: int, x: Array, v: Array, ids: Array) -> None:
        """Positions [P, 3] [m], velocities [P, 3] [m/s] and ids int64 [P] of a frame."""
        self._stage.set(self._points, x, frame)
        self._stage.set(self._velocities, v, frame)
        self._stage.set(self._extent, extent_of(x, 0.5 * self._width), frame)
        if self._last is None or not np.array_equal(ids, self._last):  # Samples of arrays of other sizes are held.
            self._write_ids(frame, ids)
            self._last = ids

    def _write_ids(self, frame: int, ids: Array) -> None:
        self._stage.set(self._ids, ids, frame)


class Grains(Points):
    """Particles as instances of a sphere (UsdGeomPointInstancer); arguments as `Points`."""

    def __init__(self, stage: Stage, path: str, width: float, color: Array) -> None:
        geometry = pxr("UsdGeom")
        prim = geometry.PointInstancer.Define(stage.stage, path)
        self._stage, self._width, self._last = stage, width, None
        self._points, self._velocities = prim.CreatePositionsAttr(), prim.CreateVelocitiesAttr()
        self._ids, self._extent = prim.CreateIdsAttr(), prim.CreateExtentAttr()
        self._kinds = prim.CreateProtoIndicesAttr()
        grain = geometry.Sphere.Define(stage.stage, f"{path}/grain")
        grain.CreateRadiusAttr(0.5 * width)
        stage.set(grain.CreateExtentAttr(), extent_of(np.zeros((1, 3)), 0.5 * width))
        set_color(stage, grain, color)
        prim.CreatePrototypesRel().SetTargets([grain.GetPath()])

    def _write_ids(self, frame: int, ids: Array) -> None:
        self._stage.set(self._ids, ids, frame)
        self._stage.set(self._kinds, np.zeros(len(ids)), frame)


class Mesh:
    """Surface whose triangles differ from frame to frame; `color` is linear RGB."""

    def __init__(self, stage: Stage, path: str, color: Array) -> None:
        prim = _triangles(stage, path, color)
        self._stage = stage
        self._points, self._normals = prim.CreatePointsAttr(), prim.CreateNormalsAttr()
        self._counts, self._corners = prim.CreateFaceVertexCountsAttr(), prim.CreateFaceVertexIndicesAttr()
        self._velocities, self._extent = prim.CreateVelocitiesAttr(), prim.CreateExtentAttr()
        prim.SetNormalsInterpolation(pxr("UsdGeom").Tokens.vertex)

    def write(self, frame: int, surface: Surface, v: Array) -> None:
        """Surface [m] and velocities of its vertices [V, 3] [m/s] of a frame."""
        self._stage.set(self._points, surface.vertices, frame)
        self._stage.set(self._normals, surface.normals, frame)
        self._stage.set(self._counts, np.full(len(surface.faces), 3), frame)
        self._stage.set(self._corners, surface.faces.ravel(), frame)
        self._stage.set(self._velocities, v, frame)
        self._stage.set(self._extent, extent_of(surface.vertices), frame)


@dataclass(frozen=True)
class RigidPiece:
    """Piece of an obstacle: its shape in each frame, None where it does not act."""

    name: str
    shapes: Sequence[Shape | None]


def write_rigid(stage: Stage, parent: str, piece: RigidPiece) -> None:
    """Write a piece as a mesh that is translated and turned; poses are interpolated between frames."""
    present = [(k, shape) for k, shape in enumerate(piece.shapes) if shape is not None]
    if not present:
        return
    first = present[0][1]
    assert first.faces is not None
    prim = _triangles(stage, child_path(parent, piece.name), linear(np.array(first.color)))
    stage.set(prim.CreateFaceVertexCountsAttr(), np.full(len(first.faces), 3))
    stage.set(prim.CreateFaceVertexIndicesAttr(), first.faces.ravel())
    prim.CreateDoubleSidedAttr(True)
    if first.opacity < 1:
        stage.set(prim.CreateDisplayOpacityAttr(), np.array([first.opacity]))
    changes = any(not np.array_equal(shape.vertices, first.vertices) for _, shape in present)
    for k, shape in present if changes else present[:1]:
        stage.set(prim.CreatePointsAttr(), shape.vertices, k if changes else None)
        stage.set(prim.CreateExtentAttr(), extent_of(shape.vertices), k if changes else None)
    _write_poses(prim, present)
    if len(present) < len(piece.shapes):
        tokens = pxr("UsdGeom").Tokens
        for k, drawn in enumerate(piece.shapes):
            prim.CreateVisibilityAttr().Set(tokens.invisible if drawn is None else tokens.inherited, float(k))


def _write_poses(prim: Any, present: Sequence[tuple[int, Shape]]) -> None:
    gf, geometry = pxr("Gf"), pxr("UsdGeom")
    shift, turn = prim.AddTranslateOp(), prim.AddOrientOp(geometry.XformOp.PrecisionDouble)
    first = present[0][1]
    moves = any(
        not (np.array_equal(s.position, first.position) and np.array_equal(s.rotation, first.rotation))
        for _, s in present
    )
    last = None
    for k, shape in present if moves else present[:1]:
        rotation = gf.Matrix3d(*shape.rotation.T.ravel().tolist()).ExtractRotation().GetQuat()
        if last is not None and gf.Dot(rotation, last) < 0:  # The nearer of the two quaternions of a rotation.
            rotation = -rotation
        last = rotation
        when = (float(k),) if moves else ()
        shift.Set(gf.Vec3d(*shape.position.tolist()), *when)
        turn.Set(rotation, *when)


def write_camera(stage: Stage, path: str, camera: Camera, depths: tuple[float, float]) -> None:
    """Write a camera at rest; `depths` are the distances between which it sees [m]."""
    gf = pxr("Gf")
    prim = pxr("UsdGeom").Camera.Define(stage.stage, path)
    width, height = camera.resolution
    prim.CreateVerticalApertureAttr(APERTURE)
    prim.CreateHorizontalApertureAttr(APERTURE * width / height)
    prim.CreateFocalLengthAttr(0.5 * APERTURE / float(np.tan(0.5 * np.radians(camera.view_angle))))
    prim.CreateClippingRangeAttr(gf.Vec2f(*depths))
    pose = np.eye(4)
    pose[:3] = np.pad([camera.right, camera.up, -camera.forward], ((0, 0), (0, 1)))
    pose[3, :3] = camera.position
    prim.AddTransformOp().Set(gf.Matrix4d(*pose.ravel().tolist()))


def write_group(stage: Stage, path: str, shift: Array | None = None, turn: Array | None = None) -> Any:
    """Write a transform: `shift` [3] [m] after the rotation `turn` [3, 3]; returns its prim."""
    gf = pxr("Gf")
    group = pxr("UsdGeom").Xform.Define(stage.stage, path)
    pose = np.eye(4)
    if turn is not None:
        pose[:3, :3] = turn.T
    if shift is not None:
        pose[3, :3] = shift
    if not np.array_equal(pose, np.eye(4)):
        group.AddTransformOp().Set(gf.Matrix4d(*pose.ravel().tolist()))
    return group.GetPrim()


def _triangles(stage: Stage, path: str, color: Array) -> Any:
    geometry = pxr("UsdGeom")
    prim = geometry.Mesh.Define(stage.stage, path)
    prim.CreateSubdivisionSchemeAttr(geometry.Tokens.none)
    set_color(stage, prim, color)
    return prim


def set_color(stage: Stage, prim: Any, color: Array) -> None:
    """One linear RGB colour for a prim."""
    stage.set(prim.CreateDisplayColorAttr(), color[None])


def linear(color: Array) -> Array:
    """Linear RGB of a colour in sRGB within 0 and 1 (IEC 61966-2-1)."""
    out: Array = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return out


def extent_of(x: Array, radius: float = 0.0) -> Array:
    """Corners [2, 3] of the box around points [P, 3] with a radius; zero without points."""
    return np.stack([x.min(0) - radius, x.max(0) + radius]) if len(x) else np.zeros((2, 3))
