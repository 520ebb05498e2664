"""The keys of a scene file. The docstring under each key is its description in messages and in the JSON schema."""

from __future__ import annotations

import functools
import inspect
import itertools
import math
import operator
import re
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

from .. import laws
from ..geometry import shapes
from ..geometry.shapes import SceneWords, Shape
from ..ops.registry import LAWS, Quantity

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]
Spin = float | Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]
Contact = Literal["slip", "sticky", "separate"]
Wall = Literal["slip", "sticky", "separate", "mirror", "open"]


class Model(BaseModel):
    """Unknown keys are errors; numbers are finite."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


# ---- the domain


class Grid(Model):
    """The domain and its lattice."""

    lower: Vector
    """lower corner of the domain [m]; 2 or 3 numbers, which decide the dimension of the scene"""
    upper: Vector
    """upper corner of the domain [m]"""
    dx: Positive
    """distance between grid nodes [m]"""
    kernel: Literal["quadratic", "cubic"] = "quadratic"
    """B-spline of the transfers between particles and nodes"""
    walls: Wall | list[Wall | tuple[Wall, Wall]] | None = "slip"
    """kind of the walls: one for all faces, or a list with one kind or pair (lower, upper) per axis; a mirror is a
    frictionless wall of second order, and needs a domain of a whole or half-integer number of cells"""
    friction: NotNegative = 0.0
    """Coulomb friction coefficient of the walls"""
    deterministic: bool = False
    """bit-identical results from run to run on a GPU too, which takes longer; on a CPU they always are"""


# ---- materials


class Curve(Model):
    """A quantity that depends on temperature: piecewise linear, constant beyond the ends."""

    temperature: list[float]
    """increasing temperatures [K]"""
    value: list[Positive]
    """values there"""

    @model_validator(mode="after")
    def _increasing(self) -> Curve:
        if len(self.temperature) != len(self.value) or len(self.value) < 2:
            raise ValueError("takes as many values as temperatures, at least two")
        if any(b <= a for a, b in itertools.pairwise(self.temperature)):
            raise ValueError(f"takes increasing temperatures, got {self.temperature}")
        return self


class Thermal(Model):
    """Thermal properties of a material, in a scene with a [heat] table."""

    conductivity: NotNegative | Curve | None = None
    """heat conductivity [W/(m K)]"""
    specific_heat: Positive | Curve | None = None
    """heat capacity per mass [J/(kg K)]"""
    expansion: float | None = None
    """coefficient of linear thermal expansion about the reference temperature [1/K]"""
    melting_point: float | None = None
    """melting temperature [K]"""
    latent_heat: Positive | None = None
    """heat of melting [J/kg]"""


class Liquid(Model):
    """Molten material: a fluid whose pressure depends on its volume."""

    bulk_modulus: Positive
    """bulk modulus [Pa]"""
    gamma: Positive = 7.0
    """exponent of the equation of state"""
    viscosity: NotNegative | Curve = 0.0
    """dynamic viscosity [Pa s]"""


class NeoHookean(Thermal):
    """Elastic solid."""

    law: Literal["neo_hookean"] = "neo_hookean"
    """name of the law"""
    density: Positive = 1000.0
    """density at rest [kg/m^3]"""
    E: Positive | Curve
    """Young's modulus [Pa]"""
    nu: Annotated[float, Field(gt=-1, lt=0.5)] = 0.3
    """Poisson's ratio, between -1 and 0.5"""
    liquid: Liquid | None = None
    """fluid above the melting point"""


class WeaklyCompressible(Thermal):
    """Fluid whose pressure depends on its volume."""

    law: Literal["weakly_compressible"] = "weakly_compressible"
    """name of the law"""
    density: Positive = 1000.0
    """density at rest [kg/m^3]"""
    bulk_modulus: Positive
    """bulk modulus [Pa]; density * (10 * largest expected speed)^2 keeps density changes near 1%"""
    gamma: Positive = 7.0
    """exponent of the equation of state; 7 for water"""
    viscosity: NotNegative | Curve = 0.0
    """dynamic viscosity [Pa s]"""


