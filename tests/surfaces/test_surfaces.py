"""Surfaces of particles: volume, velocity and normals against exact values, their files, and wrong inputs."""

import json
import shutil
import sys

import numpy as np
import pytest
from cases.small_run import small_run
from helpers import FILE

for package in ("pysplashsurf", "scipy", "trimesh", "meshio", "h5py", "pydantic"):
    pytest.importorskip(package)

import meshio  # noqa: E402
import trimesh  # noqa: E402

from torch_mpm import Trajectory, surfaces  # noqa: E402
from torch_mpm.cli import main  # noqa: E402
from torch_mpm.scene import pictures  # noqa: E402
from torch_mpm.scene import surfaces as run_surfaces  # noqa: E402
from torch_mpm.scene.folder import load_run  # noqa: E402
from torch_mpm.surfaces import files  # noqa: E402

SAND = """
duration = 0.01
fps = 100
device = "cpu"
grid = { lower = [0.0, 0.0, 0.0], upper = [1.0, 1.0, 1.0], dx = 0.1 }
material.sand = { law = "quartic_sand", E = 1e5 }
body = [{ shape = "box", lower = [0.1, 0.1, 0.1], upper = [0.3, 0.3, 0.3], material = "sand" }]
render = { surface = true, resolution = [64, 48], video = false }
"""

SPACING, RADIUS = 0.02, 0.3
CENTRE = np.array([0.4, -0.2, 0.7])


def ball(dtype=np.float32, jitter=0.5, offset=CENTRE, radius=RADIUS):
    """Jittered lattice of particles in a ball."""
    axis = np.arange(-radius - SPACING / 2, radius + SPACING, SPACING) + 0.13 * SPACING
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    x = x[np.linalg.norm(x, axis=1) < radius]
    x += jitter * SPACING * np.random.default_rng(0).uniform(-0.5, 0.5, x.shape)
    return (x + offset).astype(dtype)


def mesh_of(surface):
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return small_run(tmp_path_factory.mktemp("run"))


@pytest.fixture
def copied(run, tmp_path):
    return shutil.copytree(run, tmp_path / "run")


# ---- the mesh


@pytest.mark.parametrize("jitter", [0.0, 0.5, 0.8])
@pytest.mark.parametrize(("spacings", "dx"), [(10, 2 * SPACING), (15, 1.5 * SPACING), (15, 2 * SPACING)])
def test_volume_of_a_ball(jitter, spacings, dx):
    """To 3%, closed, and every vertex within half a spacing of the sphere."""
    radius = spacings * SPACING
    surface = surfaces.reconstruct(ball(jitter=jitter, radius=radius), SPACING, dx)
    mesh = mesh_of(surface)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.03)
    assert np.abs(np.linalg.norm(surface.vertices - CENTRE, axis=1) - radius).max() < 0.5 * SPACING


def test_normals_point_outward():
    surface = surfaces.reconstruct(ball(), SPACING, 2 * SPACING)
    outward = (surface.vertices - CENTRE) / np.linalg.norm(surface.vertices - CENTRE, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-5)
    assert (surface.normals * outward).sum(1).min() > np.cos(np.radians(15))
    assert (mesh_of(surface).vertex_normals * surface.normals).sum(1).min() > 0.9  # the winding of the triangles


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_velocity_of_a_rigid_rotation(dtype):
    """The linear interpolation is exact for it, although all particles are on one side of the surface."""
    x = ball(dtype)
    surface = surfaces.reconstruct(x, SPACING, 2 * SPACING)
    omega, shift = np.array([1.0, -2.0, 3.0]), np.array([5.0, 0.0, -1.0])
    expected = np.cross(omega, surface.vertices - CENTRE) + shift
    found = surfaces.Interpolation(x, surface.vertices, 3 * SPACING)
    speed = RADIUS * np.linalg.norm(omega)
    velocity = (np.cross(omega, x - CENTRE) + shift).astype(dtype)
    assert np.abs(found.linear(velocity) - expected).max() < 1e-3 * speed
    assert np.abs(found.mean(velocity) - expected).max() > 0.02 * speed  # which the mean is not


