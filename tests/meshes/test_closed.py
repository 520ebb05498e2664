"""Mesh files of all forms that modelling programs write: what is merged, turned, refused, and the mass of bodies."""

import itertools
import re
import warnings

import numpy as np
import pytest
import torch

import torch_mpm as mpm
from torch_mpm.geometry import shapes
from torch_mpm.meshes import closed

trimesh = pytest.importorskip("trimesh")
from trimesh.creation import box, icosphere  # noqa: E402
from trimesh.transformations import translation_matrix as at  # noqa: E402

SIDE = 0.4
CORNERS = np.array(list(itertools.product((-0.2, 0.2), repeat=3)))
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def obj(path, form):
    """A cube of quads; `form` of the entries of a face, v, t and n for the indices of position, texture and normal."""
    lines = ["mtllib none.mtl", *("v {:.9g} {:.9g} {:.9g}".format(*v) for v in CORNERS)]
    lines += [f"vt {u} {v}" for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))]
    lines += [f"vn {s * (k == 0)} {s * (k == 1)} {s * (k == 2)}" for k in range(3) for s in (-1, 1)]
    for i, quad in enumerate(QUADS):
        lines.append("f " + " ".join(form.format(v=v + 1, t=t + 1, n=i + 1) for t, v in enumerate(quad)))
    path.write_text("\n".join(lines))
    return path


def flat(jitter=0.0):
    """A cube whose triangles share no vertex. Each vertex is displaced by up to `jitter` [m]."""
    cube = box((SIDE,) * 3)
    corners = cube.triangles.reshape(-1, 3) + np.random.default_rng(0).uniform(-jitter, jitter, (36, 3))
    return trimesh.Trimesh(
        corners, np.arange(36).reshape(-1, 3), process=False, vertex_normals=np.repeat(cube.face_normals, 3, 0)
    )


