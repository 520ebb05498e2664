"""State of a simulation: tensors packed over particles and scenes."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor

from ..cuda_graphs.capture import is_captured, is_traced, version
from ..errors import (
    FLOATING,
    NUMBER_OR_TENSOR,
    check_count,
    check_device,
    check_dtype,
    check_flag,
    check_index,
    check_like,
    check_number,
    default_dtype,
    shape_of,
)
from ..geometry.seed import Points
from ..grid.grid import Grid, check_grid
from ..ops.arguments import refuse_batched, scenes_up_to, soa_empty
from ..ops.autograd import dispatch, is_tracked

if TYPE_CHECKING:
    from ..boundaries.control import Poses


class Time:
    """Descriptor of `State.time`. A number is stored as (tensor [],), because compiled code treats Python numbers as
    constants.

    A tensor is stored in float64: the sum of steps in float32 would differ from the time.
    """

    def __get__(self, state: State | None, owner: type) -> float | Tensor:
        if state is None:
            return 0.0  # Of a new state.
        time: Tensor | tuple[Tensor] = state.__dict__["_time"]
        if isinstance(time, Tensor):
            return time
        return time[0] if torch.compiler.is_compiling() else time[0].item()

    def __set__(self, state: State, time: float | Tensor) -> None:
        kept: Tensor | tuple[Tensor]
        if isinstance(time, Tensor):
            if time.is_complex() or time.dtype == torch.bool:
                raise TypeError(f"time must be a number or a real tensor, got {time.dtype}")
            time = time.double()
            number = torch.compiler.is_compiling() and time.dim() == 0 and time.dtype == torch.float64
            kept = (time,) if number and time.device.type == "cpu" and not time.requires_grad else time
        else:
            seconds = time
            if not (isinstance(time, float) and math.isfinite(time)):
                seconds = float(check_number("time", time, kinds="a number or a tensor [B]"))
            kept = (torch.scalar_tensor(seconds, dtype=torch.float64, device="cpu"),)
        state.__dict__["_time"] = kept


@dataclasses.dataclass(eq=False)
class State:
    """Particles of all scenes of a batch, packed. Unused fields are None.

    Attributes:
        x: positions [P, D] [m].
        v: velocities [P, D] [m/s].
        mass: [P] [kg].
        volume: rest volume [P] [m³] (m² in 2-D).
        C: affine velocity field [P, D, D] [1/s].
        F: deformation gradient [P, D, D]; for laws that need only its determinant,
        J: volume ratio [P].
        scene: scene of each particle, int32 [P]; None for one scene. A particle of scene -1 is absent: it takes part in
            nothing, and keeps its position without a velocity.
        ids: stable identity of each particle, int64 [P], set once particles are reordered; 0 .. P − 1 in some order
            where parameters are given per particle.
        material: law of each particle, int32 [P], for a `Mixture`.
        temperature: relative to a reference [P] [K].
        extra: further per-particle tensors [P, ...] that follow a reordering.
        time: simulated time [s]: a number, or a tensor [B] once dt is a tensor, stored in float64 for any dtype of x.
            Code compiled by `torch.compile` receives a number as a tensor [] of float64 on the CPU, so that it is valid
            for every time.
        impulse: impulse of the material on each boundary of the step and then on each face of the domain, accumulated
            over steps [B, K + 2 D, D + 1 or 3] [N s, N m s], float64; see `torch_mpm.impulses`.
        x_residual: accumulated rounding error of the positions [P, D] [m]: a particle is at x + x_residual. None where
            positions are not compensated; see `Step(compensated=)`. Constant for autograd.

    All floating tensors of the particles have one dtype and device. Any strides work; the particle index of results of
    ops is contiguous, which is fastest.
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
    impulse: Tensor | None = None
    x_residual: Tensor | None = None
    _poses: dataclasses.InitVar[Poses | None] = None
    """An unknown argument is not a field, so that `dataclasses.replace` passes it on."""

    _counted = None  # Scenes, and the tensor and its version for which they are known; not a field.

    def __post_init__(self, _poses: Poses | None) -> None:
        if _poses:
            self.__dict__["_poses"] = _poses
        if not isinstance(self.x, Tensor) or self.x.dim() != 2 or self.x.shape[1] not in (2, 3):
            raise ValueError(f"x must have shape [P, 2] or [P, 3], got {shape_of(self.x)}")
        if self.x.dtype not in FLOATING:
            raise TypeError(f"x must be float32 or float64, got {self.x.dtype}")
        self._check(FIELDS)

    def _check(self, names: Iterable[str]) -> None:
        """Check fields against x.

        Raises:
            TypeError, ValueError: for another shape, dtype or device.
        """
        x, fields = self.x, self.__dict__
        P, D = x.shape
        for name in names:
            value = fields.get(name)
            if value is None and name not in _NEEDED:
                continue
            if name in _SYMBOLS:
                symbols = _SYMBOLS[name]
                check_like(name, value, x, (P, D, D)[: symbols.count(",") + 1], symbols, name in _NEEDED)
            elif name in _INDICES:
                check_index(name, value, x, _INDICES[name])
            elif name == "impulse":
                _check_impulse(value, x)
            elif name == "extra":
                _check_extra(value, P)

    def check_assigned(self) -> None:
        """Check fields that may have been assigned since, and that ops of transfers do not check.

        Raises:
            TypeError, ValueError: for another shape, dtype or device.
        """
        self._check(("F", "J", "material", "temperature", "extra"))

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
            points: positions [m], rest volumes [m³] and perhaps scenes, as returned by the functions of
                `torch_mpm.seed`; a state in float64 stores them without their rounding to another dtype.
            density: [kg/m³]; a number or [P].
            velocity: [m/s]; D numbers, or a tensor [D] or [P, D]; None for zero.
            dtype: float32 or float64; torch's default if None, or float32 where that is a half.
            device: that of the points if None.

        Raises:
            TypeError, ValueError: for a density that is not positive and finite, numbers as velocity that are not
                finite, or wrong shapes.
        """
        if not isinstance(points, Points):
            raise TypeError(f"points must be a result of torch_mpm.seed, got {shape_of(points)}")
        P, D = points.x.shape
        density = _checked_density(density, P)
        check_dtype(dtype)
        check_device(device)
        dtype = dtype or default_dtype()
        x, given_volume = points.values_for(dtype)
        x = _as_soa(x.to(device=device, dtype=dtype))
        volume = given_volume.to(device=x.device, dtype=dtype)
        mass = (given_volume.to(x.device) * density).to(dtype)
        v = soa_empty(x, (P, D)).zero_()
        if velocity is not None:
            v = v + _given_velocity(velocity, P, D).to(device=x.device, dtype=dtype)
        scene = None if points.scene is None else points.scene.to(device=x.device, dtype=torch.int32)
        return cls(x=x, v=v, mass=mass, volume=volume, scene=scene)

    def __len__(self) -> int:
        return self.x.shape[0]

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore from a copy or a file, which may be of an earlier version, with a time in float32."""
        time = state.pop("_time")
        self.__dict__.update({"x_residual": None} | state)  # Fields that earlier versions lack.
        self.time = time if isinstance(time, Tensor) else time[0].item()

    @property
    def scene_time(self) -> Tensor | None:
        """The time where it is a tensor [B]; None where it is a number, which is not read."""
        time = self.__dict__["_time"]
        return time if isinstance(time, Tensor) else None

    @property
    def scenes(self) -> int | None:
        """Number of scenes B for parameters [B], including scenes without particles.

        It is that of the grid of the step that prepared or returned the state. For other states it is that of a time
        [B] or of the impulse, or else the largest scene plus one, for which the device is read once. None where it
        cannot be read: in compiled code, and while a CUDA graph is captured.
        """
        if torch.compiler.is_compiling():
            return None
        scene = self.scene
        now = None if scene is None else version(scene)
        if self._counted is None or self._counted[0] is not scene or self._counted[1] != now:
            self._counted = scene, now, _count_scenes(self)
        return self._counted[2]

    def of_scenes(self, scenes: int) -> State:
        """The same state, marked as one of a grid of B scenes.

        Raises:
            TypeError, ValueError: for an invalid number of scenes, or a time of another number of them.
        """
        check_count("scenes", scenes)
        time = self.__dict__["_time"]
        if isinstance(time, Tensor) and (time.dim() > 1 or (time.dim() == 1 and len(time) not in (1, scenes))):
            raise ValueError(f"time must be a number or have shape [], [1] or [B] = [{scenes}], got {shape_of(time)}")
        if not torch.compiler.is_compiling():
            self._counted = self.scene, None if self.scene is None else version(self.scene), scenes
        return self

    def replace(self, **changes: Any) -> State:
        """A copy with some fields changed.

        Raises:
            TypeError, ValueError: for unknown fields, or another shape, dtype or device.
        """
        x = changes.get("x", self.x)
        if torch.compiler.is_compiling() or not changes.keys() <= _NAMES or not _is_alike(x, self.x):
            return self._rebuilt(changes)
        state = self.with_results(changes)
        state._check(changes)
        return state

    def with_results(self, changes: dict[str, Any]) -> State:
        """A copy with fields that an op computed from this state, which are not checked."""
        state: State = object.__new__(State)
        state.__dict__.update(self.__dict__)
        if "time" in changes:
            state.time = changes.pop("time")
        state.__dict__.update(changes)
        return state

    def _rebuilt(self, changes: dict[str, Any]) -> State:
        """`replace` by the constructor, which checks all fields."""
        kept = {name: self.__dict__[name] for name in FIELDS if name not in changes and name != "time"}
        state = State(**kept, **({"time": self.time} | changes))
        if "_poses" in self.__dict__:
            state.__dict__["_poses"] = self.__dict__["_poses"]
        if not torch.compiler.is_compiling():
            state._counted = self._counted
        return state

    @property
    def poses(self) -> Poses:
        """Poses of obstacles after the latest step, see `torch_mpm.boundaries.control`; None for a newly made state.

        Copies of a state have them, also those of `dataclasses.replace`, `copy` and functions of pytrees. Files,
        pickles and TensorDicts do not.
        """
        poses: Poses = self.__dict__.get("_poses", {})
        return poses

    def with_poses(self, poses: Poses) -> State:
        """Copy with other poses of its obstacles."""
        state: State = object.__new__(State)
        state.__dict__.update(self.__dict__)
        state.__dict__["_poses"] = poses
        return state

    def __copy__(self) -> State:
        return self.with_poses(self.poses)

    def __deepcopy__(self, memo: dict[int, Any]) -> State:
        state: State = object.__new__(State)
        memo[id(self)] = state
        state.__dict__.update(copy.deepcopy(self.__getstate__(), memo))
        if self.poses:
            state.__dict__["_poses"] = {key: left.copied(memo) for key, left in self.poses.items()}
        return state

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_poses", "_counted")}

    def map(self, function: Callable[[Tensor], Tensor]) -> State:
        """Copy with a function applied to every per-particle tensor; absent fields stay None."""
        return self._map_all(lambda fields: [function(t) for t in fields])

    def _map_all(self, function: Callable[[list[Tensor]], list[Tensor]]) -> State:
        """The same with a function of all tensors together."""
        names = [name for name in PARTICLE_FIELDS if getattr(self, name) is not None]
        results = iter(function([*(getattr(self, name) for name in names), *self.extra.values()]))
        changes: dict[str, Any] = {name: next(results) for name in names}
        state = self.replace(**changes, extra={name: next(results) for name in self.extra})
        return state if self._counted is None or self._counted[2] is None else state.of_scenes(self._counted[2])

    def to(
        self,
        device: torch.device | str | torch.dtype | Tensor | None = None,
        dtype: torch.dtype | None = None,
        non_blocking: bool = False,
    ) -> State:
        """Move to a device, and floating tensors of the particles to a dtype; as `torch.nn.Module.to`.

        `scene`, `ids`, `material` and integers in `extra` keep their dtype, `time` and `impulse` stay in float64.
        Positions in float64 include `x_residual`.

        Args:
            device: a device or its name; or a dtype; or a tensor that gives device and dtype.
            dtype: float32 or float64.
            non_blocking: as in `torch.Tensor.to`.

        Raises:
            TypeError, ValueError: for other arguments.
        """
        if isinstance(device, (torch.dtype, Tensor)):
            if dtype is not None:
                raise TypeError(f"dtype must be given once, got {shape_of(device)} and {dtype}")
            given = device
            device, dtype = (given.device, given.dtype) if isinstance(given, Tensor) else (None, given)
        check_device(device)
        check_dtype(dtype)
        check_flag("non_blocking", non_blocking)

        def moved(t: Tensor, dtype: torch.dtype | None = None) -> Tensor:
            return t.to(device=device, dtype=dtype, non_blocking=non_blocking)

        positions: dict[str, Tensor | None] = {"x_residual": self.x_residual}
        if self.x_residual is not None and dtype not in (None, self.x.dtype):
            positions = _rounded(self.x, self.x_residual, dtype)
        state = self.replace(impulse=None, x_residual=None)
        state = state.map(lambda t: moved(t, dtype if t.is_floating_point() else None))
        state = state.replace(**{name: None if t is None else moved(t) for name, t in positions.items()})
        if isinstance(self.time, Tensor):
            state.time = moved(self.time)
        if self.poses:
            state = state.with_poses({key: left.to(state.x.device) for key, left in self.poses.items()})
        if self.impulse is not None:
            state.impulse = moved(self.impulse)
        return state

    def detach(self) -> State:
        """The same values outside the autograd graph."""
        state = self.map(Tensor.detach)
        if isinstance(self.time, Tensor):
            state.time = self.time.detach()
        if self.impulse is not None:
            state.impulse = self.impulse.detach()
        if self.poses:
            state = state.with_poses({key: left.map(Tensor.detach) for key, left in self.poses.items()})
        return state

    def select(self, particles: Tensor) -> State:
        """The particles of an index tensor, int64 or int32 [Q], in that order; differentiable.

        `ids` go with their particles. A law with parameters per particle needs those of the Q particles in the order of
        `ids`, and ids 0 .. Q − 1, as from `State.concatenate([state])`.
        """
        if not isinstance(particles, Tensor) or particles.dim() != 1 or particles.layout != torch.strided:
            raise ValueError(f"particles must be an index tensor of shape [Q], got {shape_of(particles)}")
        if particles.dtype not in (torch.int32, torch.int64):
            raise TypeError(f"particles must be int32 or int64, got {particles.dtype}")
        if particles.device != self.x.device:
            raise ValueError(f"particles must be on the device of x, {self.x.device}, got {particles.device}")
        return self.map(lambda t: _take(t, particles))

    def sorted(self, grid: Grid) -> State:
        """Reorder by grid block and cell: neighbours in space become neighbours in memory. `ids` store the original
        order.

        Occasional reordering keeps long simulations fast; results differ only by rounding. Differentiable.
        """
        check_grid(grid)
        ids = torch.arange(len(self), device=self.x.device) if self.ids is None else self.ids
        blocks = grid.activate(self.x, self.scene)
        order = torch.ops.torch_mpm.cell_order(self.x.detach(), *blocks.packed)
        state = self if ids is self.ids else self.replace(ids=ids)
        return state._map_all(lambda fields: _take_all(fields, order))

    def restored(self) -> State:
        """State in the order of `ids`, the order before any `sorted`. Differentiable."""
        return self if self.ids is None else self.select(torch.argsort(self.ids))

    def split(self, scenes: int | None = None) -> list[State]:
        """States of the scenes of a batch, the inverse of `concatenate(states, scene=True)`; synchronises.

        Args:
            scenes: number of scenes; None for the largest plus one, or the number of entries of the time.

        Returns:
            States of one scene, in the order of the particles; differentiable. Obstacles are placed anew in them.
        """
        (count,) = _scene_counts([self], None if scenes is None else [scenes])
        of_particle = _scene_of(self)
        parts = [self.select((of_particle == k).nonzero().squeeze(1)) for k in range(count)]
        if isinstance(self.time, Tensor) and self.time.numel() > 1:
            parts = [part.replace(time=self.time[k : k + 1]) for k, part in enumerate(parts)]
        if self.impulse is not None:
            parts = [part.replace(impulse=self.impulse[k : k + 1]) for k, part in enumerate(parts)]
        return [State.concatenate([part.replace(scene=None).with_poses({})]) for part in parts]

    @staticmethod
    def concatenate(states: Sequence[State], scene: bool = False, scenes: Sequence[int] | None = None) -> State:
        """Pack several states into one; differentiable.

        Args:
            states: states of one dimension, dtype and device. Where only some have C, F, J or x_residual, the others
                get the initial values of a step: zero, identity, one, zero.
            scene: False packs parts of one batch with unchanged scenes. True packs batches: the scenes of each state
                follow those of the previous states, and each keeps its time and its impulses. Obstacles are placed anew
                (see `Obstacle.place`).
            scenes: with scene=True, number of scenes of each state. None uses that of its time [B], or else its largest
                scene plus one, which synchronises with the device.

        Returns:
            A state with ids 0 .. P − 1 where one of the states has ids, such that `restored` returns the states one
            after another, each in its own restored order. Parameters [P] are then the concatenated parameters of the
            states.

        Raises:
            TypeError: unless the argument is a list of states.
            ValueError: for an empty list; states of one batch at different times or with different impulses; another
                field that is present in some states only; counts that do not fit.
        """
        states, scene = _checked(states), check_flag("scene", scene)
        counts = [0] * len(states)
        if scene:
            counts = _scene_counts(states, scenes)
            firsts = itertools.accumulate([0, *counts])
            states = [s.replace(scene=_shifted(_scene_of(s), first)) for s, first in zip(states, firsts, strict=False)]
        time = _times_of_scenes(states, counts) if scene else _one_time(states)
        if any(s.ids is not None for s in states):
            befores = itertools.accumulate([0, *(len(s) for s in states)])
            states = [s.replace(ids=_rank(s) + before) for s, before in zip(states, befores, strict=False)]
        impulse = _impulses_of_scenes(states, counts) if scene else _one_impulse(states)
        keys = dict.fromkeys(key for s in states for key in s.extra)
        joined: dict[str, Any] = {name: _joined(name, states) for name in PARTICLE_FIELDS}
        extra = {key: _as_soa(torch.cat([_extra(key, s, k, states) for k, s in enumerate(states)])) for key in keys}
        state = State(**joined, extra=extra, time=time, impulse=impulse)
        poses = next((s.poses for s in states if s.poses), None)
        return state if poses is None or scene else state.with_poses(poses)


