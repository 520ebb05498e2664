"""MjData of the scenes of a batch: their steps, and their quantities as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from ..errors import SimulationError
from .geoms import load_mujoco
from .mujoco_threads import MujocoThreads

LEAST_DOFS = 500
"""Least number of degrees of freedom of all scenes that is computed by threads.

Two threads gain from about this number on. With fewer, their start and the copies of states take longer
(benchmarks/results/coupling_amd_epyc.md, "Steps of MuJoCo").
"""


class MujocoScenes:
    """MjData of B scenes of a model. Wrenches act on K of its bodies.

    Args:
        model: MjModel.
        data: MjData of the scenes; a list, whose items are read in each `begin`.
        bodies: numbers of the bodies.
        threads: largest number of threads; None for those of torch where the scenes have at least `LEAST_DOFS` degrees
            of freedom, and MuJoCo has threads for the model.

    Raises:
        ImportError, ValueError: for more than one thread where MuJoCo has none; see `MujocoThreads`.
    """

    def __init__(self, model: Any, data: list[Any], bodies: Sequence[int], threads: int | None) -> None:
        self._mujoco = load_mujoco()
        self.model, self.data = model, data
        self._bodies = np.array(bodies, dtype=np.int64)
        self._required = threads is not None
        if threads is None:
            threads = torch.get_num_threads() if len(data) * model.nv >= LEAST_DOFS else 1
        self._wanted = min(threads, len(data))
        self._threads: MujocoThreads | None = None
        kinds = self._mujoco.mjtWarning
        self._unstable = [int(w) for w in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)]
        self.begin()

    def begin(self) -> None:
        """Use the present items of `data`, and the present values of the model."""
        self._positions = [data.xipos for data in self.data]
        self._orientations = [data.xquat for data in self.data]
        self._warnings = [data.warning.number for data in self.data]
        self._in_threads = self._find_threads()

    def poses(self) -> np.ndarray:
        """Centres of mass and orientations of the bodies by the present states [B, K, 7]."""
        for data in self.data:
            self._mujoco.mj_kinematics(self.model, data)
        parts = (self._of_scenes(views)[:, self._bodies] for views in (self._positions, self._orientations))
        return np.concatenate(list(parts), 2)

    def step(self, wrenches: np.ndarray, derived: bool) -> None:
        """Advance by one step of MuJoCo.

        Args:
            wrenches: forces [N] and torques about the centres of mass [N m] on the bodies [B, K, 6].
            derived: compute what follows from the states in the MjData too, such as contacts and sensors, as `mj_step`
                does; threads do not.

        Raises:
            SimulationError: for data that MuJoCo reports as unstable, after the step of all scenes, and for an error
                of MuJoCo.
        """
        times, counts = self._times(), self._of_scenes(self._warnings)
        if self._in_threads is not None and not derived:
            states, warned = self._in_threads.step(self.states(), self._bodies, wrenches)
            self.restore(states)
            for b in np.flatnonzero(warned.any(1)):
                self._warnings[b] += warned[b]
        else:
            self._step_one_by_one(wrenches)
        wrong = self._times() != times + self.model.opt.timestep
        wrong |= (self._of_scenes(self._warnings) != counts)[:, self._unstable].any(1)
        if wrong.any():
            scene = int(wrong.argmax())
            raise SimulationError(
                f"MuJoCo reports unstable data at {times[scene]:.6g} s in scene {scene}: use a smaller time step, or "
                "more exchanges"
            )

    def states(self) -> np.ndarray:
        """All that a step depends on [B, n], for `restore`."""
        kind = self._mujoco.mjtState.mjSTATE_INTEGRATION
        rows = np.empty((len(self.data), self._mujoco.mj_stateSize(self.model, kind)))
        for data, row in zip(self.data, rows, strict=True):
            self._mujoco.mj_getState(self.model, data, row, kind)
        return rows

    def restore(self, states: np.ndarray) -> None:
        """Set the MjData to states [B, n]."""
        for data, row in zip(self.data, states, strict=True):
            self._mujoco.mj_setState(self.model, data, row, self._mujoco.mjtState.mjSTATE_INTEGRATION)

    def _step_one_by_one(self, wrenches: np.ndarray) -> None:
        for b, (data, wrench) in enumerate(zip(self.data, wrenches, strict=True)):
            data.xfrc_applied[self._bodies] = wrench
            try:
                self._mujoco.mj_step(self.model, data)
            except self._mujoco.FatalError as error:
                raise SimulationError(f"MuJoCo stopped in scene {b}: {error}") from error

    def _find_threads(self) -> MujocoThreads | None:
        if self._wanted == 1:
            return None
        try:
            if self._threads is None:
                self._threads = MujocoThreads(self.model, len(self.data), self._wanted)
            self._threads.update(self.model)
        except (ImportError, ValueError):
            if self._required:
                raise
            return None
        return self._threads

    def _times(self) -> np.ndarray:
        return np.array([data.time for data in self.data])

    def _of_scenes(self, views: list[np.ndarray]) -> np.ndarray:
        """Copy of an array of each scene as [B, ...]."""
        return np.concatenate(views).reshape(len(views), *views[0].shape)
