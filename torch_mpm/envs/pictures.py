"""Pictures of the scenes of an environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..boundaries.obstacles import Obstacle
from ..rollouts.environments import Environments

RESOLUTION = (480, 360)


class Pictures:
    """A renderer for the scenes of a batch, which is made for the first picture."""

    def __init__(self) -> None:
        self._renderer: Any = None

    def draw(self, envs: Environments, b: int, lines: list[Any]) -> np.ndarray:
        """Picture of scene b, uint8 [H, W, 3], with its obstacles where they are, and with lines over it."""
        from .. import render

        grid = envs.step.grid
        if self._renderer is None:
            up = np.eye(grid.dim)[-1]
            self._renderer = render.Renderer((grid.lower, grid.upper), RESOLUTION, None, gravity=-up)
        state = envs.scene(b)
        shapes = [
            shape
            for boundary in envs.step.boundaries
            if isinstance(boundary, Obstacle)
            for shape in render.obstacle_shapes(boundary, float(envs.time[b]), (grid.lower, grid.upper), b)
        ]
        image: np.ndarray = self._renderer.frame(state.x.detach(), obstacles=shapes, overlays=lines, time=state.time)
        return image

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