FIELDS = tuple(f.name for f in dataclasses.fields(State))
PARTICLE_FIELDS = tuple(name for name in FIELDS if name not in ("extra", "time", "impulse"))
"""Fields with a row per particle, beside those in `extra`."""
_NAMES = frozenset(FIELDS)


class Role(NamedTuple):
    """Role of a field in a step.

    Attributes:
        changed_by: part of a step that changes the field; None for a constant.
        differentiable: whether a step passes gradients to the field. The time has those of dt, see `step.clocks`.
    """

    changed_by: Literal["motion", "heat"] | None
    differentiable: bool


_ROLES = {
    **dict.fromkeys(("x", "v", "C", "F", "J", "impulse", "extra"), Role("motion", True)),
    **dict.fromkeys(("temperature",), Role("heat", True)),
    **dict.fromkeys(("x_residual", "time"), Role("motion", False)),
    **dict.fromkeys(("mass", "volume"), Role(None, True)),
    **dict.fromkeys(("scene", "ids", "material"), Role(None, False)),
}
ROLES = {name: _ROLES[name] for name in FIELDS}
"""Role of each field. Lists of fields for gradients, checkpoints and graphs are derived from it."""
CONSTANTS = tuple(name for name, role in ROLES.items() if role.changed_by is None)
"""Fields that steps do not change."""
TRACKED = tuple(name for name, role in ROLES.items() if role.changed_by and role.differentiable and name != "extra")
"""Fields that steps change and pass gradients to, beside those in `extra`."""
_SYMBOLS = {
    **dict.fromkeys(("mass", "volume", "J", "temperature"), "[P]"),
    **dict.fromkeys(("v", "x_residual"), "[P, D]"),
    **dict.fromkeys(("C", "F"), "[P, D, D]"),
}
"""Shapes of floating fields."""
_NEEDED = ("v", "mass", "volume", "extra")
_INDICES = {"scene": torch.int32, "material": torch.int32, "ids": torch.int64}


