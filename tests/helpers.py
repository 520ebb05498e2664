"""Helpers of several tests: errors and tolerances, random particles and nodes, small scenes, programs."""

import copy
import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import torch_mpm as mpm
from benchmarks import common

# ---- errors

TOLERANCE = {
    "transfer": {torch.float32: 1e-6, torch.float64: 1e-14},
    "transfer on CUDA": {torch.float32: 5e-5, torch.float64: 1e-12},  # gradients through three transfers
    "law": {torch.float32: 2e-5, torch.float64: 1e-11},  # strains of moderate condition
    "conservation": {torch.float32: 1e-6, torch.float64: 1e-12},
    "rollout": {torch.float32: 1e-4, torch.float64: 1e-11},  # where the order of sums differs
    "rollout with FLIP": {torch.float32: 1e-4, torch.float64: 1e-10},  # differences of two transfers
    "rollout gradient": {torch.float32: 1e-5, torch.float64: 1e-11},
    # Relative changes of positions change gradients by parameters of laws up to 500 times as much (Cam-Clay).
    "rollout gradient on CUDA": {torch.float32: 1e-4, torch.float64: 1e-10},
    # Changes of positions by one rounding change gradients by parameters of seven laws by up to 1e-10, and sums of
    # nodes in another order are several such changes.
    "mixture on CUDA": {torch.float32: 1e-4, torch.float64: 1e-9},
}
"""Relative errors of results that only rounding changes."""


def relative_error(value: Tensor, reference: Tensor) -> float:
    value, reference = value.detach().cpu().double(), reference.detach().cpu().double()
    return float((value - reference).norm() / reference.norm().clamp_min(1e-300))


# ---- steps


class SingleSteps(mpm.Step):
    """A `Step` whose rollouts are composed of single steps: the op of many steps computes no subclass."""


# ---- particles and nodes


@dataclasses.dataclass
class Particles:
    grid: mpm.Grid
    x: Tensor
    mass: Tensor
    v: Tensor
    C: Tensor
    stress: Tensor
    volume: Tensor
    scene: Tensor | None

    def blocks(self) -> mpm.Blocks:
        return self.grid.activate(self.x, self.scene)

    def to(self, device: str, dtype: torch.dtype) -> "Particles":
        def move(t: Tensor | None) -> Tensor | None:
            return None if t is None else t.to(device=device, dtype=dtype if t.is_floating_point() else None)

        tensors = {f.name: move(getattr(self, f.name)) for f in dataclasses.fields(self) if f.name != "grid"}
        return Particles(grid=self.grid, **tensors)


def random_particles(
    dim: int,
    kernel: str = "quadratic",
    sizes: tuple[int, ...] = (11, 0, 6),
    device: str = "cpu",
    dtype: torch.dtype = torch.float64,
    dx: float = 0.1,
    extent: float = 1.0,
    shuffled: bool = True,
    **grid_options: object,
) -> Particles:
    """Ragged scenes (one may be empty) with values of order one, positions anywhere inside the domain."""
    generator = torch.Generator().manual_seed(7)
    lower, upper = (-0.2,) * dim, (-0.2 + extent,) * dim
    grid = mpm.Grid(dx=dx, lower=lower, upper=upper, scenes=len(sizes), kernel=kernel, **grid_options)
    P = sum(sizes)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    x = torch.tensor(lower) + extent * torch.rand(P, dim, generator=generator, dtype=torch.float64)
    scene = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes)).int()
    if shuffled:
        scene = scene[torch.randperm(P, generator=generator)]
    particles = Particles(
        grid=grid,
        x=x,
        mass=0.5 + torch.rand(P, generator=generator, dtype=torch.float64),
        v=normal(P, dim),
        C=normal(P, dim, dim),
        stress=normal(P, dim, dim),
        volume=0.5 + torch.rand(P, generator=generator, dtype=torch.float64),
        scene=None if len(sizes) == 1 else scene,
    )
    return particles.to(device, dtype)


def random_blocks(grid: mpm.Grid, device: str = "cpu", share: float = 0.7, unused: int = 3) -> mpm.Blocks:
    """A share of the grid's blocks in slots of random order, with unused slots between them."""
    generator = torch.Generator().manual_seed(3)
    total = grid.block_count if grid.scenes else 0
    active = torch.randperm(total, generator=generator)[: round(share * total)].int()
    block = torch.full((len(active) + unused,), -1, dtype=torch.int32)
    slots = torch.randperm(len(block), generator=generator)[: len(active)]
    block[slots] = active
    table = torch.full((total,), -1, dtype=torch.int32)
    table[active.long()] = slots.int()
    nothing = torch.empty(0, dtype=torch.int32, device=device)
    return mpm.Blocks(grid, table.to(device), block.to(device), nothing, nothing, nothing, None, nothing)


def random_nodes(blocks: mpm.Blocks) -> Tensor:
    """Mass and momentum [N, 1 + D] in float64; every fifth row and those of unused blocks are zero."""
    generator = torch.Generator().manual_seed(5)
    nodes = torch.randn(blocks.node_count, 1 + blocks.grid.dim, generator=generator, dtype=torch.float64)
    nodes[:, 0] = 0.5 + nodes[:, 0].abs()
    nodes[::5] = 0
    return torch.where(blocks.active_nodes()[:, None], nodes.to(blocks.block.device), 0)


# ---- scenes and the command line

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


def scene_command(folder: Path, name: str, override: str) -> list[str]:
    """Arguments of `check` or `run` with a small scene file in a folder and one overridden key."""
    scene = folder / "scene.toml"
    scene.write_text(FILE.format(duration=0.04))
    where = ["-o", str(folder / "out"), "--quiet"] if name == "run" else []
    return [name, str(scene), *where, "--set", override]


# ---- examples and benchmark programs


def example(name: str) -> ModuleType:
    """A script of examples/ as a module of its own, whose constants a test may change."""
    spec = importlib.util.spec_from_file_location(Path(name).name, common.ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for their annotations
    spec.loader.exec_module(module)
    return module


# Threads that wait without spinning: tests share their machine.
PASSIVE = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}


def run_quick(program: str, out: Path, *options: str) -> str:
    command = [sys.executable, "-m", program, "--quick", "--out", str(out), *options]
    done = subprocess.run(command, cwd=common.ROOT, env=PASSIVE, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def run_quick_here(program: str, out: Path, *options: str) -> None:
    """`run_quick` in this process and with its threads, without the imports of a new one."""
    arguments = [program, "--quick", "--out", str(out), *options]
    threads = mock.patch.object(common, "use_all_cores", torch.get_num_threads)
    with mock.patch.object(sys, "argv", arguments), threads:
        try:
            status = importlib.import_module(program).main()
        except SystemExit as end:
            status = end.code
    assert not status, status


def result(out: Path, pattern: str) -> dict:
    (file,) = out.glob(pattern)
    assert file.with_suffix(".md").read_text().startswith("# ")
    found = json.loads(file.read_text())
    assert {"device", "torch_mpm", "torch", "commit", "date"} <= found["environment"].keys()
    return found


# ---- ops


class OpNames(TorchDispatchMode):
    """The names of the ops that are called, in their order, as "aten.add.Tensor"."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.seen.append(str(function))
        return function(*args, **(kwargs or {}))
