"""Runs under external faults: mutated scene files, kills, full disks, damaged run folders.

    python -m benchmarks.fuzz.runs --mutations 1000 --kills 100 --disks 100 --corrupt 100 --seed 0

Counts crashes, tracebacks, exit status 0 with wrong results, calls that do not end, and frames lost or changed against
a run left in peace; the exit status is 1 if there is any. Faults are printed with the number of their case.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import random
import re
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from torch_mpm import Trajectory, cli
from torch_mpm.scene import writer

from .. import common as benchmark
from . import common, corruptions, scene_mutations

COLUMNS = ("crash", "traceback", "wrong exit status 0", "time limit", "lost frames")
SCENE = """
device = "cpu"
gravity = [0.0, -10.0]
duration = 0.4
fps = 50
output.fields = ["F"]
grid = {lower = [0.0, 0.0], upper = [1.0, 1.0], dx = 0.1}
material.jelly = {law = "neo_hookean", E = 1e4}
[[body]]
shape = "sphere"
center = [0.4, 0.3]
radius = 0.2
spin = 3.0
material = "jelly"
[[emitter]]
center = [0.8, 0.7]
radius = 0.1
velocity = [-1.0, 0.5]
material = "jelly"
end = 0.2
"""
PICTURES = "render={resolution = [160, 120], video = false, every = 10, range = [0.0, 3.0]}"
HALF = 8
"""Frame after which the unfinished run of the corrupted folders was killed."""


class Fuzz:
    """The cases of all parts, in one temporary folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.out = folder, folder / "out"
        self.scene = folder / "scene.toml"
        self.scene.write_text(SCENE)
        scene_mutations.prepare(folder)
        self.whole = folder / "whole"
        self._warm()
        begin = time.monotonic()
        self._succeed("run", self.scene, "-o", self.whole, "--quiet")
        self.seconds = time.monotonic() - begin
        with Trajectory(self.whole) as read:
            self.frames = {name: read.file[name][:] for name in read.file}
        self.half = folder / "half"
        common.run(lambda: at_frame(HALF, lambda: os.kill(os.getpid(), signal.SIGKILL), self._resume(self.half)))

    def _warm(self) -> None:
        """Reference run with pictures and exports, for comparison with damaged runs; a scene of each kind."""
        good = self.folder / "good"
        self._succeed("run", self.scene, "-o", good, "--quiet")
        self._succeed("export", good, "--ply")
        self._succeed("render", good, "--set", PICTURES)
        for words in scene_mutations.BASES:
            path = self.folder / "base.toml"
            path.write_text(scene_mutations.toml(words))
            self._succeed("check", path)

    def _succeed(self, *arguments: object) -> None:
        """Import and initialise in this process, once for all children."""
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            status = cli.main([str(a) for a in arguments])
        if status:
            raise RuntimeError(f"{arguments} ended with exit status {status}")

    def _resume(self, out: Path) -> Callable[[], int]:
        return lambda: cli.main(["run", str(self.scene), "-o", str(out), "--quiet", "--resume"])

    def _lost(self) -> int:
        """Frames of the run in ``out`` that are missing or differ from those of the reference run."""
        try:
            with Trajectory(self.out) as read:
                same = [
                    all(read.file[name][k].tobytes() == self.frames[name][k].tobytes() for name in read.columns)
                    for k in range(len(read))
                ]
                statics = all(read[name].tobytes() == self.frames[name].tobytes() for name in ("mass", "material"))
        except (OSError, ValueError) as error:
            print(f"  {error}")
            return len(self.frames["time"])
        return len(self.frames["time"]) - sum(same) * statics

    def _finished(self) -> Iterator[str]:
        """Resume the run in ``out``, which must end with all frames."""
        outcome = common.run(self._resume(self.out))
        if outcome.status and "complete run" not in outcome.text:
            yield "traceback" if outcome.kind == "ok" else outcome.kind
            print(outcome.text)
        yield from ["lost frames"] * self._lost()

    # -- parts: each yields the faults of one case

    def mutation(self, rng: random.Random) -> Iterator[str]:
        path = self.folder / "mutated.toml"
        text, wrong = scene_mutations.mutated(rng)
        path.write_bytes(text.encode(errors="surrogateescape"))
        command = rng.choice((["check"], ["check"], ["info"], ["run", "-o", str(self.out), "--quiet"]))
        arguments = [command[0], str(path), *command[1:]]
        outcome = common.run(lambda: cli.main(arguments), must_fail=wrong, seconds=20)
        if outcome.kind == "time limit" and command[0] == "run":
            return  # a long run is no fault
        if outcome.kind != "ok":
            print(f"{command[0]}: {text}\n{outcome.text[-2000:]}")
            yield outcome.kind

    def kill(self, rng: random.Random) -> Iterator[str]:
        for _ in range(rng.randint(1, 3)):
            outcome = common.run(self._resume(self.out), seconds=rng.uniform(0, self.seconds))
            if outcome.kind in ("crash", "traceback"):
                yield outcome.kind
        yield from self._finished()

    def disk(self, rng: random.Random) -> Iterator[str]:
        # The checksums that every frame writes lie beyond nine tenths of the file.
        size = int((self.whole / "trajectory.h5").stat().st_size * rng.uniform(0, 0.9))
        limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))  # noqa: E731
        frame = rng.choice((None, rng.randrange(20)))

        def work() -> int:
            if frame is not None:
                return at_frame(frame, limit, self._resume(self.out))
            limit()
            return self._resume(self.out)()

        outcome = common.run(work, must_fail=True)
        if outcome.kind == "ok" and "no room on the disk" not in outcome.text:
            yield "traceback"
        elif outcome.kind != "ok":
            yield outcome.kind
        yield from self._finished()

    def corruption(self, rng: random.Random) -> Iterator[str]:
        unfinished = rng.random() < 0.6
        shutil.copytree(self.half if unfinished else self.whole, self.out)
        what = corruptions.corrupt(self.out, rng)
        for command in ("render", "export", "resume") if unfinished else ("render", "export"):
            result = {"render": "frames", "export": "ply"}.get(command)
            arguments = [command, str(self.out), *(["--ply"] if command == "export" else ["--set", PICTURES])]
            work = self._resume(self.out) if command == "resume" else lambda a=arguments: cli.main(a)
            outcome = common.run(work, memory=2 << 30)
            kind = outcome.kind
            if kind == "ok" and outcome.status == 0:
                right = self._lost() == 0 if result is None else self._same(result)
                kind = "ok" if right else "wrong exit status 0"
            if kind != "ok":
                print(f"{command}, {what}: {outcome.text[-2000:]}")
                yield kind

    def _same(self, name: str) -> bool:
        """Whether pictures or exports are those of the whole run."""
        good = self.folder / "good" / name
        made = sorted((self.out / name).iterdir())
        return all(undated(path) == undated(good / path.name) for path in made)