def _is_alike(a: Any, b: Tensor) -> bool:
    return a is b or (isinstance(a, Tensor) and a.shape == b.shape and a.dtype == b.dtype and a.device == b.device)


EXTRA = "extra."
"""Prefix of names in `State.extra` where all tensors of a state have names."""


def tensors_of(state: State) -> dict[str, Tensor]:
    """Tensors of a state by name, those of `extra` as "extra.NAME"."""
    fields = {name: getattr(state, name) for name in FIELDS if name != "extra"}
    fields |= {EXTRA + name: value for name, value in state.extra.items()}
    return {name: value for name, value in fields.items() if isinstance(value, Tensor)}


def check_state(state: Any) -> None:
    if not isinstance(state, State):
        raise TypeError(f"state must be a State, got {shape_of(state)}")
    if not torch.compiler.is_compiling() and torch._C._are_functorch_transforms_active():
        for name in ("x", "v", "mass", "F"):
            refuse_batched(f"state.{name}", getattr(state, name))


def _count_scenes(state: State) -> int | None:
    """Number of scenes of a state that was not prepared by a step, see `State.scenes`."""
    if isinstance(state.time, Tensor) and state.time.numel() > 1:
        return state.time.numel()
    if state.impulse is not None:
        return state.impulse.shape[0]
    if state.scene is None:
        return 1
    if is_traced(state.scene) or is_captured(state.scene):
        return None
    return scenes_up_to(state.scene)


