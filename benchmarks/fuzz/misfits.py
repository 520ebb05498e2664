"""Calls of all ops and of the public functions with one argument that does not fit, which must be refused by its name.

`python -m benchmarks.fuzz.misfits [--calls N] [--seed S] [--only NAME]` replaces one argument of valid calls at random:
a tensor by one of another length, number of dimensions, dtype or device, a number by a word or NaN, a name by another
name, anything by an object of another kind, and adds arguments of unknown names. A call must raise one of `REFUSALS`,
and the message must name the argument. What is accepted, ends in another error or without the name is a fault; what may
be accepted stands in `FITTING`, with the reason. `calls` looks for crashes in a wider range of changes.
"""

from __future__ import annotations

import argparse
import collections
import json
import math
import os
import random
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.fuzz import calls
from benchmarks.fuzz.common import run
from torch_mpm.ops import LAWS

REFUSALS = (TypeError, ValueError)
"""Errors of public functions; ops may raise a RuntimeError too."""
BATCH = 500
"""Number of calls per child process."""
FAULTS = ("accepted", "another error", "unnamed", "crash")


class Stranger:
    """Object of a type that no function accepts."""


OTHERS: dict[str, Any] = {"None": None, "a word": "neo", "a dict": {}, "a stranger": Stranger(), "complex": 1j}
"""Values of other kinds, for any argument."""

OPTIONAL = (
    "C|F|J|affine|ambient|angular_velocity|boundaries|checkpoint|cohesion|device|dtype|exchange|fixed|friction_angle|"
    "friction|gradient|grad_.*|gravity|heat|held|hook|ids|images|impulse|latent_heat|local|lower|material|max_blocks|"
    "melting_point|moment|norms|obstacles|particles|previous.*|record|rotation|scene|scene_.*|scenes|source|stiffness|"
    "stress|temperature|theta|truncate|upper|velocity|viscosity|volume|volume_correction|walls|along_.*|energy|speed|"
    "nodes|dim|walls|on_grid|on_particles|graph|normal|extra|data|parameter|end|(x_)?residual"
)
FLAGS = (
    "affine",
    "apic",
    "deterministic",
    "details",
    "energy",
    "gradient",
    "grows",
    "choose",
    "moment",
    "projected",
    "records",
    "resident",
    "volumetric",
    "wants_.*",
)
NUMBERS = "time|dt|cfl|longest|start|end|moment_scale|numbers|adjoint_tolerance|.*tolerance|bound|kept|reach|upper|flip"
REAL = r"torch\.(float16|float64|int64|bool)"
SHAPES = "(Sphere|Plane|Box|Capsule|SDF|Revolved)"
FITTING: tuple[tuple[str, str, str, str], ...] = (
    (".*", OPTIONAL, "None", "optional"),
    ("ops[.].*", ".*", "on meta", "an argument on meta makes a fake call"),
    ("ops[.].*", "|".join(FLAGS), "= .*|None|complex", "torch makes a bool of it"),
    (
        "ops[.].*",
        NUMBERS,
        ".*NaN",
        "numbers that no memory depends on; the functions that call the ops have checked them",
    ),
    ("(law_|ops[.]substeps).*", "parameters", r"[[]\d[]] one dimension more", "a tensor [1]"),
    ("ops[.]plan_substeps", ".*", "= .*|complex|None", "torch makes a bool of it; numbers that no memory depends on"),
    (
        "ops[.].*bodies",
        "bodies",
        r"[[][15][]] one (more|less), axis 0",
        "obstacles and gravity of all scenes or of each",
    ),
    ("ops[.]latest_schedule", "like", ".*", "a tensor of any shape has a device"),
    ("ops[.]law_.*", "parameters", ".*(axis 0|one dimension more)", "uniform, or of more scenes than have particles"),
    (
        "ops[.]quartic.*",
        "mu|lam|alpha|cohesion",
        "axis 0|one dimension more",
        "uniform, or of more scenes than have particles",
    ),
    ("(ops[.])?(svd3|polar)", "F", "axis 0|dimension.* more|float64|on meta", "any number of matrices"),
    ("(ops[.])?(svd3|polar)", "F", "axis [12]", "matrices in 2-D and 3-D"),
    ("ops[.]take", "fields|particles", ".*", "any tensors, any rows"),
    ("State.select", "particles", "axis 0", "any rows"),
    ("ops[.]advance.*", "scene_dt", "axis 0", "of scenes that have no particles"),
    ("ops[.](activate|cell_order)|Grid.activate", "x", "float64", "nothing else has a dtype"),
    ("(ops[.])?gather", "nodes", "axis 1", "any number of channels"),
    ("Environments", "room", "None", "optional"),
    ("ops[.]pointwise.*", "tensors", "dimension more", "a row of one that all share"),
    ("NeoHookean of Lamé parameters", "mu", "one dimension more", "a tensor [1]"),
    ("ops[.]pointwise.*", "tensors", r"[[]0[]] .* axis 0", "any number of rows, of a function of one argument"),
    ("Surface", "points", "axis 0", "any number of points"),
    (".*", ".*", REAL, "values that are brought to the dtype of the state"),
    ("ops[.](contact|survey|substeps).*", "scene_time|obstacles", "one less, axis 0", "one for all scenes"),
    ("law_update", "details", "= 2", "bits"),
    ("seed[.]sphere", "center", "one more", "a sphere in 3-D"),
    ("Surface", "points", "axis 1", "a surface in 3-D"),
    ("contact", "velocity", "on meta", "a fake call"),
    ("contact", "mass", "None", "optional"),
    ("substeps_arguments", "blocks", "None", "optional"),
    ("FreeBodies.advance", "wrenches", "None", "optional"),
    ("ops[.]substeps.*", "tables", "axis 1", "any number of knots"),
    ("plan_rollout", "schedule|checkpoint", "None", "optional"),
    ("Step.failures", "state", "None", "optional"),
    ("Waypoints", "position", "a list", "as many lists of numbers"),
    (".* of a batch", "rotation|radius|friction|angular_velocity", "a list", "a number per scene"),
    ("grid_update|wall_impulses", "gravity", "one dimension more", "[B, D] of one scene"),
    ("ops[.]implicit_cg", "images", "axis 0", "any number of images"),
    ("PerMaterial", "values", ".*", "any values of any number; a law or a Heat that gets them checks them"),
    (SHAPES, "friction|radius|angular_velocity", "a list", "a list of one scene"),
    (SHAPES, ".*", "nested", "vectors of one scene"),
    (".* of a batch", "position|velocity|normal|size|half_axis|gravity", "as a list", "lists are values too"),
    ("Step", "gravity", "nested", "vectors of one scene"),
    ("ops[.]segment_clock", "rate", "None", "optional"),
)
"""Patterns of a callable, an argument and a change that may be accepted, and the reason."""


