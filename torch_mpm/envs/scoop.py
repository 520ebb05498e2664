"""Scoop sand with a bucket, in 2-D."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Walls
from ..geometry import seed
from ..grid.grid import Grid
from ..laws import QuarticSand
from ..state.state import State
from ..step.step import Step
from .vector import MaterialEnv, Scenes
from .vessel import THICK, vessel

UPPER = (1.6, 1.2)  # of the domain from the origin [m]
BED = (UPPER[0], 0.25)  # width and depth of the sand [m]
WIDTH, DEPTH = 0.3, 0.3  # of the inside of the bucket [m]
LOWEST, HIGHEST = (0.3, 0.4), (1.3, 0.8)  # positions of the bucket [m]
TOP = 0.5  # height of the sand that is lifted [m]


class Scoop(MaterialEnv):
    """A bucket dips into a bed of sand, turns, and lifts some of it.

    Action [3]: velocity of the bucket in units of 0.5 m/s, and its angular velocity in units of 2 rad/s.

    Observation [8]: position of the bucket, the middle of its bottom [m], its angle [rad], centre of the sand [m], its
    velocity [m/s], and the share of it that is lifted, above a height of 0.5 m.

    Score: y, the height of the centre of the sand [m].

    Success: a share of 0.03 is lifted.

    Seeds choose the position of the bucket above the sand; it is open to the right.

    Args:
        num_envs: number of scenes B.
        dx: width of a cell [m], at most 0.03.
        options: see `MaterialEnv`.
    """

    ACTIONS, OBSERVATIONS, RANDOM, MAX_EPISODE_STEPS = 3, 8, 1, 120
    SPEED, SPIN, LIFTED = 0.5, 2.0, 0.03

    def __init__(self, num_envs: int = 1, dx: float = 0.025, **options: Any) -> None:
        self.grid = Grid(dx, (0.0, 0.0), UPPER, scenes=num_envs, deterministic=True)
        self.points = seed.box((0.0, 0.0), BED, self.grid, per_cell=4)
        bucket = vessel(WIDTH, DEPTH, THICK * dx, friction=0.5)
        sand = QuarticSand(E=3e5, nu=0.3, friction_angle=0.6)
        obstacles = [part.obstacle for part in bucket]
        walls = Walls("separate", friction=0.5)
        step = Step(self.grid, sand, gravity=(0.0, -9.81), walls=walls, boundaries=obstacles)
        super().__init__(step, [bucket], substeps=round(1.6 / dx), dt=dx / 80, **options)

    def particles(self) -> State:
        return State.at_rest(self.points, density=1600.0, dtype=self.dtype, device=self.device)

    def scenes(self, random: Tensor) -> Scenes:
        return Scenes(self.columns(0.4 + 0.2 * random[:, 0], 0.45, -0.5 * math.pi)[:, None])

    def velocities(self, actions: Tensor) -> Tensor:
        velocity = self.within(self.SPEED * actions[:, None, :2], LOWEST, HIGHEST)
        return torch.cat([velocity, self.SPIN * actions[:, None, 2:].to(velocity)], -1)

    def lifted(self) -> Tensor:
        """Share of the sand that is lifted [B]."""
        return (self.envs.observe("x")[..., 1] > TOP).sum(1).to(self.dtype) / self.envs.room

    def observation(self) -> Tensor:
        bucket = self.poses[:, 0].to(self.dtype)
        return torch.cat([bucket, self.mean("x"), self.mean("v"), self.lifted()[:, None]], 1)

    def score(self) -> Tensor:
        return self.mean("x")[:, 1]

    def success(self) -> Tensor:
        return self.lifted() >= self.LIFTED

    def lines(self, b: int) -> list[Any]:
        return [(np.array([[0.0, TOP], [UPPER[0], TOP]]), "red", "height")]
