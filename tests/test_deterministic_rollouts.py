"""Rollouts on deterministic grids in float32, whose node sums are in fixed point on CUDA: the same bits in each run,
and single steps in float64 to rounding, for all kernels."""

import pytest
import torch
from cases import few_particles as few
from cases import many_particles as many
from cases.rollouts import TRANSFERS, tensors
from cases.small_scenes import F64, LAWS, assert_same, both, joined
from pairs import in_pairs

import torch_mpm as mpm

DT, N = 1e-3, 40


def make(dim, law="neo_hookean", scenes=1, cells=None, **options):
    cells = cells or {2: 50, 3: 20}[dim]
    grid = mpm.Grid(1 / cells, (0,) * dim, (1,) * dim, scenes=scenes, deterministic=True, **options.pop("grid", {}))
    options = {"gravity": (0.0, -9.8, 0.0)[:dim], "walls": "separate", **options}
    return mpm.Step(grid, LAWS[law]() if isinstance(law, str) else law, **options)


def assert_repeats(step, state, n, dt, bound=2e-4):
    """Three runs from the same state, and single steps of a grid like it."""
    end, expected = both(step, step, state, n, dt)
    assert_same(end, expected, bound)
    for _ in range(2):
        with torch.no_grad():
            again = mpm.rollout(step, step.prepare(state.to(dtype=torch.float32)), n, dt)
        assert all(torch.equal(value, tensors(end)[name]) for name, value in tensors(again).items())


@pytest.mark.parametrize("law", LAWS)
def test_few_particles(law, dim, device):
    assert_repeats(make(dim, law), few.body(dim, device), N, DT, 2e-3 if law == "sand" else 2e-4)


def test_more_particles_than_a_cluster_takes(dim, device):
    """And a jet in them, so that many particles of an item stray at once."""
    state = few.body(dim, device, low=0.2, high=0.75 if dim == 3 else 0.78)
    jet = (state.x[:, 0] > 0.4) & (state.x[:, 0] < 0.5)
    along = torch.tensor([0.0, 25.0, 0.0][:dim], dtype=F64, device=device)
    assert_repeats(make(dim), state.replace(v=state.v + jet[:, None] * along), 30, 5e-4, 1e-3)


@pytest.mark.parametrize("high", [0.6, 0.65])
def test_crowded_blocks(high, dim, device):
    """The first run of a grid has no block count of an earlier one."""
    assert_repeats(make(dim), few.crowd(dim, device, high), 30, 5e-4, 1e-3)


@pytest.mark.parametrize(
    ("law", "cells"), [("neo_hookean", 0.15), ("neo_hookean", 0.6), ("sand", 0.15), ("water", 0.15)]
)
def test_many_particles(law, cells, dim, device):
    state = many.body(dim, device, cells)
    step = make(dim, law, cells=many.CELLS[device][dim])
    assert_repeats(step, state, many.N, many.dt_of(dim, device), 2e-2 if law == "sand" else 1e-3)


@pytest.mark.parametrize(*in_pairs(kernel=["quadratic", "cubic"], transfer=TRANSFERS, dim=[2, 3]))
def test_a_mixture_beside_an_obstacle(transfer, kernel, dim, device):
    state = few.body(dim, device)
    material = (state.x[:, 0] > state.x[:, 0].mean()).int()
    laws = mpm.Mixture([LAWS["neo_hookean"](), LAWS["water"]()])
    ball = mpm.Sphere((0.6, 0.2, 0.5)[:dim], 0.2, friction=0.3, velocity=(-2.0, 1.0, 0.0)[:dim])
    step = make(dim, laws, boundaries=[ball], grid={"kernel": kernel}, **TRANSFERS[transfer])
    assert_repeats(step, state.replace(material=material), N, DT, 1e-3)


@pytest.mark.parametrize("flip", [0.0, 0.95])
def test_scenes(flip, dim, device):
    state = joined([few.body(dim), None, few.body(dim, low=0.4)], device)
    assert_repeats(make(dim, scenes=3, flip=flip), state, N, DT)


def test_masses_of_many_sizes(dim, device):
    """From one that is zero to one that makes a million of the smallest."""
    state = few.body(dim, device, speed=1.0)
    share = 10 ** torch.linspace(-6, 0, len(state), dtype=F64, device=device)
    share[3] = 0.0
    mass, volume = state.mass * share, state.volume * share
    assert_repeats(make(dim, "water"), state.replace(mass=mass, volume=volume), N, DT, 2e-3)


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_tiny_and_huge_masses(scale, dim, device):
    state = few.body(dim, device)
    laws = mpm.NeoHookean(E=1e4 * scale, nu=0.3)
    assert_repeats(make(dim, laws), state.replace(mass=state.mass * scale), N, DT)


def test_a_number_that_is_not_finite(dim, device):
    """It spreads as in single steps, and is reported in the same step."""
    state = few.body(dim, device)
    v = state.v.clone()
    v[7] = torch.inf
    step, single = make(dim), make(dim)
    end, expected = both(step, single, state.replace(v=v), 6, DT)
    assert torch.equal(step.status[:, 1:7], single.status[:, 1:7])
    assert torch.equal(end.x.isfinite(), expected.x.isfinite()) and not bool(end.x.isfinite().all())
