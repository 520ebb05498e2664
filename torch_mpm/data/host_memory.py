"""Memory available to this process, and errors of exhausted memory."""

from __future__ import annotations

import errno
import math
import re
import resource
from pathlib import Path

import torch

LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
"""Files with the limit of a container (cgroup versions 2 and 1) and its usage."""


SHORTAGE = re.compile(
    r"(allocate|allocation|out of|not enough|insufficient) .{0,40}memory|memory allocation failed|bad_alloc|"
    r"failed to map segment|can't allocate|unable to allocate|can't start new thread|cannot allocate",
    re.IGNORECASE,
)
"""Messages of exhausted memory: C, the dynamic linker, C++, NumPy, torch, HDF5, Python."""
WANTED = re.compile(r"you tried to allocate (\d+) bytes")
"""Pattern in torch's message."""


def available() -> float:
    """Memory that can be allocated without swapping [bytes]; infinite where unknown."""
    try:
        return min(_of_machine(), _of_process(), *(_of_container(*files) for files in LIMITS))
    except MemoryError:
        return 0.0


def in_words(size: float) -> str:
    """A number of bytes with its unit."""
    power = int(min(math.log10(max(size, 1)) / 3, 3))
    return f"{size / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB')[power]}"


def is_short(error: BaseException | None) -> bool:
    """Whether an error, or one of its causes, reports exhausted memory."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, (MemoryError, torch.OutOfMemoryError)) or SHORTAGE.search(str(error)):
            return True
        if isinstance(error, OSError) and error.errno == errno.ENOMEM:
            return True
        error = error.__cause__ or error.__context__
    return False


def shortage(error: BaseException) -> str:
    """Requested and available memory in one line, for an error for which `is_short`."""
    text = " ".join(str(error).split())
    wanted = WANTED.search(text)
    text = f"{in_words(int(wanted[1]))} were wanted" if wanted else text
    free, limit = available(), _limit()
    there = f"{in_words(free)} are free" if math.isfinite(free) else ""
    there += f" of the {in_words(limit)} of address space that this process may take (ulimit -v)" if limit else ""
    return "; ".join(part for part in (text[:400], there) if part)


def require(size: float, purpose: str) -> None:
    """Raise MemoryError where less memory is available than the known requirement."""
    if (free := available()) < size:
        raise MemoryError(f"{purpose} takes about {in_words(size)}, and {in_words(free)} are available")


def require_address_space(size: float, purpose: str) -> None:
    """Raise MemoryError where the limit of the address space (ulimit -v) leaves less than the known requirement.

    Compiled libraries end the process where they cannot allocate memory. Without a limit the check costs nothing.
    """
    if _limit() and (free := _of_process()) < size:
        raise MemoryError(
            f"{purpose} takes about {in_words(size)} of address space, and {in_words(free)} are available"
        )


def _limit() -> int:
    """Limit of the address space [bytes]; 0 for none."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return 0 if limit == resource.RLIM_INFINITY else limit


def _of_process() -> float:
    try:
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        return max(0, limit - taken) if (limit := _limit()) else math.inf
    except (OSError, ValueError):
        return math.inf


def _of_machine() -> float:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(float(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return math.inf


def _of_container(limit: str, used: str) -> float:
    try:
        return float(Path(limit).read_text()) - float(Path(used).read_text())
    except (OSError, ValueError):  # No container, or the word "max".
        return math.inf
