"""Reading and repair of closed triangle meshes."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import optional
from ..errors import shape_of
from ..files import check_file
from ..geometry.surface_mesh import Array
from . import obj, off, ply, stl

MERGED = 1e-5
"""Distance within which vertices on open edges are merged, in diagonals of the mesh."""
READERS = {".obj": obj.read, ".off": off.read, ".ply": ply.read, ".stl": stl.read}
"""Readers by the ends of names. Those of trimesh make fans of polygons, which also cover places outside of them where
they are not convex; they count negative indices of an .obj from the last object of the file, and find no triangles in
an .stl whose header declares another number.
"""
NAMED = 3
"""Number of open edges whose positions a message lists."""


class ClosedMesh(NamedTuple):
    """Vertices float64 [V, 3], triangles int64 [T, 3] that traverse each edge equally often in both directions, and
    sentences on the repairs.
    """

    vertices: Array
    faces: Array
    changes: tuple[str, ...]


def load(source: str | Path | Any) -> ClosedMesh:
    """A closed mesh, from a file that trimesh reads (.obj, .ply, .stl, .glb, ...) or of a `trimesh.Trimesh`.

    Where it is open, vertices at the same position are merged, as files with textures or normals need; triangles that
    are listed again are left out; then vertices on open edges within `MERGED` of each other are merged. Where triangles
    of one part have opposite orientations, those with the smaller total area are reversed. All changes but the first,
    which is lossless, warn.

    Raises:
        ImportError: without trimesh, or without scipy for the last two changes.
        TypeError: for a source of another type.
        OSError: for a file that cannot be read.
        ValueError: for a file without triangles, coordinates that are not finite, or a mesh that is not closed.
    """
    vertices, faces = triangles(source)
    changes = []
    if len(_open_edges(faces)):
        vertices, faces, merged = merged_equal(vertices, faces)
        changes += [f"{merged} vertices at positions of others were merged"] if merged else []
    if len(_open_edges(faces)):
        faces, again = _without_repetitions(faces)
        if again:
            changes.append(f"{again} triangles that were listed again were left out")
            _warn(source, changes[-1])
    if len(_open_edges(faces)):
        vertices, faces, merged, distance = _merged_near(vertices, faces)
        if merged:
            changes.append(f"{merged} vertices on open edges within {distance:.3g} m of others were merged")
            _warn(source, changes[-1])
    if len(edges := _open_edges(faces)):
        raise ValueError(
            f"mesh {source} is not closed: {len(edges)} of its edges do not join two triangles, "
            f"{places(vertices[edges])}; "
            "close the holes (trimesh.repair.fill_holes, or a modelling program) before filling it"
        )
    faces, turned = _turned_alike(source, vertices, faces)
    if turned:
        changes.append(f"{turned} of {len(faces)} triangles that were inside out were turned")
        _warn(source, changes[-1])
    return ClosedMesh(vertices, faces, tuple(changes))


def triangles(source: str | Path | Any) -> tuple[Array, Array]:
    """Vertices float64 [V, 3] and triangles int64 [T, 3] of a file or a `trimesh.Trimesh`, open or closed.

    Raises:
        ImportError, OSError, ValueError: as `load`.
    """
    trimesh = optional.load("trimesh", "a mesh shape", "mesh")
    mesh: Any = source
    if not isinstance(source, (trimesh.Trimesh, str, os.PathLike)):
        raise TypeError(f"source must be the path of a mesh file or a trimesh.Trimesh, got {shape_of(source)}")
    if not isinstance(source, trimesh.Trimesh):
        check_file(source, "mesh")
        try:
            mesh = _read(Path(source))
        except Exception as error:  # Readers of many formats raise any kind of exception.
            raise ValueError(f"mesh file {source} cannot be read: {type(error).__name__}: {error}") from error
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            raise ValueError(f"mesh file {source} holds no triangles")
    vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    if len(faces) == 0:
        raise ValueError(f"mesh {source} holds no triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"a triangle of mesh {source} has corner {faces.max()}, and there are {len(vertices)} corners")
    if not np.isfinite(vertices).all():
        raise ValueError(f"vertices of mesh {source} must be finite")
    return vertices, _without_points(faces)


def _read(path: Path) -> Any:
    """A mesh of a file, by `READERS` or trimesh."""
    import trimesh

    read = READERS.get(path.suffix.lower())
    if read is not None:
        vertices, faces = read(path)
        used, which = np.unique(faces, return_inverse=True)
        return trimesh.Trimesh(vertices[used], which.reshape(-1, 3), process=False)
    return trimesh.load(str(path), force="mesh", resolver=_resolver(path))


def edge_uses(faces: Array) -> tuple[Array, Array, Array]:
    """Edges of triangles: int64 [E, 2], the lower index first; the edge of each side of the triangles [3 T]; and +1
    where a side traverses its edge from the lower index, otherwise −1.

    Sides of a triangle follow each other, from corner k to corner k + 1.
    """
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], 2).reshape(-1, 2)
    edges, which = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    return edges, which.reshape(-1), np.where(sides[:, 0] < sides[:, 1], 1, -1)


def _resolver(path: str | Path) -> Any:
    """Open a file named in a mesh file, if it is a regular file."""
    from trimesh.resolvers import FilePathResolver

    class Resolver(FilePathResolver):
        def get(self, name: str) -> bytes:
            check_file(Path(self.parent, name.strip()), "mesh")
            found: bytes = super().get(name)
            return found

    return Resolver(str(path))


def _without_points(faces: Array) -> Array:
    """Triangles with three different vertices."""
    return faces[(faces != np.roll(faces, 1, axis=1)).all(1)]


def _without_repetitions(faces: Array) -> tuple[Array, int]:
    """Triangles of different corners, the first of each, and the number of those left out; all where fewer triangles
    leave as many edges open."""
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    kept = faces[np.sort(first)]
    if len(_open_edges(kept)) >= len(_open_edges(faces)):
        return faces, 0
    return kept, len(faces) - len(kept)


def _open_edges(faces: Array) -> Array:
    """Edges int64 [E, 2] of an odd number of triangles."""
    edges, which, _ = edge_uses(faces)
    return edges[np.bincount(which, minlength=len(edges)) % 2 == 1]


def merged_equal(vertices: Array, faces: Array) -> tuple[Array, Array, int]:
    """Merge vertices at the same position; returns vertices, triangles and the number of merged vertices."""
    kept, which = np.unique(vertices + 0.0, axis=0, return_inverse=True)  # -0 equals 0.
    return kept, _without_points(which.reshape(-1)[faces]), len(vertices) - len(kept)


def _merged_near(vertices: Array, faces: Array) -> tuple[Array, Array, int, float]:
    """Merge vertices on open edges with near ones; also returns their number and the tolerance [m]."""
    scipy = _scipy()
    own = np.unique(_open_edges(faces))
    distance = MERGED * float(np.linalg.norm(vertices.max(0) - vertices.min(0)))
    pairs = scipy.spatial.cKDTree(vertices[own]).query_pairs(distance, output_type="ndarray")
    _, part = _parts(len(own), pairs)
    _, first, inverse = np.unique(part, return_index=True, return_inverse=True)
    place = np.arange(len(vertices))
    place[own] = own[first[inverse.reshape(-1)]]
    return vertices, _without_points(place[faces]), int((place[own] != own).sum()), distance


def _turned_alike(source: Any, vertices: Array, faces: Array) -> tuple[Array, int]:
    """Triangles that traverse each edge equally often in both directions, and the number of reversed ones.

    Triangles that share an edge with one other depend on each other. Both orientations of each triangle are nodes of a
    graph, in which compatible ones are joined.
    """
    edges, which, sign = edge_uses(faces)
    if not np.bincount(which, sign, len(edges)).any():
        return faces, 0
    uses = np.bincount(which, minlength=len(edges))
    order = np.argsort(which, kind="stable")
    pairs = order[uses[which[order]] == 2].reshape(-1, 2)
    a, b = (pairs // 3).T
    count, alike = len(faces), sign[pairs[:, 0]] != sign[pairs[:, 1]]
    ends = np.where(alike, b, b + count), np.where(alike, b + count, b)
    joined = np.stack([np.concatenate([a, a + count]), np.concatenate(ends)], 1)
    parts, part = _parts(2 * count, joined)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weight = np.bincount(part[:count], area, parts)
    turn = weight[part[count:]] > weight[part[:count]]
    tied = weight[part[count:]] == weight[part[:count]]
    turn |= tied & (part[count:] < part[:count])
    faces = np.where(turn[:, None], faces[:, ::-1], faces)
    edges, which, sign = edge_uses(faces)
    wrong = edges[np.bincount(which, sign, len(edges)) != 0]
    if len(wrong):
        raise ValueError(
            f"the triangles of mesh {source} have no common outside: {len(wrong)} of its edges are passed twice in one "
            f"direction however they are turned, {places(vertices[wrong])}; it is one-sided, or parts of it touch"
        )
    return faces, int(turn.sum())


def _parts(count: int, pairs: Array) -> tuple[int, Array]:
    """Number of connected parts of a graph of `count` nodes, and the part of each node."""
    sparse = _scipy().sparse
    graph = sparse.coo_matrix((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), (count, count))
    parts, part = sparse.csgraph.connected_components(graph, directed=False)
    return int(parts), part


def _scipy() -> Any:
    for module in ("scipy.sparse.csgraph", "scipy.spatial"):
        optional.load(module, "the repair of a mesh", "mesh")
    return optional.load("scipy", "the repair of a mesh", "mesh")


def places(edges: Array) -> str:
    """Positions of some edges [E, 2, 3] or triangles [E, 3, 3], in words."""
    middles = [f"({x:.6g}, {y:.6g}, {z:.6g})" for x, y, z in edges.mean(1)[:NAMED].tolist()]
    return f"near {', '.join(middles)}{' and elsewhere' if len(edges) > NAMED else ''}"


def _warn(source: Any, change: str) -> None:
    warnings.warn(f"mesh {source}: {change}", stacklevel=4)
