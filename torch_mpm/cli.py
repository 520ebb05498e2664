"""The command line: ``torch-mpm run SCENE -o DIR``, check, info, schema, render, export, surface, usd, splats, and the
commands of data sets.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from .data import commands as data_sets
from .data import host_memory, progress
from .data import reading_commands as reading
from .data.commands import path_argument, set_argument
from .interrupts import alarm
from .splats.picture import BACKENDS
from .surfaces import commands as surfaces
from .usd import commands as usd


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        The exit status: 0, 1 for a problem (described on stderr), 130 after Ctrl-C, and 143 after SIGTERM. A run that
        stops at a frame returns 130 after both.
    """
    came: list[type[KeyboardInterrupt]] = []
    try:
        with signals_raise(came), warnings_in_lines(), any_text_on_stdout():
            options = _parser().parse_args(arguments)
            host_memory.require_address_space(LEAST, "a command with the packages that it imports")
            options.command(options)
    except KeyboardInterrupt as error:
        return _ended(type(error))
    except Exception as error:
        if came:  # a library has turned the exception of the signal into another one
            return _ended(came[0])
        message = _message(error)
        if message is None:
            raise
        return _report(message, 130 if type(error).__name__ == "Interrupted" else 1)
    return 0


class Terminated(KeyboardInterrupt):
    """SIGTERM as an exception: incomplete files are removed during unwinding."""


def _ended(kind: type[KeyboardInterrupt]) -> int:
    return _report("terminated", 143) if issubclass(kind, Terminated) else _report("interrupted", 130)


AGAIN_SECONDS = 0.01
"""Delay until an exception that Python has dropped is raised again [s]."""


@contextlib.contextmanager
def signals_raise(came: list[type[KeyboardInterrupt]]) -> Iterator[None]:
    """SIGTERM raises `Terminated` in the main thread, and SIGINT KeyboardInterrupt. Other threads change nothing.

    The classes raised are appended to `came`. Python drops exceptions in destructors and in callbacks of weak
    references; they are raised again.
    """

    def end(number: int, frame: FrameType | None) -> None:
        came.append(Terminated if number == signal.SIGTERM else KeyboardInterrupt)
        raise came[-1]

    def raise_again(dropped: sys.UnraisableHookArgs) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            raise_later(dropped.exc_type, AGAIN_SECONDS)
        else:
            hook(dropped)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGTERM, *([signal.SIGINT] if signal.getsignal(signal.SIGINT) != signal.SIG_IGN else [])]
    previous, hook = {number: signal.signal(number, end) for number in numbers}, sys.unraisablehook
    with alarm() as raise_later:
        sys.unraisablehook = raise_again
        try:
            yield
        finally:
            sys.unraisablehook = hook
            for number, handler in previous.items():
                signal.signal(number, handler)


@contextlib.contextmanager
def warnings_in_lines() -> Iterator[None]:
    """Warnings of torch_mpm are one line without a source location, as errors are."""
    usual = warnings.formatwarning

    def line(message: Warning | str, category: type[Warning], *place: Any, **words: Any) -> str:
        own = category.__module__.startswith(__package__ or "")
        return f"torch-mpm: warning: {message}\n" if own else usual(message, category, *place, **words)

    warnings.formatwarning = line
    try:
        yield
    finally:
        warnings.formatwarning = usual


@contextlib.contextmanager
def any_text_on_stdout() -> Iterator[None]:
    """Letters that the encoding of stdout lacks, as in the locale C, are printed as escapes, as stderr does."""
    stdout = sys.stdout
    if not isinstance(stdout, io.TextIOWrapper) or stdout.errors != "strict":
        yield
        return
    stdout.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        stdout.reconfigure(errors="strict")


REPORTED = (
    "SceneError", "OutputError", "DamagedFileError", "SimulationError", "Interrupted", "RenderError", "WorkerError",
    "IncompleteError", "VerifyError", "DatasetError", "MissingError", "FailedScenesError", "SurfaceError", "UsdError",
)  # fmt: skip
"""Errors reported by their message alone; others by their traceback."""

