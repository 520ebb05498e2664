"""The solver of taichi_elements, on a `Step` of torch_mpm."""

from __future__ import annotations

import math
import numbers
import os
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ...boundaries import Plane, Sphere
from ...errors import check_count, check_number, check_vector, shape_of
from ...grid.grid import Grid
from ...rollouts import rollout
from ...state.state import State, identity_deformation
from ...step.step import Step
from ..gradients import refuse_grad
from ..node_conditions import outer_planes, surface_margin
from ..physgaussian.particles import Anchored
from . import materials, particle_io
from .materials import law_indices, mixture_of, shapeless
from .seeding import in_box, in_ellipsoid, in_mesh, in_polygon

MOST_SUBSTEPS = 10**9
"""Largest number of substeps of a call."""

DENSITY = 1000.0
"""Density of all materials [kg/m³]."""
WHITE = 0xFFFFFF
STORAGE = {
    **{"quant": False, "use_voxelizer": True, "voxelizer_super_sample": 2, "use_bls": True, "use_ggui": False},
    **{"v_clamp_g2p2g": True, "g2p2g_allowed_cfl": 0.9, "use_g2p2g": False, "max_num_particles": 2**30},
}
"""Options of the storage and the kernels, which have no effect."""
UNBOUNDED = 16
"""Size of an unbounded domain in sizes of the bounded one."""


class Number(int):
    """Whole number that is also read as a field of Taichi without axes, by the index None."""

    def __getitem__(self, index: None) -> int:
        if index is not None:
            raise IndexError(f"a field without axes must have the index None, got {index!r}")
        return int(self)


