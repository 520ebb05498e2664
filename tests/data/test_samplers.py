"""Distributions against their laws, and scenes that are drawn from them."""

import copy
import datetime
import functools
import itertools
import math
import operator

import numpy as np
import pytest
import torch

pytest.importorskip("pydantic")

from generated import configuration, words
from scipy import stats

from torch_mpm.data import distribution
from torch_mpm.data.configuration import Configuration, presets
from torch_mpm.data.distribution import sample
from torch_mpm.data.generate import check_samples, generate
from torch_mpm.data.sampling import content, divided
from torch_mpm.scene import Scene, SceneError

COUNT = 4000


def draws(words, dim=2, count=COUNT):
    rng = np.random.default_rng(5)
    return [sample(words, rng, dim) for _ in range(count)]


@pytest.mark.parametrize(
    ("words", "law"),
    [
        ({"uniform": [-1, 3]}, stats.uniform(-1, 4).cdf),
        ({"log_uniform": [1e2, 1e6]}, stats.loguniform(1e2, 1e6).cdf),
        ({"normal": [2.0, 0.5]}, stats.norm(2.0, 0.5).cdf),
    ],
)
def test_numbers_follow_their_law(words, law):
    assert stats.kstest(draws(words), law).pvalue > 1e-3


def test_whole_numbers_and_choices():
    whole = draws({"integers": [2, 5]})
    assert set(map(type, whole)) == {int}
    assert stats.chisquare(np.bincount(whole)[2:], np.full(4, COUNT / 4)).pvalue > 1e-3
    chosen = draws({"choice": ["a", {"uniform": [0, 1]}, [1, 2]], "weights": [1, 2, 1]})
    kinds = [sum(isinstance(c, k) for c in chosen) for k in (str, float, list)]
    assert stats.chisquare(kinds, COUNT * np.array([0.25, 0.5, 0.25])).pvalue > 1e-3


@pytest.mark.parametrize("dim", [2, 3])
def test_directions_have_their_length_and_no_preference(dim):
    vectors = np.array(draws({"direction": {"uniform": [1, 2]}}, dim))
    lengths = np.linalg.norm(vectors, axis=1)
    assert stats.kstest(lengths, stats.uniform(1, 1).cdf).pvalue > 1e-3
    unit = vectors / lengths[:, None]
    # of isotropic unit vectors: mean 0, second moments I/D; each with its standard error
    assert (np.abs(unit.mean(0)) < 4 / math.sqrt(dim * COUNT)).all()
    assert np.abs(unit.T @ unit / COUNT - np.eye(dim) / dim).max() < 4 / math.sqrt(4 * COUNT)


def test_points_fill_their_box():
    points = np.array(draws({"in_box": [[0, -1], [1, 3]]}))
    for axis, (a, b) in enumerate([(0, 1), (-1, 3)]):
        assert stats.kstest(points[:, axis], stats.uniform(a, b - a).cdf).pvalue > 1e-3


def test_words_around_distributions_stay():
    words = {"law": "sand", "list": [1, {"uniform": [2, 2]}], "deep": {"x": {"integers": [3, 3]}}}
    assert draws(words, count=1) == [{"law": "sand", "list": [1, 2.0], "deep": {"x": 3}}]
    merged = draws({"material": "m", "choice": [{"shape": "box", "size": {"integers": [4, 4]}}]}, count=1)
    assert merged == [{"material": "m", "shape": "box", "size": 4}]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            {"uniform": [2, 1]},
            "x.uniform: takes two numbers, the lower one first and their difference finite, got [2, 1]",
        ),
        ({"uniform": [-1e308, 1e308]}, "x.uniform: takes two numbers"),
        ({"integers": [0, 2**63]}, "x.integers: takes two whole numbers of at most 64 bits"),
        ({"in_box": [[-1e308, 0], [1e308, 1]]}, "x.in_box: takes a lower and an upper corner"),
        ({"choose": [1, 2]}, "x.choose: unknown key; did you mean 'choice'?"),
        ({"shape": "box", "choose": [{"a": 1}]}, "x.choose: unknown key; did you mean 'choice'?"),
        ({"uniform": 3}, "x.uniform: takes two numbers"),
        ({"uniform": [0, math.inf]}, "x.uniform: takes two numbers"),
        ({"log_uniform": [0, 1]}, "x.log_uniform: takes two positive numbers"),
        ({"normal": [0, -1]}, "x.normal: takes a mean and a deviation"),
        ({"integers": [0.5, 2]}, "x.integers: takes two whole numbers"),
        ({"in_box": [[0, 0, 0], [1, 1, 1]]}, "x.in_box: takes a lower and an upper corner"),
        ({"direction": "up"}, "x.direction: takes a length"),
        ({"direction": 0.0}, "x.direction: takes a length"),
        ({"direction": {"choice": ["up", 1.0]}}, "x.direction: takes a length"),
        ({"direction": {"in_box": [[0, 0], [1, 1]]}}, "x.direction: takes a length"),
        ({"direction": {"direction": 1.0}}, "x.direction: takes a length"),
        ({"direction": {"uniform": [1, 0]}}, "x.direction.uniform: takes two numbers"),
        ({"choice": []}, "x.choice: takes a list with at least one entry"),
        ({"choice": [1, 2], "weights": [1]}, "x.weights: takes 2 numbers"),
        ({"choice": [1, 2], "weights": [0, 0]}, "x.weights: takes 2 numbers"),
        ({"choice": [1], "shape": "box"}, "x.choice: takes tables where it stands beside other keys"),
        ([{"choice": [{"uniform": []}]}], "x[0].choice[0].uniform: takes two numbers"),
        ({"unifrom": [1, 2]}, "x: unknown distribution 'unifrom'; did you mean 'uniform'?"),
    ],
)
def test_distributions_that_cannot_be(words, message):
    (problem,) = distribution.problems(words, "x", 2)
    assert problem.startswith(message)


