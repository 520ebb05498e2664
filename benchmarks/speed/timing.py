"""Times of tensor programs on the CPU and on CUDA."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable

import torch

Run = Callable[[], object]


@dataclasses.dataclass(frozen=True)
class Time:
    """Median and minimum of several measurements [ms]; whether of a CUDA graph, which excludes the host."""

    ms: float
    fastest_ms: float
    graph: bool = False


class Clock:
    """Clock of one device.

    On CUDA everything runs on one stream, that of this clock: use `with clock:` around the set-up too, because autograd
    runs a backward pass on the stream of its forward pass and a graph can capture one stream only.
    """

    def __init__(self, device: str, samples: int = 20, budget: float = 1.0) -> None:
        self.device = torch.device(device)
        self.samples, self.budget = samples, budget
        self.cuda = self.device.type == "cuda"
        if self.cuda:
            self.stream = torch.cuda.Stream()
            # Read between measurements, so that a kernel finds its data in memory rather than in the cache.
            self._flush = torch.zeros(64 * 2**20, device=self.device)

    def __enter__(self) -> Clock:
        if self.cuda:
            torch.cuda.synchronize()
            self._context = torch.cuda.stream(self.stream)
            self._context.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        if self.cuda:
            torch.cuda.synchronize()
            self._context.__exit__(*exception)

    def synchronize(self) -> None:
        if self.cuda:
            torch.cuda.synchronize()

    def op(self, run: Run) -> Time:
        """One op: CUDA events around the replay of a graph with a cold cache, or the wall clock on the CPU."""
        for _ in range(3 if self.cuda else 1):
            run()
        if not self.cuda:
            return Time(*self._sample(lambda: _wall(run)))
        graph = self.capture(run)
        return Time(*self._sample(lambda: self._events(graph or run)), graph is not None)

    def steps(self, run: Run, count: int) -> Time:
        """Wall clock of a program that does `count` steps and is synchronised once, per step."""
        run()

        def together() -> None:
            run()
            self.synchronize()

        self.synchronize()
        median, fastest = self._sample(lambda: _wall(together))
        return Time(median / count, fastest / count)

    def capture(self, run: Run) -> Run | None:
        """Replay of a CUDA graph of `run`, or None where it cannot be captured."""
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.graph(graph, stream=self.stream):
                keep = run()
        except RuntimeError as error:
            torch.cuda.synchronize()
            print(f"not captured in a CUDA graph: {str(error).splitlines()[0]}")
            return None

        def replay(_: object = keep) -> None:
            graph.replay()

        return replay

    def _sample(self, measure: Callable[[], float]) -> tuple[float, float]:
        times: list[float] = []
        while len(times) < self.samples and (len(times) < 3 or sum(times) < self.budget * 1e3):
            times.append(measure())
        return statistics.median(times), min(times)

    def _events(self, run: Run) -> float:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        self._flush.sum()
        start.record(self.stream)
        run()
        end.record(self.stream)
        end.synchronize()
        return start.elapsed_time(end)


def _wall(run: Run) -> float:
    begin = time.perf_counter()
    run()
    return (time.perf_counter() - begin) * 1e3


def memory_ms(clock: Clock, size: int) -> float:
    """Minimum time in which the memory moves `size` bytes: a copy, which writes half of them, or a read [ms]."""
    return min(copy_ms(clock, size), read_ms(clock, size))


def copy_ms(clock: Clock, size: int) -> float:
    """Minimum time of a copy that reads and writes `size` bytes together [ms]."""
    source = torch.ones(size // 8, device=clock.device)
    target = torch.ones_like(source)
    # A kernel, as the parts are: a CUDA graph converts `copy_` to a transfer by the driver.
    return clock.op(lambda: torch.neg(source, out=target)).fastest_ms


def read_ms(clock: Clock, size: int) -> float:
    """Minimum time of a sum over `size` bytes [ms]."""
    values = torch.ones(size // 4, device=clock.device)
    return clock.op(values.sum).fastest_ms


def float32_rate(clock: Clock, n: int = 8192) -> float:
    """Largest rate of operations of a product of n × n matrices in float32, without tensor cores [1/s]."""
    a, b = (torch.rand(n, n, device=clock.device) for _ in range(2))
    product = torch.empty_like(a)
    precision = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        return 2 * n**3 / clock.op(lambda: torch.mm(a, b, out=product)).fastest_ms * 1e3
    finally:
        torch.set_float32_matmul_precision(precision)