def _check_extra(extra: Any, particles: int) -> None:
    if not isinstance(extra, dict):
        raise TypeError(f"extra must be a dict of tensors [P, ...], got {shape_of(extra)}")
    for name, value in extra.items():
        if not isinstance(value, Tensor) or value.shape[:1] != (particles,):
            raise ValueError(f"extra[{name!r}] must have {particles} rows, got {shape_of(value)}")


def _check_impulse(impulse: Any, x: Tensor) -> None:
    D = x.shape[1]
    width = D + (1 if D == 2 else 3)
    if not isinstance(impulse, Tensor) or impulse.dim() != 3 or impulse.shape[2] != width:
        raise ValueError(f"impulse must have shape [B, K, {width}], got {shape_of(impulse)}")
    if impulse.dtype != torch.float64:
        raise TypeError(f"impulse must be float64, as a sum over many steps, got {impulse.dtype}")
    if impulse.device != x.device:
        raise ValueError(f"impulse must be on the device of x, {x.device}, got {impulse.device}")


# ---- joining


def _shifted(scene: Tensor, first: int) -> Tensor:
    """Scene indices shifted behind those of other states; absent particles, of scene -1, stay absent."""
    return torch.where(scene < 0, scene, scene + first)


def _checked(states: Sequence[State]) -> list[State]:
    """The states as a list, after a check of their common properties."""
    if not isinstance(states, (list, tuple)):
        raise TypeError(f"states must be a list of State, got {shape_of(states)}")
    if wrong := [s for s in states if not isinstance(s, State)]:
        raise TypeError(f"states must be a list of State, got a list with {shape_of(wrong[0])}")
    if len(states) == 0:
        raise ValueError("states must have at least one State, got none")
    kinds = [(s.x.shape[1], s.x.dtype, s.x.device) for s in states]
    if len(set(kinds)) > 1:
        found = " and ".join(f"{dim}-D {dtype} on {device}" for dim, dtype, device in dict.fromkeys(kinds))
        raise ValueError(f"states must have one dimension, dtype and device, got {found}")
    return list(states)


