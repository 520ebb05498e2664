"""Generation: the same content from any number of processes and after any kill; what can go wrong on the way."""

import json
import math
import os
import random
import resource
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

import small_dataset as datasets
from generated import assert_same, configuration, decoded, start
from helpers import command

from torch_mpm.data import batch
from torch_mpm.data.finish import IncompleteError, finalize, verify
from torch_mpm.data.folder import DatasetError, DatasetFolder, MissingError
from torch_mpm.data.generate import check_samples, generate
from torch_mpm.data.packing import prepare_scene
from torch_mpm.data.sampling import content
from torch_mpm.data.shard import record_path, shard_path
from torch_mpm.data.shard_simulation import _of_next, draw, simulate
from torch_mpm.data.workers import Worker, WorkerError, take_device, worker
from torch_mpm.errors import DamagedFileError
from torch_mpm.scene import SceneError
from torch_mpm.scene.folder import OutputError

FILES = ("shard_00000.h5", "shard_00000.json")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The small data set, made by this process."""
    folder = tmp_path_factory.mktemp("whole") / "set"
    summary = generate(configuration(), folder, device="cpu")
    assert summary["complete"] and summary["scenes"] == 7 and summary["failed"] == 0
    return folder


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def test_what_is_in_a_data_set(whole):
    made = configuration()
    assert list(verify(whole)) == []
    dataset = DatasetFolder(whole)
    assert [s.id for s in dataset.scenes("train")] == [0, 1, 2, 3, 4] and len(dataset.scenes("test")) == 2
    for name, (arrays, attributes) in decoded(whole).items():
        built = made.scene(content(made, int(attributes["id"]))).build("cpu")
        # the first frame is the sampled scene, built anew, and later ones fall: x = x0 + v t + g t^2 / 2 in free flight
        np.testing.assert_array_equal(arrays["position"][0], built.state.x.numpy(), err_msg=name)
        x = arrays["position"].astype(np.float64)
        free = x[:, :, 1].min() > 0.3
        if free:
            centre = x.mean(1)
            t = 0.005 * np.arange(12)[:, None]
            v = built.state.v.double().numpy().mean(0)
            expected = centre[0] + v * t + 0.5 * np.array([0.0, -9.8]) * t**2
            assert np.abs(centre - expected).max() < 0.03 * np.abs(expected - centre[0]).max() + 1e-3
        assert arrays["mass"].sum() == pytest.approx(1000 * arrays["volume"].sum())
        assert set(arrays["particle_type"]) == {7} and arrays["position"].dtype == np.float32
        (jelly,) = json.loads(attributes["materials"])
        assert jelly["name"] == "jelly" and (arrays["E"] == np.float32(jelly["E"])).all() and "nu" not in arrays
        assert json.loads(attributes["scene"])["duration"] == pytest.approx(0.055)


@pytest.mark.thorough
def test_one_and_three_processes_make_the_same(whole, tmp_path):
    processes = [start(tmp_path / "set", rank, 3, threads=1 + rank % 2) for rank in range(3)]
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert_same(whole, tmp_path / "set")
    assert finalize(tmp_path / "set") == finalize(whole)


def test_each_device_makes_the_same_again(device, tmp_path):
    """To the last bit on one device, and to rounding on the other."""
    changes = {"grid__deterministic": True, "dataset__fields": ["velocity", "F", "stress"]}
    for name in ("one", "other"):
        assert generate(configuration(**changes), tmp_path / name, device=device)["failed"] == 0
    record_path(shard_path(tmp_path / "other", 1)).unlink()
    assert generate(configuration(**changes), tmp_path / "other", device=device)["scenes"] == 2
    assert_same(tmp_path / "one", tmp_path / "other")
    generate(configuration(**changes), tmp_path / "cpu", device="cpu")
    reference = decoded(tmp_path / "cpu")
    for name, (arrays, attributes) in decoded(tmp_path / "one").items():
        assert attributes["dt"] == reference[name][1]["dt"]
        for key in ("position", "velocity", "F"):
            error = np.abs(arrays[key] - reference[name][0][key]).max() / np.abs(reference[name][0][key]).max()
            assert error < 1e-4, (name, key, error)


@pytest.mark.thorough
@pytest.mark.parametrize("kills", [5, pytest.param(20, marks=pytest.mark.slow)])
def test_a_data_set_that_is_killed_and_resumed_is_the_same(tmp_path, kills):
    changes = {"dataset__splits": {"train": 8 * kills}, "dataset__scenes_per_shard": 1}
    generate(configuration(**changes), tmp_path / "whole", device="cpu")
    rng, survived = random.Random(kills), 0
    for _ in range(kills):
        process = start(tmp_path / "set", **changes)
        process.join(rng.uniform(0.1, 0.4))
        survived += process.exitcode is None
        process.kill()
        process.join()
        if (tmp_path / "set" / "dataset.json").exists():
            seen = DatasetFolder(tmp_path / "set")
            assert all(seen.scene(s.id)["position"].shape[0] == 12 for s in seen.scenes())  # nothing unfinished
    assert survived >= kills // 3  # a fast machine is done before the last kill
    generate(configuration(**changes), tmp_path / "set", device="cpu")
    assert_same(tmp_path / "whole", tmp_path / "set")
    assert list(verify(tmp_path / "set")) == [] and not list((tmp_path / "set" / "shards").glob(".*"))


def test_processes_without_ranks_share_a_folder(whole, tmp_path):
    processes = [start(tmp_path / "set") for _ in range(2)]
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert_same(whole, tmp_path / "set")


def test_a_finished_data_set_is_left_alone(copy):
    before = {p: p.stat().st_mtime_ns for p in copy.rglob("shard_*")}
    assert generate(configuration(), copy, device="cpu")["scenes"] == 0
    assert {p: p.stat().st_mtime_ns for p in copy.rglob("shard_*")} == before


def test_another_configuration_is_refused(copy):
    with pytest.raises(OutputError, match="another configuration"):
        generate(configuration(dataset__seed=1), copy, device="cpu")
    (copy / "notes.txt").write_text("mine")
    (copy / "dataset.json").unlink()
    with pytest.raises(OutputError, match="no data set"):
        generate(configuration(), copy, device="cpu")


def test_a_data_set_is_extended(whole, copy):
    """Scenes that are there stay as they are to the last byte; new ones are those of their ids."""
    before = {p.name: p.read_bytes() for p in (copy / "shards").iterdir()}
    for _ in range(2):  # the second time there is nothing left to do
        done = generate(configuration(), copy, device="cpu", extend={"train": 8})
        assert done["complete"] and {n: (copy / "shards" / n).read_bytes() for n in before} == before
    data = DatasetFolder(copy)
    assert [s.id for s in data.attempted("train")] == [0, 1, 2, 3, 4, 8, 9, 10]
    assert [s.id for s in data.attempted("test")] == [5, 6] and data.record.split_of(10) == "train"
    assert data.record.scenes == 10 and data.record.shards == 6 and list(verify(copy)) == []
    assert finalize(copy)["statistics_of"] == "train"
    longer = generate(configuration(), copy, device="cpu", extend={"test": 3, "train": 9})
    assert longer["scenes"] == 2 and [s.id for s in DatasetFolder(copy).attempted("test")] == [5, 6, 12]
    expected = content(configuration(), 9)
    assert json.loads(decoded(copy)["scene_0000009"][1]["scene"])["seed"] == expected["seed"]
    again = generate(configuration(), copy, device="cpu")  # without `extend`, the folder as it is now
    assert again["complete"] and again["scenes"] == 0
    with pytest.raises(DatasetError, match="the split 'train' has 9 scenes, got a total of 5"):
        generate(configuration(), copy, device="cpu", extend={"train": 5})
    with pytest.raises(MissingError, match="one of train, test, got 'dev'"):
        generate(configuration(), copy, device="cpu", extend={"dev": 5})
    with pytest.raises(OutputError, match=r"another configuration .* --extend"):
        generate(configuration(dataset__splits={"train": 9, "test": 3}), copy, device="cpu")


def test_an_extended_data_set_is_one_that_was_extended_at_once(copy, tmp_path):
    generate(configuration(), copy, device="cpu", extend={"train": 7})
    other = tmp_path / "other"
    generate(configuration(), other, device="cpu", extend={"train": 7})
    assert_same(copy, other)


def test_another_device_is_refused(copy):
    datasets.forge(copy / "dataset.json", lambda words: words.update(device="cuda"))
    with pytest.raises(OutputError, match="begun on cuda, and process 0 of 1 would continue it on cpu"):
        generate(configuration(), copy, device="cpu")


def test_another_version_is_refused(copy):
    datasets.forge(copy / "dataset.json", lambda words: words["versions"].update(torch_mpm="0.0.1"))
    with pytest.raises(OutputError, match=r"begun with torch_mpm 0\.0\.1, and this is"):
        generate(configuration(), copy, device="cpu")


def test_parameters_that_differ_are_stored_by_particle(whole):
    for arrays, attributes in decoded(whole).values():
        E = json.loads(attributes["scene"])["material"]["jelly"]["E"]
        np.testing.assert_array_equal(arrays["E"], np.full(len(arrays["mass"]), E, np.float32))
        assert "nu" not in arrays


# ---- damage


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("damage", ["cut off", "a bit", "removed"])
def test_a_corrupt_shard_is_found_and_made_anew(whole, copy, name, damage):
    path = copy / "shards" / name
    data = path.read_bytes()
    if damage == "removed":
        path.unlink()
    else:
        path.write_bytes(data[:-50] if damage == "cut off" else data[:900] + bytes([data[900] ^ 1]) + data[901:])
    problems = list(verify(copy))
    assert problems and all("shard_00000" in p for p in problems)
    assert generate(configuration(), copy, device="cpu", check=True)["scenes"] == 2
    assert list(verify(copy)) == []
    assert_same(whole, copy)


def test_a_shard_of_another_number_is_found_and_made_anew(whole, copy):
    for place in (shard_path, lambda folder, index: record_path(shard_path(folder, index))):
        shutil.copy(place(copy, 1), place(copy, 0))
    assert "has other scenes than those of its number" in next(verify(copy))
    assert generate(configuration(), copy, device="cpu", check=True)["scenes"] == 2
    assert_same(whole, copy)


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """A data set of another seed, otherwise equal."""
    target = tmp_path_factory.mktemp("other") / "set"
    assert generate(configuration(dataset__seed=9), target, device="cpu")["failed"] == 0
    finalize(target)
    return target


@pytest.mark.parametrize("read", [finalize, DatasetFolder, lambda folder: verify_one(folder)])
def test_a_shard_of_another_data_set_is_refused(other, copy, read):
    """With its record, and of the same number, scenes and fields."""
    for place in (shard_path, lambda folder, index: record_path(shard_path(folder, index))):
        shutil.copy(place(other, 1), place(copy, 1))
    with pytest.raises(DamagedFileError, match=r"shard_00001\.json: is of another data set \(\w{12}, this is \w{12}\)"):
        read(copy)


def verify_one(folder):
    problems = list(verify(folder))
    assert len(problems) == 1
    raise DamagedFileError(folder, problems[0])


def test_a_shard_of_another_data_set_is_made_anew(whole, other, copy):
    for place in (shard_path, lambda folder, index: record_path(shard_path(folder, index))):
        shutil.copy(place(other, 1), place(copy, 1))
    assert generate(configuration(), copy, device="cpu", check=True)["scenes"] == 2
    assert_same(whole, copy)


def test_the_record_of_another_data_set_is_refused(other, copy):
    shutil.copy(other / "dataset.json", copy / "dataset.json")
    assert all("is of another data set" in problem for problem in verify(copy))
    with pytest.raises(DamagedFileError, match="is of another data set"):
        DatasetFolder(copy)


def test_shards_without_a_configuration_are_read(whole, copy):
    """Those of earlier versions."""
    datasets.forge(record_path(shard_path(copy, 1)), lambda words: words.pop("configuration"))
    assert list(verify(copy)) == []
    assert len(DatasetFolder(copy).scenes()) == len(DatasetFolder(whole).scenes())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path, other: path.write_text("{"), "is no metadata of a data set"),
        (lambda path, other: path.write_text("[1]"), "is no metadata of a data set"),
        (lambda path, other: path.write_bytes(b"\xff\xfe"), "is no metadata of a data set"),
        (lambda path, other: path.write_bytes(b""), "is no metadata of a data set"),
        (lambda path, other: path.write_text(path.read_text().replace("vel_std", "vel_sdt")), "checksum is wrong"),
        (lambda path, other: path.write_text(path.read_text().replace("0.005", "0.006")), "checksum is wrong"),
        (lambda path, other: shutil.copy(other / path.name, path), "is of another data set"),
        (lambda path, other: (path.unlink(), path.symlink_to(other / path.name)), "is a link to a place outside"),
        (lambda path, other: (path.unlink(), path.mkdir()), "is a folder"),
        (lambda path, other: (path.unlink(), os.mkfifo(path)), "is a pipe"),
    ],
)
def test_changed_metadata_is_reported(other, copy, change, message):
    finalize(copy)
    path = copy / "metadata.json"
    assert list(verify(copy)) == []
    change(path, other)
    (problem,) = verify(copy)
    assert message in problem and str(path) in problem


def test_metadata_of_earlier_versions_or_none(copy):
    finalize(copy)
    words = json.loads((copy / "metadata.json").read_text())
    (copy / "metadata.json").write_text(json.dumps({k: v for k, v in words.items() if k != "checksum"}))
    assert list(verify(copy)) == []
    (copy / "metadata.json").unlink()
    assert list(verify(copy)) == []


@pytest.mark.thorough
def test_a_full_disk_keeps_what_is_finished(whole, tmp_path):
    (tmp_path / "set.toml").write_text(json_to_toml())
    size = shard_path(whole, 0).stat().st_size

    def small_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size - 100, size - 100))

    process = command("generate", tmp_path / "set.toml", "-o", tmp_path / "set", "--device", "cpu", "--quiet",
                      preexec_fn=small_disk)  # fmt: skip
    _, errors = process.communicate()
    assert process.returncode == 1
    assert errors.startswith("torch-mpm: no room on the disk of ") and len(errors.splitlines()) == 1
    assert not list((tmp_path / "set" / "shards").glob(".*"))
    generate(configuration(), tmp_path / "set", device="cpu")
    arrays, others = decoded(whole), decoded(tmp_path / "set")
    assert all(np.array_equal(a["position"], others[n][0]["position"]) for n, (a, _) in arrays.items())


def json_to_toml() -> str:
    """The small configuration as a file; JSON's inline tables need another sign between key and value."""
    from generated import WORDS

    def toml(value):
        if isinstance(value, dict):
            return "{" + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + "}"
        if isinstance(value, list):
            return "[" + ", ".join(map(toml, value)) + "]"
        return json.dumps(value)

    return "\n".join(f"{key} = {toml(value)}" for key, value in WORDS.items())


