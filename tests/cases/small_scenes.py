"""Batches of small scenes, and the same step by step."""

import dataclasses

import pytest
import torch
from helpers import relative_error

import torch_mpm as mpm
from benchmarks.catalogue.laws import named

F32, F64 = torch.float32, torch.float64
DT, N = 1e-3, 12
LAWS = named("neo_hookean", "fixed_corotated", "sand", "von_mises", "water")


def joined(blocks, device):
    """Blocks in scenes of their own, in a mixed order, with ids; None is an empty scene."""
    scenes = [(b, s) for b, s in enumerate(blocks) if s is not None]
    states = [s.replace(scene=torch.full((len(s),), b, dtype=torch.int32)) for b, s in scenes]
    state = mpm.State.concatenate(states)
    order = torch.randperm(len(state), generator=torch.Generator().manual_seed(1))
    return state.replace(ids=torch.arange(len(state))).select(order).to(device)


def both(step, single, state, n=N, dt=DT):
    """The same rollout in float32 in one call, and by single steps in float64."""
    wide = dt.double() if isinstance(dt, torch.Tensor) else dt
    with torch.no_grad():
        end = mpm.rollout(step, step.prepare(state.to(dtype=F32)), n, dt)
        expected = single.prepare(state.to(dtype=F64))
        for _ in range(n):
            expected = single(expected, wide)
    return end, expected


def assert_same(end, expected, bound=2e-5):
    for f in dataclasses.fields(end):
        value, right = getattr(end, f.name), getattr(expected, f.name)
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            assert relative_error(value.double(), right) < bound, f.name
    assert end.time == pytest.approx(expected.time)
