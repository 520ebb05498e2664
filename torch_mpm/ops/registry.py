"""The compiled laws, as the CPU library lists them (csrc/laws/registry.h)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from .. import _library


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A parameter or history variable of a law.

    Attributes:
        name, unit: the unit is "" for a pure number.
        low, high: ends of its range; infinite ends mean any finite number.
        with_low, with_high: whether a finite end is in the range.
        matrix: whether a history variable has D by D entries per particle.
        option: the option without which a law does not have a history variable, or None.
    """

    name: str
    unit: str
    low: float
    high: float
    with_low: bool
    with_high: bool
    matrix: bool
    option: str | None

    def holds(self, value: Any) -> Any:
        """Whether a number, or each entry of a tensor, is in the range; infinite values are."""
        above = value >= self.low if self.with_low else value > self.low
        below = value <= self.high if self.with_high else value < self.high
        return above & below

    @property
    def expected(self) -> str:
        """The range in words, for messages."""
        if math.isinf(self.high):
            if math.isinf(self.low):
                return "finite"
            if self.low == 0:
                return "finite and not negative" if self.with_low else "positive"
        return f"in {'[' if self.with_low else '('}{self.low:g}, {self.high:g}{']' if self.with_high else ')'}"


@dataclasses.dataclass(frozen=True)
class LawInfo:
    """Description of a compiled law.

    Attributes:
        field: field of the deformation that it reads and updates: "F" or "J".
        viscous: whether its stress reads C.
        plastic: whether it changes F.
        optional_history: whether it works without its history, or with the first variables alone.
        twice_differentiable, twice_differentiable_energy: whether its stress, and its energy, has second derivatives.
        has_tangent: whether it has `law_tangent`, which implicit steps need.
        in_2d: whether it exists in two dimensions.
        additive: whether its stress is added to that of another law of the same material.
        parameters, history: in the order of the ops.
        options: names of the bits of `options`.
    """

    name: str
    field: str
    viscous: bool
    plastic: bool
    optional_history: bool
    twice_differentiable: bool
    twice_differentiable_energy: bool
    has_tangent: bool
    in_2d: bool
    additive: bool
    parameters: tuple[Quantity, ...]
    history: tuple[Quantity, ...]
    options: tuple[str, ...]

    def history_with(self, options: Sequence[str]) -> tuple[Quantity, ...]:
        """The history that the law has with these options, in its order."""
        return tuple(q for q in self.history if q.option is None or q.option in options)

    @property
    def rate_dependent(self) -> bool:
        """Whether the last parameter is the time step."""
        return any(p.name == "dt" for p in self.parameters)

    def parameter(self, name: str) -> Quantity:
        return next(p for p in self.parameters if p.name == name)


def _quantities(entries: list[dict[str, Any]]) -> tuple[Quantity, ...]:
    ends = ({"low": -math.inf if e["low"] is None else e["low"]} for e in entries)
    high = ({"high": math.inf if e["high"] is None else e["high"]} for e in entries)
    return tuple(Quantity(**{**e, **a, **b}) for e, a, b in zip(entries, ends, high, strict=True))


def _read() -> dict[str, LawInfo]:
    laws = {}
    for entry in _library.listed("torch_mpm_laws"):
        lists = {key: _quantities(entry[key]) for key in ("parameters", "history")}
        laws[entry["name"]] = LawInfo(**{**entry, **lists, "options": tuple(entry["options"])})
    return dict(sorted(laws.items()))


LAWS: dict[str, LawInfo] = _read()
"""All compiled laws by name."""
