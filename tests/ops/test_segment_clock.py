"""`segment_clock` against the same in plain torch, and the choice of dt of single scenes."""

import math

import pytest
import torch
from oracle.clocks import segment_clock as reference

from torch_mpm.ops.segment_clock import ALL_LEFT, SegmentClock, segment_clock

F64 = torch.float64


def table(device: str, **columns: list[float]) -> torch.Tensor:
    """Clocks with some columns, zero elsewhere."""
    count = len(next(iter(columns.values())))
    rows = [columns.get(name, [0.0] * count) for name in SegmentClock._fields]
    return torch.tensor(rows, dtype=F64, device=device).T.contiguous()


def clocks_of(rows: torch.Tensor) -> SegmentClock:
    return SegmentClock(*rows.unbind(1))


@pytest.mark.parametrize("substeps", [0, 1, 16, ALL_LEFT])
@pytest.mark.parametrize("choose", [True, False, None])
@pytest.mark.parametrize("longest", [math.inf, 2e-3])
def test_random_clocks(device, substeps, choose, longest):
    """Two segments of 1000 scenes, also ones that have arrived, were never chosen for, or have no finite limit."""
    g = torch.Generator().manual_seed(7)
    count = 1000
    now, end, latest = torch.rand(3, count, generator=g, dtype=F64)
    rows = torch.stack([now, end, latest * 1e-2, *torch.zeros(5, count, dtype=F64)], 1)
    rates = 10 ** (4 * torch.rand(2, count, generator=g, dtype=F64))
    rates[0, :3] = torch.tensor([0.0, math.inf, 1e300], dtype=F64)
    rows[3:6, 1] = torch.tensor([math.nan, math.inf, -1.0], dtype=F64)
    rows[6, 0] = math.nan
    rows, rates = rows.to(device), rates.to(device)
    expected = rows
    for k in range(2):
        options = None if choose is None else rates[k], 0.5, longest, 40, choose is not False, substeps
        rows, expected = segment_clock(rows, *options), reference(expected, *options)
        torch.testing.assert_close(rows, expected, rtol=1e-13, atol=0, equal_nan=True)


def test_substeps_of_a_scene(device):
    """A span of 1 s at a limit of 0.3 s takes four substeps of 0.25 s. A segment of three leaves one."""
    rows = table(device, now=[2.0], end=[3.0])
    rate = torch.full((1,), 1 / 0.6, dtype=F64, device=device)
    rows = segment_clock(rows, rate, 0.5, math.inf, 100, True, 3)
    c = clocks_of(rows)
    assert c.latest.item() == pytest.approx(0.3) and c.segment_step.item() == 0.25
    assert (c.now.item(), c.left.item(), c.substeps.item()) == (2.75, 4, 3)
    assert c.largest_cfl.item() == pytest.approx(0.25 / 0.6)
    c = clocks_of(segment_clock(rows, rate, 0.5, math.inf, 100, True, ALL_LEFT))
    assert (c.now.item(), c.left.item(), c.substeps.item(), c.segment_step.item()) == (3.0, 1, 4, 0.25)


def test_scenes_that_wait_or_may_not_move(device):
    """Scenes with no more substeps than the segment, without a limit above zero, and with all allowed substeps."""
    rows = table(device, end=[1.0, 1.0, 1.0], substeps=[0.0, 0.0, 9.0])
    rate = torch.tensor([4.0, math.inf, 1e3], dtype=F64, device=device)
    c = clocks_of(segment_clock(rows, rate, 1.0, math.inf, 10, True, 4))
    assert c.left.tolist() == [4, 0, 1] and c.segment_step.tolist() == [0, 0, 0] and c.now.tolist() == [0, 0, 0]


def test_wrong_tensors(device):
    rows, rate = table(device, end=[1.0, 1.0]), torch.ones(2, dtype=F64, device=device)
    rest = 0.5, math.inf, 10, True, 4
    clocks = {
        "be float64, got float32": rows.float(),
        "have shape .B, 8., got .2, 7.": rows[:, :7],
        "have shape .B, 8., got .8.": rows[0],
        "be contiguous": rows.T.contiguous().T,
    }
    for message, wrong in clocks.items():
        with pytest.raises(RuntimeError, match=f"clock must {message}"):
            segment_clock(wrong, rate, *rest)
    rates = {
        "be float64, got float32": rate.float(),
        "have shape .2., got .1.": rate[:1],
        "have shape .2., got .2, 8.": rows,
    }
    for message, wrong in rates.items():
        with pytest.raises(RuntimeError, match=f"rate must {message}"):
            segment_clock(rows, wrong, *rest)
    with pytest.raises(RuntimeError, match="substeps must be"):
        segment_clock(rows, rate, *rest[:-1], -2)


def test_is_a_pure_op(device):
    rows, rate = table(device, end=[1.0, 2.0]), torch.ones(2, dtype=F64, device=device)
    torch.library.opcheck(torch.ops.torch_mpm.segment_clock, (rows, rate, 0.5, math.inf, 10, True, 4))
