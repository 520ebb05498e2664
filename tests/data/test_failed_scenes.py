"""Scenes that fail are counted with their reasons and fail the commands. Choices are checked beforehand."""

import pytest

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

from generated import configuration

from torch_mpm.cli import main
from torch_mpm.data import batch
from torch_mpm.data.configuration import Configuration, presets
from torch_mpm.data.failures import FailedScenesError, check_failures, reasons
from torch_mpm.data.folder import DatasetFolder
from torch_mpm.data.generate import check_samples
from torch_mpm.data.shard import SceneRecord
from torch_mpm.scene import SceneError

BALL = {"shape": "sphere", "center": [0.5, 0.0], "radius": 0.05}
JELLY, BODY = {"law": "neo_hookean", "E": 1e4}, "body__0__"


def record(number: int, failure: str) -> SceneRecord:
    return SceneRecord(number, not failure, 10, "", 1, failure, None)


def test_reasons_are_counted():
    failures = [
        "a particle left at step 3",
        "",
        "a particle left at step 17",
        "no room",
        "",
        "a particle left at 1e-3 s",
    ]
    scenes = [record(k, failure) for k, failure in enumerate(failures)]
    assert reasons(scenes) == [
        "2 failed: a particle left at step 3", "1 failed: no room", "1 failed: a particle left at 1e-3 s"
    ]  # fmt: skip
    many = [record(k, "abcdefgh"[k]) for k in range(8)]
    assert reasons(many)[-1] == "3 failed for other reasons" and len(reasons(many)) == 6


@pytest.mark.parametrize(("failed", "most", "fails"), [(0, 0.0, False), (1, 0.0, True), (5, 0.5, False), (6, 0.5, True),
                                                       (10, 1.0, True), (9, 1.0, False)])  # fmt: skip
def test_too_many_failures(failed, most, fails):
    scenes = [record(k, "why" if k < failed else "") for k in range(10)]
    if not fails:
        return check_failures(scenes, most)
    with pytest.raises(FailedScenesError, match=f"^{failed} of 10 scenes failed(.|\\n)*{failed} failed: why"):
        check_failures(scenes, most)


@pytest.mark.parametrize("failed", [3, 1])
def test_commands_fail_with_the_reasons(tmp_path, capsys, monkeypatch, failed):
    """`generate` of scenes that are there already, and `verify`."""
    made = configuration(
        dataset__splits={"train": 3}, dataset__frames=2, dataset__scenes_per_shard=3, dataset__attempts=1
    )
    monkeypatch.setattr(Configuration, "load", lambda path, overrides: made)
    simulated = batch.simulate

    def broken(*arguments, **options):
        found = simulated(*arguments, **options)
        failures = [f"particle {k} is not finite" if k < failed else "" for k, _ in enumerate(found.failures)]
        return found._replace(failures=failures)

    monkeypatch.setattr(batch, "simulate", broken)
    arguments = ["generate", "set.toml", "-o", str(tmp_path / "set"), "--device", "cpu", "--quiet"]
    for command in (arguments, arguments, ["verify", str(tmp_path / "set")]):
        assert main(command) == 1
        message = capsys.readouterr().err
        limit = "no scene is valid" if failed == 3 else "more than 25% of the scenes failed"
        assert f"{failed} of 3 scenes failed: {limit}" in message
        assert f"{failed} failed: particle 0 is not finite" in message
        assert main([*command, "--most-failed", "0.5"]) == (1 if failed == 3 else 0)
        capsys.readouterr()
    assert len(DatasetFolder(tmp_path / "set").scenes()) == 3 - failed


@pytest.mark.parametrize("share", ["-0.1", "1.5", "nan", "half"])
def test_a_share_that_is_none(share, capsys):
    with pytest.raises(SystemExit):
        main(["verify", "set", "--most-failed", share])
    assert "--most-failed" in capsys.readouterr().err


WRONG = {
    "a name of a material": ({BODY + "material": {"choice": ["jelly", "jely"]}}, "body[0].material.choice[1]: "),
    "that is never drawn": (
        {BODY + "material": {"choice": ["jelly", "x"], "weights": [1, 1e-12]}}, "body[0].material.choice[1]: "
    ),
    "of bodies that are rare": (
        {BODY + "material": {"choice": ["jelly", "x"]}, BODY + "count": {"choice": [0, 1], "weights": [1, 1e-12]}},
        "body[0].material.choice[1]: ",
    ),
    "a law": ({"material__jelly": {"choice": [JELLY, {"law": "neo_hooken"}]}}, "material.jelly.choice[1]: "),
    "a key": ({"material__jelly": {"choice": [JELLY, {**JELLY, "yield": 3}]}}, "material.jelly.choice[1]: "),
    "a choice in a choice": (
        {"material__jelly": {"choice": [JELLY, {**JELLY, "E": {"choice": [1e4, "soft"]}}]}},
        "material.jelly.choice[1].E.choice[1]: ",
    ),
    "a shape": ({BODY + "choice": [{"shape": "sphere", "radius": 0.1}, {"shape": "ball"}]}, "body[0].choice[1]: "),
    "a kind of contact": (
        {"obstacle": [{**BALL, "contact": {"choice": ["slip", "slp"]}}]},
        "obstacle[0].contact.choice[1]: ",
    ),
    "gravity": ({"gravity": {"choice": [[0.0, -9.8], [0.0]]}}, "gravity.choice[1]: "),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_choices_are_checked_before_the_first_scene(name):
    changes, key = WRONG[name]
    with pytest.raises(SceneError) as found:
        check_samples(configuration(**changes))
    assert any(problem.startswith(key) for problem in found.value.problems), found.value.problems


def test_particle_types_are_those_of_materials():
    with pytest.raises(SceneError, match=r"dataset\.particle_type\.jely: takes names of materials, jelly"):
        configuration(dataset__particle_type={"jely": 1})
    with pytest.raises(SceneError, match=r"dataset\.particle_type\.jelly: takes 0 to 8 but for 3, the type of obst"):
        configuration(dataset__particle_type={"jelly": 3})
    assert configuration(dataset__particle_type={"jelly": 4}).dataset.particle_type == {"jelly": 4}


def test_splits_have_files_of_their_own():
    """Also on file systems that ignore the case of letters."""
    with pytest.raises(SceneError, match=r"dataset\.splits: train and Train differ in upper case alone"):
        configuration(dataset__splits={"train": 1, "Train": 1})


def test_good_choices_pass():
    for name in presets():
        check_samples(Configuration.preset(name), 1)
