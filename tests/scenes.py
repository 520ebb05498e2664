"""Small scenes for tests: a jelly disc that falls, and the command line as a process."""

import copy
import os
import subprocess
import sys

DISC = {
    "grid": {"lower": (0, 0), "upper": (1, 1), "dx": 0.05},
    "gravity": (0, -10),
    "duration": 0.1,
    "fps": 50,
    "material": {"jelly": {"law": "neo_hookean", "E": 1e4, "nu": 0.3}},
    "body": [{"shape": "sphere", "center": (0.5, 0.5), "radius": 0.2, "material": "jelly"}],
}

FILE = """
device = "cpu"
gravity = [0.0, -10.0]
duration = {duration}
fps = 50
[grid]
lower = [0.0, 0.0]
upper = [1.0, 1.0]
dx = 0.05
[material.jelly]
law = "neo_hookean"
E = 1e4
[[body]]
shape = "sphere"
center = [0.4, 0.3]
radius = 0.2
spin = 3.0
material = "jelly"
[[emitter]]
center = [0.8, 0.7]
radius = 0.1
velocity = [-1.0, 0.5]
material = "jelly"
end = 0.2
"""


def disc(**changes):
    """The words of the disc with some changed; a nested key as ``grid__dx``."""
    words = copy.deepcopy(DISC)
    for key, value in changes.items():
        *path, last = key.split("__")
        target = words
        for step in path:
            target = target[int(step)] if isinstance(target, list) else target.setdefault(step, {})
        target[int(last) if isinstance(target, list) else last] = value
    return words


def command(*arguments, **options):
    """``torch-mpm ...`` as a process."""
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    line = [sys.executable, "-m", "torch_mpm", *map(str, arguments)]
    return subprocess.Popen(line, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)
