"""Particles of NCLaw's simulator: moving fields, constant fields, and their initial values."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ..gradients import refuse_grad
from ..settings import setting

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
        self.enabled = _by_section(self.enabled, sections, [int(a <= step < b) for a, b in spans])


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
    """

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
        """Body of a configuration with rho, clip_bound, span and a shape of type "cube".

        Raises:
            ValueError: for another shape, which `torch_mpm.seed` fills: MPMInitData(..., pos=points.x.numpy()).
        """
        shape = setting(cfg, "shape")
        if setting(shape, "type") != "cube":
            raise ValueError(
                f"shape must be of type 'cube', got {setting(shape, 'type')!r}: fill others by torch_mpm.seed and pass "
                "positions and volume to MPMInitData"
            )
        center, size, resolution, mode = (setting(shape, name) for name in ("center", "size", "resolution", "mode"))
        cube = cls.get_cube(center, size, resolution, mode, setting(shape, "sort", None))
        rho, clip_bound, span = (setting(cfg, name) for name in ("rho", "clip_bound", "span"))
        return cls(rho=rho, clip_bound=clip_bound, span=tuple(span), **cube)

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
        if sort is not None:
            pos = pos[np.argsort(-pos[:, sort], kind="stable")]
        vol = math.prod(edges) / len(pos)
        return {"num_particles": len(pos), "vol": vol, "pos": pos + middle, "center": middle}

    def set_lin_vel(self, value: Sequence[float]) -> None:
        """[m/s]"""
        refuse_grad("arrays have no gradient; pass tensors to the simulator", lin_vel=value)
        self.lin_vel = np.array(value, float)

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
