"""Build configuration and usable devices of this installation of torch_mpm."""

from __future__ import annotations

import json
import platform
from typing import Any

import torch

from . import _library


def info() -> dict[str, Any]:
    """Describe the installation.

    Returns:
        ``version`` of torch_mpm, ``python``, ``torch``, ``build`` (compilers, options, architectures and torch headers,
        as the build recorded them), ``cpu`` (instruction set of the processor, threads) and ``cuda`` (``usable``, and
        the ``devices`` or the ``reason`` why none can be used).
    """
    record = _library.DIRECTORY / "build.json"
    build = json.loads(record.read_text()) if record.exists() else {}
    return {
        "version": build.pop("version", "unknown"),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "build": build,
        "cpu": {"capability": torch.backends.cpu.get_cpu_capability(), "threads": torch.get_num_threads()},
        "cuda": _cuda(),
    }


def _cuda() -> dict[str, Any]:
    reason = _library.cuda_error
    if reason is None and not torch.cuda.is_available():
        reason = "torch finds no CUDA device"
    if reason is not None:
        return {"usable": False, "reason": reason}
    devices = [torch.cuda.get_device_properties(index) for index in range(torch.cuda.device_count())]
    return {"usable": True, "devices": [f"{d.name} (compute capability {d.major}.{d.minor})" for d in devices]}


def print_info() -> None:
    """Print :func:`info` as indented ``key: value`` lines."""
    print("\n".join(_lines(info())))


def _lines(values: dict[str, Any], indent: str = "") -> list[str]:
    lines = []
    for key, value in values.items():
        if isinstance(value, dict):
            lines += [f"{indent}{key}:", *_lines(value, indent + "  ")]
        else:
            text = " ".join(str(item) for item in value) if isinstance(value, list) else value
            lines.append(f"{indent}{key}: {text}")
    return lines
