"""Faces with many corners: what triangles cover of polygons that are not convex, in all formats that have them."""

import struct

import numpy as np
import pytest
import torch

from torch_mpm.geometry import shapes
from torch_mpm.meshes.polygons import triangulated

pytest.importorskip("trimesh")

OUTLINE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
"""An L; its corner at (1, 1) is the only one that sees all others."""
CORNERS = [(x, y, z) for z in (0.0, 1.0) for x, y in OUTLINE]
FACES = [[5, 4, 3, 2, 1, 0], [6, 7, 8, 9, 10, 11], *([k, (k + 1) % 6, 6 + (k + 1) % 6, 6 + k] for k in range(6))]
DISTANCES = {
    (1.5, 1.5, 0.5): 0.5,
    (1.5, 1.5, 1.0): 0.5,
    (1.6, 1.3, 0.0): 0.3,
    (0.5, 0.5, 0.9): -0.1,
    (1, 0.5, 1.25): 0.25,
}


def obj(path, faces):
    lines = [*("v {} {} {}".format(*v) for v in CORNERS), *("f " + " ".join(f"{k + 1}//1" for k in f) for f in faces)]
    path.write_text("\n".join(lines))


def off(path, faces):
    lines = ["OFF", f"# a comment\n{len(CORNERS)} {len(faces)} 0", *("{} {} {}".format(*v) for v in CORNERS)]
    path.write_text("\n".join([*lines, *(f"{len(f)} {' '.join(map(str, f))} 0.5 0.5 0.5" for f in faces)]))


def ply(order):
    """Writer of .ply with other properties and elements, as modelling programs have them."""

    def write(path, faces):
        form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
        lines = ["ply", f"format {form} 1.0", "comment a cube", f"element vertex {len(CORNERS)}"]
        lines += ["property float x", "property float y", "property double z", "property uchar red"]
        lines += [f"element face {len(faces)}", "property uchar flags", "property list uchar int vertex_index"]
        lines += ["property list uchar float texcoord", "element edge 1", "property int vertex1", "end_header", ""]
        if order:
            rows = [struct.pack(order + "ffdB", *v, 9) for v in CORNERS]
            rows += [struct.pack(f"{order}BB{len(f)}iB2f", 1, len(f), *f, 2, 0.5, 0.25) for f in faces]
            data = b"".join([*rows, struct.pack(order + "i", 0)])
        else:
            texts = ["{} {} {} 9".format(*v) for v in CORNERS]
            texts += [f"1 {len(f)} {' '.join(map(str, f))} 2 0.5 0.25" for f in faces]
            data = "\n".join([*texts, "0"]).encode()
        path.write_bytes("\n".join(lines).encode() + data)

    return write


FORMATS = {"l.obj": obj, "l.off": off, "ascii.ply": ply(""), "little.ply": ply("<"), "big.ply": ply(">")}


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("name", FORMATS)
def test_distances_from_a_face_that_is_not_convex(name, first, tmp_path):
    """Fans about the other corners cover places outside of the L."""
    FORMATS[name](tmp_path / name, [face[first % len(face) :] + face[: first % len(face)] for face in FACES])
    mesh = shapes.Mesh(tmp_path / name)
    x = torch.tensor(list(DISTANCES), dtype=torch.float64)
    expected = torch.tensor(list(DISTANCES.values()), dtype=torch.float64)
    torch.testing.assert_close(mesh.surface(x)[0], expected, rtol=0, atol=1e-12)
    assert mesh.volume(3) == pytest.approx(3.0, rel=1e-12) and mesh.changes == ()


def star(count, seed):
    """A polygon around a point, with random radii."""
    radius = np.random.default_rng(seed).uniform(0.1, 1.0, count)
    angle = np.arange(count) * 2 * np.pi / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)


def spiral(count):
    angle = np.linspace(0.0, 6 * np.pi, count)
    arm = np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.concatenate([(1 + angle)[:, None] * arm, ((2 + angle)[:, None] * arm)[::-1]])[::-1]


RING = np.array([(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)], dtype=float)
"""A square with a square hole, to which an edge leads there and back."""
ARROW = np.array([(0, 0), (2, 1), (0, 2), (1, 1)], dtype=float)
OUTLINES = {"arrow": ARROW, "ring": RING, "spiral": spiral(40), "L": np.array(OUTLINE, dtype=float)}
OUTLINES |= {f"star {count} {seed}": star(count, seed) for count in (5, 12, 60) for seed in range(4)}


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", OUTLINES)
def test_polygons_are_covered_once(name, turned):
    """No triangle is turned over, and together they have the area of the polygon, by the shoelace formula."""
    outline = OUTLINES[name][::-1] if turned else OUTLINES[name]
    (x, y), (u, v) = outline.T, np.roll(outline, -1, axis=0).T
    area = 0.5 * float((x * v - u * y).sum())
    plane = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    plane *= np.sign(np.linalg.det(plane))
    corners = np.concatenate([outline, 0 * outline[:, :1]], 1) @ plane.T + 5.0
    sizes, order = np.array([2, len(outline), 3]), np.arange(len(outline))
    faces = triangulated(corners, np.concatenate([[0, 1], order, [0, 1, 2]]), sizes)
    assert len(faces) == len(outline) - 1 and faces[-1].tolist() == [0, 1, 2]
    a, b, c = np.moveaxis(corners[faces[:-1]], 1, 0)
    areas = 0.5 * np.cross(b - a, c - a) @ plane[:, 2]
    np.testing.assert_allclose([areas.sum(), np.abs(areas).sum()], [area, abs(area)], rtol=1e-9)


SMALL = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = b"element face 1\nproperty list uchar int vertex_index\nend_header\n"
WRONG = {
    "no end": ("a.ply", b"ply\nformat ascii 1.0\n", "end_header"),
    "too many rows": ("a.ply", SMALL.replace(b"3", b"99999999999") + FACE, "99999999999 rows"),
    "long list": ("a.ply", SMALL + FACE + b"0 0 0\n1 0 0\n0 1 0\n200 0 1 2", "does not fit"),
    "unknown vertex": ("a.ply", SMALL + FACE + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 3", "vertex 3"),
    "list of a negative length": (
        *("a.ply", SMALL.replace(b"ascii", b"binary_little_endian") + FACE.replace(b"uchar", b"char")),
        *(bytes(36) + b"\xff" + bytes(12), "does not fit"),
    ),
    "no faces": ("a.ply", SMALL + b"end_header\n0 0 0\n1 0 0\n0 1 0\n", "no triangles"),
    "few lines": ("a.off", b"OFF\n5 9 0\n0 0 0", "do not fit"),
    "short face": ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2", "fewer vertices"),
    "vertex outside": ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7", "outside of 0 to 2"),
    "other text": ("a.off", b"solid\n3 1 0", "begin with OFF"),
}


@pytest.mark.parametrize("name", WRONG)
def test_damaged_files_are_errors_by_name(name, tmp_path):
    file, *data, words = WRONG[name]
    (tmp_path / file).write_bytes(b"".join(data))
    with pytest.raises(ValueError, match=words):
        shapes.Mesh(tmp_path / file)
