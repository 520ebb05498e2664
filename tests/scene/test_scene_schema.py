"""Scene files: valid ones are read, and errors name the key and the values that it takes."""

# ruff: noqa: E501

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import FILE, disc

pytest.importorskip("pydantic")

import torch_mpm as mpm
from torch_mpm.data.configuration import Dataset
from torch_mpm.rollouts.plan import SCHEDULES
from torch_mpm.scene import Scene, SceneError, json_schema, schema
from torch_mpm.scene.describe import halfway, plan_in_words
from torch_mpm.scene.explain import BOOLEANS
from torch_mpm.scene.substeps import time_step

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.toml"))
BOX = {"shape": "box", "lower": (0.1, 0.1), "upper": (0.3, 0.3), "material": "jelly"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"grvity": (0, -9.8)}, "grvity: unknown key; did you mean 'gravity'?"),
        ({"body__0__raduis": 1}, "body[0].raduis: unknown key; did you mean 'radius'?; the keys here (ball; a disc in 2-D)"),
        ({"grid__dxx": 1}, "grid.dxx: unknown key; did you mean 'dx'?"),
        ({"material__jelly__desnity": 1}, "material.jelly.desnity: unknown key; did you mean 'density'?"),
        ({"body__0__shape": "spere"}, "body[0].shape: takes one of 'box', 'sphere', 'cylinder', 'capsule', 'mesh', 'points', "
         "'splats', "
         "got 'spere'; did you mean 'sphere'?"),
        ({"body": [{"radius": 1}]}, "body[0].shape: missing; takes one of 'box'"),
        ({"material__jelly__law": "neo_hooke"}, "material.jelly.law: takes one of 'neo_hookean', 'weakly_compressible', 'quartic_sand', 'cam_clay',"),
        ({"material__jelly__density": -1.0}, "material.jelly.density: should be greater than 0, got -1.0; takes: density at rest"),
        ({"material__jelly__nu": 0.5}, "material.jelly.nu: should be less than 0.5, got 0.5; takes: Poisson's ratio"),
        ({"material__jelly": {"law": "neo_hookean"}}, "material.jelly.E: missing; takes: Young's modulus [Pa]"),
        ({"grid__dx": math.nan}, "grid.dx: should be a finite number, got nan"),
        ({"grid__kernel": "linear"}, "grid.kernel: takes one of 'quadratic', 'cubic', got 'linear'"),
        ({"grid__walls": "slippery"}, "grid.walls: "),
        ({"duration": "long"}, "duration: should be a valid number"),
        ({"material__jelly__E": True}, "material.jelly.E: takes no true or false, got true"),
        ({"gravity": (False, -9.8)}, "gravity[0]: takes no true or false, got false"),
        ({"seed": True}, "seed: takes no true or false"),
        ({"body__0__radius": True, "grid__deterministic": True}, "body[0].radius: takes no true or false"),
        ({"fps": 0}, "fps: should be greater than 0, got 0; takes: frames per second"),
        ({"obstacle": [{"shape": "box", "center": (0, 0), "size": (1, 1), "contact": "sticki"}]},
         "obstacle[0].contact: takes one of 'slip', 'sticky', 'separate', got 'sticki'; did you mean 'sticky'?"),
        ({"output": {"fields": ["strain"]}}, "output.fields[0]: takes one of 'F', 'J', 'C', 'stress', 'cauchy_stress', 'kirchhoff_stress', "),
        ({"scene": [{"graviti": (0, 1)}]}, "scene[0].graviti: unknown key; did you mean 'gravity'?"),
    ],
)  # fmt: skip
def test_wrong_words(words, message):
    with pytest.raises(SceneError) as error:
        Scene(**disc(**words))
    assert any(problem.startswith(message) for problem in error.value.problems), str(error.value)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"gravity": (0, -9.8, 0)}, "gravity: must have 2 numbers in this 2-D scene, got (0.0, -9.8, 0.0)"),
        ({"grid__upper": (1, 1, 1)}, "grid.upper: must have 2 numbers like grid.lower"),
        ({"grid__upper": (1, -1)}, "grid.upper: must be above grid.lower on every axis"),
        ({"grid__walls": ["slip"]}, "grid.walls: must have one entry per axis, 2 in all"),
        ({"grid__walls": "mirror", "grid__upper": [1.0, 1.01]}, "grid.walls: a mirror must lie on a node or halfway"),
        ({"body__0__spin": (1, 2, 3)}, "body[0].spin: takes one number in 2-D, got (1.0, 2.0, 3.0)"),
        ({"body__0__velocity": (1, 2, 3)}, "body[0].velocity: must have 2 numbers"),
        ({"body__0__material": "jely"}, "body[0].material: there is no material 'jely'; known: jelly"),
        ({"body": []}, "body: the scene has no matter"),
        ({"body": [{"shape": "mesh", "file": "a.ply", "material": "jelly"}]}, "body[0].shape: a mesh needs three dimensions"),
        ({"body__0__center": (0.9, 0.5), "body__0__name": "ball"}, "body[0] (ball): reaches from [0.7"),
        ({"body": [BOX, {**BOX, "lower": (0.2, 0.2), "upper": (0.5, 0.5)}]}, "body[0]: overlaps body[1], 36 of its particles"),
        ({"obstacle": [{"shape": "sphere", "center": (0.5, 0.3), "radius": 0.1}]}, "body[0]: "),
        ({"body": [{"shape": "points", "file": "none.npy", "material": "jelly"}]}, "body[0].file: points file none.npy does not exist"),
        ({"emitter": [{"center": (0.5, 0.98), "radius": 0.1, "velocity": (1, 0), "material": "jelly"}]},
         "emitter[0]: the nozzle is outside the domain"),
        ({"emitter": [{"center": (0.5, 0.8), "radius": 0.1, "velocity": (1, 0), "material": "jelly", "rate": 1.0}]},
         "emitter[0]: rate must be at most area times speed, 0.2 m^2/s, got 1.0"),
        ({"emitter": [{"center": (0.5, 0.8), "radius": 0.1, "velocity": (0, 0), "material": "jelly"}]},
         "emitter[0]: velocity must not be zero"),
        ({"scene": [{}, {"body": [{**BOX, "lower": (-0.3, 0.1)}]}]}, "scene[1].body[0]: reaches from [-0.3"),
        ({"device": "cuda:9000"}, "device: "),
        ({"device": "toaster"}, 'device: takes "cpu", "cuda", "cuda:1", ... or "auto"'),
    ],
)  # fmt: skip
def test_scenes_that_make_no_sense(words, message):
    with pytest.raises(SceneError) as error:
        Scene(**disc(**words)).build()
    assert any(problem.startswith(message) for problem in error.value.problems), str(error.value)


