"""Calls of all ops and of the public functions with malformed arguments.

`python -m benchmarks.fuzz.calls [--calls N] [--seed S] [--only NAME]` changes one to three arguments of valid calls at
random and makes them in child processes. A call may work, or end in a clear error: one of `CLEAR` whose message is not
Python's own about something inside. Anything else is a fault, a crash above all; faults are listed by callable and
argument, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import faulthandler
import functools
import itertools
import json
import os
import random
import re
import resource
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch starts threads: a forked child has none of them

import torch

from benchmarks import common
from benchmarks.fuzz import operators, public
from benchmarks.fuzz.common import Outcome, run
from benchmarks.fuzz.mutations import mutate

CLEAR = (RuntimeError, ValueError, TypeError, NotImplementedError)  # SimulationError is a RuntimeError
INTERNAL = re.compile(
    r"has no attribute|not supported between|unsupported operand|object is not|is not iterable|to unpack|"
    r"object does not support|bad operand type|must be real number|cannot be interpreted as|cannot unpack|"
    r"INTERNAL ASSERT|API call failed|bad_alloc|std::|maximum recursion|only one element tensors|"
    r"Boolean value of Tensor|list index|indices must be|invalid combination of arguments|"
    r"has no len|(float|int)\(\) argument|unhashable|not subscriptable|can't multiply|only concatenate",
)
"""Messages about internals, which name no argument."""
BATCH = 400
"""Number of calls per child process."""
Arguments, Changes = dict[str, Any], dict[str, tuple[str, Any]]
CPU_SECONDS, SECONDS, MEMORY = 60, 600.0, 2 << 30
"""Limits of a child process: CPU time [s], time [s], memory [bytes]. The time allows for a busy machine."""
SUSPECTS = 20
"""Number of calls before the end of a crashed child that are repeated alone."""
PUBLIC = 0.2
"""Fraction of calls of public functions; the others are calls of ops."""
FAULTS = ("crash", "time limit", "unclear")


@dataclasses.dataclass(frozen=True)
class Result:
    """A call: its name, the changes of its arguments, and its outcome."""

    number: int
    name: str
    changes: tuple[tuple[str, str], ...]
    end: str
    error: str = ""


# ---- one call


@functools.cache
def raw_calls() -> dict[str, list[dict[str, Any]]]:
    """Valid arguments by op."""
    found: dict[str, list[dict[str, Any]]] = {}
    for dim, dtype in itertools.product((2, 3), (torch.float32, torch.float64)):
        for op, arguments in operators.calls(dim, dtype):
            found.setdefault(f"ops.{op}", []).append(arguments)
    return found


@functools.cache
def public_calls() -> dict[str, Callable[[], public.Call]]:
    return public.calls()


def names() -> list[str]:
    return sorted(raw_calls().keys() | public_calls().keys())


def malformed(seed: int, number: int, only: str | None = None) -> tuple[str, Callable[..., Any], Arguments, Changes]:
    """(name, callable, valid arguments, changes of some), determined by seed and number."""
    choose = random.Random(f"{seed} {number}")
    if only is None:
        only = choose.choice(sorted(public_calls() if choose.random() < PUBLIC else raw_calls()))
    function: Callable[..., Any]
    if only in raw_calls():
        function = getattr(torch.ops.torch_mpm, only.removeprefix("ops."))
        arguments = choose.choice(raw_calls()[only])
    else:
        function, arguments = public_calls()[only]()
    torch.manual_seed(number)
    changed = choose.sample(list(arguments), min(choose.choice((1, 1, 2, 3)), len(arguments)))
    others = list(arguments.values())
    return only, function, arguments, {a: mutate(a, arguments[a], others, choose) for a in changed}


def call(seed: int, number: int, only: str | None = None) -> Result:
    """Outcome of a call. After an unclear error the call is repeated with each change alone, to find the argument."""
    name, *_, changes = malformed(seed, number, only)
    texts = {argument: text for argument, (text, _) in changes.items()}
    end, error = _end(seed, number, only, list(changes))
    if end == "unclear" and len(changes) > 1:
        for argument in changes:
            if (alone := _end(seed, number, only, [argument]))[0] == end:
                return Result(number, name, ((argument, texts[argument]),), *alone)
    return Result(number, name, tuple(texts.items()), end, error)


def _end(seed: int, number: int, only: str | None, chosen: Sequence[str]) -> tuple[str, str]:
    """Outcome of a call with the chosen changes, and its error."""
    name, function, arguments, changes = malformed(seed, number, only)
    arguments = arguments | {argument: changes[argument][1] for argument in chosen}
    try:
        if name in raw_calls():  # positional: a list of results has the names of some arguments
            function(*arguments.values())
        else:
            function(**arguments)
    except Exception as error:
        return "clear error" if is_clear(error) else "unclear", f"{type(error).__name__}: {str(error)[:200]}"
    return "ok", ""


def is_clear(error: Exception) -> bool:
    """Whether an error is of a kind that is meant for callers, and its message not Python's about something inside.

    Torch checks the types of an op's arguments itself, and names them.
    """
    message = str(error)
    if re.search(r"torch_mpm::\w+\(\)", message):
        return True
    return isinstance(error, CLEAR) and bool(message) and not INTERNAL.search(message)


# ---- many calls, in children


def child(seed: int, numbers: Iterable[int], only: str | None) -> int:
    """Makes calls; writes the number of each before, and its result after it."""
    warnings.simplefilter("ignore")
    faulthandler.disable()  # pytest's writes pages about a crash
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    for number in numbers:
        os.write(1, f"\n{number}\n".encode())  # not through sys.stdout, which pytest replaces
        result = call(seed, number, only)
        os.write(1, (json.dumps([result.name, result.changes, result.end, result.error]) + "\n").encode())
    return 0


def results(seed: int, numbers: Sequence[int], only: str | None = None) -> list[Result]:
    """Results of calls in a child process; after a crash the remaining calls continue in another one."""
    outcome = _run(seed, numbers, only)
    found, started = [], None
    for line in outcome.text.splitlines():
        if line.isdigit():
            started = int(line)
        elif line.startswith("[") and started is not None:
            name, changes, end, error = json.loads(line)
            found.append(Result(started, name, tuple(map(tuple, changes)), end, error))
    if outcome.kind == "ok" and len(found) == len(numbers):
        return found
    last = len(found) if len(found) < len(numbers) else len(numbers) - 1
    culprit = _culprit(seed, numbers[: last + 1], only, outcome.kind)
    return (
        [r for r in found if r.number < numbers[last]]
        + [culprit]
        + (results(seed, numbers[last + 1 :], only) if numbers[last + 1 :] else [])
    )


def _run(seed: int, numbers: Sequence[int], only: str | None) -> Outcome:
    outcome = run(functools.partial(child, seed, numbers, only), seconds=SECONDS, memory=MEMORY)
    return dataclasses.replace(outcome, kind="time limit") if outcome.status == -signal.SIGXCPU else outcome


def _culprit(seed: int, numbers: Sequence[int], only: str | None, kind: str) -> Result:
    """Which of the last calls, each in a child of its own, ends the process; the last one if none does alone."""
    for number in reversed(numbers[-SUSPECTS:]):
        outcome = _run(seed, [number], only)
        if outcome.kind != "ok":
            return _ended(seed, number, only, outcome.kind, outcome.text.strip()[-200:])
    return _ended(seed, numbers[-1], only, kind, "not alone, after the calls before it")


def _ended(seed: int, number: int, only: str | None, kind: str, text: str) -> Result:
    name, *_, changes = malformed(seed, number, only)
    return Result(number, name, tuple((argument, done) for argument, (done, _) in changes.items()), kind, text)


def fuzz(calls: int, seed: int, only: str | None = None) -> Iterator[Result]:
    torch.set_num_threads(1)
    raw_calls()  # before the fork, and so once
    for first in range(0, calls, BATCH):
        yield from results(seed, range(first, min(first + BATCH, calls)), only)


# ---- report


def table(found: Sequence[Result]) -> str:
    """A row of each callable, in Markdown."""
    columns, rows = ("ok", "clear error", *FAULTS), []
    for name in [*sorted({r.name for r in found}), "all"]:
        ends = [r.end for r in found if name in (r.name, "all")]
        rows.append((name, len(ends), *(ends.count(c) for c in columns)))
    return common.table(("callable", "calls", *columns), rows)


def faults(found: Sequence[Result]) -> list[dict[str, Any]]:
    """Faults by callable, changed arguments and message, each with an example."""
    groups = collections.defaultdict(list)
    for r in found:
        if r.end in FAULTS:
            key = (r.name, ", ".join(sorted(a for a, _ in r.changes)), r.end, _kind_of(r.error))
            groups[key].append(r)
    return [
        {"callable": key[0], "arguments": key[1], "end": key[2], "calls": len(same), "example": vars(same[0])}
        for key, same in sorted(groups.items())
    ]


def _kind_of(error: str) -> str:
    """A message without the types, names and numbers of one call."""
    return re.sub(r"'[^']*'|\d[\d.e+-]*", "…", error)[:60]


def write(out: Path, found: Sequence[Result], seed: int, seconds: float) -> None:
    listed, place = faults(found), common.environment()
    ends = collections.Counter(r.end for r in found)
    result = {"environment": place, "calls": len(found), "seed": seed, "seconds": round(seconds), "ends": ends}
    lines = [
        f"# {len(found)} calls with malformed arguments, seed {seed}",
        "",
        common.describe(place),
        "",
        table(found),
    ]
    for fault in listed:
        changes = "; ".join(f"`{name}` {done}" for name, done in fault["example"]["changes"])
        lines.append(
            f"- {fault['callable']}, {fault['end']} ({fault['calls']}): {changes}: {fault['example']['error']}"
        )
    common.write(out, "fuzz_calls", {**result, "faults": listed}, "\n".join(lines) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", metavar="NAME", help="one callable: " + ", ".join(names()))
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    start = time.monotonic()
    found: list[Result] = []
    try:
        for result in fuzz(arguments.calls, arguments.seed, arguments.only):
            found.append(result)
            if len(found) % 5000 == 0:
                print(f"{len(found)} calls, {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        print(f"stopped after {len(found)} calls", file=sys.stderr)
    write(arguments.out, found, arguments.seed, time.monotonic() - start)
    print(table(found))
    bad = [r for r in found if r.end in FAULTS]
    for fault in faults(found):
        print(fault["calls"], fault["callable"], fault["end"], fault["example"]["changes"], fault["example"]["error"])
    sys.exit(f"{len(bad)} faults" if bad else 0)


if __name__ == "__main__":
    main()
