"""From a configuration to what an `OnlineStream` asks for: scenes of some ids, simulated together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .configuration import Configuration
from .shard_simulation import draw, simulate, with_obstacles


def simulator(
    configuration: Configuration, device: torch.device | str = "cpu"
) -> Callable[[Sequence[int]], list[dict[str, Tensor] | None]]:
    """A function that draws and simulates the scenes of some ids as `torch-mpm generate` does, shard by shard.

    The ids of a shard give bit-identical numbers to that shard on the same device; ids beyond
    ``configuration.scenes`` give scenes that are in no data set of that configuration.

    Args:
        configuration: of the data set.
        device: where the scenes are simulated, and where their tensors are.

    Returns:
        A function of a sequence of ids. Its result is for each id a dictionary of ``position`` and the fields of the
        configuration [T, N, ...], ``particle_type``, ``material``, ``mass`` and ``volume`` [N]; None for a scene that
        failed.
    """
    target = torch.device(device)

    def simulated(ids: Sequence[int]) -> list[dict[str, Tensor] | None]:
        drawn = draw(configuration, ids, target)
        simulate(configuration, drawn, target)
        scenes = [None if o.failure else with_obstacles(configuration, o) for o in drawn.outcomes]
        return [s and {name: torch.from_numpy(array).to(target) for name, array in s.items()} for s in scenes]

    return simulated
