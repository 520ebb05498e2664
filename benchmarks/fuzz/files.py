"""Command lines, files from elsewhere, damaged data sets and limits of memory: no command trusts any of them.

    python -m benchmarks.fuzz.files --lines 600 --inputs 200 --shards 100 --records 1000 --memory 500 --seed 0

Faults are crashes, tracebacks, calls that do not end, false success, unclear messages, and files outside of the folder
that a command is given. The exit status is 1 if there is a fault. A fault is printed with the number of its case and
the output of the command.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tomllib

from torch_mpm import Trajectory, cli
from torch_mpm.data.finish import verify
from torch_mpm.data.folder import DatasetFolder

from .. import common as benchmark
from . import command_lines, common, forged_shards, hostile_inputs, mutated_records, scene_mutations

COLUMNS = ("crash", "traceback", "wrong exit status 0", "time limit", "unclear message", "written outside")
MOST_LETTERS, MOST_LINES = 24_000, 60
"""Largest number of letters and lines of a message."""
MANY_SUBSTEPS = 10**6
"""Number of substeps from which a run may exceed the time limit."""
UNCLEAR = re.compile(r"^torch-mpm: ?(['\"]?[\w.]*['\"]?)?$|Error\b.*object at 0x", re.MULTILINE)
"""Uninformative messages: none, a single word, or the address of an object."""
SCENE = """
device = "cpu"
gravity = [0.0, -10.0]
duration = 0.02
fps = 100
output.fields = ["F"]
grid = {lower = [0.0, 0.0], upper = [1.0, 1.0], dx = 0.1, walls = "separate"}
material.jelly = {law = "neo_hookean", E = 1e4}
[[body]]
shape = "sphere"
center = [0.5, 0.5]
radius = 0.15
material = "jelly"
[[obstacle]]
shape = "sphere"
center = [0.5, 0.1]
radius = 0.1
[[emitter]]
center = [0.8, 0.8]
radius = 0.06
velocity = [-1.0, 0.0]
material = "jelly"
"""
SOLID = """
device = "cpu"
duration = 0.01
fps = 100
grid = {lower = [0.0, 0.0, 0.0], upper = [1.0, 1.0, 1.0], dx = 0.2}
material.jelly = {law = "neo_hookean", E = 1e4}
render = {resolution = [160, 120], video = false}
[[body]]
shape = "box"
lower = [0.3, 0.3, 0.3]
upper = [0.7, 0.7, 0.7]
material = "jelly"
"""
SET = """
device = "cpu"
gravity = [0.0, -10.0]
grid = {lower = [0.0, 0.0], upper = [1.0, 1.0], dx = 0.1, walls = "separate"}
[dataset]
splits = {train = 2, test = 1}
frames = 4
interval = 0.005
scenes_per_shard = 2
fields = ["velocity", "F", "stress"]
[material.jelly]
law = "neo_hookean"
E = {log_uniform = [1e4, 1e5]}
[[body]]
count = {integers = [1, 2]}
material = "jelly"
center = {in_box = [[0.2, 0.4], [0.8, 0.8]]}
choice = [{shape = "sphere", radius = 0.12}]
[[obstacle]]
shape = "sphere"
center = [0.5, 0.15]
radius = 0.1
"""
CONFIGURED: list[Any] = [
    *scene_mutations.NASTY,
    *({"uniform": [0.1, 0.2]}, {"uniform": [1, 0]}, {"uniform": ["a", 1]}, {"uniform": []}, {"uniform": 3}),
    *({"log_uniform": [-1.0, 1.0]}, {"normal": [0.5, -1.0]}, {"normal": [0.5, 0.01]}, {"integers": [0, 10**9]}),
    *({"integers": [2, 1]}, {"integers": [0.5, 1.5]}, {"choice": []}, {"choice": [1, "x"]}, {"choice": {"a": 1}}),
    *({"direction": 1.0}, {"in_box": [[0.4, 0.4], [0.6, 0.6]]}, {"in_box": [[0.6, 0.6], [0.4, 0.4]]}, {"in_box": 1}),
    *({"uniform": [0, 1], "normal": [0, 1]}, {"train": 2}, {"train": -1}, {"../x": 2}, {"train": 0, "test": 1}),
    *(["position"], ["F", "F"], ["velocity", "nope"], {"jelly": 5}, {"nope": 5}, {"jelly": 500}),
]
"""Values for configurations of data sets: distributions, right and wrong, splits, names of fields and types."""


class Fuzz:
    """The cases of all parts, in one temporary folder.

    ``inputs`` hold a scene, a configuration, a run and a data set, ``out`` is what commands write, ``here`` is the
    folder that they start in.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.good = folder, folder / "good"
        self.case, self.here = folder / "case", folder / "here"
        self.inputs, self.out = self.case / "in", self.case / "out"
        for made in (self.good, self.here):
            made.mkdir()
        (self.good / "scene.toml").write_text(SCENE)
        (self.good / "solid.toml").write_text(SOLID)
        (self.good / "set.toml").write_text(SET)
        common.succeed("run", self.good / "scene.toml", "-o", self.good / "run", "--quiet")
        common.succeed("generate", self.good / "set.toml", "-o", self.good / "set", "--quiet")
        common.succeed("finalize", self.good / "set")
        hostile_inputs.prepare(self.good)
        self._warm()
        self.around = self._outside()

    def _warm(self) -> None:
        """Import the modules that commands need, once for all children."""
        made = self.folder / "warm"
        for arguments in (
            ["stats", self.good / "set", "-o", made / "x.png"],
            ["render", self.good / "set", "-o", made / "pictures", "--no-video"],
            *(["export", self.good / "set", "-o", made / name, "--format", name] for name in command_lines.FORMATS[:4]),
        ):
            common.succeed(*arguments)
        shutil.rmtree(made)

    def _outside(self) -> dict[str, tuple[int, int]]:
        """Sizes and times of all files that commands must not change."""
        places = [p for top in (self.good, self.here) for p in (top, *top.rglob("*"))] + list(self.folder.iterdir())
        return {str(p): (s.st_size, s.st_mtime_ns) for p in places if p != self.case and (s := p.lstat())}

    @contextlib.contextmanager
    def prepared(self) -> Iterator[None]:
        """Fresh inputs for a case, removed after it."""
        shutil.copytree(self.good, self.inputs, symlinks=True)
        try:
            yield
        finally:
            shutil.rmtree(self.case)

    def faults(self, arguments: Iterable[object], must_fail: bool = False, **limits: Any) -> Iterator[str]:
        """Run a command in a child process; yields the faults of its outcome."""
        words = [str(a) for a in arguments]

        def work() -> int:
            os.chdir(self.here)
            return cli.main(words)

        outcome = common.run(work, must_fail=must_fail, **{"seconds": 60.0, **limits})
        found = [] if outcome.kind == "ok" or self._is_long(outcome, words) else [outcome.kind]
        if outcome.kind == "ok" and outcome.status == 0:
            found += self._false_success(words, outcome.text)
        elif outcome.kind == "ok":
            lines = outcome.text.splitlines()
            if len(outcome.text) > MOST_LETTERS or len(lines) > MOST_LINES or UNCLEAR.search(outcome.text):
                found.append("unclear message")
        if self._outside() != self.around:
            found.append("written outside")
            self.around = self._outside()
        if found:
            print(f"{[w if len(w) < 100 else w[:100] + '...' for w in words]}: {outcome.text[-3000:]!s}", flush=True)
        yield from found

    def _is_long(self, outcome: common.Outcome, words: list[str]) -> bool:
        """Whether a run was killed for having more substeps than the time allows, as counted by `check`."""
        if outcome.kind != "time limit" or words[0] != "run":
            return False
        sets = [word for k, word in enumerate(words) if "--set" in words[max(0, k - 1) : k + 1]]
        check = common.run(lambda: cli.main(["check", words[1], *sets]))
        count = re.search(r"about (\S+) substeps", check.text)
        return count is not None and float(count[1]) > MANY_SUBSTEPS

    def _false_success(self, words: list[str], text: str) -> Iterator[str]:
        """Fault: exit status 0 of a command without a valid result."""
        if words[0] == "run":
            with Trajectory(Path(words[words.index("-o") + 1])) as read:
                if not (read.complete and all(np.isfinite(frame["position"]).all() for frame in read)):
                    yield "wrong exit status 0"
        elif words[0] == "generate" and "-o" in words and "--check" not in words:
            folder = Path(words[words.index("-o") + 1])
            unread = "were not read" in text  # A set that is resumed is not verified, and `generate` says so.
            if not DatasetFolder(folder).scenes() or (list(verify(folder)) and not unread):
                yield "wrong exit status 0"
        elif words[0] in ("export", "render", "stats") and "-o" in words:
            made = Path(words[words.index("-o") + 1])
            if not made.exists() or (made.is_dir() and not any(made.iterdir())):
                yield "wrong exit status 0"

    # -- parts: each yields the faults of one case

    def line(self, rng: random.Random) -> Iterator[str]:
        with self.prepared():
            yield from self.faults(command_lines.random_line(rng, self.inputs, self.out), memory=2 << 30)

    def input(self, rng: random.Random) -> Iterator[str]:
        with self.prepared():
            command, what = hostile_inputs.hostile(self.inputs, self.out, rng)
            found = list(self.faults(command, memory=2 << 30))
            if found:
                print(f"  {what}", flush=True)
            yield from found

    def configuration(self, rng: random.Random) -> Iterator[str]:
        """A configuration of a data set with one to three mistakes."""
        with self.prepared():
            words = tomllib.loads(SET)
            wrong = scene_mutations.mistakes(words, CONFIGURED, rng)
            (self.inputs / "mutated.toml").write_text(text := scene_mutations.toml(words), errors="surrogateescape")
            command = ["generate", self.inputs / "mutated.toml", "-o", self.out, "--quiet"]
            found = list(self.faults(command, wrong, memory=2 << 30))
            if found:
                print(text[:3000], flush=True)
            yield from found

    def shard(self, rng: random.Random) -> Iterator[str]:
        with self.prepared():
            what, wrong = forged_shards.forge(self.inputs / "set", rng)
            yield from self._read_set(what, wrong, rng)

    def record(self, rng: random.Random) -> Iterator[str]:
        with self.prepared():
            what, wrong = mutated_records.mutate(self.inputs, rng)
            if what.startswith("run"):
                run = self.inputs / "run"
                resume = ["run", self.inputs / "scene.toml", "-o", run, "--resume", "--quiet"]
                command = rng.choice([["render", run], ["export", run], resume])
                found = list(self.faults(command, wrong and command[0] != "export"))  # which needs no record
                if found:
                    print(f"  {what}", flush=True)
                yield from found
            else:
                yield from self._read_set(what, wrong, rng)

    def _read_set(self, what: str, wrong: bool, rng: random.Random) -> Iterator[str]:
        """Faults of `verify`, which must fail if the data set is ``wrong``, and of another command that reads it."""
        folder = self.inputs / "set"
        found = list(self.faults(["verify", folder], wrong, memory=2 << 30))
        others: list[list[Any]] = [
            ["stats", folder, "-o", self.out / "x.png"],
            ["finalize", folder],
            ["render", folder, "-o", self.out, "--no-video"],
            ["generate", self.inputs / "set.toml", "-o", folder, "--quiet"],
            ["generate", self.inputs / "set.toml", "-o", folder, "--quiet", "--extend", "train=3"],
            *(["export", folder, "-o", self.out, "--format", name] for name in command_lines.FORMATS),
        ]
        found += list(self.faults(rng.choice(others), memory=2 << 30))
        if found:
            print(f"  {what}", flush=True)
        yield from found

    def limited(self, count: int, seed: int) -> Iterator[list[str]]:
        """Faults of commands under memory limits, in a process that has imported torch_mpm only."""
        words = [sys.executable, "-m", "benchmarks.fuzz.memory_limits", str(self.folder), str(count), str(seed)]
        with subprocess.Popen(words, cwd=benchmark.ROOT, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                found = json.loads(line)
                if found["fault"]:
                    print(f"{found['command']} with {found['memory'] / 1e6:.1f} MB: {found['text']}", flush=True)
                yield [found["fault"]] if found["fault"] else []
        if process.returncode:
            raise RuntimeError(f"{words} ended with exit status {process.returncode}")


def fuzz(folder: Path, counts: dict[str, int], seed: int) -> list[dict[str, Any]]:
    """A row of counts for each part; ``counts`` is the number of cases of each."""
    program = Fuzz(folder)
    parts: dict[str, Callable[[random.Random], Iterator[str]]] = {
        "lines": program.line, "inputs": program.input, "configurations": program.configuration,
        "shards": program.shard, "records": program.record,
    }  # fmt: skip
    rows = []
    for part, count in counts.items():
        faults: Counter[str] = Counter()
        begin = time.monotonic()
        generators = (random.Random(f"{seed} {part} {number}") for number in range(count))
        cases = program.limited(count, seed) if part == "memory" else map(list, map(parts[part], generators))
        for number, found in enumerate(cases):
            if found:
                print(f"{part} {number}: {', '.join(sorted(set(found)))}\n", flush=True)
            faults.update(found)
        seconds = time.monotonic() - begin
        rows.append({"part": part, "cases": count, **{c: faults[c] for c in COLUMNS}, "seconds": seconds})
    return rows


COUNTS = {"lines": 600, "inputs": 200, "configurations": 400, "shards": 100, "records": 1000, "memory": 500}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for part, count in COUNTS.items():
        parser.add_argument(f"--{part}", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=benchmark.RESULTS)
    arguments = parser.parse_args()
    counts = {part: getattr(arguments, part) for part in COUNTS}
    sys.exit(common.report(fuzz, counts, arguments.seed, COLUMNS, "Fuzzed files", "fuzz_files", arguments.out))


if __name__ == "__main__":
    main()
