"""Pool of blocks of a shard: it grows ahead of the scenes, and a simulation with too few blocks ends on the way."""

import dataclasses

import numpy as np
import pytest
import torch

pytest.importorskip("pydantic")

from generated import configuration

from torch_mpm.data import batch
from torch_mpm.data.sampling import content
from torch_mpm.grid.grid import Grid
from torch_mpm.grid.topology import Status

FRAMES, INTERVAL, COUNT = 41, 0.005, 5
BLOCKS = 100
"""Blocks of the pool of a grid whose status is made by hand."""


def gas(device):
    """Two scenes of a soft ball that flies apart, from 30 blocks to 66."""
    ball = {"shape": "sphere", "radius": 0.1}
    body = {"count": 1, "material": "jelly", "center": [0.5, 0.5], "velocity": [0.0, 0.0], "choice": [ball]}
    made = configuration(
        grid__dx=0.02, grid__deterministic=True, material__jelly__E=1.0, gravity=[0.0, 0.0], body=[body]
    )
    built = made.scene(content(made, 0), content(made, 1)).build(device)
    return dataclasses.replace(built, state=built.state.replace(v=6 * (built.state.x - 0.5)))


def simulate(built):
    stored, failures, _ = batch.simulate(built, ["position"], FRAMES, INTERVAL, COUNT)
    assert failures == ["", ""]
    return [scene.arrays["position"] for scene in stored]


@pytest.fixture
def late(monkeypatch):
    """Pools of all devices grow at looks alone, as that of a device whose work is far behind the host; returns the step
    of each rollout, in their order."""
    steps, rollout = [], batch.rollout

    def counted(step, *arguments):
        steps.append(step)
        return rollout(step, *arguments)

    monkeypatch.setattr(batch, "rollout", counted)
    monkeypatch.setattr(batch, "_grows_late", lambda built: True)
    monkeypatch.setattr(Grid, "watch", lambda grid, status: None)
    return steps


def test_scenes_that_grow_slowly_are_simulated_once(late, monkeypatch, device):
    expected = simulate(gas(device))
    late.clear()
    monkeypatch.setattr(batch, "_leave_room", lambda built: built.grid.pool(built.state.x, built.state.scene))
    built = gas(device)
    first = built.grid.measured_pool(built.state.x, built.state.scene)
    found = simulate(built)
    assert len(late) == FRAMES - 1
    assert first < int(built.step.status[0, Status.BLOCKS_WANTED]) < built.grid.max_blocks
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_pool_that_is_too_small_is_found_on_the_way(late, monkeypatch, device):
    """At the second look after it was full; the next simulation has the results of one with enough blocks."""
    expected = simulate(gas(device))
    late.clear()

    def leave_too_few(built):
        built.grid.max_blocks = built.grid._activate(built.state.x, built.state.scene, None, 0).wanted - 2

    monkeypatch.setattr(batch, "_leave_room", leave_too_few)
    frames = []

    def mark(number):
        """On the CPU the op enlarges the pool by itself: its status is made that of a device."""
        frames.append(number)
        if device == "cpu" and len(frames) == 5:
            late[-1].status[0, Status.PROBLEM_ACTIVATION] = 5

    stored, failures, _ = batch.simulate(gas(device), ["position"], FRAMES, INTERVAL, COUNT, mark)
    assert failures == ["", ""] and len(late) == 2 * batch.LOOK + FRAMES - 1
    assert frames == [*range(2 * batch.LOOK), *range(FRAMES)]
    for a, b in zip(stored, expected, strict=True):
        np.testing.assert_array_equal(a.arrays["position"], b)


# ---- looks


def status(wanted, now, problem=-1):
    row = {Status.BLOCKS_WANTED: wanted, Status.BLOCKS_NOW: now, Status.PROBLEM_ACTIVATION: problem}
    return torch.tensor([[row.get(column, 0) for column in Status]] * 3, dtype=torch.int32)


@pytest.fixture
def grid():
    grid = Grid(0.01, (0.0, 0.0), (1.0, 1.0), 2)
    grid.max_blocks = BLOCKS
    return grid


def test_a_pool_grows_ahead_where_more_than_half_is_in_use(grid):
    watch = batch._PoolWatch(grid)
    assert watch.look(None) and watch.look(status(90, BLOCKS // 2))
    assert watch.look(status(90, BLOCKS // 2 + 1)) and grid.max_blocks == BLOCKS
    assert watch.finish() and grid.max_blocks == 3 * (BLOCKS // 2 + 1) + 16
    assert watch.finish()


def test_a_full_pool_is_enlarged_for_what_was_wanted(grid):
    watch = batch._PoolWatch(grid)
    watch.look(status(BLOCKS + 1, 20, 7))
    assert not watch.look(status(BLOCKS + 1, 20, 7)) and grid.max_blocks == 3 * (BLOCKS + 1) + 16


def test_a_pool_that_has_grown_after_it_was_full(grid):
    """As by `Grid.watch`: the steps before had too few blocks all the same."""
    watch = batch._PoolWatch(grid)
    watch.look(None)
    grid.max_blocks = 10 * BLOCKS
    watch.look(status(BLOCKS + 1, BLOCKS + 1, 7))
    assert not watch.finish()


@pytest.mark.parametrize(("wanted", "problem"), [(BLOCKS, 7), (BLOCKS + 1, -1)])
def test_what_is_no_full_pool(wanted, problem, grid):
    """A particle outside; a call with a larger pool than that of the grid, or one that had grown in time."""
    watch = batch._PoolWatch(grid)
    watch.look(status(wanted, wanted, problem))
    assert watch.finish()


def test_a_later_problem_after_the_pool_has_grown(grid):
    """What was wanted in all steps is compared with the pool since the previous look."""
    watch = batch._PoolWatch(grid)
    assert watch.look(status(BLOCKS, BLOCKS))
    assert watch.look(status(BLOCKS, BLOCKS))  # reads the first one: there are 316 from here on
    assert watch.look(status(300, 300, 9)) and watch.finish()