def undated(path: Path) -> bytes:
    """Content of a file without the date comment of PLY files."""
    return re.sub(rb"comment Created by .*\n", b"", path.read_bytes(), count=1)


def at_frame(frame: int, action: Callable[[], Any], work: Callable[[], int]) -> int:
    """Do ``work``, and ``action`` at the end of a frame. For child processes only, since it patches modules."""
    submit = writer.FrameWriter.submit

    def and_act(self: Any, handed: writer.Frame) -> None:
        if handed.number == frame:
            action()
        submit(self, handed)

    writer.FrameWriter.submit = and_act  # type: ignore[method-assign]
    return work()


def fuzz(folder: Path, counts: dict[str, int], seed: int) -> list[dict[str, Any]]:
    """A row of counts for each part; ``counts`` is the number of cases of each."""
    program = Fuzz(folder)
    parts = {"mutations": program.mutation, "kills": program.kill, "disks": program.disk, "corrupt": program.corruption}
    rows = []
    for part, work in parts.items():
        faults: Counter[str] = Counter()
        begin = time.monotonic()
        for number in range(counts[part]):
            found = list(work(random.Random(f"{seed} {part} {number}")))
            shutil.rmtree(program.out, ignore_errors=True)
            if found:
                print(f"{part} {number}: {', '.join(sorted(set(found)))}", flush=True)
            faults.update(found)
        seconds = time.monotonic() - begin
        rows.append({"part": part, "cases": counts[part], **{c: faults[c] for c in COLUMNS}, "seconds": seconds})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for part, count in {"mutations": 1000, "kills": 100, "disks": 100, "corrupt": 100}.items():
        parser.add_argument(f"--{part}", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=benchmark.RESULTS)
    arguments = parser.parse_args()
    counts = {part: getattr(arguments, part) for part in ("mutations", "kills", "disks", "corrupt")}
    sys.exit(common.report(fuzz, counts, arguments.seed, COLUMNS, "Fuzzed runs", "fuzz_runs", arguments.out))


if __name__ == "__main__":
    main()
