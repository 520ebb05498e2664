"""Environments of gymnasium's vector interface: B scenes of a task in one simulation, with tensors on its device.

A task is a subclass of `MaterialEnv` with a scene, the motion of its bodies, observations and a score (docs/envs.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..bodies.exchange import POSE, VELOCITY, Part, RigidBodies, moved
from ..boundaries.obstacles import Obstacle
from ..errors import FLOATING, check_count, check_flag, check_number, default_dtype, shape_of
from ..rollouts.environments import Environments
from ..state.state import State
from ..step.step import Step
from .arguments import autoreset_mode as check_autoreset_mode
from .arguments import reset_mask, seeds_of_scenes
from .failed_scenes import GradientGate, reasons
from .package import AutoresetMode, gymnasium
from .pictures import Pictures


class Scene(NamedTuple):
    """First state of a scene, first poses of its K bodies (K rows of 3 or 7 numbers), and numbers of its goal."""

    state: State
    poses: Sequence[Sequence[float]]
    goal: Sequence[float] = ()


class MaterialEnv(gymnasium.vector.VectorEnv):
    """B scenes of a task; the base class of tasks.

    A subclass makes a step, and defines `scene`, `velocities`, `observation`, `score`, and perhaps `reward` and
    `success`. Its class attributes are the numbers of an action and of an observation, and the default limit of time.

    Args:
        step: step of a grid of B scenes.
        bodies: bodies that the actions move, as of `RigidBodies`.
        substeps, dt: steps of the material in a step of the environment, and their time step [s].
        max_episode_steps: steps after which an episode is truncated; None for those of the task.
        autoreset_mode: "NextStep": the step after the end of an episode ignores the action, resets the scene, and
            returns its first observation with a reward of 0. "Disabled": a scene that has ended stands still, with its
            last observation, rewards of 0 and unchanged flags, until `reset` with a mask. Also gymnasium's
            `AutoresetMode`; its "SameStep" is not supported.
        differentiable: rewards and observations have gradients by the actions and by what else in the step requires
            one, from step to step until `detach`, or a reset of all scenes.
        numpy: return arrays instead of tensors.
        render_mode: "rgb_array" for `render`, or None.
        dtype, device: of the particles and of all results; None for torch's defaults.

    Attributes:
        envs: the scenes (`Environments`).
        bodies: the bodies (`RigidBodies`).
        poses: poses of the bodies [B, K, 3] (2-D) or [B, K, 7] (3-D), float64; see `torch_mpm.bodies.exchange`.
        goal: numbers of the goals [B, G].
        ended: episodes that have ended and were not reset, bool [B].

    Raises:
        TypeError, ValueError: for other arguments.
        ImportError: without gymnasium.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    ACTIONS: ClassVar[int]
    OBSERVATIONS: ClassVar[int]
    MAX_EPISODE_STEPS: ClassVar[int]

    def __init__(
        self,
        step: Step,
        bodies: Sequence[Obstacle | Part | Sequence[Obstacle | Part]],
        *,
        substeps: int,
        dt: float,
        max_episode_steps: int | None = None,
        autoreset_mode: Any = "NextStep",
        differentiable: bool = False,
        numpy: bool = False,
        render_mode: str | None = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        self.bodies, self.num_envs = RigidBodies(step, bodies), check_count("num_envs", step.grid.scenes, 1)
        self.substeps = check_count("substeps", substeps, 1)
        self.dt = check_number("dt", dt, "positive", lambda v: 0 < v < torch.inf)
        limit = self.MAX_EPISODE_STEPS if max_episode_steps is None else max_episode_steps
        self.max_episode_steps = check_count("max_episode_steps", limit, 1)
        self.autoreset = check_autoreset_mode(autoreset_mode)
        self.differentiable, self.numpy = check_flag("differentiable", differentiable), check_flag("numpy", numpy)
        if self.differentiable and self.numpy:
            raise ValueError("numpy must be False where differentiable is True: arrays have no gradients")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode, self._pictures = render_mode, Pictures()
        self.dtype = default_dtype() if dtype is None else dtype
        if self.dtype not in FLOATING:
            raise TypeError(f"dtype must be float32 or float64, got {dtype}")
        self.device = torch.get_default_device() if device is None else torch.device(device)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": 1 / self.seconds,
            "autoreset_mode": self.autoreset,
        }
        self._make_spaces()
        self._make_scenes()

    def _make_spaces(self) -> None:
        box, single = gymnasium.spaces.Box, np.float64 if self.dtype == torch.float64 else np.float32
        batch = gymnasium.vector.utils.batch_space
        self.single_action_space = box(-1.0, 1.0, (self.ACTIONS,), single)
        self.single_observation_space = box(-np.inf, np.inf, (self.OBSERVATIONS,), single)
        self.action_space = batch(self.single_action_space, self.num_envs)
        self.observation_space = batch(self.single_observation_space, self.num_envs)

    def _make_scenes(self) -> None:
        """All scenes from the same seed, until the first reset."""
        first = self.scene(np.random.default_rng(0))
        B, device = self.num_envs, self.device
        self.envs = Environments(self.bodies.step, [first.state] * B)
        self.poses = torch.tensor([first.poses] * B, dtype=torch.float64, device=device)
        self.poses = self.poses.reshape(B, len(self.bodies), POSE[self.dim])
        self.goal = torch.tensor([first.goal] * B, dtype=self.dtype, device=device)
        self.steps = torch.zeros(B, dtype=torch.int64, device=device)
        self.terminated, self.truncated = (torch.zeros(B, dtype=torch.bool, device=device) for _ in range(2))
        self._observation = torch.zeros(B, self.OBSERVATIONS, dtype=self.dtype, device=device)
        self._score = torch.zeros(B, dtype=self.dtype, device=device)
        self._random: list[Any] = [None] * B
        self._began = False

    # ---- what a task defines

    def scene(self, random: np.random.Generator) -> Scene:
        """A scene from a random generator, in `dtype` and on `device`; all with the same number of particles."""
        raise NotImplementedError

    def velocities(self, actions: Tensor) -> Tensor:
        """Velocities of the bodies during the step [B, K, 3] (2-D) or [B, K, 6] (3-D) for actions [B, A] in [-1, 1].

        Velocity [m/s] and angular velocity [rad/s]; `poses` are those at the beginning.
        """
        raise NotImplementedError

    def observation(self) -> Tensor:
        """Observations [B, O] of the scenes as they are. Frozen scenes have no particles; theirs are not used."""
        raise NotImplementedError

    def score(self) -> Tensor:
        """What each scene has achieved [B]: the reward of a step is the gain of the score."""
        raise NotImplementedError

    def reward(self, gain: Tensor, actions: Tensor) -> Tensor:
        """Rewards [B] of a step by the gain of the score [B] and the actions [B, A]."""
        return gain

    def success(self) -> Tensor:
        """Scenes that have reached their goal, bool [B], where the episode ends; by default none."""
        return torch.zeros_like(self.terminated)

    def lines(self, b: int) -> list[Any]:
        """Lines of a picture of scene b, such as its goal: (points [N, D], colour, label)."""
        return []

    # ---- parts for tasks

    @property
    def dim(self) -> int:
        return self.bodies.step.grid.dim

    @property
    def ended(self) -> Tensor:
        return self.terminated | self.truncated

    @property
    def seconds(self) -> float:
        """Time of a step [s]."""
        return self.substeps * self.dt

    @property
    def positions(self) -> Tensor:
        """Positions of the bodies [B, K, D] in `dtype`."""
        return self.poses[..., : self.dim].to(self.dtype)

    def mean(self, name: str) -> Tensor:
        """Mean of a field of the particles by mass, [B, ...], such as "x" or "v"; zero in frozen scenes."""
        values, mass = self.envs.observe(name), self.envs.observe("mass")
        total = mass.sum(1)
        share = mass / torch.where(total > 0, total, 1.0)[:, None]
        return (share.reshape(*share.shape, *(1,) * (values.dim() - 2)) * values).sum(1)

    def within(self, velocity: Tensor, lower: Sequence[float], upper: Sequence[float]) -> Tensor:
        """Velocities [B, K, D] limited so that the positions of the bodies stay within a box at the end of the step."""
        now = self.poses[..., : self.dim]
        low, high = (torch.tensor(corner, dtype=now.dtype, device=now.device) for corner in (lower, upper))
        later = now + self.seconds * velocity.to(now)
        return (torch.minimum(torch.maximum(later, low), high) - now) / self.seconds

    # ---- gymnasium's interface

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes.

        Args:
            seed: scene b gets seed + b, or seed[b] of a list; the same scene whatever the others are. None continues
                the random numbers of each scene.
            options: {"reset_mask": bool [B], a tensor or an array} resets these scenes only; the others are unchanged,
                bit by bit.

        Returns:
            Observations [B, O], and an empty dictionary.

        Raises:
            TypeError, ValueError: for another seed, another option, or a mask of another shape or dtype.
        """
        which = reset_mask(options, self.num_envs)
        if not self._began and not which.all():
            raise RuntimeError("reset must be called without a mask before the first reset with one")
        self._seed(seed, which)
        if which.all():
            self.detach()
        with torch.set_grad_enabled(self._has_graph()):
            self._replace(which)
        self._began = True
        return self._given(self._observation), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Compute a step of all scenes.

        Args:
            actions: [B, A], a tensor or an array; clamped to [-1, 1], so that the gradient outside is zero.

        Returns:
            Observations [B, O], rewards [B], terminated and truncated bool [B], and a dictionary: "success" bool [B];
            where scenes failed also "failed" bool [B] and, as arrays on the host, "reason" (texts or None) and
            "_reason" (where there is one). A scene fails where particles leave the grid, are not finite or are
            inverted, or where its observation or score is not finite. Its episode terminates with the observation of
            the step before and a reward of 0.

        Raises:
            TypeError, ValueError: for other actions, for ones that are not finite, or that require a gradient where the
                environment is not differentiable.
            RuntimeError: before the first reset.
        """
        if not self._began:
            raise RuntimeError("reset must be called before the first step")
        actions = self._checked(actions)
        with torch.set_grad_enabled(self._has_graph()):
            before = self.ended
            self._advance(actions)
            reward, info = self._judge(actions)
            if self.autoreset is AutoresetMode.NEXT_STEP:
                self._replace(before.cpu().numpy())
        results = (self._observation, reward, self.terminated, self.truncated)
        observation, reward, terminated, truncated = (self._given(value) for value in results)
        return observation, reward, terminated, truncated, {key: self._given(value) for key, value in info.items()}

    def detach(self) -> None:
        """Cut the gradient here: later rewards have none by earlier actions, whose memory is freed."""
        self.envs.detach()
        for name in ("poses", "_observation", "_score"):
            setattr(self, name, getattr(self, name).detach())

    def render(self) -> tuple[Any, ...]:
        """A picture of each scene, uint8 [H, W, 3]; of its particles, obstacles and lines.

        Raises:
            ValueError: for an environment that was made without `render_mode="rgb_array"`.
            ImportError: without the packages of the extra `render`.
        """
        if self.render_mode is None:
            raise ValueError("render_mode must be 'rgb_array' where pictures are drawn, got None")
        with torch.no_grad():
            self._place()
            return tuple(self._pictures.draw(self.envs, b, self.lines(b)) for b in range(self.num_envs))

    def close_extras(self) -> None:
        self._pictures.close()

    # ---- episodes

    def _seed(self, seed: Any, which: npt.NDArray[np.bool_]) -> None:
        """Choose the random numbers of the scenes of a mask."""
        seeds, make = seeds_of_scenes(seed, self.num_envs), gymnasium.utils.seeding.np_random
        super().reset(seed=None if isinstance(seed, Sequence) else seeds[0])
        for b in np.flatnonzero(which).tolist():
            given = seeds[b]
            if given is None and self._random[b] is None:
                given = int(self.np_random.integers(2**31))
            if given is not None:
                self._random[b] = make(given)[0]

    def _replace(self, which: npt.NDArray[np.bool_]) -> None:
        """Begin new episodes in the scenes of a mask bool [B]."""
        scenes = [self.scene(self._random[b]) for b in np.flatnonzero(which).tolist()]
        if not scenes:
            return
        index = torch.as_tensor(np.flatnonzero(which), device=self.device)
        self.envs.reset(index, [scene.state for scene in scenes])
        for name, rows in (("poses", [s.poses for s in scenes]), ("goal", [s.goal for s in scenes])):
            old = getattr(self, name)
            new = torch.tensor(rows, dtype=old.dtype, device=self.device).reshape(len(scenes), *old.shape[1:])
            setattr(self, name, old.index_copy(0, index, new))
        for name in ("steps", "terminated", "truncated"):
            setattr(self, name, getattr(self, name).index_fill(0, index, 0))
        mask = torch.zeros_like(self.terminated).index_fill(0, index, True)
        self._observation = torch.where(mask[:, None], self.observation(), self._observation)
        self._score = torch.where(mask, self.score(), self._score)

    def _place(self) -> None:
        """Put the bodies at their poses, at rest."""
        rest = self.poses.new_zeros(*self.poses.shape[:2], VELOCITY[self.dim])
        self.bodies.move(torch.cat([self.poses, rest], -1), self.envs.state)

    def _advance(self, actions: Tensor) -> None:
        """Move the bodies and the material."""
        velocities = torch.where(self.ended[:, None, None], 0.0, self.velocities(actions).double())
        rows = torch.cat([self.poses, velocities], -1)
        self._gate = GradientGate()
        rows, self.envs.state = self._gate(rows), self.envs.state.map(self._gate)
        self.bodies.move(rows, self.envs.state)
        self.envs.advance(self.substeps, self.dt)
        self.poses, self.steps = moved(rows, self.seconds), self.steps + ~self.ended

    def _judge(self, actions: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Rewards [B] and information of a step, after which scenes that have ended stand still."""
        ended, failures = self.ended, self.bodies.step.failures(self.envs.state)
        failed = failures.failed & ~ended
        if failed.any():  # Before observations: zero times the gradient of a scene without a result is NaN.
            self.envs.freeze(failed)
        observation, score = self.observation(), self.score()
        undefined = ~(observation.isfinite().all(1) & score.isfinite() | ended | failed)
        self._gate.failed = failed | undefined
        held = ended | failed | undefined
        observation = torch.where(held[:, None], self._observation, observation)
        score = torch.where(held, self._score, score)
        reward = torch.where(held, 0.0, self.reward(score - self._score, actions))
        success = self.success() & ~held
        terminated = torch.where(ended, self.terminated, success | failed | undefined)
        truncated = torch.where(ended, self.truncated, ~terminated & (self.steps >= self.max_episode_steps))
        self._observation, self._score = observation, score
        self.terminated, self.truncated = terminated, truncated
        if (self.ended & ~ended).any():
            self.envs.freeze(self.ended)
        info = {"success": success} | reasons(failures, (failed | undefined).cpu().numpy())
        return reward, info

    # ---- arguments and results

    def _has_graph(self) -> bool:
        return self.differentiable and torch.is_grad_enabled()

    def _given(self, value: Any) -> Any:
        """A result in the form of this environment."""
        return value.cpu().numpy() if self.numpy and isinstance(value, Tensor) else value

    def _checked(self, actions: Any) -> Tensor:
        """Actions [B, A] in [-1, 1] on the device."""
        shape = [self.num_envs, self.ACTIONS]
        if not isinstance(actions, (Tensor, np.ndarray)) or list(actions.shape) != shape:
            given = list(actions.shape) if isinstance(actions, np.ndarray) else shape_of(actions)
            raise ValueError(f"actions must be a tensor or an array [B, A] = {shape}, got {given}")
        values = torch.as_tensor(actions).to(self.device, self.dtype)
        if values.requires_grad and torch.is_grad_enabled() and not self.differentiable:
            raise ValueError("actions must not require grad where differentiable is False: detach them")
        if not values.isfinite().all():
            raise ValueError("actions must be finite, got NaN or infinity")
        return values.clamp(-1.0, 1.0)
