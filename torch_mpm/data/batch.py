"""Scenes of a shard simulated together, with one time step, without waiting for the device."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..geometry.values import to_device
from ..grid.grid import Grid
from ..grid.topology import Status
from ..laws import Mixture
from ..laws.thermal import LIQUID
from ..rollouts import rollout
from ..scene import fields, heap
from ..scene.build import Built
from ..state.state import State, _take_all
from .frame_transfer import Array, FrameTransfer, StoredFrames
from .host_copies import Copier, Copies

LOOK = 8
"""Frames between two checks of the stability limit and the validity of the particles, and between two reorderings."""
MOST_SUBSTEPS = 100_000
"""Maximum number of substeps of a frame; a scene that needs more fails."""

OnFrame = Callable[[int], None]
"""Function that is called with the number of each frame."""


class Simulated(NamedTuple):
    """Result of a simulation of scenes [B]."""

    stored: list[StoredFrames]
    """Fields of each scene."""
    failures: list[str]
    """Reason of the failure of each scene; "" for a valid one."""
    shares: list[float]
    """Largest share of the stability limit that the time step had at a check, above 1 for a failed scene. Infinite
    where particles were not finite, outside or inverted, or a solve failed."""


def substeps(built: Built, interval: float, cfl: float, dt: float | None = None) -> list[float]:
    """Number of substeps that each scene [B] needs per frame: with the positions at the start, the speed of a fall, and
    the stiffer of the phases of materials that melt.

    Args:
        built: the scenes.
        interval: time between two frames [s].
        cfl: share of the stability limit.
        dt: upper bound of the time step [s], instead of `cfl`.
    """
    if dt is not None:
        return [math.ceil(interval / dt * (1 - 1e-9))] * built.grid.scenes
    reports = [built.step.stability_report(state) for state in _phases(built, _falling(built))]
    rates: list[float] = torch.stack([report.rate for report in reports]).amax(0).tolist()
    return [max(1.0, math.ceil(interval * rate / cfl * (1 - 1e-9))) if rate < math.inf else rate for rate in rates]


def _falling(built: Built) -> State:
    """State with the additional speed of a fall through the domain, so that the time step is also small enough
    later.
    """
    state, grid = built.state, built.grid
    gravity = built.step.gravity_like(state.x)
    if gravity is None or not len(state):
        return state
    rows = gravity.expand(grid.scenes, -1)
    size = torch.tensor(grid.upper, dtype=state.x.dtype, device=state.x.device) - torch.tensor(
        grid.lower, dtype=state.x.dtype, device=state.x.device
    )
    strength = rows.norm(dim=1, keepdim=True)
    down = rows / strength.clamp_min(1e-30)
    added = down * (2 * (rows.abs() * size).sum(1, keepdim=True)).sqrt()  # v² = 2 g h
    return state.replace(v=state.v + (added[0] if state.scene is None else added[state.scene.long()]))


def _phases(built: Built, state: State) -> list[State]:
    """The state with all particles solid and with all liquid, where materials melt; otherwise the state.

    Tangent modulus and viscosity are between those of the phases.
    """
    extra = built.step.prepare(state).extra
    if LIQUID not in extra:
        return [state]
    return [state.replace(extra={**extra, LIQUID: torch.full_like(extra[LIQUID], share)}) for share in (0.0, 1.0)]


def particles_of(built: Built) -> list[int]:
    """Number of particles of each scene."""
    if built.state.scene is None:
        return [len(built.state)]
    return torch.bincount(built.state.scene.long(), minlength=built.grid.scenes).tolist()


def shapes_of(names: Sequence[str], dim: int) -> dict[str, tuple[int, ...]]:
    """Shape per particle of fields by name."""
    return {name: (dim,) * (1 if name in ("position", "velocity") else fields.RANKS[name]) for name in names}


@torch.inference_mode()
def simulate(
    built: Built,
    names: Sequence[str],
    frames: int,
    interval: float,
    count: int,
    on_frame: OnFrame | None = None,
    executor: Executor | None = None,
    packed: Sequence[bool] | None = None,
    behind: Sequence[Mapping[str, Array]] | None = None,
) -> Simulated:
    """Simulate all scenes of a batch.

    Args:
        built: the scenes; their step is consumed.
        names: fields to store, with the names of `torch_mpm.scene.fields`.
        frames: T, including the first.
        interval: time between two frames [s].
        count: substeps per frame.
        on_frame: called after each frame has been queued.
        executor, packed, behind: as in `FrameTransfer`.
    """
    _leave_room(built)
    while True:
        shapes = shapes_of(names, built.grid.dim)
        transfer = FrameTransfer(frames, particles_of(built), shapes, built.state.x.device, executor, packed, behind)
        try:
            reports = _run(built, transfer, names, frames, interval, count, on_frame)
            stored = [] if reports is None else transfer.finish()
        except BaseException:
            transfer.abandon()
            raise
        if reports is not None:
            return Simulated(stored, *_failures(built, reports, interval / count, frames))
        transfer.abandon()


def _run(
    built: Built, transfer: FrameTransfer, names: Sequence[str], frames: int, interval: float, count: int,
    on_frame: OnFrame | None,
) -> Tensor | None:  # fmt: skip
    """Queue all frames; returns the results of reports, float64 [reports, 3, B] on the device. None where particles
    were without nodes; the pool of blocks is larger then."""
    step, state, reports = built.step, step_ready(built), []
    pool = _PoolWatch(built.grid) if _grows_late(built) else None
    order = torch.argsort(state.ids)  # type: ignore[arg-type]
    for frame in range(frames):
        if frame:
            state = rollout(step, state, count, interval / count).replace(time=frame * interval)
        if frame % LOOK == 0 or frame == frames - 1:
            if pool is not None and not pool.look(step.status):
                return None
            state = step.sorted(state)
            order = torch.argsort(state.ids)  # type: ignore[arg-type]
            reports.append(torch.stack(step.stability_report(state)))
            if state.x.is_cpu:
                heap.trim()
        taken = _take_all([_field(built, state, name) for name in names], order)
        transfer.put(dict(zip(names, taken, strict=True)))
        if on_frame is not None:
            on_frame(frame)
    if pool is not None and not pool.finish():
        return None
    return torch.stack(reports)


def step_ready(built: Built) -> State:
    """First state, in a step without earlier failures."""
    built.step.reset()
    return built.step.prepare(built.state)


def _field(built: Built, state: State, name: str) -> Tensor:
    """Field of all particles of a batch: missing fields of a material follow from its other fields."""
    if name in ("F", "J"):
        return _deformation(built, state, name)
    value = fields.field(built.step, state, name)
    return state.mass.new_zeros(len(state)) if value is None else value  # Nothing has melted.


def _deformation(built: Built, state: State, name: str) -> Tensor:
    """F, which is J^(1/D) I for a law of J, or J, which is det F for a law of F."""
    law, dim = built.step.law, built.grid.dim
    laws: list[Any] = list(law.laws) if isinstance(law, Mixture) else [law]
    value: Tensor | None = getattr(state, name)
    if value is not None and all(name in part.state_fields for part in laws):
        return value
    if name == "J":
        assert state.F is not None
        other = torch.linalg.det(state.F)
    else:
        assert state.J is not None
        eye = torch.eye(dim, dtype=state.x.dtype, device=state.x.device)
        other = state.J.clamp_min(0).pow(1 / dim)[:, None, None] * eye
    if value is None or state.material is None:
        return other
    has = to_device(torch.tensor([name in part.state_fields for part in laws], device="cpu"), state.x.device)
    return torch.where(has[state.material.long()].reshape(-1, *(1,) * (value.dim() - 1)), value, other)


# ---- number of blocks


def _grows_late(built: Built) -> bool:
    """Whether the pool of blocks follows the scene with a delay, in which particles may be without nodes."""
    return built.grid.grows and built.state.x.is_cuda


def _leave_room(built: Built) -> None:
    """Number of blocks for bodies that disintegrate, so that the device need not be queried during the simulation."""
    if _grows_late(built):
        built.grid.follow(2 * built.grid.pool(built.state.x, built.state.scene))


class _PoolWatch:
    """Looks at the pool of blocks of a grid, which grows ahead of the scene there.

    A look reads the status of the previous one, whose copy has arrived by then, so that the device has work meanwhile.
    """

    def __init__(self, grid: Grid) -> None:
        self._grid, self._copier = grid, Copier()
        self._least = grid.max_blocks
        """Smallest pool since the latest look."""
        self._pending: tuple[Copies, int | None] | None = None

    def look(self, status: Tensor | None) -> bool:
        """Whether all particles had nodes until the previous look.

        Args:
            status: that of the step now; None before the first step.
        """
        enough = self.finish()
        if status is not None:
            self._pending = self._copier.begin({"all": status[0].clone()}), self._least
        self._least = self._grid.max_blocks
        return enough

    def finish(self) -> bool:
        """Whether all particles had nodes until the latest look; otherwise the pool is enlarged. It also grows where
        more than half of it is in use."""
        if self._pending is None:
            return True
        (copies, least), self._pending = self._pending, None
        assert least is not None
        row = copies.arrays()["all"].tolist()
        wanted = row[Status.BLOCKS_WANTED]
        # The pool may have grown in time, or that of a call was larger: no activation has a problem then.
        enough = wanted <= least or row[Status.PROBLEM_ACTIVATION] < 0
        self._grid.follow(2 * (row[Status.BLOCKS_NOW] if enough else wanted))
        return enough


# ---- failures


def _failures(built: Built, reports: Tensor, dt: float, frames: int) -> tuple[list[str], list[float]]:
    """Reason of the failure of each scene and its share of the limit, as in `Simulated`. Waits for the device."""
    texts: list[list[str]] = [[] for _ in range(built.grid.scenes)]
    for problem in built.step.failures().problems.values():
        for scene, number in enumerate(problem.count.tolist()):
            if number:
                texts[scene].append(f"{number} {problem.what}")
    shares = [math.inf if text else 0.0 for text in texts]
    for look, (rates, _, wrong) in enumerate(reports.tolist()):
        frame = min(look * LOOK, frames - 1)
        for scene, text in enumerate(texts):
            share = dt * rates[scene]
            shares[scene] = max(shares[scene], share if share < math.inf and not wrong[scene] else math.inf)
            if not text and wrong[scene]:
                text.append(f"{wrong[scene]:.0f} particles were not finite, outside or inverted by frame {frame}")
            elif not text and not share <= 1:
                text.append(f"the time step {dt:.3g} s was above the limit by frame {frame}")
    return ["; ".join(text) for text in texts], shares
