"""Parameters of `set_parameters_dict`: ranges, required and optional parameters of each material, and keys of
descendants.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

import torch
from torch import Tensor

from ...errors import check_count, check_number, shape_of
from ..gradients import refuse_grad, requires_grad, vector

FINITE, NOT_NEGATIVE, POSITIVE = "finite", "finite and not negative", "finite and positive"
RANGES: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "E": (NOT_NEGATIVE, lambda v: v >= 0),
    "nu": ("between -1 and 0.5", lambda v: (v > -1) & (v < 0.5)),
    "density": (POSITIVE, lambda v: v > 0),
    "yield_stress": (NOT_NEGATIVE, lambda v: v >= 0),
    "xi": (NOT_NEGATIVE, lambda v: v >= 0),
    "friction_angle": ("at least 0 and below 90 degrees", lambda v: (v >= 0) & (v < 90)),
    "plastic_viscosity": (NOT_NEGATIVE, lambda v: v >= 0),
    "softening": (NOT_NEGATIVE, lambda v: v >= 0),
    "rpic_damping": ("finite and at most 1", lambda v: v <= 1),
    "grid_v_damping_scale": (NOT_NEGATIVE, lambda v: v >= 0),
}
"""Range of each parameter in words, and its test."""
OF_THE_WHOLE = ("rpic_damping", "grid_v_damping_scale")
"""Parameters without a value per particle."""
KNOWN = (*RANGES, "material", "grid_lim", "n_grid", "hardening", "g", "additional_material_params")
WITHOUT_EFFECT = ("pic_damping", "opacity_threshold")
"""Keys that PhysGaussian's `decode_param_json` stores among the parameters, and its simulator does not read."""
BOX = ("point", "size", "E", "nu", "density")

LAW = "give a law as material, such as torch_mpm.Viscoelastic"
CAMCLAY = "GaussianFluent has it for its watermelon: give material=torch_mpm.CamClay(...)"
FLUID = "fluids need a law as material, such as torch_mpm.WeaklyCompressible"
UNSUPPORTED = {
    **{name: f"Physics3D has it for a viscous branch: {LAW}" for name in ("mu_N", "lam_N", "viscosity")},
    "mu": "MotionPhysics has it: give E and nu",
    **{"bulk": f"MotionPhysics has it: {FLUID}", "bulk_modulus": f"PIXIE has it: {FLUID}"},
    "spawn_offset": "PIXIE has it: move the positions before they are loaded",
    "flip_pic_ratio": "GaussianFluent has it: steps here are APIC, or PIC with rpic_damping=-1",
    **{"alpha_0": CAMCLAY, "beta": CAMCLAY},
    "dx": "others have it in the place of n_grid, which is grid_lim / dx",
}
"""Keys of descendants of PhysGaussian's simulator."""
BOX_UNSUPPORTED = {"material": "PIXIE has it; all particles of a simulator here have one material"}

USED: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "jelly": (("E", "nu"), ()),
    "metal": (("E", "nu", "yield_stress"), ("hardening", "xi")),
    "sand": (("E", "nu"), ("friction_angle",)),
    "foam": (("E", "nu", "yield_stress"), ("plastic_viscosity",)),
    "plasticine": (("E", "nu", "yield_stress"), ("softening", "hardening", "xi")),
}
"""Required and optional parameters of each material."""
OF_LAWS = ("E", "nu", "yield_stress", "hardening", "xi", "friction_angle", "plastic_viscosity", "softening")
OTHER_MATERIALS = {
    **{"elastic": "PhysFlow's; 'jelly' is elastic", "neo-hookean": "PhysDreamer's; give torch_mpm.NeoHookean"},
    **{name: f"PhysFlow's; {FLUID}" for name in ("newtonian", "non_newtonian")},
    **{"fluid": f"PIXIE's and MotionPhysics's; {FLUID}", "stationary": "PIXIE's; hold particles at rest instead"},
    **{"rock_brittle": "PIXIE's; give a law", "watermelon": "GaussianFluent's; give torch_mpm.CamClay"},
}
"""Materials of descendants."""


