"""The state of a simulation: tensors packed over particles and scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .errors import FLOATING, check_like, shape_of
from .ops.arguments import soa_empty

if TYPE_CHECKING:
    from .grid import Grid
    from .seed import Points


class Time:
    """`State.time`. A number is kept as (tensor [],), because compiled code takes Python numbers for constants."""

    def __get__(self, state: State | None, owner: type) -> float | Tensor:
        if state is None:
            return 0.0  # of a new state
        time: Tensor | tuple[Tensor] = state.__dict__["_time"]
        if isinstance(time, Tensor):
            return time
        return time[0] if torch.compiler.is_compiling() else time[0].item()

    def __set__(self, state: State, time: float | Tensor | tuple[Tensor]) -> None:
        if isinstance(time, Tensor):
            number = torch.compiler.is_compiling() and time.dim() == 0 and time.dtype == torch.float64
            if number and time.device.type == "cpu" and not time.requires_grad:
                time = (time,)
        elif not isinstance(time, tuple):
            time = (torch.scalar_tensor(time, dtype=torch.float64, device="cpu"),)
        state.__dict__["_time"] = time


@dataclasses.dataclass(eq=False)
class State:
    """Particles of all scenes of a batch, packed. A field that a simulation does not use is None.

    Attributes:
        x: positions [P, D] [m].
        v: velocities [P, D] [m/s].
        mass: [P] [kg].
        volume: rest volume [P] [m³] (m² in 2-D).
        C: affine velocity field [P, D, D] [1/s].
        F: deformation gradient [P, D, D]; for laws that need only its determinant,
        J: volume ratio [P].
        scene: scene of each particle, int32 [P]; None for one scene.
        ids: stable identity of each particle, int64 [P], set once particles are reordered.
        material: law of each particle, int32 [P], for a `Mixture`.
        temperature: relative to a reference [P] [K].
        extra: further per-particle tensors [P, ...] that follow a reordering.
        time: simulated time [s]: a number, or a tensor [B] once dt is a tensor. Code compiled by `torch.compile` sees a
            number as a tensor [] of float64 on the CPU, so that it serves every time.

    All floating tensors have one dtype and device. Any strides work; those that the ops return keep the particle index
    contiguous, which is fastest.
    """

    x: Tensor
    v: Tensor
    mass: Tensor
    volume: Tensor
    C: Tensor | None = None
    F: Tensor | None = None
    J: Tensor | None = None
    scene: Tensor | None = None
    ids: Tensor | None = None
    material: Tensor | None = None
    temperature: Tensor | None = None
    extra: dict[str, Tensor] = dataclasses.field(default_factory=dict)
    time: float | Tensor = Time()  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if not isinstance(self.x, Tensor) or self.x.dim() != 2 or self.x.shape[1] not in (2, 3):
            raise ValueError(f"x must have shape [P, 2] or [P, 3], got {shape_of(self.x)}")
        if self.x.dtype not in FLOATING:
            raise TypeError(f"x must be float32 or float64, got {self.x.dtype}")
        P, D = self.x.shape
        check_like("v", self.v, self.x, (P, D), "[P, D]")
        check_like("C", self.C, self.x, (P, D, D), "[P, D, D]")
        check_like("F", self.F, self.x, (P, D, D), "[P, D, D]")
        for name in ("mass", "volume", "J", "temperature"):
            check_like(name, getattr(self, name), self.x, (P,), "[P]")
        for name, dtype in (("scene", torch.int32), ("material", torch.int32), ("ids", torch.int64)):
            index = getattr(self, name)
            if index is None:
                continue
            if not isinstance(index, Tensor) or index.shape != (P,):
                raise ValueError(f"{name} must have shape [P] = [{P}], got {shape_of(index)}")
            if index.dtype != dtype:
                raise TypeError(f"{name} must be {dtype}, got {index.dtype}")
        for name, value in self.extra.items():
            if value.shape[:1] != (P,):
                raise ValueError(f"extra[{name!r}] must have {P} rows, got {shape_of(value)}")

    @classmethod
    def at_rest(
        cls,
        points: Points,
        density: float | Tensor = 1000.0,
        velocity: Any = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> State:
        """Undeformed particles.

        Args:
            points: positions [m], rest volumes [m³] and perhaps scenes, as the functions of `torch_mpm.seed` give them.
            density: [kg/m³]; a number or [P].
            velocity: [m/s]; D numbers or [P, D]; None for zero.
            dtype: float32 or float64; torch's default if None.
            device: the points' if None.

        Raises:
            ValueError: for a density that is not positive and finite, or wrong shapes.
        """
        values = torch.as_tensor(density)
        bad = values[~((values > 0) & (values < torch.inf))]
        if bad.numel():
            raise ValueError(f"density must be positive and finite, got {float(bad[0])}")
        dtype = dtype or torch.get_default_dtype()
        x = _as_soa(points.x.to(device=device, dtype=dtype))
        volume = points.volume.to(device=x.device, dtype=dtype)
        mass = (points.volume.to(x.device) * density).to(dtype)
        v = soa_empty(x, tuple(x.shape)).zero_()
        if velocity is not None:
            v = v + torch.as_tensor(velocity, dtype=dtype, device=x.device)
        scene = None if points.scene is None else points.scene.to(device=x.device, dtype=torch.int32)
        return cls(x=x, v=v, mass=mass, volume=volume, scene=scene)

    def __len__(self) -> int:
        return self.x.shape[0]

    def replace(self, **changes: Any) -> State:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **{"time": self.__dict__["_time"]} | changes)

    def map(self, function: Callable[[Tensor], Tensor]) -> State:
        """A copy with a function applied to every per-particle tensor, absent fields staying None."""
        changes: dict[str, Any] = {
            f.name: function(value)
            for f in dataclasses.fields(self)
            if f.name != "time" and isinstance(value := getattr(self, f.name), Tensor)
        }
        return self.replace(**changes, extra={k: function(t) for k, t in self.extra.items()})

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> State:
        """Move to a device, and floating tensors to a dtype."""
        state = self.map(lambda t: t.to(device=device, dtype=dtype if t.is_floating_point() else None))
        if isinstance(self.time, Tensor):
            state.time = self.time.to(device=device, dtype=dtype)
        return state

    def detach(self) -> State:
        """The same values outside the autograd graph."""
        state = self.map(Tensor.detach)
        if isinstance(self.time, Tensor):
            state.time = self.time.detach()
        return state

    def select(self, particles: Tensor) -> State:
        """The particles of an index tensor, int64 or int32 [Q], in that order; differentiable."""
        return self.map(lambda t: _take(t, particles))

    def sorted(self, grid: Grid) -> State:
        """Reorder by grid block and cell: neighbours in space become neighbours in memory. `ids` remember the order.

        Reordering now and then keeps long simulations fast; results differ only by rounding. Differentiable.
        """
        ids = torch.arange(len(self), device=self.x.device) if self.ids is None else self.ids
        blocks = grid.activate(self.x, self.scene)
        order = torch.ops.torch_mpm.cell_order(self.x.detach(), *blocks.topology)
        return self.replace(ids=ids).select(order)

    def restored(self) -> State:
        """In the order of `ids`, that is in the order before any `sorted`. Differentiable."""
        return self if self.ids is None else self.select(torch.argsort(self.ids))

    @staticmethod
    def concatenate(states: list[State], scene: bool = False) -> State:
        """Pack several states into one.

        Args:
            states: with the same fields present.
            scene: make each of them its own scene, numbered in order.

        Raises:
            ValueError: for an empty list, or where a field is present in some states only.
        """
        if not states:
            raise ValueError("states must not be empty")
        if scene:
            states = [
                s.replace(scene=torch.full((len(s),), i, dtype=torch.int32, device=s.x.device))
                for i, s in enumerate(states)
            ]

        def joined(name: str) -> Tensor | None:
            values = [getattr(s, name) for s in states]
            if all(v is None for v in values):
                return None
            if any(v is None for v in values):
                raise ValueError(f"{name} is present in some states and absent in others")
            return _cat(values)

        fields = [f.name for f in dataclasses.fields(State) if f.name not in ("extra", "time")]
        keys = states[0].extra.keys()
        if any(s.extra.keys() != keys for s in states):
            raise ValueError("the states have different extra fields")
        extra = {k: _cat([s.extra[k] for s in states]) for k in keys}
        return State(**{name: joined(name) for name in fields}, extra=extra, time=states[0].time)  # type: ignore[arg-type]


def _as_soa(t: Tensor) -> Tensor:
    """The same values with the particle index contiguous."""
    if t.dim() == 1:
        return t.contiguous()
    axes = (*range(1, t.dim()), 0)
    return t.permute(axes).contiguous().permute(t.dim() - 1, *range(t.dim() - 1))


def _take(t: Tensor, particles: Tensor) -> Tensor:
    """Rows of a [P, ...] tensor with the particle index contiguous."""
    if t.dim() == 1:
        return t.index_select(0, particles)
    rows = t.permute(*range(1, t.dim()), 0).flatten(0, -2)  # of which `index_select` is ten times faster
    taken = rows.index_select(1, particles).unflatten(0, t.shape[1:])
    return taken.permute(t.dim() - 1, *range(t.dim() - 1))


def _cat(tensors: list[Tensor]) -> Tensor:
    return _as_soa(torch.cat(tensors))


def identity_deformation(x: Tensor) -> Tensor:
    """F = I for every particle, [P, D, D]."""
    P, D = x.shape
    F = soa_empty(x, (P, D, D)).zero_()
    F.diagonal(dim1=1, dim2=2).fill_(1)
    return F
