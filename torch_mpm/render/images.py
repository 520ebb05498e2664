"""PNG files that are complete or absent, and contact sheets."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import numpy as np

from ..data.whole_files import replacing
from ..files import check_file
from .requires import require
from .shapes import Array

NOTE = "torch_mpm"
"""Key of the note in a PNG file."""


def check_image(name: str, image: Array) -> Array:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"{name} must be uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
    return image


def write_png(path: str | os.PathLike[str], image: Array, width: int | None = None, note: str = "") -> None:
    """Write `image` uint8 [H, W, 3] to `path`, atomically.

    `width` scales the picture to that many pixels and compresses harder: for a README, where size matters. `note` is
    stored in the file, for `note_of`.
    """
    pil = require("PIL.Image")
    picture = pil.fromarray(check_image("image", image))
    if width is not None:
        picture = picture.resize((width, round(picture.height * width / picture.width)), pil.Resampling.LANCZOS)
    with replacing(path) as temporary:
        notes = require("PIL.PngImagePlugin").PngInfo()
        if note:
            notes.add_text(NOTE, note)
        picture.save(temporary, compress_level=4 if width is None else 9, pnginfo=notes)


def note_of(path: str | os.PathLike[str]) -> str:
    """Return the note that `write_png` stored in a file; "" for a file without one or without a picture."""
    try:
        check_file(os.fspath(path), "picture")
        with require("PIL.Image").open(path) as picture:
            return str(picture.info.get(NOTE, ""))
    except Exception:  # For any defect of the file.
        return ""


def read_png(path: str | os.PathLike[str]) -> Array:
    """The picture in `path` as uint8 [H, W, 3]."""
    with require("PIL.Image").open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def contact_sheet(frames: Sequence[Array], columns: int, width: int = 1280, gap: int = 4) -> Array:
    """Frames (uint8 [H, W, 3], one size) scaled into a table of `columns` columns, `width` pixels wide."""
    if not frames:
        raise ValueError("frames must hold at least one picture, got none")
    if columns < 1:
        raise ValueError(f"columns must be at least 1, got {columns}")
    image = require("PIL.Image")
    shape = check_image("frames[0]", frames[0]).shape
    cell_width = (width - gap * (columns - 1)) // columns
    cell_height = round(cell_width * shape[0] / shape[1])
    rows = math.ceil(len(frames) / columns)
    height = rows * cell_height + gap * (rows - 1)
    sheet = np.full((height, columns * cell_width + gap * (columns - 1), 3), 255, dtype=np.uint8)
    for i, frame in enumerate(frames):
        if frame.shape != shape:
            raise ValueError(f"frames[{i}] must have shape {list(shape)} like the first, got {list(frame.shape)}")
        small = image.fromarray(frame).resize((cell_width, cell_height), image.Resampling.LANCZOS)
        top, left = i // columns * (cell_height + gap), i % columns * (cell_width + gap)
        sheet[top : top + cell_height, left : left + cell_width] = np.asarray(small)
    return sheet