def misfits(value: Any) -> Iterator[tuple[str, Any]]:
    """(change, a value of another kind) for an argument of a valid call."""
    if isinstance(value, Tensor):
        yield from _of_tensor(value)
    elif isinstance(value, bool):
        yield from ((f"= {other!r}", other) for other in (2, 0.5))
    elif isinstance(value, (int, float)):
        yield "NaN", math.nan
        yield "a list", [value]
    elif isinstance(value, str):
        yield "another word", "neo"
        if value.upper() != value:
            yield "in capitals", value.upper()
        yield "a number", 3
    elif isinstance(value, (list, tuple)):
        yield from _of_list(value)
    elif callable(value) and not isinstance(value, nn.Module):
        yield "a number", 3.5
    elif value is not None:
        yield "a number", 3.5
        if not callable(value):
            yield "its class", type(value)
    wanted = "a word" if isinstance(value, str) else "a dict" if isinstance(value, dict) else ""
    yield from ((name, other) for name, other in OTHERS.items() if name != wanted)


def _of_tensor(t: Tensor) -> Iterator[tuple[str, Any]]:
    for axis in range(t.dim()):
        if t.shape[axis]:
            yield f"one less, axis {axis}", t.narrow(axis, 0, t.shape[axis] - 1)
            yield f"one more, axis {axis}", torch.cat([t, t.narrow(axis, 0, 1)], axis)
            yield f"two more, axis {axis}", torch.cat([t] + 2 * [t.narrow(axis, 0, 1)], axis)
    yield "one dimension more", t[None]
    yield "two dimensions more", t[None, None]
    if t.dim():
        yield "as a list", t.tolist()
    for dtype in (torch.complex64, torch.bool, torch.float16, torch.int64, torch.float64):
        if dtype != t.dtype:
            yield str(dtype), t.to(dtype)
    yield "on meta", t.to("meta")