# ---- scenes that fail


def test_a_scene_that_explodes_is_recorded_and_leaves_the_others_as_they_are(tmp_path):
    fast = {"choice": [[0.0, 0.0], [500.0, 500.0]]}
    made = configuration(
        body__0__velocity=fast, body__0__count=1, grid__walls="open", dt=5e-4, dataset__scenes_per_shard=7,
        grid__deterministic=True,
    )  # fmt: skip
    assert generate(made, tmp_path, device="cpu")["failed"] > 0
    dataset = DatasetFolder(tmp_path)
    good, bad = dataset.scenes(), [s for s in dataset.attempted() if not s.valid]
    assert good and all("left the grid" in s.failure and s.attempts == 3 for s in bad)
    assert all(decoded(tmp_path)[f"scene_{s.id:07d}"][0] == {} for s in bad)
    built = made.scene(*(content(made, s.id) for s in good)).build("cpu")
    alone, failures, _ = batch.simulate(built, ["position"], 12, 0.005, 10)
    assert failures == [""] * len(good)
    for recorded, listed in zip(alone, good, strict=True):
        np.testing.assert_array_equal(recorded.arrays["position"], dataset.scene(listed.id)["position"])
    assert list(verify(tmp_path)) == []


def test_a_scene_that_explodes_is_tried_again_with_half_of_the_time_step(tmp_path):
    made = configuration(material__jelly__E={"choice": [1e4, 1.2e7]}, dt=1e-3, dataset__scenes_per_shard=7)
    generate(made, tmp_path, device="cpu")
    stored = decoded(tmp_path)
    stiff = {n: json.loads(a["scene"])["material"]["jelly"]["E"] == 1.2e7 for n, (_, a) in stored.items()}
    assert set(stiff.values()) == {True, False}
    for name, (arrays, attributes) in stored.items():
        assert attributes["valid"] and len(arrays["position"]) == 12
        assert attributes["attempts"] == (2 if stiff[name] else 1), name
        assert attributes["dt"] * attributes["substeps_per_frame"] == pytest.approx(0.005)
        assert attributes["dt"] == pytest.approx(5e-4 if stiff[name] else 1e-3)


