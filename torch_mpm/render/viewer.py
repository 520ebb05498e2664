"""A viewer in the browser for runs and data sets: play, scrub, colour by a field, pick a scene (extra ``view``)."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..data.clips import Source
from ..data.trajectory import Array
from .cloud import rest_spacing
from .colors import PALETTES, QUANTITIES, Quantity, map_colors, palette_colors, value_range
from .viewer_server import page_address, viser_server

PLAYED_FPS = 30
COUNTED = ("particle_type", *PALETTES)
"""Fields whose numbers are categories."""


class Viewer:
    """Serves a run or a data set on a local port until `close`.

    Args:
        path: folder of a run or of a data set.
        port: port to listen at; the next free one where it is in use.
        host: address to listen at; by default only this machine can connect.

    Attributes:
        url: the page.

    Raises:
        FileNotFoundError, DatasetError: as `Source`.
        ValueError, OSError: for a port or an address that cannot be listened at.
        ImportError: when viser is missing (extra ``view``).
    """

    def __init__(self, path: str | Path, port: int = 8080, host: str = "127.0.0.1") -> None:
        self.source = Source(path)
        self._server: Any = viser_server(host, port)
        self.url = page_address(host, self._server.get_port())
        self._lock, self._stop = threading.Lock(), threading.Event()
        first = next(iter(self.source.scenes))
        self.clip = self.source.clip(first)
        self._build(first)
        self._thread = threading.Thread(target=self._play, name="torch_mpm viewer", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._stop.set()
        self._thread.join()
        self._server.stop()

    def wait(self) -> None:
        """Serve until the process is interrupted."""
        while not self._stop.wait(1.0):
            pass

    # ---- the page

    def _build(self, first: str) -> None:
        server, clip = self._server, self.clip
        flat = clip.position.shape[2] == 2
        server.scene.set_up_direction("+y")
        server.gui.set_panel_label(self.source.title or self.source.path.name)
        self._scene = server.gui.add_dropdown("scene", tuple(self.source.scenes), initial_value=first)
        self._color = server.gui.add_dropdown("colour", tuple(clip.fields), initial_value="speed")
        self._frame = server.gui.add_slider("frame", 0, max(1, len(clip.position) - 1), 1, 0)
        self._playing = server.gui.add_checkbox("play", False)
        self._speed = server.gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
        self._size = server.gui.add_slider("size", 0.2, 3.0, 0.1, 1.0)
        self._legend = server.gui.add_markdown("")
        self._cloud = server.scene.add_point_cloud("particles", np.zeros((1, 3), "f4"), (0, 0, 0), point_shape="circle")
        lower, upper = (self._three(np.asarray(b, float)[None])[0] for b in self.source.bounds)
        size, centre = np.maximum(upper - lower, 1e-6), 0.5 * (lower + upper)
        server.scene.add_line_segments("domain", _edges(lower, upper), (128, 128, 128))
        away = 1.3 * size.max()
        server.initial_camera.look_at = tuple(centre)
        server.initial_camera.position = tuple(centre + away * np.array([0, 0, 1] if flat else [0.7, 0.5, 1.0]))
        server.initial_camera.up = (0.0, 1.0, 0.0)
        self._scene.on_update(lambda _: self._choose())
        for control in (self._color, self._frame, self._size):
            control.on_update(lambda _: self.show())
        self._measure()
        self.show()

    def _choose(self) -> None:
        clip = self.source.clip(self._scene.value)
        with self._lock:
            self.clip = clip
            self._measure()
        self._color.options = tuple(clip.fields)  # This scene may lack the previous field.
        self._frame.max = max(1, len(clip.position) - 1)
        self._frame.value = 0
        self.show()

    def _measure(self) -> None:
        """Distance of neighbours, and ranges of the colours over all frames."""
        there = self.clip.position[-1][np.isfinite(self.clip.position[-1]).all(1)].astype(float)
        extent = float(np.max(np.subtract(self.source.bounds[1], self.source.bounds[0])))
        self._spacing = (rest_spacing(there) if len(there) > 1 else 0.0) or 0.02 * extent
        self._ranges: dict[str, tuple[float, float]] = {}

    def show(self) -> None:
        """Show the chosen frame."""
        with self._lock:
            frame = min(self._frame.value, len(self.clip.position) - 1)
            name = self._color.value if self._color.value in self.clip.fields else "speed"
            x, values = self.clip.position[frame], self.clip.values(name, frame)
            there = np.isfinite(x).all(1)
            with self._server.atomic():
                self._cloud.points = self._three(x[there])
                self._cloud.colors = self._colors(name, values)[there]
                self._cloud.point_size = 0.5 * self._spacing * self._size.value
            self._legend.content = (
                f"t = {frame * self.clip.interval:.3f} s, {int(there.sum())} particles\n\n{self._scale(name)}"
            )

    def _range(self, name: str) -> tuple[float, float]:
        if name not in self._ranges:
            numbers = np.linspace(0, len(self.clip.position) - 1, 8).round().astype(int)
            values = np.concatenate([self.clip.values(name, int(k)) for k in numbers])
            self._ranges[name] = value_range(values.astype(float), _quantity(name).from_zero)
        return self._ranges[name]

    def _colors(self, name: str, values: Array) -> Array:
        if name in COUNTED:
            return palette_colors(values)
        return map_colors(
            values.astype(float), self._range(name), QUANTITIES.get(name, Quantity("", "", "viridis")).cmap
        )

    def _scale(self, name: str) -> str:
        if name in COUNTED:
            return name
        quantity, (low, high) = _quantity(name), self._range(name)
        return f"{quantity.label} from {low:.3g} to {high:.3g} {quantity.unit}"

    @staticmethod
    def _three(x: Array) -> Array:
        return np.pad(x, [(0, 0), (0, 3 - x.shape[1])]).astype(np.float32)

    def _play(self) -> None:
        """Move the slider while the box is ticked, in real time; frames are skipped where there are too many."""
        since = time.perf_counter()
        position = 0.0
        while not self._stop.wait(1 / PLAYED_FPS):
            now = time.perf_counter()
            passed, since = now - since, now
            if not self._playing.value:
                position = float(self._frame.value)
                continue
            if int(position) != self._frame.value:  # Moved by hand.
                position = float(self._frame.value)
            frames = len(self.clip.position)
            position = following_frame(position, passed, self._speed.value, self.clip.interval, frames)
            if int(position) != self._frame.value:
                self._frame.value = int(position)


def following_frame(position: float, seconds: float, speed: float, interval: float, frames: int) -> float:
    """Position in a clip some seconds later, at a multiple ``speed`` of real time; the clip restarts at its end."""
    return (position + seconds * speed / interval) % frames if frames > 1 else 0.0


def _quantity(name: str) -> Quantity:
    return QUANTITIES.get(name, Quantity(name, "", "viridis"))


def _edges(lower: Array, upper: Array) -> Array:
    """Both ends of the twelve edges of a box, [12, 2, 3]."""
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"), -1)
    along = [np.moveaxis(corners, axis, 2).reshape(4, 2, 3) for axis in range(3)]
    return np.concatenate(along).astype(np.float32)