class MPMSolver:
    """Explicit MLS-MPM with APIC on a lattice of `res` cells, of water, elastic bodies, snow and sand.

        solver = MPMSolver(res=(64, 64))
        solver.add_cube((0.4, 0.4), (0.2, 0.2), MPMSolver.material_elastic)
        solver.step(4e-3)

    Each particle has the volume dx^D and the density 1000 kg/m³, for any sample density. Positions are random where
    they are sampled; `torch.manual_seed` repeats them. Steps are computed without gradients.

    Args:
        res: cells along each axis, 2 or 3 numbers.
        size: length of the first axis [m].
        padding: nodes at each face at which nothing moves outwards.
        unbounded: whether the domain is larger than `res`, on both sides.
        dt_scale: multiple of the default time step, 2e-2 dx/size.
        E_scale: multiple of Young's modulus, 1e6 Pa/m times size.
        water_density: mass of water over that of the other materials.
        support_plasticity: whether snow and sand may be added.
        use_emitter_id: whether particles have the id of their emitter.
        device: of the particles.
        storage: options of Taichi's storage and kernels, without effect.

    Raises:
        TypeError, ValueError, NotImplementedError: for a wrong argument, or an adaptive time step.
    """

    material_water, material_elastic, material_snow, material_sand, material_stationary = range(5)
    materials: ClassVar[dict[str, int]] = materials.NAMES
    surface_sticky, surface_slip, surface_separate = range(3)
    surfaces: ClassVar[dict[str, int]] = {"STICKY": 0, "SLIP": 1, "SEPARATE": 2}

    def __init__(
        self,
        res: Sequence[int],
        size: float = 1.0,
        padding: int = 3,
        unbounded: bool = False,
        dt_scale: float = 1.0,
        E_scale: float = 1.0,
        water_density: float = 1.0,
        support_plasticity: bool = True,
        use_adaptive_dt: bool = False,
        use_emitter_id: bool = False,
        device: torch.device | str | None = None,
        **storage: Any,
    ) -> None:
        if len(res) not in (2, 3):
            raise ValueError(f"res must have 2 or 3 numbers, got {list(res)}")
        if use_adaptive_dt:
            raise NotImplementedError("use_adaptive_dt has no step here: see torch_mpm.rollout_to with Step.stable_dt")
        _check_storage(storage)
        self.dim, self.res = len(res), tuple(check_count("res", n, 1) for n in res)
        length = float(check_number("size", size, "positive", lambda v: v > 0))
        self.dx = length / self.res[0]
        self.inv_dx = 1 / self.dx
        self.default_dt = 2e-2 * self.dx / length * float(_positive_number("dt_scale", dt_scale))
        self.E, self.nu = 1e6 * length * float(_positive_number("E_scale", E_scale)), materials.POISSON
        self.p_vol, self.p_rho = self.dx**self.dim, DENSITY
        self.p_mass = self.p_vol * DENSITY
        self.water_density = float(check_number("water_density", water_density, "positive", lambda v: v > 0))
        self.support_plasticity, self.unbounded, self.use_emitter_id = support_plasticity, unbounded, use_emitter_id
        self.padding = check_count("padding", padding)
        self.t, self.total_substeps = 0.0, 0
        self._state: State | None = None
        self._step: Step | None = None
        self._grid = self._lattice()
        self.device = torch.device("cpu" if device is None else device)
        self.gravity: Sequence[float] = (0.0, -9.8, 0.0)[: self.dim]
        self.grid_postprocess: list[Any] = []
        self.add_bounding_box(unbounded)
        self.clear_particles()

    def _lattice(self) -> Grid:
        reach = [n * self.dx for n in self.res]
        if not self.unbounded:
            return Grid(self.dx, (0.0,) * self.dim, reach)
        far = round(UNBOUNDED / 2 * max(self.res)) * self.dx
        return Grid(self.dx, (-far,) * self.dim, (far,) * self.dim)

    # ---- what acts

    def set_gravity(self, g: Sequence[float]) -> None:
        """Acceleration [m/s²], as many numbers as dimensions."""
        self.gravity = _vector("g", g, self.dim)
        self._step = None

    def add_bounding_box(self, unbounded: bool = False) -> None:
        """Let no node within `padding` of a face move outwards."""
        if unbounded:
            low, high = self._grid.lower[0] + self.padding * self.dx, self._grid.upper[0] - self.padding * self.dx
            planes: list[Any] = []
            for axis in range(self.dim):
                normal = [float(k == axis) for k in range(self.dim)]
                planes += [Plane([low * n for n in normal], normal, "separate")]
                planes += [Plane([high * n for n in normal], [-n for n in normal], "separate")]
        else:
            planes = [*outer_planes(self.dx, self.res, self.padding, 0.0, math.inf)]
        self.grid_postprocess += planes

    def add_surface_collider(
        self, point: Sequence[float], normal: Sequence[float], surface: int = 0, friction: float = 0.0
    ) -> None:
        """Nodes behind a plane stop (0), slip (1) or separate (2), with Coulomb friction."""
        kind = self._kind(surface)
        if kind == "sticky" and friction != 0:
            raise ValueError(f"friction must be 0 on sticky surfaces, got {friction}")
        at, n = _vector("point", point, self.dim), _vector("normal", normal, self.dim)
        length = math.sqrt(sum(a * a for a in n))
        if length == 0:
            raise ValueError(f"normal must have a positive length, got {list(normal)}")
        margin = surface_margin(torch.float32, max(self.res) * self.dx)
        position = [p - margin * a / length for p, a in zip(at, n, strict=True)]
        self.grid_postprocess.append(Plane(position, [a / length for a in n], kind, friction=friction))

    def add_sphere_collider(self, center: Sequence[float], radius: float, surface: int = 0) -> None:
        """Nodes in a ball stop (0), slip (1) or separate (2)."""
        number = check_number("radius", radius, "positive", lambda v: v > 0)
        self.grid_postprocess.append(Sphere(_vector("center", center, self.dim), number, self._kind(surface)))

    def clear_grid_postprocess(self) -> None:
        """Remove all colliders, the bounding box among them."""
        self.grid_postprocess.clear()

    def _kind(self, surface: int) -> str:
        if surface not in self.surfaces.values():
            raise ValueError(f"surface must be one of {sorted(self.surfaces.values())}, got {surface!r}")
        return ("sticky", "slip", "separate")[surface]

    # ---- particles

    @property
    def n_particles(self) -> Number:
        """P, also read as n_particles[None]."""
        return Number(len(self.material))

    def clear_particles(self) -> None:
        """Remove all particles."""
        self._state, self._step = None, None
        self.material = torch.zeros(0, dtype=torch.int32, device=self.device)
        self.color, self.emitter_ids = torch.zeros_like(self.material), torch.zeros_like(self.material)

    @property
    def state(self) -> State:
        """Particles as a state of torch_mpm.

        Raises:
            ValueError: without particles.
        """
        if self._state is None:
            raise ValueError("there are no particles: call add_cube or another method that adds some")
        return self._state

    def add_cube(
        self,
        lower_corner: Sequence[float],
        cube_size: Sequence[float],
        material: int,
        color: int = WHITE,
        sample_density: float | None = None,
        velocity: Sequence[float] | None = None,
    ) -> None:
        """Particles at random positions in a box, sample_density in each cell, by default 2^D."""
        corner = _vector("lower_corner", lower_corner, self.dim)
        edges = _vector("cube_size", cube_size, self.dim)
        if min(edges) < 0:
            raise ValueError(f"cube_size must not be negative, got {list(edges)}")
        count = int(self._density(sample_density) * math.prod(edges) / self.p_vol + 1)
        self.add_particles(in_box(corner, edges, count), material, color, velocity)

    def add_ellipsoid(
        self,
        center: Sequence[float],
        radius: float | Sequence[float],
        material: int,
        color: int = WHITE,
        sample_density: float | None = None,
        velocity: Sequence[float] | None = None,
    ) -> None:
        """Particles at random positions in an ellipsoid with one radius, or one for each axis [m]."""
        radii = [radius] * self.dim if isinstance(radius, (int, float)) else radius
        halves = _positive("radius", radii, self.dim)
        unit = math.pi if self.dim == 2 else 4 / 3 * math.pi
        volume = unit * math.prod(r * self.inv_dx for r in halves)
        count = math.ceil(volume * self._density(sample_density))
        middle = _vector("center", center, self.dim)
        self.add_particles(in_ellipsoid(middle, halves, count), material, color, velocity)

    def add_ngon(
        self,
        sides: int,
        center: Sequence[float],
        radius: float,
        angle: float,
        material: int,
        color: int = WHITE,
        sample_density: float | None = None,
        velocity: Sequence[float] | None = None,
    ) -> None:
        """Particles at random positions in a regular polygon (2-D) with a corner at `angle` [rad].

        Raises:
            ValueError: in 3-D.
        """
        if self.dim != 2:
            raise ValueError("add_ngon needs a solver of 2 dimensions")
        check_count("sides", sides, 3)
        radius, angle = float(_positive_number("radius", radius)), float(check_number("angle", angle))
        area = 0.5 * (radius * self.inv_dx) ** 2 * math.sin(2 * math.pi / sides) * sides
        count = math.ceil(area * self._density(sample_density))
        points = in_polygon(_vector("center", center, 2), radius, sides, angle, count)
        self.add_particles(points, material, color, velocity)

    def add_texture_2d(
        self, offset_x: float, offset_y: float, texture: Any, new_material: int, color: int = WHITE
    ) -> None:
        """A particle for each entry above 0.1 of an array, dx apart (2-D)."""
        if self.dim != 2:
            raise ValueError("add_texture_2d needs a solver of 2 dimensions")
        index = (torch.as_tensor(np.asarray(texture)) > 0.1).nonzero()
        self.add_particles(torch.tensor([offset_x, offset_y]) + self.dx * index, new_material, color)

    def add_mesh(
        self,
        triangles: Any,
        material: int,
        color: int = WHITE,
        sample_density: float | None = None,
        velocity: Sequence[float] | None = None,
        translation: Sequence[float] | None = None,
        emmiter_id: int = 0,
    ) -> None:
        """Particles at jittered positions in a closed mesh (3-D), sample_density in each cell, by default 8.

        Args:
            triangles: their corners [T, 9] or [T, 3, 3] [m].
            translation: displacement of the mesh [m].
            material, color, sample_density, velocity, emmiter_id: as for `add_particles`.

        Raises:
            ImportError: without trimesh.
            ValueError: in 2-D, for triangles of another shape, a mesh that is not closed, or one with no space.
        """
        if self.dim != 3:
            raise ValueError("add_mesh needs a solver of 3 dimensions")
        shift = (0.0,) * 3 if translation is None else _vector("translation", translation, 3)
        points = in_mesh(triangles, shift, self.dx, self._density(sample_density))
        self.add_particles(points, material, color, velocity, emmiter_id)

    def add_particles(
        self,
        particles: Any,
        material: int,
        color: int = WHITE,
        velocity: Sequence[float] | None = None,
        emmiter_id: int = 0,
    ) -> None:
        """Particles at positions [P, D] [m], an array or a tensor, all with a velocity [m/s]; also between steps."""
        refuse_grad("steps have no gradients here; see torch_mpm.rollout", particles=particles, velocity=velocity)
        x = torch.as_tensor(particles, dtype=torch.float32, device=self.device)
        if x.dim() != 2 or x.shape[1] != self.dim:
            raise ValueError(f"particles must have shape [P, {self.dim}], got {shape_of(x)}")
        ids = [_ids(*pair, x) for pair in (("material", material), ("color", color), ("emmiter_id", emmiter_id))]
        start = (0.0,) * self.dim if velocity is None else _vector("velocity", velocity, self.dim)
        self._append(x, torch.tensor(start, device=x.device).expand_as(x), ids[0], ids[1])
        self.emitter_ids = torch.cat([self.emitter_ids, ids[2]])

    def read_restart(self, num_particles: int, pos: Any, vel: Any, material: Any, color: Any) -> None:
        """Particles with positions and velocities [P, D], materials and colors [P], undeformed."""
        refuse_grad("steps have no gradients here; see torch_mpm.rollout", pos=pos, vel=vel)
        x, v = (torch.as_tensor(a[:num_particles], dtype=torch.float32, device=self.device) for a in (pos, vel))
        ids = (torch.as_tensor(np.asarray(a[:num_particles]).astype(np.int64)) for a in (material, color))
        kinds, colors = (i.to(self.device, torch.int32) for i in ids)
        self._append(x, v, kinds, colors)
        self.emitter_ids = torch.cat([self.emitter_ids, torch.zeros_like(kinds)])

    def _density(self, given: float | None) -> float:
        return 2.0**self.dim if given is None else float(_positive_number("sample_density", given))

    def _append(self, x: Tensor, v: Tensor, material: Tensor, color: Tensor) -> None:
        for name, value in (("positions", x), ("velocities", v)):
            if value.shape != (len(x), self.dim):
                raise ValueError(f"{name} must have shape [P, D] = [{len(x)}, {self.dim}], got {shape_of(value)}")
            if not bool(value.isfinite().all()):
                row = int(value.isfinite().all(1).int().argmin())
                raise ValueError(f"{name} must be finite, got {value[row].tolist()} for particle {row}")
        for name, ids in (("material", material), ("color", color)):
            if ids.shape != x.shape[:1]:
                raise ValueError(f"{name} must have shape [P] = [{len(x)}], got {shape_of(ids)}")
        if len(x) == 0:
            return
        for number in material.unique().tolist():
            materials.law_of(number, self.E, self.dim, self.support_plasticity)
        mass = torch.where(material == self.material_water, self.water_density, 1.0).to(x) * self.p_mass
        zero = torch.zeros(len(x), self.dim, self.dim, device=x.device)
        new = State(x=x, v=v.clone(), mass=mass, volume=torch.full_like(mass, self.p_vol), C=zero)
        new = new.replace(F=identity_deformation(x), time=self.t)
        self.material, self.color = torch.cat([self.material, material]), torch.cat([self.color, color])
        self._state = new if self._state is None else _joined(self._state, new)
        self._step = None

    def particle_info(self) -> dict[str, np.ndarray[Any, Any]]:
        """Arrays of positions and velocities [P, D], float32, and of materials and colors [P], int32."""
        x, v = (torch.zeros(0, self.dim),) * 2 if self._state is None else (self._state.x, self._state.v)
        info = {"position": x, "velocity": v, "material": self.material, "color": self.color}
        if self.use_emitter_id:
            info["emitter_ids"] = self.emitter_ids
        return {name: value.detach().cpu().numpy().copy() for name, value in info.items()}

    def write_particles(self, fn: str | os.PathLike[str], slice_size: int = 1000000) -> None:
        """Write positions, velocities and colors as an .npz file with quantised numbers, see `particle_io`.

        Args:
            fn: the file.
            slice_size: not used.

        Raises:
            OSError: when it cannot be written; nothing remains of it.
            ValueError: without particles.
        """
        check_count("slice_size", slice_size, 1)
        info = self.particle_info()
        particle_io.write_particles(fn, info["position"], info["velocity"], info["color"])

    def write_particles_ply(self, fn: str | os.PathLike[str]) -> None:
        """Write positions and colors as a binary PLY file.

        Raises:
            OSError: when it cannot be written; nothing remains of it.
        """
        info = self.particle_info()
        particle_io.write_particles_ply(fn, info["position"], info["color"])

    # ---- time

    def step(self, frame_dt: float, print_stat: bool = False, smry_writer: Any = None) -> None:
        """Substeps of equal length up to frame_dt [s] later, computed together.

        Args:
            frame_dt: [s]
            print_stat: whether to print the number of particles and substeps.
            smry_writer: not supported.

        Raises:
            ValueError: for a frame_dt that is not positive and finite, or of more than 1e9 substeps.
        """
        check_number("frame_dt", frame_dt, "positive and finite", lambda v: 0 < v < math.inf)
        if frame_dt / self.default_dt > MOST_SUBSTEPS:
            raise ValueError(
                f"frame_dt must be at most {MOST_SUBSTEPS:.0e} substeps of {self.default_dt:.3g} s, got {frame_dt} s"
            )
        if smry_writer is not None:
            raise NotImplementedError("smry_writer has no scalars here: read solver.state after each step")
        dt = frame_dt / (int(frame_dt / self.default_dt) + 1)
        count, left = 0, frame_dt
        while left > 0:  # The rounding of this sum decides whether there is one more, as in taichi_elements.
            left -= dt
            count += 1
        if self._state is not None:
            with torch.no_grad():
                step = self._ready_step()
                self._state = rollout(step, self._state, count, dt)
                if self._anchored is not None:
                    self._state = self._anchored(self._state, dt)
                assert self._state is not None and self._state.F is not None
                water = self.material == self.material_water
                self._state = self._state.replace(F=shapeless(self._state.F, water))
        self.t += count * dt
        self.total_substeps += count
        if print_stat:
            print(f"{self.n_particles} particles, {count} substeps of {dt:.3g} s")

    def _ready_step(self) -> Step:
        state = self.state
        if self._step is None:
            present, indices = law_indices(self.material)
            law = mixture_of(present, self.E, self.dim, self.support_plasticity)
            self._state = state = state.replace(material=indices if len(present) > 1 else None)
            still = self.material == self.material_stationary
            self._anchored = Anchored(state, still) if self.material_stationary in present else None
            self._step = Step(self._grid, law, gravity=self.gravity, on_particles=self._anchored)
        step = self._step
        if list(step.boundaries.entries) != self.grid_postprocess:
            step.boundaries = list(self.grid_postprocess)  # type: ignore[assignment]
        return step

    _anchored: Anchored | None = None


