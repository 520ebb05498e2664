"""The bandwidth of the memory, and the bytes of the parts that are compared with it."""

import torch

from benchmarks.speed import step, work
from benchmarks.speed.timing import Clock, Time, copy_ms, memory_ms

SIZE = 2**26


def test_plain_copy_reaches_about_the_bandwidth() -> None:
    clock = Clock("cpu", samples=10)
    source = torch.ones(SIZE // 8)
    target = torch.ones_like(source)
    copied = clock.op(lambda: target.copy_(source)).fastest_ms
    assert 0.2 < copy_ms(clock, SIZE) / copied < 5
    assert 0.05 < memory_ms(clock, SIZE) / copied < 5


def test_backward_pass_counts_what_it_needs_and_makes() -> None:
    class Still(Clock):
        def op(self, run: object) -> Time:
            return Time(1.0, 1.0)

    blocks, ops = step.parts(step.setup(work.make(8), "cpu"))
    rows = {r["name"]: r["bytes"] for op in ops for r in step.time_part(Still("cpu"), op, blocks, active=100)}
    P = 8**3
    # Forward x, v, C, F and the new x and F; backward x, C, F and two gradients to three, that of x being passed on.
    assert rows["advance"] == 4 * P * (3 + 3 + 9 + 9 + 3 + 9)
    assert rows["advance, backward"] == 4 * P * (3 + 9 + 9 + 3 + 9 + 3 + 9 + 9)
    assert rows["stress, backward"] == 4 * P * (9 + 9 + 9)
    assert rows["g2p, backward"] == 4 * P * (3 + 3 + 9 + 3) + 4 * 100 * (3 + 3)