class QuarticSand(Thermal):
    """Dry sand: Drucker-Prager plasticity."""

    law: Literal["quartic_sand"] = "quartic_sand"
    """name of the law"""
    density: Positive = 1600.0
    """density at rest, with the air between the grains [kg/m^3]"""
    E: Positive | None = None
    """Young's modulus [Pa], with nu; quartic energies are as stiff at a strain of 0.4 and far softer below it"""
    nu: Annotated[float, Field(gt=-1, lt=0.5)] | None = None
    """Poisson's ratio, between -1 and 0.5; 0.3 if only E is given"""
    mu: Positive | None = None
    """shear modulus [Pa], with lam, instead of E and nu"""
    lam: float | None = None
    """first Lame parameter [Pa]"""
    friction_angle: Annotated[float, Field(ge=0, lt=90)] = 30.0
    """friction angle [degrees]"""
    energy: Literal["unilateral", "full", "hencky", "mixed"] = "unilateral"
    """elastic energy; unilateral: quartic without tension, hencky: quadratic"""
    apex: Literal["zero", "keep"] = "zero"
    """strain of separated sand: zero, or, with the unilateral energy, that of the expansion (keep)"""
    smallest_strain: NotNegative = 0.05
    """minimum strain for which the time step is chosen; ideally the compression of the deepest sand"""
    flow: Literal["radial", "exact"] = "radial"
    """plastic flow; exact: along the deviator of the stress, with more friction in plane strain"""
    cohesion: NotNegative = 0.0
    """logarithmic strain at which the sand tears; 0 for dry sand"""
    volume_correction: bool = False
    """separated sand has no stress until it has regained its volume"""
    hardening: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    """h0, h1, h2, h3 of the friction angle h0 + (h1 q - h3) exp(-h2 q) after plastic flow q, instead of friction_angle;
    h0, h1 and h3 in degrees, for example [35, 9, 0.2, 10]"""

    @model_validator(mode="after")
    def _moduli(self) -> QuarticSand:
        if self.E is not None and self.nu is None:
            self.nu = 0.3
        given = {name for name in ("E", "nu", "mu", "lam") if getattr(self, name) is not None}
        if given not in ({"E", "nu"}, {"mu", "lam"}):
            raise ValueError(f"takes E and nu, or mu and lam, got {', '.join(sorted(given)) or 'none of them'}")
        if self.apex == "keep" and self.energy != "unilateral":
            raise ValueError("apex = 'keep' needs energy = 'unilateral'")
        if self.hardening is not None:
            # Not by model_fields_set: an entry of a batch has all fields of the file.
            if self.friction_angle != type(self).model_fields["friction_angle"].default:
                raise ValueError("takes friction_angle or hardening, got both")
            h0, h1, h2, h3 = self.hardening
            if not (0 <= h3 <= h0 < 90 and h1 >= 0 and h2 >= 0):
                raise ValueError(f"hardening needs 0 <= h3 <= h0 < 90, h1 >= 0 and h2 >= 0, got {self.hardening}")
        return self


class Solid(Thermal):
    """Common keys of the laws in principal strains."""

    law: str
    """name of the law"""
    density: Positive = 1000.0
    """density at rest [kg/m^3]"""
    E: Positive | Curve
    """Young's modulus [Pa]"""
    nu: Annotated[float, Field(gt=-1, lt=0.5)] = 0.3
    """Poisson's ratio, between -1 and 0.5"""


def _range(quantity: Quantity) -> Any:
    """The type of a number in the range of a parameter."""
    ends: dict[str, Any] = {
        "ge" if quantity.with_low else "gt": quantity.low,
        "le" if quantity.with_high else "lt": quantity.high,
    }
    return Annotated[float, Field(**{key: end for key, end in ends.items() if math.isfinite(end)})]


