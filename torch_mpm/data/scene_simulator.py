"""Simulation function of a configuration for `OnlineStream`: scenes of some ids, simulated together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .configuration import Configuration
from .shard_simulation import Outcome, draw, simulate


def simulator(
    configuration: Configuration, device: torch.device | str = "cpu"
) -> Callable[[Sequence[int]], list[dict[str, Tensor] | None]]:
    """A function that draws and simulates the scenes of some ids as `torch-mpm generate` does, shard by shard.

    The ids of a shard give bit-identical numbers to that shard on the same device; ids beyond ``configuration.scenes``
    give scenes outside any data set of that configuration.

    Args:
        configuration: configuration of the data set.
        device: device of the simulation and its tensors.

    Returns:
        A function of a sequence of ids. Its result is for each id a dictionary of ``position`` and the fields of the
        configuration [T, N, ...], ``particle_type``, ``material``, ``mass`` and ``volume`` [N]; None for a scene that
        failed.
    """
    target = torch.device(device)

    def simulated(ids: Sequence[int]) -> list[dict[str, Tensor] | None]:
        drawn = draw(configuration, ids, target)
        simulate(configuration, drawn, target)
        return [None if outcome.failure else tensors(outcome) for outcome in drawn.outcomes]

    def tensors(outcome: Outcome) -> dict[str, Tensor]:
        return {name: torch.from_numpy(array).to(target) for name, array in outcome.arrays.items()}

    return simulated