def checked(name: str, value: Any, like: Tensor) -> Any:
    """Parameter as a number, or as a tensor in the dtype and on the device of a particle tensor [P, ...].

    Raises:
        TypeError, ValueError: for a wrong type, shape or range, or a gradient that it cannot have.
    """
    if name == "g":
        if isinstance(value, (int, float)):
            raise TypeError(f"g must be three numbers, got {value}")
        return vector("g", value, like)
    if name in ("n_grid", "grid_lim", "hardening"):
        refuse_grad("it is a number of the whole simulation", **{name: value})
    if name == "n_grid":
        return check_count("n_grid", value, 1)
    if name == "grid_lim":
        return float(check_number("grid_lim", value, POSITIVE, lambda v: 0 < v < math.inf))
    if name == "hardening":
        return check_number("hardening", value, "0 or 1", lambda v: v in (0, 1))
    return _in_range(name, value, like) if name in RANGES else value


def _in_range(name: str, value: Any, like: Tensor) -> float | Tensor:
    expected, holds = RANGES[name]
    if not isinstance(value, Tensor) and not hasattr(value, "__len__"):
        number = float(check_number(name, value, expected, lambda v: math.isfinite(v) and bool(holds(v))))
        if abs(number) > (most := torch.finfo(like.dtype).max):
            raise ValueError(f"{name} must be at most {most:.2g}, the largest number of {like.dtype}, got {number:g}")
        return number
    try:
        tensor = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError):
        found = repr(value) if isinstance(value, str) else shape_of(value)
        raise TypeError(f"{name} must be a number, or numbers [P], got {found}") from None
    one = name in OF_THE_WHOLE
    if tuple(tensor.shape) not in (((), (1,)) if one else ((), (1,), (len(like),))):
        shapes = "[]" if one else f"[] or [P] = [{len(like)}]"
        raise ValueError(f"{name} must be a number, or have shape {shapes}, got {shape_of(tensor)}")
    values = tensor.detach()
    if not bool((holds(values) & values.isfinite()).all()):
        raise ValueError(f"{name} must be {expected}, got {value}")
    if name == "rpic_damping" and tensor.requires_grad and bool(values < 0):
        raise ValueError(f"rpic_damping must not be negative where it requires grad, got {value}: PIC has no share")
    return tensor.reshape(()) if one else tensor


def check_material(material: Any, parameters: Mapping[str, Any]) -> None:
    """Check that a material is known and has all required parameters.

    Raises:
        TypeError: for an unknown material.
        ValueError: for a material of a descendant, or a parameter that is missing, out of the range of the material, or
            requires grad without effect.
    """
    if not isinstance(material, str) or material not in USED:
        if material in OTHER_MATERIALS:
            raise ValueError(f"material {material!r} is not supported; it is {OTHER_MATERIALS[material]}")
        found = repr(material) if isinstance(material, str) else shape_of(material)
        raise TypeError(f"material must be one of {[*USED, 'snow']} or a torch_mpm.Material, got {found}")
    needed, optional = USED[material]
    for name in needed:
        if name not in parameters:
            words = f"{', '.join(needed[:-1])} and {needed[-1]}"
            raise ValueError(f"material {material!r} needs {words}: give {name} in set_parameters_dict")
    limit = parameters.get("yield_stress")
    if material in ("metal", "plasticine") and bool((torch.as_tensor(limit).detach() <= 0).any()):
        raise ValueError(f"yield_stress of {material!r} must be positive, got {limit}")
    hardens = parameters.get("hardening", 0) == 1
    effective = [name for name in (*needed, *optional) if name != "xi" or hardens]
    check_gradients(parameters, effective, f"material {material!r}")


def check_gradients(parameters: Mapping[str, Any], effective: Collection[str], material: str) -> None:
    """Check that parameters that require grad have an effect on a material.

    Raises:
        ValueError: for a parameter of laws that is not among those with an effect, and requires grad.
    """
    for name in OF_LAWS:
        if name not in effective and requires_grad(parameters.get(name)):
            hint = " while hardening is 0" if name == "xi" else ""
            raise ValueError(f"{name} must not require grad: it has no effect on {material}{hint}")