def test_a_mesh_that_is_not_closed_is_named(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export(tmp_path / "open.ply")
    text = FILE.format(duration=1).replace("]\nduration", ", 0.0]\nduration").replace("spin = 3.0\n", "")
    text = text.replace('shape = "sphere"\ncenter = [0.4, 0.3]\nradius = 0.2', 'shape = "mesh"\nfile = "open.ply"')
    text = text[: text.index("[[emitter]]")].replace("[0.0, 0.0]", "[0, 0, 0]").replace("[1.0, 1.0]", "[1, 1, 1]")
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(SceneError, match=r"scene.toml: body\[0\]: mesh .*open.ply is not closed: 3 of its edges"):
        Scene.load(tmp_path / "scene.toml").build()


def test_files_name_themselves_in_messages(tmp_path):
    path = tmp_path / "scene.toml"
    with pytest.raises(FileNotFoundError, match=r"scene.toml does not exist"):
        Scene.load(path)
    path.write_text("gravity = [0,\n[")
    with pytest.raises(SceneError, match=r"scene.toml: not a TOML file: "):
        Scene.load(path)
    path.write_text(FILE.format(duration=1).replace("fps", "fsp"))
    with pytest.raises(SceneError, match=r"scene.toml: fsp: unknown key; did you mean 'fps'"):
        Scene.load(path)


def test_keys_that_are_true_or_false():
    models = [m for m in vars(schema).values() if isinstance(m, type) and issubclass(m, schema.Model)]
    models += [Dataset, *schema.SOLIDS]
    found = {name for model in models for name, field in model.model_fields.items() if field.annotation is bool}
    assert found == set(BOOLEANS)


def test_a_byte_order_mark(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_bytes(b"\xef\xbb\xbf" + FILE.format(duration=0.04).encode())
    assert Scene.load(path).duration == 0.04


def test_overrides(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(duration=1))
    scene = Scene.load(path, ["grid.dx=0.1", "body[0].center=[0.5, 0.4]", "precision=float64", "material.jelly.nu=0.1"])
    assert scene.grid.dx == 0.1 and scene.body[0].center == (0.5, 0.4) and scene.precision == "float64"
    assert scene.material["jelly"].nu == 0.1
    for override, message in {
        "grid.dx": "must look like grid.dx=0.01",
        "body[3].radius=1": "there is no body",
        "grid.dxx=1": "did you mean 'dx'",
    }.items():
        with pytest.raises(SceneError, match=message):
            Scene.load(path, [override])


@pytest.mark.parametrize("name", ["weicher Ton", "sand.grob", "a[0]", "Gelée 漢", "a=b"])
@pytest.mark.parametrize("quote", ['"', "'"])
def test_overrides_of_names_in_quotes(name, quote, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(
        FILE.format(duration=1).replace("material.jelly", f"material.'{name}'").replace('"jelly"', f"'{name}'")
    )
    assert Scene.load(path, [f"material.{quote}{name}{quote}.E=3e4"]).material[name].E == 3e4


@pytest.mark.parametrize("override", ["grid.dx=0.1\nkernel='cubic'", "duration=1\nfps=5", "title='a'\n[grid]\ndx=1"])
def test_an_override_of_several_keys(override, tmp_path):
    (tmp_path / "scene.toml").write_text(FILE.format(duration=1))
    with pytest.raises(SceneError, match=r"must have one value, got more keys: (kernel|fps|grid)"):
        Scene.load(tmp_path / "scene.toml", [override])


def test_python_says_what_the_file_says(tmp_path):
    (tmp_path / "scene.toml").write_text(FILE.format(duration=0.1))
    loaded = Scene.load(tmp_path / "scene.toml")
    emitter = {"center": (0.8, 0.7), "radius": 0.1, "velocity": (-1, 0.5), "material": "jelly", "end": 0.2}
    said = mpm.Scene(**disc(body__0__center=(0.4, 0.3), body__0__spin=3.0, emitter=[emitter]))
    assert said.fingerprint() == loaded.fingerprint()
    assert said.fingerprint() != mpm.Scene(**disc()).fingerprint()


def test_the_fingerprint_is_of_what_decides_the_trajectory():
    base = Scene(**disc()).fingerprint()
    assert Scene(**disc(title="x", render={"color_by": "speed"})).fingerprint() == base
    assert Scene(**disc(seed=1)).fingerprint() != base
    assert Scene(**disc(output={"fields": ["F"]})).fingerprint() != base


def test_schema_is_one_that_editors_take():
    jsonschema = pytest.importorskip("jsonschema")
    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    good = json.loads(json.dumps(disc()))
    validator.validate(good)
    assert not validator.is_valid(good | {"grvity": [0, 1]})


def test_the_schema_beside_the_examples_is_that_of_the_package():
    assert json.loads((EXAMPLES[0].parent / "scene.schema.json").read_text()) == json_schema(), "torch-mpm schema > it"


def test_descriptions_reach_the_schema():
    text = json.dumps(json_schema())
    assert "Young's modulus [Pa]" in text and "distance between grid nodes [m]" in text


LARGE = ("sand_blade", "sand_cylinder", "hourglass", "sand_drum", "spinner")


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=pytest.mark.thorough) if p.stem in LARGE else p for p in EXAMPLES],
    ids=lambda p: p.stem,
)
def test_examples_build_and_name_their_plan(path):
    scene = Scene.load(path, ["device=cpu"])
    if any(getattr(body, "shape", None) == "mesh" for body in scene.body):
        pytest.importorskip("trimesh")
    if path.stem == "demo":
        assert scene.dim == 3 and scene.render.video
    built = scene.build()
    assert built.particles >= (100_000 if path.stem == "demo" else 1001)
    state = halfway(built)
    dt, substeps = time_step(scene, built, state)
    headline, *others = plan_in_words(scene, built, state.sorted(built.grid), dt, substeps).items()
    executors, schedules = {"fused", "replay", "graph", "loop"}, set(SCHEDULES)
    assert "(executor fused, schedule sorted_cpu)" in headline[1]
    assert headline[0] == "plan" and {name for name, _ in others} == {
        f"not {name}" for name in (executors | schedules) - {"fused", "sorted_cpu"}
    }
    assert all(len(reason) > 10 for _, reason in others)


