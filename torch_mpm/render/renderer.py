"""`Renderer`: from particle arrays to a picture, the same call for 2-D and 3-D."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..surfaces.reconstruction import Surface
from .annotate import blend, scale_overlay, scale_width, write_text
from .camera import framing, light_directions, up_axis
from .cloud import Skin, rest_spacing
from .colors import PALETTES, PLAIN, QUANTITIES, Quantity, map_colors, numpy_of, palette_colors, scalar_of, value_range
from .ground import Ground
from .requires import RenderError, require
from .scene2d import Overlay, Scene2D
from .scene3d import Scene3D, window_class
from .shapes import Array, Shape, vector
from .software import SoftwareScene

log = logging.getLogger(__name__)


class Renderer:
    """Draws particles, ground and obstacles of a scene, one frame per call, without a screen.

    Args:
        bounds: (lower [D], upper [D]) of the domain in metres; D = 2 or 3. It is drawn as a box and framed.
        resolution: (width, height) in pixels.
        color_by: "speed" [m/s], "stress" (von Mises) or "pressure" [Pa], "temperature" [K], "material", "layer", any
            other label for a user scalar (then give `unit`), or None for one colour.
        range: (lo, hi) of the colour scale in that unit. None uses the range of each frame, which flickers in a video.
        cmap: a matplotlib colour map name; None uses that of the quantity.
        unit: unit shown on the scale; None uses that of the quantity.
        gravity: [D] vector; its opposite is up. Default: up is y.
        radius: particle radius [m]; None uses 0.6 (0.75 in 2-D) of the particle spacing of the first frame, or of the
            argument of `fit_radius`.
        style: "particles" (spheres, discs in 2-D) or "surface" (3-D only: a smooth skin around the particles).
        materials: names of materials 0, 1, ... for the legend of color_by="material".
        azimuth, elevation: direction of the camera in degrees (3-D), around and above the horizontal plane.
        view: (lower [D], upper [D]) to frame instead of the bounds.
        exaggeration: scale of heights over that of lengths (2-D); particles stay round.
        origin: coordinates [m], D numbers, to which all others are relative: the axes show theirs (2-D).
        ground: draw the ground at the lower face of the bounds (3-D).
        backend: "vtk", "software" (3-D without OpenGL, plainer), or "auto": VTK, and where VTK finds no OpenGL a logged
            warning and "software". The attribute `backend` is the selected one; 2-D is "matplotlib".

    Raises:
        ImportError: a package of the `render` extra is missing.
        RenderError: backend is "vtk" and VTK finds no OpenGL; the message names the packages to install.
        ValueError: an argument has the wrong shape or value.
    """

    def __init__(
        self,
        bounds: tuple[npt.ArrayLike, npt.ArrayLike],
        resolution: tuple[int, int] = (1280, 720),
        color_by: str | None = "speed",
        range: tuple[float, float] | None = None,
        cmap: str | None = None,
        *,
        unit: str | None = None,
        gravity: npt.ArrayLike | None = None,
        radius: float | None = None,
        style: str = "particles",
        materials: Sequence[str] = (),
        azimuth: float = 28.0,
        elevation: float = 18.0,
        view: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
        exaggeration: float = 1.0,
        origin: npt.ArrayLike | None = None,
        ground: bool = True,
        backend: str = "auto",
    ) -> None:
        self.bounds = _box("bounds", bounds, None)
        self.dim = len(self.bounds[0])
        if style not in ("particles", "surface") or (style == "surface" and self.dim == 2):
            raise ValueError(f"style must be 'particles' or, in 3-D, 'surface', got {style!r}")
        if range is not None and not range[0] < range[1]:
            raise ValueError(f"range must be (lo, hi) with lo < hi, got {range}")
        if not 0 < exaggeration < np.inf or (exaggeration != 1 and self.dim == 3):
            raise ValueError(f"exaggeration must be positive, and 1 in 3-D, got {exaggeration}")
        self.resolution = (int(resolution[0]), int(resolution[1]))
        self.color_by, self.limits, self.radius, self.style = color_by, range, radius, style
        quantity = QUANTITIES.get(color_by or "", Quantity(color_by or "", "", "viridis"))
        self.quantity = quantity if unit is None else replace(quantity, unit=unit)
        self.cmap = cmap or quantity.cmap
        self.names = tuple(materials) if color_by == "material" else ()
        frame = self.bounds if view is None else _box("view", view, self.dim)
        self.has_scale = color_by is not None and color_by not in PALETTES
        self.scene: Scene2D | Scene3D | SoftwareScene
        if backend not in ("auto", "vtk", "software"):
            raise ValueError(f"backend must be 'auto', 'vtk' or 'software', got {backend!r}")
        if self.dim == 2:
            self.backend = "matplotlib"
            zero = None if origin is None else vector("origin", origin, 2)
            self.scene = Scene2D(frame, self.resolution, self.has_scale, exaggeration, zero)
        else:
            self.backend = _choose(backend)
            fill = (1 - 1.7 * scale_width(self.resolution) if color_by else 0.92, 0.86)
            up = up_axis(gravity)
            camera = framing(*frame, up, self.resolution, azimuth, elevation, fill=fill)
            plate = Ground(*self.bounds, up, -light_directions(camera)[0]) if ground else None
            draws = Scene3D if self.backend == "vtk" else SoftwareScene
            self.scene = draws(camera, plate, self.bounds)

    def frame(
        self,
        x: Any,
        scalars: Any = None,
        obstacles: Sequence[Shape] = (),
        overlays: Sequence[Overlay] = (),
        time: float | None = None,
        title: str = "",
        surfaces: Sequence[tuple[Surface, Any]] = (),
    ) -> Array:
        """One picture, uint8 [H, W, 3].

        Args:
            x: positions [P, D] in metres, torch or numpy. Particles that are not finite are skipped and logged.
            scalars: [P] for the colour; also velocities [P, D] for "speed", stresses [P, 3, 3] for "stress" (von Mises;
                in 2-D with the out-of-plane component), numbers for "material" and "layer". Not finite: grey.
            obstacles: shapes of `torch_mpm.render.shapes` at their poses at this time.
            overlays: (points [N, D] in metres, colour, label) polylines over the picture.
            time: seconds, written into the picture.
            title: text at the top left.
            surfaces: meshes to draw beside the particles (3-D), with the scalars of their vertices.
        """
        x = numpy_of(x)
        if x.ndim != 2 or x.shape[1] != self.dim:
            raise ValueError(f"x must have shape [P, {self.dim}], got {list(x.shape)}")
        if any(o.dim != self.dim for o in obstacles):
            raise ValueError(f"obstacles must have {self.dim} dimensions like the bounds")
        if surfaces and self.dim == 2:
            raise ValueError("surfaces need three dimensions, and the bounds have two")
        counts = [len(x), *(len(surface.vertices) for surface, _ in surfaces)]
        (rgb, *tints), limits = self._colors([scalars, *(values for _, values in surfaces)], counts)
        skins = [Skin(*surface, tint) for (surface, _), tint in zip(surfaces, tints, strict=True)]
        finite = np.isfinite(x).all(axis=1)
        if not finite.all():
            log.warning("%d of %d particles have no finite position and are not drawn", int((~finite).sum()), len(x))
        x, rgb = x[finite].astype(np.float64), rgb[finite]
        self.fit_radius(x)
        radius = self.radius or 0.0
        stamp = "" if time is None else f"t = {time:.3f} s"
        if isinstance(self.scene, Scene2D):
            if limits is not None:
                self.scene.set_scale(self.quantity, limits, self.cmap)
            return self.scene.draw(x, rgb, radius, obstacles, overlays, self.names, title, stamp)
        image = self.scene.draw(x, rgb, radius, self.style, obstacles, skins)
        return self._annotate(image, overlays, limits, title, stamp)

    def fit_radius(self, x: Array) -> None:
        """Choose the radius from particles [P, D], where it is neither given nor chosen yet; `frame` does this too."""
        x = x[np.isfinite(x).all(axis=1)]
        if self.radius is None and len(x):
            extent = float(np.max(self.bounds[1] - self.bounds[0]))
            self.radius = (0.6 if self.dim == 3 else 0.75) * rest_spacing(x) or 0.02 * extent

    def project(self, points: npt.ArrayLike) -> Array:
        """Pixel coordinates (column, row) [N, 2] at which points [N, D] in metres appear."""
        at = np.asarray(points, dtype=np.float64)
        return self.scene.to_pixels(at) if isinstance(self.scene, Scene2D) else self.scene.camera.project(at)[:, :2]

    def close(self) -> None:
        """Release the renderer's OpenGL context (3-D)."""
        if not isinstance(self.scene, Scene2D):
            self.scene.close()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _colors(self, scalars: Sequence[Any], counts: Sequence[int]) -> tuple[list[Array], tuple[float, float] | None]:
        """Colours uint8 [P, 3] of particles and of each surface, and the range of their common scale."""
        if self.color_by is None:
            return [np.tile((np.array(PLAIN) * 255).astype(np.uint8), (count, 1)) for count in counts], None
        if any(part is None for part in scalars):
            raise ValueError(f"scalars must be given for color_by={self.color_by!r}, got None")
        values = [scalar_of(self.color_by, numpy_of(s), n) for s, n in zip(scalars, counts, strict=True)]
        if self.color_by in PALETTES:
            return [palette_colors(part, PALETTES[self.color_by]) for part in values], None
        limits = self.limits or value_range(np.concatenate(values), self.quantity.from_zero)
        return [map_colors(part, limits, self.cmap) for part in values], limits

    def _annotate(
        self, image: Array, overlays: Sequence[Overlay], limits: tuple[float, float] | None, title: str, stamp: str
    ) -> Array:
        if overlays:
            image = self._draw_lines(image, overlays)
        if limits is not None or self.names:
            image = blend(image, scale_overlay(self.resolution, self.quantity, limits, self.cmap, self.names))
        if title:
            image = write_text(image, title, "top left", 1.25)
        return write_text(image, stamp, "bottom left") if stamp else image

    def _draw_lines(self, image: Array, overlays: Sequence[Overlay]) -> Array:
        pil = require("PIL.Image").fromarray(image)
        pen = require("PIL.ImageDraw").Draw(pil)
        for points, color, _ in overlays:
            pen.line([tuple(p) for p in self.project(points)], fill=color, width=3)
        return np.array(pil)


def _box(name: str, box: tuple[npt.ArrayLike, npt.ArrayLike], dim: int | None) -> tuple[Array, Array]:
    lower = vector(f"{name}[0]", box[0], dim)
    upper = vector(f"{name}[1]", box[1], len(lower))
    if not np.all(lower < upper):
        raise ValueError(f"{name} must be (lower, upper) with lower < upper, got {lower.tolist()}, {upper.tolist()}")
    return lower, upper


def _choose(backend: str) -> str:
    """Backend that draws 3-D on this machine."""
    if backend == "software":
        return backend
    try:
        window_class()
    except RenderError as error:
        if backend == "vtk":
            raise
        log.warning("%s. Until then pictures are drawn in software: plainer, and without surfaces.", error)
        return "software"
    return "vtk"