def _descriptions(law: type) -> dict[str, str]:
    """Descriptions of the arguments in the docstring of a law."""
    text = inspect.getdoc(law) or ""
    _, _, arguments = text.partition("Args:\n")
    found = re.findall(r"^    (\w+): (.*(?:\n        .*)*)", arguments.partition("\n\n")[0], re.MULTILINE)
    return {name: " ".join(description.split()) for name, description in found}


def _described(name: str, base: type[Model], summary: str, **fields: Any) -> Any:
    """Model of fields with descriptions. pydantic would search the sources for docstrings for 40 ms, and find none."""
    without_search = {"use_attribute_docstrings": False}
    return create_model(name, __base__=base, __doc__=summary, __cls_kwargs__=without_search, **fields)


def _solid(law: type[laws.SolidLaw]) -> type[Solid]:
    """The table of a material with a compiled law, from its constructor and the ranges of its parameters."""
    descriptions = _descriptions(law)
    fields: dict[str, Any] = {}
    for name, default in law.scene_defaults.items():
        field = Solid.model_fields[name]
        fields[name] = (field.rebuild_annotation(), Field(default, description=field.description))
    for name, argument in inspect.signature(law).parameters.items():
        if argument.kind is not argument.KEYWORD_ONLY:
            continue  # the elastic moduli, which all solids have
        kind = _range(LAWS[law.name].parameter(name))
        given = {} if argument.default is argument.empty else {"default": argument.default}
        fields[name] = (kind, Field(**given, description=descriptions[name]))
    summary = (inspect.getdoc(law) or "").partition("\n")[0]
    name_of_law: Any = (Literal[law.name], Field(law.name, description="name of the law"))
    return _described(law.__name__, Solid, summary, law=name_of_law, **fields)


SOLIDS = tuple(
    _solid(law)
    for law in vars(laws).values()
    if isinstance(law, type)
    and issubclass(law, laws.SolidLaw)
    and law not in (laws.SolidLaw, laws.NeoHookean, laws.QuarticSand)
)
"""Tables of the solids without a separate model here; they include every new class in torch_mpm.laws."""

Material: Any = Annotated[
    functools.reduce(operator.or_, SOLIDS, NeoHookean | WeaklyCompressible | QuarticSand),
    Field(discriminator="law"),
]


# ---- bodies


class Seeding(Model):
    """How a region is filled with particles of one material."""

    material: str
    """name of a material of this scene"""
    per_cell: Positive = 8.0
    """mean number of particles per grid cell"""
    temperature: float | None = None
    """initial temperature [K]; by default the reference of [heat]"""


class Body(Seeding):
    """A body that exists from the start."""

    name: str = ""
    """name in messages"""
    velocity: Vector | None = None
    """initial velocity [m/s]"""
    spin: Spin | None = None
    """initial angular velocity about the centre of mass [rad/s]: a number in 2-D, a vector in 3-D"""
    seeding: Literal["lattice", "jittered", "poisson"] = "lattice"
    """regular lattice, the same with each particle moved at random within its cell, or Poisson-disk sample"""
    particles: Annotated[int, Field(ge=1)] | None = None
    """exact number of particles, instead of per_cell"""


class BoxBody(Body):
    """Axis-aligned box; a rectangle in 2-D."""

    shape: Literal["box"] = "box"
    """kind of shape"""
    lower: Vector
    """lower corner [m]"""
    upper: Vector
    """upper corner [m]"""


class SphereBody(Body):
    """Ball; a disc in 2-D."""

    shape: Literal["sphere"] = "sphere"
    """kind of shape"""
    center: Vector
    """centre [m]"""
    radius: Positive
    """radius [m]"""


class CylinderBody(Body):
    """Cylinder with flat ends (3-D)."""

    shape: Literal["cylinder"] = "cylinder"
    """kind of shape"""
    a: Vector
    """centre of one end [m]"""
    b: Vector
    """centre of the other end [m]"""
    radius: Positive
    """radius [m]"""


