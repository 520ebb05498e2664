"""Bodies of many particles."""

import torch

from benchmarks.catalogue.scenes import block_state
from cases.small_scenes import F64

CELLS = {"cpu": {2: 64, 3: 24}, "cuda": {2: 528, 3: 72}}
N = 24


def cell(dim, device):
    return 1 / CELLS[device][dim]


def dt_of(dim, device):
    """Time step in which a wave travels less than a third of a cell."""
    return 0.08 * cell(dim, device)


def body(dim, device, cells=0.15):
    """Block of particles in random order that moves by `cells` per step."""
    state = block_state(dim, low=0.25, high=0.75, dx=cell(dim, device), spin=5.0)
    assert device == "cpu" or len(state) >= 2**18
    along = torch.tensor([1.0, -0.4, 0.6][:dim], dtype=F64) * cells * cell(dim, device) / dt_of(dim, device)
    order = torch.randperm(len(state), generator=torch.Generator().manual_seed(2))
    return state.replace(v=state.v + along).select(order).to(device)