@pytest.mark.parametrize(
    "form", ["{v}", "{v}/{t}", "{v}//{n}", "{v}/{t}/{n}", "flat.glb", "flat.obj", "flat.stl", "flat.ply", "flat.off"]
)
def test_closed_cubes_of_all_files(form, tmp_path):
    """None of them is a hint that something is wrong, so that nothing warns."""
    path = obj(tmp_path / "cube.obj", form) if "{" in form else tmp_path / form
    if "{" not in form:
        flat().export(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        cube = shapes.Mesh(path, 2.0)
    assert cube.volume(3) == pytest.approx(8 * SIDE**3, rel=1e-6)
    x = 0.9 * (2 * torch.rand(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1)
    assert torch.equal(cube.contains(x), (x.abs() < SIDE).all(1))
    if form in ("flat.glb", "flat.obj"):
        assert re.fullmatch(r"\d+ vertices at positions of others were merged", cube.changes[0])


def two_cubes(corner):
    """Two cubes, the second of half the size, as two objects; `corner` of the index of a vertex and their number."""
    blocks = []
    for k, shift in enumerate((0.0, 1.0)):
        blocks += [f"o part{k}", *("v {:.9g} {:.9g} {:.9g}".format(*(v / (k + 1) + shift)) for v in CORNERS)]
        count = 8 * (k + 1)
        blocks += ["f " + " ".join(corner(8 * k + v + 1, count) for v in quad) for quad in QUADS]
    return "\n".join(blocks) + "\n"


OBJ_FORMS = {
    "positive": lambda text: text,
    "tabs": lambda text: text.replace(" ", "\t"),
    "indented": lambda text: "  " + text.replace("\n", " \n\t"),
    "remarks": lambda text: text.replace("\n", " # a vertex v 0 0 0\n"),
    "CR": lambda text: text.replace("\n", "\r"),
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "continued": lambda text: text.replace(" ", " \\\n"),
    "unused": lambda text: text + "v nan 1e30 0\nl 1 2\np 3\n",
    "last": lambda text: "".join(sorted(text.splitlines(True), key=lambda line: line[0])),  # Faces before vertices.
}


@pytest.mark.parametrize("index", ["positive", "negative", "negative/", "mixed"])
@pytest.mark.parametrize("form", OBJ_FORMS)
def test_indices_of_several_objects(form, index, tmp_path):
    """Negative indices count back from the latest vertex, not from the last one of the file."""
    if form == "last" and index != "positive":
        pytest.skip("negative indices stand below their vertices")
    corners = {
        "positive": lambda v, count: f"{v}",
        "negative": lambda v, count: f"{v - 1 - count}",
        "negative/": lambda v, count: f"{v - 1 - count}/-1/-1",
        "mixed": lambda v, count: f"{v if v % 2 else v - 1 - count}",
    }
    path = tmp_path / "two.obj"
    path.write_bytes(OBJ_FORMS[form](two_cubes(corners[index])).encode())
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        body = shapes.Mesh(path)
    assert body.volume(3) == pytest.approx(SIDE**3 * (1 + 1 / 8), rel=1e-6)
    x = torch.tensor([[0.15, 0.15, 0.15], [1.05, 1.05, 1.05], [1.15, 1.05, 1.05], [0.5, 0.5, 0.5]])
    assert body.contains(x.double()).tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    "line, message",
    [
        ("f 0 1 2", "line 1 is not a vertex or a face: 'f 0 1 2', there is no vertex 0"),
        ("f -1 -2 -3", "there is no vertex -1"),
        ("v 1,5 2 3", "line 1 .*could not convert"),
        ("v 1 2", "line 1 .*not enough values"),
        ("f 1 2 x", "line 1 .*invalid literal"),
        ("f 1 2 17", "a face has the vertex 17, and there are 16"),
    ],
)
def test_lines_of_objects_that_are_refused(line, message, tmp_path):
    path = tmp_path / "two.obj"
    path.write_text(line + "\n" + two_cubes(lambda v, count: f"{v}"))
    with pytest.raises(ValueError, match=message):
        shapes.Mesh(path)


def test_vertices_that_are_near_are_merged_and_reported():
    with pytest.warns(UserWarning, match=r"28 vertices on open edges within 6\.93e-06 m of others were merged"):
        cube = shapes.Mesh(flat(jitter=1e-6))
    assert cube.volume(3) == pytest.approx(SIDE**3, rel=1e-4)
    with pytest.raises(ValueError, match="is not closed: 36 of its edges"):
        shapes.Mesh(flat(jitter=1e-4))


def parts(*meshes):
    return trimesh.util.concatenate(meshes)


def inverted(mesh):
    mesh.invert()
    return mesh


def turned(mesh, *faces):
    """With some triangles inside out."""
    changed = mesh.faces.copy()
    changed[list(faces)] = changed[list(faces), ::-1]
    return trimesh.Trimesh(mesh.vertices, changed, process=False)


def cube(size, x=0.0):
    return box((size,) * 3, at((x, 0, 0)))


UNLIKE, TURNED = "parts overlap or are inside out one against another", "triangles that were inside out were turned"
BODIES = {
    "a cube": (lambda: cube(0.4), 64.0, None),
    "inside out": (lambda: inverted(cube(0.4)), 64.0, None),
    "two parts that overlap": (lambda: parts(cube(0.4), cube(0.4, 0.2)), 96.0, UNLIKE),
    "three parts that overlap": (lambda: parts(*(cube(0.4, 0.1 * k) for k in range(3))), 96.0, UNLIKE),
    "the same part twice": (lambda: parts(cube(0.4), cube(0.4)), 64.0, UNLIKE),
    "a part inside another": (lambda: parts(cube(0.4), cube(0.2)), 64.0, UNLIKE),
    "a cavity": (lambda: parts(cube(0.4), inverted(cube(0.2))), 56.0, None),
    "a cavity in a body inside out": (lambda: parts(inverted(cube(0.4)), cube(0.2)), 56.0, None),
    "two parts, one inside out": (lambda: parts(cube(0.2, -0.3), inverted(cube(0.2, 0.3))), 16.0, UNLIKE),
    "two parts, both inside out": (lambda: inverted(parts(cube(0.2, -0.3), cube(0.2, 0.3))), 16.0, None),
    "two parts that share an edge": (lambda: parts(cube(0.2, -0.1), box((0.2,) * 3, at((0.1, 0.2, 0)))), 16.0, None),
    "two parts that share a face": (lambda: parts(cube(0.2, -0.1), cube(0.2, 0.1)), 16.0, None),
    "one of twelve triangles turned": (lambda: turned(cube(0.4), 0), 64.0, TURNED),
    "five of twelve triangles turned": (lambda: turned(cube(0.4), 1, 4, 5, 7, 10), 64.0, TURNED),
    "a turned triangle in each part": (lambda: turned(parts(cube(0.2, -0.3), cube(0.2, 0.3)), 3, 17), 16.0, TURNED),
}


@pytest.mark.parametrize("name", BODIES)
def test_the_mass_is_that_of_the_filled_places(name):
    """Cubes with sides between points of the lattice, against a mass computed by hand."""
    make, right, message = BODIES[name]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        points = mpm.seed.mesh(make(), 0.05, per_cell=8, dtype=torch.float64)
    messages = [str(w.message) for w in caught if w.category is UserWarning]
    assert [bool(re.search(message or "none", line)) for line in messages] == [True] * (message is not None)
    mass = float(mpm.State.at_rest(points, density=1000.0).mass.sum())
    assert mass == pytest.approx(right, rel=2e-4)
    assert len(points) * 0.025**3 * 1000 == pytest.approx(right, rel=1e-9)


def test_overlapping_balls_have_the_volume_of_their_union():
    """V = 2 V(ball) - lens, by the volume of a lens of two equal balls, π (4 R + d) (2 R - d)² / 12."""
    radius = 0.3
    other = icosphere(4, radius)
    other.apply_translation((0.1, 0.2, 0.05))
    balls, distance = parts(icosphere(4, radius), other), float(np.linalg.norm((0.1, 0.2, 0.05)))
    lens = np.pi * (4 * radius + distance) * (2 * radius - distance) ** 2 / 12
    with pytest.warns(UserWarning, match=UNLIKE):
        volume = shapes.Mesh(balls).volume(3)
    assert volume == pytest.approx(8 / 3 * np.pi * radius**3 - lens, rel=2.5e-3)  # of flat triangles


def test_an_open_mesh_says_how_many_edges_and_where(tmp_path):
    ball = icosphere(
        2,
        0.3,
    )
    ball.update_faces(np.arange(len(ball.faces)) != 7)
    hole = icosphere(2, 0.3).triangles[7].mean(0)
    ball.export(tmp_path / "open.ply")
    with pytest.raises(ValueError, match=r"open\.ply is not closed: 3 of its edges do not join two triangles") as error:
        mpm.seed.mesh(tmp_path / "open.ply", 0.1)
    places = re.findall(r"\(([^()]*, [^()]*, [^()]*)\)", str(error.value))[:3]
    middle = np.mean([[float(a) for a in place.split(",")] for place in places], 0)
    np.testing.assert_allclose(middle, hole, atol=1e-6)
    ball.update_faces(np.arange(len(ball.faces)) > 9)
    with pytest.raises(ValueError, match=r"\d+ of its edges .* and elsewhere; close the holes"):
        shapes.Mesh(ball)


def test_a_wall_inside_a_mesh_is_open():
    """Edges of three triangles."""
    inner = trimesh.Trimesh(CORNERS, [(0, 1, 7), (0, 7, 6)], process=False)
    with pytest.raises(ValueError, match="is not closed"):
        shapes.Mesh(parts(trimesh.Trimesh(CORNERS, [t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))]), inner))


