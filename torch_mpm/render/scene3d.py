"""Three-dimensional pictures through VTK, off screen: spheres or a surface, ambient occlusion, soft shadows."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from .camera import LIGHTS, Camera, light_directions
from .cloud import Skin, surface, visible
from .ground import BACKGROUND, Ground
from .requires import RenderError, require
from .shapes import Array, Shape, surface_samples

CULL_FROM = 20_000  # Number of particles below which finding hidden ones costs more than drawing them.

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

    VTK's wheel includes no OpenGL and crashes without one, so separate processes try first.
    """
    modules = [require("vtkmodules.vtkRenderingOpenGL2"), require("vtkmodules.vtkRenderingCore")]
    for kind in WINDOWS:
        found = next((getattr(m, kind) for m in modules if hasattr(m, kind)), None)
        if (
            found
            and subprocess.run([sys.executable, "-c", _PROBE, kind], capture_output=True, check=False).returncode == 0
        ):
            return found
    raise RenderError(
        "VTK finds no OpenGL on this machine (neither EGL, nor OSMesa, nor a screen). A software OpenGL will do: "
        "apt-get install libosmesa6, or libegl1 and libgl1-mesa-dri (Debian, Ubuntu)"
    )


class Scene3D:
    """A VTK render window that draws one frame after another. Build once, call `draw` per frame."""

    def __init__(
        self, camera: Camera, ground: Ground | None, bounds: tuple[Array, Array], occlusion: bool = True
    ) -> None:
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
        self.occlusion = occlusion

    def draw(
        self,
        x: Array,
        rgb: Array,
        radius: float,
        style: str,
        obstacles: Sequence[Shape],
        skins: Sequence[Skin] = (),
    ) -> Array:
        """The picture, uint8 [H, W, 3], of finite positions x [P, 3] m with colours uint8 [P, 3], and of surfaces."""
        for actor in self.moving:
            self.renderer.RemoveActor(actor)
        if self.occlusion and any(o.opacity < 1 for o in obstacles):
            self._add_passes(occlusion=False)  # It would darken objects behind glass in stripes.
            self.occlusion = False
        self.moving = [self._obstacle_actor(o) for o in obstacles]
        self.moving += [self._surface_actor(skin) for skin in skins if len(skin.faces)]
        shown = visible(x, 2 * radius) if len(x) > CULL_FROM and style == "particles" else np.ones(len(x), dtype=bool)
        if len(x) and style == "surface":
            skin, shown = surface(x, rgb, 2 * radius)
            self.moving.append(self._surface_actor(skin))
        if len(x):
            self.moving.append(self._spheres_actor(x[shown], rgb[shown], radius))
        for actor in self.moving:
            self.renderer.AddActor(actor)
        if self.ground is not None:
            self._shade_ground(np.concatenate([x, *(skin.vertices for skin in skins)]), radius, obstacles)
        self.window.Render()
        return self._pixels()

    def close(self) -> None:
        """Release the OpenGL context and its memory."""
        self.window.Finalize()

    def _place_camera(self) -> None:
        camera = self.renderer.GetActiveCamera()
        camera.SetPosition(*self.camera.position)
        camera.SetFocalPoint(*(self.camera.position + self.camera.forward))
        camera.SetViewUp(*self.camera.up)
        camera.SetViewAngle(self.camera.view_angle)

    def _place_lights(self) -> None:
        self.renderer.AutomaticLightCreationOff()
        for direction, strength in zip(light_directions(self.camera), LIGHTS, strict=True):
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
            shading.SetBias(0.0025 * scale)
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

    def _shade_ground(self, x: Array, radius: float, obstacles: Sequence[Shape]) -> None:
        assert self.ground is not None
        samples = [surface_samples(o, count=4000) for o in obstacles if o.opacity == 1]
        radii = [np.full(len(x), radius), *(np.full(len(s.points), s.radius) for s in samples)]
        pixels = self.ground.texture(np.concatenate([x, *(s.points for s in samples)]), np.concatenate(radii))
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

    def _obstacle_actor(self, obstacle: Shape) -> Any:
        assert obstacle.faces is not None
        body = self._polydata(obstacle.world(), obstacle.faces)
        normals = require("vtkmodules.vtkFiltersCore").vtkPolyDataNormals()
        normals.SetInputData(body)
        normals.SetFeatureAngle(40)
        normals.Update()
        actor = self._actor(normals.GetOutput(), obstacle.color)
        actor.GetProperty().SetAmbient(0.40)
        actor.GetProperty().SetDiffuse(0.7)
        actor.GetProperty().SetOpacity(obstacle.opacity)
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
        """Triangles, or, without faces, one cell with all points (the sphere mapper draws the points of cells)."""
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
