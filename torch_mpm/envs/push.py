"""Push a soft lump along the floor to a target, in 2-D."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Sphere, Walls
from ..geometry import seed
from ..geometry.vectors import norm
from ..grid.grid import Grid
from ..laws import NeoHookean
from ..state.state import State
from ..step.step import Step
from .vector import MaterialEnv, Scenes

UPPER = (1.2, 0.6)  # of the domain from the origin [m]
SIDE, RADIUS = 0.2, 0.1  # of the lump and of the disc that pushes it [m]
LOWEST, HIGHEST = (RADIUS, RADIUS), (UPPER[0] - RADIUS, UPPER[1] - RADIUS)  # positions of the disc [m]


class Push(MaterialEnv):
    """A disc pushes a lump of rubber along a rough floor to a target.

    Action [2]: velocity of the disc, in units of 1 m/s.

    Observation [7]: position of the disc [m], centre of the lump [m], its velocity [m/s], and the target, a height of
    zero left out [m].

    Score: −|x − target| − 0.1 d, with the horizontal position x of the centre of the lump, and the distance d between
    the centres of the disc and the lump [m].

    Success: x is within 0.02 m of the target, and its velocity along x is below 0.1 m/s.

    Seeds choose the position of the lump and the target on its right.

    Args:
        num_envs: number of scenes B.
        dx: width of a cell [m], at most 0.05.
        options: see `MaterialEnv`.
    """

    ACTIONS, OBSERVATIONS, RANDOM, MAX_EPISODE_STEPS = 2, 7, 2, 40
    SPEED, APPROACH, NEAR, SLOW = 1.0, 0.1, 0.02, 0.1

    def __init__(self, num_envs: int = 1, dx: float = 0.05, **options: Any) -> None:
        self.grid = Grid(dx, (0.0, 0.0), UPPER, scenes=num_envs, deterministic=True)
        self.points = seed.box((0.0, 0.0), (SIDE, SIDE), self.grid, per_cell=4)
        disc = Sphere((0.0, 0.0), RADIUS, "separate")
        walls = Walls("separate", friction=0.3)
        step = Step(self.grid, NeoHookean(E=2e4, nu=0.3), gravity=(0.0, -9.81), walls=walls, boundaries=[disc])
        super().__init__(step, [disc], substeps=round(1.0 / dx), dt=0.04 * dx, **options)

    def particles(self) -> State:
        return State.at_rest(self.points, density=1000.0, dtype=self.dtype, device=self.device)

    def scenes(self, random: Tensor) -> Scenes:
        left, way = 0.3 + 0.1 * random[:, 0], 0.2 + 0.2 * random[:, 1]
        poses = self.columns(left - 1.1 * RADIUS, RADIUS, 0.0)[:, None]
        return Scenes(poses, self.columns(left + 0.5 * SIDE + way), self.shifted(left, 0.0))

    def velocities(self, actions: Tensor) -> Tensor:
        velocity = self.within(self.SPEED * actions[:, None], LOWEST, HIGHEST)
        return torch.cat([velocity, torch.zeros_like(velocity[..., :1])], -1)

    def observation(self) -> Tensor:
        return torch.cat([self.positions[:, 0], self.mean("x"), self.mean("v"), self.goal], 1)

    def score(self) -> Tensor:
        centre = self.mean("x")
        return -(centre[:, 0] - self.goal[:, 0]).abs() - self.APPROACH * norm(self.positions[:, 0] - centre)

    def success(self) -> Tensor:
        near = (self.mean("x")[:, 0] - self.goal[:, 0]).abs() < self.NEAR
        return near & (self.mean("v")[:, 0].abs() < self.SLOW)

    def lines(self, b: int) -> list[Any]:
        at = float(self.goal[b, 0])
        return [(np.array([[at, 0.0], [at, SIDE]]), "red", "target")]