def test_a_one_sided_surface_is_refused():
    """A Klein bottle, closed and without an outside."""
    n = 12
    u, v = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")

    def index(i, j):  # the second direction is joined the other way round
        wrapped = i // n
        return (i % n) * n + np.where(wrapped, -j, j) % n

    a, b, c, d = index(u, v), index(u + 1, v), index(u + 1, v + 1), index(u, v + 1)
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    bottle = trimesh.Trimesh(np.random.default_rng(0).random((n * n, 3)), faces, process=False)
    with pytest.raises(ValueError, match=r"have no common outside: .* it is one-sided"):
        closed.load(bottle)


def test_files_that_a_mesh_file_names_are_regular(tmp_path):
    import json
    import os

    flat().export(tmp_path / "cube.gltf")
    (name,) = (b["uri"] for b in json.loads((tmp_path / "cube.gltf").read_text())["buffers"][:1])
    os.remove(tmp_path / name)
    os.mkfifo(tmp_path / name)
    with pytest.raises(ValueError, match="is a pipe, not a regular file"):
        shapes.Mesh(tmp_path / "cube.gltf")


def test_a_mesh_whose_vertices_change_is_looked_up_anew():
    """In place, by assignment and through NumPy."""
    cube = shapes.Mesh(box((0.4,) * 3))
    x = torch.tensor([[0.25, 0.0, 0.0]], dtype=torch.float64)
    assert not cube.contains(x)
    cube.vertices.mul_(2)
    assert cube.contains(x) and cube.volume(3) == pytest.approx(0.512)
    assert float(cube.signed_distance(x)) == pytest.approx(-0.15)
    cube.vertices = cube.vertices * 0.5
    assert not cube.contains(x)
    cube.vertices.numpy()[:] *= 2
    assert cube.contains(x)


