"""Active blocks without particles, for tests of what acts on nodes."""

import torch
from torch import Tensor

import torch_mpm as mpm


def random_blocks(grid: mpm.Grid, device: str = "cpu", share: float = 0.7, unused: int = 3) -> mpm.Blocks:
    """A share of the grid's blocks in slots of random order, with unused slots between them."""
    generator = torch.Generator().manual_seed(3)
    total = grid.block_count if grid.scenes else 0
    active = torch.randperm(total, generator=generator)[: round(share * total)].int()
    block = torch.full((len(active) + unused,), -1, dtype=torch.int32)
    slots = torch.randperm(len(block), generator=generator)[: len(active)]
    block[slots] = active
    table = torch.full((total,), -1, dtype=torch.int32)
    table[active.long()] = slots.int()
    nothing = torch.empty(0, dtype=torch.int32, device=device)
    return mpm.Blocks(grid, table.to(device), block.to(device), nothing, nothing, nothing, None, nothing)


def random_nodes(blocks: mpm.Blocks) -> Tensor:
    """Mass and momentum [N, 1 + D] in float64; every fifth row and those of unused blocks are zero."""
    generator = torch.Generator().manual_seed(5)
    nodes = torch.randn(blocks.node_count, 1 + blocks.grid.dim, generator=generator, dtype=torch.float64)
    nodes[:, 0] = 0.5 + nodes[:, 0].abs()
    nodes[::5] = 0
    return torch.where(blocks.active_nodes()[:, None], nodes.to(blocks.block.device), 0)
