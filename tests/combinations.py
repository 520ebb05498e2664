"""Random simulations: a law with options, a transfer, walls, obstacles, heat and a batch, all drawn from one seed."""

import dataclasses
import random
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue import laws as catalogue

DX = 0.125
DT = 2e-3
"""[s]; a tenth of the limit of the stiffest law at rest."""
F64 = torch.float64

SAND_ENERGIES = ("unilateral", "full", "hencky", "mixed")


def _sand(r: random.Random) -> dict[str, Any]:
    energy = r.choice(SAND_ENERGIES)
    hardening = r.random() < 0.3
    return {
        "friction_angle": None if hardening else r.uniform(0.3, 0.9),
        "energy": energy,
        "apex": r.choice(("zero", "keep")) if energy == "unilateral" else "zero",
        "flow": r.choice(("radial", "exact")),
        "cohesion": r.choice((None, r.uniform(0.0, 0.05))),
        "volume_correction": r.random() < 0.5,
        "hardening": (0.61, 0.16, 0.2, 0.17) if hardening else None,
    }


LAWS = catalogue.LAWS | catalogue.named("water")
OPTIONS: dict[str, Callable[..., dict[str, Any]]] = {
    "water": lambda r: {"gamma": r.choice((1.0, 7.0))},
    "fluid": lambda r: {"viscosity": r.uniform(0.1, 10.0)},
    "von_mises": lambda r: {"hardening": r.choice((0.0, 2e3))},
    "sand": _sand,
    "mixture": _sand,
    "custom": lambda r: {"stiffness": 3e4},
    "custom_principal": lambda r: {"stiffness": 3e4},
}
"""Draws of arguments of laws; the others are those of the catalogue."""
PLASTIC = ("von_mises", "herschel_bulkley", "sand", "mixture")
WITH_ENERGY = (*PLASTIC, "neo_hookean", "fluid", "water", "fixed_corotated", "hencky")
"""Laws whose free energy is `energy_density`: hardening of snow and clay changes their moduli or stores more."""


@dataclasses.dataclass(frozen=True)
class Combination:
    """Draw of one seed; `text` reproduces a failure."""

    seed: int
    law: str
    dim: int
    kernel: str
    transfer: str
    flip: float
    stress_form: str
    walls: str | None
    obstacle: str | None
    gravity: bool
    heat: str | None
    contrast: float
    scenes: int
    checkpoint: int | None

    @property
    def text(self) -> str:
        return ", ".join(f"{k}={v}" for k, v in dataclasses.asdict(self).items())

    @property
    def isolated(self) -> bool:
        """Whether nothing outside acts on the particles."""
        return self.walls is None and self.obstacle is None and not self.gravity


def draw(seed: int) -> Combination:
    """The laws in turn, everything else at random."""
    r = random.Random(seed)
    names = list(LAWS)
    law = names[seed % len(names)]
    transfer = r.choice(("apic", "apic", "pic", "flip"))
    heat = r.choice((None, "hybrid", "hybrid", "apic", "flip", "pic"))
    if law == "melting" and heat is None:
        heat = "hybrid"
    return Combination(
        seed=seed,
        law=law,
        dim=r.choice((2, 3)),
        kernel=r.choice(("quadratic", "cubic")),
        transfer=transfer,
        flip=r.choice((0.0, 0.0, 0.9)) if transfer != "flip" else 0.0,
        stress_form=r.choice(("mls", "gradient")),
        walls=r.choice((None, None, "slip", "sticky", "separate", "mirror")),
        obstacle=r.choice((None, None, "plane", "sphere", "box", "sdf")),
        gravity=r.random() < 0.5,
        heat=heat,
        contrast=10.0 ** r.choice((0, 1, 2, 4)),
        scenes=r.choice((1, 1, 3)),
        checkpoint=r.choice((None, 1, 2)),
    )


@dataclasses.dataclass
class Case:
    """A combination made: `swap` exchanges the first two axes of everything."""

    step: mpm.Step
    state: mpm.State


