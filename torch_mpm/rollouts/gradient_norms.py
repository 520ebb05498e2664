"""Norms of the gradients inside a rollout, for each scene: their growth or decay, and where to truncate them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import check_count, check_number
from ..ops.arguments import sum_by_scene
from ..state.state import PARTICLE_FIELDS, TRACKED, State

NORMED = tuple(name for name in TRACKED if name in PARTICLE_FIELDS)
"""Fields with a norm, beside history."""


class GradientNorms:
    """Norms of the gradient of the loss by the states of a rollout: `rollout(..., norms=GradientNorms())`.

    Args:
        every: steps between two states with a norm. A rollout stores each of these states.

    The backward pass fills it, without waiting for the device; the next rollout with it starts anew. A norm is NaN
    for fields that need no gradient, zero for those without one, and infinite for a gradient that is not finite.

    Raises:
        TypeError, ValueError: unless `every` is a positive integer.
    """

    def __init__(self, every: int = 1) -> None:
        self.every = check_count("every", every, 1)
        self._steps: list[int] = []
        self._fields: dict[str, Tensor] = {}
        self._units: dict[str, Any] = {}
        self._scenes = 1

    # ---- in a rollout

    def points(self, first: int, n: int) -> list[int]:
        """Numbers of steps before the states with a norm, and n for the end."""
        return [*range(first, n, self.every), n]

    def start(self, steps: Sequence[int], scenes: int, dx: float, dt: float | Tensor) -> None:
        """Begin another rollout: norms of the previous one are dropped.

        Args:
            steps: numbers of steps before the states with a norm.
            scenes: B.
            dx: node distance [m].
            dt: time step [s].
        """
        self._steps, self._scenes, self._fields = list(steps), scenes, {}
        rate: Any
        if not isinstance(dt, Tensor):
            rate = 1 / dt if dt else 0.0  # The step refuses it.
        else:  # Paused scenes have zero.
            rate = torch.where(dt > 0, 1 / dt.double(), 0).detach().reshape(-1)
        self._units = {"x": dx, "v": dx * rate, "C": rate}

    def watched(self, state: State, k: int) -> State:
        """The same state, with hooks that store the norms of its gradients as those before step k."""
        row, scene = self._steps.index(k), state.scene

        def watch(name: str, t: Tensor) -> Tensor:
            if not (t.is_floating_point() and t.requires_grad and torch.is_grad_enabled()):
                return t
            if name not in self._fields:
                shape = len(self._steps), self._scenes
                self._fields[name] = torch.full(shape, torch.nan, dtype=torch.float64, device=t.device)
            norms = self._fields[name]
            norms[row] = 0

            @torch.no_grad()
            def store_norm(grad: Tensor | None) -> None:
                if grad is None:  # An output without a gradient among others with one.
                    return
                squares = grad.double().square().reshape(len(grad), math.prod(grad.shape[1:])).sum(1)
                norms[row] = sum_by_scene(squares, scene, self._scenes).sqrt().nan_to_num(math.inf, posinf=math.inf)

            # A user's tensor, which would keep the hooks and may be used elsewhere.
            if t.is_leaf or k == self._steps[0]:
                t = t.view_as(t)
            t.register_hook(store_norm)
            return t

        changes = {name: watch(name, t) for name in NORMED if (t := getattr(state, name)) is not None}
        history = {name: t if t.is_leaf else watch(name, t) for name, t in state.extra.items()}
        return state.replace(**changes, extra=history)

    # ---- results

    @property
    def steps(self) -> list[int]:
        """Numbers of steps before the states with a norm, [K]."""
        return self._steps

    @property
    def fields(self) -> dict[str, Tensor]:
        """Norm of the gradient by each field of the states [K, B], in units of the loss per unit of the field."""
        return self._fields

    def total(self) -> Tensor:
        """Root of the sum of squares over x, v, C, F, J, temperature and history [K, B], in units of the loss.

        Fields are scaled by the possible change in a step: x by a node distance, v by a node distance per time step, C
        by one per time step, all others by one. NaN where a field that has a gradient elsewhere needs none, as at the
        start.
        """
        if not self._fields:
            return torch.full((len(self._steps), self._scenes), torch.nan, dtype=torch.float64, device="cpu")
        scaled = torch.stack([self._units.get(name, 1.0) * norms for name, norms in self._fields.items()])
        return scaled.square().sum(0).sqrt()

    def truncation(self, growth: float = 100.0) -> int | None:
        """Value of `truncate` for such rollouts: steps back from the end beyond which gradients carry little
        information.

        Args:
            growth: above 1. A gradient larger by this factor than at the end results from chaos; gradients that stay
                smaller by this factor contribute nothing.

        Returns:
            Number of steps back from the end to the first such state in any scene, at least 1; None where all norms
            are within the bounds. Synchronises.

        Raises:
            ValueError: for a `growth` of 1 or less, or before a backward pass.
        """
        check_number("growth", growth, "a number above 1", lambda v: 1 < v < math.inf)
        total = self.total().cpu()
        found = [_length(total[:, b], self._steps, growth) for b in range(self._scenes)]
        if not bool((total > 0).any()):
            raise ValueError("GradientNorms.truncation needs a backward pass with a gradient first")
        lengths = [length for length in found if length is not None]
        return min(lengths) if lengths else None


def _length(norms: Tensor, steps: Sequence[int], growth: float) -> int | None:
    """Steps back from the end to the first state with a gradient that is too large, or stays too small."""
    back = [(steps[-1] - k, v) for k, v in zip(steps, norms.tolist(), strict=True) if v == v][::-1]
    reference = next((v for _, v in back if v > 0), 0.0)
    lengths = [length for length, v in back if v > growth * reference][:1]
    tail = 0  # Gradients that stay small.
    while tail < len(back) and back[len(back) - 1 - tail][1] * growth < reference:
        tail += 1
    lengths += [length for length, _ in back[len(back) - tail :]][:1]
    return max(min(lengths), 1) if lengths else None
