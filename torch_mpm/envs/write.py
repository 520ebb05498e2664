"""Write a letter in clay with a stylus."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Capsule, Walls
from ..geometry import seed
from ..geometry.vectors import norm
from ..grid.grid import Grid
from ..laws import VonMises
from ..state.state import State
from ..step.step import Step
from .vector import MaterialEnv, Scenes

UPPER = (0.8, 0.8, 0.5)  # of the domain from the origin [m]
CLAY = 0.12  # height of the clay, which covers the floor [m]
RADIUS, HALF = 0.08, 0.08  # of the stylus, an upright capsule, and half of the length of its axis [m]
BOTTOM = 0.06  # height of the bottom of the groove of a letter [m]
LOWEST = (0.15, 0.15, BOTTOM + RADIUS + HALF)
HIGHEST = (0.65, 0.65, UPPER[2] - RADIUS - HALF)  # positions of the stylus [m]
LETTERS = {
    "I": ((0.4, 0.6), (0.4, 0.2)),
    "L": ((0.25, 0.6), (0.25, 0.2), (0.55, 0.2)),
    "V": ((0.25, 0.6), (0.4, 0.2), (0.55, 0.6)),
    "Z": ((0.25, 0.6), (0.55, 0.6), (0.25, 0.2), (0.55, 0.2)),
}
"""Corners of the stroke of each letter on the floor [m]."""
CORNERS = max(len(corners) for corners in LETTERS.values())
POINTS = 12  # along the stroke of a letter, which the observation has


class Write(MaterialEnv):
    """A stylus draws a letter into a plate of clay.

    Action [3]: velocity of the stylus, in units of 1 m/s.

    Observation [39]: position of the stylus [m], and for each of 12 points along the stroke of the letter the vector
    on the floor to it from the stylus [m], and then the share of the clay around it that is left.

    Score: −(mean of max(z − 0.06 m, 0) (1 − d / r) over the particles with d < r), with the height z of a particle, its
    distance d from the stroke on the floor, and the radius r of the stylus; over its first absolute value. It is −1 for
    flat clay, and zero where the groove is free of clay.

    Success: the score is above −0.5. A stylus that follows the letter once leaves 0.4 of the clay in the groove.

    Seeds choose the letter, I, L, V or Z, and the position of the stylus above the clay.

    Args:
        num_envs: number of scenes B.
        dx: width of a cell [m], at most 0.04.
        options: see `MaterialEnv`.
    """

    ACTIONS, OBSERVATIONS, RANDOM, MAX_EPISODE_STEPS = 3, 3 + 3 * POINTS, 3, 100
    SPEED, MOST_LEFT = 1.0, 0.5

    def __init__(self, num_envs: int = 1, dx: float = 0.04, **options: Any) -> None:
        self.grid = Grid(dx, (0.0, 0.0, 0.0), UPPER, scenes=num_envs, deterministic=True)
        self.points = seed.box((0.0, 0.0, 0.0), (*UPPER[:2], CLAY), self.grid, per_cell=8)
        stylus = Capsule((0.0, 0.0, 0.0), (0.0, 0.0, HALF), RADIUS)
        clay = VonMises(E=2e4, nu=0.3, yield_stress=500.0)
        step = Step(self.grid, clay, gravity=(0.0, 0.0, -9.81), walls=Walls("sticky"), boundaries=[stylus])
        super().__init__(step, [stylus], substeps=round(0.8 / dx), dt=dx / 40, **options)

    def particles(self) -> State:
        return State.at_rest(self.points, density=1000.0, dtype=self.dtype, device=self.device)

    def scenes(self, random: Tensor) -> Scenes:
        letter = (random[:, 0] * len(LETTERS)).long()
        x, y = (0.3 + 0.2 * random[:, 1:]).unbind(1)
        poses = self.columns(x, y, CLAY + 1.1 * (RADIUS + HALF), 1.0, 0.0, 0.0, 0.0)[:, None]
        return Scenes(poses, self.letters[letter])

    @cached_property
    def letters(self) -> Tensor:
        """Numbers of the goal of each letter [L, G]; `parts` has their meaning."""
        strokes = tuple(stroke + stroke[-1:] * (CORNERS - len(stroke)) for stroke in LETTERS.values())
        stroke, points = self.constant(strokes), self.constant(tuple(map(points_along, LETTERS.values())))
        x = self.first.x[None]
        return torch.cat(
            [stroke.flatten(1), points.flatten(1), clay_left(x, stroke)[:, None], clay_around(x, points)], 1
        )

    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Corners of the stroke of each scene [B, N, 2], and points along it [B, M, 2] [m]; and the clay at the
        beginning in the groove [B], and around the points [B, M] [m]."""
        stroke, points, groove, around = self.goal.split([2 * CORNERS, 2 * POINTS, 1, POINTS], 1)
        return stroke.unflatten(1, (CORNERS, 2)), points.unflatten(1, (POINTS, 2)), groove[:, 0], around

    def velocities(self, actions: Tensor) -> Tensor:
        velocity = self.within(self.SPEED * actions[:, None], LOWEST, HIGHEST)
        return torch.cat([velocity, torch.zeros_like(velocity)], 2)

    def observation(self) -> Tensor:
        _, points, _, before = self.parts()
        return self.observed(clay_around(self.envs.observe("x"), points) / before)

    def observed(self, left: Tensor) -> Tensor:
        """The observation with shares of the clay that are left around the points [B, M]."""
        stylus = self.positions[:, 0]
        to_points = (self.parts()[1] - stylus[:, None, :2]).flatten(1)
        return torch.cat([stylus, to_points, left], 1)

    def start(self) -> tuple[Tensor, Tensor]:
        """All clay is left."""
        around = self.parts()[3]
        return self.observed(torch.ones_like(around)), -torch.ones_like(around[:, 0])

    def score(self) -> Tensor:
        stroke, _, before, _ = self.parts()
        return -clay_left(self.envs.observe("x"), stroke) / before

    def success(self) -> Tensor:
        return self.score() > -self.MOST_LEFT

    def lines(self, b: int) -> list[Any]:
        corners = self.parts()[0][b].cpu().numpy()
        return [(np.concatenate([corners, np.full((CORNERS, 1), CLAY)], 1), "red", "letter")]