# ---- configurations


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dataset__frame": 3}, "dataset.frame: unknown key; did you mean 'frames'?"),
        ({"dataset__frames": 1}, "dataset.frames: should be greater than or equal to 2, got 1"),
        ({"dataset__splits": {}}, "dataset.splits: "),
        ({"dataset__splits": {"train": 0}}, "dataset.splits: has no scenes"),
        ({"dataset__splits": {"../x": 1}}, "dataset.splits"),
        ({"dataset__splits": {"x" * 101: 1}}, f"dataset.splits.{'x' * 101}: value error, takes a name"),
        ({"dataset__splits": {"Con": 1}}, "dataset.splits.Con: value error, takes a name of at most 100 letters"),
        ({"dataset__fields": ["speed"]}, "dataset.fields[0]: takes one of 'velocity'"),
        ({"dataset__fields": ["temperature"]}, "dataset.fields: temperature needs a [heat] table"),
        ({"grid__dx": {"uniform": [0.1, 0.2]}}, "grid.dx: takes no distribution"),
        ({"duration": 1.0}, "duration: is not for data sets; give [dataset] frames and interval"),
        ({"emitter": []}, "emitter: is not for data sets"),
        ({"body__0__count": -1}, "body[0].count: takes a whole number"),
        ({"body__0__count": {"integers": [-1, 2]}}, "body[0].count: takes a whole number"),
        ({"body__0__count": {"uniform": [1, 2]}}, "body[0].count: takes a whole number"),
        ({"body__0__count": {"choice": [1, 1.5]}}, "body[0].count: takes a whole number"),
        ({"body": {"shape": "sphere"}}, "body: takes a list of tables"),
        ({"body": {"choice": [[]]}}, "body: takes a list of tables"),
        ({"body": ["sphere"]}, "body[0]: takes a table"),
        ({"body": [{"choice": ["sphere"]}]}, "body[0]: takes a table"),
        ({"obstacle": 3}, "obstacle: takes a list of tables"),
        ({"material": [1]}, "material: takes a table"),
        ({"material": {"choice": [{}]}}, "material: takes a table"),
        ({"material__jelly": "sand"}, "material.jelly: takes a table"),
        ({"material__jelly": {"choice": ["sand"]}}, "material.jelly: takes a table"),
        ({"title": datetime.date(2026, 1, 1)}, "title: takes no date"),
        ({"body__0__density": datetime.datetime(2026, 1, 1)}, "body[0].density: takes no date"),
        ({"dataset__particles": 9, "body__0__choice": [{"shape": "points"}]}, "body[0].shape: points have"),
        ({"obstacle": [{"shape": "sphere", "start": 0.1}]}, "obstacle[0]: start and end are not"),
        ({"obstacle": [{"shape": "sphere", "end": {"uniform": [1, 2]}}]}, "obstacle[0]: start and end are not"),
        ({"body__0__center": {"in_box": [[0, 0]]}}, "body[0].center.in_box: takes a lower and an upper corner"),
    ],
)
def test_configurations_that_cannot_be(changes, message):
    with pytest.raises(SceneError) as error:
        configuration(**changes)
    assert any(problem.startswith(message) for problem in error.value.problems), error.value.problems


def places_of(words, place=()):
    """Paths of all entries of nested tables and lists."""
    entries = words.items() if isinstance(words, dict) else enumerate(words) if isinstance(words, list) else ()
    for key, value in entries:
        yield (*place, key)
        yield from places_of(value, (*place, key))


