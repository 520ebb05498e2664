"""Argument checks of the raw ops, `torch.ops.torch_mpm`, which are also called without the checks in Python.

A call that is not rejected may crash the process, so each test makes its calls in a child process, which prints the
name of each op first.
"""

import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch.utils._pytree import tree_flatten, tree_map_only

from benchmarks.fuzz import calls, operators
from benchmarks.fuzz.common import run

Arguments = dict[str, Any]
Changes = Callable[[Arguments], Iterator[tuple[Arguments, str]]]
PLANS = ("plan_substeps", "latest_schedule")
"""Ops without tensors whose sizes count, tested in tests/rollouts/test_plan.py."""
OPS = [name for name in operators.operators() if name not in PLANS]
CALLS = [(dim, *call) for dim in (2, 3) for call in operators.calls(dim) if call[0] not in PLANS]
COMPARED = ("x", "F", "state", "velocity", "nodes", "r", "gravity", "previous_status", "clock")
"""Arguments that define the shapes of the others."""
ANY_NUMBER = ("mu", "lam", "alpha", "cohesion", "scene_dt", "scene_time", "obstacles")
"""Tensors that are given once, per scene or per particle."""
TOPOLOGY = ("table", "block", "offsets", "index", "schedule", "scene")


def taking(name: str) -> list[str]:
    """The ops that take an argument."""
    return sorted({op for _, op, arguments in CALLS if name in arguments})


def refusals(ops: Sequence[str], changes: Changes) -> None:
    """Each change of the valid arguments of the ops must be refused with its message, a pattern."""

    def work() -> int:
        wrong = 0
        for dim, op, arguments in CALLS:
            if op not in ops:
                continue
            os.write(1, f"{op} in {dim}-D\n".encode())  # not through sys.stdout, which pytest replaces
            for changed, message in changes(arguments):
                try:
                    getattr(torch.ops.torch_mpm, op)(*(arguments | changed).values())
                    end = "no error"
                except (RuntimeError, ValueError, TypeError) as error:
                    end = str(error)
                if not re.search(message, end):
                    wrong = 1
                    os.write(1, f"wanted {message!r}, got {end!r}\n".encode())
        return wrong

    outcome = run(work)
    assert outcome.kind == "ok" and outcome.status == 0, f"{outcome.kind} {outcome.status}\n{outcome.text}"


