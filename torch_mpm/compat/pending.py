"""Substeps that are computed later, and tensors that must not be written to before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from ..cuda_graphs.capture import version

Versions = Mapping[str, int | None]


def versions(values: Mapping[str, Any]) -> Versions:
    """Versions of the tensors among values, which grow with each write in place."""
    return {name: version(value) for name, value in values.items() if isinstance(value, Tensor)}


def check_versions(before: Versions, now: Versions, steps: int) -> None:
    """Raise RuntimeError that names a tensor which was written to while substeps were pending."""
    for name, one in before.items():
        if now.get(name) != one:
            raise RuntimeError(
                f"{name} must not be written to while {steps} substeps are pending, which would be computed with the "
                "new values: read a result, or assign a new tensor"
            )
