"""Constitutive laws: modules from the deformation of a state to its Kirchhoff stress.

A law is a `Material`. Most are compiled (`CompiledLaw`); `CustomLaw` wraps any module, `Mixture` combines several in
one state. A new compiled law is a class in `solids` or `fluids`, named in the `__all__` of that module.
"""

from . import active, custom, fluids, mixture, sand, solids, thermal
from .active import *  # noqa: F403
from .compiled import CompiledLaw as CompiledLaw
from .compiled import SolidLaw as SolidLaw
from .custom import *  # noqa: F403
from .fluids import *  # noqa: F403
from .material import Material
from .mixture import *  # noqa: F403
from .sand import *  # noqa: F403
from .solids import *  # noqa: F403
from .thermal import *  # noqa: F403

__all__ = [
    "Material",
    *active.__all__,
    *custom.__all__,
    *fluids.__all__,
    *mixture.__all__,
    *sand.__all__,
    *solids.__all__,
    *thermal.__all__,
]
