"""Pictures and video of the Gaussians of a run, with its obstacles and other bodies."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch

from ..data.trajectory import Array, Trajectory
from ..render import obstacle_shapes
from ..render.annotate import write_text
from ..render.camera import framing, light_directions
from ..render.colors import palette_colors
from ..render.ground import Ground
from ..render.shapes import Samples, surface_samples
from ..render.software import SoftwareScene, lit
from ..splats import Gaussians, concatenate, render
from ..splats.harmonics import OFFSET, basis
from ..splats.picture import chosen_backend
from ..splats.placement import axis
from . import check, schema
from .explain import SceneError
from .pictures import draw_by
from .places import obstacle
from .scene import Scene
from .splat_bodies import up_axis
from .splat_frames import Progress, SplatFrames

PIXELS, SAMPLES = 3, (2000, 60_000)
"""Pixels of a picture for each Gaussian on the surface of an obstacle, and the range of the number of these."""
WIDTH, THINNESS = 0.6, 0.06
"""Deviations of such a Gaussian along and across the surface, relative to the distance of its neighbours."""
SOLID = 0.98
"""Opacity of the Gaussians of obstacles that are opaque, and of particles."""


def draw_frames(
    folder: str | Path,
    scene: Scene,
    backend: str = "auto",
    device: torch.device | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Draw the Gaussians of a run by the settings `scene.render`: frames/00000.png, ..., and video.mp4.

    Existing pictures of the same settings are reused. Obstacles, and particles of other bodies in the colours of their
    materials, are drawn as Gaussians too; particles inside an object are not. The ground has the shadows of all.

    Args:
        folder: folder of the run.
        scene: its scene.
        backend: as for `torch_mpm.splats.render`.
        device: where the pictures are computed; None for the CPU.
        progress: called with (frame, frames) after each picture.

    Returns:
        The paths of the pictures, and of the video last.

    Raises:
        SceneError: where `scene.render` does not fit.
        DamagedFileError, OSError, ValueError: as `SplatFrames`.
        ImportError: when a package of the extra ``render`` is missing, or gsplat where it is wanted.
    """
    if problems := list(check.render_problems(scene)):
        raise SceneError(problems, scene.source)

    def artist(trajectory: Trajectory) -> _Artist:
        return _Artist(scene, trajectory, backend, device or torch.device("cpu"))

    return draw_by(artist, folder, scene, progress)


class _Artist:
    """Camera, ground and bodies of a run."""

    def __init__(self, scene: Scene, trajectory: Trajectory, backend: str, device: torch.device) -> None:
        self.frames = SplatFrames(scene, trajectory)
        self.device, self.backend, self.scene = device, backend, scene.relative()
        words, grid = self.scene.render or schema.Render(), self.scene.grid
        lower, upper = (np.array(corner, dtype=np.float64) for corner in (grid.lower, grid.upper))
        low, high = (np.array(corner, dtype=np.float64) for corner in words.view or (grid.lower, grid.upper))
        up = axis(up_axis(scene.gravity)).numpy()
        pixels = words.resolution[0] * words.resolution[1]
        self.samples = min(max(pixels // PIXELS, SAMPLES[0]), SAMPLES[1])
        self.camera = framing(low, high, up, words.resolution, words.azimuth, words.elevation, fill=(0.92, 0.86))
        ground = Ground(lower, upper, up, -light_directions(self.camera)[0])
        self.stage = SoftwareScene(self.camera, ground, (lower, upper))
        volumes = trajectory["volume"][self.frames.others]
        self.radius = 0.5 * float(np.cbrt(volumes.mean())) if len(volumes) else 0.0
        """Deviation of the Gaussians of other particles [m]."""
        drawn = "splats", chosen_backend(self.frames.rest.to(device)) if backend == "auto" else backend
        self.way = hashlib.sha256(repr((scene.model_dump_json(), drawn)).encode()).hexdigest()

    def picture(self, frame: dict[str, Array]) -> Array:
        """One frame, uint8 [H, W, 3]."""
        objects = self.frames.of(frame)
        samples, bodies = self._obstacles(float(frame["time"]))
        others, loose = self._others(frame)
        points = np.concatenate([objects.x.numpy(), loose, *(s.points for s in samples)])
        radii = [np.full(len(objects), _mean_deviation(objects)), np.full(len(loose), self.radius)]
        radii += [np.full(len(s.points), s.radius) for s in samples]
        backdrop = torch.from_numpy(self.stage.backdrop(points, np.concatenate(radii)))
        together = concatenate([objects, *others, *bodies]).to(self.device)
        with torch.no_grad():
            color = render(together, self.camera, backdrop.to(self.device, together.x.dtype) / 255, self.backend).color
        image = (color * 255).round().clamp(0, 255).to(torch.uint8).cpu().numpy()
        image = write_text(image, f"t = {float(frame['time']):.3f} s", "bottom left")
        return write_text(image, self.scene.title, "top left", 1.25) if self.scene.title else image

    def close(self) -> None:
        """Nothing to release."""

    def _obstacles(self, time: float) -> tuple[list[Samples], list[Gaussians]]:
        """Samples of the surfaces of the obstacles at a time [s], and Gaussians on them."""
        samples, bodies = [], []
        for words in self.scene.obstacle:
            for shape in obstacle_shapes(obstacle(words, None), time, (self.scene.grid.lower, self.scene.grid.upper)):
                found = surface_samples(shape, self.samples)
                color = lit(np.array(shape.color), found.normals, self.camera)
                samples.append(found)
                bodies.append(flat(found, color, SOLID * words.opacity, self.frames.rest.x))
        return samples, bodies

    def _others(self, frame: dict[str, Array]) -> tuple[list[Gaussians], Array]:
        """Gaussians at the particles of other bodies, and the positions of these [n, 3]."""
        rows = self.frames.others[self.frames.others < len(frame["position"])]
        x = self.frames.positions(frame, rows)
        if len(rows) == 0:
            return [], x
        like = self.frames.rest.x
        colors = like.new_tensor(palette_colors(frame["material"][rows]) / 255)
        axes = self.radius * torch.eye(3, dtype=like.dtype).expand(len(rows), 3, 3)
        return [solid(torch.from_numpy(x).to(like), axes, colors, SOLID)], x


def flat(samples: Samples, color: Array, opacity: float, like: torch.Tensor) -> Gaussians:
    """Flat Gaussians on a surface, with colours [N, 3], in the dtype of a tensor."""
    normals = torch.from_numpy(samples.normals).to(like)
    across = torch.eye(3, dtype=like.dtype)[normals.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, across), dim=1)
    second = torch.linalg.cross(normals, first)
    axes = samples.radius * torch.stack([WIDTH * first, WIDTH * second, THINNESS * normals], 2)
    return solid(torch.from_numpy(samples.points).to(like), axes, torch.from_numpy(color).to(like), opacity)


def solid(x: torch.Tensor, axes: torch.Tensor, colors: torch.Tensor, opacity: float) -> Gaussians:
    """Gaussians of one colour each [N, 3] from all sides."""
    constant = basis(x.new_zeros(3), 0)
    harmonics = ((colors - OFFSET) / constant)[:, None, :]
    return Gaussians(x, axes, torch.full_like(x[:, 0], opacity).logit(), harmonics)


def _mean_deviation(gaussians: Gaussians) -> float:
    """Mean of the largest deviation [m]."""
    return float(gaussians.factors()[0][:, 0].mean())