@pytest.mark.parametrize("attempts", [2, 3])
def test_a_scene_above_the_limit_is_tried_again_with_the_time_step_that_it_needs(attempts, device):
    """The time step has 0.8 of the limit there; in a last attempt it is half of the first one."""
    made = configuration(
        material__jelly__E={"choice": [1e4, 7e6]}, dt=1e-3, grid__deterministic=True, dataset__attempts=attempts
    )
    place = torch.device(device)
    drawn = draw(made, range(7), place)
    assert drawn.built is not None
    first = batch.simulate(drawn.built, ["position"], 12, 0.005, 5)
    stiff = [o.words["material"]["jelly"]["E"] == 7e6 for o in drawn.outcomes]
    assert [share > 1 for share in first.shares] == [bool(f) for f in first.failures] == stiff and any(stiff)
    assert all("above the limit" in f for f in first.failures if f) and max(first.shares) < 1.5
    drawn = draw(made, range(7), place)
    simulate(made, drawn, place)
    needed = math.ceil(5 * max(first.shares) / 0.8)
    for outcome, again in zip(drawn.outcomes, stiff, strict=True):
        assert (outcome.attempts, outcome.failure) == (2 if again else 1, "")
        assert outcome.substeps == (5 if not again else 10 if attempts == 2 else needed) and 5 < needed < 10
        assert outcome.dt == 0.005 / outcome.substeps
    built = made.scene(*(o.words for o in drawn.outcomes if o.attempts == 2)).build(place)
    alone = batch.simulate(built, ["position"], 12, 0.005, 10 if attempts == 2 else needed)
    assert max(alone.shares) <= 1 and not any(alone.failures)
    retried = [o for o in drawn.outcomes if o.attempts == 2]
    for outcome, stored in zip(retried, alone.stored, strict=True):
        np.testing.assert_array_equal(outcome.arrays["position"], stored.arrays["position"])


