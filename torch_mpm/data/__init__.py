"""Files of simulations: trajectories and data sets, training windows of them, and their conversion to other formats."""

import importlib
from typing import TYPE_CHECKING, Any

from .trajectory import Trajectory

if TYPE_CHECKING:
    from .exports.gns import export_gns as export_gns
    from .exports.lagrangebench import export_lagrangebench as export_lagrangebench
    from .exports.neuralmpm import export_neuralmpm as export_neuralmpm
    from .exports.scenes import export_scenes_ply as export_scenes_ply
    from .exports.scenes import export_scenes_vtk as export_scenes_vtk
    from .exports.tfrecord import export_tfrecord as export_tfrecord
    from .exports.well import export_well as export_well
    from .folder import DatasetFolder as DatasetFolder
    from .online import OnlineStream as OnlineStream
    from .scene_simulator import simulator as simulator
    from .windows import WindowDataset as WindowDataset
    from .windows import WindowStream as WindowStream
    from .windows import pack as pack
    from .windows import pad as pad

_MODULES = {
    "DatasetFolder": "folder",
    "OnlineStream": "online",
    "WindowDataset": "windows",
    "WindowStream": "windows",
    "export_gns": "exports.gns",
    "export_lagrangebench": "exports.lagrangebench",
    "export_neuralmpm": "exports.neuralmpm",
    "export_scenes_ply": "exports.scenes",
    "export_scenes_vtk": "exports.scenes",
    "export_tfrecord": "exports.tfrecord",
    "export_well": "exports.well",
    "pack": "windows",
    "pad": "windows",
    "simulator": "scene_simulator",
}
"""Imported on first use: `import torch_mpm` should not wait for them."""

__all__ = ["Trajectory", *_MODULES]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f".{_MODULES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
