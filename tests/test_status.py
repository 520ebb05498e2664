"""Columns of the status: those of the native code."""

import re
from pathlib import Path

import pytest

from torch_mpm.grid.topology import SceneStatus, Status
from torch_mpm.step.status import NO_PROBLEM

HEADER = (Path(__file__).parent.parent / "csrc/grid/status.h").read_text()


@pytest.mark.parametrize("columns", [Status, SceneStatus])
def test_columns_are_those_of_the_header(columns):
    body = re.search(rf"enum {columns.__name__} : int {{(.*?)}};", HEADER, re.S).group(1)
    native = {name: int(value) for name, value in re.findall(r"k(\w+) = (\d)", body) if name != "StatusSize"}
    assert native == {"".join(word.title() for word in c.name.split("_")): c.value for c in columns}


def test_a_row_before_the_first_activation_is_that_of_the_header():
    fresh = re.search(r"fresh\[kStatusSize\] = {(.*?)};", HEADER).group(1)
    assert NO_PROBLEM == tuple(int(number) for number in fresh.split(","))
