"""Lag of fronts between phases, by the diffusion numbers of the particles that change their phase."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from ..cuda_graphs.capture import DeviceConstantCache, outside_transforms, without_transforms
from ..errors import FrontWarning

LARGEST = 1.0
"""Diffusion number of particles that change their phase, above which a front is reported."""
LAG, LEAST_LAG = 0.45, 0.1
"""Lag of a front in conduction lengths of a step √(κ dt/(ρ C)), and its lag in cells in short steps
(benchmarks/results/heat_fronts.md).
"""


class FrontStatus:
    """Largest diffusion number so far, r = κ dt/(ρ C dx²), of particles that changed their liquid fraction.

    Attributes:
        largest: of each scene, float64 [B] on the device of the particles; None before the first step.
    """

    def __init__(self) -> None:
        self.largest: Tensor | None = None
        self._scene_rows = DeviceConstantCache()

    @torch.no_grad()
    def add(self, number: Tensor, scene: Tensor | None, scenes: int) -> None:
        """Count one step, with the diffusion numbers of the particles that changed their phase in it [P], zero of
        others.
        """
        number = without_transforms(number.detach())
        with outside_transforms():
            largest = self._of_scenes(scenes, number.device)
            if not scenes or not len(number):
                return
            if scene is None:
                torch.maximum(largest, number.amax(), out=largest)
                return
            rows = self._scene_rows.get((scene, scenes), lambda: scene.long().clamp(0, scenes - 1), number)
            largest.scatter_reduce_(0, rows, number.to(largest.dtype), "amax")

    def _of_scenes(self, scenes: int, device: torch.device) -> Tensor:
        if self.largest is None or self.largest.device != device or len(self.largest) != scenes:
            with torch.inference_mode(False):
                self.largest = torch.zeros(scenes, dtype=torch.float64, device=device)
        return self.largest

    @torch.no_grad()
    def add_largest(self, numbers: Tensor) -> None:
        """Count steps, with the largest diffusion number of each scene in them [B]."""
        largest = self._of_scenes(len(numbers), numbers.device)
        torch.maximum(largest, numbers, out=largest)

    def lags(self) -> Tensor | None:
        """Whether fronts of a scene lag behind, bool [B] on the device; None before the first step."""
        return None if self.largest is None else self.largest > LARGEST

    def warn(self) -> None:
        """Warn of fronts with too long steps; waits for the device.

        Warns:
            FrontWarning: by scene and diffusion number.
        """
        if self.largest is None:
            return
        numbers = self.largest.tolist()
        scenes = [b for b, r in enumerate(numbers) if r > LARGEST]
        if scenes:
            r = max(numbers)
            where = "" if len(numbers) == 1 else f" in {len(scenes)} scenes, first in scene {scenes[0]},"
            warnings.warn(
                f"fronts between phases{where} lag behind by up to {LEAST_LAG + LAG * math.sqrt(r):.2g} dx: particles "
                f"changed their phase at a diffusion number of {r:.3g}; reduce dt to a diffusion number of {LARGEST:g} "
                "or less",
                FrontWarning,
                stacklevel=3,
            )

    def reset(self) -> None:
        """Discard the status."""
        if self.largest is not None:
            self.largest.zero_()

    def forget(self, scenes: Tensor) -> None:
        """Discard the status of scenes, bool [B]."""
        if self.largest is not None:
            self.largest.masked_fill_(scenes, 0)