def _scene_of(state: State) -> Tensor:
    """Scene of each particle, int32 [P], also of a state of one scene."""
    if state.scene is not None:
        return state.scene
    return torch.zeros(len(state), dtype=torch.int32, device=state.x.device)


def _scene_counts(states: Sequence[State], given: Sequence[int] | None) -> list[int]:
    """Number of scenes of each state."""
    if given is not None and (not isinstance(given, (list, tuple)) or len(given) != len(states)):
        raise ValueError(f"scenes must have one count for each of {len(states)} states, got {given}")
    counts = []
    for k, state in enumerate(states):
        several = isinstance(state.time, Tensor) and state.time.numel() > 1
        known = None if given is None else given[k]
        if known is None and several:
            known = len(state.time)  # type: ignore[arg-type]
        last = int(state.scene.max()) if state.scene is not None and len(state) else 0
        if known is not None and check_count(f"scenes[{k}]", known) <= last:
            raise ValueError(f"scenes[{k}] must be above {last}, the largest scene of its state, got {known}")
        counts.append(last + 1 if known is None else known)
    return counts


def _times_of_scenes(states: Sequence[State], counts: Sequence[int]) -> float | Tensor:
    """A number where it is the same for all, otherwise [B]."""
    times = [s.time for s in states]
    if not any(isinstance(t, Tensor) for t in times) and len(set(times)) == 1:
        return times[0]
    x = states[0].x
    rows = [torch.as_tensor(t, dtype=torch.float64, device=x.device).reshape(-1) for t in times]
    return torch.cat([row.expand(count) for row, count in zip(rows, counts, strict=True)])


