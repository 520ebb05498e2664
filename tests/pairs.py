"""Products of parameters: the quick tests have every pair of two values, `make thorough` has the other combinations."""

import itertools
from collections.abc import Iterable

import pytest

Groups = dict[tuple[str, ...], Iterable[tuple[object, ...]]]
"""Values of several parameters together, by their names."""


def in_pairs(groups: Groups | None = None, **axes: Iterable[object]) -> tuple[tuple[str, ...], list[object]]:
    """Arguments of `parametrize` for all combinations of the axes. Those that a quick test needs so that every two
    values of two axes meet are quick, the others thorough. A group is one axis."""
    every = {(name,): [(value,) for value in axis] for name, axis in axes.items()}
    every |= {names: list(values) for names, values in (groups or {}).items()}
    places = list(itertools.product(*[range(len(axis)) for axis in every.values()]))
    quick = covering(places)
    cases = []
    for place in places:
        values = itertools.chain(*[axis[k] for axis, k in zip(every.values(), place, strict=True)])
        cases.append(pytest.param(*values, marks=() if place in quick else pytest.mark.thorough))
    return tuple(itertools.chain(*every)), cases


def covering(places: list[tuple[int, ...]]) -> set[tuple[int, ...]]:
    """Few of the places, together with all pairs that they have: in turn the one that adds the most pairs."""
    pairs = {place: set(itertools.combinations(enumerate(place), 2)) for place in places}
    missing, chosen = set().union(*pairs.values()), set()
    while missing:
        best = max(places, key=lambda place: len(pairs[place] & missing))
        chosen.add(best)
        missing -= pairs[best]
    return chosen
