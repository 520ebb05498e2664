"""Lift a soft cube between two fingers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Box, Walls
from ..geometry import seed
from ..geometry.vectors import norm
from ..grid.grid import Grid
from ..laws import NeoHookean
from ..state.state import State
from ..step.step import Step
from .vector import MaterialEnv, Scenes

UPPER = (0.72, 0.36, 0.48)  # of the domain from the origin [m]
SIDE, FINGER = 0.12, (0.12, 0.12, 0.12)  # of the cube, and of a finger [m]
LOWEST = [0.5 * width for width in FINGER]  # position of a finger [m]
HIGHEST = [limit - 0.5 * width for limit, width in zip(UPPER, FINGER, strict=True)]


class Lift(MaterialEnv):
    """Two fingers press on a cube of rubber, and lift it to a height by friction.

    Action [3]: velocity of the left finger and of the right one along x, and of both along z, in units of 0.5 m/s.

    Observation [13]: positions of the left and the right finger [m], centre of the cube [m], its velocity [m/s], and
    the height of the goal [m].

    Score: −|z − goal| − 0.1 d, with the height z of the centre of the cube, and the mean distance d between the centres
    of the fingers and the cube [m].

    Success: z is within 0.01 m of the goal, at a speed below 0.1 m/s.

    Seeds choose the position of the cube along x and the goal.

    Args:
        num_envs: number of scenes B.
        dx: width of a cell [m], at most 0.03.
        options: see `MaterialEnv`.
    """

    ACTIONS, OBSERVATIONS, RANDOM, MAX_EPISODE_STEPS = 3, 13, 2, 60
    SPEED, APPROACH, NEAR, SLOW = 0.5, 0.1, 0.01, 0.1

    def __init__(self, num_envs: int = 1, dx: float = 0.03, **options: Any) -> None:
        self.grid = Grid(dx, (0.0, 0.0, 0.0), UPPER, scenes=num_envs, deterministic=True)
        self.points = seed.box((0.0, 0.0, 0.0), (SIDE, SIDE, SIDE), self.grid, per_cell=8)
        fingers = [Box((0.0, 0.0, 0.0), FINGER, "separate", friction=1.0) for _ in range(2)]
        walls = Walls("separate", friction=0.5)
        step = Step(self.grid, NeoHookean(E=3e4, nu=0.3), gravity=(0.0, 0.0, -9.81), walls=walls, boundaries=fingers)
        super().__init__(step, fingers, substeps=round(0.6 / dx), dt=dx / 30, **options)

    def particles(self) -> State:
        return State.at_rest(self.points, density=1000.0, dtype=self.dtype, device=self.device)

    def scenes(self, random: Tensor) -> Scenes:
        centre, y = 0.5 * UPPER[0] - 0.03 + 0.06 * random[:, 0], 0.5 * UPPER[1]
        apart = 0.5 * (SIDE + FINGER[0]) + 0.01
        rest = y, 0.5 * FINGER[2], 1.0, 0.0, 0.0, 0.0
        poses = torch.stack([self.columns(centre + side * apart, *rest) for side in (-1, 1)], 1)
        goal = self.columns(0.15 + 0.1 * random[:, 1])
        return Scenes(poses, goal, self.shifted(centre - 0.5 * SIDE, y - 0.5 * SIDE, 0.0))

    def velocities(self, actions: Tensor) -> Tensor:
        zero = torch.zeros_like(actions[:, :2])
        velocity = self.SPEED * torch.stack([actions[:, :2], zero, actions[:, 2:].expand(-1, 2)], 2)
        velocity = self.within(velocity, LOWEST, HIGHEST)
        return torch.cat([velocity, torch.zeros_like(velocity)], 2)

    def observation(self) -> Tensor:
        return torch.cat([self.positions.flatten(1), self.mean("x"), self.mean("v"), self.goal], 1)

    def score(self) -> Tensor:
        centre = self.mean("x")
        distance = norm(self.positions - centre[:, None]).mean(1)
        return -(centre[:, 2] - self.goal[:, 0]).abs() - self.APPROACH * distance

    def success(self) -> Tensor:
        near = (self.mean("x")[:, 2] - self.goal[:, 0]).abs() < self.NEAR
        return near & (norm(self.mean("v")) < self.SLOW)

    def lines(self, b: int) -> list[Any]:
        at, y = float(self.goal[b, 0]), 0.5 * UPPER[1]
        return [(np.array([[0.0, y, at], [UPPER[0], y, at]]), "red", "goal")]
