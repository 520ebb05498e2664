"""Roll dough flat, in 2-D."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..boundaries import Sphere, Walls
from ..geometry import seed
from ..grid.grid import Grid
from ..laws import VonMises
from ..state.state import State
from ..step.step import Step
from .vector import MaterialEnv, Scenes

UPPER = (1.2, 0.6)  # of the domain from the origin [m]
WIDTH, HEIGHT, RADIUS = 0.3, 0.2, 0.1  # of the dough and of the roller [m]
GAP = 0.06  # least distance between the roller and the floor [m]
LOWEST, HIGHEST = (RADIUS, RADIUS + GAP), (UPPER[0] - RADIUS, UPPER[1] - RADIUS)  # positions of the roller [m]


class Roll(MaterialEnv):
    """A roller flattens dough, a plastic body, on a floor to which it sticks.

    Action [2]: velocity of the roller, in units of 1 m/s; it rolls without slip on what is below it.

    Observation [8]: position of the roller [m], centre of the dough [m], its velocity [m/s], lower and upper end of the
    dough along x [m].

    Score: −y, with the height y of the centre of the dough [m].

    Success: all of the dough is below 0.12 m.

    Seeds choose the position of the dough.

    Args:
        num_envs: number of scenes B.
        dx: width of a cell [m], at most 0.05.
        options: see `MaterialEnv`.
    """

    ACTIONS, OBSERVATIONS, RANDOM, MAX_EPISODE_STEPS = 2, 8, 1, 100
    SPEED, FLAT = 1.0, 0.12

    def __init__(self, num_envs: int = 1, dx: float = 0.04, **options: Any) -> None:
        self.grid = Grid(dx, (0.0, 0.0), UPPER, scenes=num_envs, deterministic=True)
        self.points = seed.box((0.0, 0.0), (WIDTH, HEIGHT), self.grid, per_cell=4)
        roller = Sphere((0.0, 0.0), RADIUS, "separate", friction=0.3)
        law = VonMises(E=2e4, nu=0.3, yield_stress=1e3)
        step = Step(self.grid, law, gravity=(0.0, -9.81), walls=Walls("sticky"), boundaries=[roller])
        super().__init__(step, [roller], substeps=round(1.2 / dx), dt=dx / 30, **options)

    def particles(self) -> State:
        return State.at_rest(self.points, density=1000.0, dtype=self.dtype, device=self.device)

    def scenes(self, random: Tensor) -> Scenes:
        left = 0.4 + 0.1 * random[:, 0]
        poses = self.columns(left + 0.5 * WIDTH, HEIGHT + 1.1 * RADIUS, 0.0)[:, None]
        return Scenes(poses, fields=self.shifted(left, 0.0))

    def velocities(self, actions: Tensor) -> Tensor:
        velocity = self.within(self.SPEED * actions[:, None], LOWEST, HIGHEST)
        return torch.cat([velocity, -velocity[..., :1] / RADIUS], -1)

    def observation(self) -> Tensor:
        x, present = self.envs.observe("x")[..., 0], self.envs.present
        left = torch.where(present, x, torch.inf).amin(1, keepdim=True)
        right = torch.where(present, x, -torch.inf).amax(1, keepdim=True)
        return torch.cat([self.positions[:, 0], self.mean("x"), self.mean("v"), left, right], 1)

    def score(self) -> Tensor:
        return -self.mean("x")[:, 1]

    def success(self) -> Tensor:
        return self.envs.observe("x")[..., 1].amax(1) < self.FLAT