# ---- what a scene becomes


def test_mass_and_volume_are_exact():
    built = Scene(**disc(precision="float64", material__jelly__density=1234.0)).build("cpu")
    assert float(built.state.mass.sum()) == pytest.approx(1234 * math.pi * 0.04, rel=1e-13)
    assert float(built.state.volume.sum()) == pytest.approx(math.pi * 0.04, rel=1e-13)


def test_spin_is_a_rigid_rotation_with_the_angular_momentum_of_its_matter():
    built = Scene(**disc(precision="float64", body__0__spin=2.0, body__0__velocity=(1, 0))).build("cpu")
    state = built.state
    r = state.x - (state.mass[:, None] * state.x).sum(0) / state.mass.sum()
    torch.testing.assert_close(state.v[:, 0], 1 - 2 * r[:, 1], rtol=0, atol=1e-13)
    torch.testing.assert_close(state.v[:, 1], 2 * r[:, 0], rtol=0, atol=1e-13)
    torch.testing.assert_close(state.C, torch.tensor([[0, -2.0], [2.0, 0]]).double().expand_as(state.C))


def test_spin_in_space_is_about_its_axis():
    grid = {"lower": (0, 0, 0), "upper": (1, 1, 1), "dx": 0.1}
    ball = {"shape": "sphere", "center": (0.5, 0.5, 0.5), "radius": 0.2, "material": "jelly", "spin": (0, 0, 3)}
    built = Scene(**disc(grid=grid, gravity=None, body=[ball], precision="float64")).build("cpu")
    r = built.state.x - 0.5
    expected = torch.linalg.cross(torch.tensor([0, 0, 3.0]).double().expand_as(r), r)
    torch.testing.assert_close(built.state.v, expected, rtol=0, atol=1e-12)


