"""Write a letter in clay with a stylus."""

from __future__ import annotations

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


class Write(MaterialEnv):
    """A stylus draws a letter into a plate of clay.

    Action [3]: velocity of the stylus, in units of 1 m/s.

    Observation [12]: position of the stylus [m], four corners of the stroke of the letter [m], and the score. The last
    corner is repeated for a letter with fewer.

    Score: −(mean of max(z − 0.06 m, 0) (1 − d / r) over the particles with d < r), with the height z of a particle, its
    distance d from the stroke on the floor, and the radius r of the stylus; over its first absolute value. It is −1 for
    flat clay, and zero where the groove is free of clay.

    Success: the score is above −0.4.

    Seeds choose the letter, I, L, V or Z, and the position of the stylus above the clay.

    Args:
        num_envs: number of scenes B.
        dx: width of a cell [m], at most 0.04.
        options: see `MaterialEnv`.
    """

    ACTIONS, OBSERVATIONS, RANDOM, MAX_EPISODE_STEPS = 3, 4 + 2 * CORNERS, 3, 100
    SPEED, FREE = 1.0, 0.4

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
        letters = tuple(stroke + stroke[-1:] * (CORNERS - len(stroke)) for stroke in LETTERS.values())
        stroke = self.constant(letters)[(random[:, 0] * len(letters)).long()]
        left = clay_left(self.first.x[None], stroke)
        x, y = (0.3 + 0.2 * random[:, 1:]).unbind(1)
        poses = self.columns(x, y, CLAY + 1.1 * (RADIUS + HALF), 1.0, 0.0, 0.0, 0.0)[:, None]
        return Scenes(poses, torch.cat([stroke.flatten(1), left[:, None]], 1))

    def velocities(self, actions: Tensor) -> Tensor:
        velocity = self.within(self.SPEED * actions[:, None], LOWEST, HIGHEST)
        return torch.cat([velocity, torch.zeros_like(velocity)], 2)

    def observation(self) -> Tensor:
        return torch.cat([self.positions[:, 0], self.goal[:, :-1], self.score()[:, None]], 1)

    def score(self) -> Tensor:
        stroke = self.goal[:, :-1].unflatten(1, (CORNERS, 2))
        return -clay_left(self.envs.observe("x"), stroke) / self.goal[:, -1]

    def success(self) -> Tensor:
        return self.score() > -self.FREE

    def lines(self, b: int) -> list[Any]:
        corners = self.goal[b, :-1].reshape(CORNERS, 2).cpu().numpy()
        return [(np.concatenate([corners, np.full((CORNERS, 1), CLAY)], 1), "red", "letter")]


def clay_left(x: Tensor, stroke: Tensor) -> Tensor:
    """Clay that is left in the groove of a letter [B] [m], for positions [B, R, 3] and corners [B, N, 2] [m]."""
    begin, along = stroke[:, None, :-1], stroke[:, None].diff(dim=2)
    arm = x[:, :, None, :2] - begin
    length = along.square().sum(-1)
    share = ((arm * along).sum(-1) / torch.where(length > 0, length, 1.0)).clamp(0.0, 1.0)
    distance = norm(arm - share[..., None] * along).amin(2)
    return ((x[..., 2] - BOTTOM).clamp_min(0.0) * (1 - distance / RADIUS).clamp_min(0.0)).mean(1)