def make(c: Combination, device: str = "cpu", swap: bool = False, scene: int | None = None) -> Case:
    """The step and its first state in float64.

    Args:
        c: what to make.
        device: where.
        swap: exchange the first two axes of all vectors and tensors, of the obstacles and of gravity.
        scene: this scene of the batch alone.
    """
    r = random.Random(c.seed + 1000)
    axes = [1, 0, 2][: c.dim] if swap else list(range(c.dim))
    options = OPTIONS[c.law](r) if c.law in OPTIONS else {}
    if c.law == "active":
        options["direction"] = [(0.6, 0.8, 0.0)[axis] for axis in axes]
    law = LAWS[c.law](strength=0.03, **options)
    state = _state(c)
    parameters = {name: value.to(device) for name, value in _per_particle(c, len(state)).items()}
    if scene is not None:
        assert state.scene is not None
        rows = (state.scene == scene).nonzero()[:, 0]
        state = state.select(rows).replace(scene=None)
        parameters = {name: value[rows.to(device)] for name, value in parameters.items()}
    state = _permuted(state, axes).to(device)
    grid = mpm.Grid(DX, (0.0,) * c.dim, (1.5,) * c.dim, scenes=1 if scene is not None else c.scenes, kernel=c.kernel)
    heat = None
    if c.heat is not None:
        melting: dict[str, Any] = {"melting_point": 0.3, "latent_heat": 40.0} if c.law == "melting" else {}
        heat = mpm.Heat(
            grid, transfer=c.heat, plastic_heating=0.5, tolerance=1e-13, **parameters, **melting
        )  # fmt: skip
    gravity = [(-3.0, -9.0, 2.0)[axis] for axis in axes] if c.gravity else None
    step = mpm.Step(
        grid, law, gravity=gravity, walls=c.walls, boundaries=_obstacles(c, axes), transfer=c.transfer, flip=c.flip,
        stress_form=c.stress_form, heat=heat,
    )  # fmt: skip
    return Case(step, step.prepare(state))


def _state(c: Combination) -> mpm.State:
    """Particles in a ball at random, strained, torn and compressed, with velocities."""
    g = torch.Generator().manual_seed(c.seed)
    sizes = [20 + 4 * b for b in range(c.scenes)]
    P, D = sum(sizes), c.dim

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=g, dtype=F64) - 1

    F = torch.eye(D, dtype=F64) * (1 + 0.04 * uniform(P, 1, 1)) + 0.04 * uniform(P, D, D)
    volume = (DX / 2) ** D * (1 + 0.2 * uniform(P))
    scene = torch.repeat_interleave(torch.arange(c.scenes), torch.tensor(sizes)).int()
    material = torch.arange(P, dtype=torch.int32) % 3 if c.law == "mixture" else None
    extra = {"activation": 1e3 * uniform(P)} if c.law == "active" else {}
    temperature = uniform(P) if c.heat is not None or c.law == "expansion" else None
    return mpm.State(
        x=0.75 + 0.2 * uniform(P, D), v=0.5 * uniform(P, D), mass=1000.0 * volume * (1 + 0.2 * uniform(P)),
        volume=volume, C=uniform(P, D, D) if c.transfer == "apic" else None, F=F, J=torch.linalg.det(F),
        scene=None if c.scenes == 1 else scene, material=material, temperature=temperature, extra=extra,
    )  # fmt: skip


def _per_particle(c: Combination, P: int) -> dict[str, Tensor]:
    """Conductivity and specific heat that jump from particle to particle."""
    g = torch.Generator().manual_seed(c.seed + 1)
    pick = torch.rand(2, P, generator=g) < 0.5
    conductivity = torch.where(pick[0], 1.0, c.contrast).to(F64) * 1e3
    return {"conductivity": conductivity, "specific_heat": torch.where(pick[1], 1.0, 3.0).to(F64) * 10}


def _permuted(state: mpm.State, axes: list[int]) -> mpm.State:
    changes = {"x": state.x[:, axes], "v": state.v[:, axes]}
    for name in ("C", "F"):
        value = getattr(state, name)
        if value is not None:
            changes[name] = value[:, axes][:, :, axes]
    return state.replace(**changes)


def _obstacles(c: Combination, axes: list[int]) -> list[Any]:
    def vector(*values: float) -> list[float]:
        return [values[axis] for axis in axes]

    where, velocity = vector(0.7, 0.6, 0.75), vector(0.3, 0.1, -0.2)
    if c.obstacle == "plane":
        return [mpm.Plane(where, normal=vector(0.6, 0.8, 0.0), kind="separate", friction=0.3)]
    if c.obstacle == "sphere":
        return [mpm.Sphere(where, radius=0.15, kind="slip", velocity=velocity)]
    if c.obstacle == "box":
        return [mpm.Box(where, size=vector(0.2, 0.3, 0.25), kind="sticky", velocity=velocity)]
    if c.obstacle == "sdf":
        radii = torch.tensor(vector(0.2, 0.15, 0.25), dtype=F64)

        def distance(body: Tensor) -> Tensor:
            return ((body / radii.to(body)).square().sum(1) + 1e-3).sqrt() - 1

        return [mpm.SDF(distance, position=where, kind="separate", friction=0.2)]
    return []