def _of_list(values: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    kind = type(values)
    yield "nested", kind([values])
    for name, other in {"None": None, "a word": "neo", "a stranger": Stranger()}.items():
        yield f"[0] {name}", kind([other, *values[1:]])
    if values and all(isinstance(v, float) for v in values):
        yield "one less", values[:-1]
        yield "one more", (*values, *values[:1])
        yield "[0] NaN", kind([math.nan, *values[1:]])
    for k, value in enumerate(values):
        if isinstance(value, Tensor):
            yield from ((f"[{k}] {done}", [*values[:k], other, *values[k + 1 :]]) for done, other in _of_tensor(value))


# ---- one call


def names() -> list[str]:
    return calls.names()


def changed(seed: int, number: int, only: str | None = None) -> tuple[str, Callable[[], Any], str, set[str], str]:
    """(name, the call to make, argument, other names that may be in the message, change of the argument),
    determined by seed and number."""
    choose = random.Random(f"misfit {seed} {number}")
    raw, faces = calls.raw_calls(), calls.public_calls()
    name = only or choose.choice(sorted(faces if choose.random() < 0.7 else raw))
    if name in raw:
        op, arguments = getattr(torch.ops.torch_mpm, name.removeprefix("ops.")), choose.choice(raw[name])
        argument = choose.choice([a for a in arguments if a != "topology"])
        done, value = choose.choice(list(misfits(arguments[argument])))
        return (
            name,
            lambda: op(*(arguments | {argument: value}).values()),
            argument,
            _compared(arguments, argument),
            done,
        )
    function, arguments = faces[name]()
    if choose.random() < 0.05:
        argument = choose.choice(list(arguments)) + "_typo"
        return name, lambda: function(**arguments, **{argument: 1.0}), argument, set(), "unknown"
    argument = choose.choice(list(arguments))
    done, value = choose.choice(list(misfits(arguments[argument])))
    return name, lambda: function(**(arguments | {argument: value})), argument, _compared(arguments, argument), done


def _compared(arguments: dict[str, Any], argument: str) -> set[str]:
    """Names that an error may have instead of the argument: its parts, and arguments that it is compared with."""
    quantities = {q.name for law in LAWS.values() for q in (*law.parameters, *law.history)}
    if argument == "state" and "law" in arguments:
        return {"F", "J", "the state", *quantities, *arguments}
    if argument == "lattice":
        return {"dx", "lower"}
    if argument == "walls":
        return {"wall"}
    if argument in ("parameters", "history"):
        return {q.name for law in LAWS.values() for q in (*law.parameters, *law.history)}
    parts = arguments[argument] if isinstance(arguments[argument], (list, tuple)) else [arguments[argument]]
    numeric = all(isinstance(part, (Tensor, float)) for part in parts)
    return {*arguments, "index", "table", "nodes"} if numeric else set()


def judged(seed: int, number: int, only: str | None = None) -> tuple[str, str, str, str, str]:
    """(name, argument, change, outcome of the call, its error)."""
    name, make, argument, others, done = changed(seed, number, only)
    try:
        make()
    except Exception as error:
        return (
            name,
            argument,
            done,
            _end(name, argument, others, done, error),
            f"{type(error).__name__}: {str(error)[:200]}",
        )
    fits = any(re.fullmatch(n, name) and re.fullmatch(a, argument) and re.search(d, done) for n, a, d, _ in FITTING)
    return name, argument, done, "fits" if fits else "accepted", ""


def _end(name: str, argument: str, others: set[str], done: str, error: Exception) -> str:
    """Outcome of a call with an error; `others` are names that the message may have instead."""
    allowed = (*REFUSALS, RuntimeError, NotImplementedError) if name.startswith("ops.") else REFUSALS
    if not isinstance(error, allowed) or not calls.is_clear(error):
        return "another error"
    if name.startswith("ops.") and "None" in done:
        return "refused"  # by torch, which may not name it
    words = "|".join(others | {argument.replace("_", "[_ ]")})
    return "refused" if re.search(rf"(?<!\w)({words})(?!\w)", str(error)) else "unnamed"


# ---- many calls


def fuzz(count: int, seed: int, only: str | None = None) -> list[list[Any]]:
    """Calls in child processes: [number, name, argument, change, outcome, error]."""
    torch.set_num_threads(1)
    calls.raw_calls()  # before the fork, and so once
    found: list[list[Any]] = []
    while len(found) < count:
        numbers = range(len(found), min(len(found) + BATCH, count))

        def work(numbers: Sequence[int] = numbers) -> int:
            warnings.simplefilter("ignore")
            for number in numbers:
                os.write(1, f"\n{number}\n".encode())
                os.write(1, (json.dumps([number, *judged(seed, number, only)]) + "\n").encode())
            return 0

        outcome = run(work, seconds=600)
        lines = outcome.text.splitlines()
        found += [json.loads(line) for line in lines if line.startswith("[")]
        if len(found) <= numbers[-1]:
            number = len(found)
            name, _, argument, _, done = changed(seed, number, only)
            found.append([number, name, argument, done, "crash", f"{outcome.kind} {outcome.status}"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", metavar="NAME", help="one callable: " + ", ".join(names()))
    arguments = parser.parse_args()
    found = fuzz(arguments.calls, arguments.seed, arguments.only)
    groups = collections.Counter((name, argument, done, end, error) for _, name, argument, done, end, error in found)
    for (name, argument, done, end, error), count in sorted(groups.items()):
        if end in FAULTS:
            print(count, name, argument, "|", done, "|", end, "|", error)
    ends = collections.Counter(end for *_, end, _ in found)
    print(len(found), "calls:", dict(ends))
    sys.exit(1 if any(ends[end] for end in FAULTS) else 0)


if __name__ == "__main__":
    main()