class CapsuleBody(Body):
    """All points near a segment."""

    shape: Literal["capsule"] = "capsule"
    """kind of shape"""
    a: Vector
    """one end of the segment [m]"""
    b: Vector
    """other end of the segment [m]"""
    radius: Positive
    """distance from the segment [m]"""


class MeshBody(Body):
    """Interior of a closed triangle mesh (3-D)."""

    shape: Literal["mesh"] = "mesh"
    """kind of shape"""
    file: str
    """mesh file that trimesh reads (.obj, .ply, .stl, ...), relative to the scene file"""
    scale: Positive = 1.0
    """factor on the coordinates of the file"""
    offset: Vector = (0.0, 0.0, 0.0)
    """shift after scaling [m]"""


class PointsBody(Body):
    """Points from a file."""

    shape: Literal["points"] = "points"
    """kind of shape"""
    file: str
    """.npy, .npz (x, volume), .csv, .tsv, .txt (x, y, z, volume) or .ply file, relative to the scene file"""
    volume: Positive | None = None
    """total volume [m^3], needed if the file has no volumes"""


class SplatsBody(Body):
    """Object of 3-D Gaussian splats (3-D): a particle for each Gaussian, and others that fill its inside."""

    shape: Literal["splats"] = "splats"
    """kind of shape"""
    file: str
    """.ply file of Gaussian splats, relative to the scene file"""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = "+y"
    """axis of the file that points up: against gravity, or +y without gravity"""
    extent: Positive | None = None
    """longest edge of the box around the object [m]; by default as in the file"""
    center: Vector | None = None
    """middle of this box [m]; by default as in the file"""
    fill: bool = True
    """fill the inside with per_cell particles per grid cell that carry no Gaussian; false for thin shells"""
    min_opacity: Annotated[float, Field(ge=0, le=1)] = 0.02
    """opacity below which Gaussians are left out"""


FileBody = MeshBody | PointsBody | SplatsBody
"""Bodies from a file."""

AnyBody = Annotated[BoxBody | SphereBody | CylinderBody | CapsuleBody | FileBody, Field(discriminator="shape")]


class Emitter(Seeding):
    """A round nozzle (a slit in 2-D) that emits particles along its velocity."""

    name: str = ""
    """name in messages"""
    center: Vector
    """centre of the nozzle [m]"""
    radius: Positive
    """radius of the nozzle (half width of the slit) [m]"""
    velocity: Vector
    """velocity of the flow [m/s], normal to the nozzle"""
    rate: Positive | None = None
    """volume flow rate [m^3/s], at most area times speed, which is the default"""
    start: NotNegative = 0.0
    """time at which it starts to emit [s]"""
    end: Positive | None = None
    """time at which it stops [s]; by default the end of the run"""


# ---- obstacles


class Obstacle(Model):
    """A rigid body that particles cannot enter."""

    name: str = ""
    """name in messages"""
    contact: Contact = "separate"
    """motion of particles at the surface: stick to it (sticky), slide along it (slip), slide and leave it (separate)"""
    friction: NotNegative = 0.0
    """Coulomb friction coefficient"""
    velocity: Vector | None = None
    """constant velocity [m/s]"""
    spin: Spin | None = None
    """constant angular velocity about its centre [rad/s]: a number in 2-D, a vector in 3-D"""
    rotation: Spin | None = None
    """orientation at the start [rad]: an angle in 2-D, a rotation vector in 3-D"""
    start: NotNegative = 0.0
    """time at which it appears and starts to move [s]"""
    end: Positive | None = None
    """time at which it disappears [s]"""
    temperature: float | None = None
    """temperature that it imposes on material in contact [K]; insulating by default"""
    held: Literal["nodes", "surface"] = "nodes"
    """location of its temperature: at the nodes inside, or on its surface, which is more accurate"""
    opacity: Annotated[float, Field(gt=0, le=1)] = 1.0
    """opacity in pictures; 1 is opaque"""


KEY_TYPES: dict[str, Any] = {
    "point": Vector,
    "vector": Vector,
    "length": Positive,
    "outline": Annotated[list[tuple[NotNegative, float]], Field(min_length=3)],
}
"""Types of the kinds of keys of shapes."""


