"""Bodies of few particles."""

import torch

from benchmarks.catalogue.scenes import block_state
from cases.small_scenes import F64


def body(dim, device="cpu", speed=3.0, **options):
    state = block_state(dim, dx=0.05 if dim == 3 else 0.02, **options)
    along = torch.tensor([speed, -0.3 * speed, 0.5 * speed][:dim], dtype=F64)
    return state.replace(v=state.v + along).to(device)


def crowd(dim, device, high):
    """64 particles a cell."""
    state = block_state(dim, dx=0.025 if dim == 3 else 0.005, high=high)
    assert 13000 < len(state) < 2**15
    return state.replace(v=state.v + torch.tensor([3.0, -1.0, 1.5][:dim], dtype=F64)).to(device)