def test_substeps_of_attempts():
    """At most twice those before; more than before, as failed scenes have a share above 1."""
    assert _of_next(77, 154, 1.0001, False) == 97 and _of_next(77, 154, 1.21, False) == 117
    assert _of_next(77, 154, 1.7, False) == 154 and _of_next(77, 154, math.inf, False) == 154
    assert _of_next(77, 154, 1.0001, True) == 154 and _of_next(97, 308, 1.2, False) == 146


@pytest.mark.parametrize("liquid_modulus", [1e4, 1e7])
def test_the_time_step_suffices_for_both_phases(liquid_modulus, device):
    """A liquid that is stiffer than the solid sets the time step before anything has melted."""
    heat = {"conductivity": 10.0, "specific_heat": 1000.0, "melting_point": 330.0, "latent_heat": 1e3}
    jelly = {"law": "neo_hookean", "E": 1e5, "nu": 0.3, "density": 1000.0}
    made = configuration(
        heat={"reference": 330.0}, body__0__temperature=300.0, body__0__velocity=[0.0, 0.0], gravity=[0.0, 0.0],
        material={"jelly": jelly | heat | {"liquid": {"bulk_modulus": liquid_modulus}}},
    )  # fmt: skip
    built = draw(made, range(2), torch.device(device)).built
    assert built is not None
    of_solid = 2 * 0.1 * built.step.stability_report(built.state).rate
    times = math.sqrt(liquid_modulus / (1e5 / (2 * 1.3 * 0.4)))  # bulk moduli in the plane: K and λ + μ
    for found, expected in zip(batch.substeps(built, 0.1, 0.5), (max(1.0, times) * of_solid).tolist(), strict=True):
        assert expected - 0.01 <= found <= expected + 1.01


