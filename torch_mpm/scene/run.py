"""Run a scene: frames, substeps, emitters, output, progress, resumption."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import platform
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor

from ..errors import SimulationError
from ..hdf5 import h5py_module
from ..state import State
from ..thermal import LIQUID
from ..trajectory import COMPLETE, PARTIAL, Layout, TrajectoryWriter, create
from . import checkpoint, heap
from .build import Built
from .diagnose import SceneFailure, replay, wrong
from .explain import SceneError
from .scene import Scene
from .writer import FrameWriter

SEGMENT = 32
"""Substeps between two looks at the stability limit and the validity of the state, and between two reorderings."""
FIELD_SHAPES = {"F": 2, "C": 2, "stress": 2, "J": 0, "temperature": 0, "liquid": 0}
RUN, CHECKPOINT, LAST_GOOD = "run.json", "checkpoint.h5", "last_good.h5"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

Progress = Callable[[dict[str, Any]], None]


class OutputError(RuntimeError):
    """The output folder cannot be used, or its disk is full."""


class Interrupted(RuntimeError):
    """The run was asked to stop, and did after a whole frame."""


@dataclass
class Totals:
    """What the summary tells, kept in the checkpoint so that a resumed run tells it of the whole."""

    substeps: int = 0
    simulating: float = 0.0
    largest_cfl: float = 0.0
    smallest_dt: float = math.inf
    first: dict[str, Any] = field(default_factory=dict)


def run(
    scene: Scene,
    out: str | Path,
    *,
    resume: bool = False,
    source: str = "",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Simulate ``scene`` into the folder ``out``: trajectory, checkpoint, summary.

    Args:
        scene: what to simulate.
        out: folder, made where it does not exist.
        resume: go on with an unfinished run of the same scene.
        source: text of the scene file, kept in the trajectory; the words of the scene by default.
        progress: called after each frame with a dictionary of its figures.

    Returns:
        The summary, also in ``run.json``.

    Raises:
        SceneError: for a scene that cannot be simulated.
        OutputError: for a folder that holds something else, or a full disk.
        SceneFailure: for a simulation that went wrong; the state before it is in ``last_good.h5``.
        Interrupted: after Ctrl-C or SIGTERM, once the frame is whole.
    """
    begin = time.perf_counter()
    folder = Path(out)
    h5py_module()
    fingerprint = scene.fingerprint()
    _claim(folder, fingerprint, resume)
    built = scene.build()
    simulation = Simulation(scene, built)
    with _stop_signals() as stop, _disk_errors(folder), torch.no_grad():
        _prepare_folder(folder, scene, built, fingerprint, source)
        writer = simulation.open(folder)
        try:
            simulation.run(writer, progress, stop)
        except SceneFailure as failure:
            path = _save_last_good(folder, simulation.state, failure)
            raise SceneFailure(f"{failure}\nThe state before it is in {path}.", failure.failure) from None
        finally:
            writer.close()
    summary = simulation.summary(writer, time.perf_counter() - begin)
    record_summary(folder, summary)
    (folder / CHECKPOINT).unlink(missing_ok=True)
    return summary


