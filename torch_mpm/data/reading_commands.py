"""Commands that read data sets: ``torch-mpm export DIR --format gns``, render, stats, view."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ..render.viewer_server import MOST_PORT
from .commands import folder_argument, path_argument
from .folder import DATASET, DatasetError

FORMATS = ("gns", "lagrangebench", "neuralmpm", "ply", "tfrecord", "vtk", "well")
OF_RUNS = ("vtk", "ply")
WITH_FIELDS = ("lagrangebench", "neuralmpm", "tfrecord")
OPTIONS = {"material": ("gns",), "fields": WITH_FIELDS, "context": ("tfrecord",), "dx": ("well",), "scenes": OF_RUNS}
"""Formats that an option of the export of a data set is for."""


def is_dataset(folder: Path) -> bool:
    return (folder / DATASET).is_file()


def add(commands: Any) -> None:
    """Add the commands that are for data sets alone, or for looking, to those of the command line."""
    stats = commands.add_parser("stats", help="draw what is in a data set: sizes, motions, energies, failures")
    stats.add_argument("folder", type=path_argument, help="folder of the data set")
    stats.add_argument("-o", "--out", type=path_argument, help="the picture; statistics.png in the folder by default")
    stats.set_defaults(command=_stats)

    view = commands.add_parser("view", help="show a run or a data set in the browser")
    view.add_argument("folder", type=path_argument, help="folder of a run or of a data set")
    view.add_argument("--port", type=_port, default=8080, help="default: %(default)s")
    view.add_argument("--host", default="127.0.0.1", help="address to listen at; default: %(default)s")
    view.set_defaults(command=_view)


def add_export_options(parser: argparse.ArgumentParser) -> None:
    help = f"{', '.join(FORMATS)}; of a run {' or '.join(OF_RUNS)}; may be repeated"
    parser.add_argument("--format", dest="formats", action="append", choices=FORMATS, metavar="FORMAT", help=help)
    for name in OF_RUNS:
        parser.add_argument(f"--{name}", dest="formats", action="append_const", const=name, help=f"--format {name}")
    parser.add_argument(
        "-o", "--out", type=folder_argument, help="folder to make; by default one named after the format in DIR"
    )
    parser.add_argument("--material", metavar="NAME", help="gns: array [N] of the scenes for the material column")
    parser.add_argument(
        "--fields", type=_words, default=(), metavar="stress,F", help="lagrangebench, neuralmpm, tfrecord: more arrays"
    )
    parser.add_argument("--context", action="store_true", help="tfrecord: gravity as step_context of every frame")
    parser.add_argument("--dx", type=float, help="well: size of a cell [m]")
    _scenes_option(parser, "vtk, ply: scenes; the first by default")


def add_render_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-o", "--out", type=folder_argument, help="data set: folder of the pictures; DIR/pictures by default"
    )
    parser.add_argument("--color-by", metavar="FIELD", help="data set: speed by default")
    parser.add_argument("--no-video", action="store_true", help="data set: the contact sheet alone")
    _scenes_option(parser, "data set: scenes; the first six by default")


def _scenes_option(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--scenes", type=_numbers, metavar="0,5,7", help=text)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 5 and int(text) <= MOST_PORT):
        raise argparse.ArgumentTypeError(f"takes a port within 0 and {MOST_PORT}, got {text!r}")
    return int(text)


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")]


def _numbers(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"takes numbers of scenes such as 0,5,7, got {text!r}") from None


def export(options: argparse.Namespace) -> None:
    """Export a data set."""
    from .. import data

    formats = dict.fromkeys(options.formats or [])
    if not formats:
        raise DatasetError(f"export takes --format with one of {', '.join(FORMATS)}")
    if options.out is not None and len(formats) > 1:
        raise DatasetError("export takes -o with one format only")
    for option in _given(options, *OPTIONS):
        if formats.keys().isdisjoint(OPTIONS[option]):
            raise DatasetError(f"--{option} is for --format {' or '.join(OPTIONS[option])}, got {', '.join(formats)}")
    for name in formats:
        more = {option: getattr(options, option) for option, of in OPTIONS.items() if name in of}
        write = getattr(data, f"export_scenes_{name}" if name in OF_RUNS else f"export_{name}")
        print(write(options.run, options.out, **more))


def _given(options: argparse.Namespace, *names: str) -> list[str]:
    """Options that the command line has."""
    return [name for name in names if getattr(options, name) not in (None, False, ())]


def require_a_run(options: argparse.Namespace) -> None:
    """Refuse the options of `render` that are for data sets."""
    for name in _given(options, "out", "color_by", "no_video", "scenes"):
        option = "-o" if name == "out" else f"--{name.replace('_', '-')}"
        raise DatasetError(f"{options.run}: {option} is for data sets; of a run --set render.video=false and the like")


def export_run(options: argparse.Namespace) -> None:
    """Export a run."""
    from .export import export_ply, export_vtk

    formats = dict.fromkeys(options.formats or ["vtk"])
    wrong = [name for name in formats if name not in OF_RUNS]
    if wrong:
        raise DatasetError(f"{options.run}: --format {wrong[0]} is for data sets; of a run {' or '.join(OF_RUNS)}")
    if given := _given(options, *OPTIONS):
        raise DatasetError(f"{options.run}: --{given[0]} is for data sets, and this is a run")
    for name in formats:
        print({"vtk": export_vtk, "ply": export_ply}[name](options.run, options.out))


def render(options: argparse.Namespace) -> None:
    """Draw scenes of a data set."""
    from .pictures import draw_scenes

    if options.overrides:
        raise DatasetError("render of a data set takes --color-by, --scenes and --no-video in place of --set")
    color_by = "speed" if options.color_by is None else options.color_by
    made = draw_scenes(options.run, options.out, options.scenes, color_by, video=not options.no_video)
    print("\n".join(map(str, made)))


def _stats(options: argparse.Namespace) -> None:
    from .figures import draw_statistics, summary

    for name, words in summary(options.folder).items():
        print(f"{name:>14}  {json.dumps(words)[1:-1]}")
    print(draw_statistics(options.folder, options.out))


def _view(options: argparse.Namespace) -> None:
    from ..render.viewer import Viewer

    viewer = Viewer(options.folder, options.port, options.host)
    try:
        print(f"{viewer.url} (Ctrl-C ends it)", flush=True)
        viewer.wait()
    finally:
        viewer.close()
