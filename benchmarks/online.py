"""Training of examples/learn_simulator.py from a data set on disk and from scenes that are simulated during training.

    python -m benchmarks.online --device cuda

Both train the same network for the same number of steps, with the same held-out windows for tests. Simulation is the
time in which scenes were simulated online, concurrently with the training; its share refers to the whole time of
training online.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from torch_mpm.data import DatasetFolder, OnlineStream, WindowDataset, WindowStream, simulator
from torch_mpm.data.generate import generate

from . import common

BATCH, ROUND, TRAINING_SCENES = 4, 20, 120
COLUMNS = ("from", "steps", "training [s]", "ms a step", "simulation [s]", "share", "held-out loss")


def example() -> Any:
    """The example as a module."""
    path = common.ROOT / "examples" / "learn_simulator.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


class Timed:
    """A function of scenes that accumulates its time."""

    def __init__(self, simulate: Any) -> None:
        self.simulate, self.seconds = simulate, 0.0

    def __call__(self, ids: Sequence[int]) -> Any:
        begin = time.perf_counter()
        result = self.simulate(ids)
        self.seconds += time.perf_counter() - begin
        return result


def measure(device: str, steps: int, folder: Path) -> list[dict[str, Any]]:
    """Both ways, after some warm-up steps."""
    learn = example()
    config = learn.configuration(TRAINING_SCENES)
    generate(config, folder, device=device)
    data = DatasetFolder(folder)
    domain = learn.Domain.of(data, data.motion("train"), torch.device(device))
    windows, held_out = (WindowDataset(data, split, learn.HISTORY + 1) for split in ("train", "valid"))

    def trained(origin: str, count: int) -> dict[str, Any]:
        made = Timed(simulator(config, device))
        if origin == "disk":
            batches = iter(WindowStream(windows, BATCH).loader())
        else:
            batches = iter(OnlineStream(made, BATCH, scenes=ROUND, first=config.scenes, device=device))
        torch.manual_seed(0)
        model = learn.Simulator(domain).to(device)
        begin = time.perf_counter()
        learn.train(model, batches, count, lambda _: None)  # It waits for the device at its end.
        seconds = time.perf_counter() - begin
        loss = learn.mean_loss(model, held_out)
        share = made.seconds / seconds
        return dict(
            zip(COLUMNS, (origin, count, seconds, 1e3 * seconds / count, made.seconds, share, loss), strict=True)
        )

    rows = []
    for origin in ("disk", "online"):
        trained(origin, 20)
        rows.append(trained(origin, steps))
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(arguments.device, arguments.steps, Path(folder) / "data")
    environment = common.environment(arguments.device)
    table = common.table(COLUMNS, [list(row.values()) for row in rows])
    text = f"# Training from disk and online\n\n{common.describe(environment)}\n\n{table}"
    name = f"online_{common.slug(common.device_name(arguments.device))}"
    common.write(arguments.out, name, {"environment": environment, "rows": rows}, text)


if __name__ == "__main__":
    main()
