"""Old import paths of modules and old names, which work for one release with a warning."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
import warnings
from collections.abc import Callable
from typing import Any

PACKAGE = __name__.rpartition(".")[0]
MOVED = {
    "activation_record": "step.status",
    "adaptive": "rollouts.until_time",
    "anomaly": "rollouts.anomaly",
    "bspline": "grid.bspline",
    "capture": "cuda_graphs.capture",
    "captured_steps": "rollouts.graph_segments",
    "cfl": "step.stability",
    "checkpoints": "rollouts.checkpoints",
    "containers": "state.pytree",
    "data.recording": "data.frame_transfer",
    "environments": "rollouts.environments",
    "failures": "step.failures",
    "gradient_norms": "rollouts.gradient_norms",
    "graphs": "cuda_graphs.graph",
    "heat_boundaries": "heat.boundaries",
    "impulses": "boundaries.impulses",
    "locking": "laws.locking",
    "memory": "data.host_memory",
    "node_contact": "boundaries.apply",
    "orders": "rollouts.sorting",
    "parameters": "laws.parameters",
    "particle_operations": "step.particle_operations",
    "pause": "step.pause",
    "per_scene": "geometry.per_scene",
    "point_files": "geometry.point_files",
    "precision": "ops.precision",
    "recompute": "rollouts.recompute",
    "recording": "rollouts.frames",
    "recording_keys": "cuda_graphs.keys",
    "resolution": "grid.resolution",
    "rollout_estimate": "rollouts.estimate",
    "rollout_parts": "rollouts.hooks",
    "scene.checkpoint": "state.state_file",
    "seed": "geometry.seed",
    "shapes": "geometry.shapes",
    "step_cost": "rollouts.memory",
    "step_times": "step.clocks",
    "surface_mesh": "geometry.surface_mesh",
    "topology": "grid.topology",
    "vectors": "geometry.vectors",
    "view": "render.viewer",
    "view_server": "render.viewer_server",
}
"""New path of each old one, both relative to the package."""
REMOVED = {"reference": "the ops in plain torch are an aid of tests: the package `oracle` in tests/ of the sources"}
"""Modules that are no longer part of the package, and where their contents are."""
RENAMED = {"Arrival": "RolloutToResult"}
"""New name of each old name of the package."""


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports the modules of the new paths under the old ones."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        package, _, old = name.partition(".")
        if package == PACKAGE and old in REMOVED:
            raise ModuleNotFoundError(f"{name} is not part of the package: {REMOVED[old]}", name=name)
        return importlib.machinery.ModuleSpec(name, self) if package == PACKAGE and old in MOVED else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> None:
        return None

    def exec_module(self, module: types.ModuleType) -> None:
        new = f"{PACKAGE}.{MOVED[module.__name__.partition('.')[2]]}"
        warnings.warn(f"{module.__name__} has moved to {new}", DeprecationWarning, stacklevel=2)
        target = importlib.import_module(new)
        sys.modules[module.__name__] = target  # The import returns this entry.


def attributes_of(package: str, module: str) -> Callable[[str], Any]:
    """A `__getattr__` for a package that was a module, for the names of a module in the package."""

    def attribute(name: str) -> Any:
        if not name.startswith("__"):
            new = f"{package}.{module}"
            found = getattr(importlib.import_module(new), name, None)
            if found is not None:
                warnings.warn(f"{package}.{name} has moved to {new}.{name}", DeprecationWarning, stacklevel=2)
                return found
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return attribute


def renamed(name: str) -> Any:
    """Attribute of the package by its old name."""
    warnings.warn(f"{PACKAGE}.{name} is now {PACKAGE}.{RENAMED[name]}", DeprecationWarning, stacklevel=3)
    return getattr(importlib.import_module(PACKAGE), RENAMED[name])


def install() -> None:
    """Install the finder of old paths, before the finders of files."""
    sys.meta_path.insert(0, _Finder())