def test_a_scene_has_only_the_fields_that_it_needs():
    solid = Scene(**disc()).build("cpu").state
    fluid = Scene(**disc(material__jelly={"law": "weakly_compressible", "bulk_modulus": 1e4})).build("cpu").state
    assert (
        solid.F is not None and solid.J is None and solid.C is None and solid.scene is None and solid.material is None
    )
    assert fluid.F is None and fluid.J is not None


def test_a_batch_has_the_parameters_of_each_scene():
    materials = [{"jelly": {"law": "neo_hookean", "E": E}} for E in (1e4, 2e4)]
    water = {"water": {"law": "weakly_compressible", "bulk_modulus": 1e5}}
    pool = {"shape": "box", "lower": (0.0, 0.0), "upper": (0.2, 0.2), "material": "water"}
    built = Scene(
        **disc(
            material={},
            scene=[
                {"material": materials[0], "name": "soft"},
                {"material": materials[1] | water, "gravity": (0, -1), "body": [pool]},
            ],
        )
    ).build("cpu")
    assert built.scenes == ["soft", "scene 1"]
    assert [(m.name, m.scene) for m in built.materials] == [("jelly", 0), ("jelly", 1), ("water", 1)]
    elastic, fluid = built.step.law.laws
    assert elastic.E.tolist() == [1e4, 2e4] and float(fluid.bulk_modulus) == 1e5
    torch.testing.assert_close(built.step.gravity, torch.tensor([[0.0, -10.0], [0.0, -1.0]]))
    counts = [int(((built.material == m) & (built.state.scene == s)).sum()) for m, s in ((0, 0), (1, 1), (2, 1))]
    assert counts[0] == counts[1] and counts[2] == 11 * 11
    assert sum(counts) == len(built.state)


