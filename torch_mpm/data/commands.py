"""Commands of data sets: ``torch-mpm generate CONFIG -o DIR``, finalize, verify."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from .. import optional
from .failures import MOST_FAILED, check_failures, reasons


class VerifyError(ValueError):
    """A data set in which something is wrong."""


def add(commands: Any) -> None:
    """Add the commands to those of the command line."""
    generate = commands.add_parser(
        "generate",
        help="simulate a data set of random scenes; alone, under torchrun or as a SLURM array",
        description="Simulate the scenes that a data set lacks. Any number of processes may work in one folder; "
        "RANK and WORLD_SIZE, SLURM_PROCID and SLURM_NTASKS or SLURM_ARRAY_TASK_ID and _COUNT share out the work.",
    )
    generate.add_argument("config", type=path_argument, nargs="?", help="configuration (TOML)")
    generate.add_argument(
        "--preset", metavar="NAME", help="a configuration that comes with torch_mpm; 'list' names them"
    )
    generate.add_argument("-o", "--out", type=path_argument, help="folder of the data set")
    generate.add_argument("--device", default="auto", help='"auto", "cpu", "cuda" or "cuda:1"; default: %(default)s')
    generate.add_argument("--check", action="store_true", help="check finished shards, and make damaged ones anew")
    generate.add_argument(
        "--extend", type=_total, action="append", default=[], metavar="SPLIT=N",
        help="give a split N scenes in all where the folder has fewer; those that are there stay; may be repeated",
    )  # fmt: skip
    _failures_argument(generate)
    generate.add_argument("--quiet", action="store_true", help="no progress bar")
    set_argument(generate, "dataset.splits={train=100}")
    generate.set_defaults(command=_generate)

    finalize = commands.add_parser("finalize", help="merge the statistics of a complete data set into metadata.json")
    finalize.add_argument("folder", type=path_argument, help="folder of the data set")
    finalize.set_defaults(command=_finalize)

    verify = commands.add_parser("verify", help="check all files and scenes of a data set")
    verify.add_argument("folder", type=path_argument, help="folder of the data set")
    _failures_argument(verify)
    verify.set_defaults(command=_verify)


def _failures_argument(parser: argparse.ArgumentParser) -> None:
    text = "share of the scenes that may fail before the command does; default: %(default)s"
    parser.add_argument("--most-failed", type=_share, default=MOST_FAILED, metavar="SHARE", help=text)


def _total(text: str) -> tuple[str, int]:
    name, equals, number = text.partition("=")
    if not equals or not number.isascii() or not number.isdigit() or len(number) > 12:
        raise argparse.ArgumentTypeError(f"takes a split and a number of scenes, such as train=2000, got {text!r}")
    return name, int(number)


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"takes a share within 0 and 1, got {text!r}")
    return value


def path_argument(text: str) -> Path:
    """Argument type of paths. An empty path is refused: it would be the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"takes a path, got {text!r}")
    return Path(text)


def folder_argument(text: str) -> Path:
    """Argument type of output folders, which need not exist."""
    path = path_argument(text)
    if path.exists() and not path.is_dir():
        raise argparse.ArgumentTypeError(f"takes a folder, and {path} is a file")
    return path


def set_argument(parser: argparse.ArgumentParser, example: str) -> None:
    """An option that overrides keys of a file."""
    text = f"override a key of the file, such as {example}"
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help=text)


def _generate(options: argparse.Namespace) -> None:
    from ..scene import SceneError
    from .configuration import Configuration, presets
    from .folder import DatasetFolder
    from .generate import generate

    if options.preset == "list":
        print("\n".join(presets()))
        return
    if (options.config is None) == (options.preset is None):
        raise SceneError(["takes a configuration or --preset NAME"], "generate")
    if options.out is None:
        raise SceneError(["takes a folder: -o DIR"], "generate")
    if options.preset is not None:
        configuration = Configuration.preset(options.preset, options.overrides)
    else:
        configuration = Configuration.load(options.config, options.overrides)
    bar = None if options.quiet else _Bar()
    try:
        done = generate(
            configuration,
            options.out,
            device=options.device,
            check=options.check,
            progress=None if bar is None else bar.show,
            extend=dict(options.extend),
        )
    finally:
        if bar is not None:
            bar.close()
    rate = done["scenes"] / max(done["seconds"], 1e-9)
    print(
        f"{done['scenes']} scenes in {done['seconds']:.1f} s ({rate:.3g} per second), of which simulation "
        f"{done['simulating']:.1f} s; {done['failed']} failed"
    )
    dataset = DatasetFolder(options.out)
    scenes = dataset.attempted()
    print("".join(f"{line}\n" for line in reasons(scenes)), end="")
    check_failures(scenes, options.most_failed)
    others = len(scenes) - done["scenes"]
    if others > 0 and not options.check:
        print(f"{others} scenes of earlier calls or other processes were not read: --check and torch-mpm verify do")
    rest = f"complete; torch-mpm finalize {options.out} writes its metadata"
    print(f"{options.out} is {rest if done['complete'] else 'not complete: other processes work in it, or are to'}")


def _finalize(options: argparse.Namespace) -> None:
    from .finish import finalize
    from .metadata import METADATA

    words = finalize(options.folder)
    print(f"{options.folder / METADATA}: statistics of {words['statistics_of']}")


def _verify(options: argparse.Namespace) -> None:
    from .finish import verify
    from .folder import DatasetFolder

    problems = list(verify(options.folder))
    if problems:
        raise VerifyError("\n".join(problems))
    dataset = DatasetFolder(options.folder)
    scenes = dataset.attempted()
    check_failures(scenes, options.most_failed)
    print(f"{options.folder}: good, {len(dataset.scenes())} of {len(scenes)} scenes are valid")
    print("".join(f"{line}\n" for line in reasons(scenes)), end="")


class _Bar:
    """Progress of a process: frames of scenes, their rate and the time left, if it makes all that is missing."""

    def __init__(self) -> None:
        self._make = optional.load("tqdm", "the progress bar, which --quiet disables", "scene").tqdm
        self._bar: Any = None

    def show(self, figures: dict[str, Any]) -> None:
        if self._bar is None:
            self._bar = self._make(total=figures["missing"], unit="frame", unit_scale=True)
        self._bar.set_postfix_str(f"{figures['scenes']} scenes, {figures['failed']} failed", refresh=False)
        self._bar.update(max(0, figures["frames"] - self._bar.n))

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