def test_what_is_packed_beside_the_simulation_is_the_same(device):
    """Scenes that failed at first, and scenes with obstacle particles."""
    made = configuration(
        material__jelly__E={"choice": [1e4, 1.2e7]}, dt=1e-3, grid__deterministic=True,
        obstacle=[{"count": {"choice": [0, 1]}, "shape": "sphere", "center": [0.5, 0.1], "radius": 0.08}],
    )  # fmt: skip
    prepared = []
    with ThreadPoolExecutor(3) as executor:
        for packers in (None, executor):
            drawn = draw(made, range(7), torch.device(device))
            simulate(made, drawn, torch.device(device), packers=packers)
            assert {o.attempts for o in drawn.outcomes} == {1, 2} and not any(o.failure for o in drawn.outcomes)
            standing = [bool(o.words["obstacle"]) for o in drawn.outcomes]
            assert len(set(standing)) == 2
            for outcome, stands in zip(drawn.outcomes, standing, strict=True):
                assert set(outcome.packed) == (set() if packers is None else {"position"})
                assert (3 in outcome.arrays["particle_type"]) == stands
                assert ("position" in outcome.arrays) != ("position" in outcome.packed)
            prepared.append([prepare_scene(o.arrays, o.packed, o.motion) for o in drawn.outcomes])
    for alone, beside in zip(*prepared, strict=True):
        assert alone.hash == beside.hash and alone.motion == beside.motion
        assert alone.arrays["position"] == beside.arrays["position"]