def test_interpolation_keeps_constants_and_the_range():
    x = ball(np.float64)
    points = surfaces.reconstruct(x, SPACING, 2 * SPACING).vertices
    found = surfaces.Interpolation(x, points, 3 * SPACING)
    values = np.random.default_rng(1).random((len(x), 2, 2))
    assert found.mean(values).shape == (len(points), 2, 2)
    assert values.min() <= found.mean(values).min() and found.mean(values).max() <= values.max()
    np.testing.assert_allclose(found.linear(np.full((len(x), 1), 7.0)), 7, rtol=1e-12)
    nearest = np.argmin(np.linalg.norm(x[None] - points[:50, None], axis=2), axis=1)
    np.testing.assert_array_equal(found.nearest(np.arange(len(x)))[:50], nearest)


@pytest.mark.parametrize("count", [1, 2, 3, 20])
def test_few_particles_on_a_line(count):
    """Their neighbours spread in one direction at most, in which the velocity is linear."""
    x = np.zeros((count, 3))
    x[:, 0] = SPACING * np.arange(count)
    surface = surfaces.reconstruct(x, SPACING, 2 * SPACING)
    velocity = surfaces.Interpolation(x, surface.vertices, 3 * SPACING).linear(10 * x + 1)
    assert len(surface.faces) and np.isfinite(velocity).all()
    assert np.abs(velocity[:, 1:] - 1).max() < 1e-9 and velocity[:, 0].max() < 10 * SPACING * count + 1


def test_surface_far_from_zero():
    """Positions in map coordinates: the mesh is that near zero, to the rounding of float32 near zero."""
    offset = np.array([5e5, 4e6, 100.0])
    near = surfaces.reconstruct(ball(np.float64, offset=0), SPACING, 2 * SPACING)
    far = surfaces.reconstruct(ball(np.float64, offset=offset), SPACING, 2 * SPACING)
    assert far.vertices.dtype == np.float64
    assert mesh_of(far).volume == pytest.approx(mesh_of(near).volume, rel=1e-4)


