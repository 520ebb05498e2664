"""Geoms of a MuJoCo model as obstacles.

Sizes of geoms: https://mujoco.readthedocs.io/en/stable/XMLreference.html#body-geom.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ..boundaries import Obstacle
from ..geometry import shapes
from ..geometry.vectors import rotation_vector
from ..optional import load
from .exchange import Part

SHAPES: dict[str, Callable[[np.ndarray], shapes.Shape]] = {
    "plane": lambda size: shapes.Plane((0.0, 0.0, 1.0)),  # Infinite for contact; the size is that of pictures.
    "sphere": lambda size: shapes.Sphere(float(size[0])),
    "capsule": lambda size: shapes.Capsule((0.0, 0.0, float(size[1])), float(size[0])),
    "cylinder": lambda size: shapes.Cylinder((0.0, 0.0, float(size[1])), float(size[0])),
    "box": lambda size: shapes.Box((2 * size).tolist()),
}
"""Shapes in the frame of a geom by the name of its type; beside "mesh"."""


def load_mujoco() -> Any:
    """The package mujoco; raises ImportError without it."""
    return load("mujoco", "coupling with MuJoCo", "mujoco")


def body_number(model: Any, name: str) -> int:
    """Number of a body; raises ValueError for an unknown name."""
    mujoco = load_mujoco()
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) if isinstance(name, str) else -1
    if found < 0:
        known = sorted(model.body(k).name for k in range(model.nbody))
        raise ValueError(f"bodies must be names of bodies of the model, {known}, got {name!r}")
    return int(found)


def geom_name(model: Any, geom: int) -> str:
    """Name of a geom, or "geom 3" of one without a name."""
    return model.geom(geom).name or f"geom {geom}"


def colliding_geoms(model: Any, body: int) -> list[int]:
    """Geoms of a body that collide in MuJoCo; the others are for pictures."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return [int(g) for g in np.flatnonzero((model.geom_bodyid == body) & collides)]


def part_of_geom(model: Any, geom: int, kind: str, friction: float | None, spacing: float) -> Part:
    """A geom as an obstacle on its body, whose frame has the axes of the body and its centre of mass as origin.

    Args:
        model: MjModel.
        geom: number of the geom.
        kind, friction: of the obstacle; None for the sliding friction of the geom.
        spacing: distance of the samples of a mesh [m].

    Raises:
        ValueError: for a geom of a type without a shape.
        ImportError: for a mesh without trimesh.
    """
    obstacle = Obstacle(
        _shape_of(model, geom, spacing),
        (0.0, 0.0, 0.0),
        kind,
        float(model.geom_friction[geom, 0]) if friction is None else friction,
    )
    quaternion = torch.tensor(model.geom_quat[geom], dtype=torch.float64)
    at = model.geom_pos[geom] - model.body_ipos[model.geom_bodyid[geom]]
    return Part(obstacle, at.tolist(), rotation_vector(quaternion[:1], quaternion[1:]).tolist())


def _shape_of(model: Any, geom: int, spacing: float) -> shapes.Shape:
    mujoco = load_mujoco()
    name = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
    if name == "mesh":
        return _sampled_mesh(model, int(model.geom_dataid[geom]), spacing)
    if name not in SHAPES:
        supported = sorted([*SHAPES, "mesh"])
        raise ValueError(f"geoms must be of a type among {supported}, got {geom_name(model, geom)!r} of type {name!r}")
    return SHAPES[name](model.geom_size[geom])


def _sampled_mesh(model: Any, mesh: int, spacing: float) -> shapes.Sampled:
    """The closed mesh itself, where MuJoCo takes its convex hull."""
    trimesh = load("trimesh", "an obstacle of a mesh", "mesh")
    first, n = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = np.asarray(model.mesh_vert[first : first + n], dtype=np.float64)
    first, n = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    made = trimesh.Trimesh(vertices, np.array(model.mesh_face[first : first + n]), process=False)
    lower, upper = vertices.min(0) - 2 * spacing, vertices.max(0) + 2 * spacing
    return shapes.Sampled.of(shapes.Mesh(made), lower.tolist(), upper.tolist(), spacing)
