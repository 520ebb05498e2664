"""Command ``torch-mpm surface RUN``: surfaces of a run as mesh files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..data.commands import folder_argument, path_argument
from ..data.progress import frame_bar

FORMATS = ("ply", "obj", "vtp")
PARAMETERS = ("smoothing_length", "cube_size", "iso_threshold", "smoothing")


def add(commands: Any) -> None:
    """Add the command to those of the command line."""
    surface = commands.add_parser("surface", help="write the surfaces of the fluids and bodies of a run as meshes")
    surface.add_argument("run", type=path_argument, help="folder of a run in 3-D")
    surface.add_argument("-o", "--out", type=folder_argument, help="folder of the meshes; RUN/surface by default")
    surface.add_argument(
        "--format", dest="formats", action="append", choices=FORMATS, metavar="FORMAT",
        help=f"{', '.join(FORMATS)}; ply by default; may be repeated",
    )  # fmt: skip
    add_options(surface)
    surface.add_argument("--every", type=count_argument, default=1, metavar="N", help="write every n-th frame")
    surface.add_argument("--quiet", action="store_true", help="no progress bar")
    surface.set_defaults(command=_surface)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the parameters of a reconstruction."""
    parser.add_argument(
        "--material", dest="materials", action="append", default=[], metavar="NAME",
        help="material with a surface; by default all but sand; may be repeated",
    )  # fmt: skip
    lengths = {
        "smoothing-length": "smoothing length of the particles; by default 0.75 grid.dx, 1.5 to 3 particle spacings",
        "cube-size": "edge of the cubes of marching cubes; half of the smoothing length by default",
    }
    for name, text in lengths.items():
        parser.add_argument(f"--{name}", type=float, metavar="M", help=f"{text} [m]")
    parser.add_argument(
        "--iso-threshold", type=float, default=0.6, metavar="X",
        help="value on the surface, 0.05 to 0.95, smaller for larger bodies; default: %(default)s",
    )  # fmt: skip
    parser.add_argument(
        "--smoothing", type=int, default=3, metavar="N", help="smoothing steps of the mesh; default: %(default)s"
    )


def count_argument(text: str) -> int:
    """Argument type of positive whole numbers."""
    if not (text.isascii() and text.isdigit() and len(text) <= 12 and int(text)):
        raise argparse.ArgumentTypeError(f"takes a positive whole number, got {text!r}")
    return int(text)


def require_a_run(folder: Path, command: str) -> None:
    """Refuse the folder of a data set."""
    from ..data.reading_commands import is_dataset
    from .reconstruction import SurfaceError

    if is_dataset(folder):
        raise SurfaceError(f"{folder}: {command} is for runs, and this is a data set")


def require_surface(options: argparse.Namespace) -> None:
    """Refuse parameters of a reconstruction without ``--surface``."""
    from .reconstruction import SurfaceError, SurfaceOptions

    given = [name for name in PARAMETERS if getattr(options, name) != getattr(SurfaceOptions(), name)]
    given += ["material"] if options.materials else []
    if given and not options.surface:
        raise SurfaceError(f"--{given[0].replace('_', '-')} is for --surface")


def surface_options(options: argparse.Namespace) -> Any:
    """The parameters of a reconstruction.

    Raises:
        SurfaceError: for a value out of its range.
    """
    from .reconstruction import SurfaceError, SurfaceOptions

    try:
        return SurfaceOptions(**{name: getattr(options, name) for name in PARAMETERS})
    except ValueError as error:
        name, _, rest = str(error).partition(" ")
        raise SurfaceError(f"--{name.replace('_', '-')} {rest}") from None


def _surface(options: argparse.Namespace) -> None:
    from ..scene.surfaces import export_surfaces

    require_a_run(options.run, "surface")
    parameters, formats = surface_options(options), list(dict.fromkeys(options.formats or ["ply"]))
    with frame_bar("surfaces", options.quiet) as progress:
        print(
            export_surfaces(
                options.run, options.out, formats, options=parameters, materials=options.materials,
                every=options.every, progress=progress,
            )
        )  # fmt: skip
