"""The script with the mug of splats, in short."""

import pytest
import torch
from helpers import example

from torch_mpm import splats

for package in ("pydantic", "h5py", "matplotlib", "PIL", "imageio_ffmpeg"):
    pytest.importorskip(package)


@pytest.mark.thorough
def test_the_mug_moves_in_all_scenes(device, tmp_path, capsys):
    pictures = example("splat_mug").main(tmp_path, device, count=400, frames=1, resolution=(48, 36))
    assert pictures.keys() == {"wobble", "melt", "pour"} and all(len(paths) == 2 for paths in pictures.values())
    for name in pictures:
        first, last = (splats.read(tmp_path / name / "splats" / f"0000{k}.ply") for k in (0, 1))
        assert float((last.x - first.x).norm(dim=1).mean()) > 1e-5, name
    assert (tmp_path / "splat_mug.png").stat().st_size > 5000


def test_surfaces_have_outward_normals_and_colours_face_the_viewer():
    script = example("splat_mug")
    x, normal = script.revolved((1.0, 0.0), (1.0, 2.0), 200.0)
    torch.testing.assert_close(normal[:, [0, 2]], x[:, [0, 2]])
    x, normal = script.revolved((0.5, 1.0), (0.0, 1.0), 200.0)
    assert bool((normal[:, 1] > 0.99).all()) and float(x[:, [0, 2]].norm(dim=1).max()) < 0.5
    color = torch.full((1, 3), 0.5, dtype=torch.float64)
    side = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    harmonics = script.shaded(color, side)
    towards, away = (splats.colors(harmonics, sign * side) for sign in (-1, 1))
    torch.testing.assert_close(towards - away, torch.full((1, 3), 0.25, dtype=torch.float64))