def _one_time(states: Sequence[State]) -> float | Tensor:
    """Time of states that are parts of one batch."""
    first, x = states[0].time, states[0].x
    for other in (s.time for s in states[1:]):
        if other is first:
            continue
        if isinstance(first, Tensor) or isinstance(other, Tensor):
            a, b = (torch.as_tensor(t, dtype=torch.float64, device=x.device) for t in (first, other))
            same = bool((a == b).all())
        else:
            same = first == other
        if not same:
            raise ValueError(
                f"states of one batch must have one time, got {first} and {other}: set it with replace(time=...), or "
                "pass scene=True for states that are scenes of their own"
            )
    return first


def _impulses_of_scenes(states: Sequence[State], counts: Sequence[int]) -> Tensor | None:
    impulses = [s.impulse for s in states]
    if all(i is None for i in impulses):
        return None
    shape = next(i.shape[1:] for i in impulses if i is not None)
    for k, (impulse, count) in enumerate(zip(impulses, counts, strict=True)):
        if impulse is None or impulse.shape != (count, *shape):
            expected = [count, *shape]
            raise ValueError(f"impulse of state {k} must have shape {expected} as that of others, got {impulse!r:.80}")
    return torch.cat([i for i in impulses if i is not None])


def _one_impulse(states: Sequence[State]) -> Tensor | None:
    """Impulse of the parts of one batch that have one."""
    found = [s.impulse for s in states if s.impulse is not None]
    for other in found[1:]:
        if other is not found[0] and not torch.equal(other, found[0]):
            raise ValueError("states of one batch must have one impulse: set that of all but one of them to None")
    return found[0] if found else None


