"""Environments for the algorithms of stable-baselines3, such as PPO (docs/envs.md); extra `learn`.

env = StableBaselinesEnv(Push(16, numpy=True, autoreset_mode="Disabled"))
stable_baselines3.PPO("MlpPolicy", env, seed=0).learn(100_000)
"""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from .. import optional
from .package import AutoresetMode
from .vector import MaterialEnv

VecEnv: Any = optional.load("stable_baselines3.common.vec_env", "StableBaselinesEnv", "learn").VecEnv


class StableBaselinesEnv(VecEnv):
    """A `MaterialEnv` in the vector interface of stable-baselines3.

    The step that ends an episode returns the first observation of the next one. Then the dictionary of its scene has
    the last observation, "terminal_observation" [O], "TimeLimit.truncated" (bool), "is_success" (bool), and after a
    failure the "reason" (text). Algorithms add the value of the last observation to the reward of a truncated episode.

    Args:
        env: an environment with `numpy=True` and `autoreset_mode="Disabled"`: scenes are reset here.

    Attributes:
        env: that environment. Attributes are read from it, and set and called on it, not through this interface.

    Raises:
        TypeError, ValueError: for another environment.
        ImportError: without stable-baselines3, at the import of this module.
    """

    def __init__(self, env: MaterialEnv) -> None:
        if not isinstance(env, MaterialEnv):
            raise TypeError(f"env must be a MaterialEnv, got {type(env).__name__}")
        if not env.numpy:
            raise ValueError("env must have numpy=True, got an environment that returns tensors")
        if env.autoreset is not AutoresetMode.DISABLED:
            raise ValueError(f"env must have autoreset_mode='Disabled', got {env.autoreset.value!r}")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> npt.NDArray[Any]:
        """First observations [B, O] of new episodes, with the seeds of `seed`."""
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options}")
        observation, _ = self.env.reset(seed=self._seeds)
        self._reset_seeds()
        return observation

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Observations [B, O], rewards [B], ends of episodes bool [B], and a dictionary for each scene."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        ended = terminated | truncated
        reasons = self.env.failure_reasons() if info["failed"].any() else [None] * self.num_envs
        infos: list[dict[str, Any]] = [{} for _ in ended]
        for b in np.flatnonzero(ended):
            infos[b]["terminal_observation"] = observation[b]
            infos[b]["TimeLimit.truncated"] = bool(truncated[b])
            infos[b]["is_success"] = bool(info["success"][b])
            if reasons[b] is not None:
                infos[b]["reason"] = reasons[b]
        if ended.any():
            observation, _ = self.env.reset(options={"reset_mask": ended})
        return observation, reward, ended, infos

    def get_images(self) -> tuple[Any, ...]:
        return self.env.render()

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, which all scenes share, for each scene of `indices`."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> NoReturn:
        raise NotImplementedError(f"{attr_name} must be set on env: its scenes are one simulation")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> NoReturn:
        raise NotImplementedError(f"{method_name} must be called on env: its scenes are one simulation")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
