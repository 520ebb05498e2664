"""Scenes of a step that fail: reasons in words, and no gradient."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..step.failures import Failures


class GradientGate:
    """Inputs of a step of B scenes, with gradients from it that are zero in scenes that turned out to fail.

    Zero times a NaN is a NaN in the backward pass of such a scene, which would spoil weights that all scenes share.
    """

    def __init__(self) -> None:
        self.failed: Tensor | None = None
        """Scenes that failed, bool [B]; None for no scene. It is assigned after the step, before the backward pass."""

    def __call__(self, value: Tensor) -> Tensor:
        """An input whose rows belong to the scenes in equal numbers, scene after scene."""
        if not value.requires_grad:
            return value
        gated = value.view_as(value)
        gated.register_hook(self._gradient)
        return gated

    def _gradient(self, gradient: Tensor) -> Tensor:
        if self.failed is None:
            return gradient
        failed = self.failed.repeat_interleave(len(gradient) // len(self.failed))
        return torch.where(failed.reshape(-1, *(1,) * (gradient.dim() - 1)), 0.0, gradient)


def sentences(failures: Failures, failed: Sequence[bool]) -> list[str | None]:
    """Why scenes failed; None for the others."""
    problems = (*failures.given.values(), *failures.problems.values())
    found: list[str | None] = [None] * len(failed)
    for b in (b for b, wrong in enumerate(failed) if wrong):
        others = [k != b for k in range(len(failed))]
        parts = [sentence for problem in problems if (sentence := problem.sentence(others))]
        found[b] = "; ".join(parts) or "the observation, the score or a pose is not finite"
    return found
