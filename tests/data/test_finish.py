"""Statistics of a data set against numpy, and what `verify` finds."""

import json
import shutil

import numpy as np
import pytest

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

import small_dataset as datasets
from generated import configuration, decoded

from torch_mpm.data.finish import finalize, verify
from torch_mpm.data.generate import generate
from torch_mpm.data.packing import prepare_scene
from torch_mpm.data.shard import record_path, shard_path
from torch_mpm.data.shard_writer import ShardWriter
from torch_mpm.errors import DamagedFileError

OBSTACLES = [
    {"shape": "box", "center": [0.5, 0.05], "size": [0.6, 0.08], "rotation": 0.2},
    {"shape": "sphere", "center": [0.1, 0.1], "radius": 0.08, "velocity": [0.5, 0.0], "spin": 2.0},
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    laws = [{"law": "neo_hookean", "E": 1e4}, {"law": "weakly_compressible", "bulk_modulus": 1e4}]
    made = configuration(
        obstacle=OBSTACLES,
        dataset__fields=["velocity", "F", "J", "stress", "liquid"],
        body__0__count=1,
        body__0__center={"in_box": [[0.3, 0.32], [0.7, 0.35]]},
        material__jelly={"choice": laws},
    )
    target = tmp_path_factory.mktemp("finish") / "set"
    assert generate(made, target, device="cpu")["failed"] == 0
    return target


def test_statistics_are_those_of_the_arrays(folder):
    words = finalize(folder)
    velocity, acceleration, most = [], [], 0
    for name, (arrays, _) in decoded(folder).items():
        most = max(most, arrays["position"].shape[1])
        if int(name[-7:]) < 5:  # of the split "train"
            x = arrays["position"][:, arrays["particle_type"] != 3].astype(np.float64)
            velocity.append(np.diff(x, axis=0).reshape(-1, 2))
            acceleration.append(np.diff(x, n=2, axis=0).reshape(-1, 2))
    for kind, rows in (("vel", velocity), ("acc", acceleration)):
        together = np.concatenate(rows)
        np.testing.assert_allclose(words[f"{kind}_mean"], together.mean(0), rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(words[f"{kind}_std"], together.std(0), rtol=1e-6)
    assert words["sequence_length"] == 11 and words["rollout"]["sequence_length"] == 12
    assert words["bounds"] == [[0.0, 1.0], [0.0, 1.0]] and words["num_particles_max"] == most
    before = (folder / "metadata.json").read_bytes()
    finalize(folder)
    assert (folder / "metadata.json").read_bytes() == before == json.dumps(words, indent=1).encode()


def test_obstacles_are_particles_that_move_with_them(folder):
    for arrays, _ in decoded(folder).values():
        solid = arrays["particle_type"] == 3
        assert (arrays["material"][solid] == -1).all() and (arrays["mass"][solid] == 0).all()
        x, v = arrays["position"][:, solid].astype(np.float64), arrays["velocity"][:, solid].astype(np.float64)
        t = 0.005 * np.arange(12)
        ball = np.linalg.norm(x[0] - [0.1, 0.1], axis=1) < 0.08 + 1e-6
        assert ball.any() and not ball.all()
        # The ball: x(t) = centre + 0.5 t + R(2 t) (x(0) - centre), and velocity 0.5 + 2 k x arm.
        arm = x[0, ball] - [0.1, 0.1]
        c, s = np.cos(2 * t)[:, None], np.sin(2 * t)[:, None]
        turned = np.stack([c * arm[:, 0] - s * arm[:, 1], s * arm[:, 0] + c * arm[:, 1]], -1)
        centre = np.stack([0.1 + 0.5 * t, 0.1 + 0 * t], -1)[:, None]
        np.testing.assert_allclose(x[:, ball], centre + turned, atol=1e-6)
        np.testing.assert_allclose(v[:, ball], [0.5, 0] + 2 * turned[..., ::-1] * [-1, 1], atol=1e-6)
        # The ramp: at rest, inside the box, and near its surface.
        assert (x[:, ~ball] == x[0, ~ball]).all() and (v[:, ~ball] == 0).all()
        c, s = np.cos(0.2), np.sin(0.2)
        own = np.abs((x[0, ~ball] - [0.5, 0.05]) @ [[c, -s], [s, c]])
        assert (own <= [0.3 + 1e-6, 0.04 + 1e-6]).all()
        np.testing.assert_array_equal(arrays["F"][:, solid], np.broadcast_to(np.eye(2), (12, solid.sum(), 2, 2)))
        assert (arrays["J"][:, solid] == 1).all() and (arrays["stress"][:, solid] == 0).all()


def test_solids_and_fluids_have_the_same_fields(folder):
    """Solids move F and fluids J, together in a batch or not; the other one follows from it: J = det F."""
    changes: dict[str, float] = {}
    for arrays, attributes in decoded(folder).values():
        law = json.loads(attributes["materials"])[0]["law"]
        J = np.linalg.det(arrays["F"].astype(np.float64))
        np.testing.assert_allclose(arrays["J"], J, rtol=1e-5)
        changes[law] = max(changes.get(law, 0.0), np.abs(J[-1] - 1).max())
    assert changes["neo_hookean"] > 1e-3 and changes["weakly_compressible"] > 1e-3


def changed(folder, change):
    """Write the first shard again with other arrays or attributes, and a record that fits them."""
    scenes = {name: value for name, value in decoded(folder).items() if int(name[-7:]) < 2}
    with ShardWriter(shard_path(folder, 0)) as writer:
        for name, (arrays, attributes) in scenes.items():
            kept = {k: v.item() if hasattr(v, "item") else v for k, v in attributes.items() if k != "id"}
            change(arrays, kept)
            writer.add(int(name[-7:]), prepare_scene(arrays), kept)
        writer.finish()


def fill(name, value, part=...):
    def change(arrays, attributes):
        arrays[name][part] = value

    return change


@pytest.mark.parametrize(
    ("place", "name"),
    [("sum", "velocity"), ("squares", "velocity"), ("sum", "acceleration"), ("squares", "acceleration")],
)
def test_sums_that_are_not_those_of_the_scene(folder, tmp_path, place, name):
    """With a checksum that fits: `verify` computes the sums anew."""
    copy = shutil.copytree(folder, tmp_path / "copy")

    def change(words):
        words["scenes"][0]["motion"][name][place][1] *= 1 + 1e-6

    datasets.forge(record_path(shard_path(copy, 0)), change)
    problems = list(verify(copy))
    assert len(problems) == 1 and "scene 0 has other statistics than its record says" in problems[0]


@pytest.mark.parametrize("sealed", [None, "x", "0" * 64])
def test_a_record_with_the_seal_of_another_shard(folder, tmp_path, sealed):
    """`verify` finds what readers refuse."""
    copy = shutil.copytree(folder, tmp_path / "copy")
    datasets.forge(record_path(shard_path(copy, 0)), lambda words: words.update(seal=sealed))
    problems = list(verify(copy))
    assert len(problems) == 1 and "is another shard than that of its record" in problems[0]


def lifted(arrays, attributes):
    words = json.loads(attributes["scene"])
    attributes["scene"] = json.dumps({k: v for k, v in words.items() if k != "obstacle"})
    arrays["velocity"][-1] *= 20


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (fill("stress", np.nan, 3), "has numbers that are not finite in stress"),
        (fill("position", 7.0, (2, 4)), "has particles outside of the domain"),
        (lifted, "of its energy"),
        (lambda arrays, attributes: arrays.pop("F"), "lacks F"),
        (lambda arrays, attributes: attributes.update(valid=0), "is valid in its record or in its file"),
    ],
)
def test_what_is_wrong_with_a_scene(folder, tmp_path, change, message):
    copy = shutil.copytree(folder, tmp_path / "copy")
    assert list(verify(copy)) == []
    changed(copy, change)
    problems = list(verify(copy))
    assert len(problems) == 2 and all(message in p and "shard_00000.h5: scene" in p for p in problems), problems


@pytest.mark.parametrize("damage", ["gone", "cut off", "too much", "other scenes"])
def test_shards_that_are_not_those_of_the_data_set_are_not_finalized(tmp_path, damage):
    path = datasets.make_dataset(tmp_path / "set")
    file = shard_path(path, 1)
    if damage == "gone":
        file.unlink()
    elif damage == "cut off":
        file.write_bytes(file.read_bytes()[:-9])
    else:
        other = shard_path(path, 3 if damage == "too much" else 0)
        other.write_bytes(file.read_bytes())
        record_path(other).write_bytes(record_path(file).read_bytes())
    with pytest.raises(DamagedFileError, match=r"is gone, or|is beyond the 3 shards|has other scenes"):
        finalize(path)


def test_a_folder_without_a_data_set(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no data set"):
        list(verify(tmp_path))