def test_sizes_of_the_index_tensors() -> None:
    def changes(arguments: Arguments) -> Iterator[tuple[Arguments, str]]:
        for count in (0, 4, 7):
            yield {"topology": (2 * arguments["topology"])[:count]}, "topology must be .* got"
        # The other ops with a topology read its table and block only.
        read = TOPOLOGY if "x" in arguments else ("table", "block") if "nodes" in arguments else ("block",)
        for name in read:
            k = TOPOLOGY.index(name)
            value = arguments["topology"][k]

            def replaced(other: torch.Tensor, k: int = k) -> Arguments:
                tensors = arguments["topology"]
                return {"topology": [*tensors[:k], other, *tensors[k + 1 :]]}

            # The table of no scene, of one instead of two, and of less than a whole one.
            sizes = (0, len(value) // 2, len(value) - 1) if name == "table" else (0, 1, len(value) - 1)
            for size in sizes if "x" in arguments else ():
                yield (
                    replaced(value[:size].clone()),
                    f"{name} must|entries below the .* of {name}" if name != "block" else "must have shape",
                )
            yield replaced(value.long()), f"{name} must be int32, got int64"
            yield replaced(value[:, None]), f"{name} must have"
            yield replaced(value[0]), f"{name} must have"
            if name != "scene":
                yield replaced(value[:1].expand(value.shape)), f"{name} must be contiguous"

    refusals(taking("topology"), changes)


def test_the_lattice() -> None:
    def changes(arguments: Arguments) -> Iterator[tuple[Arguments, str]]:
        dx, *lower = arguments["lattice"]
        order, deterministic, *blocks = arguments["layout"]
        for wrong in (math.nan, math.inf, 0.0, -1.0, 1e-320):
            yield {"lattice": [wrong, *lower]}, "dx must be positive and finite, got"
        yield {"lattice": [dx, math.nan, *lower[1:]]}, "lower must be finite, got"
        for count in range(len(lower) + 1):
            yield {"lattice": [dx, *lower][:count]}, r"lattice must .* got"
        for count in range(len(blocks) + 2):
            yield {"layout": [order, deterministic, *blocks][:count]}, r"layout must .* got"
        yield {"layout": [*arguments["layout"], 1]}, r"layout must have \d entries, .* got \d"
        for wrong in (0, -1, 2**31, 2**62):
            yield {"layout": [order, deterministic, wrong, *blocks[1:]]}, r"blocks must be positive .* got"
        for wrong in (-1, 0, 1, 4, 2**40):
            yield {"layout": [wrong, deterministic, *blocks]}, "order must be 2 or 3, got"

    refusals(taking("lattice"), changes)


def test_expected_and_given_shapes_are_reported() -> None:
    """One row fewer in each particle or node tensor: the message has its name, the expected and the given shape.
    Images, and particles to take, may have any number."""

    def changes(arguments: Arguments) -> Iterator[tuple[Arguments, str]]:
        for name, value in arguments.items():
            if not isinstance(value, torch.Tensor) or name in (*COMPARED, *ANY_NUMBER, "images", "particles"):
                continue
            shape = re.escape(str(list(value[1:].shape)))
            yield {name: value[1:]}, rf"{name} must .*got {shape}"

    refusals(OPS, changes)


def test_sizes_that_overflow() -> None:
    """2^31 to 2^56 rows, in the memory of one or of none."""

    def changes(arguments: Arguments) -> Iterator[tuple[Arguments, str]]:
        for name, value in arguments.items():
            if not isinstance(value, torch.Tensor) or name in ANY_NUMBER:
                continue
            for rows in (2**31, 2**40, 2**56):
                shape = list(value.shape)
                shape[0] = rows
                yield {name: value[:1].expand(shape)}, " must (have|be)"
                if value.dim() > 1:
                    empty = value.new_empty(0, *value.shape[1:-1], rows)
                    yield {name: empty}, " must (have|be)"

    refusals(OPS, changes)


def test_activation_without_scenes() -> None:
    """A grid of no scenes takes no particles, with their scenes given or not."""

    def changes(arguments: Arguments) -> Iterator[tuple[Arguments, str]]:
        for scene in (arguments["scene"], None):
            yield {"scenes": 0, "scene": scene}, "x must have no particles where scenes is 0, got 37"
        yield {"scenes": -1}, "scenes must not be negative, got -1"
        yield {"scenes": 2**40}, r"scenes times blocks must be below 2\^31"
        yield {"max_blocks": -1}, "max_blocks must not be negative, got -1"
        yield {"max_blocks": 2**40}, r"max_blocks must be at most \d+, got"
        yield {"previous_status": arguments["previous_status"][:2]}, r"previous_status must have shape \[3, 8\]"

    refusals(["activate"], changes)


def test_the_dimension_of_a_law() -> None:
    def changes(arguments: Arguments) -> Iterator[tuple[Arguments, str]]:
        for dim in (-1, 0, 1, 4, 2**40):
            yield {"dim": dim}, "dim must be 2 or 3, got"
        yield {"state": arguments["state"].sum()}, "the state must have"
        yield {"law": "neo"}, "law must be one of .*neo_hookean.*, got neo"
        yield {"parameters": []}, r"parameters must be \d tensors for the law \w+, got 0"
        yield {"parameters": [p.new_empty(0) for p in arguments["parameters"]]}, r"parameters\[0\] must"

    refusals(taking("law"), changes)


def test_iterations_of_a_heat_solve() -> None:
    def changes(arguments: Arguments) -> Iterator[tuple[Arguments, str]]:
        for count in (-1, 2**31, 2**62):
            yield {"max_iterations": count}, "max_iterations must be .* got"

    refusals(taking("max_iterations"), changes)


def malformed_tensors(arguments: Arguments) -> Iterator[tuple[str, Any]]:
    """Each tensor, also of the topology, with all dimensions fewer and with one more."""
    for name, value in arguments.items():
        if isinstance(value, torch.Tensor):
            yield from ((name, value.new_empty(())), (name, value[None]))
        if name == "topology":
            for k, t in enumerate(value):
                yield from ((name, [*value[:k], wrong, *value[k + 1 :]]) for wrong in (t.new_empty(()), t[None]))


def test_malformed_arguments_of_fake_kernels() -> None:
    """On the meta device: the results of the op, and errors that name an argument."""
    for _, name, arguments in CALLS:
        op = getattr(torch.ops.torch_mpm, name)
        meta = {n: tree_map_only(torch.Tensor, lambda t: t.to("meta"), value) for n, value in arguments.items()}
        results, fakes = tree_flatten(op(*arguments.values()))[0], tree_flatten(op(*meta.values()))[0]
        kinds = [[None if t is None else (t.shape, t.dtype) for t in tensors] for tensors in (results, fakes)]
        assert kinds[0] == kinds[1]
        for changed, wrong in malformed_tensors(meta):
            try:
                op(*(meta | {changed: wrong}).values())
            except (RuntimeError, ValueError, TypeError) as error:
                assert calls.is_clear(error), f"{name}, {changed}: {error}"
