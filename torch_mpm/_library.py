"""Loads the native libraries beside this file into torch.ops.torch_mpm when torch_mpm is imported."""

from __future__ import annotations

import ctypes
import functools
import json
import os
from pathlib import Path
from typing import Any

import torch

from . import signals

DIRECTORY = Path(__file__).parent / "lib"
CPU_LIBRARY = DIRECTORY / "libtorch_mpm_cpu.so"
CUDA_LIBRARY = DIRECTORY / "libtorch_mpm_cuda.so"

cuda_error: str | None = None
"""Reason why the CUDA library is not in use, or None if it is loaded."""


def _load(path: Path, backend: str) -> str | None:
    """Register the ops of a library; return the reason why it cannot be loaded, or None."""
    try:
        torch.ops.load_library(os.fspath(path))
    except OSError as error:
        return str(error.__cause__ or error)  # torch wraps the loader's message in one that omits the reason.
    signals.watch(ctypes.CDLL(os.fspath(path)), backend)
    return None


def listed(function: str) -> Any:
    """JSON returned by a function of the CPU library without arguments."""
    text = getattr(ctypes.CDLL(os.fspath(CPU_LIBRARY)), function)
    text.restype = ctypes.c_char_p
    return json.loads(text())


def _load_cpu() -> None:
    if not CPU_LIBRARY.exists():
        raise ImportError(
            f"torch_mpm is not built: {CPU_LIBRARY} does not exist. Run `make build` in the source tree, "
            "or install the package with `pip install .`"
        )
    if reason := _load(CPU_LIBRARY, "cpu"):
        raise ImportError(
            f"torch_mpm cannot load {CPU_LIBRARY} with torch {torch.__version__} (2.11 or newer is needed): {reason}"
        )


def _load_cuda() -> str | None:
    """Load the CUDA library if it can be used; return the reason why not."""
    if not CUDA_LIBRARY.exists():
        return "torch_mpm was built without its CUDA library (build with TORCH_MPM_CUDA=1 where nvcc is installed)"
    if torch.version.cuda is None:
        return f"torch {torch.__version__} was built without CUDA"
    return _load(CUDA_LIBRARY, "cuda")


def graph_loops() -> bool:
    """Whether the device is not known to refuse CUDA graphs with loops; also where the CUDA library is not in use."""
    return cuda_error is not None or bool(_opened(CUDA_LIBRARY).torch_mpm_graph_loops())


@functools.cache
def _opened(library: Path) -> ctypes.CDLL:
    """A library whose functions are called without torch; opening it looks for its file each time."""
    return ctypes.CDLL(os.fspath(library))


_load_cpu()
cuda_error = _load_cuda()
