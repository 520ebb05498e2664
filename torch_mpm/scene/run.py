"""Run a scene: frames, substeps, emitters, output, progress, resumption."""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..data.hdf5 import h5py_module
from ..data.host_copies import Copier, Copies
from ..data.trajectory import PARTIAL, Layout, Trajectory, TrajectoryWriter
from ..data.whole_files import remove_leftovers
from ..errors import DamagedFileError, SimulationError
from ..grid.topology import Status
from ..laws import Mixture
from ..rollouts import rollout
from ..state import state_file
from ..state.state import State, _take_all, tensors_of
from ..step.stability import LawDiagnostics
from . import fields, heap
from .build import Built
from .diagnose import SceneFailure, replay, wrong
from .folder import CHECKPOINT, LAST_GOOD, claim, finished, locked, output_errors, prepare, record_summary
from .process import StopSignals, prompt_turns
from .scene import Scene
from .substeps import check_substeps
from .writer import Frame, FrameWriter

SEGMENT = 32
"""Substeps between two checks of the stability limit and the validity of the state, and between two reorderings."""
LONGEST_SEGMENT = {"cpu": SEGMENT, "cuda": 512}
"""The same while the limit is steady: a GPU waits at each check."""
UNSTEADY_SEGMENT = {"cpu": SEGMENT, "cuda": 128}
"""The same while it is not; where it was exceeded, the substeps are recomputed in the shortest segments."""
STEADY = 1.02
"""Largest factor by which a steady limit may decrease over a segment."""
LIMITS = 8
"""Number of segments whose smallest limit is used: a dt that followed the present limit would feed energy into
oscillating particles (docs/limitations.md).
"""

LONG_RUN = 10**6
"""Number of substeps from which a run gives notice of those that are left."""
BETWEEN_NOTICES = 60.0
"""Time without a frame after which it does so again [s]."""

Progress = Callable[[dict[str, Any]], None]
Notice = Callable[[str], None]


class Interrupted(RuntimeError):
    """The run was interrupted, and stopped after a complete frame."""


@dataclass
class Totals:
    """Numbers of the summary, stored in the checkpoint so that a resumed run reports them for the whole run."""

    substeps: int = 0
    simulating: float = 0.0
    largest_cfl: float = 0.0
    smallest_dt: float = math.inf
    segment: int = SEGMENT  # maximum number of substeps of the next one
    limits: list[float] = field(default_factory=list)  # limits of dt in the latest `LIMITS` segments [s]
    first: dict[str, Any] = field(default_factory=dict)


def run(
    scene: Scene,
    out: str | Path,
    *,
    resume: bool = False,
    source: str = "",
    progress: Progress | None = None,
    notice: Notice | None = None,
) -> dict[str, Any]:
    """Simulate ``scene`` into the folder ``out``: trajectory, checkpoint, summary.

    Args:
        scene: the scene.
        out: folder, created where it does not exist.
        resume: continue an unfinished run of the same scene; for a complete one, return its summary, which is empty
            where a kill prevented its writing.
        source: text of the scene file, stored in the trajectory; the words of the scene by default.
        progress: called after each frame with a dictionary of its numbers.
        notice: called with a line about the substeps and the time that are left, at the start of a run of more than
            `LONG_RUN` substeps and after each `BETWEEN_NOTICES` without a frame.

    Returns:
        The summary, also in ``run.json``.

    Raises:
        SceneError: for a scene that cannot be simulated.
        OutputError: for a folder with other content or in which another process runs, or a full disk.
        DamagedFileError: for a run to be resumed with damaged files.
        SceneFailure: for a failed simulation; the last good state is in ``last_good.h5``.
        Interrupted: after Ctrl-C or SIGTERM, once the frame is complete, or has taken too long.
    """
    begin = time.perf_counter()
    folder = Path(out)
    h5py_module()
    fingerprint = scene.fingerprint()
    if resume and (summary := finished(folder, fingerprint)) is not None:
        _remove_rest(folder)
        return summary
    with output_errors(folder):
        claim(folder, fingerprint, resume)
    built = scene.build()
    check_substeps(scene, built)
    simulation = Simulation(scene, built, notice)
    layout = simulation.layout(source, fingerprint)
    with StopSignals() as stop, prompt_turns(), output_errors(folder), locked(folder), torch.no_grad():
        claim(folder, fingerprint, resume)  # Again: another process may have worked here before the lock.
        remove_leftovers(folder)
        prepare(folder, scene, layout, fingerprint)
        writer = simulation.open(folder, layout)
        try:
            with stop.within_frames():
                simulation.run(writer, progress, stop)
        except KeyboardInterrupt:
            raise simulation.interrupted() from None
        except SceneFailure as failure:
            kept = _save_last_good(folder, simulation.state, failure)
            raise SceneFailure(f"{failure}\n{kept}", failure.failure) from None
        finally:
            writer.close(finished=simulation.frame == scene.frames)
        summary = simulation.summary(writer, time.perf_counter() - begin)
        record_summary(folder, summary)
        _remove_rest(folder)
    return summary


