"""Arguments of other interfaces of a wrong type or length: the error names the argument and what came."""

import inspect
import json
import math

import pytest
import torch

from torch_mpm.compat import mpm_pytorch, nclaw
from torch_mpm.compat.mpm_pytorch import boundary_condition, constitutive_models
from torch_mpm.compat.physgaussian import MPM_Simulator_WARP, decode_param_json, dialects, set_boundary_conditions
from torch_mpm.compat.physgaussian import parameters as table

VECTORS = {"point": 3, "size": 3, "normal": 3, "half_height_and_radius": 2, "velocity": 3, "force": 3}
VALUES = {"normal": [0, 0, 1], "num_dt": 2, "num_layers": 5, "end_time": 2.0, "end_position": 0.7, "dim": 1}
NUMBERS = ("dt", "start_time", "start_position", "rotation_scale", "translation_scale", "bound")
NOT_READ = ("self", "model", "surface", "reset", "device", "dim")
SETTERS = (
    "add_surface_collider",
    "set_velocity_on_cuboid",
    "add_impulse_on_particles",
    "enforce_particle_velocity_translation",
    "enforce_particle_velocity_rotation",
    "release_particles_sequentially",
    "add_bounding_box",
)
CASES = [
    *((of, name, argument) for of in ("physgaussian", "mpm_pytorch") for name in SETTERS
      for argument in inspect.signature(getattr(MPM_Simulator_WARP, name)).parameters
      if argument not in NOT_READ and (of == "physgaussian" or hasattr(boundary_condition, name))),
    ("mpm_pytorch", "add_sdf_collider", "bound"),
]  # fmt: skip


def simulator(dialect: str | None = None) -> MPM_Simulator_WARP:
    made = MPM_Simulator_WARP(10, dialect=dialect)
    x = 0.4 + 0.2 * torch.rand(10, 3, generator=torch.Generator().manual_seed(0))
    made.load_initial_data_from_torch(x, torch.full((10,), 1e-5), n_grid=20)
    return made


@pytest.mark.parametrize(("of", "name", "argument"), CASES)
def test_arguments_of_setters(of, name, argument):
    if of == "physgaussian":
        setter = getattr(simulator(), name)
    else:
        solver = mpm_pytorch.MPMSolver(0.4 + 0.2 * torch.rand(10, 3))
        setter = lambda **given: getattr(boundary_condition, name)(solver, **given)  # noqa: E731
    parameters = inspect.signature(getattr(boundary_condition, name, None) or setter).parameters
    names = [a for a in parameters if a in (*VECTORS, *VALUES, *NUMBERS)]
    given = {a: VALUES.get(a, [0.1] * VECTORS[a] if a in VECTORS else 0.1) for a in names}
    setter(**given)
    wrong = ["1e4", None, {}, math.nan]
    if argument in VECTORS:
        count = VECTORS[argument]
        wrong += [
            0.5,
            [0.1] * (count - 1),
            [0.1] * (count + 1),
            ["0.1"] * count,
            [[0.1] * count],
            torch.zeros(count + 1),
        ]
    for value in wrong:
        with pytest.raises((TypeError, ValueError), match=rf"^{argument} must "):
            setter(**{**given, argument: value})


def with_key(key: str) -> MPM_Simulator_WARP:
    """A simulator whose dialect has a key."""
    return simulator(next(d.name for d in dialects.DIALECTS.values() if key in (*dialects.BASE_KEYS, *d.keys)))


WRONG_NUMBERS = ("1e4", None, {}, [1.0, 2.0], [None] * 10, math.nan)


@pytest.mark.parametrize("key", [*table.RANGES, "grid_lim", "n_grid", "hardening", "g"])
def test_values_of_parameters(key):
    for value in WRONG_NUMBERS:
        with pytest.raises((TypeError, ValueError), match=rf"^{key} must "):
            with_key(key).set_parameters_dict({key: value})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "the configuration must be a mapping, got list"),
        ({"nu": "0.3"}, "nu must be a number, got str '0.3'"),
        ({"nu": 0.6}, "nu must be between 0 and 0.5, got 0.6"),
        ({"additional_material_params": {}}, "additional_material_params must be a list of mappings, got dict"),
        ({"additional_material_params": [3]}, r"additional_material_params\[0\] must be a mapping, got int"),
        ({"particle_filling": 3}, r"particle_filling\[0\] must be a mapping, got int"),
    ],
)
def test_types_of_configurations(given, message, tmp_path):
    path = tmp_path / "configuration.json"
    path.write_text(json.dumps(given))
    with pytest.raises((TypeError, ValueError), match=message):
        decode_param_json(path)


