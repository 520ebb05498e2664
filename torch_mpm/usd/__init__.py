"""USD files of runs (`pip install torch-mpm[usd]`).

from torch_mpm import usd

usd.export_usd("out/demo", surface=True)
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..scene.usd import export_usd as export_usd

__all__ = ["export_usd"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ..scene.usd import export_usd

    return export_usd
