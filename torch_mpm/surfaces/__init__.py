"""Surfaces of the particles of a run as triangle meshes, and their files (`pip install torch-mpm[surface]`).

from torch_mpm import surfaces

surface = surfaces.reconstruct(state.x.numpy(), spacing=0.5 * grid.dx, dx=grid.dx)
surfaces.export_surfaces("out/demo", formats=["ply", "vtp"])
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..scene.surfaces import export_surfaces as export_surfaces
    from .interpolation import Interpolation as Interpolation
    from .reconstruction import Surface as Surface
    from .reconstruction import SurfaceOptions as SurfaceOptions
    from .reconstruction import reconstruct as reconstruct

_MODULES = {
    "Interpolation": ".interpolation",
    "Surface": ".reconstruction",
    "SurfaceOptions": ".reconstruction",
    "export_surfaces": "..scene.surfaces",
    "reconstruct": ".reconstruction",
}
"""Imported on first use: the command line should not wait for them."""

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(_MODULES[name], __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
