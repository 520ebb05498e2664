"""Steps of the MjData of many scenes by threads of MuJoCo (`mujoco.batch`, MuJoCo 3.17 or later)."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from ..errors import SimulationError
from ..optional import load
from .geoms import load_mujoco

NUMBER = 1
"""Column of the number of warnings in `Batch.warning`, beside the latest information."""


class MujocoThreads:
    """Threads that compute `mj_step` of all scenes, with the results of a loop over their MjData, bit by bit.

    Each thread has one MjData for all of its scenes, so that only their states are returned, without contacts and
    sensors. `mujoco.rollout` returns less: no warm start of the constraint solver, on which the next step depends.

    Args:
        model: MjModel.
        scenes: number of MjData.
        threads: number of threads.

    Raises:
        ImportError: without `mujoco.batch`.
        ValueError: for a model that it does not support, such as one whose bodies sleep.
    """

    def __init__(self, model: Any, scenes: int, threads: int) -> None:
        if find_spec("mujoco.batch") is None:
            raise ImportError(f"threads of MuJoCo need mujoco 3.17 or later, got {load_mujoco().__version__}")
        self._module = load("mujoco.batch", "threads of MuJoCo", "mujoco")
        try:
            self._batch = self._module.Batch(model, scenes, threads)
        except ValueError as error:
            raise ValueError(f"threads must be 1 for this model: {error}") from error
        self._wrenches = self._batch.bind("xfrc_applied")

    def update(self, model: Any) -> None:
        """Use the present values of a model; raises ValueError for one, or Python callbacks, without support."""
        if model.nplugin > 0:
            raise ValueError("threads must be 1 for a model with plugins, which may have a state in each MjData")
        try:
            self._batch.set_models(model)
            self._batch.step(np.empty(0, dtype=np.int32))  # Of no scene, which finds callbacks.
        except (ValueError, load_mujoco().FatalError) as error:
            raise ValueError(f"threads must be 1 for this model: {error}") from error

    def step(self, states: np.ndarray, bodies: np.ndarray, wrenches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States one step later.

        Args:
            states: all that a step depends on (mjSTATE_INTEGRATION) [B, n].
            bodies: numbers of K bodies.
            wrenches: forces [N] and torques about the centres of mass [N m] on them [B, K, 6].

        Returns:
            States [B, n], valid until the next call, and numbers of warnings of the step [B, kinds].

        Raises:
            SimulationError: for an error of MuJoCo.
        """
        batch = self._batch
        batch.state[:] = states
        self._wrenches[:, bodies] = wrenches
        before = batch.warning[:, :, NUMBER].copy()
        try:
            batch.step()
        except self._module.SimulationError as error:
            b = int(error.ids[0])
            raise SimulationError(f"MuJoCo stopped in scene {b}: {batch.error(b)}") from error
        return batch.state, batch.warning[:, :, NUMBER] - before
