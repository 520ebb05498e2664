"""Time of the simulation of the example scenes, without pictures: `python -m benchmarks.examples [SCENES]`."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import torch

import torch_mpm as mpm

from . import common

EXAMPLES = common.ROOT / "examples"


def measure(path: Path, device: str) -> dict[str, Any]:
    """Simulate a scene and return its summary."""
    scene = mpm.Scene.load(path, [f'device="{device}"']).model_copy(update={"render": None})
    with tempfile.TemporaryDirectory() as folder:
        return {"name": path.stem, **scene.run(Path(folder) / path.stem)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("scenes", nargs="*", type=Path, help="scene files; by default all examples")
    arguments = parser.parse_args()
    results = []
    for path in arguments.scenes or sorted(EXAMPLES.glob("*.toml")):
        results.append(measure(path, arguments.device))
        print(results[-1], flush=True)
    environment = common.environment(arguments.device)
    columns = ("name", "particles", "substeps", "frames", "particles_lost")
    parts = list(results[0]["seconds"])
    rows = [[*(r[c] for c in columns), *(r["seconds"].get(part) for part in parts)] for r in results]
    columns += tuple(f"{part} [s]" for part in parts)
    text = f"# Example scenes\n\n{common.describe(environment)}\n\n{common.table(columns, rows)}"
    name = f"examples_{common.slug(common.device_name(arguments.device))}"
    common.write(arguments.out, name, {"environment": environment, "scenes": results}, text)


if __name__ == "__main__":
    main()
