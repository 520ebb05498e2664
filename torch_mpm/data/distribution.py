"""Words of a scene with distributions in place of values, and samples of them.

A distribution is a table with one key, its name:

| distribution | a sample |
|---|---|
| `{ uniform = [a, b] }` | a number between a and b |
| `{ log_uniform = [a, b] }` | a number between a and b > a > 0, whose logarithm is uniform |
| `{ normal = [mean, deviation] }` | a Gaussian number |
| `{ integers = [a, b] }` | an integer from a to b, both included |
| `{ choice = [...], weights = [...] }` | one of any words, also distributions; equal probabilities without weights |
| `{ in_box = [[...], [...]] }` | a point of the box between two corners |
| `{ direction = length }` | a vector of any direction; the length is a number or a distribution |

`choice` beside other keys of a table adds the keys of the chosen table to them.
"""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

Words = dict[str, Any]
CHOICE, WEIGHTS = "choice", "weights"


@dataclass(frozen=True)
class Kind:
    """A kind of distribution: description and test of its argument, and its sampling function."""

    takes: str
    fits: Callable[[Any, int], bool]
    sample: Callable[[Any, np.random.Generator, int], Any]


def is_number(value: Any) -> bool:
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) < sys.float_info.max
    return isinstance(value, float) and math.isfinite(value)


def _pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(is_number, value))


def _box(value: Any, dim: int) -> bool:
    if not isinstance(value, list) or len(value) != 2:
        return False
    points = all(isinstance(p, list) and len(p) == dim and all(map(is_number, p)) for p in value)
    return points and all(a <= b and math.isfinite(b - a) for a, b in zip(*value, strict=True))


def _length(value: Any) -> bool:
    if is_distribution(value):
        if CHOICE in value:
            return not isinstance(value[CHOICE], list) or all(map(_length, value[CHOICE]))
        return value.keys().isdisjoint({"in_box", "direction"})
    return is_number(value) and value > 0


def _direction(length: Any, rng: np.random.Generator, dim: int) -> list[float]:
    vector = rng.standard_normal(dim)
    scale = sample(length, rng, dim) / np.linalg.norm(vector)
    return [float(v) for v in scale * vector]


KINDS = {
    "uniform": Kind(
        "two numbers, the lower one first and their difference finite",
        lambda v, dim: _pair(v) and v[0] <= v[1] and math.isfinite(v[1] - v[0]),
        lambda v, rng, dim: float(rng.uniform(*v)),
    ),
    "log_uniform": Kind(
        "two positive numbers, the lower one first",
        lambda v, dim: _pair(v) and 0 < v[0] <= v[1],
        lambda v, rng, dim: float(np.clip(math.exp(rng.uniform(math.log(v[0]), math.log(v[1]))), *v)),
    ),
    "normal": Kind(
        "a mean and a deviation that is not negative",
        lambda v, dim: _pair(v) and v[1] >= 0,
        lambda v, rng, dim: float(rng.normal(*v)),
    ),
    "integers": Kind(
        "two whole numbers of at most 64 bits, the lower one first",
        lambda v, dim: _pair(v) and all(isinstance(a, int) and abs(a) < 2**63 for a in v) and v[0] <= v[1],
        lambda v, rng, dim: int(rng.integers(v[0], v[1], endpoint=True)),
    ),
    "in_box": Kind(
        "a lower and an upper corner with as many numbers as the domain",
        _box,
        lambda v, rng, dim: [float(a) for a in rng.uniform(*v)],
    ),
    "direction": Kind(
        "a length: a positive number, or a distribution of numbers",
        lambda v, dim: _length(v),
        _direction,
    ),
}


def is_distribution(words: Any) -> bool:
    """Whether words are a table with the name of a distribution and no other key but weights."""
    if not isinstance(words, dict) or not words:
        return False
    names = set(words) - ({WEIGHTS} if CHOICE in words else set())
    return len(names) == 1 and not names.isdisjoint({CHOICE, *KINDS})


