"""Complete state of a run in one HDF5 file, from which it continues bit for bit."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..data.hdf5 import h5py_module, open_sealed, seal
from ..data.whole_files import building_path
from ..errors import DamagedFileError
from .state import EXTRA, State, _as_soa

Host = dict[str, Tensor]
REMEDY = "remove it and add --resume to simulate from the start"


def save(path: Path, tensors: Host, record: dict[str, Any]) -> None:
    """Write tensors (on the CPU) and a JSON record; ``path`` is replaced atomically.

    Raises:
        OSError: when the disk is full.
    """
    image = io.BytesIO()
    with h5py_module().File(image, "w") as out:
        for name, tensor in tensors.items():
            out[name] = tensor.numpy()
        out.attrs["record"] = json.dumps(record)
    building = building_path(path)
    try:
        with open(building, "w+b") as handle:
            handle.write(image.getbuffer())
            seal(handle, [(0, image.getbuffer().nbytes)])
            handle.flush()
            os.fsync(handle.fileno())
        building.replace(path)
    except BaseException:
        building.unlink(missing_ok=True)
        raise


def load(path: Path, device: torch.device | str = "cpu", remedy: str = REMEDY) -> tuple[State, dict[str, Any]]:
    """State written by `save`, in its original memory order, and the record; `remedy` is for messages.

    Raises:
        DamagedFileError: for a file that is damaged or holds something else.
    """
    with open_sealed(path, remedy, in_memory=True) as source:
        try:
            record = json.loads(source.attrs["record"])
            tensors: dict[str, Any] = {name: torch.from_numpy(data[()]) for name, data in source.items()}
            extra = {name.removeprefix(EXTRA): tensors.pop(name) for name in list(tensors) if name.startswith(EXTRA)}
            time = tensors.pop("time", record["time"])
            state = State(**tensors, extra=extra, time=time)
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise DamagedFileError(path, f"does not hold the state of a run ({error})", remedy) from None
    return state.map(_as_soa).to(device), record