def _rank(state: State) -> Tensor:
    """Index of each particle in the restored order of its state, int64 [P]."""
    places = torch.arange(len(state), device=state.x.device)
    return places if state.ids is None else torch.empty_like(places).scatter_(0, torch.argsort(state.ids), places)


def _joined(name: str, states: Sequence[State]) -> Tensor | None:
    """A field of all states, with the initial values of a step where absent; None where no state has it."""
    values = [getattr(s, name) for s in states]
    if all(v is None for v in values):
        return None
    make = {
        "C": _no_motion,
        "F": identity_deformation,
        "J": lambda x: torch.ones_like(x[:, 0]),
        "x_residual": torch.zeros_like,
    }.get(name)
    if make is not None:
        values = [make(s.x.detach()) if v is None else v for s, v in zip(states, values, strict=True)]
    lacks = next((k for k, v in enumerate(values) if v is None), None)
    if lacks is not None:
        has = next(k for k, v in enumerate(values) if v is not None)
        raise ValueError(f"state {lacks} has no {name}, which state {has} has: set it with replace({name}=...)")
    return _as_soa(torch.cat(values))


def _extra(key: str, state: State, number: int, states: Sequence[State]) -> Tensor:
    if key not in state.extra:
        has = next(k for k, s in enumerate(states) if key in s.extra)
        raise ValueError(
            f"state {number} has no extra[{key!r}], which state {has} has: set it, or join the results of "
            "step.prepare for the states"
        )
    return state.extra[key]