def longer(value):
    """A list with one more entry."""
    return [*value, value[0]] if isinstance(value, list) and value else value


WRONG = {"table": lambda value: {"a": 1}, "list": lambda value: ["a"], "longer": longer}


@pytest.mark.parametrize("wrong", WRONG)
def test_entries_that_do_not_fit_are_errors_by_name(wrong):
    """Or no errors, where such an entry is possible; never one of the program."""
    capsule = {"shape": "capsule", "center": [0.5, 0.1], "axis": [0.2, 0.0], "radius": 0.05}
    with_obstacle = words(obstacle=[capsule])
    refused = 0
    for *path, last in places_of(with_obstacle):
        mutated = copy.deepcopy(with_obstacle)
        table = functools.reduce(operator.getitem, path, mutated)
        table[last] = WRONG[wrong](table[last])
        try:
            check_samples(Configuration.from_words(mutated), 1)
        except SceneError:
            refused += 1
    assert refused >= {"table": 40, "list": 40, "longer": 8}[wrong]


def test_a_configuration_without_its_tables():
    with pytest.raises(SceneError, match="dataset: missing"):
        Configuration.from_words({"grid": {"lower": [0, 0], "upper": [1, 1], "dx": 0.1}})
    with pytest.raises(SceneError, match="grid: missing"):
        Configuration.from_words({"dataset": {"splits": {"a": 1}, "frames": 2, "interval": 0.1}})


def test_the_hash_is_that_of_what_decides_the_scenes():
    hashes = [configuration().hash, configuration(title="x", device="cpu").hash]
    assert hashes[0] == hashes[1]
    others = [configuration(dataset__seed=1), configuration(grid__dx=0.11), configuration(body__0__per_cell=4)]
    assert len({hashes[0], *(c.hash for c in others)}) == 4


def test_the_hash_is_that_of_files_too(tmp_path):
    np.save(tmp_path / "points.npy", np.full((3, 2), 0.5))
    words = {**configuration().words, "body": [{"shape": "points", "file": "points.npy", "volume": 1, "material": "m"}]}
    before = Configuration.from_words(words, folder=tmp_path).hash
    np.save(tmp_path / "points.npy", np.full((3, 2), 0.6))
    assert Configuration.from_words(words, folder=tmp_path).hash != before
    (tmp_path / "points.npy").unlink()
    with pytest.raises(SceneError, match=r"body\[0\].file: .*does not exist"):
        Configuration.from_words(words, folder=tmp_path)


# ---- scenes


def test_a_scene_depends_on_the_hash_and_its_id_alone():
    one, other = configuration(), configuration()
    backwards = {k: content(one, k) for k in reversed(range(6))}
    assert backwards == {k: content(other, k) for k in range(6)}
    assert len({str(words) for words in backwards.values()}) == 6
    assert content(configuration(dataset__seed=1), 0) != backwards[0]


def test_bodies_keep_their_distance():
    made = configuration(
        body__0__count=3, body__0__center={"in_box": [[0, 0], [1, 1]]}, dataset__gap=0.07,
        obstacle=[{"shape": "sphere", "radius": 0.1, "center": {"in_box": [[0, 0], [1, 1]]}}],
    )  # fmt: skip
    for scene_id in range(8):
        drawn = content(made, scene_id)
        assert len(drawn["body"]) == 3
        # Points of the shapes against each other: none nearer than the gap.
        points = [_outline(body) for body in drawn["body"]] + [_outline(drawn["obstacle"][0])]
        for a, b in itertools.combinations(points, 2):
            nearest = np.linalg.norm(a[:, None] - b[None], axis=2).min()
            assert nearest > 0.07, (scene_id, nearest)
        for x in points[:3]:
            assert x.min() >= -1e-9 and x.max() <= 1 + 1e-9
        made.scene(drawn).build("cpu")  # whose own checks find no overlap


@pytest.mark.parametrize("dim", [2, 3])
def test_spheres_keep_the_gap(dim):
    """Exactly: the distance of their centres less their radii."""
    least = math.inf
    for scene_id in range(6):
        made = configuration(
            grid__lower=[0.0] * dim, grid__upper=[1.0] * dim, gravity=[0.0] * dim, dataset__gap=0.03,
            body=[{"count": 9, "material": "jelly", "shape": "sphere", "radius": {"uniform": [0.04, 0.12]},
                   "center": {"in_box": [[0.0] * dim, [1.0] * dim]}}],
        )  # fmt: skip
        for a, b in itertools.combinations(content(made, scene_id)["body"], 2):
            least = min(least, math.dist(a["center"], b["center"]) - a["radius"] - b["radius"])
    assert 0.03 <= least < 0.12  # and they come near each other


