"""Products of parameters: quick tests have every value or every pair, `make thorough` the other combinations."""

import itertools
from collections.abc import Iterable

import pytest

Groups = dict[tuple[str, ...], Iterable[tuple[object, ...]]]
"""Values of several parameters together, by their names."""
Arguments = tuple[tuple[str, ...], list[object]]
"""Names and cases, as `parametrize` takes them."""
Place = tuple[int, ...]
"""The number of the value on every axis."""


def in_pairs(groups: Groups | None = None, **axes: Iterable[object]) -> Arguments:
    """All combinations of the axes. Those are quick that are needed so that every two values of two axes meet, the
    others thorough. A group is one axis."""
    values = by_names(groups, axes)
    return cases(values, covering([len(axis) for axis in values.values()]))


def each_once(groups: Groups | None = None, **axes: Iterable[object]) -> Arguments:
    """All combinations of the axes, for slow tests: the quick ones have each value of the longest axis once, beside
    values of the others in turn."""
    values = by_names(groups, axes)
    sizes = [len(axis) for axis in values.values()]
    return cases(values, {tuple(k % size for size in sizes) for k in range(max(sizes))})


def by_names(groups: Groups | None, axes: dict[str, Iterable[object]]) -> dict[tuple[str, ...], list]:
    groups = {names: list(values) for names, values in (groups or {}).items()}
    return groups | {(name,): [(value,) for value in axis] for name, axis in axes.items()}


def cases(axes: dict[tuple[str, ...], list], quick: set[Place]) -> Arguments:
    params = []
    for place in itertools.product(*[range(len(axis)) for axis in axes.values()]):
        values = itertools.chain(*[axis[k] for axis, k in zip(axes.values(), place, strict=True)])
        params.append(pytest.param(*values, marks=() if place in quick else pytest.mark.thorough))
    return tuple(itertools.chain(*axes)), params


def covering(sizes: list[int]) -> set[Place]:
    """Few places that have every pair of numbers on two axes: in turn the one that adds the most pairs."""
    places = list(itertools.product(*map(range, sizes)))
    pairs = {place: set(itertools.combinations(enumerate(place), 2)) for place in places}
    missing, chosen = set().union(*pairs.values()), set()
    while missing:
        best = max(places, key=lambda place: len(pairs[place] & missing))
        chosen.add(best)
        missing -= pairs[best]
    return chosen
