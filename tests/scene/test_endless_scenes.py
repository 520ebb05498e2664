"""Scenes that would never end are refused before the first substep, by the key that makes them so."""

import re

import pytest
from helpers import FILE, scene_command

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

from torch_mpm.cli import main
from torch_mpm.scene import Scene, SceneError
from torch_mpm.scene import run as module

EMITTER = "emitter=[{material='jelly', center=[0.5, 0.8], radius=0.05, "


@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("dt=1e-12", "dt"),
        ("dt=1e-300", "dt"),
        ("cfl=1e-9", "cfl"),
        ("material.jelly.E=1e30", "cfl"),
        ("grid.dx=1e-9", ""),
        ("fps=1e300", "duration"),
        (f"{EMITTER}velocity=[0.0, -1e9], rate=1e-3}}]", "cfl"),
        (f"{EMITTER}velocity=[0.0, -1e30], rate=1e-3}}]", "cfl"),
        ("dt=10.0", "dt"),
    ],
)
def test_scenes_that_would_never_end(tmp_path, capsys, command, override, key):
    assert main(scene_command(tmp_path, command, override)) == 1
    message = capsys.readouterr().err
    assert f"{key}:" in message and not (tmp_path / "out").exists(), message


def test_the_number_of_substeps_is_reported(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    scene.write_text(FILE.format(duration=0.04))
    assert main(["check", str(scene), "--set", "dt=1e-5"]) == 0
    assert "about 4000 substeps" in capsys.readouterr().out


@pytest.mark.parametrize(("start", "share"), [(0.0, 1.0), (0.02, 0.5)])
def test_the_speed_of_emitters_counts(start, share, tmp_path, capsys):
    """The estimate is compared with the substeps of a run. Without the emitter there are few."""
    scene = tmp_path / "scene.toml"
    scene.write_text(FILE.format(duration=0.04))
    emitter = f"{EMITTER}velocity=[0.0, -200.0], start={start}}}]"
    assert main(["check", str(scene), "--set", emitter]) == 0
    estimated = int(re.search(r"about (\d+) substeps", capsys.readouterr().out)[1])
    assert main(["run", str(scene), "--set", emitter, "-o", str(tmp_path / "out"), "--quiet"]) == 0
    taken = int(re.search(r"(\d+) substeps", capsys.readouterr().out)[1])
    assert estimated <= taken <= 2 * estimated and estimated > 400 * share


@pytest.mark.parametrize("quiet", [False, True])
@pytest.mark.parametrize("runs", ["long", "short"])
def test_a_long_run_gives_notice_of_the_substeps_left(runs, quiet, tmp_path, capsys, monkeypatch):
    """At the start, and again while no frame is complete; the numbers are those of the run."""
    if runs == "long":
        monkeypatch.setattr(module, "LONG_RUN", 200)
        monkeypatch.setattr(module, "BETWEEN_NOTICES", 0.0)
    words = scene_command(tmp_path, "run", "dt=1e-4")
    assert main(words if quiet else [word for word in words if word != "--quiet"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "substeps of" in line]
    if quiet or runs == "short":
        assert not lines
        return
    found = [re.search(r"frame 0 of 2, t = (.*) s: about (.*) substeps of 0.0001 s are left", line) for line in lines]
    left = [(float(a[1]), float(a[2])) for a in found if a is not None]
    assert (
        len(left) >= 2 and left[0][0] == pytest.approx(32e-4, rel=0.02) and "until 0.04 s, which take some" in lines[0]
    )
    for time, substeps in left:
        assert substeps == pytest.approx((0.04 - time) / 1e-4, rel=0.05) and substeps >= 200


@pytest.mark.parametrize("together", [False, True])
def test_many_bodies(together):
    """A thousand bodies, apart or all in one place: each is compared with its neighbours only, and reported once."""
    n, side = 1000, 32
    bodies = [
        {
            "shape": "sphere",
            "center": [0.5, 0.5] if together else [(k % side + 0.5) / side, (k // side + 0.5) / side],
            "radius": 0.3 / side,
            "material": "jelly",
        }
        for k in range(n)
    ]
    scene = Scene.from_words(
        {
            "duration": 0.01,
            "fps": 100,
            "grid": {"lower": [0.0, 0.0], "upper": [1.0, 1.0], "dx": 1 / (2 * side)},
            "material": {"jelly": {"law": "neo_hookean", "E": 1e4, "nu": 0.3}},
            "body": bodies,
        }
    )
    if not together:
        assert scene.build("cpu").particles >= n
        return
    with pytest.raises(SceneError) as error:
        scene.build("cpu")
    assert n / 2 - 1 <= len(error.value.problems) <= n
    lines = str(error.value).splitlines()
    assert len(lines) == 21 and lines[-1].endswith("more problems") and "overlaps body[" in lines[0]


def test_long_values_are_shortened():
    error = SceneError(["title: " + 10_000 * "x"], "a.toml")
    assert str(error).startswith("a.toml: title: xxx") and len(str(error)) < 1100
