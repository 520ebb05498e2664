"""Work in a separate thread that ends with the program, which does not wait for unneeded results."""

import itertools
import threading
import time
import weakref

import pytest

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

from generated import assert_same, configuration

from torch_mpm.data import generate as generation
from torch_mpm.data import shard_simulation
from torch_mpm.data.generate import generate
from torch_mpm.data.stoppable import StoppableExecutor, Stopped

LONG = 20.0
"""Duration of work that is not stopped [s]."""


class LongWork:
    """Work that records whether it has begun and whether it has ended."""

    def __init__(self):
        self.begun, self.ended = threading.Event(), False

    def __call__(self, *_):
        self.begun.set()
        end = time.monotonic() + LONG
        while time.monotonic() < end:
            pass
        self.ended = True


def test_work_is_stopped_and_what_waits_is_cancelled():
    work = LongWork()
    with StoppableExecutor() as executor:
        assert executor.submit(pow, 2, 3).result() == 8
        first, second = executor.submit(work), executor.submit(work)
        work.begun.wait()
        executor.stop()
        assert isinstance(first.exception(), Stopped) and second.cancelled()
    assert not work.ended


def test_work_is_stopped_in_a_callback_that_drops_exceptions(capfd):
    """As torch's dictionaries of weak references have them."""
    work, dropped = LongWork(), threading.Event()

    class Target:
        pass

    def callback(_):
        dropped.set()
        end = time.monotonic() + LONG
        while time.monotonic() < end:
            pass

    def in_callback():
        target = Target()
        reference = weakref.ref(target, callback)
        del target
        return work() if reference() is None else None

    with StoppableExecutor() as executor:
        future = executor.submit(in_callback)
        dropped.wait()
        executor.stop()
        assert isinstance(future.exception(), Stopped) and not work.ended
    assert "Stopped" not in capfd.readouterr().err


def test_an_executor_without_work_is_stopped():
    with StoppableExecutor() as executor:
        executor.stop()
        with pytest.raises(RuntimeError):
            executor.submit(print)


def test_an_interrupt_does_not_wait_for_scenes_that_are_drawn(tmp_path, monkeypatch):
    """Finished shards remain, without temporary files."""
    work, numbers = LongWork(), itertools.count()

    def draw(*arguments):
        return work() if next(numbers) == 2 else shard_simulation.draw(*arguments)

    def interrupt(figures):
        if figures["scenes"] == 2:  # the first shard is simulated
            work.begun.wait()
            raise KeyboardInterrupt

    monkeypatch.setattr(generation, "draw", draw)
    with pytest.raises(KeyboardInterrupt):
        generate(configuration(), tmp_path / "set", device="cpu", progress=interrupt)
    monkeypatch.undo()
    assert not work.ended and not list(tmp_path.rglob("*.building*"))
    assert (tmp_path / "set" / "shards" / "shard_00000.json").exists()
    generate(configuration(), tmp_path / "set", device="cpu")
    generate(configuration(), tmp_path / "whole", device="cpu")
    assert_same(tmp_path / "set", tmp_path / "whole")


def test_an_interrupt_does_not_wait_for_a_shard_that_takes_long_to_write(tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "WRITING_SECONDS", 0.0)
    begun, go_on = threading.Event(), threading.Event()

    def slow(outcome, prepared=generation._prepared):
        begun.set()
        go_on.wait(LONG)
        return prepared(outcome)

    def interrupt(figures):
        if figures["scenes"] == 2:
            begun.wait()
            threading.Timer(0.2, go_on.set).start()
            raise KeyboardInterrupt

    monkeypatch.setattr(generation, "MOST_PACKERS", 1)
    monkeypatch.setattr(generation, "_prepared", slow)
    with pytest.raises(KeyboardInterrupt):
        generate(configuration(), tmp_path / "set", device="cpu", progress=interrupt)
    assert not list((tmp_path / "set" / "shards").iterdir())
