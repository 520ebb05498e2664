"""Dialects of PhysGaussian's simulator: units, keys, materials and defaults of the projects that derive from it."""

from __future__ import annotations

import dataclasses
import logging
import math
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

from ..keys import check_keys

log = logging.getLogger(__name__)

BASE_KEYS = (
    *("E", "nu", "density", "yield_stress", "xi", "friction_angle", "plastic_viscosity", "softening"),
    *("rpic_damping", "grid_v_damping_scale", "material", "grid_lim", "n_grid", "hardening", "g"),
    "additional_material_params",
)
"""Keys of `set_parameters_dict` in PhysGaussian."""
WITHOUT_EFFECT = ("pic_damping", "opacity_threshold", "downsample_scale")
"""Keys that `decode_param_json` of the projects stores among the parameters, and their simulators do not read."""
BASE_MATERIALS = {name: name for name in ("jelly", "metal", "sand", "foam", "snow", "plasticine")}
STRESSES = ("E", "yield_stress", "plastic_viscosity", "softening")
"""Parameters in units of stress."""
CODES = {"jelly": 0, "metal": 1, "sand": 2, "foam": 3, "snow": 4, "plasticine": 5}
"""Numbers of the materials in `mpm_model.material`."""
SCALED = {"E": 1e7}
FLOW = {"E": 1e7, "yield_stress": 1e5, "plastic_viscosity": 1e4}
FLOW_MATERIALS = {
    **{"jelly": "jelly", "elastic": "jelly", "metal": "hardening metal", "sand": "sand of an angle", "foam": "foam"},
    **{"plasticine": "softening metal", "newtonian": "newtonian", "non_newtonian": "foam"},
}
FLOW_CODES = {
    **{"jelly": 0, "elastic": 0, "metal": 1, "sand": 2, "foam": 3, "plasticine": 4, "newtonian": 5},
    "non_newtonian": 6,
}


@dataclasses.dataclass(frozen=True)
class Dialect:
    """A project that derives from PhysGaussian's simulator.

    Attributes:
        name: value of `dialect=`.
        project: name of the project.
        units: SI value of 1 of a parameter, where it is not 1.
        keys: keys of `set_parameters_dict` in addition to those of PhysGaussian.
        box_keys: optional keys of a box of additional_material_params.
        without_effect: keys without effect.
        materials: kind of `materials.law_of` for each material.
        codes: numbers of the materials in `mpm_model.material`.
        defaults: parameters without a value, where they differ from PhysGaussian's.
        clipped: distance in cells that positions keep from the faces of the domain after each step; None for any.
        layers: number of layers of a sequential release; None for the given number.
        configuration: keys of configurations by which a dialect is recognised.
        stress_form: form of the forces, see `Step`.
        stress_factor: factor of the stress in the forces.
    """

    name: str
    project: str
    units: Mapping[str, float] = dataclasses.field(default_factory=dict)
    keys: tuple[str, ...] = ()
    box_keys: tuple[str, ...] = ()
    without_effect: tuple[str, ...] = ()
    materials: Mapping[str, str] = dataclasses.field(default_factory=lambda: BASE_MATERIALS)
    codes: Mapping[str, int] = dataclasses.field(default_factory=lambda: CODES)
    defaults: Mapping[str, float] = dataclasses.field(default_factory=dict)
    clipped: float | None = None
    layers: int | None = 50
    configuration: tuple[str, ...] = ()
    stress_form: str = "gradient"
    stress_factor: float = 1.0

    @property
    def known(self) -> tuple[str, ...]:
        """All keys of `set_parameters_dict`."""
        return (*BASE_KEYS, *self.keys, *self.without_effect, *WITHOUT_EFFECT)

    def si(self, name: str, value: Any) -> Any:
        """A parameter of the dialect in SI units."""
        unit = self.units.get(name, 1.0)
        return value if unit == 1 else unit * value

    def effective(self, name: str, value: Any) -> Any:
        """A parameter in SI units with which the law has the stress of the forces."""
        si = self.si(name, value)
        return self.stress_factor * si if self.stress_factor != 1 and name in STRESSES else si

    def sentence(self) -> str:
        """Description of the units."""
        symbols = {"E": "Pa", "yield_stress": "Pa", "plastic_viscosity": "Pa s", "mu": "Pa", "bulk": "Pa"}
        units = [f"{name} in {unit:.0e} {symbols[name]}".replace("e+0", "e") for name, unit in self.units.items()]
        return f"parameters are those of {self.project}" + (f": {', '.join(units)}" if units else ", in SI units")


