"""Files of .stl as programs write them: numbers of triangles, bytes at the end, several solids."""

import struct

import numpy as np
import pytest
import torch

from torch_mpm.geometry import shapes

trimesh = pytest.importorskip("trimesh")

CUBE = trimesh.creation.box((0.4,) * 3).triangles


def binary(name=b"", declared=12, behind=b""):
    rows = [struct.pack("<12fH", 0, 0, 0, *corners.reshape(-1), 7) for corners in CUBE]
    return name.ljust(80) + struct.pack("<I", declared) + b"".join(rows) + behind


def text(solids=1, vertex="vertex"):
    lines = []
    for part in np.split(CUBE, solids):
        lines.append("solid of a program")
        for corners in part:
            lines += ["  facet normal 0 0 0", "    outer loop"]
            lines += [f"      {vertex} {x:e} {y:e} {z:e}" for x, y, z in corners]
            lines += ["    endloop", "  endfacet"]
        lines.append("endsolid")
    return "\r\n".join(lines).encode()


GOOD = {
    "binary": binary(),
    "named solid": binary(b"solid exported"),
    "bytes behind": binary(behind=b"a text of the program"),
    "one solid": text(),
    "three solids": text(3),
    "capitals": text(vertex="VERTEX"),
}


@pytest.mark.parametrize("name", GOOD)
def test_cubes(name, tmp_path):
    (tmp_path / "cube.stl").write_bytes(GOOD[name])
    cube = shapes.Mesh(tmp_path / "cube.stl")
    assert cube.volume(3) == pytest.approx(0.4**3, rel=1e-6)
    x = torch.tensor([[0.0, 0.0, 0.19], [0.0, 0.0, 0.3]], dtype=torch.float64)
    torch.testing.assert_close(cube.surface(x)[0], torch.tensor([-0.01, 0.1], dtype=torch.float64), rtol=0, atol=1e-7)


WRONG = {
    "too many": (binary(declared=13), "declares 13 triangles, and it has 12"),
    "far too many": (binary(declared=2**32 - 1), "declares 4294967295 triangles, and it has 12"),
    "none": (binary(declared=0), "declares 0 triangles, and it has 12"),
    "too few": (binary(declared=11), "not closed"),
    "cut off": (binary()[:-10], "declares 12 triangles, and it has 11"),
    "a vertex less": (text().replace(b"vertex", b"other", 1), "35 vertices, which is no multiple of 3"),
    "something else": (b"MZ", "neither a binary"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_errors_with_the_reason(name, tmp_path):
    data, words = WRONG[name]
    (tmp_path / "cube.stl").write_bytes(data)
    with pytest.raises(ValueError, match=words):
        shapes.Mesh(tmp_path / "cube.stl")
