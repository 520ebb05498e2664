"""Files of frames, under the names of `engine_utils` of PhysGaussian and of its descendants."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from ...data.hdf5 import new_file
from ...data.whole_files import replacing
from ...errors import shape_of
from ...geometry.point_files import write_ply
from ...geometry.surface_mesh import Array

if TYPE_CHECKING:
    from .simulator import MPM_Simulator_WARP

__all__ = ["particle_position_tensor_to_ply", "particle_position_to_ply", "save_data_at_frame"]

DIGITS = 10
"""Digits of the number of a frame in the name of its file."""


def save_data_at_frame(
    mpm_solver: MPM_Simulator_WARP,
    dir_name: str | os.PathLike[str],
    frame: int,
    save_to_ply: bool = True,
    save_to_h5: bool = False,
) -> None:
    """Write the present particles as sim_0000000000.ply and sim_0000000000.h5 with the number of a frame.

    The HDF5 file has x and v [3, P] [m, m/s], F in "f_tensor" and C [9, P], float32, and time [1, 1] [s]; of the
    first scene of a `BatchedSimulator`, as in kywind's warp-mpm.

    Args:
        mpm_solver: the simulator.
        dir_name: the folder, which is created.
        frame: the number.
        save_to_ply: whether to write positions.
        save_to_h5: whether to write the HDF5 file.

    Raises:
        ImportError: without h5py, where it is needed.
        OSError: when a file cannot be written; nothing remains of it.
    """
    path = Path(dir_name) / f"sim_{str(frame).zfill(DIGITS)}"
    path.parent.mkdir(parents=True, exist_ok=True)
    if save_to_ply:
        particle_position_to_ply(mpm_solver, path.with_suffix(".ply"))
    if save_to_h5:
        fields = {name: _first_scene(mpm_solver, f"particle_{name}") for name in ("x", "F", "v", "C")}
        with replacing(path.with_suffix(".h5")) as building, new_file(building) as (file, _):
            for name, values in fields.items():
                file.create_dataset("f_tensor" if name == "F" else name, data=values.reshape(len(values), -1).T)
            file.create_dataset("time", data=np.array([[mpm_solver.time]]))


def particle_position_to_ply(mpm_solver: MPM_Simulator_WARP, filename: str | os.PathLike[str]) -> None:
    """Write the present positions [P, 3] [m] of a simulator as a binary PLY file.

    Scene k of a `BatchedSimulator` is displaced by k m along x, as in kywind's warp-mpm.

    Raises:
        OSError: when the file cannot be written; nothing remains of it.
    """
    x = mpm_solver.mpm_state.particle_x.detach()
    if x.dim() == 3:
        x = x.clone()
        x[:, :, 0] += x.new_tensor(range(len(x)))[:, None]
    particle_position_tensor_to_ply(x.reshape(-1, 3), filename)


def particle_position_tensor_to_ply(position_tensor: Tensor, filename: str | os.PathLike[str]) -> None:
    """Write positions [P, 3] as a binary PLY file, float32.

    Raises:
        ValueError: for another shape.
        OSError: when the file cannot be written; nothing remains of it.
    """
    if not isinstance(position_tensor, Tensor) or position_tensor.dim() != 2 or position_tensor.shape[1] != 3:
        raise ValueError(f"position_tensor must have shape [P, 3], got {shape_of(position_tensor)}")
    x = _numpy(position_tensor)
    write_ply(filename, {axis: x[:, k] for k, axis in enumerate("xyz")})


def _first_scene(simulator: MPM_Simulator_WARP, name: str) -> Array:
    """A field of particles, [P, ...]."""
    values: Tensor = getattr(simulator.mpm_state, name)
    batched = simulator.mpm_state.particle_x.dim() == 3
    return _numpy(values[0] if batched else values)


def _numpy(values: Tensor) -> Array:
    return values.detach().float().cpu().numpy()
