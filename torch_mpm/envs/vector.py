"""Environments of gymnasium's vector interface: B scenes of a task in one simulation, with tensors on its device.

A task is a subclass of `MaterialEnv` with a scene, the motion of its bodies, observations and a score (docs/envs.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..bodies.exchange import POSE, VELOCITY, Part, RigidBodies, moved
from ..boundaries.obstacles import Obstacle
from ..cuda_graphs.capture import is_readable
from ..errors import FLOATING, check_count, check_flag, check_number, default_dtype, shape_of
from ..geometry.values import to_device
from ..rollouts.environments import Environments
from ..state.state import PARTICLE_FIELDS, State
from ..step.failures import Failures
from ..step.step import Step
from .arguments import autoreset_mode as check_autoreset_mode
from .arguments import reset_mask, seeds_of_scenes
from .failed_scenes import GradientGate, sentences
from .package import AutoresetMode, gymnasium
from .pictures import Pictures
from .random_numbers import uniform


class Scenes(NamedTuple):
    """How B scenes begin.

    Attributes:
        poses: poses of the K bodies [B, K, 3] (2-D) or [B, K, 7] (3-D).
        goal: numbers of the goals [B, G]; None for no numbers.
        fields: fields of the particles that differ from those of `MaterialEnv.particles`, of `State` or
            `State.extra`, by name [B, R, ...]. Floating ones are converted to the dtype of the field; others must have
            it.
    """

    poses: Tensor
    goal: Tensor | None = None
    fields: Mapping[str, Tensor] = {}


OF_START = ("particles", "scenes", "observation", "score")
"""Methods of a task that decide what `MaterialEnv.start` returns."""


class MaterialEnv(gymnasium.vector.VectorEnv):
    """B scenes of a task; the base class of tasks.

    A subclass makes a step, and defines `particles`, `scenes`, `velocities`, `observation`, `score`, and perhaps
    `reward` and `success`. Its class attributes are the numbers of an action and of an observation, the number of
    random numbers of a scene, and the default limit of time. On CUDA neither `step` nor `reset` waits for the device,
    unless the results are arrays.

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
            one, from step to step until `detach`, or a reset of all scenes: one without a mask, or with a mask on the
            host that is true everywhere.
        numpy: return arrays instead of tensors.
        render_mode: "rgb_array" for `render`, or None.
        dtype, device: of the particles and of all results; None for torch's defaults.

    Attributes:
        envs: the scenes (`Environments`).
        bodies: the bodies (`RigidBodies`).
        first: particles of a scene as `particles` made them (`State`).
        poses: poses of the bodies [B, K, 3] (2-D) or [B, K, 7] (3-D), float64; see `torch_mpm.bodies.exchange`.
        goal: numbers of the goals [B, G].
        seeds: seed of the random numbers of each scene, int64 [B].
        episodes: number of the episode of each scene since its seed was given, int64 [B].
        steps: steps of each scene in its episode, int64 [B].
        ended: episodes that have ended and were not reset, bool [B].

    Raises:
        TypeError, ValueError: for other arguments.
        ImportError: without gymnasium.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    ACTIONS: ClassVar[int]
    OBSERVATIONS: ClassVar[int]
    RANDOM: ClassVar[int] = 0
    MAX_EPISODE_STEPS: ClassVar[int]

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "start" not in vars(cls) and not vars(cls).keys().isdisjoint(OF_START):
            cls.start = MaterialEnv.start  # type: ignore[method-assign]

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
        B, device = self.num_envs, self.device
        self._constants: dict[tuple[Any, torch.dtype], Tensor] = {}
        self.first = self.particles()
        self.envs = Environments(self.bodies.step, [self.first] * B)
        self.seeds, self.episodes, self.steps = (torch.zeros(B, dtype=torch.int64, device=device) for _ in range(3))
        made = self._drawn()
        self.poses = torch.zeros_like(made.poses, dtype=torch.float64)
        self.goal = self.poses.new_zeros(B, 0, dtype=self.dtype) if made.goal is None else torch.zeros_like(made.goal)
        self.terminated, self.truncated = (torch.zeros(B, dtype=torch.bool, device=device) for _ in range(2))
        self._observation = torch.zeros(B, self.OBSERVATIONS, dtype=self.dtype, device=device)
        self._score = torch.zeros(B, dtype=self.dtype, device=device)
        self._failures: tuple[Failures, Tensor] | None = None
        self._began = False
        with torch.no_grad():
            self._replace(torch.ones_like(self.terminated))

    # ---- what a task defines

    def particles(self) -> State:
        """The R particles of a scene, in `dtype` and on `device`."""
        raise NotImplementedError

    def scenes(self, random: Tensor) -> Scenes:
        """How the scenes begin by random numbers from 0 to 1 [B, RANDOM], float64, by operations on the device.

        `first` are the particles of `particles`. Row b must depend on row b of the numbers alone.
        """
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

    def start(self) -> tuple[Tensor, Tensor]:
        """Observations [B, O] and scores [B] of scenes that begin; those of the others are not used.

        By default `observation` and `score`. A task may know both without a pass over all particles. A class that
        defines other particles, scenes, observations or scores has the default again, unless it defines this too.
        """
        return self.observation(), self.score()

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

    def constant(self, numbers: Any, dtype: torch.dtype | None = None) -> Tensor:
        """A number, or nested tuples of numbers, as a tensor on `device`, in `dtype` by default.

        Those of tuples are made once and kept: their numbers must not change from step to step.
        """
        dtype = self.dtype if dtype is None else dtype
        if not isinstance(numbers, tuple):
            return torch.full((), numbers, dtype=dtype, device=self.device)
        if (numbers, dtype) not in self._constants:
            with torch.inference_mode(False):  # A later step may then differentiate through it.
                self._constants[numbers, dtype] = torch.tensor(numbers, dtype=dtype, device=self.device)
        return self._constants[numbers, dtype]

    def columns(self, *values: Tensor | float) -> Tensor:
        """Tensors [B] and numbers side by side [B, n], float64."""
        rows = [v.double() if isinstance(v, Tensor) else self.constant(v, torch.float64) for v in values]
        return torch.stack([row.expand(self.num_envs) for row in rows], 1)

    def shifted(self, *offset: Tensor | float) -> dict[str, Tensor]:
        """The positions of the particles of `first` by an offset of D tensors [B] or numbers [m], for `Scenes`."""
        return {"x": self.first.x + self.columns(*offset).to(self.dtype)[:, None]}

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
        low, high = (self.constant(tuple(corner), now.dtype) for corner in (lower, upper))
        later = now + self.seconds * velocity.to(now)
        return (torch.minimum(torch.maximum(later, low), high) - now) / self.seconds

    # ---- gymnasium's interface

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes.

        Args:
            seed: scene b gets seed + b, or seed[b] of a list; the same scene whatever the others are. Numbers of 2^63
                or more are folded to 63 bits. None continues the random numbers of each scene.
            options: {"reset_mask": bool [B], a tensor or an array} resets these scenes only; the others are unchanged,
                bit by bit. A reset without a mask ends all gradients, and so does one with a mask on the host that is
                true everywhere. A mask on a device is not read: gradients end in its scenes, and `detach` frees their
                memory.

        Returns:
            Observations [B, O], and an empty dictionary.

        Raises:
            TypeError, ValueError: for another seed, another option, or a mask of another shape or dtype.
        """
        mask = reset_mask(options, self.num_envs)
        if not self._began and mask is not None:
            raise RuntimeError("reset must be called without a mask before the first reset with one")
        which = torch.ones_like(self.terminated) if mask is None else to_device(mask, self.device)
        self._seed(seed, which)
        if mask is None or (is_readable(mask) and bool(mask.all())):
            self.detach()
        with torch.set_grad_enabled(self._has_graph()):
            self._begin(which)
        self._began = True
        return self._given(self._observation), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Compute a step of all scenes.

        Args:
            actions: [B, A], a tensor or an array; clamped to [-1, 1], so that the gradient outside is zero.

        Returns:
            Observations [B, O], rewards [B], terminated and truncated bool [B], and a dictionary: "success" and
            "failed", bool [B]. A scene fails where particles leave the grid, are not finite or are inverted, or where
            its observation, its score or a pose is not finite. Its episode terminates with the observation of the step
            before and a reward of 0. `failure_reasons` has the reasons.

        Raises:
            TypeError, ValueError: for other actions, for ones that require a gradient where the environment is not
                differentiable, and on the CPU for ones that are not finite; on CUDA their scenes fail, and the reason
                is that particles are not finite.
            RuntimeError: before the first reset.
        """
        if not self._began:
            raise RuntimeError("reset must be called before the first step")
        actions = self._checked(actions)
        with torch.set_grad_enabled(self._has_graph()):
            before = self.ended
            self._advance(actions)
            reward, info = self._judge(actions)
            if self.autoreset is AutoresetMode.NEXT_STEP and _may_have_some(before):
                self._begin(before)
        results = (self._observation, reward, self.terminated, self.truncated)
        observation, reward, terminated, truncated = (self._given(value) for value in results)
        return observation, reward, terminated, truncated, {key: self._given(value) for key, value in info.items()}

    def failure_reasons(self) -> list[str | None]:
        """For each scene why it failed in the latest step, None where it did not; waits for the device."""
        if self._failures is None:
            return [None] * self.num_envs
        failures, failed = self._failures
        return sentences(failures, failed.tolist())

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

    def _seed(self, seed: Any, which: Tensor) -> None:
        """Choose the random numbers of the scenes of a mask bool [B]."""
        seeds = seeds_of_scenes(seed, self.num_envs)
        super().reset(seed=None if isinstance(seed, Sequence) else seeds[0])
        if not self._began:
            first = int(self.np_random.integers(2**31))
            seeds = [first + b if own is None else own for b, own in enumerate(seeds)]
        if all(own is None for own in seeds):
            return
        given = to_device(torch.tensor([-1 if own is None else own for own in seeds], device="cpu"), self.device)
        chosen = which & (given >= 0)
        self.seeds = torch.where(chosen, given, self.seeds)
        self.episodes = torch.where(chosen, -1, self.episodes)  # `_replace` counts the episode.

    def _drawn(self) -> Scenes:
        """How the present episodes of all scenes begin: poses in float64, goals in `dtype`, fields in their own dtype.

        Raises:
            TypeError, ValueError: for poses, goals or fields of another shape, and fields of another dtype or name.
        """
        made = self.scenes(uniform(self.seeds, self.episodes, self.RANDOM))
        shape = self.num_envs, len(self.bodies), POSE[self.dim]
        if tuple(made.poses.shape) != shape:
            raise ValueError(f"poses of scenes must have shape {list(shape)}, got {shape_of(made.poses)}")
        goal = made.goal
        if goal is not None and (goal.dim() != 2 or len(goal) != self.num_envs):
            raise ValueError(f"goal of scenes must have shape [B, G] = [{self.num_envs}, G], got {shape_of(goal)}")
        fields = {name: self._checked_field(name, value) for name, value in made.fields.items()}
        return Scenes(made.poses.double(), None if goal is None else goal.to(self.dtype), fields)

    def _checked_field(self, name: str, value: Tensor) -> Tensor:
        """A field of the particles of all scenes [B, R, ...] in the dtype of that field."""
        known = _fields_of(self.envs.first)
        if name not in known:
            raise ValueError(f"fields of scenes must be among {sorted(known)}, which the particles have, got {name!r}")
        shape = [self.num_envs, self.envs.room, *known[name].shape[1:]]
        if list(value.shape) != shape:
            raise ValueError(f"field {name!r} of scenes must have shape {shape}, got {shape_of(value)}")
        if value.is_floating_point() and known[name].is_floating_point():
            value = value.to(known[name].dtype)
        if value.dtype != known[name].dtype:
            raise TypeError(f"field {name!r} of scenes must be {known[name].dtype}, got {value.dtype}")
        return value

    def _begin(self, which: Tensor) -> None:
        """Begin new episodes in the scenes of a mask bool [B]."""
        self._replace(which)
        observation, score = self.start()
        self._observation = torch.where(which[:, None], observation, self._observation)
        self._score = torch.where(which, score, self._score)

    def _replace(self, which: Tensor) -> None:
        """Replace the scenes of a mask bool [B]. All scenes are drawn, because reading the mask would wait for it."""
        self.episodes = self.episodes + which
        made = self._drawn()
        fields, first = {name: value.flatten(0, 1) for name, value in made.fields.items()}, self.envs.first
        extra = {name: fields.pop(name, value) for name, value in first.extra.items()}
        self.envs.reset(which, first.replace(**fields, extra=extra))
        self.poses = torch.where(which[:, None, None], made.poses, self.poses)
        if made.goal is not None:
            self.goal = torch.where(which[:, None], made.goal, self.goal)
        for name in ("steps", "terminated", "truncated"):
            setattr(self, name, getattr(self, name).masked_fill(which, 0))

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
        self._freeze(failed)  # Before observations: zero times the gradient of a scene without a result is NaN.
        observation, score = self.observation(), self.score()
        defined = observation.isfinite().all(1) & score.isfinite() & self.poses.isfinite().flatten(1).all(1)
        failed = failed | ~(defined | ended)
        self._gate.failed = failed
        held = ended | failed
        observation = torch.where(held[:, None], self._observation, observation)
        score = torch.where(held, self._score, score)
        reward = torch.where(held, 0.0, self.reward(score - self._score, actions))
        success = self.success() & ~held
        terminated = torch.where(ended, self.terminated, success | failed)
        truncated = torch.where(ended, self.truncated, ~terminated & (self.steps >= self.max_episode_steps))
        self._observation, self._score = observation, score
        self.terminated, self.truncated = terminated, truncated
        self._freeze(self.ended & ~ended)
        self._failures = failures, failed
        return reward, {"success": success, "failed": failed}

    def _freeze(self, which: Tensor) -> None:
        """Let scenes of a mask bool [B] stand still."""
        if _may_have_some(which):
            self.envs.freeze(which)

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
        values = actions if isinstance(actions, Tensor) else torch.as_tensor(actions, device="cpu")
        values = to_device(values, self.device, self.dtype)
        if values.requires_grad and torch.is_grad_enabled() and not self.differentiable:
            raise ValueError("actions must not require grad where differentiable is False: detach them")
        if is_readable(values) and not bool(values.isfinite().all()):
            raise ValueError("actions must be finite, got NaN or infinity")
        return values.clamp(-1.0, 1.0)


def _fields_of(state: State) -> dict[str, Tensor]:
    """Fields of the particles that a state has, by name."""
    named = {name: getattr(state, name) for name in PARTICLE_FIELDS}
    return {name: value for name, value in named.items() if value is not None} | state.extra


def _may_have_some(mask: Tensor) -> bool:
    """Whether a mask has an entry that is true; it may have one where it cannot be read without waiting."""
    return not is_readable(mask) or bool(mask.any())
