"""Common parts of benchmarks: environments, and result files."""

from __future__ import annotations

import contextlib
import ctypes
import datetime
import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parent.parent
RESULTS = Path(__file__).parent / "results"


def use_all_cores() -> int:
    """Let torch use every core available to this process; returns their number."""
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    return torch.get_num_threads()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Context for small scenes on a busy machine, where threads would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def release_memory() -> None:
    """Return freed memory to the system.

    The heap of glibc before 2.38 fragments without bound under aligned allocations (glibc bug 14581): a rollout of
    large tensors on the CPU then takes gigabytes.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):
        libc.malloc_trim(0)


def environment(device: str = "cpu", devices: int = 1) -> dict[str, Any]:
    """Device and number of devices, versions, commit and date of a result."""
    import torch_mpm.info

    build = torch_mpm.info.info()
    place: dict[str, Any] = {
        "device": f"{devices} " * (devices > 1) + device_name(device),
        "torch_mpm": build["version"],
        "commit": commit(),
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    if torch.device(device).type == "cuda":
        place["cuda"] = torch.version.cuda
        if "--Ofast-compile=max" in build["build"].get("cuda", {}).get("flags", []):
            place["kernels"] = "compiled for a check, slow"
    else:
        place["threads"] = torch.get_num_threads()
        place["instructions"] = torch.backends.cpu.get_cpu_capability()
        place["load"] = round(os.getloadavg()[0], 1)
        if "OMP_WAIT_POLICY" in os.environ:
            place["OMP_WAIT_POLICY"] = os.environ["OMP_WAIT_POLICY"]
    return place


def device_name(device: str) -> str:
    """Name of the processor or GPU from its manufacturer."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        models = re.findall(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        models = []
    return models[0] if models else platform.processor() or platform.machine()


def commit() -> str:
    """TORCH_MPM_COMMIT, for a tree outside git; otherwise the commit, "-dirty" where files differ."""
    if given := os.environ.get("TORCH_MPM_COMMIT"):
        return given
    try:
        run = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--exclude=*"], cwd=ROOT, capture_output=True, text=True
        )
        described = run.stdout.strip() if run.returncode == 0 else ""
    except OSError:
        described = ""
    return described or "unknown"


def slug(name: str) -> str:
    """A device's name as part of a file name."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def write(directory: Path, name: str, result: dict[str, Any], text: str) -> None:
    """Write a result as `name`.json for programs and `name`.md for readers."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / f"{name}.json").write_text(compact(result) + "\n")
    (directory / f"{name}.md").write_text(text.rstrip() + "\n")
    print(f"wrote {directory / name}.json and .md")


def compact(value: Any, indent: str = "") -> str:
    """JSON of a value with every innermost list or dictionary on one line."""
    items = list(value.values() if isinstance(value, dict) else value) if isinstance(value, (dict, list, tuple)) else []
    if not any(isinstance(item, (dict, list, tuple)) for item in items):
        return json.dumps(value)
    inner = indent + " "
    lines = [inner + compact(item, inner) for item in items]
    if isinstance(value, dict):
        lines = [inner + json.dumps(str(key)) + ": " + compact(item, inner) for key, item in value.items()]
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return opening + "\n" + ",\n".join(lines) + "\n" + indent + closing


def read(directory: Path, pattern: str) -> list[dict[str, Any]]:
    """Results of a directory with matching file names, in the order of these names."""
    return [json.loads(file.read_text()) for file in sorted(directory.glob(pattern))]


def describe(place: dict[str, Any]) -> str:
    """An environment as one line of a report."""
    return ", ".join(str(v) if k == "device" else f"{k} {v}" for k, v in place.items())


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table, its columns aligned so that it reads as plain text too."""
    cells = [[str(c) for c in header], *([_cell(c) for c in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in cells]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    return (
        f"{value:.3g}"
        if value == 0 or 1e-3 <= abs(value) < 1000
        else f"{value:.0f}"
        if 1000 <= abs(value) < 1e6
        else f"{value:.1e}"
    )


def order_of(sizes: Sequence[float], errors: Sequence[float]) -> list[float | None]:
    """Observed order of convergence between neighbours of a refinement, None for the first."""
    pairs = zip(zip(sizes, errors, strict=True), zip(sizes[1:], errors[1:], strict=True), strict=False)
    return [None, *(math.log(e0 / e1) / math.log(s0 / s1) for (s0, e0), (s1, e1) in pairs)]
