"""Batch as environments: scenes side by side, each with a separate clock, and each replaceable.

    envs = mpm.Environments(step, [scene() for _ in range(1024)])    # step.grid.scenes = 1024
    for k in range(steps):
        paddle.position = policy(envs.observe("x"))                  # [B, D], where it is after the next call
        envs.advance(20, dt=1e-4)                                    # in which it moves there, and pushes
        force = envs.forces()[paddle].linear                         # [B, D] [N], the mean over these 20 steps
        envs.freeze()                                                # failed scenes are not advanced until their reset
        envs.reset(envs.frozen | done(force))                        # bool [B] on the device: as they were at first

The particles of scene b have the rows [b R, (b + 1) R) of the state. Unused rows are absent particles: their `scene` is
-1, they take part in nothing, and cost little. So a scene may be replaced in place by one of another size, without an
allocation and without waiting for the device. Parameters, gravity and poses of obstacles may differ between scenes [B],
and an obstacle may be in one scene only.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..boundaries.impulses import Impulses
from ..errors import check_count, shape_of
from ..geometry.values import to_device
from ..ops.arguments import split_dt
from ..state.state import EXTRA, PARTICLE_FIELDS, State, check_state, tensors_of
from ..step.pause import standing
from ..step.step import Step
from .run import rollout

ABSENT = -1
"""`State.scene` of an absent particle (csrc/grid/activate.h)."""


FROZEN = "frozen rows"
"""Name in a file: whether the scene of each row is frozen."""


class Environments:
    """B scenes in one state.

    Args:
        step: step of a grid of B scenes.
        states: initial states, B states of one scene each. They may differ in size, and get the union of their fields.
            Tensors shared with the caller are copied.
        room: rows of each scene R; None for the largest number of particles of a state.

    Attributes:
        state: all scenes. `reset` overwrites its fields where none requires a gradient: clone a state that must stay.
            It may be replaced by one with the same number of particles, such as with another velocity; if its time is
            a tensor [B], the clocks follow it, and a number is replaced by the clocks. Absent particles have no volume,
            and a mass of one.
        time: time of each scene since it began [B] [s], float64; that of `state`.
        frozen: scenes that are not advanced until they are reset, bool [B].

    Differentiable as `rollout`, from call to call, by everything in the step and the states that requires a gradient.
    The memory grows with each call until `detach`: without a loss, advance under `torch.no_grad()`.

    Raises:
        TypeError, ValueError: for another number of states than the grid has scenes, or a state without room.
    """

    def __init__(self, step: Step, states: Sequence[State], room: int | None = None) -> None:
        if not isinstance(step, Step):
            raise TypeError(f"step must be a Step, got {shape_of(step)}")
        if not isinstance(states, (list, tuple)) or len(states) != step.grid.scenes:
            count = len(states) if isinstance(states, (list, tuple)) else shape_of(states)
            raise ValueError(f"states must be a list of the {step.grid.scenes} scenes of the grid, got {count}")
        if step.grid.scenes == 0:
            raise ValueError("states must have at least one scene, got none")
        for k, state in enumerate(states):
            if not isinstance(state, State):
                raise TypeError(f"states[{k}] must be a State, got {shape_of(state)}")
            check_state(state)
        self.step = step
        self.room = max(len(s) for s in states) if room is None else check_count("room", room)
        self.first = self.pack(states)
        """The scenes that `reset` uses by default."""
        state = self._placed(self.first.map(torch.clone))
        device = state.x.device
        self._state = state.replace(time=torch.zeros(step.grid.scenes, dtype=torch.float64, device=device))
        self.frozen = torch.zeros(step.grid.scenes, dtype=torch.bool, device=device)
        # Whether a scene was ever frozen: laws change its rows in each step, which are then restored.
        self._froze = False
        self._before: tuple[Tensor, Tensor] | None = None

    def __len__(self) -> int:
        return self.step.grid.scenes

    @property
    def state(self) -> State:
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        time = state.scene_time
        self._state = state if time is not None and time.shape == (len(self),) else state.replace(time=self.time)

    @property
    def time(self) -> Tensor:
        time = self._state.scene_time
        assert time is not None
        return time

    def pack(self, states: Sequence[State]) -> State:
        """Scenes for repeated use by `reset`: n states of one scene each, R rows for each, `scene` 0 or -1.

        Raises:
            TypeError, ValueError: for a state of several scenes or without room, or of another dtype or device.
        """
        rows = []
        for k, state in enumerate(states):
            if len(state) > self.room:
                raise ValueError(f"states[{k}] must have at most {self.room} particles, the room of a scene, "
                                 f"got {len(state)}")  # fmt: skip
            if isinstance(state.time, Tensor) and state.time.numel() > 1:
                raise ValueError(f"states[{k}] must be of one scene, got {state.time.numel()}")
            rows.append(_in_room(state.replace(impulse=None, ids=None, time=0.0), self.room))
        packed = State.concatenate(rows)
        return self._with_fields(packed)

    def _with_fields(self, state: State) -> State:
        """Add the fields that steps create and store, so that all scenes have the same fields.

        Scenes are prepared side by side, as the first ones of the grid, since fields of a step may depend on a grid.
        """
        present, B = state.scene, len(self) * self.room
        groups = [state.select(rows) for rows in torch.arange(len(state), device=state.x.device).split(B)]
        state = State.concatenate([self.step.prepare(self._placed(group)) for group in groups])
        made = {name: value.nan_to_num(nan=0.0) for name, value in state.extra.items()}  # Absent particles.
        keeps_C = self.step._keeps_C
        C = state.C if keeps_C else None
        if keeps_C and C is None:
            C = torch.zeros_like(state.x[:, :, None].expand(-1, -1, state.x.shape[1]))
        return state.replace(scene=present, C=C, extra=made)

    def _placed(self, packed: State, index: Tensor | None = None) -> State:
        """Packed scenes with their numbers, or those of an index [n], as the scene of their particles."""
        own = torch.arange(len(self), dtype=torch.int32, device=packed.x.device)
        own = own[: len(packed) // self.room] if index is None else own[index]
        own = own[:, None].expand(-1, self.room).reshape(-1)
        assert packed.scene is not None
        return packed.replace(scene=torch.where(packed.scene == ABSENT, ABSENT, own))

    # ---- steps and resets

    def advance(self, n: int, dt: float | Tensor) -> None:
        """Compute n steps of dt [s], a number or a tensor [B]; see `rollout`. Frozen scenes are not advanced.

        An obstacle moves to a pose that was assigned since the previous call, and reaches it at the end of this one;
        see `Obstacle`.
        """
        check_count("n", n)
        state, time = self.state, self.time
        split_dt(dt, len(self), state.x)  # checks dt
        elapsed = dt.double() if isinstance(dt, Tensor) else torch.full_like(time, dt)
        elapsed = torch.where(self.frozen | ~(elapsed > 0), 0.0, n * elapsed)
        # Steps with a tensor time take longer.
        after = rollout(self.step, state if self.step.reads_time else state.replace(time=0.0), n, dt)
        after = after.replace(time=time + elapsed)
        self.state = standing(state, after, self.present.reshape(-1)) if self._froze else after
        self._before = None if state.impulse is None else (state.impulse, elapsed)

    @property
    def failed(self) -> Tensor:
        """Scenes with any problem since they began, bool [B] on the device; see `Step.failures`."""
        return self.step.failures(self.state).failed

    def detach(self) -> None:
        """Cut the gradient here: later losses have no gradient from previous steps, whose memory is freed."""
        self.state = self.state.detach()
        if self._before is not None:
            self._before = self._before[0].detach(), self._before[1].detach()

    def freeze(self, which: Any = None) -> None:
        """Freeze scenes until they are reset: those of a bool [B] or of indices; None for all that failed.

        Their particles take part in nothing and cost little. They keep their positions and deformations, and lose their
        velocities.
        """
        self.frozen = self.frozen | (self.failed if which is None else self._mask(self._which(which)))
        absent = self.frozen.repeat_interleave(self.room)
        self.state = self.state.replace(scene=self.state.scene.masked_fill(absent, ABSENT))  # type: ignore[union-attr]
        self._froze = True

    def reset(self, which: Any, states: State | Sequence[State] | None = None) -> None:
        """Replace scenes in place; the others are unchanged, bit by bit. Clocks restart.

        In these scenes obstacles are placed: the next call of `advance` begins with them at their present poses,
        without a motion to them. Gradients end at replaced scenes, and pass through the others.

        Args:
            which: bool [B], which may be on the device, or indices of scenes.
            states: None for the initial states. Otherwise a list, or the result of `pack` of one, with a state for each
                index in turn; with a mask, one for each of the B scenes; only those in the mask are used.

        Raises:
            TypeError, ValueError: for states without room, or another number of them.
        """
        which = self._which(which)
        mask = self._mask(which)
        index = None if which.dtype == torch.bool else which
        if isinstance(states, State) and states.scene is None:
            states = [states]
        given = self.first if states is None else states if isinstance(states, State) else self.pack(states)
        if index is not None and states is None:
            given = given.select(_rows_of(index, self.room))
        count = len(self) if index is None else len(index)
        if len(given) != count * self.room:
            raise ValueError(f"states must be {count}, one for each scene to reset, got {len(given) // self.room}")
        changes: dict[str, Tensor] = {}
        pairs = _pairs(self.state, self._placed(given, index))
        # Autograd saves fields without copying them.
        in_graph = any(t.requires_grad for _, *both in pairs for t in both)
        for name, old, new in pairs:
            rows = self._rows(old)
            of_mask = mask.reshape(-1, *(1,) * (rows.dim() - 1))
            if in_graph:
                new = self._rows(new) if index is None else rows.index_copy(0, index, self._rows(new))
                changes[name] = torch.where(of_mask, new, rows).flatten(0, 1)
            elif index is None:
                torch.where(of_mask, self._rows(new), rows, out=rows)
            else:
                rows.index_copy_(0, index, self._rows(new))
        extra = {name: changes.pop(name, value) for name, value in self.state.extra.items()}
        self.state = self.state.replace(**changes, extra=extra)
        self._restart(mask)

    def _restart(self, mask: Tensor) -> None:
        """Set clocks, impulses and status of the scenes of a mask to their initial values."""
        self.frozen = self.frozen & ~mask
        poses = {key: left.without(mask) for key, left in self.state.poses.items()}
        self.state = self.state.replace(time=torch.where(mask, 0.0, self.time)).with_poses(poses)
        if self.state.impulse is not None:
            self.state = self.state.replace(impulse=self.state.impulse.masked_fill(mask[:, None, None], 0.0))
        if self._before is not None:
            before, elapsed = self._before
            self._before = torch.where(mask[:, None, None], 0.0, before), torch.where(mask, 0.0, elapsed)
        self.step.forget_failures(mask)

    def _which(self, which: Any) -> Tensor:
        """Scenes as a mask bool [B] or as indices int64 [n] on the device, without waiting for it."""
        which = which if isinstance(which, Tensor) else torch.as_tensor(which, device="cpu")
        if which.dtype == torch.bool:
            if which.shape != self.time.shape:
                raise ValueError(f"a mask of scenes must have shape [B] = [{len(self)}], got {shape_of(which)}")
            return to_device(which, self.time.device)
        if which.numel() and (which.is_floating_point() or which.is_complex()):
            raise TypeError(f"scenes must be a mask or whole numbers, got {which.dtype}")
        if which.is_cpu and which.numel() and not (0 <= int(which.min()) and int(which.max()) < len(self)):
            raise ValueError(f"scenes must be from 0 to {len(self) - 1}, got {which.tolist()}")
        return to_device(which.reshape(-1), self.time.device, torch.int64)

    def _mask(self, which: Tensor) -> Tensor:
        """Mask bool [B] of scenes."""
        return which if which.dtype == torch.bool else torch.zeros_like(self.frozen).index_fill_(0, which, True)

    # ---- values of particles and boundaries

    def _rows(self, value: Any) -> Tensor:
        """A field [n R, ...] as [n, R, ...]."""
        rows: Tensor = value.unflatten(0, (-1, self.room))
        return rows

    @property
    def present(self) -> Tensor:
        """Rows of present particles, bool [B, R]; none of a frozen scene."""
        return torch.ne(self._rows(self.state.scene), ABSENT)

    def observe(self, name: str, padded: bool = True) -> Tensor:
        """Field of the particles, of `State` or `state.extra`.

        Args:
            name: name of the field.
            padded: [B, R, ...] with zero for absent particles, see `present`; or packed [P, ...], scene after scene,
                which waits for the device.

        Raises:
            ValueError: for an unknown field.
        """
        value = self.state.extra.get(name, getattr(self.state, name, None) if name in PARTICLE_FIELDS else None)
        if value is None:
            raise ValueError(f"name must be that of a field of the particles, got {name!r}")
        if not padded:
            return value[self.present.reshape(-1)]
        rows = self._rows(value)
        return torch.where(self.present.reshape(*rows.shape[:2], *(1,) * (rows.dim() - 2)), rows, 0)

    def count_impulses(self) -> None:
        """Count the impulses of the material on boundaries and walls from now on; see `torch_mpm.impulses`."""
        self.state, self._before = self.step.with_impulses(self.state), None

    def forces(self) -> Impulses:
        """Mean force [N] and torque [N m] on boundaries and walls over the latest `advance`; zero in frozen scenes.

        Raises:
            ValueError: where impulses are not counted, or no step was computed since they are.
        """
        if self._before is None:
            raise ValueError("impulses must be counted (count_impulses) when scenes are advanced, got none")
        before, elapsed = self._before
        rate = torch.where(elapsed > 0, 1 / elapsed, 0.0)[:, None, None]
        change = self.step.impulses(self.state).values - before
        return Impulses(torch.where(rate > 0, rate * change, 0.0), tuple(self.step.boundaries.entries))

    def scene(self, k: int) -> State:
        """A copy of one scene, without its absent particles; waits for the device."""
        if not isinstance(k, int) or not 0 <= k < len(self):
            raise ValueError(f"k must be a scene from 0 to {len(self) - 1}, got {k!r}")
        rows = torch.arange(k * self.room, (k + 1) * self.room, device=self.time.device)
        rows = rows[self.state.volume[rows] != 0]
        impulse = None if self.state.impulse is None else self.state.impulse[k : k + 1].clone()
        one = self.state.replace(impulse=None).select(rows).with_poses({})
        return one.replace(scene=None, time=float(self.time[k]), impulse=impulse)

    # ---- files

    def save(self, path: str | Path, k: int | None = None) -> None:
        """Write all scenes, or scene k only, to an HDF5 file with checksums; needs h5py."""
        from ..state.state_file import save

        if k is None:
            frozen = {EXTRA + FROZEN: self.frozen.int().repeat_interleave(self.room)}
            tensors, record = tensors_of(self.state) | frozen, {"time": 0.0}
        else:
            one = self.scene(k)
            tensors, record = tensors_of(one), {"time": float(one.time)}
        save(Path(path), {name: t.cpu() for name, t in tensors.items()}, record)

    @torch.no_grad()
    def load(self, path: str | Path, k: int | None = None) -> None:
        """Read a file of `save`: all scenes, with equal numbers of rows; or one, which replaces scene k.

        Raises:
            DamagedFileError: for a file that is damaged or holds something else.
            ValueError: for another number of particles or other fields.
        """
        from ..state.state_file import load

        state, _ = load(Path(path), self.time.device, "save the environments anew")
        frozen = state.extra.pop(FROZEN, None)
        if k is not None:
            if frozen is not None:
                raise ValueError(f"{path} must hold one scene, got all scenes of a batch")
            self.reset([k], [state])
            self.time[k] = state.time
            if state.impulse is not None and self.state.impulse is not None:
                self.state.impulse[k] = state.impulse[0]
            return
        if frozen is None or len(state) != len(self.state):
            raise ValueError(f"{path} must hold {len(self)} scenes of {self.room} particles, got {len(state)}")
        own = torch.arange(len(self), device=self.time.device).repeat_interleave(self.room)
        time = torch.as_tensor(state.time)
        scene = torch.as_tensor(state.scene)
        if time.shape != self.time.shape or not bool((scene.eq(own) | scene.eq(ABSENT)).all()):
            raise ValueError(f"{path} must hold {len(self)} scenes of {self.room} particles, got others")
        _pairs(self.state, state)
        self.frozen, self._froze = self._rows(frozen)[:, 0] != 0, True
        self.state, self._before = state.replace(time=time), None
        self.step.forget_failures(torch.ones_like(self.frozen))


def _in_room(state: State, room: int) -> State:
    """State with absent particles at the end, at the position of the first particle."""
    count = len(state)
    if count == 0:
        raise ValueError("states must have at least one particle each, got none")
    rows = torch.arange(room, device=state.x.device)
    there = rows < count
    padded = state.select(torch.where(there, rows, 0))
    return padded.replace(
        v=torch.where(there[:, None], padded.v, 0.0),
        volume=torch.where(there, padded.volume, 0.0),
        mass=torch.where(there, padded.mass, 1.0),
        scene=torch.where(there, 0, ABSENT).int(),
    )


def _pairs(state: State, given: State) -> list[tuple[str, Tensor, Tensor]]:
    """Fields of two states of the same form by name."""
    if (given.x.dtype, given.x.device) != (state.x.dtype, state.x.device):
        raise ValueError(f"states must be {state.x.dtype} on {state.x.device}, got {given.x.dtype} on {given.x.device}")
    if (state.x_residual is None) != (given.x_residual is None):  # Steps add these where needed.
        given = given.replace(x_residual=None if state.x_residual is None else torch.zeros_like(given.x))
    old, new = ({name: getattr(s, name) for name in PARTICLE_FIELDS} | s.extra for s in (state, given))
    for name in dict.fromkeys([*old, *new]):
        if (old.get(name) is None) != (new.get(name) is None):
            which = "have no" if new.get(name) is None else "must have no"
            raise ValueError(f"states {which} {name}, unlike those of the other scenes")
    for name, value in old.items():
        if value is not None and (value.shape[1:], value.dtype) != (new[name].shape[1:], new[name].dtype):
            expected = f"{list(value.shape[1:])} {value.dtype}"
            raise ValueError(
                f"{name} of a particle must be {expected}, got {list(new[name].shape[1:])} {new[name].dtype}"
            )
    return [(name, value, new[name]) for name, value in old.items() if value is not None]


def _rows_of(index: Tensor, room: int) -> Tensor:
    """Rows of scenes [n] as one index [n R]."""
    return (index[:, None] * room + torch.arange(room, device=index.device)).reshape(-1)
