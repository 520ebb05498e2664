"""PLY files of 3-D Gaussian splatting."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..data.host_copies import copied
from ..data.whole_files import replacing
from ..geometry import point_files
from ..geometry.surface_mesh import Array
from .gaussians import Gaussians, check_gaussians
from .harmonics import COUNTS

Rows = npt.NDArray[np.float32]
COLOR = tuple(f"f_dc_{k}" for k in range(3))
SCALE = tuple(f"scale_{k}" for k in range(3))
ROTATION = tuple(f"rot_{k}" for k in range(4))
NEEDED = (*COLOR, "opacity", *SCALE, *ROTATION)
"""Properties without which a file has no Gaussians, beside x, y and z."""
REST = tuple(3 * (count - 1) for count in COUNTS)
"""Number of the properties f_rest_0, f_rest_1, ... for the degrees 0 to 3."""
SMALLEST_LOG, LARGEST_LOG = -40.0, 20.0
"""Range of the logarithms of deviations, for which squares in a picture neither vanish nor overflow in float32."""


def read(path: str | Path, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Gaussians of a PLY file, ASCII or binary of either byte order, on the CPU.

    Properties of the vertices: the centre x, y, z; f_dc_0 to 2 and f_rest_0 to 8, 23 or 44, the harmonics of the degree
    0 and of the higher ones, channel by channel; opacity, a logit; scale_0 to 2, logarithms of the deviations; rot_0 to
    3, a quaternion w, x, y, z of any length. Others, such as the normals nx, ny, nz, are ignored.

    Args:
        path: the file; lengths in it are in metres.
        dtype: float32 or float64.

    Raises:
        OSError: for a file that cannot be read.
        ValueError: for a file that is no PLY file, lacks properties, or has a number of a wrong type, a number that is
            not finite, a quaternion of zeros, or a deviation that is too large or too small.
    """
    if Path(path).suffix.lower() != ".ply":
        raise ValueError(f"splats file must end in .ply, got {path}")
    found = point_files.read(path, 3)
    try:
        return _gaussians(found.x, found.fields, dtype)
    except ValueError as error:
        raise ValueError(f"splats file {path}: {error}") from None


def _gaussians(x: Array, fields: dict[str, Array], dtype: torch.dtype) -> Gaussians:
    if missing := [name for name in NEEDED if name not in fields]:
        raise ValueError(f"its vertices lack the properties {', '.join(missing)}; is it a file of points?")
    rest = [name for name in fields if name.startswith("f_rest_")]
    if len(rest) not in REST or any(f"f_rest_{k}" not in fields for k in range(len(rest))):
        raise ValueError(f"it must have 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ..., got {len(rest)}")
    names = (*NEEDED, *(f"f_rest_{k}" for k in range(len(rest))))
    for name in names:
        if fields[name].dtype.kind != "f":
            raise ValueError(f"the property {name} must be float or double, got {fields[name].dtype}")
    _check_finite({**{axis: x[:, k] for k, axis in enumerate("xyz")}, **{name: fields[name] for name in names}})

    def columns(chosen: tuple[str, ...]) -> Tensor:
        return torch.from_numpy(np.stack([fields[name] for name in chosen], 1)).to(dtype)

    scale, quaternion = columns(SCALE), columns(ROTATION)
    wrong = (scale < SMALLEST_LOG) | (scale > LARGEST_LOG)
    _check_rows(wrong.any(1), f"a scale, the logarithm of a deviation, outside {SMALLEST_LOG:g} to {LARGEST_LOG:g}")
    _check_rows(quaternion.norm(dim=1) < 1e-12, "a quaternion rot_0, ..., rot_3 of zeros")
    harmonics = columns(COLOR)[:, None, :]
    if rest:
        higher = columns(tuple(f"f_rest_{k}" for k in range(len(rest))))
        harmonics = torch.cat([harmonics, higher.unflatten(1, (3, -1)).mT], 1)
    start = torch.from_numpy(x).to(dtype)
    half = torch.full_like(start[:, 0], 0.5)
    made = Gaussians.from_factors(start, scale.exp(), quaternion, half, harmonics.contiguous())
    return made.replace(opacity_logit=columns(("opacity",))[:, 0])


def _check_finite(columns: dict[str, Array]) -> None:
    for name, values in columns.items():
        if not (finite := np.isfinite(values)).all():
            row = int(np.argmin(finite))
            raise ValueError(f"the property {name} must be finite, got {values[row]} in vertex {row}")


def _check_rows(bad: Tensor, problem: str) -> None:
    if bool(bad.any()):
        raise ValueError(f"vertex {int(bad.int().argmax())} has {problem}")


def write(path: str | os.PathLike[str], gaussians: Gaussians) -> int:
    """Write a binary little-endian PLY file in float32, which appears when it is complete; returns its size [bytes].

    The properties are those of `read` in the usual order, with normals of zero. The principal axes come from the
    singular values of `Gaussians.axes`, in descending order, so that the covariance of the file is that of the
    Gaussians and not, in general, the order of its axes.

    Raises:
        OSError: when it cannot be written; nothing remains of it.
        ValueError: for Gaussians that are not finite.
    """
    check_gaussians(gaussians)
    rows = rows_of(gaussians)
    return write_rows(path, copied(rows).numpy(), float(rows.sum()), gaussians.harmonics.shape[1])


def write_rows(path: str | os.PathLike[str], rows: Rows, total: float, harmonics: int) -> int:
    """Write the file of some rows [N, properties] with their sum; the rest as `write`."""
    if not math.isfinite(total):  # The sum of finite numbers may overflow too.
        finite = np.isfinite(rows).all(1)
        if not finite.all():
            number = int(np.argmin(finite))
            raise ValueError(f"the Gaussians of {os.fspath(path)} must be finite, and number {number} is not")
    header = header_of(len(rows), harmonics)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(header)
        file.write(np.ascontiguousarray(rows, "<f4").data)
    return len(header) + rows.nbytes


def names_of(harmonics: int) -> list[str]:
    """Properties of a file with a number of harmonics, in their order."""
    rest = [f"f_rest_{k}" for k in range(3 * (harmonics - 1))]
    return ["x", "y", "z", "nx", "ny", "nz", *COLOR, *rest, "opacity", *SCALE, *ROTATION]


def header_of(count: int, harmonics: int) -> bytes:
    """Header of a file."""
    return point_files.ply_header(np.dtype([(name, "<f4") for name in names_of(harmonics)]), count)


def size_of(count: int, harmonics: int) -> int:
    """Size of a file [bytes]."""
    return len(header_of(count, harmonics)) + 4 * count * len(names_of(harmonics))


@torch.no_grad()
def rows_of(gaussians: Gaussians) -> Tensor:
    """Rows of a file, float32 [N, properties], on the device of the Gaussians."""
    N, K = gaussians.harmonics.shape[:2]
    rows = gaussians.x.new_empty((N, len(names_of(K))), dtype=torch.float32)
    x, normal, color, rest, opacity, scale, rotation = rows.split([3, 3, 3, 3 * (K - 1), 1, 3, 4], 1)
    deviation, quaternion = gaussians.factors()
    x.copy_(gaussians.x)
    normal.zero_()
    color.copy_(gaussians.harmonics[:, 0])
    rest.unflatten(1, (3, K - 1)).copy_(gaussians.harmonics[:, 1:].mT)
    opacity.copy_(gaussians.opacity_logit[:, None])
    scale.copy_(deviation.log().clamp(min=SMALLEST_LOG))
    rotation.copy_(quaternion)
    return rows