class Simulation:
    """The loop over frames. Everything it decides follows from the state at the last frame."""

    def __init__(self, scene: Scene, built: Built) -> None:
        self.scene, self.built, self.step = scene, built, built.step
        self.state = built.state
        self.frame = -1
        self.totals = Totals()
        self.emissions = built.emissions()
        self.emitted = 0
        self._figures: dict[str, Any] = {}

    # -- output

    def layout(self, source: str, fingerprint: str) -> Layout:
        """What the trajectory of this scene holds."""
        dim, dtype = self.scene.dim, str(self.state.x.numpy(force=True).dtype)
        vector = ((dim,), dtype)
        fields: dict[str, tuple[tuple[int, ...], str]] = {"position": vector, "velocity": vector}
        fields |= {name: ((dim,) * FIELD_SHAPES[name], dtype) for name in self.scene.trajectory_fields}
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
            fields=fields,
            scalars={**scalars, **counts, "momentum": ((dim,), "f8")},
            statics={name: value.numpy() for name, value in self.built.statics().items()},
            names=names,
            attributes={
                "title": self.scene.title,
                "scene": source or self.scene.model_dump_json(),
                "fingerprint": fingerprint,
                "seed": self.scene.seed,
                "precision": self.scene.precision,
                "device": str(self.state.x.device),
                **versions(),
            },
        )

    def open(self, folder: Path) -> FrameWriter:
        """Continue from the checkpoint of a folder, or start; returns the writer of its trajectory."""
        trajectory = TrajectoryWriter(folder / PARTIAL)
        path = folder / CHECKPOINT
        if path.exists():
            self.state, record = checkpoint.load(path, self.state.x.device)
            self.frame, self.emitted = record["frame"], record["emitted"]
            self.totals = Totals(**record["totals"])
        trajectory.rewind(self.frame + 1)
        return FrameWriter(trajectory, path)

    def run(self, writer: FrameWriter, progress: Progress | None, stop: Callable[[], bool]) -> None:
        """All frames that are missing."""
        if self.frame < 0:
            self._put(writer, 0, 0.0)
        while self.frame < self.scene.frames:
            begin, before = time.perf_counter(), self.totals.substeps
            self._check_stop(stop)
            cfl = self._advance(self.scene.time_of(self.frame), self.scene.time_of(self.frame + 1))
            self._put(writer, self.totals.substeps - before, cfl)
            seconds = time.perf_counter() - begin
            self.totals.simulating += seconds
            if progress is not None:
                substeps = self.totals.substeps - before
                rate = substeps * len(self.state) / seconds
                progress({**self._figures, "frames": self.scene.frames, "substeps": substeps, "rate": rate})

    def _check_stop(self, stop: Callable[[], bool]) -> None:
        if stop():
            raise Interrupted(f"stopped after frame {self.frame} of {self.scene.frames}; add --resume to go on")

    def _put(self, writer: FrameWriter, substeps: int, cfl: float) -> None:
        """Hand the present state over as the next frame."""
        self.frame += 1
        state = self.state
        scalars = {"time": self.scene.time_of(self.frame), "particles": len(state), "substeps": substeps, "cfl": cfl}
        scalars |= energies(self.step, state)
        if not self.totals.first:
            self.totals.first = {k: v for k, v in scalars.items() if k.endswith("energy")}
            self.totals.first |= {"mass": float(state.mass.double().sum())}
        self._figures = {"frame": self.frame, **scalars}
        record = {
            "frame": self.frame,
            "time": float(state.time),
            "emitted": self.emitted,
            "totals": vars(self.totals),
        }
        writer.submit(self.frame, self._fields(), scalars, checkpoint.tensors_of(state), json.loads(json.dumps(record)))

    def _fields(self) -> dict[str, Tensor]:
        """The fields of the trajectory in the order of ids."""
        state = self.step.prepare(self.state)
        assert state.ids is not None
        order = torch.argsort(state.ids)
        fields = {"position": state.x, "velocity": state.v}
        for name in self.scene.trajectory_fields:
            value = self._field(state, name)
            if value is None:
                raise SceneError([f"output.fields: no material of this scene has {name!r}"])
            fields[name] = value
        return {name: value[order] for name, value in fields.items()}

    def _field(self, state: State, name: str) -> Tensor | None:
        if name == "stress":
            return self.step.law.stress(_with_C(state))
        if name == "liquid":
            return state.extra.get(LIQUID)
        if name == "temperature" and state.temperature is not None and self.step.heat is not None:
            return state.temperature + self.step.heat.reference
        value: Tensor | None = getattr(state, name)
        return _with_C(state).C if value is None and name == "C" else value

    # -- time

    def _advance(self, begin: float, end: float) -> float:
        """Move the state to time ``end``; returns the largest CFL number |v| dt / dx on the way."""
        now, largest = begin, 0.0
        rounding = 1e-9 * (end - begin)
        while now < end - rounding:
            self._emit(now + rounding)
            following = self.emissions[self.emitted][0] if self.emitted < len(self.emissions) else math.inf
            target = min(end, following) if following > now + rounding else end
            self.state = self.state.replace(time=now).sorted(self.step.grid)
            dt, count = self._choose_dt(target - now)
            steps = min(count, SEGMENT)
            largest = max(largest, self._speed() * dt / self.step.grid.dx)
            self._segment(dt, steps)
            if self.state.x.is_cpu:
                heap.trim()
            now = target if steps == count else now + steps * dt
            self.totals.substeps += steps
            self.totals.smallest_dt = min(self.totals.smallest_dt, dt)
        self.state = self.state.replace(time=end)
        self.totals.largest_cfl = max(self.totals.largest_cfl, largest)
        return largest

    def _choose_dt(self, span: float) -> tuple[float, int]:
        """Time step and number of steps that fill ``span``."""
        limits = self.step.stable_dt(self.state, 1.0)
        worst = int(limits.argmin()) if len(limits) else 0
        limit = float(limits[worst]) if len(limits) else math.inf
        if self.scene.dt is not None and self.scene.dt > limit:
            scene = self.built.scenes[worst]
            raise SceneFailure(
                f"{scene + ', ' if scene else ''}step {self.totals.substeps}: dt = {self.scene.dt:g} s is above the "
                f"stability limit {limit:.3g} s; use dt = {0.5 * limit:.2g}, or leave dt out and set cfl = 0.5."
            )
        wanted = self.scene.dt or self.scene.cfl * limit
        count = max(1, math.ceil(span / wanted * (1 - 1e-9))) if math.isfinite(wanted) else 1
        return span / count, count

    def _segment(self, dt: float, steps: int) -> None:
        """Some substeps, then a look at the state; what went wrong is found by doing them again."""
        good = self.state
        try:
            for _ in range(steps):
                self.state = self.step(self.state, dt)
            self.step.check()
            bad = wrong(self.step, self.state)
            if bad is None:
                return
            message = bad[1]
        except SimulationError as error:
            message = str(error)
        self.state = good
        failure = replay(self.step, good, dt, steps, self.totals.substeps, self.built.scenes)
        if failure is not None:
            self.state = failure.good
        raise SceneFailure(str(failure or message), failure)

    def _emit(self, until: float) -> None:
        """Add the layers that are due."""
        while self.emitted < len(self.emissions) and self.emissions[self.emitted][0] <= until:
            layer = self.built.nozzles[self.emissions[self.emitted][1]].turned(self.emitted)
            ids = torch.arange(len(self.state), len(self.state) + len(layer), device=layer.x.device)
            self.state = joined(self.state, layer.replace(ids=ids))
            self.emitted += 1

    def _speed(self) -> float:
        return float(self.state.v.norm(dim=1).max()) if len(self.state) else 0.0

    # -- the end

    def summary(self, writer: FrameWriter, seconds: float) -> dict[str, Any]:
        """What the run took and how well it kept what should be kept."""
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
        }


