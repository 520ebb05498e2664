"""JSON configurations of PhysGaussian: defaults and boundary conditions."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ...errors import check_number
from ...files import read_text
from ..keys import check_keys, check_needed, checked_list
from .parameters import BOX, BOX_UNSUPPORTED, UNSUPPORTED
from .simulator import MPM_Simulator_WARP

MATERIAL: dict[str, Any] = {"material": "jelly", "grid_lim": 2.0, "n_grid": 50, "nu": 0.4, "E": 1e5, "density": 200.0}
MATERIAL_OPTIONS = (
    *("yield_stress", "hardening", "xi", "friction_angle", "plastic_viscosity", "g", "rpic_damping", "pic_damping"),
    *("softening", "opacity_threshold", "grid_v_damping_scale", "additional_material_params"),
)
TIME: dict[str, Any] = {"substep_dt": 1e-4, "frame_dt": 1e-2, "frame_num": 100}
PREPROCESSING: dict[str, Any] = {
    **{"opacity_threshold": 0.02, "rotation_degree": [], "rotation_axis": [], "sim_area": None, "scale": 1.0},
    "particle_filling": None,
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
OTHER_TIMES = "MotionPhysics has it: give substep_dt, frame_dt and frame_num"
OTHER_KEYS = {
    **UNSUPPORTED,
    **{"substep_perframe": OTHER_TIMES, "total_time": OTHER_TIMES},
    "opt_frame_dt": "PhysFlow has it for its optimisation: give frame_dt",
    "fix_ground": "PIXIE has it: give a boundary condition",
}
"""Keys of descendants that change the simulation."""
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
}
"""For each type of a configuration: method of the simulator, required keys and optional keys."""
OTHER_CONDITIONS = {
    "add_constant_force": "MotionPhysics has it: use particle_impulse with num_dt",
    "release_particles_sequentially_size": "PhysFlow has it: use release_particles_sequentially",
}
"""Types of descendants."""


def decode_param_json(
    json_file: str | Path,
) -> tuple[dict[str, Any], Any, dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Parts of a configuration with their defaults.

    Keys of descendants for their training and pictures are ignored with a warning.

    Returns:
        Parameters of `set_parameters_dict`; the list of boundary conditions; substep_dt, frame_dt [s] and frame_num;
        parameters of the preparation of Gaussians, and of the camera, which torch_mpm does not use.

    Raises:
        ValueError: for an unknown key, a key of a descendant that changes the simulation, a Poisson's ratio outside
            [0, 0.5], or a box of material parameters that lacks one.
    """
    given = json.loads(read_text(json_file, "configuration"))
    if not isinstance(given, Mapping):
        raise TypeError(f"the configuration must be a mapping, got {type(given).__name__}")
    _check_configuration(given)

    def part(defaults: Mapping[str, Any]) -> dict[str, Any]:
        return {name: given.get(name, value) for name, value in defaults.items()}

    material = part(MATERIAL) | {name: given[name] for name in MATERIAL_OPTIONS if name in given}
    check_number("nu", material["nu"], "between 0 and 0.5", lambda v: 0 <= v <= 0.5)
    for box in checked_list("additional_material_params", material.get("additional_material_params", [])):
        check_keys(A_BOX, box, BOX, BOX_UNSUPPORTED)
        check_needed(A_BOX, box, ("point", "size", "E", "nu"))
        box.setdefault("density", material["density"])
    preprocessing = part(PREPROCESSING)
    if preprocessing["particle_filling"] is not None:
        checked_list("particle_filling", [preprocessing["particle_filling"]])
        filling = {"n_grid": 4 * material["n_grid"], **FILLING}
        check_keys("particle_filling", preprocessing["particle_filling"], filling)
        preprocessing["particle_filling"] = filling | preprocessing["particle_filling"]
    return material, given.get("boundary_conditions", {}), part(TIME), preprocessing, part(CAMERA)


def set_boundary_conditions(
    mpm_solver: MPM_Simulator_WARP, bc_params: Iterable[Mapping[str, Any]], time_params: Mapping[str, Any]
) -> None:
    """Add the boundary conditions of a configuration to a simulator, in their order.

    Raises:
        TypeError: for an unknown type.
        ValueError: for a missing or unknown key, or a type of a descendant.
    """
    for condition in checked_list("boundary_conditions", bc_params):
        check_needed("a boundary condition", condition, ("type",))
        kind = condition["type"]
        if kind in OTHER_CONDITIONS:
            raise ValueError(f"boundary condition {kind} is not supported: {OTHER_CONDITIONS[kind]}")
        if kind not in CONDITIONS:
            raise TypeError(f"type of a boundary condition must be one of {sorted(CONDITIONS)}, got {kind!r}")
        method, needed, optional = CONDITIONS[kind]
        check_keys(f"a boundary condition {kind}", condition, ("type", *needed, *optional))
        check_needed(f"a boundary condition {kind}", condition, needed)
        arguments = {name: condition[name] for name in (*needed, *optional) if name in condition}
        if kind == "particle_impulse":
            check_needed("time_params", time_params, ("substep_dt",))
            arguments["dt"] = time_params["substep_dt"]
        if kind == "cuboid":
            arguments.setdefault("end_time", 1e3)
        getattr(mpm_solver, method)(**arguments)


def _check_configuration(given: Mapping[str, Any]) -> None:
    known = (*MATERIAL, *MATERIAL_OPTIONS, *TIME, *PREPROCESSING, *CAMERA, "boundary_conditions")
    left_out = sorted(set(given) & set(NOT_OF_THE_SIMULATION))
    if left_out:
        warnings.warn(f"keys of the configuration that have no effect: {', '.join(left_out)}", stacklevel=3)
    check_keys("the configuration", (name for name in given if name not in left_out), known, OTHER_KEYS)
