"""JSON configurations of PhysGaussian and its descendants: defaults and boundary conditions."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...errors import check_number
from ...files import read_text
from ..gradients import refuse_grad
from ..keys import check_keys, check_needed, checked_list
from .dialects import DIALECTS, PHYSGAUSSIAN, Dialect, dialect_of, recognised
from .parameters import check_box
from .simulator import MPM_Simulator_WARP

MATERIAL: dict[str, Any] = {"material": "jelly", "grid_lim": 2.0, "n_grid": 50, "nu": 0.4, "E": 1e5, "density": 200.0}
MATERIAL_OPTIONS = (
    *("yield_stress", "hardening", "xi", "friction_angle", "plastic_viscosity", "g", "rpic_damping", "pic_damping"),
    *("softening", "opacity_threshold", "grid_v_damping_scale", "additional_material_params"),
)
MATERIAL_OF: dict[str, dict[str, Any]] = {
    "physics3d": {"mu_N": 5, "lam_N": 5, "viscosity": 0.1},
    "physflow": {"mu_N": 5, "lam_N": 5, "viscosity": 0.1},
    "motionphysics": {"E": 1e-2, "viscosity": 0.1, "downsample_scale": 1.0},
    "gaussianfluent": {"alpha_0": -0.04, "beta": 2, "flip_pic_ratio": 0.8},
}
"""Defaults of material parameters of each dialect."""
TIME: dict[str, Any] = {"substep_dt": 1e-4, "frame_dt": 1e-2, "frame_num": 100}
TIME_OF: dict[str, dict[str, Any]] = {
    "physflow": {**TIME, "opt_frame_dt": 1e-2},
    "motionphysics": {"substep_perframe": 256, "total_time": 3, "frame_num": 100},
}
"""Times of each dialect."""
PREPROCESSING: dict[str, Any] = {
    **{"opacity_threshold": 0.02, "rotation_degree": [], "rotation_axis": [], "sim_area": None, "scale": 1.0},
    "particle_filling": None,
}
PREPROCESSING_OF: dict[str, dict[str, Any]] = {
    "pixie": {
        **{"nn_distance_threshold": 0.1, "to_original_coord": True, "z_shift_value": 0.0, "fix_ground": True},
        **{"only_handle_largest_cluster": True, "k_smoothing_neighbors": 10, "out_of_bound_check_freq": 10},
    },
}
FILLING: dict[str, Any] = {
    **{"density_threshold": 5.0, "search_threshold": 3.0, "max_particles_num": 2000000, "max_partciels_per_cell": 1},
    **{"search_exclude_direction": 5, "ray_cast_direction": 4, "boundary": None, "smooth": False, "visualize": False},
}
CAMERA: dict[str, Any] = {
    **{"mpm_space_viewpoint_center": [1.0, 1.0, 1.0], "mpm_space_vertical_upward_axis": [0, 0, 1]},
    **{"default_camera_index": 0, "show_hint": False, "init_azimuthm": None, "init_elevation": None},
    **{"init_radius": None, "delta_a": None, "delta_e": None, "delta_r": None, "move_camera": False},
}
CAMERA_OF: dict[str, dict[str, Any]] = {"pixie": {"init_roll": 0.0, "delta_roll": 0.0}}
OPTIMISATION = ("prompt", "lr", "line", "reduction", "bbox_2d")
"""Keys that PhysFlow and MotionPhysics return as the sixth part of a configuration."""
NOT_OF_THE_SIMULATION = (
    *("prompt", "lr", "line", "reduction", "downsample_scale", "bbox_2d"),  # MotionPhysics, PhysFlow
    *("init_roll", "delta_roll", "k_smoothing_neighbors", "nn_distance_threshold", "out_of_bound_check_freq"),  # PIXIE
    *("export_gaussians_to_ply", "only_handle_largest_cluster", "to_original_coord", "z_shift_value"),
)
"""Keys of descendants for their training, preparation and pictures."""
A_BOX = "a box of additional_material_params"
CONDITIONS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "bounding_box": ("add_bounding_box", (), ()),
    "cuboid": ("set_velocity_on_cuboid", ("point", "size", "velocity"), ("start_time", "end_time", "reset")),
    "particle_impulse": ("add_impulse_on_particles", ("force",), ("point", "size", "num_dt", "start_time")),
    "enforce_particle_translation": (
        "enforce_particle_velocity_translation",
        ("point", "size", "velocity", "start_time", "end_time"),
        (),
    ),
    "surface_collider": (
        "add_surface_collider",
        ("point", "normal", "surface", "friction", "start_time", "end_time"),
        (),
    ),
    "release_particles_sequentially": (
        "release_particles_sequentially",
        ("normal", "start_position", "end_position", "num_layers", "start_time", "end_time"),
        (),
    ),
    "enforce_particle_velocity_rotation": (
        "enforce_particle_velocity_rotation",
        ("point", "normal", "half_height_and_radius", "rotation_scale", "translation_scale", "start_time", "end_time"),
        (),
    ),
    "release_particles_sequentially_size": (
        "release_particles_sequentially_size",
        ("normal", "start_position", "end_position", "num_layers", "start_time", "end_time", "size", "point"),
        (),
    ),
    "add_constant_force": ("add_constant_force", ("force", "point", "radius", "start_time", "end_time"), ()),
}
"""For each type of a configuration: method of the simulator, required keys and optional keys."""
CUBOID_END = 1e3


class MaterialParameters(dict[str, Any]):
    """Parameters of `set_parameters_dict` with the dialect of their configuration."""

    dialect: Dialect | None = None

    def copy(self) -> MaterialParameters:
        """A copy with the dialect."""
        return self | {}

    def __or__(self, other: Any) -> MaterialParameters:  # type: ignore[override]
        result = MaterialParameters({**self, **other})
        result.dialect = self.dialect
        return result


def decode_param_json(json_file: str | Path, dialect: str | None = None) -> tuple[Any, ...]:
    """Parts of a configuration with their defaults.

    Keys of descendants for their training and pictures are ignored with a warning.

    Args:
        json_file: a JSON file.
        dialect: project of the configuration, see `DIALECTS`; None for PhysGaussian, or the one whose keys it has.

    Returns:
        Parameters of `set_parameters_dict`; the list of boundary conditions; substep_dt, frame_dt [s] and frame_num,
        or the times of the dialect; parameters of the preparation of Gaussians, and of the camera, which torch_mpm does
        not use; in the dialects of PhysFlow and MotionPhysics those of the optimisation too.

    Raises:
        ValueError: for an unknown key, keys of several dialects, a Poisson's ratio outside [0, 0.5], or a box of
            material parameters that lacks one, and a length of a step or a frame that is not positive.
    """
    given = json.loads(read_text(json_file, "configuration"))
    if not isinstance(given, Mapping):
        raise TypeError(f"the configuration must be a mapping, got {type(given).__name__}")
    chosen = _dialect(given, dialect)
    own = PHYSGAUSSIAN if chosen is None else chosen
    _check_configuration(given, own)

    def part(defaults: Mapping[str, Any]) -> dict[str, Any]:
        return {name: given.get(name, value) for name, value in defaults.items()}

    options = (*MATERIAL_OPTIONS, *own.keys, *own.without_effect)
    material = MaterialParameters(part({**MATERIAL, **MATERIAL_OF.get(own.name, {})}))
    material.update({name: given[name] for name in options if name in given})
    material.dialect = chosen
    check_number("nu", material["nu"], "between 0 and 0.5", lambda v: 0 <= v <= 0.5)
    for box in checked_list("additional_material_params", material.get("additional_material_params", [])):
        check_box(A_BOX, box, own)
        check_needed(A_BOX, box, ("point", "size", "E", "nu"))
        box.setdefault("density", material["density"])
    preprocessing = part({**PREPROCESSING, **PREPROCESSING_OF.get(own.name, {})})
    if preprocessing["particle_filling"] is not None:
        checked_list("particle_filling", [preprocessing["particle_filling"]])
        filling = {"n_grid": 4 * material["n_grid"], **FILLING}
        check_keys("particle_filling", preprocessing["particle_filling"], filling)
        preprocessing["particle_filling"] = filling | preprocessing["particle_filling"]
    times, camera = _times(part(TIME_OF.get(own.name, TIME))), part({**CAMERA, **CAMERA_OF.get(own.name, {})})
    parts = material, given.get("boundary_conditions", {}), times, preprocessing, camera
    if own.name not in ("physflow", "motionphysics"):
        return parts
    return *parts, {"reduction": "sum"} | {name: given[name] for name in OPTIMISATION if name in given}


def _times(times: dict[str, Any]) -> dict[str, Any]:
    """Times of a configuration, with lengths of steps and frames that are positive."""
    for name, value in times.items():
        if name.endswith("_dt") and value is not None:
            check_number(name, value, "positive and finite", lambda v: 0 < v < math.inf)
    return times


def _dialect(given: Mapping[str, Any], dialect: str | None) -> Dialect | None:
    """The given dialect, or that of the keys of a configuration."""
    if dialect is not None:
        return dialect_of(dialect)
    boxes = given.get("additional_material_params", ())
    of_boxes = {key for box in boxes if isinstance(box, Mapping) for key in box} if isinstance(boxes, list) else set()
    return recognised(given, given.get("material"), given, of_boxes)


def set_boundary_conditions(
    mpm_solver: MPM_Simulator_WARP,
    bc_params: Iterable[Mapping[str, Any]],
    time_params: Mapping[str, Any],
    freeze_pts: Tensor | None = None,
    sim_pos: Tensor | None = None,
) -> list[dict[str, Any]]:
    """Add the boundary conditions of a configuration to a simulator, in their order.

    Args:
        mpm_solver: the simulator.
        bc_params: mappings with a type and its keys.
        time_params: times of the configuration.
        freeze_pts: points [Q, 3] [m]; the nodes of their cells are held at rest, as in MotionPhysics.
        sim_pos: not used: the particles of the simulator count.

    Returns:
        Arrows of the forces for pictures, as MotionPhysics returns them: force, point, start_frame and end_frame.

    Raises:
        TypeError: for an unknown type.
        ValueError: for a missing or unknown key.
    """
    if freeze_pts is not None:
        _freeze(mpm_solver, freeze_pts)
    arrows = []
    for condition in checked_list("boundary_conditions", bc_params):
        check_needed("a boundary condition", condition, ("type",))
        kind = condition["type"]
        if kind not in CONDITIONS:
            raise TypeError(f"type of a boundary condition must be one of {sorted(CONDITIONS)}, got {kind!r}")
        method, needed, optional = CONDITIONS[kind]
        check_keys(f"a boundary condition {kind}", condition, ("type", *needed, *optional))
        check_needed(f"a boundary condition {kind}", condition, needed)
        arguments = {name: condition[name] for name in (*needed, *optional) if name in condition}
        if kind == "particle_impulse":
            arguments["dt"] = substep_of(time_params)
        if kind == "cuboid":
            arguments.setdefault("end_time", CUBOID_END)
        getattr(mpm_solver, method)(**arguments)
        if "force" in condition:
            arrows.append(_arrow(mpm_solver, condition, time_params))
    return arrows


def substep_of(time_params: Mapping[str, Any]) -> float:
    """Time of a substep [s]: substep_dt, or total_time over the number of substeps.

    Raises:
        ValueError: without either.
    """
    if "substep_perframe" in time_params:
        check_needed("time_params", time_params, ("total_time", "frame_num"))
        steps = time_params["frame_num"] * time_params["substep_perframe"]
        return float(time_params["total_time"]) / float(steps)
    check_needed("time_params", time_params, ("substep_dt",))
    return time_params["substep_dt"]


def _freeze(mpm_solver: MPM_Simulator_WARP, points: Tensor) -> None:
    """Hold the nodes of the cells of some points at rest."""
    refuse_grad("it selects nodes", freeze_pts=points)
    n = int(mpm_solver.mpm_model.n_grid)
    x = mpm_solver.state.x
    i, j, k = (points.detach().to(x) * mpm_solver.mpm_model.inv_dx).long().clamp(0, n - 1).unbind(1)
    mask = torch.zeros(n, n, n, dtype=torch.bool, device=x.device)
    mask[i, j, k] = True
    mpm_solver.enforce_grid_velocity_by_mask(mask)


def _arrow(
    mpm_solver: MPM_Simulator_WARP, condition: Mapping[str, Any], time_params: Mapping[str, Any]
) -> dict[str, Any]:
    """An arrow of 0.1 m for a force, at the particle next to its point, and its first and last frame."""
    x = mpm_solver.state.x.detach()
    force, point = (
        torch.as_tensor(condition.get(name, (1, 1, 1)), dtype=x.dtype, device=x.device).detach()
        for name in ("force", "point")
    )
    dt, start = substep_of(time_params), float(condition.get("start_time", 0.0))
    end = float(condition["end_time"]) if "end_time" in condition else start + dt * condition.get("num_dt", 1)
    frame = (
        dt * time_params["substep_perframe"] if "substep_perframe" in time_params else time_params.get("frame_dt", dt)
    )
    nearest = int((x - point).norm(dim=1).argmin()) if len(x) else 0
    return {
        "force": 0.1 * force / force.norm(),
        "point": x[nearest] if len(x) else point,
        "start_frame": int(start / frame),
        "end_frame": int(end / frame),
    }


def _check_configuration(given: Mapping[str, Any], dialect: Dialect) -> None:
    """Check the keys of a configuration; warn of those without effect."""
    known = (
        *(*MATERIAL, *MATERIAL_OPTIONS, *dialect.keys, *dialect.without_effect, *TIME_OF.get(dialect.name, TIME)),
        *(*PREPROCESSING, *PREPROCESSING_OF.get(dialect.name, {}), *CAMERA, *CAMERA_OF.get(dialect.name, {})),
        *(OPTIMISATION if dialect.name in ("physflow", "motionphysics") else ()),
        "boundary_conditions",
    )
    ignored = {*NOT_OF_THE_SIMULATION, *dialect.without_effect} - {*OPTIMISATION} | {*OPTIMISATION} - {*known}
    left_out = sorted(key for key in given if key in ignored and key not in PREPROCESSING_OF.get(dialect.name, {}))
    if left_out:
        warnings.warn(f"keys of the configuration that have no effect: {', '.join(left_out)}", stacklevel=3)
    others = {}
    for other in DIALECTS.values():
        for key in (*other.keys, *other.without_effect, *other.configuration):
            if key not in known:
                others[key] = f"{other.project} has it: pass dialect={other.name!r}"
    check_keys("the configuration", (name for name in given if name not in left_out), known, others)