def _outline(words):
    """Points all over a box or a disc."""
    s = np.linspace(0, 1, 24)
    if words["shape"] == "box":
        lower, upper = np.array(words["lower"]), np.array(words["upper"])
        return lower + np.stack(np.meshgrid(s, s), -1).reshape(-1, 2) * (upper - lower)
    angle = 2 * np.pi * s
    return words["center"] + words["radius"] * np.stack([np.cos(angle), np.sin(angle)], 1)


def test_a_budget_of_particles_is_met(device):
    made = configuration(dataset__particles=300, body__0__count={"integers": [1, 3]})
    for scene_id in range(5):
        drawn = content(made, scene_id)
        state = made.scene(drawn).build(device).state
        assert len(state) == 300
        shares = np.array([b["particles"] for b in drawn["body"]]) / 300
        areas = np.array([_area(b) for b in drawn["body"]])
        assert np.abs(shares - areas / areas.sum()).max() < 2 / 300
        assert float(state.volume.double().sum()) == pytest.approx(areas.sum(), rel=1e-5)
    assert divided(7, [1.0, 1.0, 1e-9]) == [3, 3, 1]


def _area(words):
    if words["shape"] == "sphere":
        return math.pi * words["radius"] ** 2
    return math.prod(b - a for a, b in zip(words["lower"], words["upper"], strict=True))


def test_ends_of_boxes_capsules_and_cylinders():
    body = [
        {"shape": "capsule", "center": [0.5, 0.5, 0.5], "axis": [0.2, 0.0, 0.0], "radius": 0.1, "material": "jelly"},
    ]
    grid = {"lower": [0.0] * 3, "upper": [1.0] * 3, "dx": 0.1}
    made = configuration(gravity=[0.0, -9.8, 0.0], grid=grid, body=body)
    (capsule,) = content(made, 0)["body"]
    assert capsule["a"] == [0.4, 0.5, 0.5] and capsule["b"] == [0.6, 0.5, 0.5] and "axis" not in capsule


def test_words_of_a_scene_are_those_of_a_scene_file():
    made = configuration()
    words = made.scene_words(content(made, 2))
    alone, batch = Scene.from_words(words).build("cpu"), made.scene(content(made, 1), content(made, 2)).build("cpu")
    own = batch.state.scene == 1
    np.testing.assert_array_equal(alone.state.x.numpy(), batch.state.x[own].numpy())
    np.testing.assert_array_equal(alone.state.v.numpy(), batch.state.v[own].numpy())


# ---- presets


@pytest.mark.parametrize("name", presets())
def test_every_preset_gives_scenes_that_run(name, tmp_path):
    short = ["dataset.splits={train=2,test=1}", "dataset.frames=3", "dataset.scenes_per_shard=2"]
    small = ["dataset.particles=500"] if name.endswith("3d") else []
    made = Configuration.preset(name, [*short, *small])
    check_samples(made)
    summary = generate(made, tmp_path, device="cpu")
    assert summary["complete"] and summary["failed"] == 0
    assert Configuration.preset(name).words["grid"]["deterministic"]


def test_squeezed_wax_of_a_preset_keeps_its_pressure_when_it_melts():
    """At 0.7 of its volume, for which a piece that lands on the plate is squeezed: pressure and tangent modulus, for
    both choices of E."""
    made = Configuration.preset("melting")
    words = [content(made, k) for k in range(6)]
    built = made.scene(*words).build("cpu")
    assert {w["material"]["wax"]["E"] for w in words} == {5e4, 1e5}
    state, law = built.step.prepare(built.state), built.step.law
    squeezed = state.replace(
        F=math.sqrt(0.7) * torch.eye(2).expand_as(state.F), J=torch.full_like(state.mass, 0.7),
        temperature=torch.zeros_like(state.mass),
    )  # fmt: skip

    def phase(liquid):
        part = squeezed.replace(extra={**state.extra, "liquid": torch.full_like(state.mass, liquid)})
        return -law.stress(part).diagonal(dim1=1, dim2=2).mean(1), law.stiffness(part)

    for solid, liquid in zip(phase(0.0), phase(1.0), strict=True):
        assert (solid > 0).all() and (liquid / solid).log2().abs().max() < 1


def test_an_unknown_preset():
    with pytest.raises(SceneError, match=r"takes one of elastic, .*got 'lava'"):
        Configuration.preset("lava")


def test_the_text_of_a_configuration_gives_it_again(tmp_path):
    overrides = ["dataset.frames=9", "material.sand.E=1e6"]
    changed = Configuration.preset("sand", overrides)
    assert changed.text.splitlines()[:2] == [f"# --set {item}" for item in overrides]
    (tmp_path / "config.toml").write_text(changed.text)
    assert Configuration.load(tmp_path / "config.toml", overrides).hash == changed.hash
