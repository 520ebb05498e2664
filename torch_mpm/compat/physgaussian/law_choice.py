"""Choice of the law of a simulator by its dialect, parameters and materials of particles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ...laws import Material, Mixture
from .dialects import Dialect, material_of
from .materials import law_of
from .parameters import USED, check_gradients, check_material, kind_of


def kinds_of(dialect: Dialect, material: Any, codes: Tensor | None) -> list[tuple[str, str]]:
    """Materials and their kinds; none where the material is a law.

    Args:
        dialect: the dialect.
        material: name of the material, or a law.
        codes: number of the material of each particle, int32 [P]; None where all have `material`.

    Raises:
        TypeError, ValueError, NotImplementedError: for a material without a law.
    """
    if isinstance(material, Material):
        return []
    names = [material] if codes is None else [material_of(dialect, code) for code in codes.unique().tolist()]
    return [(name, kind_of(dialect, name)) for name in names]


def needs_moduli(kinds: list[tuple[str, str]]) -> bool:
    """Whether a law needs E and nu of `finalize_mu_lam`."""
    return not kinds or any(kind == "snow" or "E" in USED[kind][0] for _, kind in kinds)


def chosen_law(dialect: Dialect, parameters: Mapping[str, Any], codes: Tensor | None) -> Material:
    """Law of parameters in units of the dialect.

    Raises:
        TypeError, ValueError, NotImplementedError: for an unknown material, one that has no law or lacks a parameter,
            or a parameter that requires grad without effect.
    """
    material = parameters.get("material", "jelly")
    kinds = kinds_of(dialect, material, codes)
    if not kinds:
        check_gradients(parameters, (), "a law")
        assert isinstance(material, Material)
        return material
    effective = {used for name, kind in kinds if kind != "snow" for used in check_material(name, kind, parameters)}
    check_gradients(parameters, effective, f"material {kinds[0][0]!r}" if len(kinds) == 1 else "the materials")
    si = {name: dialect.effective(name, value) for name, value in {**dialect.defaults, **parameters}.items()}
    laws = [law_of(kind, si) for _, kind in kinds]
    return laws[0] if len(laws) == 1 else Mixture(laws)


def law_indices(codes: Tensor) -> Tensor:
    """Index of the law of each particle in the `Mixture` of `chosen_law`, int32 [P]."""
    return torch.searchsorted(codes.unique(), codes).to(torch.int32)
