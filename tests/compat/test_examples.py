"""Scripts in the published style run with only their imports changed: the examples and those of the documentation."""

import re
from pathlib import Path

import pytest
import torch
from helpers import example

ROOT = Path(__file__).parents[2]


def test_gaussians():
    module = example("compat/gaussians")
    x = module.main(ROOT / "examples" / "compat" / "gaussians.json", frames=1)
    assert x.shape == (4608, 3) and 1.0 < float(x[x[:, 2] > 1.3, 0].mean()) < 1.02


@pytest.mark.parametrize("name", ["jelly", "sand"])
def test_cube(name):
    x = example("compat/cube").main(name, frames=1, steps_per_frame=20)
    fallen = 0.4 - float(x[:, 2].mean())
    time = 20 * 3e-4
    assert fallen == pytest.approx(0.5 * time + 9.8 * time**2 / 2, rel=0.05)


def test_learned_law():
    first, last = example("compat/learned_law").main(epochs=2, steps=15)
    assert last < 0.9 * first


PAGES = ["physgaussian", "descendants", "warp_mpm", "taichi_elements", "nclaw", "mpm_pytorch"]


@pytest.mark.parametrize("page", PAGES)
def test_programs_of_the_migration_pages(page):
    """The programs of a page, one after another."""
    text = (ROOT / "docs" / "migrating" / f"{page}.md").read_text()
    names: dict = {"__name__": "__main__"}
    for program in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(program, page, "exec"), names)
    position = torch.as_tensor(names["position"] if "position" in names else names["x"])
    assert bool(position.isfinite().all()) and float(position.detach().mean()) != 0.5