# ---- nothing is seeded that cannot be


BALL = {"shape": "sphere", "center": (0.5, 0.5), "radius": 0.2, "material": "jelly"}
NOZZLE = {"center": (0.5, 0.9), "radius": 0.05, "velocity": (1.0, 0.0), "material": "jelly"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"body": [{**BOX, "upper": (9.5, 9.5)}]}, "body[0]: reaches from [0.1, 0.1] to [9.5, 9.5], outside the domain"),
        ({"body": [{**BOX, "upper": (1e30, 1e30)}]}, "body[0]: reaches from"),
        ({"body": [{**BALL, "radius": 1e30}]}, "body[0]: reaches from"),
        ({"body": [{**BALL, "radius": 1e200}]}, "body[0]: reaches from"),
        ({"body": [{**BALL, "per_cell": 1e9}]}, "body[0].per_cell: about 5.03e+10 of the"),
        ({"body": [BALL, {**BOX, "per_cell": 1e9}]}, "body[1].per_cell: about 1.6e+10 of the"),
        ({"body": [{**BALL, "seeding": "poisson", "per_cell": 1e9}]}, "body[0].per_cell: about"),
        ({"grid__dx": 1e-9}, "grid: the grid has"),
        ({"grid__dx": 1e-300}, "grid.dx: the domain has 1e+300 nodes along an axis"),
        ({"grid__lower": (-1e308, 0), "grid__upper": (1e308, 1)}, "grid.dx: the domain has inf nodes"),
        ({"emitter": [{**NOZZLE, "radius": 1e30}]}, "emitter[0]: the nozzle is outside the domain"),
        ({"emitter": [{**NOZZLE, "per_cell": 1e12}]}, "emitter[0].per_cell: about"),
        ({"emitter": [{**NOZZLE, "velocity": (1e12, 0.0)}]}, "emitter[0].per_cell: about"),
        ({"duration": 1e300, "fps": 1e300}, "duration: inf frames are too many"),
        ({"heat": {"face": [{"lower": (0, 0), "upper": (1e30, 0), "flux": 1.0}]}}, "heat.face[0]: is outside the domain"),
    ],
)  # fmt: skip
def test_sizes_are_checked_before_a_particle_is_seeded(words, message, monkeypatch):
    lattice = mpm.seed._lattice

    def small(lower, upper, spacing):
        assert float(((upper - lower) / spacing).prod()) < 1e4
        return lattice(lower, upper, spacing)

    monkeypatch.setattr(mpm.seed, "_lattice", small)
    monkeypatch.delattr(mpm.seed, "_poisson_disk")
    with pytest.raises(SceneError) as error:
        Scene(**disc(**words)).build()
    assert any(problem.startswith(message) for problem in error.value.problems), str(error.value)


def test_files_of_bodies_are_named_with_their_key(tmp_path):
    pytest.importorskip("trimesh")
    (tmp_path / "folder.obj").mkdir()
    (tmp_path / "text.obj").write_text("this is no mesh")
    (tmp_path / "bad.stl").write_bytes(bytes(range(100)))
    np.save(tmp_path / "words.npy", np.array(["a", "b"]))
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04")
    header = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (4000000000000, 3), }"
    (tmp_path / "huge.npy").write_bytes(header.ljust(127) + b"\n")
    grid = {"lower": (0, 0, 0), "upper": (1, 1, 1), "dx": 0.2}
    files = {"none.obj": "does not exist", "folder.obj": "is a folder", "text.obj": "text.obj", "bad.stl": "bad.stl"}
    files |= {"words.npy": "cannot be read", "cut.npz": "cannot be read", "huge.npy": "cannot be read"}
    bodies = [
        {"shape": "points" if ".np" in name else "mesh", "file": name, "material": "jelly", "volume": 1.0}
        for name in files
    ]
    for body in bodies:
        if body["shape"] == "mesh":
            del body["volume"]
    scene = Scene.from_words(disc(grid=grid, gravity=None, body=bodies), folder=tmp_path, source="scene.toml")
    with pytest.raises(SceneError) as error:
        scene.build()
    for (k, (name, message)), line in zip(enumerate(files.items()), sorted(error.value.problems), strict=True):
        assert line.startswith(f"body[{k}]") and name in line and message in line
    assert str(error.value).count("scene.toml: body[") == len(files)
    with pytest.raises(SceneError, match=r"scene.toml: body\[0\].file: mesh file .*none.obj does not exist"):
        scene.fingerprint()


