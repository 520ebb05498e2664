"""Pictures and video of the Gaussians of a run, with its obstacles and other bodies."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch

from ..data.trajectory import Array, Trajectory
from ..data.whole_files import output_folder, output_path, remove_leftovers
from ..render import assemble_video, obstacle_shapes, write_png
from ..render.annotate import write_text
from ..render.camera import framing, light_directions
from ..render.cloud import rest_spacing
from ..render.colors import palette_colors
from ..render.ground import Ground
from ..render.images import note_of
from ..render.shapes import Samples, surface_samples
from ..render.software import SoftwareScene, lit
from ..splats import Gaussians, concatenate, render
from ..splats.harmonics import OFFSET, basis
from ..splats.picture import chosen_backend
from ..splats.placement import axis
from . import check, schema
from .explain import SceneError
from .pictures import FOLDER, VIDEO
from .places import obstacle
from .scene import Scene
from .splat_bodies import up_axis
from .splat_frames import Progress, SplatFrames

SAMPLES = 60_000
"""Number of Gaussians on the surface of an obstacle."""
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
    words = scene.render or schema.Render()
    if problems := list(check.render_problems(scene)):
        raise SceneError(problems, scene.source)
    target, video = (output_path(Path(folder), name) for name in (FOLDER, VIDEO))
    remove_leftovers(Path(folder))
    with Trajectory(folder) as trajectory, output_folder(target):
        artist = _Artist(scene, words, trajectory, backend, device or torch.device("cpu"))
        numbers = range(0, len(trajectory), words.every)
        paths = [target / f"{k:05d}.png" for k in numbers]
        for k, path in zip(numbers, paths, strict=True):
            if note_of(path) != artist.way:
                write_png(path, artist.picture(trajectory.frame(k)), note=artist.way)
            if progress is not None:
                progress(k, len(trajectory))
    if not words.video:
        return paths
    assemble_video(paths, video, scene.frames / scene.duration / words.every)
    return [*paths, video]


class _Artist:
    """Camera, ground and bodies of a run."""

    def __init__(
        self, scene: Scene, words: schema.Render, trajectory: Trajectory, backend: str, device: torch.device
    ) -> None:
        self.scene, self.device, self.backend = scene, device, backend
        self.frames = SplatFrames(scene, trajectory)
        lower, upper = (np.array(corner, dtype=np.float64) for corner in (scene.grid.lower, scene.grid.upper))
        corners = words.view or (scene.grid.lower, scene.grid.upper)
        up = axis(up_axis(scene.gravity)).numpy()
        width, height = words.resolution
        low, high = (np.array(corner, dtype=np.float64) for corner in corners)
        self.camera = framing(low, high, up, (width, height), words.azimuth, words.elevation, fill=(0.92, 0.86))
        ground = Ground(lower, upper, up, -light_directions(self.camera)[0])
        self.stage = SoftwareScene(self.camera, ground, (lower, upper))
        first = trajectory.frame(0)["position"]
        others = self.frames.others
        self.radius = 0.5 * rest_spacing(first[others[others < len(first)]].astype(np.float64))
        drawn = "splats", chosen_backend(self.frames.rest.to(device)) if backend == "auto" else backend
        self.way = hashlib.sha256(repr((scene.model_dump_json(), drawn)).encode()).hexdigest()
        """Hash of everything that affects the picture of a frame."""

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

    def _obstacles(self, time: float) -> tuple[list[Samples], list[Gaussians]]:
        """Samples of the surfaces of the obstacles at a time [s], and Gaussians on them."""
        samples, bodies = [], []
        for words in self.scene.obstacle:
            for shape in obstacle_shapes(obstacle(words, None), time, (self.scene.grid.lower, self.scene.grid.upper)):
                found = surface_samples(shape, SAMPLES)
                color = lit(np.array(shape.color), found.normals, self.camera)
                samples.append(found)
                bodies.append(flat(found, color, SOLID * words.opacity, self.frames.rest.x))
        return samples, bodies

    def _others(self, frame: dict[str, Array]) -> tuple[list[Gaussians], Array]:
        """Gaussians at the particles of other bodies, and the positions of these [n, 3]."""
        rows = self.frames.others[self.frames.others < len(frame["position"])]
        x = frame["position"][rows]
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
