"""The scene of an object of Gaussian splats: from a scene file with a place for it, or the default one."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

from .. import optional
from ..files import check_file
from ..render.requires import require
from .explain import SceneError
from .scene import Scene, parsed
from .splat_frames import check_scene

DEFAULT: dict[str, Any] = {
    "gravity": [0.0, -9.8, 0.0],
    "duration": 1.5,
    "fps": 30.0,
    "grid": {"lower": [0.0, 0.0, 0.0], "upper": [1.0, 1.0, 1.0], "dx": 0.025, "walls": "separate", "friction": 0.3},
    "material": {"jelly": {"law": "neo_hookean", "density": 1000.0, "E": 3e4, "nu": 0.4}},
    "body": [{"shape": "splats", "file": "", "extent": 0.5, "center": [0.5, 0.45, 0.5], "material": "jelly"}],
    "render": {"resolution": [960, 540]},
}
"""Scene of an object that drops on the floor as jelly."""


def splat_scene(file: Path, scene: Path | None = None, overrides: list[str] | None = None) -> tuple[Scene, str]:
    """Scene of the object in a file, and the text of its scene file.

    Args:
        file: .ply file of Gaussian splats.
        scene: scene file (TOML) with one body of the shape "splats", whose `file` is replaced; None for `DEFAULT`.
        overrides: ``key=value`` as for `Scene.load`.

    Raises:
        SceneError: for problems in the scene file, another number of such bodies, or a batch of scenes.
        OSError: for a file that cannot be read.
    """
    check_file(file, "splats")
    text, words = ("", copy.deepcopy(DEFAULT)) if scene is None else parsed(scene)
    folder, source = (Path(), "") if scene is None else (scene.parent, str(scene))
    bodies = words.get("body")
    found = [
        body
        for body in (bodies if isinstance(bodies, list) else [])
        if isinstance(body, dict) and body.get("shape") == "splats"
    ]
    if len(found) != 1:
        raise SceneError([f'body: must have one body with shape = "splats" for {file}, got {len(found)}'], source)
    found[0]["file"] = str(file.resolve())
    made = Scene.from_words(words, overrides, folder, source)
    check_scene(made)
    return made, text


def require_renderer(backend: str) -> None:
    """Raise ImportError for a missing package of the pictures before the simulation instead of after it."""
    for module in ("matplotlib", "PIL", "imageio_ffmpeg"):
        require(module)
    if backend == "gsplat":
        optional.load("gsplat", "the renderer gsplat", "splats")