def _obstacle(shape: type[Shape], words: SceneWords) -> type[Obstacle]:
    """The table of an obstacle, from the words of its shape."""
    fields: dict[str, Any] = {"shape": (Literal[shape.name], Field(shape.name, description="kind of shape"))}
    for name, key in words.keys.items():
        kind = KEY_TYPES[key.kind]
        given: dict[str, Any] = {"default": None} if key.optional else {}
        fields[name] = (kind | None if key.optional else kind, Field(**given, description=key.description))
    return _described(f"{shape.name.capitalize()}Obstacle", Obstacle, words.summary, **fields)


OBSTACLE_SHAPES = {shape.name: shape for shape in shapes.SHAPES if shape.words is not None}
"""Shapes of obstacles by their names; they include every new class in torch_mpm.shapes with words."""

OBSTACLE_WORDS = {name: shape.words for name, shape in OBSTACLE_SHAPES.items() if shape.words is not None}
_KEYS = [item for words in OBSTACLE_WORDS.values() for item in words.keys.items()]
POINT_KEYS = tuple(dict.fromkeys(name for name, key in _KEYS if key.kind == "point"))
"""Keys of shapes of obstacles with coordinates [m]."""
VECTOR_KEYS = tuple(dict.fromkeys(name for name, key in _KEYS if key.kind in ("point", "vector")))
"""Keys of shapes of obstacles with a number per axis."""

AnyObstacle: Any = Annotated[
    functools.reduce(operator.or_, [_obstacle(OBSTACLE_SHAPES[name], words) for name, words in OBSTACLE_WORDS.items()]),
    Field(discriminator="shape"),
]


# ---- heat


class Exchange(Model):
    """Exchange of heat with the surroundings at the free surface of the bodies."""

    coefficient: NotNegative = 0.0
    """coefficient of convection [W/(m^2 K)]"""
    emissivity: Annotated[float, Field(ge=0, le=1)] = 0.0
    """emissivity, for radiation"""
    ambient: float
    """temperature of the surroundings [K]"""


class Face(Model):
    """Heat through a flat face along the axes."""

    lower: Vector
    """lower corner [m]"""
    upper: Vector
    """upper corner [m], equal to the lower one along one axis"""
    flux: float
    """heat flux into the body [W/m^2]"""


class Heat(Model):
    """Conduction of heat; every material then needs conductivity and specific_heat."""

    reference: float = 0.0
    """temperatures are stored relative to this one [K], best in the middle of their range; no thermal strain there"""
    transfer: Literal["hybrid", "apic", "flip", "pic"] = "hybrid"
    """how temperature is transferred between particles and grid"""
    method: Literal["cg", "chebyshev", "multigrid"] = "cg"
    """solver of the implicit step; multigrid for diffusion numbers kappa dt/(rho C dx^2) from about 1000"""
    plastic_heating: Annotated[float, Field(ge=0, le=1)] = 0.0
    """share of the plastic work that becomes heat"""
    exchange: list[Exchange] = []
    """exchange with the surroundings"""
    face: list[Face] = []
    """heated or cooled faces"""


# ---- outputs


StoredField = Literal[
    "F", "J", "C", "stress", "cauchy_stress", "kirchhoff_stress", "out_of_plane_stress", "von_mises_stress", "pressure",
    "temperature", "liquid",
]  # fmt: skip


class Output(Model):
    """Stored fields in addition to position and velocity, and other formats."""

    fields: list[StoredField] = []
    """additional fields of the trajectory; stress is another name of cauchy_stress"""
    vtk: bool = False
    """write a VTK file per frame, with the Cauchy stress"""
    ply: bool = False
    """write a PLY point cloud per frame"""


class Ritter(Model):
    """Ritter's solution of a dam break (1892) drawn over a 2-D picture."""

    dam: float
    """x of the dam [m]; the water stood on the lower side"""
    depth: Positive
    """depth of the water before the break [m]"""