LEAST = 2**26
"""Address space of the smallest command [bytes]."""
NOTHING = 2**22
"""Memory below which anything may fail, with any message [bytes]."""


def _message(error: Exception) -> str | None:
    """Message for the user. None for defects of torch_mpm, whose traceback should be visible."""
    if (
        host_memory.is_short(error) or host_memory.available() < NOTHING
    ):  # Python may lose exceptions when memory is exhausted.
        remedy = "have a larger grid.dx, a smaller per_cell, or fewer fields and pictures; or free some memory"
        return f"out of memory: {host_memory.shortage(error)}; {remedy}"
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, UnicodeEncodeError):
        return f"the locale cannot encode {error.object!r}; set LC_ALL=C.UTF-8"
    names = {kind.__name__ for kind in type(error).__mro__}
    return str(error) if names.intersection(REPORTED) or isinstance(error, (OSError, ImportError)) else None


def _report(message: str, status: int) -> int:
    shown = "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in message)  # Errors of file names.
    print(f"torch-mpm: {shown}", file=sys.stderr)
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("torch-mpm", description="Material Point Method scenes: simulate, draw, export.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="simulate a scene file")
    _scene_arguments(run)
    _run_arguments(run)
    run.set_defaults(command=_run)

    check = commands.add_parser("check", help="check a scene file without simulating it")
    _scene_arguments(check)
    check.set_defaults(command=_check)

    info = commands.add_parser(
        "info", help="fields, memory, run time and plan of a scene; without a scene, properties of this installation"
    )
    _scene_arguments(info, optional=True)
    info.set_defaults(command=_info)

    schema = commands.add_parser("schema", help="print the JSON schema of scene files, for editors")
    schema.set_defaults(command=_schema)

    render = commands.add_parser("render", help="redraw the pictures and the video of a run; draw scenes of a data set")
    render.add_argument("run", type=path_argument, help="folder of a run or of a data set")
    set_argument(render, "render.color_by=stress")
    reading.add_render_options(render)
    render.set_defaults(command=_render)

    export = commands.add_parser("export", help="convert a run or a data set for other programs")
    export.add_argument("run", type=path_argument, help="folder of a run or of a data set")
    reading.add_export_options(export)
    export.set_defaults(command=_export)

    splats = commands.add_parser(
        "splats", help="simulate an object of Gaussian splats; write its splats and pictures of each frame"
    )
    splats.add_argument("file", type=path_argument, help="object (.ply of 3-D Gaussian splatting)")
    splats.add_argument(
        "--scene", type=path_argument,
        help='scene file (TOML) with a body of shape = "splats", whose file is replaced; by default jelly on the floor',
    )  # fmt: skip
    set_argument(splats, "body[0].up=-y")
    splats.add_argument(
        "--backend", choices=BACKENDS, default="auto", help="renderer of the pictures; default: %(default)s"
    )
    _run_arguments(splats)
    splats.set_defaults(command=_splats)

    surfaces.add(commands)
    usd.add(commands)
    reading.add(commands)
    data_sets.add(commands)
    return parser


def _run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--out", required=True, type=path_argument, help="folder for the results")
    parser.add_argument("--resume", action="store_true", help="continue an unfinished run")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _scene_arguments(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    parser.add_argument("scene", type=path_argument, help="scene file (TOML)", nargs="?" if optional else None)
    set_argument(parser, "grid.dx=0.01")


# ---- commands


Outputs = list[tuple[str, Callable[[], dict[str, Path]]]]
"""Outputs beside a trajectory: names, and functions that write them and return their paths."""


def _run(options: argparse.Namespace) -> None:
    from .scene import Scene

    scene = Scene.load(options.scene, options.overrides)
    _require_outputs(scene)
    _simulate(scene, options, options.scene.read_text(encoding="utf-8"), _outputs(scene, options))


def _splats(options: argparse.Namespace) -> None:
    from .scene.splat_scene import require_renderer, splat_scene

    scene, source = splat_scene(options.file, options.scene, options.overrides)
    require_renderer(options.backend)
    _require_outputs(scene.model_copy(update={"render": None}))
    _simulate(scene, options, source, _splat_outputs(scene, options))


def _simulate(scene: Any, options: argparse.Namespace, source: str, outputs: Outputs) -> None:
    """Simulate a scene with the text ``source``, and write the outputs that the folder lacks."""
    from .scene.diagnose import SceneFailure
    from .scene.folder import finished
    from .scene.run import Interrupted, run

    begin = time.perf_counter()
    complete = options.resume and finished(options.out, scene.fingerprint()) is not None
    bar = None if options.quiet else _Bar()
    notice = None if bar is None else bar.notice
    try:
        summary = run(scene, options.out, resume=options.resume, source=source, progress=bar, notice=notice)
    except (SceneFailure, Interrupted):
        if bar is not None:
            bar.close()
        raise
    if bar is not None:
        bar.close()
    seconds = summary.setdefault("seconds", {})
    files = {"trajectory": options.out / "trajectory.h5"}
    missing = [(n, make) for n, make in outputs if n not in seconds or not _is_there(n, options.out)]
    if complete and not missing:
        print(f"{options.out} holds the complete run of this scene")
        return
    for name, make in missing:
        since = time.perf_counter()
        files |= make()
        seconds[name] = time.perf_counter() - since
    seconds["total"] = time.perf_counter() - begin
    _write_summary(options.out, summary)
    if "frames" in summary:
        _print_summary(summary, files)
    else:
        print(f"{options.out} holds the complete run of this scene, whose summary was lost by a kill")


def _require_outputs(scene: Any) -> None:
    """Raise ImportError for a missing package before the simulation instead of after it."""
    if scene.render is not None:
        from . import render
        from .render.requires import require

        assert render
        for module in ("matplotlib", "PIL", "imageio_ffmpeg", *(["vtk"] if scene.dim == 3 else [])):
            require(module)
        if scene.render.surface:
            from .surfaces.reconstruction import require_packages

            require_packages()
    if scene.output.vtk or scene.output.ply:
        from .data.export import meshio_module

        meshio_module()


def _outputs(scene: Any, options: argparse.Namespace) -> Outputs:
    """Outputs of the scene."""
    from .data import export

    outputs: Outputs = []
    if scene.render is not None:
        outputs.append(("pictures", lambda: _draw(options.out, scene, options.quiet)))
    if scene.output.vtk:
        outputs.append(("VTK", lambda: {"VTK": export.export_vtk(options.out)}))
    if scene.output.ply:
        outputs.append(("PLY", lambda: {"PLY": export.export_ply(options.out)}))
    return outputs


def _splat_outputs(scene: Any, options: argparse.Namespace) -> Outputs:
    """Splats and pictures of a scene with an object of splats."""
    from .scene.splat_frames import write_frames
    from .scene.splat_pictures import draw_frames

    def write() -> dict[str, Path]:
        with progress.frame_bar("splats", options.quiet) as shown:
            return {"splats": write_frames(options.out, scene, scene.torch_device(), shown)[0].parent}

    def draw() -> dict[str, Path]:
        with progress.frame_bar("pictures", options.quiet) as shown:
            return _pictures(draw_frames(options.out, scene, options.backend, scene.torch_device(), shown))

    return [("splats", write), ("pictures", draw)]


def _is_there(name: str, out: Path) -> bool:
    """Whether the files of an output exist."""
    return (out / {"pictures": "frames", "VTK": "vtk/run.pvd", "PLY": "ply", "splats": "splats"}[name]).exists()


def _draw(folder: Path, scene: Any, quiet: bool) -> dict[str, Path]:
    """Draw a run; returns the paths of its pictures and its video."""
    from .scene.pictures import draw

    with progress.frame_bar("pictures", quiet) as shown:
        return _pictures(draw(folder, scene, shown))


def _pictures(made: Sequence[Path]) -> dict[str, Path]:
    """Folder of pictures, and the video, if there is one."""
    video = {"video": made[-1]} if made[-1].suffix == ".mp4" else {}
    return {"pictures": made[0].parent, **video}


def _check(options: argparse.Namespace) -> None:
    from .boundaries.thickness import thin_walls
    from .grid import resolution
    from .scene import Scene
    from .scene.substeps import check_substeps

    scene = Scene.load(options.scene, options.overrides)
    built = scene.build("cpu")
    if unresolved := resolution.problem(built.grid, built.state.x.dtype):
        print(f"{options.scene}: warning: grid: {unresolved}", file=sys.stderr)
    for thin in thin_walls(built.step.boundaries.entries, built.grid.dx):
        print(f"{options.scene}: warning: {thin}", file=sys.stderr)
    if built.projected is not None:
        print(f"{options.scene}: {_projected(built.projected.tolist())}")
    substeps = check_substeps(scene, built)
    contents = f"{built.particles} particles in {len(built.scenes)} scene(s), {scene.frames + 1} frames"
    print(f"{options.scene}: good, {contents}, about {substeps} substeps")


def _projected(counts: Sequence[int]) -> str:
    """How many particles of each scene were moved out of obstacles."""
    each = f" ({', '.join(map(str, counts))} in each scene)" if len(counts) > 1 else ""
    return f"{sum(counts)} particles were moved out of obstacles{each}"


def _info(options: argparse.Namespace) -> None:
    if options.scene is None:
        from .info import print_info

        print_info()
        return
    from .scene import Scene
    from .scene.describe import describe

    scene = Scene.load(options.scene, options.overrides)
    for key, value in describe(scene, scene.build()).items():
        print(f"{key:>24}  {_shown(value)}")


def _schema(options: argparse.Namespace) -> None:
    from .scene import json_schema

    print(json.dumps(json_schema(), indent=1))


def _render(options: argparse.Namespace) -> None:
    if reading.is_dataset(options.run):
        reading.render(options)
        return
    reading.require_a_run(options)
    from .scene.folder import load_run

    for path in _draw(options.run, load_run(options.run, options.overrides), quiet=False).values():
        print(path)


def _export(options: argparse.Namespace) -> None:
    if reading.is_dataset(options.run):
        reading.export(options)
    else:
        reading.export_run(options)


# ---- messages


class _Bar:
    """Progress bar of a run; the first report gives the number of frames."""

    def __init__(self) -> None:
        self._make = progress.tqdm()
        self._bar: Any = None

    def __call__(self, figures: dict[str, Any]) -> None:
        if self._bar is None:
            self._bar = self._make(total=figures["frames"], initial=figures["frame"] - 1, unit="frame")
        self._bar.set_postfix_str(
            f"{figures['substeps']} substeps, {figures['rate'] / 1e6:.2f} M particles/s, "
            f"kinetic {figures['kinetic_energy']:.4g} J, elastic {figures['elastic_energy']:.4g} J",
            refresh=False,
        )
        self._bar.update()

    def notice(self, line: str) -> None:
        """Print a line above the bar."""
        self._make.write(f"torch-mpm: {line}", file=sys.stderr)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


def _write_summary(folder: Path, summary: dict[str, Any]) -> None:
    from .scene.folder import record_summary

    record_summary(folder, summary)


def _print_summary(summary: dict[str, Any], files: dict[str, Path]) -> None:
    energy = summary["energy"]
    print(f"{summary['frames'] + 1} frames, {summary['particles']} particles, {summary['substeps']} substeps")
    for name, value in summary["seconds"].items():
        print(f"{name:>24}  {value:.1f} s")
    print(f"{'energy':>24}  {energy['first']:.6g} J at the start, {energy['last']:.6g} J at the end")
    print(f"{'mass drift':>24}  {summary['mass_drift']:.1e}")
    print(f"{'largest CFL number':>24}  {summary['largest_cfl']:.3f}")
    print(f"{'particles lost':>24}  {summary['particles_lost'] or 'none'}")
    if "particles_projected" in summary:
        print(f"{'obstacles':>24}  {_projected(summary['particles_projected'])}")
    for name, path in files.items():
        print(f"{name:>24}  {path}")


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k} {v}" for k, v in value.items()) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
