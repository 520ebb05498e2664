"""Memory that this machine has left for large results."""

from __future__ import annotations

import math
from pathlib import Path

LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
"""Files with the limit of a container (cgroup versions 2 and 1) and what it uses."""


def available() -> float:
    """Memory that can be allocated without swapping [bytes]; infinite where the system does not say."""
    return min(_of_machine(), *(_of_container(*files) for files in LIMITS))


def _of_machine() -> float:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(float(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return math.inf


def _of_container(limit: str, used: str) -> float:
    try:
        return float(Path(limit).read_text()) - float(Path(used).read_text())
    except (OSError, ValueError):  # no container, or the word "max"
        return math.inf