def _with_C(state: State) -> State:
    """A viscous stress reads C, which is absent before the first step and without APIC."""
    return state if state.C is not None else state.replace(C=state.x.new_zeros(*state.x.shape, state.x.shape[1]))


def joined(state: State, layer: State) -> State:
    """A state with more particles, which are at rest in themselves."""
    if state.C is not None and layer.C is None:
        layer = _with_C(layer)
    elif state.C is None and layer.C is not None:
        state = _with_C(state)
    return State.concatenate([state, layer.replace(time=state.time)])


def energies(step: Any, state: Any) -> dict[str, Any]:
    """Kinetic, elastic and potential energy [J], momentum [kg m/s] and heat [J] of all particles, summed in float64."""
    mass, v = state.mass.double(), state.v.double()
    gravity = step.gravity
    potential = 0.0
    if gravity is not None:
        rows = gravity if gravity.dim() == 1 else gravity[state.scene.long()]
        potential = -float((mass[:, None] * state.x.double() * rows.double()).sum())
    heat = {} if step.heat is None else {"heat": float(step.heat.heat_content(state).double().sum())}
    return heat | {
        "kinetic_energy": 0.5 * float((mass * v.square().sum(1)).sum()),
        "elastic_energy": float(step.law.energy(step.prepare(state)).double().sum()),
        "potential_energy": potential,
        "momentum": (mass[:, None] * v).sum(0).tolist(),
    }


