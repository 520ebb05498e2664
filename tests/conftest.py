import gc
import os
import signal
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
import torch

# For setup.py, the benchmarks and, unless PYTHONPATH names another build of it, torch_mpm.
sys.path.append(str(Path(__file__).parent.parent))

import setup
from torch_mpm import _library
from torch_mpm.info import info

# Small tensors: more threads only wait for each other, above all on a busy machine.
THREADS = min(2, torch.get_num_threads())
torch.set_num_threads(THREADS)

CUDA = torch.cuda.is_available() and _library.cuda_error is None
DEVICES = ["cpu", *([pytest.param("cuda", marks=pytest.mark.cuda)] if CUDA else [])]


def pytest_configure() -> None:
    """Fail where a GPU is present but not usable, unless TORCH_MPM_CUDA=0: its tests are never skipped silently."""
    if not CUDA and setup.gpu_present() and os.environ.get("TORCH_MPM_CUDA") != "0":
        reason = _library.cuda_error or f"torch {torch.__version__} finds no CUDA device"
        raise pytest.UsageError(f"this machine has a GPU, but {reason}. TORCH_MPM_CUDA=0 tests the CPU alone.")
    sanitizers = os.environ.get("TORCH_MPM_SANITIZE", "")
    if sanitizers and info()["build"]["cpu"]["sanitize"] != sanitizers:
        raise pytest.UsageError(f"{_library.CPU_LIBRARY} is not built with TORCH_MPM_SANITIZE={sanitizers}")
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:  # As in the background, which processes of tests would inherit.
            signal.signal(number, handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Modules and tests stay: the garbage collector skips their millions of objects, in each of its passes."""
    gc.disable()
    result = yield
    gc.freeze()
    gc.enable()
    return result


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Cases of a test with `thorough(name=value)` that have this value become `thorough`; others lose the mark."""
    for item in items:
        for mark in list(item.iter_markers("thorough")):
            if mark.kwargs and not mark.kwargs.items() <= _parameters(item).items():
                item.own_markers.remove(mark)


def _parameters(item: pytest.Item) -> dict[str, object]:
    return item.callspec.params if hasattr(item, "callspec") else {}


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("cuda") and not CUDA:
        pytest.skip("needs a CUDA device")


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """Every device that this machine can use, so that the same test runs on each; those on CUDA are marked so."""
    return request.param


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def few_threads() -> None:
    """A benchmark called by an earlier test may have set more: they would wait for each other in all later tests."""
    if torch.get_num_threads() != THREADS:
        torch.set_num_threads(THREADS)


@pytest.fixture(autouse=True)
def no_compiled_code() -> None:
    """Code that earlier tests compiled counts towards the limit of recompilations, beyond which a test fails."""
    dynamo = sys.modules.get("torch._dynamo")
    if dynamo is not None:
        dynamo.reset()


@pytest.fixture
def one_thread() -> Iterator[None]:
    """For scenes so small that threads would wait for each other most of the time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=["quadratic", "cubic"])
def kernel(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(params=[2, 3])
def dim(request: pytest.FixtureRequest) -> int:
    return request.param