def test_a_simulation_that_is_broken_off_leaves_no_threads(device):
    made, drawn = configuration(), draw(configuration(), range(3), torch.device(device))

    def broken(scenes, frame):
        if frame == 5:
            raise KeyboardInterrupt

    with ThreadPoolExecutor(2) as executor, pytest.raises(KeyboardInterrupt):
        simulate(made, drawn, torch.device(device), broken, executor)
    assert not [t for t in threading.enumerate() if t.name == "torch_mpm frames"]


def test_a_scene_that_needs_too_many_steps_fails_alone(tmp_path):
    generate(configuration(material__jelly__E={"choice": [1e4, 1e20]}), tmp_path, device="cpu")
    attempted = DatasetFolder(tmp_path).attempted()
    assert {s.valid for s in attempted} == {True, False}
    assert all("substeps, more than" in s.failure for s in attempted if not s.valid)


@pytest.mark.thorough
def test_a_scene_without_room_is_recorded(tmp_path):
    made = configuration(body__0__count={"choice": [1, 30], "weights": [1, 8]}, dataset__splits={"train": 3})
    generate(made, tmp_path, device="cpu")
    attempted = DatasetFolder(tmp_path).attempted()
    assert {s.valid for s in attempted} == {True, False}
    assert all("no room for body[0]" in s.failure and s.attempts == 0 for s in attempted if not s.valid)


def test_a_data_set_without_a_good_scene_cannot_be_finalized(tmp_path):
    made = configuration(body__0__velocity=[500.0, 500.0], grid__walls="open", dataset__attempts=1)
    assert generate(made, tmp_path, device="cpu")["failed"] == 7
    with pytest.raises(IncompleteError, match=r"no valid scene: .*left the grid"):
        finalize(tmp_path)


def test_impossible_configurations_are_refused(tmp_path):
    with pytest.raises(SceneError, match=r"no room for body\[0\]"):
        generate(configuration(body__0__count=30, dataset__splits={"train": 1}), tmp_path, device="cpu")
    with pytest.raises(SceneError, match=r"scene 0: body\[0\].densty: unknown key; did you mean|body\[0\].densty"):
        generate(configuration(body__0__densty=1.0), tmp_path, device="cpu")
    with pytest.raises(
        SceneError, match=r"must be (within|finite and at most) .*, got (1e-300|9.999999999999999e\+299)"
    ):
        generate(configuration(dataset__interval=1e-300), tmp_path, device="cpu")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"center": [0.5, 0.1, 0.5]},
        {"center": [0.5]},
        {"shape": "box", "lower": [0.1] * 3, "upper": [0.2] * 3},
        {"shape": "half_space", "point": [0.0] * 3, "normal": [0.0, 1.0, 0.0]},
    ],
)
def test_an_obstacle_of_another_number_of_dimensions(changes):
    obstacle = {"shape": "sphere", "radius": 0.1, **changes}
    if "shape" in changes:
        obstacle.pop("radius")
    with pytest.raises(SceneError, match=r"^obstacle\[0\]\.\w+: "):
        check_samples(configuration(obstacle=[obstacle]))


def test_a_first_scene_that_is_wrong_fails_alone(monkeypatch):
    ball = {"shape": "sphere", "radius": 0.1, "material": "jelly", "center": [0.5, 0.5]}
    made, drawn = configuration(body=[ball]), content

    def wrong_at_first(configuration, scene_id):
        words = drawn(configuration, scene_id)
        return {**words, "body": [{**b, "density": -1.0} for b in words["body"]]} if scene_id in wrong else words

    monkeypatch.setattr("torch_mpm.data.generate.content", wrong_at_first)
    wrong = {0, 1}
    check_samples(made)
    wrong = {0, 1, 2}
    with pytest.raises(SceneError) as error:
        check_samples(made)
    assert [p[:16] for p in error.value.problems] == ["body[0].density:"]  # one line for all of them