def versions() -> dict[str, str]:
    """Versions that a trajectory remembers."""
    try:
        own = metadata.version("torch-mpm")
    except metadata.PackageNotFoundError:
        own = "unknown"
    return {"torch_mpm": own, "torch": str(torch.__version__), "python": platform.python_version()}


# ---- the folder


def _claim(folder: Path, fingerprint: str, resume: bool) -> None:
    """Refuse a folder that holds anything but an unfinished run of this scene that is to be resumed."""
    if not folder.exists() or (folder.is_dir() and all(p.suffix == ".building" for p in folder.iterdir())):
        return  # a file that was being built when a run was killed is nothing yet
    if not folder.is_dir():
        raise OutputError(f"{folder} is a file; choose a folder for the output")
    record = folder / RUN
    if not record.is_file():
        raise OutputError(f"{folder} holds files that are no run of torch_mpm; choose an empty or a new folder")
    if _read_json(record).get("fingerprint") != fingerprint:
        raise OutputError(f"{folder} holds the run of another scene; choose another folder, or remove it first")
    if (folder / COMPLETE).exists():
        raise OutputError(f"{folder} holds the complete run of this scene; choose another folder, or remove it first")
    if not resume:
        raise OutputError(f"{folder} holds an unfinished run of this scene; add --resume to go on, or remove it first")


def _prepare_folder(folder: Path, scene: Scene, built: Built, fingerprint: str, source: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    record = folder / RUN
    if not record.exists():
        words = json.loads(scene.model_dump_json())
        _write_json(record, {"fingerprint": fingerprint, "scene": words, "folder": str(scene.folder.resolve())})
    if not (folder / PARTIAL).exists():
        (folder / CHECKPOINT).unlink(missing_ok=True)
        layout = Simulation(scene, built).layout(source, fingerprint)
        free = shutil.disk_usage(folder).free
        if layout.bytes > free:
            raise OutputError(
                f"the trajectory needs {layout.bytes / 1e9:.2f} GB in {folder}, where {free / 1e9:.2f} GB are free; "
                "free some space, lower fps or leave out output.fields"
            )
        create(folder / PARTIAL, layout)


@contextlib.contextmanager
def _disk_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise OutputError(
            f"no room on the disk of {folder}: {error.strerror or error}. The frames written so far are whole; "
            "free some space and add --resume to go on"
        ) from error


@contextlib.contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """SIGINT and SIGTERM ask to stop after the frame; a second SIGINT stops at once."""
    asked: list[int] = []

    def ask(number: int, frame: FrameType | None) -> None:
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.append(number)

    try:
        previous = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not the main thread, where signals are somebody else's
        previous = {}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _read_json(path: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads(path.read_text())
    return values


def _write_json(path: Path, values: dict[str, Any]) -> None:
    building = path.with_suffix(".building")
    building.write_text(json.dumps(values, indent=1))
    building.replace(path)


def _save_last_good(folder: Path, state: State, failure: SceneFailure) -> Path:
    """Keep the last good state of a run that failed."""
    path = folder / LAST_GOOD
    record = {"time": float(state.time), "failure": str(failure)}
    checkpoint.save(path, {k: v.cpu() for k, v in checkpoint.tensors_of(state).items()}, record)
    return path


def record_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Keep the summary of a run beside its scene in run.json."""
    _write_json(folder / RUN, {**_read_json(folder / RUN), "summary": summary})


def load_run(folder: str | Path, overrides: list[str] | None = None) -> Scene:
    """The scene of a run folder, with overrides as for :meth:`Scene.load`.

    Raises:
        FileNotFoundError: when the folder holds no run.
    """
    path = Path(folder) / RUN
    if not path.is_file():
        raise FileNotFoundError(f"there is no run in {folder}")
    record = _read_json(path)
    return Scene.from_words(record["scene"], overrides, Path(record["folder"]))
