"""Looking at data sets: contact sheets, videos, statistics, the viewer, and the commands for them."""

import dataclasses
import json
import urllib.request

import numpy as np
import pytest
import small_dataset as datasets

pytest.importorskip("h5py")
pytest.importorskip("matplotlib")

from torch_mpm.cli import main
from torch_mpm.data.clips import Source
from torch_mpm.data.figures import draw_statistics, summary
from torch_mpm.data.folder import DatasetError, DatasetFolder, MissingError
from torch_mpm.data.pictures import draw_scenes
from torch_mpm.render import read_png
from torch_mpm.render.viewer import Viewer, following_frame


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return datasets.make_dataset(tmp_path_factory.mktemp("data") / "set")


def test_a_sheet_shows_the_particles(path, tmp_path):
    """Each cell has as much colour as the cloud covers; particles that fly apart cover more at the end."""
    (sheet,) = draw_scenes(path, tmp_path, scenes=[9], frames=2, width=800, video=False, color_by="particle_type")
    image = read_png(sheet).astype(int)
    colored = np.ptp(image, axis=2) > 60
    first, last = (half.sum() for half in np.array_split(colored, 2, axis=1))
    assert 0 < first < last


@pytest.mark.parametrize("color_by", ["friction_angle", "velocity", "material"])
def test_scenes_are_coloured_by_any_number_of_a_particle(path, tmp_path, color_by):
    """One number per particle and frame, or per particle."""
    if color_by == "velocity":
        with pytest.raises(DatasetError, match="one number per particle"):
            draw_scenes(path, tmp_path, scenes=[0], frames=1, video=False, color_by=color_by)
        return
    assert draw_scenes(path, tmp_path, scenes=[0], frames=1, width=300, video=False, color_by=color_by)[0].exists()


def test_a_video_has_the_frames(path, tmp_path):
    iio = pytest.importorskip("imageio_ffmpeg")
    seen = []
    _, video = draw_scenes(path, tmp_path, scenes=[0], frames=1, width=400, progress=lambda k, of: seen.append((k, of)))
    reader = iio.read_frames(str(video))
    assert next(reader)["size"][0] in (398, 400)
    every = 7  # frames of 2.5 ms; at most 60 per second are shown
    assert seen == [(0, 2), (1, 2)] and len(range(0, datasets.FRAMES, every)) == len(list(reader)) == 2


def test_what_cannot_be_drawn(path, tmp_path):
    with pytest.raises(MissingError, match="no finished and valid scene 3"):
        draw_scenes(path, tmp_path, scenes=[3])
    with pytest.raises(DatasetError, match="color_by must be speed or one of friction_angle, mass"):
        draw_scenes(path, tmp_path, color_by="pressure")
    empty = datasets.make_dataset(tmp_path / "set", shards=0)
    for look in (draw_scenes, draw_statistics, Source):
        with pytest.raises(DatasetError, match="has no valid scene yet"):
            look(empty)


def test_numbers_of_a_data_set(path):
    found = summary(path)
    assert found["train"] == {"scenes": 5, "finished": 5, "failed": 1, "tried again": 1, "particles": [20, 32]}
    velocity = DatasetFolder(path).motion().velocity
    assert found["velocity"] == {"mean": velocity.mean, "std": velocity.std}


def test_statistics_are_drawn(path, tmp_path):
    image = read_png(draw_statistics(path, tmp_path / "s.png"))
    assert image.shape == (1100, 1500, 3) and image.std() > 10


# ---- the viewer


def test_clips_of_a_data_set(path):
    source = Source(path)
    assert list(source.scenes)[:2] == ["train 0", "train 1"] and len(source.scenes) == 9
    clip, given = source.clip("test 9"), datasets.arrays(9)
    np.testing.assert_array_equal(clip.position, given["position"])
    np.testing.assert_allclose(clip.values("speed", 4), np.linalg.norm(given["velocity"][4], axis=1), rtol=1e-6)
    np.testing.assert_array_equal(clip.values("mass", 4), given["mass"])


def test_clips_of_a_run(tmp_path):
    pytest.importorskip("pydantic")
    from helpers import disc

    import torch_mpm as mpm

    mpm.Scene(**disc(duration=0.06)).run(tmp_path / "run")
    source = Source(tmp_path / "run")
    clip = source.clip("run")
    with mpm.Trajectory(tmp_path / "run") as read:
        np.testing.assert_array_equal(clip.position, read["position"])
    assert clip.interval == pytest.approx(0.02) and "material" in clip.fields


def test_the_viewer_serves_a_page_and_shows_frames(path):
    pytest.importorskip("viser")
    viewer = Viewer(path, port=18_080)
    try:
        page = urllib.request.urlopen(viewer.url, timeout=10).read().decode()
        assert "<html" in page
        given = datasets.arrays(0)["position"]
        viewer._frame.value = 5
        viewer.show()
        np.testing.assert_allclose(viewer._cloud.points[:, :2], given[5], atol=1e-3)
        viewer._scene.value = "test 9"
        viewer._choose()
        np.testing.assert_allclose(viewer._cloud.points[:, :2], datasets.arrays(9)["position"][0], atol=1e-3)
        assert "47 particles" in viewer._legend.content
        for name in viewer.clip.fields:
            viewer._color.value = name
            viewer.show()
            assert len(viewer._cloud.colors) == 47
        viewer.source.clip = lambda name, clip=viewer.clip: dataclasses.replace(
            clip, fields={"speed": clip.fields["speed"]}
        )
        viewer._choose()  # a scene without the colour that was chosen
        assert viewer._color.value == "speed" and len(viewer._cloud.colors) == 47
    finally:
        viewer.close()


def test_playing_is_in_real_time_and_begins_anew():
    assert following_frame(3.0, seconds=0.5, speed=1.0, interval=0.1, frames=20) == pytest.approx(8.0)
    assert following_frame(18.0, seconds=0.5, speed=2.0, interval=0.1, frames=20) == pytest.approx(8.0)
    assert following_frame(0.0, seconds=0.5, speed=1.0, interval=0.1, frames=1) == 0.0


# ---- commands


def test_export_command(path, tmp_path, capsys):
    assert main(["export", str(path), "--format", "gns", "-o", str(tmp_path / "gns"), "--material", "mass"]) == 0
    assert json.loads((tmp_path / "gns" / "metadata.json").read_text())["train"]["nnode_in"] == 31
    assert main(["export", str(path), "--format", "gns", "-o", str(tmp_path / "gns")]) == 1
    assert main(["export", str(path)]) == 1
    assert main(["export", str(path), "--vtk", "--scenes", "3", "-o", str(tmp_path / "vtk")]) == 1
    errors = capsys.readouterr().err.splitlines()
    assert "exists already" in errors[0] and "--format" in errors[1]
    assert errors[2] == f"torch-mpm: {path} has no finished and valid scene 3"


def test_looking_commands(path, tmp_path, capsys):
    assert main(["stats", str(path), "-o", str(tmp_path / "s.png")]) == 0
    assert main(["render", str(path), "-o", str(tmp_path / "p"), "--scenes", "1", "--no-video"]) == 0
    out = capsys.readouterr().out
    assert '"failed": 1' in out and str(tmp_path / "p" / "sheet.png") in out
    assert main(["view", str(tmp_path / "nothing")]) == 1
    assert main(["render", str(path), "--set", "render.fps=3"]) == 1