def _remove_rest(folder: Path) -> None:
    """Remove the checkpoint of a complete run and incomplete files of killed processes."""
    (folder / CHECKPOINT).unlink(missing_ok=True)
    remove_leftovers(folder)


class Shown(NamedTuple):
    """Content of a frame."""

    copies: Copies
    sums: dict[str, Any]


class Segment(NamedTuple):
    """Substeps between two checks of the state."""

    dt: float
    """[s]"""
    steps: int
    until: float
    """Time at the end of the segment [s]."""
    shows: bool
    """Whether a frame ends with the segment."""


class Moved(NamedTuple):
    """State after a segment, reordered."""

    state: State
    report: list[list[float]]
    status: list[list[float]]
    concerns: bool
    """Whether a solve of heat missed its tolerance, or a front lags behind."""
    shown: Shown | None
    """State in the form of a frame."""


class Simulation:
    """Loop over frames. All its decisions depend on the state at the last frame only."""

    def __init__(self, scene: Scene, built: Built, notice: Notice | None = None) -> None:
        self.scene, self.built, self.step = scene, built, built.step
        self._notice = notice
        self._began: tuple[float, int] | None = None  # Clock [s] and substeps at the first substep of this process.
        self._noticed = -math.inf  # Clock at the latest notice or frame [s].
        self.state = built.state
        self.frame = -1
        self.totals = Totals()
        self.emissions = built.emissions()
        self.emitted = 0
        self.fingerprint = ""
        self._figures: dict[str, Any] = {}
        self._report: list[list[float]] | None = None  # Rates, speeds and invalid particles of the present state.
        self._copier = Copier()
        self._shown: Shown | None = None  # Of the present state, at the end of a frame.
        origin = scene.origin
        self._origin = None if origin is None else torch.tensor(origin, dtype=torch.float64, device=self.state.x.device)

    # -- output

    def layout(self, source: str, fingerprint: str) -> Layout:
        """Content of the trajectory of this scene."""
        dim, dtype = self.scene.dim, str(self.state.x.numpy(force=True).dtype)
        vector = ((dim,), dtype)
        place = vector if self.scene.origin is None else ((dim,), "<f8")
        columns: dict[str, tuple[tuple[int, ...], str]] = {"position": place, "velocity": vector}
        columns |= {name: ((dim,) * fields.RANKS[name], dtype) for name in self.scene.trajectory_fields}
        number = ((), "f8")
        scalars = dict.fromkeys(("time", "kinetic_energy", "elastic_energy", "potential_energy", "cfl"), number)
        counts = dict.fromkeys(("particles", "substeps"), ((), "i8"))
        if self.step.heat is not None:
            scalars["heat"] = number
        names = {"material": [m.name for m in self.built.materials]}
        if len(self.built.scenes) > 1:
            names["scene"] = self.built.scenes
        return Layout(
            frames=self.scene.frames + 1,
            particles=self.built.particles,
            fields=columns,
            scalars={**scalars, **counts, "momentum": ((dim,), "f8")},
            statics={name: value.numpy() for name, value in self.built.statics().items()},
            names=names,
            attributes={
                "title": self.scene.title,
                "scene": source or self.scene.model_dump_json(),
                "fingerprint": fingerprint,
                "seed": self.scene.seed,
                **({} if self.scene.origin is None else {"origin": self.scene.origin}),
                "precision": self.scene.precision,
                "device": str(self.state.x.device),
                **versions(),
            },
        )

    def open(self, folder: Path, layout: Layout) -> FrameWriter:
        """Continue from the checkpoint of a folder, or start; returns the writer of its trajectory.

        Raises:
            DamagedFileError: for files that are damaged or do not belong to this run.
        """
        path = folder / CHECKPOINT
        self.fingerprint = str(layout.attributes["fingerprint"])
        with Trajectory(folder / PARTIAL) as trajectory:
            if not layout.describes(trajectory):
                raise DamagedFileError(trajectory.path, "is the trajectory of another scene", state_file.REMEDY)
            if path.exists():
                self._restore(path, layout, len(trajectory))
            trajectory.verify(self.frame + 1)
        writer = TrajectoryWriter(folder / PARTIAL)
        writer.rewind(self.frame + 1)
        return FrameWriter(writer, path)

    def _restore(self, path: Path, layout: Layout, written: int) -> None:
        """Load a checkpoint beside a trajectory of ``written`` frames."""
        state, record = state_file.load(path, self.state.x.device)
        problem = self._unfit(state, record, layout, written)
        if problem:
            raise DamagedFileError(path, problem, state_file.REMEDY)
        self.state, self.frame, self.emitted = state, record["frame"], record["emitted"]
        self.totals = Totals(**record["totals"])

    def _unfit(self, state: State, record: dict[str, Any], layout: Layout, written: int) -> str:
        """Reason why a checkpoint cannot be that of this run; "" if it can."""
        if record.get("fingerprint") != self.fingerprint:
            return "is the checkpoint of another scene"
        frame, emitted, totals = (record.get(name) for name in ("frame", "emitted", "totals"))
        # Checkpoints are rarer than frames, and the disk may lack the last count.
        if type(frame) is not int or not 0 <= frame < layout.frames or not frame <= written:
            return f"is of frame {frame}, which does not fit the {written} frames of the trajectory"
        known = isinstance(totals, dict) and totals.keys() == vars(self.totals).keys()
        if state.time != self.scene.time_of(frame) or not known:
            return "has a record that is not of this run"
        if type(emitted) is not int or not 0 <= emitted <= len(self.emissions):
            return f"has {emitted} layers of {len(self.emissions)} from the emitters"
        count = len(self.state) + sum(len(self.built.nozzles[k].layer) for _, k in self.emissions[:emitted])
        fields = set(tensors_of(self.state)) - set(tensors_of(state))
        if fields or len(state) != count or state.x.dtype != self.state.x.dtype:
            return f"has not the {count} particles of this run with all their fields"
        ids = state.ids.cpu() if state.ids is not None else torch.empty(0)
        if not torch.equal(ids.sort().values, torch.arange(count)):
            return "has ids that are not 0, 1, 2, ..."
        for name in ("mass", "volume", "scene"):
            value = getattr(state, name)
            if value is not None and not torch.equal(value.cpu(), torch.from_numpy(layout.statics[name])[ids]):
                return f"has another {name} of particles than the scene"
        laws = len(self.step.law.laws) if isinstance(self.step.law, Mixture) else 1
        if state.material is not None and count and not 0 <= state.material.min() <= state.material.max() < laws:
            return "has materials that the scene lacks"
        bad = wrong(self.step, state, self.scene.origin)
        return f"has a particle that is not meaningful: {bad[1]}" if bad else ""

    def run(self, writer: FrameWriter, progress: Progress | None, stop: StopSignals) -> None:
        """Compute all missing frames. A device gets its next substeps before the host hands over the last frame."""
        due: Frame | None = None

        def deliver() -> None:
            nonlocal due
            if due is None:
                return
            frame, due = due, None
            writer.submit(frame)
            if progress is not None and frame.number > 0:
                progress(self._figures)
                self._noticed = time.perf_counter()
            self._check_stop(stop)

        if self.frame < 0:
            copies, sums = self._show(self.state, self._law_diagnostics(self.state))
            self._shown = Shown(copies, on_host(sums))
            due = self._complete(0, 0.0, 0.0)
        try:
            self._check_stop(stop)
            while self.frame < self.scene.frames:
                if not self._runs_ahead():
                    deliver()
                begin, before = time.perf_counter(), self.totals.substeps
                cfl = self._advance(self.scene.time_of(self.frame), self.scene.time_of(self.frame + 1), deliver)
                due = self._complete(self.totals.substeps - before, cfl, time.perf_counter() - begin)
        finally:  # Also before a failure in work after the frame.
            deliver()

    def _runs_ahead(self) -> bool:
        """Whether the host continues while substeps are computed."""
        return self.state.x.is_cuda

    def _check_stop(self, stop: StopSignals) -> None:
        if self.frame < self.scene.frames and stop.signal:
            raise self.interrupted()

    def interrupted(self) -> Interrupted:
        """Error of a run that stops now."""
        where = f"after frame {self.frame}" if self.frame >= 0 else "before the first frame"
        return Interrupted(f"stopped {where} of {self.scene.frames}; add --resume to continue")

    def _complete(self, substeps: int, cfl: float, seconds: float) -> Frame:
        """Present state as the next frame, with everything that must not change until it is handed over."""
        assert self._shown is not None
        self.frame += 1
        self.totals.simulating += seconds
        state, (copies, sums), self._shown = self.state, self._shown, None
        scalars = {"time": self.scene.time_of(self.frame), "particles": len(state), "substeps": substeps, "cfl": cfl}
        scalars |= {"potential_energy": 0.0, **sums}
        if not self.totals.first:
            self.totals.first = {k: v for k, v in scalars.items() if k.endswith("energy")}
            self.totals.first |= {"mass": float(state.mass.double().sum())}
        rate = substeps * len(state) / max(seconds, 1e-9)
        self._figures = {"frame": self.frame, **scalars, "frames": self.scene.frames, "rate": rate}
        record = {
            "frame": self.frame,
            "time": float(state.time),
            "emitted": self.emitted,
            "fingerprint": self.fingerprint,
            "totals": dict(vars(self.totals)),
        }
        return Frame(self.frame, copies, scalars, tensors_of(state), record)

    def _show(self, state: State, diagnostics: LawDiagnostics) -> tuple[Copies, dict[str, Tensor]]:
        """Copies and sums of a state for the next frame, without waiting for them."""
        given = self.step.prepare(state)
        assert given.ids is not None
        places = torch.arange(len(given), device=given.x.device)
        order = torch.empty_like(places).scatter_(0, given.ids, places)
        values = {}
        for name in ("position", "velocity", *self.scene.trajectory_fields):
            value = fields.field(self.step, given, name, diagnostics.stress)
            assert value is not None, name  # `build` refuses fields that no material has.
            values[name] = self._in_coordinates(value) if name == "position" else value
        kept = dict(zip(values, _take_all(list(values.values()), order), strict=True))
        return self._copier.begin(kept), energies(self.step, state, diagnostics)

    def _in_coordinates(self, x: Tensor) -> Tensor:
        """Positions in the coordinates of the scene file; in float64 where they are relative to an origin."""
        return x if self._origin is None else x.double() + self._origin

    def _law_diagnostics(self, state: State) -> LawDiagnostics:
        return self.step.diagnostics(fields.with_C(state) if self.step.law.viscous else state)

    # -- time

    def _advance(self, begin: float, end: float, meanwhile: Callable[[], None] = lambda: None) -> float:
        """Advance the state to time ``end``; returns the largest CFL number |v| dt / dx of the substeps.

        ``meanwhile`` is called whenever the host would otherwise only wait for a device.
        """
        now, largest = begin, 0.0
        if self._began is None:
            self._began = time.perf_counter(), self.totals.substeps
        rounding = 1e-9 * (end - begin)
        while now < end - rounding:
            self._emit(now + rounding)
            if self._report is None:
                self.state = self.step.sorted(self.state.replace(time=now))
                self._report = torch.stack(self.step.stability_report(self.state)).tolist()
            rates, speeds, _ = self._report
            following = self.emissions[self.emitted][0] if self.emitted < len(self.emissions) else math.inf
            target = min(end, following) if following > now + rounding else end
            dt, count = self._choose_dt(target - now, rates)
            steps = min(count, self.totals.segment)
            until = target if steps == count else now + steps * dt
            shows = until >= end - rounding
            segment = Segment(dt, steps, end if shows else until, shows)
            if not self._take(segment, meanwhile):
                self.totals.segment = SEGMENT
                continue
            now = segment.until
            self.totals.segment = self._most_after(rates)
            largest = max(largest, max(speeds, default=0.0) * dt / self.step.grid.dx)
            if self.state.x.is_cpu:
                heap.trim()
            self.totals.substeps += steps
            self.totals.smallest_dt = min(self.totals.smallest_dt, dt)
            self._give_notice(now, dt)
        self.totals.largest_cfl = max(self.totals.largest_cfl, largest)
        return largest

    def _give_notice(self, now: float, dt: float) -> None:
        """Notice of a long run, at a simulated time and with the present time step [s]."""
        clock = time.perf_counter()
        left = (self.scene.duration - now) / dt
        if self._notice is None or self._began is None or left < LONG_RUN or clock < self._noticed + BETWEEN_NOTICES:
            return
        self._noticed = clock
        since, before = self._began
        seconds = left * (clock - since) / (self.totals.substeps - before)
        hours = f"{seconds / 3600:.2g} hours" if seconds > 3600 else f"{seconds / 60:.2g} minutes"
        self._notice(
            f"frame {self.frame} of {self.scene.frames}, t = {now:.3g} s: about {left:.2g} substeps of {dt:.2g} s are "
            f"left until {self.scene.duration:g} s, which take some {hours}"
        )

    def _choose_dt(self, span: float, rates: list[float]) -> tuple[float, int]:
        """Time step and number of steps that fill ``span``, for the limits of the scenes [1/s]."""
        rate = max(rates, default=0.0)
        limit = 1 / rate if rate > 0 else math.inf
        if self.scene.dt is not None and self.scene.dt > limit:
            scene = self.built.scenes[rates.index(rate)]
            raise SceneFailure(
                f"{scene + ', ' if scene else ''}step {self.totals.substeps}: dt = {self.scene.dt:g} s is above the "
                f"stability limit {limit:.3g} s; use dt = {0.5 * limit:.2g}, or remove dt and set cfl = 0.5."
            )
        self.totals.limits = [*self.totals.limits, limit][-LIMITS:]
        wanted = self.scene.dt or self.scene.cfl * min(self.totals.limits)
        count = max(1, math.ceil(span / wanted * (1 - 1e-9))) if math.isfinite(wanted) else 1
        return span / count, count

    def _most_after(self, rates: list[float]) -> int:
        """Maximum number of substeps of the next segment, after one that began with these limits."""
        assert self._report is not None
        before, after = max(rates, default=0.0), max(self._report[0], default=0.0)
        device = self.state.x.device.type
        if after > STEADY * before:
            return UNSTEADY_SEGMENT[device]
        return min(2 * self.totals.segment, LONGEST_SEGMENT[device])

    def _take(self, segment: Segment, meanwhile: Callable[[], None]) -> bool:
        """Compute a segment, and check the state at its end; a failure is located by repeating the substeps.

        Returns:
            Whether the segment was accepted: a segment longer than SEGMENT with a failure, or with a dt above the limit
            at its end, is rejected, since in shorter ones dt would have followed the limit.
        """
        good, dt, steps = self.state, segment.dt, segment.steps
        try:
            moved = self._moved(segment, meanwhile)
            if steps > SEGMENT and not dt * max(moved.report[0], default=0.0) <= 1:
                raise SimulationError("dt is above the limit")
            if moved.concerns or any(row[Status.PROBLEM_ACTIVATION] >= 0 for row in moved.status):
                self.step.check()
            bad = wrong(self.step, moved.state, self.scene.origin) if any(moved.report[2]) else None
            if bad is None:
                self._report, self.state, self._shown = moved.report, moved.state, moved.shown
                return True
            message = bad[1]
        except SimulationError as error:
            message = str(error)
        if steps > SEGMENT:
            self.step.reset()
            return False
        failure = replay(self.step, good, dt, steps, self.totals.substeps, self.built.scenes, self.scene.origin)
        if failure is not None:
            self.state = failure.good
        raise SceneFailure(str(failure or message), failure)

    def _moved(self, segment: Segment, meanwhile: Callable[[], None]) -> Moved:
        """State after a segment; recomputed where the pool of blocks was too small, which grows later on CUDA.

        All work of a device is launched before the only wait for it, including that of a frame.
        """
        room = self.step.grid.max_blocks
        end = rollout(self.step, self.state, segment.steps, segment.dt).replace(time=segment.until)
        ordered = self.step.sorted(end)
        diagnostics = self._law_diagnostics(ordered)
        results = {"report": torch.stack(self.step.stability_report(ordered, diagnostics=diagnostics))}
        if self.step.status is not None:
            results["status"] = self.step.status
        if self.step.heat is not None and (of_scenes := self.step.heat.concerns()) is not None:
            results["concerns"] = of_scenes
        copies, sums = self._show(ordered, diagnostics) if segment.shows else (None, {})
        meanwhile()
        found = on_host(results | sums)
        report, status, concerns = found.pop("report"), found.pop("status", []), any(found.pop("concerns", []))
        if self._overflowed(status, room):
            self.step.reset()
            return self._moved(segment, meanwhile)
        return Moved(ordered, report, status, concerns, None if copies is None else Shown(copies, found))

    def _overflowed(self, status: list[list[float]], room: int | None) -> bool:
        """Whether a pool of blocks that grows with the scene, with some margin before a segment, was too small for
        it.
        """
        grid = self.step.grid
        if not status or not grid.grows or room is None:
            return False
        wanted = int(status[0][Status.BLOCKS_WANTED])
        grid.follow(wanted)
        # Calls of the rollout with a larger pool have no problem.
        return wanted > room and status[0][Status.PROBLEM_ACTIVATION] >= 0

    def _emit(self, until: float) -> None:
        """Add the layers that are due."""
        while self.emitted < len(self.emissions) and self.emissions[self.emitted][0] <= until:
            layer = self.built.nozzles[self.emissions[self.emitted][1]].turned(self.emitted)
            ids = torch.arange(len(self.state), len(self.state) + len(layer), device=layer.x.device)
            self.state = joined(self.state, layer.replace(ids=ids))
            self.emitted += 1
            self._report = None

    # -- the end

    def summary(self, writer: FrameWriter, seconds: float) -> dict[str, Any]:
        """Run times of the run, and errors of conserved quantities."""
        first, last = self.totals.first, self._figures
        energy = [sum(v for k, v in values.items() if k.endswith("energy")) for values in (first, last)]
        layers = [self.built.nozzles[k].layer.mass for _, k in self.emissions[: self.emitted]]
        expected = first["mass"] + sum(float(mass.double().sum()) for mass in layers)
        mass = float(self.state.mass.double().sum())
        return {
            "frames": self.frame,
            "particles": len(self.state),
            "substeps": self.totals.substeps,
            "seconds": {
                "total": seconds,
                "simulation": self.totals.simulating,
                "writing, in the background": writer.seconds,
                "waiting for the writer": writer.waited,
            },
            "particles_per_second": self.totals.substeps * len(self.state) / max(self.totals.simulating, 1e-9),
            "energy": {"first": energy[0], "last": energy[1]},
            "mass_drift": (mass - expected) / expected if expected else 0.0,
            "largest_cfl": self.totals.largest_cfl,
            "smallest_dt": self.totals.smallest_dt,
            "particles_lost": self.built.particles - len(self.state),
            **({} if self.built.projected is None else {"particles_projected": self.built.projected.tolist()}),
        }