def points_along(corners: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """The middles of parts of equal length of a stroke, POINTS of them."""
    stroke = np.asarray(corners)
    ends = np.concatenate([[0.0], np.hypot(*np.diff(stroke, axis=0).T).cumsum()])
    middles = (np.arange(POINTS) + 0.5) / POINTS * ends[-1]
    x, y = (np.interp(middles, ends, axis).tolist() for axis in stroke.T)
    return tuple(zip(x, y, strict=True))


def clay_around(x: Tensor, points: Tensor) -> Tensor:
    """Clay that is left around points [B, M, 2] on the floor [B, M] [m], for positions [B, R, 3]."""
    height = (x[..., 2] - BOTTOM).clamp_min(0.0)
    distances = (norm(x[..., :2] - point[:, None]) for point in points.unbind(1))  # One by one, to need less memory.
    return torch.stack([mean_of_groove(height, distance) for distance in distances], 1)


def clay_left(x: Tensor, stroke: Tensor) -> Tensor:
    """Clay that is left in the groove of a letter [B] [m], for positions [B, R, 3] and corners [B, N, 2] [m]."""
    begin, along = stroke[:, None, :-1], stroke[:, None].diff(dim=2)
    arm = x[:, :, None, :2] - begin
    length = along.square().sum(-1)
    share = ((arm * along).sum(-1) / torch.where(length > 0, length, 1.0)).clamp(0.0, 1.0)
    distance = norm(arm - share[..., None] * along).amin(2)
    return mean_of_groove((x[..., 2] - BOTTOM).clamp_min(0.0), distance)


def mean_of_groove(height: Tensor, distance: Tensor) -> Tensor:
    """Mean height above the groove [B] [m], which falls with the distance from its middle to zero at the radius of the
    stylus; for heights and distances [B, R] [m]."""
    return (height * (1 - distance / RADIUS).clamp_min(0.0)).mean(1)
