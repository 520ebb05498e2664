"""Rank and device of this process among several: under python, torchrun or SLURM."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

import torch


class WorkerError(ValueError):
    """A process that cannot take part: its environment is contradictory, or it has no device."""


@dataclass(frozen=True)
class Worker:
    """One of ``size`` processes.

    ``local`` is its number among the ``beside`` processes of its machine; ``beside`` is 0 where that is unknown.
    """

    rank: int = 0
    size: int = 1
    local: int = 0
    beside: int = 0


def worker(environment: Mapping[str, str] = os.environ) -> Worker:
    """Rank from the environment: RANK, WORLD_SIZE, LOCAL_RANK and LOCAL_WORLD_SIZE (torchrun); SLURM_PROCID,
    SLURM_NTASKS, SLURM_LOCALID and SLURM_NTASKS_PER_NODE (tasks), SLURM_ARRAY_TASK_ID, _MIN, _STEP and _COUNT (an
    array, of whose jobs each may have tasks).

    Raises:
        WorkerError: for a value that is not a number, or a rank that is not below the number of processes.
    """

    def number(name: str, default: int) -> int:
        text = environment.get(name, "").strip() or str(default)
        try:
            return int(text)
        except ValueError:
            raise WorkerError(f"{name} must be a whole number, got {text!r}") from None

    if "RANK" in environment:
        beside = number("LOCAL_WORLD_SIZE", 0)
        found = Worker(number("RANK", 0), number("WORLD_SIZE", 1), number("LOCAL_RANK", 0), beside)
    else:
        tasks, array = number("SLURM_NTASKS", 1), number("SLURM_ARRAY_TASK_COUNT", 1)
        first, step = number("SLURM_ARRAY_TASK_MIN", 0), number("SLURM_ARRAY_TASK_STEP", 1)
        job = (number("SLURM_ARRAY_TASK_ID", first) - first) // max(step, 1)
        rank = job * tasks + number("SLURM_PROCID", 0)
        found = Worker(rank, array * tasks, number("SLURM_LOCALID", 0), number("SLURM_NTASKS_PER_NODE", 0))
    for rank, size in ((found.rank, found.size), (found.local, found.beside or found.local + 1)):
        if not 0 <= rank < size:
            raise WorkerError(f"the rank of a process must be below their number, got rank {rank} of {size}")
    return found


def take_device(name: str, one: Worker) -> torch.device:
    """Device of a process, set as the current one before its first use.

    Args:
        name: "cpu", "cuda", "cuda:1", ... or "auto": a GPU if torch finds one. Without a number, a process uses the GPU
            of its number on the machine, cyclically where there are two, three, ... times as many processes; where each
            process has access to one GPU only, all use that.
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
    if device.index is not None:
        index = device.index
    else:
        shared = count == 1 or (one.beside and one.beside % count == 0)
        index = one.local % count if shared else one.local
    if index >= count:
        raise WorkerError(
            f"process {one.rank} of {one.size} needs GPU {index} of its machine, and torch finds {count}; start as "
            "many processes per machine as it has GPUs, or two, three, ... times as many"
        )
    torch.cuda.set_device(index)
    return torch.device("cuda", index)
