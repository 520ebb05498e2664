"""Parameters of `set_parameters_dict`: ranges, and required and optional parameters of each material."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

import torch
from torch import Tensor

from ...errors import check_count, check_number, shape_of
from ..gradients import refuse_grad, requires_grad, vector
from ..keys import check_keys
from .dialects import DIALECTS, Dialect

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
    "mu_N": (NOT_NEGATIVE, lambda v: v >= 0),
    "lam_N": (NOT_NEGATIVE, lambda v: v >= 0),
    "viscosity": (POSITIVE, lambda v: v > 0),
    "mu": (NOT_NEGATIVE, lambda v: v >= 0),
    "bulk": (NOT_NEGATIVE, lambda v: v >= 0),
    "bulk_modulus": (NOT_NEGATIVE, lambda v: v >= 0),
    "alpha_0": (FINITE, lambda v: v == v),
    "beta": (NOT_NEGATIVE, lambda v: v >= 0),
    "flip_pic_ratio": ("between 0 and 1", lambda v: (v >= 0) & (v <= 1)),
}
"""Range of each parameter in words, and its test."""
OF_THE_WHOLE = ("rpic_damping", "grid_v_damping_scale", "flip_pic_ratio")
"""Parameters without a value per particle."""
BOX = ("point", "size", "E", "nu", "density")

USED: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "jelly": (("E", "nu"), ()),
    "metal": (("E", "nu", "yield_stress"), ("hardening", "xi")),
    "sand": (("E", "nu"), ("friction_angle",)),
    "foam": (("E", "nu", "yield_stress"), ("plastic_viscosity",)),
    "plasticine": (("E", "nu", "yield_stress"), ("softening", "hardening", "xi")),
    "viscous jelly": (("E", "nu", "mu_N", "lam_N", "viscosity"), ()),
    "hardening metal": (("E", "nu", "yield_stress"), ("hardening", "xi")),
    "softening metal": (("E", "nu", "yield_stress"), ("softening", "hardening", "xi")),
    "sand of an angle": (("E", "nu", "friction_angle"), ()),
    "newtonian": (("E", "nu"), ()),
    "newtonian of mu and bulk": (("mu", "bulk"), ()),
    "fluid": (("bulk_modulus",), ()),
    "fluid of bulk": (("bulk",), ()),
    "stationary": ((), ()),
    "watermelon": (("E", "nu", "beta"), ("alpha_0", "xi", "hardening", "friction_angle")),
    "neo-hookean": (("E", "nu"), ()),
}
"""Required and optional parameters of each kind of material."""
OF_LAWS = (
    *("E", "nu", "yield_stress", "hardening", "xi", "friction_angle", "plastic_viscosity", "softening"),
    *("mu_N", "lam_N", "viscosity", "mu", "bulk", "bulk_modulus", "alpha_0", "beta"),
)
HARDENING_BY_ITS_KEY = ("hardening metal", "softening metal")
"""Kinds that harden where `hardening` is given, with any value."""
WITHOUT_LAW = {
    "rock_brittle": "PIXIE names it without a law: pass material=torch_mpm.CamClay(...), 'metal' or 'plasticine'",
}
"""Materials of descendants that have no law in their own simulator."""


def checked(name: str, value: Any, like: Tensor) -> Any:
    """Parameter as a number, or as a tensor in the dtype and on the device of a particle tensor [P, ...].

    Raises:
        TypeError, ValueError: for a wrong type, shape or range, or a gradient that it cannot have.
    """
    if name == "g":
        if isinstance(value, (int, float)):
            raise TypeError(f"g must be three numbers, got {value}")
        return vector("g", value, like)
    if name in ("n_grid", "grid_lim", "hardening", "flip_pic_ratio"):
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
        raise ValueError(f"{name} must be {expected}, got {_first(values, ~(holds(values) & values.isfinite()))}")
    if name == "rpic_damping" and tensor.requires_grad and bool(values < 0):
        raise ValueError(f"rpic_damping must not be negative where it requires grad, got {value}: PIC has no share")
    return tensor.reshape(()) if one else tensor


def _first(values: Tensor, bad: Tensor) -> str:
    """The first of some values that are bad, in words."""
    k = int(bad.reshape(-1).int().argmax())
    number = f"{float(values.reshape(-1)[k]):g}"
    return f"{number} for particle {k}" if values.numel() > 1 else number


def check_box(what: str, box: Mapping[str, Any], dialect: Dialect) -> None:
    """Check that the keys of a box of additional_material_params are those of a dialect.

    Raises:
        ValueError: for another key.
    """
    others = {} if "material" in dialect.box_keys else {"material": "pass dialect='pixie', which has it"}
    check_keys(what, box, (*BOX, *dialect.box_keys), others)


def kind_of(dialect: Dialect, material: Any) -> str:
    """Kind of a material of a dialect.

    Raises:
        TypeError: for an unknown material.
        NotImplementedError: for one that has no law.
        ValueError: for a material of another dialect.
    """
    if isinstance(material, str):
        if material in dialect.materials:
            return dialect.materials[material]
        if material in WITHOUT_LAW:
            raise NotImplementedError(f"material {material!r} has no law: {WITHOUT_LAW[material]}")
        others = [d for d in DIALECTS.values() if material in d.materials]
        if others:
            projects, names = (", ".join(getattr(d, name) for d in others) for name in ("project", "name"))
            raise ValueError(f"material {material!r} is that of {projects}: pass dialect= of one of {names}")
    found = repr(material) if isinstance(material, str) else shape_of(material)
    raise TypeError(f"material must be one of {sorted(dialect.materials)} or a torch_mpm.Material, got {found}")


def check_material(material: str, kind: str, parameters: Mapping[str, Any]) -> list[str]:
    """Check that a material has all required parameters.

    Returns:
        Names of the parameters with an effect.

    Raises:
        ValueError: for a parameter that is missing, or out of the range of the material.
    """
    needed, optional = USED[kind]
    for name in needed:
        if name not in parameters:
            words = " and ".join([", ".join(needed[:-1]), needed[-1]]) if len(needed) > 1 else needed[0]
            raise ValueError(f"material {material!r} needs {words}: give {name} in set_parameters_dict")
    limit = parameters.get("yield_stress")
    if "metal" in kind or kind == "plasticine":
        values = torch.as_tensor(limit).detach()
        if bool((values <= 0).any()):
            raise ValueError(f"yield_stress of {material!r} must be positive, got {_first(values, values <= 0)}")
    effective = [name for name in (*needed, *optional) if name != "xi" or hardens(kind, parameters)]
    return effective


def hardens(kind: str, parameters: Mapping[str, Any]) -> bool:
    """Whether a material hardens."""
    return parameters.get("hardening", 0) == 1 or (kind in HARDENING_BY_ITS_KEY and "hardening" in parameters)


def check_gradients(parameters: Mapping[str, Any], effective: Collection[str], material: str) -> None:
    """Check that parameters that require grad have an effect on a material.

    Raises:
        ValueError: for a parameter of laws that is not among those with an effect, and requires grad.
    """
    for name in OF_LAWS:
        if name not in effective and requires_grad(parameters.get(name)):
            hint = " while hardening is 0" if name == "xi" else ""
            raise ValueError(f"{name} must not require grad: it has no effect on {material}{hint}")
