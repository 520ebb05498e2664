"""Command ``torch-mpm usd RUN``: a run as a USD file."""

from __future__ import annotations

import argparse
from typing import Any

from ..data.commands import path_argument
from ..data.progress import frame_bar
from ..surfaces import commands as surfaces


def add(commands: Any) -> None:
    """Add the command to those of the command line."""
    usd = commands.add_parser("usd", help="write a run as a USD file: particles or surfaces, obstacles, camera")
    usd.add_argument("run", type=path_argument, help="folder of a run in 3-D")
    usd.add_argument("-o", "--out", type=path_argument, help="file .usdc, .usda or .usd; RUN/run.usdc by default")
    usd.add_argument("--grains", action="store_true", help="particles as instances of a sphere")
    usd.add_argument("--surface", action="store_true", help="fluids and bodies, but not sand, as meshes")
    surfaces.add_options(usd)
    usd.add_argument("--every", type=surfaces.count_argument, default=1, metavar="N", help="write every n-th frame")
    usd.add_argument("--quiet", action="store_true", help="no progress bar")
    usd.set_defaults(command=_usd)


def _usd(options: argparse.Namespace) -> None:
    from ..scene.usd import export_usd

    surfaces.require_a_run(options.run, "usd")
    parameters = surfaces.surface_options(options)
    surfaces.require_surface(options)
    with frame_bar("USD", options.quiet) as progress:
        print(
            export_usd(
                options.run, options.out, grains=options.grains, surface=options.surface, options=parameters,
                materials=options.materials, every=options.every, progress=progress,
            )
        )  # fmt: skip