def joined(state: State, layer: State) -> State:
    """State with additional particles, which appear now."""
    return State.concatenate([state, layer.replace(time=state.time)])


def energies(step: Any, state: Any, diagnostics: LawDiagnostics) -> dict[str, Tensor]:
    """Kinetic, elastic and potential energy [J], momentum [kg m/s] and heat [J] of all particles, summed in float64."""
    mass = state.mass.double()[:, None]
    momentum = mass * state.v
    sums = {
        "kinetic_energy": 0.5 * (momentum * state.v).sum(),
        "elastic_energy": (state.volume * diagnostics.energy).sum(dtype=torch.float64),
        "momentum": momentum.sum(0),
    }
    if step.gravity is not None:
        rows = step.gravity if step.gravity.dim() == 1 else step.gravity.index_select(0, state.scene)
        sums["potential_energy"] = -(mass * state.x * rows).sum()
    if step.heat is not None:
        sums["heat"] = step.heat.heat_content(state).double().sum()
    return sums


def on_host(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Tensors on one device as numbers in float64, lists and nested lists, after one wait for the device."""
    numbers = torch.cat([t.double().flatten() for t in tensors.values()]).cpu().numpy()
    ends = accumulate(t.numel() for t in tensors.values())
    return {
        name: numbers[end - t.numel() : end].reshape(t.shape).tolist()
        for (name, t), end in zip(tensors.items(), ends, strict=True)
    }


def versions() -> dict[str, str]:
    """Versions that a trajectory stores."""
    try:
        own = metadata.version("torch-mpm")
    except metadata.PackageNotFoundError:
        own = "unknown"
    return {"torch_mpm": own, "torch": str(torch.__version__), "python": platform.python_version()}


# ---- failures


def _save_last_good(folder: Path, state: State, failure: SceneFailure) -> str:
    """Store the last good state of a failed run; returns its path."""
    path = folder / LAST_GOOD
    record = {"time": float(state.time), "failure": str(failure)}
    try:
        state_file.save(path, {k: v.cpu() for k, v in tensors_of(state).items()}, record)
    except OSError as error:
        return f"The last good state could not be stored: {error.strerror or error}."
    return f"The state before it is in {path}."
