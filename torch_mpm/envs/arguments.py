"""Arguments of `MaterialEnv.reset` and of its constructor, checked by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .package import AutoresetMode

MODES = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)}
MASK = "reset_mask"


def autoreset_mode(given: Any) -> Any:
    """A mode of gymnasium by itself or by its value; ValueError for another one."""
    mode = given if isinstance(given, AutoresetMode) else MODES.get(given)
    if mode not in MODES.values():
        raise ValueError(f"autoreset_mode must be one of {sorted(MODES)}, got {getattr(given, 'value', given)!r}")
    return mode


def reset_mask(options: dict[str, Any] | None, scenes: int) -> Tensor | None:
    """Scenes to reset, bool [B]: None for all, without options; TypeError, ValueError for other options."""
    options = {} if options is None else options
    if not isinstance(options, dict):
        raise TypeError(f"options must be a dictionary, got {type(options).__name__}")
    if unknown := sorted(str(key) for key in options if key != MASK):
        raise ValueError(f"options must have the key {MASK!r} only, got {unknown[0]!r}")
    if MASK not in options:
        return None
    given = options[MASK]
    mask = torch.from_numpy(given.copy()) if isinstance(given, np.ndarray) else given
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool or tuple(mask.shape) != (scenes,):
        kind = f"{str(mask.dtype).removeprefix('torch.')} {list(mask.shape)}" if isinstance(mask, Tensor) else None
        raise ValueError(f"{MASK} must be bool [B] = [{scenes}], got {kind or type(mask).__name__}")
    return mask


def seeds_of_scenes(seed: Any, scenes: int) -> list[int | None]:
    """Seeds of the scenes below 2^63, those of a list or consecutive numbers; TypeError, ValueError for another seed.

    Larger numbers are folded, as of `np.random.SeedSequence().entropy`, which has 128 bits.
    """
    seeds = list(seed) if isinstance(seed, Sequence) else [seed] * scenes
    if len(seeds) != scenes:
        raise ValueError(f"seed must be a number or a list of {scenes}, got {len(seeds)}")
    for one in seeds:
        if one is not None and (isinstance(one, bool) or not isinstance(one, (int, np.integer)) or one < 0):
            raise ValueError(f"seed must be a whole number >= 0, or a list of such numbers and None, got {one!r}")
    first = not isinstance(seed, Sequence)
    return [None if one is None else _folded(int(one) + first * b) for b, one in enumerate(seeds)]


def _folded(seed: int) -> int:
    """A seed of 63 bits: the exclusive or of the groups of 63 bits of a number; the number itself below 2^63."""
    return seed if seed < 2**63 else _folded(seed >> 63) ^ (seed & (2**63 - 1))