def _rounded(x: Tensor, residual: Tensor, dtype: torch.dtype) -> dict[str, Tensor | None]:
    """Compensated positions in another dtype, with their residual in float32."""
    exact = x.double() + residual
    if dtype == torch.float64:
        return {"x": exact, "x_residual": None}
    rounded = exact.to(dtype)
    return {"x": rounded, "x_residual": (exact - rounded).detach().to(dtype)}


def _no_motion(x: Tensor) -> Tensor:
    P, D = x.shape
    return x.new_zeros(P, D, D)


def _given_velocity(velocity: Any, P: int, D: int) -> Tensor:
    """[D] or [P, D]."""
    if not isinstance(velocity, Tensor):
        if isinstance(velocity, (list, tuple)) and any(isinstance(part, Tensor) for part in velocity):
            raise TypeError("velocity must be numbers or one tensor, got tensors in a list: stack them (torch.stack)")
        try:
            velocity = torch.as_tensor(velocity, dtype=torch.float64, device="cpu")
        except (TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise TypeError(f"velocity must be {D} numbers or a tensor, got {velocity!r}") from error
        if not bool(velocity.isfinite().all()):
            raise ValueError(f"velocity must be finite, got {velocity.tolist()}")
    if tuple(velocity.shape) not in ((D,), (P, D)):
        raise ValueError(f"velocity must have shape [D] = [{D}] or [P, D] = [{P}, {D}], got {shape_of(velocity)}")
    return velocity


def _checked_density(density: float | Tensor, particles: int) -> float | Tensor:
    if not isinstance(density, Tensor):
        positive = check_number("density", density, "positive and finite", lambda v: 0 < v < math.inf, NUMBER_OR_TENSOR)
        return float(positive)
    if density.shape not in ((), (particles,)):
        raise ValueError(f"density must be a number or have shape [P] = [{particles}], got {shape_of(density)}")
    values = density.detach()
    bad = values[~((values > 0) & (values < math.inf))]
    if bad.numel():
        raise ValueError(f"density must be positive and finite, got {float(bad[0])}")
    return density


def _as_soa(t: Tensor) -> Tensor:
    """Same values with a contiguous particle index."""
    if t.dim() == 1:
        return t.contiguous()
    axes = (*range(1, t.dim()), 0)
    return t.permute(axes).contiguous().permute(t.dim() - 1, *range(t.dim() - 1))


def _take(t: Tensor, particles: Tensor) -> Tensor:
    """Rows of a [P, ...] tensor with a contiguous particle index."""
    if t.dim() == 1:
        return t.index_select(0, particles)
    taken = t.flatten(1).mT.index_select(1, particles).mT  # Ten times faster than `index_select` of [P, ...].
    return taken if t.dim() == 2 else taken.view(particles.shape[0], *t.shape[1:])


def _take_all(fields: Sequence[Tensor], particles: Tensor) -> list[Tensor]:
    """Rows of many tensors in one call, for particles that are known to exist."""
    if is_tracked(*fields) or any(t.element_size() > 8 or t.layout != torch.strided for t in fields):
        return [_take(t, particles) for t in fields]
    taken: list[Tensor] = dispatch(torch.ops.torch_mpm.take, fields, particles)
    return taken


def identity_deformation(x: Tensor) -> Tensor:
    """F = I for every particle, [P, D, D]."""
    P, D = x.shape
    F = soa_empty(x, (P, D, D)).zero_()
    F.diagonal(dim1=1, dim2=2).fill_(1)
    return F
