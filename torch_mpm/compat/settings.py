"""Configurations: objects with attributes, such as those of OmegaConf, or mappings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .gradients import refuse_grad

_NEEDED = object()


def setting(configuration: Any, name: str, default: Any = _NEEDED) -> Any:
    """A value of a configuration.

    Raises:
        ValueError: where it is missing and has no default, or requires grad.
    """
    if isinstance(configuration, Mapping):
        value = configuration.get(name, default)
    else:
        value = getattr(configuration, name, default)
    if value is _NEEDED:
        raise ValueError(f"the configuration must have {name}")
    refuse_grad(
        "values of a configuration are copied; assign an attribute of its result, such as law.log_E", **{name: value}
    )
    return value