def sample(words: Any, rng: np.random.Generator, dim: int) -> Any:
    """Words with a sample in place of each distribution.

    Args:
        words: tables, lists and values without `problems`.
        rng: random numbers; the sample depends on them and the words only.
        dim: dimension of the domain, that of random vectors.
    """
    if isinstance(words, list):
        return [sample(item, rng, dim) for item in words]
    if not isinstance(words, dict):
        return words
    if CHOICE in words:
        chosen = sample(_chosen(words, rng), rng, dim)
        rest = {key: value for key, value in words.items() if key not in (CHOICE, WEIGHTS)}
        return {**sample(rest, rng, dim), **chosen} if rest else chosen
    if is_distribution(words):
        ((name, argument),) = words.items()
        return KINDS[name].sample(argument, rng, dim)
    return {key: sample(value, rng, dim) for key, value in words.items()}


def _chosen(words: Words, rng: np.random.Generator) -> Any:
    weights = words.get(WEIGHTS)
    share = None if weights is None else np.array(weights, dtype=float) / sum(weights)
    return words[CHOICE][int(rng.choice(len(words[CHOICE]), p=share))]


def problems(words: Any, path: str, dim: int) -> Iterator[str]:
    """One line, beginning with its key, for each distribution that cannot be sampled."""
    if isinstance(words, list):
        for k, item in enumerate(words):
            yield from problems(item, f"{path}[{k}]", dim)
    elif isinstance(words, dict):
        if CHOICE in words:
            yield from _choice_problems(words, path)
        if is_distribution(words) and CHOICE not in words:
            ((name, argument),) = words.items()
            if not KINDS[name].fits(argument, dim):
                yield f"{path}.{name}: takes {KINDS[name].takes}, got {argument!r}"
                return
        elif len(words) == 1 and (near := difflib.get_close_matches(str(*words), [CHOICE, *KINDS], 1, 0.7)):
            if near[0] not in words:
                yield f"{path}: unknown distribution {next(iter(words))!r}; did you mean {near[0]!r}?"
        elif CHOICE not in words:  # This may be beside other keys.
            lists = [str(key) for key, value in words.items() if isinstance(value, list)]
            for key in difflib.get_close_matches(CHOICE, lists, 1, 0.6):
                yield f"{path}.{key}: unknown key; did you mean {CHOICE!r}?"
        for key, value in words.items():
            if key != WEIGHTS:
                yield from problems(value, f"{path}.{key}" if path else key, dim)


def _choice_problems(words: Words, path: str) -> Iterator[str]:
    items, weights = words[CHOICE], words.get(WEIGHTS)
    if not isinstance(items, list) or not items:
        yield f"{path}.choice: takes a list with at least one entry, got {items!r}"
        return
    if set(words) - {CHOICE, WEIGHTS} and not all(isinstance(item, dict) for item in items):
        yield f"{path}.choice: takes tables where it stands beside other keys, got {items!r}"
    if weights is None:
        return
    good = isinstance(weights, list) and len(weights) == len(items) and all(map(is_number, weights))
    if not good or min(weights) < 0 or sum(weights) <= 0:
        yield f"{path}.weights: takes {len(items)} numbers that are not negative and not all zero, got {weights!r}"


def narrowed(words: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Words in which one choice has only one of its entries, for every entry of every choice, with its key."""
    if isinstance(words, list):
        for k, item in enumerate(words):
            for key, other in narrowed(item, f"{path}[{k}]"):
                yield key, [*words[:k], other, *words[k + 1 :]]
    elif isinstance(words, dict):
        for key, value in words.items():
            place = f"{path}.{key}" if path else key
            if key == CHOICE:
                rest = {name: kept for name, kept in words.items() if name != WEIGHTS}
                for k, item in enumerate(value):
                    yield f"{place}[{k}]", {**rest, CHOICE: [item]}
                    yield from ((at, {**rest, CHOICE: [one]}) for at, one in narrowed(item, f"{place}[{k}]"))
            elif key != WEIGHTS:
                yield from ((at, {**words, key: other}) for at, other in narrowed(value, place))


def found(words: Any, path: str = "") -> Iterator[str]:
    """The keys of all distributions in words."""
    if isinstance(words, dict):
        if CHOICE in words or is_distribution(words):
            yield path
            return
        for key, value in words.items():
            yield from found(value, f"{path}.{key}" if path else key)
    elif isinstance(words, list):
        for k, item in enumerate(words):
            yield from found(item, f"{path}[{k}]")
