"""Which of several processes this one is, and which device it takes: under python, torchrun or SLURM."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

import torch


class WorkerError(ValueError):
    """A process that cannot take part: what its environment says makes no sense, or it has no device."""


@dataclass(frozen=True)
class Worker:
    """One of ``size`` processes; ``local`` is its number among those of its machine."""

    rank: int = 0
    size: int = 1
    local: int = 0


def worker(environment: Mapping[str, str] = os.environ) -> Worker:
    """What the environment says: RANK, WORLD_SIZE and LOCAL_RANK (torchrun); SLURM_PROCID, SLURM_NTASKS and
    SLURM_LOCALID (tasks), SLURM_ARRAY_TASK_ID, _MIN, _STEP and _COUNT (an array, of whose jobs each may have tasks).

    Raises:
        WorkerError: for what is no number, or a rank that is not below the number of processes.
    """

    def number(name: str, default: int) -> int:
        text = environment.get(name, "").strip() or str(default)
        try:
            return int(text)
        except ValueError:
            raise WorkerError(f"{name} must be a whole number, got {text!r}") from None

    if "RANK" in environment:
        found = Worker(number("RANK", 0), number("WORLD_SIZE", 1), number("LOCAL_RANK", 0))
    else:
        tasks, array = number("SLURM_NTASKS", 1), number("SLURM_ARRAY_TASK_COUNT", 1)
        first, step = number("SLURM_ARRAY_TASK_MIN", 0), number("SLURM_ARRAY_TASK_STEP", 1)
        job = (number("SLURM_ARRAY_TASK_ID", first) - first) // max(step, 1)
        rank = job * tasks + number("SLURM_PROCID", 0)
        found = Worker(rank, array * tasks, number("SLURM_LOCALID", 0))
    if not 0 <= found.rank < found.size or found.local < 0:
        raise WorkerError(f"the rank of a process must be below their number, got rank {found.rank} of {found.size}")
    return found


def take_device(name: str, one: Worker) -> torch.device:
    """The device of a process, made the current one before anything is done on it.

    Args:
        name: "cpu", "cuda", "cuda:1", ... or "auto": a GPU if torch finds one. Without a number, processes take the GPU
            of their number on the machine; where each sees one alone, all take that.
        one: this process.

    Raises:
        WorkerError: for a device that does not exist.
    """
    count = torch.cuda.device_count() if name != "cpu" else 0
    if name == "auto":
        name = "cuda" if count else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise WorkerError(f'device must be "auto", "cpu", "cuda" or "cuda:1", got {name!r}') from None
    if device.type == "cpu":
        return device
    if device.type != "cuda" or not count:
        raise WorkerError(f"process {one.rank} of {one.size} needs {name!r}, and torch finds no such device")
    index = device.index if device.index is not None else 0 if count == 1 else one.local
    if index >= count:
        raise WorkerError(
            f"process {one.rank} of {one.size} needs GPU {index} of its machine, and torch finds {count}; start as "
            "many processes per machine as it has GPUs"
        )
    torch.cuda.set_device(index)
    return torch.device("cuda", index)
