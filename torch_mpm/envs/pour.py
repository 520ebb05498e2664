"""Pour water from a cup into a glass, in 2-D."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..geometry import seed
from ..geometry.vectors import norm
from ..grid.grid import Grid
from ..laws import WeaklyCompressible
from ..state.state import State
from ..step.step import Step
from .vector import MaterialEnv, Scenes
from .vessel import THICK, vessel

UPPER = (1.6, 1.2)  # of the domain from the origin [m]
WIDTH, DEPTH, LEVEL = 0.24, 0.24, 0.16  # inside of the cup and of the glass, and height of the water in the cup [m]
LEFT, HEIGHT = 0.5, 0.75  # of the middle of the bottom of the cup at first [m]
LOWEST, HIGHEST = (0.4, 0.6), (1.2, 0.9)  # positions of the cup [m]


class Pour(MaterialEnv):
    """A cup is moved and tilted, so that its water flows into a glass that stands on the floor.

    Action [3]: velocity of the cup in units of 0.5 m/s, and its angular velocity in units of 2 rad/s.

    Observation [9]: position of the cup, the middle of its bottom [m], its angle [rad], centre of the water [m], its
    velocity [m/s], horizontal position of the glass [m], and share of the water that is in it.

    Score: −d, with the mean distance d of the particles of water from the inside of the glass, a box [m].

    Success: 0.9 of the water is in the glass. Water counts up to half a cell inside its walls, where pressure moves it
    (docs/limitations.md).

    Seeds choose the position of the glass.

    Args:
        num_envs: number of scenes B.
        dx: width of a cell [m], at most 0.04.
        options: see `MaterialEnv`.
    """

    ACTIONS, OBSERVATIONS, RANDOM, MAX_EPISODE_STEPS = 3, 9, 1, 120
    SPEED, SPIN, FULL = 0.5, 2.0, 0.9

    def __init__(self, num_envs: int = 1, dx: float = 0.03, **options: Any) -> None:
        self.grid = Grid(dx, (0.0, 0.0), UPPER, scenes=num_envs, deterministic=True)
        self.points = seed.box((0.0, 0.0), (WIDTH, LEVEL), self.grid, per_cell=4)
        self.thick = THICK * dx
        cup, glass = (vessel(WIDTH, DEPTH, self.thick) for _ in range(2))
        step = Step(
            self.grid,
            WeaklyCompressible(bulk_modulus=1e5),
            gravity=(0.0, -9.81),
            walls="separate",
            boundaries=[part.obstacle for part in (*cup, *glass)],
        )
        super().__init__(step, [cup, glass], substeps=round(0.9 / dx), dt=dx / 45, **options)

    def particles(self) -> State:
        return State.at_rest(self.points, density=1000.0, dtype=self.dtype, device=self.device)

    def scenes(self, random: Tensor) -> Scenes:
        cup = self.columns(LEFT, HEIGHT, 0.0)
        glass = self.columns(0.9 + 0.2 * random[:, 0], self.thick, 0.0)
        return Scenes(torch.stack([cup, glass], 1), fields=self.shifted(LEFT - 0.5 * WIDTH, HEIGHT))

    def velocities(self, actions: Tensor) -> Tensor:
        glass = torch.zeros_like(actions)
        cup = torch.cat([self.SPEED * actions[:, :2], self.SPIN * actions[:, 2:]], 1)
        velocities = torch.stack([cup, glass], 1)
        of_cup = self.within(velocities[..., :2], LOWEST, HIGHEST)[:, :1]
        return torch.stack([torch.cat([of_cup[:, 0], cup[:, 2:].to(of_cup)], 1), glass.to(of_cup)], 1)

    def distances(self) -> Tensor:
        """Distances of the particles from the inside of the glass [B, R] [m]; zero for absent ones."""
        from_bottom = self.envs.observe("x") - self.positions[:, 1, None]
        middle, half = self.constant((0.0, 0.5 * DEPTH)), self.constant((0.5 * WIDTH, 0.5 * DEPTH))
        outside = ((from_bottom - middle).abs() - half).clamp_min(0.0)
        return torch.where(self.envs.present, norm(outside), 0.0)

    def share(self) -> Tensor:
        """Share of the water in the glass, or up to half a cell inside its walls [B]."""
        inside = (self.distances() <= 0.5 * self.grid.dx) & self.envs.present
        return inside.sum(1).to(self.dtype) / self.envs.room

    def observation(self) -> Tensor:
        cup, glass = self.poses[:, 0].to(self.dtype), self.positions[:, 1, :1]
        return torch.cat([cup, self.mean("x"), self.mean("v"), glass, self.share()[:, None]], 1)

    def score(self) -> Tensor:
        return -self.distances().sum(1) / self.envs.room

    def success(self) -> Tensor:
        return self.share() >= self.FULL