def test_all_mistakes_of_both_stages_at_once(tmp_path):
    path = tmp_path / "scene.toml"
    text = FILE.format(duration=1).replace("fps", "fsp").replace("[0.8, 0.7]", "[0.8, 7.0]")
    text += "[[body]]\nshape = 'sphere'\ncenter = [0.5, 0.5, 0.5]\nradius = 0.1\nmaterial = 'jelly'\n"
    text += "[[body]]\nshape = 'sphere'\ncenter = [0.5, 0.5]\nradius = -1\nmaterial = 'jelly'\n"
    text += "[[body]]\nshape = 'points'\nfile = 'none.npy'\nmaterial = 'jely'\n"
    path.write_text(text)
    with pytest.raises(SceneError) as error:
        Scene.load(path)
    lines = [
        "fsp: unknown key; did you mean 'fps'?",
        "body[2].radius: should be greater than 0",
        "body[3].material: there is no material 'jely'",
        "body[1].center: must have 2 numbers",
        "emitter[0]: the nozzle is outside the domain",
        "body[3].file: points file",
    ]
    assert len(error.value.problems) == len(lines), str(error.value)
    for line in lines:
        assert f"{path}: {line}" in str(error.value)


@pytest.mark.parametrize("key", ["grid", "duration", "fps", "material", "body", "gravity", "heat", "emitter"])
@pytest.mark.parametrize("value", [None, "x", [], {}, [{}], -1.0])
def test_what_cannot_be_read_is_not_judged(key, value):
    words = disc(**{"emitter": [NOZZLE], "grvity": 1, key: value})
    if value is None:
        del words[key]
    with pytest.raises(SceneError, match="grvity: unknown key"):
        Scene(**words)


def test_overlaps_show_beside_other_mistakes():
    bodies = [BOX, {**BOX, "lower": (0.2, 0.2), "upper": (0.5, 0.5)}, {**BALL, "center": (3.0, 3.0)}]
    with pytest.raises(SceneError) as error:
        Scene(**disc(body=bodies)).build()
    assert [problem[:20] for problem in error.value.problems] == ["body[2]: reaches fro", "body[0]: overlaps bo"]


def test_a_missing_material_is_not_reported_twice():
    words = disc(material={"jelly": {"law": "neo_hookean", "E": 1.0, "nu": 0.7}})
    with pytest.raises(SceneError) as error:
        Scene(**words)
    assert len(error.value.problems) == 1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((float("nan"), 0.0), "gravity[0]: should be a finite number, got nan"),
        (("a", 1.0), "gravity[0]: should be a valid number"),
        ((1.0,), "gravity: should have at least 2 entries, not 1, got (1.0,)"),
        ((1.0,) * 4, "gravity: should have at most 3 entries, not 4, got"),
    ],
)
def test_invalid_entries_are_not_missing_ones(given, message):
    grid = {"lower": (0, 0), "upper": (1, 1), "dx": 0.1}
    with pytest.raises(ValueError) as error:
        mpm.Scene(grid=grid, gravity=given, duration=1.0)
    lines = [line for line in str(error.value).splitlines() if "gravity" in line]
    assert message in lines[0] and not any("item" in line for line in lines)
    assert not any("entries" in line for line in lines[1:])
