"""Kills and signals at random moments: no data is lost, no temporary file remains, and commands end soon.

    python -m benchmarks.fuzz.interruptions --kills 100 --signals 100 --seed 0

Each of `run`, `generate`, `export` and `render` gets SIGKILL `--kills` times and SIGINT or SIGTERM `--signals` times,
and is called again. Its files must have the bytes of an undisturbed call, and nothing else may lie beside them.
After a signal a command has `SOON` seconds of CPU time to end with the exit status of the signal; in a part of the
cases it is one whose frames, scenes or shards take much longer. The exit status is 1 if there is a fault.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torch_mpm import cli

from .. import common as benchmark
from . import common
from .command_lines import FORMATS
from .files import SCENE, SET

COLUMNS = ("crash", "traceback", "wrong exit status", "late end", "files left", "lost or changed")
FIGURES = ("still at work", "slowest end, s")
"""Number of calls that were still running at their signal, and largest CPU time from signal to end."""
COMMANDS = ("run", "generate", "export", "render")
SOON = 1.2
"""Limit of the CPU time from signal to end, including the exit of Python [s]."""
MOST = 120.0
"""Time limit of a call [s]."""
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}
EXISTS = "exists already; remove it"
"""Message of an export whose output is already complete."""
STAMP = re.compile(rb"comment Created by meshio .*")
"""Line with the time in PLY files."""
PICTURES = "render = {resolution = [160, 120]}\noutput.vtk = true\n"
LONG_FRAMES = """
device = "cpu"
gravity = [0.0, -10.0]
duration = 100.0
fps = 0.1
grid = {lower = [0.0, 0.0], upper = [1.0, 1.0], dx = 0.02, walls = "separate"}
material.jelly = {law = "neo_hookean", E = 1e5}
[[body]]
shape = "box"
lower = [0.1, 0.1]
upper = [0.9, 0.9]
material = "jelly"
"""
LONG_SHARDS = """
device = "cpu"
gravity = [0.0, -10.0]
grid = {lower = [0.0, 0.0], upper = [1.0, 1.0], dx = 0.02, walls = "separate"}
[dataset]
splits = {train = 4000}
frames = 400
interval = 0.0025
scenes_per_shard = 2000
fields = ["velocity"]
obstacles = true
[material.jelly]
law = "neo_hookean"
E = {log_uniform = [1e4, 1e5]}
[[body]]
shape = "sphere"
material = "jelly"
center = {in_box = [[0.3, 0.6], [0.7, 0.8]]}
radius = 0.1
[[obstacle]]
shape = "sphere"
center = [0.5, 0.15]
radius = 0.1
"""


class Interruptions:
    """The cases, in one temporary folder that holds a scene, configurations, a run and a data set."""

    def __init__(self, folder: Path, warm: bool) -> None:
        self.good, self.out, self.whole = (folder / name for name in ("good", "out", "whole"))
        self.good.mkdir()
        for name, text in {
            "scene": SCENE.replace("duration = 0.02", "duration = 0.4"),
            "pictures": PICTURES + SCENE,
            "set": SET.replace("train = 2", "train = 20"),
            "frames": LONG_FRAMES,
            "shards": LONG_SHARDS,
        }.items():
            (self.good / f"{name}.toml").write_text(text)
        common.succeed("run", self.good / "pictures.toml", "-o", self.good / "run", "--quiet")
        common.succeed("generate", self.good / "set.toml", "-o", self.good / "set", "--quiet")
        if warm:  # what this process has imported, its children need not
            for name in FORMATS:
                common.succeed("export", self.good / "set", "-o", self.out / name, "--format", name)
        self.seconds: dict[str, float] = {}  # of undisturbed calls
        self.ends: list[float] = []  # times that calls have taken to end after signals

    def _call(self, words: list[str]) -> str:
        """Make an undisturbed call; returns its faults."""
        outcome = common.run(lambda: cli.main(words), seconds=MOST)
        return "" if outcome.kind == "ok" and outcome.status == 0 else f"{words}: {outcome.kind}: {outcome.text}"

    def _words(self, command: str, rng: random.Random) -> list[str]:
        """A command line that writes into `out` alone."""
        out, run, data_set = str(self.out), str(self.good / "run"), str(self.good / "set")
        if command == "run":
            return [
                "run",
                str(self.good / f"{rng.choice(('scene', 'pictures'))}.toml"),
                "-o",
                out,
                "--quiet",
                "--resume",
            ]
        if command == "generate":
            return ["generate", str(self.good / "set.toml"), "-o", out, "--quiet"]
        if command == "render":
            return rng.choice((["render", out], ["render", data_set, "-o", out]))
        of_set = ["export", data_set, "-o", out, "--format", rng.choice(FORMATS)]
        return rng.choice((of_set, of_set, ["export", run, "-o", out, "--vtk"]))

    def _begin(self, words: list[str]) -> None:
        """Restore the folder to its state before a command."""
        shutil.rmtree(self.out, ignore_errors=True)
        if words == ["render", str(self.out)]:
            shutil.copytree(self.good / "run", self.out)
            shutil.rmtree(self.out / "frames")
            (self.out / "video.mp4").unlink()

    def expected(self, words: list[str]) -> Path:
        """Files of an undisturbed call, made once."""
        folder = self.whole / "".join(c if c.isalnum() else "_" for c in " ".join(words[:2] + words[4:]))
        if not folder.exists():
            self._begin(words)
            begin = time.monotonic()
            if problem := self._call(words):
                raise RuntimeError(problem)
            self.seconds[str(folder)] = time.monotonic() - begin
            shutil.copytree(self.out, folder)
        return folder

    def case(self, command: str, killed: bool, rng: random.Random) -> Iterator[str]:
        """A call that is killed at a random moment, and a second call that completes its output."""
        if not killed and command in ("run", "generate") and rng.random() < 0.2:
            yield from self._long(command, rng)
            return
        words = self._words(command, rng)
        expected = self.expected(words)
        self._begin(words)
        number = signal.SIGKILL if killed else rng.choice((signal.SIGINT, signal.SIGTERM))
        yield from self._ended(words, number, rng.uniform(0.0, 1.05 * self.seconds[str(expected)]))
        problem = self._call(words)
        if problem and EXISTS not in problem:
            print(problem, flush=True)
            yield "lost or changed"
        elif found := list(self._differences(expected)):
            print(f"{words} after {number.name}: {found}", flush=True)
            yield "lost or changed"

    def _long(self, command: str, rng: random.Random) -> Iterator[str]:
        """A signal to a command that would take minutes."""
        shutil.rmtree(self.out, ignore_errors=True)
        name = {"run": "frames", "generate": "shards"}[command]
        words = [command, str(self.good / f"{name}.toml"), "-o", str(self.out), "--quiet"]
        yield from self._ended(words, rng.choice((signal.SIGINT, signal.SIGTERM)), rng.uniform(0.0, 4.0))

    def _ended(self, words: list[str], number: signal.Signals, delay: float) -> Iterator[str]:
        """Send a signal to a call after some seconds; yields the faults of its outcome."""
        outcome, late = common.run_and_signal(lambda: cli.main(words), number, delay, MOST)
        self.ends += [late] if late else []
        found = [outcome.kind] if outcome.kind in ("crash", "traceback") else []
        if outcome.kind == "time limit" or late > SOON:
            found.append("late end")
        expected = {0, -number}  # the signal itself ends a process whose command has ended
        if number != signal.SIGKILL:
            expected |= {STATUS[number], 130 if words[0] == "run" else 0}
        if outcome.kind == "ok" and outcome.status not in expected:
            found.append("wrong exit status")
        if number != signal.SIGKILL and (left := self._hidden()):
            found.append("files left")
            print(left, flush=True)
        if found:
            when = f"{number.name} after {delay:.3f} s, ended after {late:.2f} s of CPU time with {outcome.status}"
            print(f"{words} with {when}: {outcome.text[-2000:]}", flush=True)
        yield from found

    def _hidden(self) -> list[str]:
        return [str(p.relative_to(self.out)) for p in self.out.rglob("*") if p.name.startswith(".")]

    def _differences(self, expected: Path) -> Iterator[str]:
        """Files that are not as expected; of the record of a run, only the summary may differ: it has times."""
        names = {p.relative_to(top) for top in (expected, self.out) for p in top.rglob("*") if not p.is_dir()}
        for name in sorted(names):
            both = [top / name for top in (expected, self.out)]
            if not all(p.exists() for p in both):
                yield f"{name} is {'too few' if both[0].exists() else 'too many'}"
            elif name.name == "run.json":
                first, second = (json.loads(p.read_bytes()) for p in both)
                if first["fingerprint"] != second["fingerprint"] or first["scene"] != second["scene"]:
                    yield str(name)
            elif len({STAMP.sub(b"", p.read_bytes()) for p in both}) == 2:
                yield str(name)


def fuzz(folder: Path, counts: dict[str, int], seed: int) -> list[dict[str, Any]]:
    """A row of counts for each part, such as "run, kills"."""
    exports = any(part.startswith("export") for part in counts)
    program, rows = Interruptions(folder, exports), []
    for part, count in counts.items():
        command, _, kind = part.partition(", ")
        faults: Counter[str] = Counter()
        begin, program.ends = time.monotonic(), []
        for number in range(count):
            found = list(program.case(command, kind == "kills", random.Random(f"{seed} {part} {number}")))
            if found:
                print(f"{part} {number}: {', '.join(found)}\n", flush=True)
            faults.update(set(found))
        figures = dict(zip(FIGURES, (len(program.ends), max(program.ends, default=0.0)), strict=True))
        row = {"part": part, "cases": count, **{c: faults[c] for c in COLUMNS}, **figures}
        rows.append({**row, "seconds": time.monotonic() - begin})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100, help="of each command")
    parser.add_argument("--signals", type=int, default=100, help="of each command")
    parser.add_argument("--commands", nargs="+", default=COMMANDS, choices=COMMANDS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=benchmark.RESULTS)
    arguments = parser.parse_args()
    counts = {f"{c}, {kind}": getattr(arguments, kind) for c in arguments.commands for kind in ("kills", "signals")}
    title, name = "Interrupted commands", "fuzz_interruptions"
    sys.exit(common.report(fuzz, counts, arguments.seed, COLUMNS, title, name, arguments.out, FIGURES))


if __name__ == "__main__":
    main()