def _check_storage(given: dict[str, Any]) -> None:
    """Report options without effect.

    Raises:
        TypeError: for an unknown option.
    """
    for name in given:
        if name not in STORAGE:
            raise TypeError(f"MPMSolver has no argument {name!r}; those of the storage are {sorted(STORAGE)}")
    changed = sorted(name for name, value in given.items() if value != STORAGE[name])
    if changed:
        warnings.warn(f"options of Taichi's storage and kernels have no effect: {', '.join(changed)}", stacklevel=3)


def _vector(name: str, value: Any, dim: int) -> tuple[float, ...]:
    """Finite numbers from anything that has as many of them as dimensions: a list, an array, a tensor, a vector of
    Taichi.
    """
    return check_vector(name, value if hasattr(value, "tolist") else list(value), dim)


def _positive(name: str, value: Any, dim: int) -> tuple[float, ...]:
    """`_vector` of positive numbers."""
    found = _vector(name, value, dim)
    if min(found) <= 0:
        raise ValueError(f"{name} must be positive on every axis, got {list(found)}")
    return found


def _positive_number(name: str, value: Any) -> Any:
    return check_number(name, value, "positive and finite", lambda v: 0 < v < math.inf)


def _ids(name: str, value: int, x: Tensor) -> Tensor:
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name} must be a whole number, got {shape_of(value)}")
    return torch.full((len(x),), value, dtype=torch.int32, device=x.device)


def _joined(first: State, second: State) -> State:
    """Particles of two states; the history of the second starts at zero."""

    def both(name: str) -> Tensor:
        return torch.cat([getattr(first, name), getattr(second, name)])

    x, v, mass, volume, C, F = (both(name) for name in ("x", "v", "mass", "volume", "C", "F"))
    extra = {k: torch.cat([t, t.new_zeros(len(second), *t.shape[1:])]) for k, t in first.extra.items()}
    return State(x=x, v=v, mass=mass, volume=volume, C=C, F=F, extra=extra, time=second.time)
