"""Python wrappers of the ops: checks, fake kernels, autograd.

The ops themselves, `torch.ops.torch_mpm.*`, also check sizes, dtypes, devices and numbers, and raise RuntimeError. The
last three arguments `topology`, `lattice` and `layout` are `Blocks.packed`. The index tensors in `topology` must be
those of one call of `activate` with this lattice: their sizes are checked, but not their values, and other tensors can
make a kernel read or write outside its tensors.
"""

from . import activation as activation
from . import substeps as substeps
from .advance import advance
from .contact import contact, fusible
from .g2p_advance import g2p_advance
from .grid_update import grid_update
from .heat import HeatSolve, heat_cg, heat_operator
from .implicit import ImplicitSolve, implicit_apply, implicit_cg, implicit_node_blocks
from .impulses import contact_impulses, wall_impulses
from .law import LawUpdate, law_energy, law_energy_gradient, law_stiffness, law_tangent, law_update, law_wave_modulus
from .registry import LAWS
from .sand import quartic_energy, quartic_return_map, quartic_stiffness, quartic_stress
from .survey import Survey, survey
from .svd import polar, svd3
from .transfer import g2p, gather, p2g, scatter

__all__ = [
    "LAWS",
    "HeatSolve",
    "ImplicitSolve",
    "LawUpdate",
    "Survey",
    "advance",
    "contact",
    "contact_impulses",
    "fusible",
    "g2p",
    "g2p_advance",
    "gather",
    "grid_update",
    "heat_cg",
    "heat_operator",
    "implicit_apply",
    "implicit_cg",
    "implicit_node_blocks",
    "law_energy",
    "law_energy_gradient",
    "law_stiffness",
    "law_tangent",
    "law_update",
    "law_wave_modulus",
    "p2g",
    "polar",
    "quartic_energy",
    "quartic_return_map",
    "quartic_stiffness",
    "quartic_stress",
    "scatter",
    "survey",
    "svd3",
    "wall_impulses",
]