def test_no_particles_have_an_empty_surface():
    surface = surfaces.reconstruct(np.zeros((0, 3), np.float32), SPACING, 2 * SPACING)
    assert [a.shape for a in surface] == [(0, 3)] * 3
    found = surfaces.Interpolation(ball(), surface.vertices, 3 * SPACING)
    assert found.mean(np.zeros((len(ball()), 2, 2))).shape == (0, 2, 2)
    assert found.linear(np.zeros((len(ball()), 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("x", "options", "message"),
    [
        (np.zeros((4, 2)), {}, r"x must have shape \[P, 3\], got \[4, 2\]; a surface needs three dimensions"),
        (np.full((4, 3), np.nan), {}, "x must be finite, got 4 particles that are not"),
        (np.array([[0, 0, 0], [1e7, 1e7, 1e7]]), {}, "pysplashsurf finds no surface of 2 particles"),
        (np.zeros((4, 3)), {"cube_size": 1.0}, r"cube_size must be within .* got 1 m"),
        (np.zeros((4, 3)), {"cube_size": 1e-9}, r"cube_size must be within .* got 1e-09 m"),
        (np.zeros((4, 3)), {"smoothing_length": 1.0}, r"smoothing_length must be within 0.01 m and 0.08 m"),
    ],
)
def test_particles_without_a_surface(x, options, message):
    with pytest.raises(ValueError, match=message):
        surfaces.reconstruct(x, SPACING, 2 * SPACING, surfaces.SurfaceOptions(**options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"smoothing_length": 0.0}, "smoothing_length must be positive and finite, got 0.0"),
        ({"cube_size": np.inf}, "cube_size must be positive and finite, got inf"),
        ({"iso_threshold": 1.0}, "iso_threshold must be within 0.05 and 0.95, got 1.0"),
        ({"smoothing": -1}, "smoothing must not be negative, got -1"),
        ({"smoothing": 101}, "smoothing must be at most 100, got 101"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        surfaces.SurfaceOptions(**options)


def test_options_act():
    volume = {
        name: mesh_of(surfaces.reconstruct(ball(), SPACING, 2 * SPACING, surfaces.SurfaceOptions(**words))).volume
        for name, words in {"plain": {}, "larger": {"iso_threshold": 0.4}, "shrunk": {"smoothing": 50}}.items()
    }
    assert volume["larger"] > 1.05 * volume["plain"] and volume["shrunk"] < 0.99 * volume["plain"]
    fine = surfaces.reconstruct(ball(), SPACING, 2 * SPACING, surfaces.SurfaceOptions(cube_size=0.5 * SPACING))
    assert len(fine.faces) > 1.8 * len(surfaces.reconstruct(ball(), SPACING, 2 * SPACING).faces)


# ---- files


@pytest.mark.parametrize("name", ["ply", "obj", "vtp"])
def test_a_file_is_read_back(tmp_path, name):
    surface = surfaces.reconstruct(ball(radius=0.1), SPACING, 2 * SPACING)
    velocity = np.random.default_rng(0).random(surface.vertices.shape, np.float32)
    path = tmp_path / f"a.{name}"
    if name == "vtp":
        pytest.importorskip("vtkmodules")
    files.write_surface(path, surface, velocity)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    if name == "vtp":
        vertices, faces, normals, read = read_vtp(path)
    else:
        mesh = trimesh.load(path, process=False)
        vertices, faces, normals = mesh.vertices, mesh.faces, mesh.vertex_normals
        read = velocity
    if name == "ply":
        data = meshio.read(path).point_data
        read = np.stack([data["vx"], data["vy"], data["vz"]], 1)
        normals = np.stack([data["nx"], data["ny"], data["nz"]], 1)
    order = np.lexsort(vertices.T.round(5)), np.lexsort(surface.vertices.T.round(5))
    np.testing.assert_allclose(vertices[order[0]], surface.vertices[order[1]], atol=2e-5)
    np.testing.assert_allclose(normals[order[0]], surface.normals[order[1]], atol=1e-4)
    np.testing.assert_array_equal(read, velocity)
    read_mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert read_mesh.volume == pytest.approx(mesh_of(surface).volume, rel=1e-5)


def read_vtp(path):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    body = reader.GetOutput()
    arrays = [body.GetPointData().GetArray(name) for name in ("Normals", "velocity")]
    faces = vtk_to_numpy(body.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return vtk_to_numpy(body.GetPoints().GetData()), faces, *(vtk_to_numpy(a) for a in arrays)


@pytest.mark.parametrize("name", ["ply", "obj", "vtp"])
def test_a_failed_file_leaves_nothing(tmp_path, monkeypatch, name):
    surface = surfaces.reconstruct(ball(radius=0.1), SPACING, 2 * SPACING)
    writer = files.WRITERS[name]

    def interrupted(path, *rest):
        writer(path, *rest)
        raise KeyboardInterrupt

    monkeypatch.setitem(files.WRITERS, name, interrupted)
    with pytest.raises(KeyboardInterrupt):
        files.write_surface(tmp_path / f"a.{name}", surface, surface.vertices)
    assert list(tmp_path.iterdir()) == []


# ---- runs


def test_surfaces_of_a_run(run, tmp_path, capsys):
    """One for each material, without sand unless it is named; the jet begins in the last frames."""
    out = tmp_path / "out"
    assert main(["surface", str(run), "-o", str(out), "--format", "ply", "--format", "vtp", "--every", "2"]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    names = {f"rubber_{k:05d}.{name}" for k in (0, 2) for name in ("ply", "vtp")}
    assert {p.name for p in out.iterdir()} == {*names, "run.pvd"}
    text = (out / "run.pvd").read_text()
    assert 'timestep="0.02" file="rubber_00002.vtp"' in text and "rubber_00001" not in text
    first, last = (trimesh.load(out / f"rubber_{k:05d}.ply", process=False) for k in (0, 2))
    assert first.volume == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=0.05)
    assert len(first.split()) == 1 and len(last.split()) == 2
    data = meshio.read(out / "rubber_00000.ply")
    expected = np.cross([0, 2, 1], data.points - [0.4, 0.5, 0.4])
    found = np.stack([data.point_data[f"v{axis}"] for axis in "xyz"], 1)
    assert np.abs(found - expected).max() < 0.01
    assert main(["surface", str(run), "-o", str(tmp_path / "sand"), "--material", "sand", "--quiet"]) == 0
    assert {p.name for p in (tmp_path / "sand").iterdir()} == {f"sand_{k:05d}.ply" for k in range(3)}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"formats": ["stl"]}, "the format must be one of ply, obj, vtp, got 'stl'"),
        ({"every": 0}, "every must be at least 1, got 0"),
    ],
)
def test_wrong_arguments_of_an_export(run, tmp_path, words, message):
    with pytest.raises(ValueError, match=message):
        surfaces.export_surfaces(run, tmp_path / "out", **words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("frame", [0, 1])
def test_an_interrupted_export_leaves_whole_files(run, tmp_path, monkeypatch, frame):
    write = run_surfaces.write_surface

    def interrupted(path, *rest):
        if f"{frame:05d}" in path.name:
            raise KeyboardInterrupt
        write(path, *rest)

    monkeypatch.setattr(run_surfaces, "write_surface", interrupted)
    with pytest.raises(KeyboardInterrupt):
        surfaces.export_surfaces(run, tmp_path / "out")
    assert [p.name for p in tmp_path.rglob("*")] == (["out", "rubber_00000.ply"] if frame else [])


def test_surfaces_of_a_batch_have_the_names_of_their_scenes(tmp_path):
    text = '[[scene]]\nname = "one/a"\n[[scene]]\nname = "two"\n[[scene]]\nname = "one a"\n'
    run = small_run(tmp_path, "[0.0, -9.8, 0.0]", text)
    with Trajectory(run) as trajectory:
        groups = run_surfaces.RunSurfaces(load_run(run), trajectory).groups
        assert [(g.name, g.scene) for g in groups] == [("one_a_rubber_0", 0), ("two_rubber", 1), ("one_a_rubber_4", 2)]


def test_pictures_of_surfaces(run, tmp_path, monkeypatch):
    """The surface covers the particles of its material; sand is drawn as particles, and categories have their
    colours.
    """
    pytest.importorskip("vtkmodules")
    pytest.importorskip("matplotlib")
    from torch_mpm.render import renderer

    monkeypatch.setattr(renderer, "_choose", lambda backend: "software")
    seen = {}
    for key in ("surface=true", "surface=false"):
        scene = load_run(run, [f"render.{key}", "render.color_by=material", "render.resolution=[320, 180]"])
        with Trajectory(run) as trajectory:
            artist = pictures._Artist(scene, scene.render, trajectory)
            seen[key] = artist.picture(trajectory.frame(0)).astype(int)
    blue = {key: picture[..., 2] > picture[..., 0] + 60 for key, picture in seen.items()}
    assert blue["surface=true"].sum() == pytest.approx(blue["surface=false"].sum(), rel=0.1)
    rough = {key: np.abs(np.diff(seen[key], axis=0))[blue[key][1:]].mean() for key in seen}
    assert rough["surface=true"] < 0.6 * rough["surface=false"]  # smooth, in place of spheres
    orange = {key: picture[..., 0] > picture[..., 2] + 60 for key, picture in seen.items()}
    assert (orange["surface=true"] == orange["surface=false"]).mean() > 0.995


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--cube-size nan", "--cube-size must be positive and finite, got nan"),
        ("--iso-threshold 2", "--iso-threshold must be within 0.05 and 0.95, got 2.0"),
        ("--smoothing -1", "--smoothing must not be negative, got -1"),
        ("--smoothing-length 9", "smoothing_length must be within"),
        ("--material snow", "materials are rubber, sand, got 'snow'"),
    ],
)
def test_wrong_options_of_the_command(run, tmp_path, capsys, words, message):
    assert main(["surface", str(run), "-o", str(tmp_path / "out"), *words.split()]) == 1
    printed = capsys.readouterr().err
    assert message in printed and len(printed.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_run_in_two_dimensions_is_refused(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(FILE.format(duration=0.02))
    out = tmp_path / "out"
    assert main(["run", str(tmp_path / "scene.toml"), "-o", str(out), "--quiet"]) == 0
    assert main(["surface", str(out)]) == 1
    assert "a surface needs three dimensions; this run has 2" in capsys.readouterr().err
    assert main(["render", str(out), "--set", "render.surface=true"]) == 1
    assert "render.surface: a surface needs three dimensions" in capsys.readouterr().err


def test_two_styles_of_surfaces_are_refused(run, capsys):
    assert main(["render", str(run), "--set", "render.surface=true", "--set", "render.style=surface"]) == 1
    assert "render.surface: takes style = 'particles'" in capsys.readouterr().err


@pytest.mark.thorough
def test_surfaces_of_sand_alone_are_refused(tmp_path, capsys):
    path = tmp_path / "scene.toml"
    path.write_text(SAND)
    assert main(["check", str(path)]) == 1
    assert "render.surface: all materials are sand, which is drawn as particles" in capsys.readouterr().err
    words = ["--set", "render.surface=false", "--set", "render.every=9", "--quiet"]
    assert main(["run", str(path), "-o", str(tmp_path / "out"), *words]) == 0
    assert main(["surface", str(tmp_path / "out")]) == 1
    assert "all materials are sand (sand)" in capsys.readouterr().err


@pytest.mark.parametrize(("package", "words"), [("pysplashsurf", ""), ("meshio", ""), ("vtkmodules", "--format vtp")])
def test_a_missing_package_is_named(run, tmp_path, monkeypatch, capsys, package, words):
    monkeypatch.setitem(sys.modules, package, None)
    assert main(["surface", str(run), "-o", str(tmp_path / "out"), *words.split()]) == 1
    printed = capsys.readouterr().err
    assert "pip install torch-mpm[" in printed and len(printed.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_missing_package_is_noticed_before_the_simulation(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pysplashsurf", None)
    scene = str(run.parent / "scene.toml")
    arguments = ["run", scene, "-o", str(tmp_path / "out"), "--set", "render.surface=true", "--quiet"]
    assert main(arguments) == 1
    assert "pip install torch-mpm[surface]" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_hostile_folders(copied, tmp_path, capsys):
    """Links out of the folder, damaged frames, and the scene of another run."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (copied / "surface").symlink_to(elsewhere)
    assert main(["surface", str(copied)]) == 1
    assert "is a link to a place outside of" in capsys.readouterr().err and list(elsewhere.iterdir()) == []
    (copied / "surface").unlink()
    path = copied / "trajectory.h5"
    with Trajectory(copied) as trajectory:
        place = trajectory.file["position"].id.get_offset()
    data = path.read_bytes()
    path.write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
    assert main(["surface", str(copied), "--quiet"]) == 1
    assert "position of frame 0 is damaged" in capsys.readouterr().err and not (copied / "surface").exists()
    path.write_bytes(data)
    record = json.loads((copied / "run.json").read_text())
    record["scene"]["material"]["rubber"]["E"] = 3.0
    (copied / "run.json").write_text(json.dumps(record))
    assert main(["surface", str(copied)]) == 1
    assert "was changed: its checksum is wrong" in capsys.readouterr().err


def test_a_data_set_is_refused(tmp_path, capsys):
    import small_dataset

    folder = small_dataset.make_dataset(tmp_path / "set")
    assert main(["surface", str(folder)]) == 1
    assert "surface is for runs, and this is a data set" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        ({"x": ball().astype(int)}, TypeError, "x must be an array of float32 or float64, got int64"),
        ({"x": ball().astype(np.float16)}, TypeError, "x must be an array of float32 or float64, got float16"),
        ({"x": ball().tolist()}, TypeError, "x must be an array of float32 or float64, got list"),
        (
            {"x": np.array([[0.0, 0.0, 0.0], [1e9, 0.0, 0.0]])},
            ValueError,
            "the particles are spread over 6.67e.10 cubes",
        ),
        ({"spacing": 0.0}, ValueError, "spacing must be positive and finite, got 0"),
        ({"dx": -1.0}, ValueError, "dx must be positive and finite, got -1"),
        ({"options": {"smoothing": 3}}, TypeError, "options must be SurfaceOptions or None, got dict"),
    ],
)
def test_wrong_arguments_of_a_reconstruction(words, error, message):
    with pytest.raises(error, match=message):
        surfaces.reconstruct(**{"x": ball(), "spacing": SPACING, "dx": 2 * SPACING, **words})


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        ({"formats": "ply"}, TypeError, "formats must be a list of names, got str 'ply'"),
        ({"materials": "rubber"}, TypeError, "materials must be a list of names, got str 'rubber'"),
        ({"formats": []}, ValueError, "formats must have at least one of ply, obj, vtp, got none"),
    ],
)
def test_lists_of_names_of_an_export(run, tmp_path, words, error, message):
    with pytest.raises(error, match=message):
        surfaces.export_surfaces(run, tmp_path / "out", **words)
    assert list(tmp_path.iterdir()) == []