class Render(Model):
    """Pictures (PNG) and video (MP4)."""

    color_by: Literal["speed", "stress", "pressure", "material", "temperature", "liquid", "layer"] = "speed"
    """quantity of the colours; stress: the von Mises stress; layer: the height at the start, or for emitted particles
    the time"""
    layers: Annotated[int, Field(ge=1)] = 8
    """number of layers with different colours"""
    range: tuple[float, float] | None = None
    """ends of the colour scale; by default those of the whole run"""
    style: Literal["particles", "surface"] = "particles"
    """shaded particles, or a smooth surface around them (3-D)"""
    surface: bool = False
    """draw fluids and bodies, but not sand, as reconstructed surfaces (3-D), which needs the extra surface; those of
    `torch-mpm surface` with its defaults"""
    resolution: Annotated[tuple[int, int], Field()] = (1280, 720)
    """width and height [pixels]"""
    azimuth: float = 28.0
    """direction of the camera around the vertical [degrees] (3-D)"""
    elevation: float = 18.0
    """height of the camera above the horizon [degrees] (3-D)"""
    view: tuple[Vector, Vector] | None = None
    """corners of the box that the picture shows [m]; by default the domain"""
    exaggeration: Positive = 1.0
    """scale of heights over that of lengths (2-D)"""
    every: Annotated[int, Field(ge=1)] = 1
    """draw every n-th frame"""
    video: bool = True
    """make an MP4 of the pictures"""
    ritter: Ritter | None = None
    """draw Ritter's solution of a dam break"""


# ---- the scene


class Content(Model):
    """Content of a domain: the part of a scene that differs within a batch."""

    gravity: Vector | None = None
    """acceleration of gravity [m/s^2]"""
    material: dict[str, Material] = {}
    """materials by name"""
    body: list[AnyBody] = []
    """bodies"""
    obstacle: list[AnyObstacle] = []
    """obstacles"""
    emitter: list[Emitter] = []
    """emitters"""


class Entry(Content):
    """One scene of a batch. It inherits everything outside its table; its own gravity and materials take precedence."""

    name: str = ""
    """name of the scene"""
    seed: Annotated[int, Field(ge=0)] | None = None
    """seed of its random numbers; by default that of the file"""


class SceneData(Content):
    """A scene file."""

    title: str = ""
    """title of the pictures"""
    origin: Vector | None = None
    """point to which stored positions are relative [m]: for scenes far from zero, such as those in map coordinates.
    Coordinates of this file and of the outputs are unaffected; potential energy is zero at the origin"""
    grid: Grid
    """the domain"""
    duration: Positive
    """simulated time [s]"""
    fps: Positive = 60.0
    """frames per second of simulated time"""
    cfl: Annotated[float, Field(gt=0, le=1)] = 0.5
    """time step as a share of the stability limit"""
    project: bool = False
    """move particles that are seeded inside obstacles to the nearest point of their surface, and report how many"""
    dt: Positive | None = None
    """fixed upper bound of the time step [s], instead of cfl"""
    transfer: Literal["apic", "pic", "flip"] = "apic"
    """how velocity is transferred between particles and grid"""
    flip: Annotated[float, Field(ge=0, le=1)] = 0.0
    """share of FLIP blended into the transfer"""
    precision: Literal["float32", "float64"] = "float32"
    """floating-point type of the simulation"""
    device: Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:[0-9]{1,3})?)$")] = "auto"
    """"cpu", "cuda", "cuda:1", ... or "auto": a GPU if there is one"""
    seed: Annotated[int, Field(ge=0)] = 0
    """seed of all random numbers"""
    heat: Heat | None = None
    """conduction of heat; none without this table"""
    scene: list[Entry] = []
    """scenes of a batch, simulated together"""
    output: Output = Output()
    """further outputs"""
    render: Render | None = None
    """pictures; none without this table"""


def json_schema() -> dict[str, Any]:
    """JSON schema of a scene file, for editors."""
    schema = SceneData.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "torch_mpm scene"}
