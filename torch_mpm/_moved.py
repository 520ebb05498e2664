"""Old import paths of modules, which work for one release with a warning."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
import warnings
from typing import Any

PACKAGE = __name__.rpartition(".")[0]
MOVED = {
    "adaptive": "rollouts.until_time",
    "anomaly": "rollouts.anomaly",
    "captured_steps": "rollouts.graph_segments",
    "checkpoints": "rollouts.checkpoints",
    "environments": "rollouts.environments",
    "gradient_norms": "rollouts.gradient_norms",
    "orders": "rollouts.sorting",
    "recompute": "rollouts.recompute",
    "recording": "rollouts.frames",
    "rollout_estimate": "rollouts.estimate",
    "rollout_parts": "rollouts.hooks",
    "step_cost": "rollouts.memory",
}
"""New path of each old one, both relative to the package."""


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Makes modules under the old names, whose attributes are those of the new ones."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        package, _, old = name.rpartition(".")
        return importlib.machinery.ModuleSpec(name, self) if package == PACKAGE and old in MOVED else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> None:
        return None

    def exec_module(self, module: types.ModuleType) -> None:
        new = f"{PACKAGE}.{MOVED[module.__name__.rpartition('.')[2]]}"
        warnings.warn(f"{module.__name__} has moved to {new}", DeprecationWarning, stacklevel=2)
        target = importlib.import_module(new)
        module.__doc__ = target.__doc__
        vars(module)["__getattr__"] = lambda name: getattr(target, name)


def install() -> None:
    """Let import statements find old paths, before any file of this name."""
    sys.meta_path.insert(0, _Finder())