# ---- files and triangles with faults of their writers


@pytest.mark.parametrize("first", ["", "# a comment\n"])
@pytest.mark.parametrize("suffix", [".obj", ".OBJ"])
def test_a_byte_order_mark_hides_no_vertex(suffix, first, tmp_path):
    """An unused vertex at the end would hide that all indices are shifted."""
    mesh, path = cube(0.4), tmp_path / f"cube{suffix}"
    lines = [f"v {x} {y} {z}" for x, y, z in [*mesh.vertices.tolist(), (0.0, 0.0, 0.0)]]
    lines += ["f {} {} {}".format(*(face + 1)) for face in mesh.faces]
    path.write_bytes(b"\xef\xbb\xbf" + (first + "\n".join(lines)).encode())
    assert shapes.Mesh(path).volume(3) == pytest.approx(0.064)


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize("again", [1, 3, 11])
def test_triangles_that_are_listed_again(again, turn):
    mesh = cube(0.4)
    faces = np.concatenate([mesh.faces, mesh.faces[:again, ::turn]])
    with pytest.warns(UserWarning, match=f"{again} triangles that were listed again were left out"):
        shape = shapes.Mesh(trimesh.Trimesh(mesh.vertices, faces, process=False))
    assert shape.volume(3) == pytest.approx(0.064) and len(shape.faces) == 12


@pytest.mark.parametrize("mesh", [cube(0.4), icosphere(2, 0.3), trimesh.creation.torus(0.3, 0.1)], ids=str)
def test_parts_that_cancel_enclose_nothing(mesh):
    mesh = mesh.copy()
    mesh.apply_translation((0.5, 0.31, 0.2))
    both = parts(mesh, inverted(mesh.copy()))
    with pytest.raises(ValueError, match="encloses no volume: its winding number is zero everywhere"):
        mpm.seed.mesh(both, mpm.Grid(0.05, (-1,) * 3, (1,) * 3))


@pytest.mark.parametrize("source", [([[0.0, 0.0, 0.0]], [[0, 0, 0]]), 3, b"cube.obj", None, np.zeros((3, 3))])
def test_sources_of_another_type(source):
    message = "source must be the path of a mesh file or a trimesh.Trimesh, got "
    for make in (shapes.Mesh, lambda v: mpm.seed.mesh(v, 0.1), closed.load):
        with pytest.raises(TypeError, match=message):
            make(source)
