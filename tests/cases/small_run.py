"""A small run in 3-D: a spinning ball, a block of sand, a jet, and an obstacle that moves, turns and ends."""

from pathlib import Path

import torch_mpm as mpm

SCENE = """
title = "small"
duration = 0.02
fps = 100
gravity = {gravity}

[grid]
lower = [0.0, 0.0, 0.0]
upper = [1.0, 1.0, 1.0]
dx = 0.05

[material.rubber]
law = "neo_hookean"
E = 1e4
density = 1000.0

[material.sand]
law = "quartic_sand"
E = 1e5

[[body]]
shape = "sphere"
center = [0.4, 0.5, 0.4]
radius = 0.2
material = "rubber"
spin = [0.0, 2.0, 1.0]

[[body]]
shape = "box"
lower = [0.7, 0.1, 0.1]
upper = [0.9, 0.3, 0.3]
material = "sand"

[[emitter]]
center = [0.8, 0.8, 0.8]
radius = 0.06
velocity = [0.0, -2.0, 0.0]
material = "rubber"
start = 0.006

[[obstacle]]
shape = "box"
center = [0.7, 0.7, 0.3]
size = [0.1, 0.2, 0.1]
velocity = [1.0, 0.0, 2.0]
spin = [0.0, 0.0, 3.0]
rotation = [0.1, 0.2, 0.3]
end = 0.015

[[obstacle]]
shape = "plane"
center = [0.0, 0.02, 0.0]
normal = [0.0, 1.0, 0.0]
"""


def small_run(folder: Path, gravity: str = "[0.0, -9.8, 0.0]", more: str = "") -> Path:
    """A folder with the run, of three frames; `more` is a further part of the scene file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scene.toml"
    path.write_text(SCENE.format(gravity=gravity) + more)
    mpm.Scene.load(path, ['device="cpu"']).run(folder / "out")
    return folder / "out"