_ALL = [
    Dialect("physgaussian", "PhysGaussian"),
    Dialect("dreamphysics", "DreamPhysics", SCALED),
    Dialect("physics3d", "Physics3D", SCALED, ("mu_N", "lam_N", "viscosity"),
            materials={**BASE_MATERIALS, "jelly": "viscous jelly"}),
    Dialect("physflow", "PhysFlow", FLOW, without_effect=("mu_N", "lam_N", "viscosity"), materials=FLOW_MATERIALS,
            codes=FLOW_CODES, layers=None, configuration=("opt_frame_dt",)),
    Dialect("motionphysics", "MotionPhysics", {**FLOW, "mu": 1e7, "bulk": 1e5}, ("mu", "bulk"),
            without_effect=("viscosity",),
            materials={**FLOW_MATERIALS, "newtonian": "newtonian of mu and bulk", "fluid": "fluid of bulk"},
            codes={**FLOW_CODES, "fluid": 7}, clipped=2.0, layers=None,
            configuration=("substep_perframe", "total_time")),
    Dialect("neoworld", "NeoWorld"),
    Dialect("pixie", "PIXIE", keys=("bulk_modulus", "spawn_offset"), box_keys=("material",),
            materials={"jelly": "jelly", "elastic": "jelly", "metal": "metal", "sand": "sand", "foam": "foam",
                       "visplas": "foam", "plasticine": "plasticine", "snow": "plasticine", "fluid": "fluid",
                       "stationary": "stationary", "rigid": "stationary"},
            codes={**CODES, "elastic": 0, "visplas": 3, "fluid": 4, "snow": 5, "stationary": 6, "rigid": 6},
            configuration=("fix_ground", "spawn_offset")),
    Dialect("gaussianfluent", "GaussianFluent", keys=("alpha_0", "beta", "flip_pic_ratio"),
            materials={**BASE_MATERIALS, "watermelon": "watermelon"}, codes={**CODES, "watermelon": 7},
            defaults={"friction_angle": 45.0, "alpha_0": -0.04}),
    Dialect("zeshunzong", "warp-mpm", keys=("bulk_modulus",), materials={**BASE_MATERIALS, "fluid": "fluid"},
            codes={**CODES, "fluid": 6}),
    Dialect("kywind", "kywind's warp-mpm", keys=("dx",), without_effect=("rpic_damping",), stress_form="mls",
            stress_factor=0.75),
    Dialect("warp_mpm", "PhysDreamer", materials={**BASE_MATERIALS, "neo-hookean": "neo-hookean"},
            codes={**CODES, "neo-hookean": 6}, clipped=2.0),
]  # fmt: skip
DIALECTS = {dialect.name: dialect for dialect in _ALL}
PHYSGAUSSIAN = DIALECTS["physgaussian"]
_REPORTED: set[str] = set()


def dialect_of(name: str) -> Dialect:
    """Dialect of a name.

    Raises:
        ValueError: for an unknown name.
    """
    if not isinstance(name, str) or name not in DIALECTS:
        raise ValueError(f"dialect must be one of {sorted(DIALECTS)}, got {name!r}")
    return DIALECTS[name]


def report(dialect: Dialect, recognised: Iterable[str] = ()) -> None:
    """Report the units of a dialect once: as a warning where it was recognised by keys, in the log otherwise."""
    found = sorted(recognised)
    if dialect.name in _REPORTED and not found:
        return
    _REPORTED.add(dialect.name)
    if found:
        warnings.warn(
            f"{dialect.sentence()} (recognised by {', '.join(found)}; dialect={dialect.name!r} says so)", stacklevel=4
        )
    elif dialect is not PHYSGAUSSIAN:
        log.warning("%s", dialect.sentence())


def recognised(
    keys: Iterable[str], material: Any = None, configuration: Iterable[str] = (), boxes: Iterable[str] = ()
) -> Dialect | None:
    """Dialect with all given keys, where those of PhysGaussian do not suffice; None without a sign of a dialect.

    Args:
        keys: keys of `set_parameters_dict`.
        material: its material.
        configuration: keys of a configuration.
        boxes: keys of boxes of additional_material_params.

    Raises:
        ValueError: for keys of several dialects with different units or laws, or of none that has all of them.
    """
    foreign = {key for key in keys if key not in PHYSGAUSSIAN.known}
    signs = foreign & {key for dialect in _ALL for key in dialect.known}
    named = isinstance(material, str) and material not in PHYSGAUSSIAN.materials
    of_file = {key for key in configuration if any(key in dialect.configuration for dialect in _ALL)}
    of_box = {key for key in boxes if any(key in dialect.box_keys for dialect in _ALL)}
    if not (signs or named or of_file or of_box):
        return None
    fitting = [
        dialect
        for dialect in _ALL
        if signs <= set(dialect.known)
        and (not isinstance(material, str) or material in dialect.materials)
        and of_file <= set(dialect.configuration)
        and of_box <= set(dialect.box_keys)
    ]
    if not fitting:
        return None
    kinds = {(*sorted(d.units.items()), d.materials.get(str(material)), d.clipped) for d in fitting}
    if len(kinds) > 1:
        what = ", ".join(sorted(signs | of_file)) or f"material {material!r}"
        names = ", ".join(f"{d.project} (dialect={d.name!r})" for d in fitting)
        raise ValueError(f"dialect must be given: {what} may be that of {names}, which have different units or laws")
    return fitting[0]


def check_parameter_keys(dialect: Dialect, given: Iterable[str], what: str = "set_parameters_dict") -> None:
    """Check that a dialect has all keys.

    Raises:
        ValueError: for another key, with the projects that have it, or with the nearest known key.
    """
    known = dialect.known
    others = {
        key: f"{' and '.join(d.project for d in _ALL if key in d.known)} has it: pass dialect="
        f"{[d.name for d in _ALL if key in d.known]}, whose units may differ"
        for key in {key for d in _ALL for key in d.known} - set(known)
    }
    check_keys(what, given, known, others)


def code_of(dialect: Dialect, material: str) -> int:
    """Number of a material."""
    return dialect.codes[material]


def material_of(dialect: Dialect, code: int) -> str:
    """Material of a number.

    Raises:
        ValueError: for an unknown number.
    """
    for name, number in dialect.codes.items():
        if number == code:
            return name
    raise ValueError(f"material must be one of {sorted(set(dialect.codes.values()))}, got {code}")


def warn_of_soft_solid(dialect: Dialect, name: str, value: Any) -> None:
    """Warn of a Young's modulus of a dialect in Pa that is softer than any solid."""
    if name == "E" and dialect is PHYSGAUSSIAN and isinstance(value, float) and 0 < value < 50 and math.isfinite(value):
        warnings.warn(
            f"E = {value:g} Pa is softer than any solid: DreamPhysics, Physics3D, PhysFlow and MotionPhysics give E in "
            "1e7 Pa, with dialect= of one of these names",
            stacklevel=5,
        )
