"""Signals during ops of many substeps: their handlers run meanwhile, and what they raise ends the op."""

import contextlib
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest
import torch

import torch_mpm as mpm

MANY = 5_000_000
"""Steps that would take many minutes."""


class Stopped(Exception):
    pass


def stop(*_: object) -> None:
    raise Stopped


@contextlib.contextmanager
def alarms(handler: Callable[..., None], first: float, then: float = 0.0) -> Iterator[None]:
    """A signal after `first` seconds, and then after `then` seconds each."""
    before = signal.signal(signal.SIGALRM, handler)
    signal.setitimer(signal.ITIMER_REAL, first, then)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def scene(device: str, side: int = 60) -> tuple[mpm.Step, mpm.State]:
    grid = mpm.Grid(dx=1.0 / side, lower=(0.0, 0.0), upper=(1.0, 1.0), max_blocks=(side // 4 + 2) ** 2)
    points = mpm.seed.box((0.2, 0.2), (0.8, 0.8), grid, per_cell=4)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), gravity=(0.0, -9.8), walls="separate")
    return step, mpm.State.at_rest(points, dtype=torch.float64).to(device)


def with_gradient(step: mpm.Step, state: mpm.State) -> None:
    """Records all steps of a call, whose backward pass takes as long."""
    v = state.v.clone().requires_grad_()
    end = mpm.rollout(step, state.replace(v=v), 400, 1e-5, mpm.Checkpoints(memory=1e12))
    with alarms(stop, 0.01):
        torch.autograd.grad(end.x.sum(), v)


def while_tracking(step: mpm.Step, state: mpm.State) -> None:
    with alarms(stop, 0.05):
        mpm.rollout(step, state.replace(v=state.v.clone().requires_grad_()), MANY, 1e-5, 100)


def without_gradient(step: mpm.Step, state: mpm.State) -> None:
    with torch.no_grad(), alarms(stop, 0.05):
        mpm.rollout(step, state, MANY, 1e-5)


def of_scenes(step: mpm.Step, state: mpm.State) -> None:
    with torch.no_grad(), alarms(stop, 0.05):
        mpm.rollout(step, state, MANY, torch.full((1,), 1e-5, dtype=state.x.dtype, device=state.x.device))


def to_a_time(step: mpm.Step, state: mpm.State) -> None:
    with torch.no_grad(), alarms(stop, 0.05):
        mpm.rollout_to(step, state, 1e3, every=1000, most=MANY)


WAYS = (without_gradient, of_scenes, while_tracking, with_gradient, to_a_time)


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_what_a_handler_raises_ends_the_op_and_the_state_is_as_before(way, device):
    step, state = scene(device)
    before = state.map(torch.clone)
    with pytest.raises(Stopped):
        way(step, state)
    for name in ("x", "v", "mass", "volume"):
        assert torch.equal(getattr(state, name), getattr(before, name))
    other, _ = scene(device)
    with torch.no_grad():
        end, expected = (mpm.rollout(s, state, 20, 1e-4) for s in (step, other))
    torch.testing.assert_close(end.x, expected.x)
    step.check(end)


def test_handlers_that_do_not_raise_change_nothing(device):
    """Also one that takes steps itself."""
    step, state = scene(device)
    other, small = scene(device, 16)
    seen = []

    def handler(*_: object) -> None:
        seen.append(float(mpm.rollout(other, small, 3, 1e-4).x.sum()))

    n = 400
    with torch.no_grad():
        expected = mpm.rollout(step, state, n, 1e-5)
        with alarms(handler, 0.02, 0.02):
            end = mpm.rollout(step, state, n, 1e-5)
            while not seen:  # on a fast device
                end = mpm.rollout(step, state, n, 1e-5)
    assert len(set(seen)) == 1
    if device == "cpu":
        assert torch.equal(end.x, expected.x)
    torch.testing.assert_close(end.x, expected.x)


def test_ops_of_other_threads_run_no_handlers(device):
    """Python has the main thread run them, which waits for the other one here."""
    step, state = scene(device)
    where, ends = [], []

    def steps() -> None:
        with torch.no_grad():
            ends.append(mpm.rollout(step, state, 300, 1e-5))

    thread = threading.Thread(target=steps)
    with alarms(lambda *_: where.append(threading.current_thread()), 0.01):
        thread.start()
        thread.join()
        while not where:
            pass
    assert len(ends) == 1 and where == [threading.main_thread()]


PROGRAM = """
import torch, torch_mpm as mpm
torch.set_num_threads(1)
grid = mpm.Grid(dx=1 / 60, lower=(0.0, 0.0), upper=(1.0, 1.0))
state = mpm.State.at_rest(mpm.seed.box((0.2, 0.2), (0.8, 0.8), grid, per_cell=4))
step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), gravity=(0.0, -9.8), walls="separate")
x = state.x.clone()
try:
    print("ready", flush=True)
    with torch.no_grad():
        mpm.rollout(step, state, 5_000_000, 1e-5)
except KeyboardInterrupt:
    assert torch.equal(state.x, x)
    after = mpm.rollout(step, state, 5, 1e-5)
    print("interrupted", bool(after.x.isfinite().all()), flush=True)
"""


@pytest.mark.thorough
def test_interrupts_of_a_process():
    with subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=100)
    assert out == "interrupted True\n" and process.returncode == 0


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGHUP])
def test_signals_with_the_handler_of_the_system_end_a_process(end):
    with subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(end)
        out, _ = process.communicate(timeout=100)
    assert out == "" and process.returncode == -end
