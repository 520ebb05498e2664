"""The whole state of a run in one HDF5 file, from which it goes on bit for bit."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..state import State
from ..trajectory import disk_errors, h5py_module

Host = dict[str, Tensor]
EXTRA = "extra."


def tensors_of(state: State) -> Host:
    """The tensors that a state has, by name, those of `extra` as "extra.NAME"."""
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    fields |= {EXTRA + name: value for name, value in state.extra.items()}
    return {name: value for name, value in fields.items() if isinstance(value, Tensor)}


def save(path: Path, tensors: Host, record: dict[str, Any]) -> None:
    """Write tensors (on the CPU) and a JSON record; ``path`` is replaced at once, or not at all."""
    building = path.with_suffix(".building")
    try:
        with disk_errors(building), h5py_module().File(building, "w") as out:
            for name, tensor in tensors.items():
                out[name] = tensor.numpy()
            out.attrs["record"] = json.dumps(record)
        with open(building, "rb") as handle:
            os.fsync(handle.fileno())
        building.replace(path)
    except BaseException:
        building.unlink(missing_ok=True)
        raise


def load(path: Path, device: torch.device | str = "cpu") -> tuple[State, dict[str, Any]]:
    """The state that `save` wrote, in the memory order it had, and the record."""
    with h5py_module().File(path, "r") as source:
        record = json.loads(source.attrs["record"])
        tensors: dict[str, Any] = {name: torch.from_numpy(data[()]) for name, data in source.items()}
    extra = {name.removeprefix(EXTRA): tensors.pop(name) for name in list(tensors) if name.startswith(EXTRA)}
    time = tensors.pop("time", record["time"])
    state = State.concatenate([State(**tensors, extra=extra, time=time)])  # which restores the memory layout
    return state.to(device), record