def test_a_text_as_a_modulus_of_a_configuration(tmp_path):
    path = tmp_path / "configuration.json"
    path.write_text(json.dumps({"E": "1e4"}))
    material, *_ = decode_param_json(path)
    with pytest.raises(TypeError, match=r"E must be a number, or numbers \[P\], got '1e4'"):
        simulator().set_parameters_dict(material)


@pytest.mark.parametrize("given", [3, "cuboid", {"type": "cuboid"}, [3], [None]])
def test_types_of_lists_of_conditions(given):
    with pytest.raises(TypeError, match=r"^boundary_conditions(\[0\])? must be a (list of mappings|mapping), got "):
        set_boundary_conditions(simulator(), given, {"substep_dt": 1e-4})
    with pytest.raises(TypeError, match=r"^bc_params(\[0\])? must be a (list of mappings|mapping), got "):
        mpm_pytorch.set_boundary_conditions(mpm_pytorch.MPMSolver(torch.rand(4, 3)), given)


@pytest.mark.parametrize("value", ["soft", None, {}, [1.0, 2.0], math.nan, torch.ones(2)], ids=str)
def test_numbers_of_laws_and_solvers(value):
    for make, name in (
        (lambda: constitutive_models.CorotatedElasticity(E=value), "E"),
        (lambda: constitutive_models.CorotatedElasticity(nu=value), "nu"),
        (lambda: nclaw.material.CorotatedElasticity({"E": value, "nu": 0.3}), "E"),
        (lambda: nclaw.material.CorotatedElasticity({"E": 1e4, "nu": value}), "nu"),
        (lambda: mpm_pytorch.MPMSolver(torch.rand(4, 3), rho=value), "rho"),
        (lambda: mpm_pytorch.MPMSolver(torch.rand(4, 3), size=value), "size"),
        (lambda: mpm_pytorch.MPMSolver(torch.rand(4, 3), gravity=value), "gravity"),
        (lambda: nclaw.sim.MPMModel(10, 1e-4, 3, (0, 0, -9.8), eps=value), "eps"),
    ):
        with pytest.raises((TypeError, ValueError), match=rf"^{name} must "):
            make()


@pytest.mark.parametrize(
    "name", [name for name in table.RANGES if name not in ("nu", "friction_angle", "rpic_damping", "flip_pic_ratio")]
)
def test_numbers_beyond_the_type_of_the_particles(name):
    with pytest.raises(
        ValueError, match=rf"{name} must be at most 3.4e\+38, the largest number of torch.float32, got 1e"
    ):
        with_key(name).set_parameters_dict({name: 1e300})


@pytest.mark.parametrize("size", [[-0.1, 0.1, 0.1], [0.1, 0.1, -1e-9]])
@pytest.mark.parametrize("of", ["box", "impulse", "translation", "mpm_pytorch impulse", "mpm_pytorch translation"])
def test_boxes_of_negative_size(of, size):
    """They would select no particle."""
    made, solver = simulator(), mpm_pytorch.MPMSolver(0.4 + 0.2 * torch.rand(10, 3))
    made.set_parameters_dict({"E": 1e4, "nu": 0.3, "density": 100.0})
    box = {"point": [0.5] * 3, "size": size, "E": 1e5, "nu": 0.3, "density": 100.0}
    place = {"point": [0.5] * 3, "size": size}
    moving = {**place, "velocity": [0.0] * 3, "start_time": 0.0, "end_time": 1.0}
    up = [0.0, 0.0, 1.0]
    calls = {
        "box": lambda: made.set_parameters_dict({"additional_material_params": [box]}),
        "impulse": lambda: made.add_impulse_on_particles(up, 1e-3, **place),
        "translation": lambda: made.enforce_particle_velocity_translation(**moving),
        "mpm_pytorch impulse": lambda: boundary_condition.add_impulse_on_particles(solver, up, 1e-3, **place),
        "mpm_pytorch translation": lambda: boundary_condition.enforce_particle_velocity_translation(solver, **moving),
    }
    with pytest.raises(ValueError, match="size must not be negative"):
        calls[of]()
