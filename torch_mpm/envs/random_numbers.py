"""Random numbers of scenes by their seeds, computed on the device (SplitMix64: Steele, Lea and Flood 2014)."""

from __future__ import annotations

import torch
from torch import Tensor


def _signed(bits: int) -> int:
    """A number of 64 bits as int64, whose products wrap around."""
    return bits - 2**64 if bits >= 2**63 else bits


GAMMA = _signed(0x9E3779B97F4A7C15)
MIXERS = (30, _signed(0xBF58476D1CE4E5B9)), (27, _signed(0x94D049BB133111EB))


def uniform(seeds: Tensor, episodes: Tensor, count: int) -> Tensor:
    """Numbers in [0, 1) [B, count], float64, by seeds and episodes, int64 [B]; row b depends on those of b alone."""
    own = _mixed(seeds + GAMMA * (episodes + 1))
    index = torch.arange(1, count + 1, device=seeds.device)
    return _right(_mixed(own[:, None] + GAMMA * index), 11).double() * 2.0**-53


def _mixed(bits: Tensor) -> Tensor:
    for shift, factor in MIXERS:
        bits = (bits ^ _right(bits, shift)) * factor
    return bits ^ _right(bits, 31)


def _right(bits: Tensor, shift: int) -> Tensor:
    """Bits [...] shifted to the right, with zeros on the left."""
    return (bits >> shift) & (2 ** (64 - shift) - 1)
