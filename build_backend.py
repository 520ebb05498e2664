"""PEP 517 backend: setuptools, with torch as a build requirement only where the target environment has none.

Building needs the headers and libtorch.so of any torch >= 2.11, because the libraries use the LibTorch stable ABI. A
fixed entry in [build-system] would make every isolated build unpack a second torch.
"""

from __future__ import annotations

import importlib.util
import site
import sysconfig
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403


def torch_directory() -> Path | None:
    """Directory of the torch package, found without importing it.

    Build isolation hides the packages of the target environment, but its files can still be read.
    """
    spec = importlib.util.find_spec("torch")
    visible = list(spec.submodule_search_locations or []) if spec else []
    sites = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), site.getusersitepackages()]
    for candidate in [*map(Path, visible), *(Path(path, "torch") for path in sites)]:
        if (candidate / "include/torch/csrc/stable/library.h").exists():
            return candidate
    return None


def _torch_requirement() -> list[str]:
    return [] if torch_directory() else ["torch>=2.11"]


def get_requires_for_build_wheel(config_settings: dict[str, Any] | None = None) -> list[str]:
    return build_meta.get_requires_for_build_wheel(config_settings) + _torch_requirement()


def get_requires_for_build_editable(config_settings: dict[str, Any] | None = None) -> list[str]:
    return build_meta.get_requires_for_build_editable(config_settings) + _torch_requirement()
