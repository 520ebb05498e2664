"""Particles of NCLaw's simulator: moving fields, constant fields, and their initial values."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ...cuda_graphs.capture import Same, version
from ...data.whole_files import is_name
from ..gradients import refuse_grad
from ..settings import setting
from .meshes import points_in_mesh

if TYPE_CHECKING:
    from .sim import MPMModel

FIELDS = ("x", "v", "C", "F", "stress")


class MPMStatics:
    """Fields of particles that a step does not change.

    Args:
        shape: number of particles.
        device: of the tensors.

    Attributes:
        vol: rest volume [P] [m³].
        rho: density [P] [kg/m³].
        clip_bound: minimum distance of positions from the faces of the cube, in cells [P].
        enabled: whether a particle takes part, int32 [P].
    """

    def __init__(self, shape: int, device: torch.device | str | None = None) -> None:
        self.vol, self.rho, self.clip_bound = (torch.zeros(shape, device=device) for _ in range(3))
        self.enabled = torch.zeros(shape, dtype=torch.int32, device=device)
        self._enabled_by: tuple[Any, ...] | None = None  # Sections and values of `enabled`.

    def update_vol(self, sections: Sequence[int], vols: Sequence[float]) -> None:
        """Set the volume of each section."""
        self.vol = _by_section(self.vol, sections, vols)

    def update_rho(self, sections: Sequence[int], rhos: Sequence[float]) -> None:
        """Set the density of each section."""
        self.rho = _by_section(self.rho, sections, rhos)

    def update_clip_bound(self, sections: Sequence[int], clip_bounds: Sequence[float]) -> None:
        """Set the bound of each section."""
        self.clip_bound = _by_section(self.clip_bound, sections, clip_bounds)

    def update_enabled(self, sections: Sequence[int], spans: Sequence[tuple[int, int]], step: int = 0) -> None:
        """Enable each section while first ≤ step < last of its span."""
        values = [int(a <= step < b) for a, b in spans]
        if self._enabled_by != (list(sections), values, Same(self.enabled), version(self.enabled)):
            self.enabled = _by_section(self.enabled, sections, values)
            self._enabled_by = list(sections), values, Same(self.enabled), version(self.enabled)


def _by_section(like: Tensor, sections: Sequence[int], values: Sequence[float | Tensor]) -> Tensor:
    """Values [P] of sections with one value each, a number or a tensor [] that may require grad."""
    if len(sections) != len(values) or sum(sections) != len(like):
        raise ValueError(f"sections must add up to {len(like)} with one value each, got {list(sections)}")
    if not values:
        return like
    parts = (torch.as_tensor(value, dtype=like.dtype, device=like.device).reshape(-1) for value in values)
    return torch.cat([part.expand(n) for n, part in zip(sections, parts, strict=True)])


class MPMState:
    """Particles at rest in the origin.

    Args:
        shape: number of particles.
        device: of the tensors.

    Attributes:
        particle: x [P, 3] [m], v [P, 3] [m/s], C [P, 3, 3] [1/s], F [P, 3, 3] and stress [P, 3, 3] [Pa].
    """

    def __init__(self, shape: int, device: torch.device | str | None = None, requires_grad: bool = False) -> None:
        self.shape, self.device = shape, device
        vectors, matrices = torch.zeros(shape, 3, device=device), torch.zeros(shape, 3, 3, device=device)
        self.particle = SimpleNamespace(
            x=vectors, v=vectors.clone(), C=matrices, F=matrices + torch.eye(3, device=device), stress=matrices.clone()
        )

    def to_torch(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """x, v, C, F and stress."""
        return tuple(getattr(self.particle, name) for name in FIELDS)

    def from_torch(
        self,
        x: Tensor | None = None,
        v: Tensor | None = None,
        C: Tensor | None = None,
        F: Tensor | None = None,
        stress: Tensor | None = None,
    ) -> None:
        """Set what is not None."""
        for name, value in zip(FIELDS, (x, v, C, F, stress), strict=True):
            if value is not None:
                setattr(self.particle, name, value)


@dataclasses.dataclass
class MPMInitData:
    """Initial values of a body.

    Attributes:
        rho: density [kg/m³].
        clip_bound: see `MPMStatics`.
        span: first step of its presence, and first step after it.
        num_particles: P
        vol: volume of a particle [m³].
        pos: positions [P, 3] [m].
        lin_vel, ang_vel: velocity [m/s] and spin [rad/s] about `center` [m], which is the mean position if None.
        ind_vel: velocity of each particle [P, 3] [m/s], in the place of these.
        assets: of the class, the folder of NCLaw's meshes.
    """

    assets: ClassVar[str | os.PathLike[str] | None] = None

    rho: float
    clip_bound: float
    span: tuple[int, int]
    num_particles: int
    vol: float
    pos: np.ndarray
    lin_vel: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    ang_vel: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    center: np.ndarray | None = None
    ind_vel: np.ndarray | None = None

    def __post_init__(self) -> None:
        names = ("pos", "lin_vel", "ang_vel", "center", "ind_vel")
        refuse_grad("arrays have no gradient; pass tensors to the simulator", **{n: getattr(self, n) for n in names})
        if self.center is None:
            self.center = np.asarray(self.pos).mean(0)

    @classmethod
    def get(cls, cfg: Any) -> MPMInitData:
        """Body of a configuration with rho, clip_bound, span and a shape of type "cube" or "mesh".

        Raises:
            ImportError, OSError, ValueError: as `get_mesh`, and for another shape.
        """
        shape = setting(cfg, "shape")
        kind = setting(shape, "type")
        if kind not in ("cube", "mesh"):
            raise ValueError(
                f"shape must be of type 'cube' or 'mesh', got {kind!r}: fill others by torch_mpm.seed and pass "
                "positions and volume to MPMInitData"
            )
        center, size, resolution, mode = (setting(shape, name) for name in ("center", "size", "resolution", "mode"))
        arguments = center, size, resolution, mode, setting(shape, "sort", None)
        body = cls.get_cube(*arguments) if kind == "cube" else cls.get_mesh(setting(shape, "name"), *arguments)
        rho, clip_bound, span = (setting(cfg, name) for name in ("rho", "clip_bound", "span"))
        return cls(rho=rho, clip_bound=clip_bound, span=tuple(span), **body)

    @classmethod
    def get_mesh(
        cls,
        name: str,
        center: Sequence[float],
        size: Sequence[float],
        resolution: int,
        mode: str,
        sort: int | None = None,
    ) -> dict[str, Any]:
        """A mesh of the folder `assets`, scaled so that its longest edge is 1 and by `size` then; see
        `meshes.points_in_mesh`.

        Raises:
            ImportError: without trimesh.
            OSError: for a file that is missing or cannot be read.
            ValueError: without `assets`, for a name that is a path, or for points that are not there.
        """
        if cls.assets is None:
            raise ValueError("MPMInitData.assets must be the folder nclaw/assets, before a mesh is filled")
        if not isinstance(name, str) or not is_name(name):
            raise ValueError(f"name of a mesh must have letters, digits, _ and - alone, got {name!r:.100}")
        points, volume = points_in_mesh(Path(cls.assets), name, resolution, mode)
        pos, middle = _sorted(points, sort) * np.array(size, float), np.array(center, float)
        return {"num_particles": len(pos), "vol": volume * math.prod(size), "pos": pos + middle, "center": middle}

    @staticmethod
    def get_cube(
        center: Sequence[float], size: Sequence[float], resolution: int, mode: str, sort: int | None = None
    ) -> dict[str, Any]:
        """A box with `resolution` particles along its longest edge, in a lattice ("uniform") or "random"."""
        middle, edges = np.array(center, float), np.array(size, float)
        counts = np.around(edges * resolution / edges.max()).astype(int)
        if mode == "uniform":
            axes = [np.linspace(-e / 2, e / 2, n) for e, n in zip(edges, counts, strict=True)]
            pos = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        elif mode == "random":
            pos = np.random.default_rng(0).uniform(-edges / 2, edges / 2, (math.prod(counts), 3))
        else:
            raise ValueError(f"mode must be 'uniform' or 'random', got {mode!r}")
        pos = _sorted(pos, sort)
        vol = math.prod(edges) / len(pos)
        return {"num_particles": len(pos), "vol": vol, "pos": pos + middle, "center": middle}

    def set_lin_vel(self, value: Sequence[float]) -> None:
        """[m/s]"""
        refuse_grad("arrays have no gradient; pass tensors to the simulator", lin_vel=value)
        self.lin_vel = np.array(value, float)

    def zero_lin_vel(self) -> None:
        """Set the velocity to zero."""
        self.lin_vel = np.zeros(3)

    def zero_ang_vel(self) -> None:
        """Set the spin to zero."""
        self.ang_vel = np.zeros(3)

    def set_ang_vel(self, value: Sequence[float]) -> None:
        """[rad/s]"""
        refuse_grad("arrays have no gradient; pass tensors to the simulator", ang_vel=value)
        self.ang_vel = np.array(value, float)

    def set_ind_vel(self, ind_vel: np.ndarray) -> None:
        """[P, 3] [m/s]"""
        refuse_grad("arrays have no gradient; pass tensors to the simulator", ind_vel=ind_vel)
        self.ind_vel = np.array(ind_vel, float)

    def velocity(self) -> np.ndarray:
        """[P, 3] [m/s]"""
        if self.ind_vel is not None:
            return self.ind_vel
        return self.lin_vel + np.cross(self.ang_vel, self.pos - self.center)


def _sorted(points: np.ndarray, axis: int | None) -> np.ndarray:
    """Points in descending order of a coordinate; in their own order for None."""
    return points if axis is None else points[np.argsort(-points[:, axis], kind="stable")]


class _Initializer:
    def __init__(self, model: MPMModel) -> None:
        self.model = model
        self.groups: list[MPMInitData] = []

    def add_group(self, group: MPMInitData) -> None:
        """Append a body."""
        self.groups.append(group)

    @property
    def sections(self) -> list[int]:
        """Number of particles of each body."""
        return [group.num_particles for group in self.groups]


class MPMStateInitializer(_Initializer):
    """Creates the first state of bodies.

    Args:
        model: see `MPMModelBuilder`.
    """

    def finalize(self) -> tuple[MPMState, list[int]]:
        """State, and the number of particles of each body."""
        state = self.model.state(sum(self.sections))
        for name, parts in (("x", [g.pos for g in self.groups]), ("v", [g.velocity() for g in self.groups])):
            rows = np.concatenate(parts) if parts else np.zeros((0, 3))
            setattr(state.particle, name, torch.as_tensor(rows, dtype=torch.float32, device=self.model.device))
        return state, self.sections


class MPMStaticsInitializer(_Initializer):
    """Creates the statics of bodies.

    Args:
        model: see `MPMModelBuilder`.
    """

    def finalize(self) -> MPMStatics:
        """Statics at step 0."""
        statics, sections = self.model.statics(sum(self.sections)), self.sections
        statics.update_vol(sections, [g.vol for g in self.groups])
        statics.update_rho(sections, [g.rho for g in self.groups])
        statics.update_clip_bound(sections, [g.clip_bound for g in self.groups])
        self.update(statics)
        return statics

    def update(self, statics: MPMStatics, step: int = 0) -> None:
        """Enable the bodies that are present at a step."""
        statics.update_enabled(self.sections, [g.span for g in self.groups], step)
