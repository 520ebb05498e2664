"""Three-dimensional pictures through VTK, off screen: sphere impostors or a surface, ambient occlusion, soft shadows."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from typing import Any, Sequence

import numpy as np

from .camera import Camera
from .cloud import Skin, surface, visible
from .ground import BACKGROUND, Ground
from .requires import RenderError, require
from .shapes import Array, Obstacle

CULL_FROM = 20_000  # particles; below this, finding the hidden ones costs more than drawing them

# Off-screen windows in the order of preference: GPU or Mesa through EGL, Mesa's OSMesa, then the system's own.
WINDOWS = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow", "vtkRenderWindow")

_PROBE = """
import sys
from vtkmodules import vtkRenderingCore, vtkRenderingOpenGL2
kind = sys.argv[1]
window = (getattr(vtkRenderingOpenGL2, kind, None) or getattr(vtkRenderingCore, kind))()
window.OffScreenRenderingOn()
window.AddRenderer(vtkRenderingCore.vtkRenderer())
window.Render()
raise SystemExit(0 if window.SupportsOpenGL() else 3)
"""


@cache
def window_class() -> Any:
    """The VTK window that can draw on this machine; raises RenderError when there is none.

    VTK's wheel brings no OpenGL of its own and crashes where there is none, so separate processes try first.
    """
    modules = [require("vtkmodules.vtkRenderingOpenGL2"), require("vtkmodules.vtkRenderingCore")]
    for kind in WINDOWS:
        found = next((getattr(m, kind) for m in modules if hasattr(m, kind)), None)
        if found and subprocess.run([sys.executable, "-c", _PROBE, kind], capture_output=True, check=False).returncode == 0:
            return found
    raise RenderError(
        "VTK finds no OpenGL on this machine (neither EGL, nor OSMesa, nor a screen). A software OpenGL will do: "
        "apt-get install libegl1 libgl1-mesa-dri (Debian, Ubuntu), dnf install mesa-libEGL mesa-dri-drivers (Fedora)"
    )


class Scene3D:
    """A VTK render window that draws one frame after another. Build once, call `draw` per frame."""

    def __init__(self, camera: Camera, ground: Ground | None, bounds: tuple[Array, Array], occlusion: bool = True) -> None:
        self.core = require("vtkmodules.vtkRenderingCore")
        self.gl = require("vtkmodules.vtkRenderingOpenGL2")
        self.data = require("vtkmodules.vtkCommonDataModel")
        self.support = require("vtkmodules.util.numpy_support")
        self.camera, self.ground, self.bounds = camera, ground, bounds
        self.window = window_class()()
        self.window.OffScreenRenderingOn()
        self.window.SetMultiSamples(0)
        self.window.SetSize(*camera.resolution)
        self.renderer = self.core.vtkRenderer()
        self.renderer.SetBackground(*BACKGROUND)
        self.window.AddRenderer(self.renderer)
        self._place_camera()
        self._place_lights()
        self._add_passes(occlusion)
        self._add_outline()
        if ground is not None:
            self._add_ground(ground)
        self.moving: list[Any] = []

    def draw(self, x: Array, rgb: Array, radius: float, style: str, obstacles: Sequence[Obstacle]) -> Array:
        """The picture, uint8 [H, W, 3], of finite positions x [P, 3] m with colours uint8 [P, 3]."""
        for actor in self.moving:
            self.renderer.RemoveActor(actor)
        self.moving = [self._obstacle_actor(o) for o in obstacles]
        shown = visible(x, 2 * radius) if len(x) > CULL_FROM and style == "particles" else np.ones(len(x), dtype=bool)
        if len(x) and style == "surface":
            skin = surface(x, rgb, 2 * radius)
            self.moving.append(self._surface_actor(skin))
            shown = skin.loose
        if len(x):
            self.moving.append(self._spheres_actor(x[shown], rgb[shown], radius))
        for actor in self.moving:
            self.renderer.AddActor(actor)
        if self.ground is not None:
            self._shade_ground(x, radius, obstacles)
        self.window.Render()
        return self._pixels()

    def close(self) -> None:
        """Give the OpenGL context and its memory back."""
        self.window.Finalize()

    def _place_camera(self) -> None:
        camera = self.renderer.GetActiveCamera()
        camera.SetPosition(*self.camera.position)
        camera.SetFocalPoint(*(self.camera.position + self.camera.forward))
        camera.SetViewUp(*self.camera.up)
        camera.SetViewAngle(self.camera.view_angle)

    def _place_lights(self) -> None:
        self.renderer.AutomaticLightCreationOff()
        key = key_light(self.camera)
        fill = 0.75 * self.camera.right - 0.15 * self.camera.up - 0.6 * self.camera.forward
        for direction, strength in ((-key, 0.85), (fill, 0.40)):
            light = self.core.vtkLight()
            light.SetLightTypeToSceneLight()
            light.SetPosition(*direction)
            light.SetFocalPoint(0, 0, 0)
            light.SetIntensity(strength)
            self.renderer.AddLight(light)

    def _add_passes(self, occlusion: bool) -> None:
        last = self.gl.vtkRenderStepsPass()
        if occlusion:
            shading = self.gl.vtkSSAOPass()
            scale = float(np.linalg.norm(self.bounds[1] - self.bounds[0]))
            shading.SetRadius(0.04 * scale)
            shading.SetBias(0.0015 * scale)
            shading.SetKernelSize(32)
            shading.BlurOn()
            shading.SetDelegatePass(last)
            last = shading
        smooth = self.gl.vtkOpenGLFXAAPass()
        smooth.SetDelegatePass(last)
        self.renderer.SetPass(smooth)

    def _add_outline(self) -> None:
        source = require("vtkmodules.vtkFiltersSources").vtkOutlineSource()
        lower, upper = self.bounds
        source.SetBounds(lower[0], upper[0], lower[1], upper[1], lower[2], upper[2])
        source.Update()
        actor = self._actor(source.GetOutput(), (0.55, 0.57, 0.6))
        actor.GetProperty().LightingOff()
        actor.GetProperty().SetLineWidth(1.2)
        self.renderer.AddActor(actor)

    def _add_ground(self, ground: Ground) -> None:
        plate = self._polydata(ground.corners(), np.array([[0, 1, 2], [0, 2, 3]]))
        coordinates = self._array(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32))
        plate.GetPointData().SetTCoords(coordinates)
        actor = self._actor(plate, (1, 1, 1))
        actor.GetProperty().LightingOff()
        self.texture = self.core.vtkTexture()
        self.texture.InterpolateOn()
        self.texture.MipmapOn()
        actor.SetTexture(self.texture)
        self.renderer.AddActor(actor)

    def _shade_ground(self, x: Array, radius: float, obstacles: Sequence[Obstacle]) -> None:
        assert self.ground is not None
        blockers, radii = [x], [np.full(len(x), radius)]
        for obstacle in obstacles:
            points, spread = surface_samples(obstacle)
            blockers.append(points)
            radii.append(np.full(len(points), spread))
        pixels = self.ground.texture(np.concatenate(blockers), np.concatenate(radii))
        image = self.data.vtkImageData()
        image.SetDimensions(pixels.shape[1], pixels.shape[0], 1)
        image.GetPointData().SetScalars(self._array(pixels.reshape(-1, 3)))
        self.texture.SetInputData(image)

    def _spheres_actor(self, x: Array, rgb: Array, radius: float) -> Any:
        cloud = self._polydata(x, None)
        cloud.GetPointData().SetScalars(self._array(rgb))
        mapper = self.gl.vtkOpenGLSphereMapper()
        mapper.SetRadius(radius)
        mapper.SetInputData(cloud)
        return self._shaded(mapper)

    def _surface_actor(self, skin: Skin) -> Any:
        body = self._polydata(skin.vertices, skin.faces)
        body.GetPointData().SetScalars(self._array(skin.colors))
        body.GetPointData().SetNormals(self._array(skin.normals.astype(np.float32)))
        mapper = self.core.vtkPolyDataMapper()
        mapper.SetInputData(body)
        actor = self._shaded(mapper)
        actor.GetProperty().SetSpecular(0.35)
        actor.GetProperty().SetSpecularPower(40)
        return actor

    def _obstacle_actor(self, obstacle: Obstacle) -> Any:
        assert obstacle.faces is not None
        body = self._polydata(obstacle.world(), obstacle.faces)
        normals = require("vtkmodules.vtkFiltersCore").vtkPolyDataNormals()
        normals.SetInputData(body)
        normals.SetFeatureAngle(40)
        normals.Update()
        actor = self._actor(normals.GetOutput(), obstacle.color)
        actor.GetProperty().SetAmbient(0.40)
        actor.GetProperty().SetDiffuse(0.7)
        return actor

    def _shaded(self, mapper: Any) -> Any:
        mapper.SetColorModeToDirectScalars()
        actor = self.core.vtkActor()
        actor.SetMapper(mapper)
        look = actor.GetProperty()
        look.SetAmbient(0.36)
        look.SetDiffuse(0.85)
        look.SetSpecular(0.12)
        look.SetSpecularPower(20)
        return actor

    def _actor(self, polydata: Any, color: Sequence[float]) -> Any:
        mapper = self.core.vtkPolyDataMapper()
        mapper.SetInputData(polydata)
        actor = self.core.vtkActor()
        actor.SetMapper(mapper)
        actor.GetProperty().SetColor(*color)
        return actor

    def _polydata(self, points: Array, faces: Array | None) -> Any:
        """Triangles, or, without faces, one cell that holds every point (the sphere mapper draws cells' points)."""
        out = self.data.vtkPolyData()
        vertices = require("vtkmodules.vtkCommonCore").vtkPoints()
        vertices.SetData(self._array(points.astype(np.float32)))
        out.SetPoints(vertices)
        rows = np.arange(len(points))[None] if faces is None else faces
        cells = self.data.vtkCellArray()
        offsets = np.arange(len(rows) + 1, dtype=np.int64) * rows.shape[1]
        cells.SetData(self._array(offsets), self._array(rows.astype(np.int64).ravel()))
        if faces is None:
            out.SetVerts(cells)
        else:
            out.SetPolys(cells)
        return out

    def _array(self, values: Array) -> Any:
        return self.support.numpy_to_vtk(np.ascontiguousarray(values), deep=True)

    def _pixels(self) -> Array:
        width, height = self.camera.resolution
        buffer = require("vtkmodules.vtkCommonCore").vtkUnsignedCharArray()
        self.window.GetPixelData(0, 0, width - 1, height - 1, 1, buffer, 0)
        return self.support.vtk_to_numpy(buffer).reshape(height, width, 3)[::-1].copy()


def key_light(camera: Camera) -> Array:
    """Direction in which the key light shines: from above, left of the camera and behind it."""
    direction = 0.55 * camera.right - 0.9 * camera.up + 0.55 * camera.forward
    return direction / np.linalg.norm(direction)


def surface_samples(obstacle: Obstacle, count: int = 4000) -> tuple[Array, float]:
    """Points [N, 3] spread over an obstacle's surface and the radius [m] at which they cover it."""
    assert obstacle.faces is not None
    corners = obstacle.world()[obstacle.faces]
    edges = corners[:, 1:] - corners[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    per_face = np.maximum(1, np.ceil(count * area / max(area.sum(), 1e-300))).astype(np.int64)
    face = np.repeat(np.arange(len(area)), per_face)
    # The plastic number's sequence (Roberts 2018) fills the unit square evenly; folding maps it to the triangle.
    uv = np.arange(1, len(face) + 1)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]) % 1
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    points = corners[face, 0] + np.einsum("nk,nkd->nd", uv, edges[face])
    return points, float(np.sqrt(area.sum() / len(face)))
