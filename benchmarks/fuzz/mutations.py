"""Malformed arguments: changes of one argument of a valid call."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

INTEGERS = (-1, 0, 1, 2, 3, 7, 2**31 - 1, 2**31, 2**40, 2**63 - 1, -(2**63), 2**64)
NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -1.0, -0.0, 1e-300, 1e-45, 1e300, 1e39, 10**400)


def refuses(*_: Any, **__: Any) -> Any:
    """A user function with an error of its own, which no check can foresee."""
    raise ValueError("refused")


def nothing(_: Any) -> None:
    """A user function without a result."""


class Refuses:
    """A user class whose constructor fails as `refuses` does."""

    def __init__(self, *_: Any, **__: Any) -> None:
        refuses()


STRANGERS: tuple[Any, ...] = (
    None, True, 5, -3, 0.5, math.nan, 1j, "", "neo", "a\0b", b"bytes", (), [], {}, [None], [[1.0]], object(), nothing,
    refuses, Refuses, torch.float32, torch.zeros(()), torch.zeros(3), torch.zeros(0, dtype=torch.int64), {"a": 1},
    slice(None), range(3),
)  # fmt: skip
"""Values of other types, for any argument."""
FIXED_CONTENTS = ("topology",)
"""Lists of index tensors that only `activate` may fill: their values are not checked, so they are not changed here."""


def mutate(name: str, value: Any, others: list[Any], choose: random.Random) -> tuple[str, Any]:
    """(change, another value) for an argument of a call with the arguments `others`."""
    kind = choose.random()
    if kind < 0.12:
        other = choose.choice(STRANGERS)
        return f"= {_text(other)}", other
    if kind < 0.2:
        other = choose.choice(others)
        return f"= another argument, {_text(other)}", other
    if isinstance(value, Tensor):
        return _tensor(value, name not in FIXED_CONTENTS, choose)
    if isinstance(value, (list, tuple)) and not hasattr(value, "_fields"):
        return _sequence(name, value, choose)
    if isinstance(value, bool) or value is None:
        other = choose.choice(STRANGERS)
    elif isinstance(value, int):
        other = choose.choice(INTEGERS + NUMBERS[:4])
    elif isinstance(value, float):
        other = choose.choice(NUMBERS + INTEGERS[:4])
    elif isinstance(value, str):
        other = choose.choice(("", value.upper(), value + " ", value[:-1], value * 1000, "ä", "\0", value.encode()))
    else:
        other = choose.choice(STRANGERS)
    return f"= {_text(other)}", other


def _text(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"tensor {list(value.shape)} {value.dtype}"
    return repr(value) if len(repr(value)) < 40 else repr(value)[:40] + "…"


def _sequence(name: str, values: Any, choose: random.Random) -> tuple[str, Any]:
    items = list(values)
    action = choose.choice(("empty", "shorter", "longer", "element", "element", "element", "tensor", "nested"))
    if action == "element" and items:
        k = choose.randrange(len(items))
        done, items[k] = mutate(name, items[k], items, choose)
        return f"[{k}] {done}", items
    changed: dict[str, Any] = {
        "empty": [], "shorter": items[:-1], "longer": items + items[-1:], "element": [None],
        "tensor": torch.ones(len(items)), "nested": [items],
    }  # fmt: skip
    return action, changed[action]


def _tensor(value: Tensor, contents: bool, choose: random.Random) -> tuple[str, Tensor]:
    groups = [_SHAPES, _SHAPES, _KINDS, *([_VALUES] if contents and value.numel() else [])]
    name, action = choose.choice(list(choose.choice(groups).items()))
    axis = choose.randrange(value.dim()) if value.dim() else None
    try:
        return f"{name}, axis {axis}" if action in _SHAPES.values() else name, action(value, axis)
    except (RuntimeError, IndexError, TypeError):  # not every change is possible for every tensor
        return "empty", value.new_empty(0)


def _resized(change: int) -> Callable[[Tensor, int], Tensor]:
    """Tensor with one row more, repeated from the front, or one fewer."""

    def resize(t: Tensor, axis: int) -> Tensor:
        rows = torch.arange(max(t.shape[axis] + change, 0)) % max(t.shape[axis], 1)
        return t.index_select(axis, rows)

    return resize


def _huge(t: Tensor, axis: int) -> Tensor:
    """Tensor of 2^40 rows that share the memory of one."""
    shape = list(t.shape)
    shape[axis] = 2**40
    return t.narrow(axis, 0, 1).expand(shape)


def _empty_and_huge(t: Tensor, axis: int) -> Tensor:
    return t.new_empty([2**40 if i == axis else 0 for i in range(max(t.dim(), 2))])


_SHAPES: dict[str, Callable[[Tensor, Any], Tensor]] = {
    "one row fewer": _resized(-1),
    "one row more": _resized(1),
    "twice": lambda t, axis: torch.cat([t, t], axis),
    "first row": lambda t, axis: t.narrow(axis, 0, 1),
    "no rows": lambda t, axis: t.narrow(axis, 0, 0),
    "row taken out": lambda t, axis: t.select(axis, 0),
    "one axis more": lambda t, axis: t.unsqueeze(axis or 0),
    "flat": lambda t, axis: t.reshape(-1),
    "scalar": lambda t, axis: t.reshape(-1)[0],
    "transposed": lambda t, axis: t.transpose(axis, -1),
    "one row expanded": lambda t, axis: t.narrow(axis, 0, 1).expand(t.shape),
    "huge": _huge,
    "empty and huge": _empty_and_huge,
}

_DTYPES = (
    torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int8, torch.uint8, torch.int32, torch.int64,
    torch.bool, torch.complex64, torch.complex128,
)  # fmt: skip
_KINDS: dict[str, Callable[[Tensor, Any], Tensor]] = {
    **{str(dtype): lambda t, axis, dtype=dtype: t.to(dtype) for dtype in _DTYPES},
    "on meta": lambda t, axis: t.to("meta"),
    "requires grad": lambda t, axis: t.detach().clone().requires_grad_(),
    "sparse": lambda t, axis: t.to_sparse(),
    "sparse CSR": lambda t, axis: t.to_sparse_csr(),
    "parameter": lambda t, axis: torch.nn.Parameter(t.detach(), requires_grad=t.is_floating_point()),
    "every second element": lambda t, axis: t.repeat_interleave(2, -1)[..., ::2],
    "unaligned": lambda t, axis: torch.cat([t.reshape(-1)[:1], t.reshape(-1)])[1:].reshape(t.shape),
    "negative view": lambda t, axis: torch._neg_view(t.neg()),
}


def _filled(number: float) -> Callable[[Tensor, Any], Tensor]:
    return lambda t, axis: torch.full_like(t, number)


def _one(number: float) -> Callable[[Tensor, Any], Tensor]:
    def replace(t: Tensor, axis: Any) -> Tensor:
        changed = t.clone()
        changed.view(-1)[t.numel() // 2] = number
        return changed

    return replace


_VALUES: dict[str, Callable[[Tensor, Any], Tensor]] = {
    **{f"all {number}": _filled(number) for number in (math.nan, math.inf, 0, -1, 1e30, 1e-40, 2**31 - 1)},
    **{f"one {number}": _one(number) for number in (math.nan, -math.inf, -1, 1e300, 2**31 - 1, -(2**31))},
    "negative": lambda t, axis: t.neg(),
}