# ---- processes and devices


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, Worker(0, 1, 0)),
        ({"RANK": "3", "WORLD_SIZE": "8", "LOCAL_RANK": "1"}, Worker(3, 8, 1)),
        ({"RANK": "3", "WORLD_SIZE": "8", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2"}, Worker(3, 8, 1, 2)),
        ({"SLURM_PROCID": "2", "SLURM_NTASKS": "4", "SLURM_LOCALID": "2"}, Worker(2, 4, 2)),
        ({"SLURM_ARRAY_TASK_ID": "7", "SLURM_ARRAY_TASK_MIN": "5", "SLURM_ARRAY_TASK_COUNT": "3"}, Worker(2, 3, 0)),
        (
            {
                "SLURM_ARRAY_TASK_ID": "4", "SLURM_ARRAY_TASK_MIN": "0", "SLURM_ARRAY_TASK_STEP": "2",
                "SLURM_ARRAY_TASK_COUNT": "3", "SLURM_PROCID": "1", "SLURM_NTASKS": "2", "SLURM_LOCALID": "1",
            },
            Worker(5, 6, 1),
        ),
    ],
)  # fmt: skip
def test_what_the_environment_says(environment, expected):
    assert worker(environment) == expected


@pytest.mark.parametrize(
    "environment",
    [
        {"RANK": "x"},
        {"RANK": "4", "WORLD_SIZE": "4"},
        {"SLURM_PROCID": "1"},
        {"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "2", "LOCAL_WORLD_SIZE": "2"},
    ],
)
def test_an_environment_that_makes_no_sense(environment):
    with pytest.raises(WorkerError, match="must be"):
        worker(environment)


def test_a_process_without_a_gpu_of_its_own(monkeypatch):
    taken = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", taken.append)
    assert take_device("auto", Worker(5, 8, 1)) == torch.device("cuda", 1) and taken == [1]
    with pytest.raises(WorkerError, match="process 6 of 8 needs GPU 2 of its machine, and torch finds 2"):
        take_device("cuda", Worker(6, 8, 2))
    with pytest.raises(WorkerError, match="two, three, "):
        take_device("cuda", Worker(2, 3, 2, 3))
    found = [take_device("cuda", Worker(rank, 4, rank, 4)) for rank in range(4)]  # two processes on each GPU
    assert found == [torch.device("cuda", index) for index in (0, 1, 0, 1)]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert take_device("cuda", Worker(6, 8, 2)) == torch.device("cuda", 0)  # of those that each see one
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert take_device("auto", Worker()) == torch.device("cpu")
    with pytest.raises(WorkerError, match="process 3 of 4 needs 'cuda', and torch finds no such device"):
        take_device("cuda", Worker(3, 4, 3))


def test_the_command_line(whole, tmp_path, capsys):
    from torch_mpm.cli import main

    (tmp_path / "set.toml").write_text(json_to_toml())
    assert main(["generate", str(tmp_path / "set.toml"), "-o", str(tmp_path / "set"), "--device", "cpu"]) == 0
    out = capsys.readouterr()
    assert "7 scenes in " in out.out and "is complete" in out.out
    assert main(["finalize", str(tmp_path / "set")]) == 0 and main(["verify", str(tmp_path / "set")]) == 0
    assert "7 of 7 scenes are valid" in capsys.readouterr().out
    record_path(shard_path(tmp_path / "set", 2)).unlink()
    assert main(["finalize", str(tmp_path / "set")]) == 1 and main(["verify", str(tmp_path / "set")]) == 1
    assert "lacks 1 of 4 shards (shard_00002)" in capsys.readouterr().err
    assert main(["generate", str(tmp_path / "set.toml"), "-o", str(tmp_path / "set"), "--device", "cpu"]) == 0
    assert "5 scenes of earlier calls or other processes were not read" in capsys.readouterr().out
    assert main(["generate", "-o", str(tmp_path / "other")]) == 1
    assert "takes a configuration or --preset" in capsys.readouterr().err
    assert (os.environ.get("RANK") is None) and (tmp_path / "set" / "config.toml").read_text() == json_to_toml()
