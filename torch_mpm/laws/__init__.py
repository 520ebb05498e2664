"""Constitutive laws: modules from the deformation of a state to its Kirchhoff stress."""

from .material import CustomLaw, Material, Mixture, NeoHookean, WeaklyCompressible
from .plastic import CamClay, CustomPrincipalLaw, FixedCorotated, Hencky, HerschelBulkley, Snow, VonMises
from .sand import QuarticSand
from .thermal import Melting, ThermalExpansion

__all__ = [
    "CamClay",
    "CustomLaw",
    "CustomPrincipalLaw",
    "FixedCorotated",
    "Hencky",
    "HerschelBulkley",
    "Material",
    "Melting",
    "Mixture",
    "NeoHookean",
    "QuarticSand",
    "Snow",
    "ThermalExpansion",
    "VonMises",
    "WeaklyCompressible",
]
