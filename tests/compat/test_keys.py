"""Unknown or impossible keys, materials and values of the other interfaces are errors by name."""

import json
import math
import warnings

import pytest
import torch

import torch_mpm as mpm
from torch_mpm.compat import mpm_pytorch
from torch_mpm.compat.physgaussian import (
    MPM_Simulator_WARP,
    configuration,
    decode_param_json,
    dialects,
    set_boundary_conditions,
)
from torch_mpm.compat.physgaussian import parameters as table

NEEDS = {
    "jelly": {"E": 1e5, "nu": 0.3},
    "metal": {"E": 1e5, "nu": 0.3, "yield_stress": 1e3},
    "sand": {"E": 1e5, "nu": 0.3},
    "foam": {"E": 1e5, "nu": 0.3, "yield_stress": 1e3},
    "plasticine": {"E": 1e5, "nu": 0.3, "yield_stress": 1e3},
}


def solver(count=10, **options):
    result = MPM_Simulator_WARP(count, **options)
    x = 0.4 + 0.2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    result.load_initial_data_from_torch(x, torch.full((count,), 1e-5), n_grid=20)
    return result


def typos(word):
    """The word with two letters swapped, a letter missing, and one doubled."""
    middle = len(word) // 2
    swapped = word[: middle - 1] + word[middle] + word[middle - 1] + word[middle + 1 :]
    return {swapped, word[:-1], word[:middle] + word[middle - 1 :]} - {word}


@pytest.mark.parametrize("key", [k for k in dialects.BASE_KEYS if len(k) > 3])
def test_typing_errors_name_the_nearest_key(key):
    for word in typos(key):
        with pytest.raises(ValueError, match=f"{word!r} is unknown, the nearest known key is '"):
            solver().set_parameters_dict({word: 1.0})
    with pytest.raises(ValueError, match=f"'{key}s' is unknown, the nearest known key is '{key}'"):
        solver().set_parameters(**{key + "s": 1.0})


FOREIGN = sorted({key for d in dialects.DIALECTS.values() for key in d.known} - set(dialects.PHYSGAUSSIAN.known))


@pytest.mark.parametrize("key", FOREIGN)
def test_keys_of_another_dialect(key, tmp_path):
    with pytest.raises(ValueError, match=f"must have known keys: '{key}' is not supported: .* has it: pass dialect="):
        solver(dialect="physgaussian").set_parameters_dict({"E": 1.0, key: 1.0})
    with pytest.raises(ValueError, match=f"the configuration must have known keys: '{key}' is not supported"):
        decode_param_json(written(tmp_path, {key: 1.0}), "physgaussian")


def test_dialects_with_batches():
    for call in (lambda: solver(dialect="kywind"), lambda: solver().set_parameters_dict({"dx": 0.1})):
        with pytest.raises(ValueError, match=r"dialect must not be 'kywind', .* need BatchedSimulator"):
            call()


@pytest.mark.parametrize("dialect", [name for name in dialects.DIALECTS if name != "kywind"])
def test_typing_errors_in_a_dialect(dialect):
    for key in dialects.DIALECTS[dialect].keys:
        with pytest.raises(ValueError, match=f"'{key}s' is unknown, the nearest known key is '{key}'"):
            solver(dialect=dialect).set_parameters_dict({key + "s": 1.0})


RECOGNISED = [
    ({"mu": 1e-3, "bulk": 1.0}, "motionphysics"),
    ({"alpha_0": -0.04}, "gaussianfluent"),
    ({"material": "watermelon"}, "gaussianfluent"),
    ({"bulk_modulus": 1e5}, "pixie"),
    ({"bulk_modulus": 1e5, "material": "fluid"}, "pixie"),
    ({"spawn_offset": [0, 0, 0]}, "pixie"),
    ({"mu_N": 1.0, "material": "sand"}, None),
    ({"mu_N": 1.0, "material": "non_newtonian"}, "physflow"),
    ({"viscosity": 1.0}, None),
    ({"material": "fluid"}, None),
    ({"material": "neo-hookean"}, "warp_mpm"),
]


@pytest.mark.parametrize(("given", "dialect"), RECOGNISED)
def test_dialects_are_recognised_and_reported(given, dialect):
    one = solver()
    if dialect is None:
        with pytest.raises(ValueError, match=r"dialect must be given: .* which have different units or laws"):
            one.set_parameters_dict(given)
        return
    project = dialects.DIALECTS[dialect].project
    with pytest.warns(UserWarning, match=f"parameters are those of {project}.*recognised by .*dialect='{dialect}'"):
        one.set_parameters_dict(given)
    assert one.dialect.name == dialect


def test_units_do_not_change_afterwards():
    one = solver()
    one.set_parameters_dict({"E": 1e5})
    with pytest.raises(ValueError, match="dialect must be given: E had been given in SI units"):
        one.set_parameters_dict({"mu": 1.0, "bulk": 1.0})
    with pytest.raises(ValueError, match=r"dialect must be one of .*'physgaussian'.*, got 'physgausian'"):
        solver(dialect="physgausian")


def test_a_chosen_dialect_is_reported_once(caplog, monkeypatch):
    monkeypatch.setattr(dialects, "_REPORTED", set())
    for _ in range(2):
        solver(dialect="motionphysics")
    (entry,) = caplog.messages
    assert entry.startswith("parameters are those of MotionPhysics: E in 1e7 Pa, yield_stress in 1e5 Pa, plastic_visc")


def test_a_modulus_in_other_units_is_noticed():
    with pytest.warns(UserWarning, match="E = 0.05 Pa is softer than any solid: .*dialect="):
        solver().set_parameters_dict({"E": 0.05})


def test_all_problems_are_named_at_once():
    with pytest.raises(ValueError, match=r"'mu_N' is not supported.*'yeild_stress' is unknown.*'yield_stress'"):
        solver(dialect="physgaussian").set_parameters_dict({"mu_N": 1, "E": 1.0, "yeild_stress": 1})


def test_keys_without_effect_are_accepted():
    """PhysGaussian itself writes these keys into its parameters."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver().set_parameters_dict(dict.fromkeys(dialects.WITHOUT_EFFECT, 0.5))


BOX = {"point": [0.5] * 3, "size": [0.1] * 3, "E": 1e5, "nu": 0.3, "density": 100.0}


@pytest.mark.parametrize(
    ("box", "message"),
    [
        (BOX | {"material": "snad"}, r"material of a box must be one of .*'sand'.*, got 'snad'"),
        (BOX | {"densty": 1.0}, "'densty' is unknown, the nearest known key is 'density'"),
        ({k: v for k, v in BOX.items() if k != "nu"}, "a box of additional_material_params must have nu"),
        (BOX | {"E": -1.0}, "E must be finite and not negative, got -1.0"),
        (BOX | {"density": 0.0}, "density must be finite and positive, got 0.0"),
    ],
)
def test_boxes(box, message):
    with pytest.raises(ValueError, match=message):
        solver().set_parameters_dict({"E": 1.0, "nu": 0.3, "density": 1.0, "additional_material_params": [box]})


@pytest.mark.parametrize("name", ["E", "nu", "density"])
def test_boxes_need_the_values_outside(name):
    others = {k: v for k, v in BOX.items() if k in ("E", "nu", "density") and k != name}
    with pytest.raises(ValueError, match=f"{name} of all particles must be given before"):
        solver().set_parameters_dict(others | {"additional_material_params": [BOX]})


def written(folder, content):
    file = folder / "configuration.json"
    file.write_text(json.dumps(content))
    return file


OTHERS = [
    (
        {"substep_perframe": 10},
        "'substep_perframe' is not supported: MotionPhysics has it: pass dialect='motionphysics'",
    ),
    ({"total_time": 1.0}, "'total_time' is not supported"),
    ({"opt_frame_dt": 1.0}, "'opt_frame_dt' is not supported"),
    ({"fix_ground": True}, "'fix_ground' is not supported"),
    ({"substep_td": 1e-4}, "'substep_td' is unknown, the nearest known key is 'substep_dt'"),
    ({"particle_filling": {"n_gird": 3}}, "particle_filling must have known keys: 'n_gird' .* 'n_grid'"),
    ({"additional_material_params": [BOX | {"material": "sand"}]}, "'material' is not supported"),
    ({"additional_material_params": [{"point": [1, 1, 1]}]}, "must have size, E, nu"),
]


@pytest.mark.parametrize(("content", "message"), OTHERS)
def test_configurations(content, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        decode_param_json(written(tmp_path, content), "physgaussian")


@pytest.mark.parametrize("key", configuration.NOT_OF_THE_SIMULATION)
def test_keys_of_other_programs_are_left_out_with_a_warning(key, tmp_path):
    file = written(tmp_path, {"E": 2e5, key: 1})
    with pytest.warns(UserWarning, match=f"have no effect: {key}"):
        material, *_ = decode_param_json(file)
    assert material["E"] == 2e5 and key not in material


def condition(kind):
    values = {"point": [0.5] * 3, "size": [0.1] * 3, "velocity": [0.0] * 3, "force": [0.0] * 3, "normal": [0, 0, 1]}
    values |= {"half_height_and_radius": [0.1, 0.1], "rotation_scale": 1.0, "translation_scale": 0.0}
    values |= {"surface": "sticky", "friction": 0.0, "start_time": 0.0, "end_time": 1.0}
    values |= {"start_position": 0.6, "end_position": 0.4, "num_layers": 50, "radius": 0.1}
    return {"type": kind, **{key: values[key] for key in configuration.CONDITIONS[kind][1]}}


@pytest.mark.parametrize("kind", configuration.CONDITIONS)
def test_conditions(kind):
    set_boundary_conditions(solver(), [condition(kind)], {"substep_dt": 1e-4})
    with pytest.raises(ValueError, match=f"a boundary condition {kind} must have known keys: 'strat_time' is unknown"):
        set_boundary_conditions(solver(), [condition(kind) | {"strat_time": 0.0}], {"substep_dt": 1e-4})


def test_impulses_need_the_time_step():
    with pytest.raises(ValueError, match="time_params must have substep_dt, got"):
        set_boundary_conditions(solver(), [{"type": "particle_impulse", "force": [0, 0, 1]}], {"frame_dt": 1e-2})


@pytest.mark.parametrize("kind", mpm_pytorch.boundary_condition.CONDITIONS)
def test_conditions_of_mpm_pytorch(kind):
    model = mpm_pytorch.MPMSolver(torch.full((2, 3), 0.5))
    with pytest.raises(ValueError, match=f"a boundary condition {kind} must have known keys: 'strat_time' .*'start_t"):
        mpm_pytorch.set_boundary_conditions(model, [{"type": kind, "strat_time": 0.0}])


# ---- materials


@pytest.mark.parametrize(("material", "name"), [(m, n) for m, names in NEEDS.items() for n in names])
def test_materials_need_their_parameters(material, name):
    one = solver()
    needed = NEEDS[material]
    one.set_parameters_dict({"material": material} | {k: v for k, v in needed.items() if k != name})
    with pytest.raises(ValueError, match=f"material '{material}' needs E.*: give {name} in set_parameters_dict"):
        one.finalize_mu_lam()
    one.set_parameters_dict({name: needed[name]})
    one.finalize_mu_lam()


@pytest.mark.parametrize("material", ["metal", "plasticine"])
@pytest.mark.parametrize("value", [0.0, torch.tensor([1.0] * 9 + [0.0])])
def test_a_yield_stress_of_zero_is_no_solid(material, value):
    one = solver()
    one.set_parameters_dict({"material": material, "E": 1e5, "nu": 0.3, "yield_stress": value})
    with pytest.raises(ValueError, match=f"yield_stress of '{material}' must be positive"):
        one.finalize_mu_lam()


OTHER_MATERIALS = sorted({m for d in dialects.DIALECTS.values() for m in d.materials} - set(dialects.BASE_MATERIALS))


@pytest.mark.parametrize("material", OTHER_MATERIALS)
def test_materials_of_another_dialect(material):
    one = solver(dialect="physgaussian")
    one.set_parameters_dict({"material": material, "E": 1e5, "nu": 0.3})
    with pytest.raises(ValueError, match=f"material '{material}' is that of .*: pass dialect= of one of "):
        one.finalize_mu_lam()


def test_a_material_without_a_law():
    one = solver(dialect="pixie")
    one.set_parameters_dict({"material": "rock_brittle", "E": 1e5, "nu": 0.3})
    with pytest.raises(NotImplementedError, match=r"material 'rock_brittle' has no law: .*CamClay"):
        one.finalize_mu_lam()


OUTSIDE = {
    **{"E": -1.0, "nu": 0.5, "density": 0.0, "yield_stress": -1.0, "xi": -0.1, "friction_angle": 90.0},
    **{"plastic_viscosity": -1.0, "softening": -1.0, "rpic_damping": 1.5, "grid_v_damping_scale": -0.1},
    **{"n_grid": 0, "grid_lim": 0.0, "hardening": 2},
}


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("form", ["number", "tensor", "nan"])
def test_values_out_of_range(name, form):
    value = math.nan if form == "nan" else OUTSIDE[name]
    value = torch.tensor(value) if form == "tensor" else value
    with pytest.raises((ValueError, TypeError), match=f"^{name} must be "):
        solver().set_parameters_dict({name: value})
    if name in table.RANGES:
        with pytest.raises(ValueError, match=f"^{name} must be a number, or have shape"):
            solver().set_parameters_dict({name: torch.zeros(3)})


@pytest.mark.parametrize("name", ["friction_angle", "plastic_viscosity", "softening", "xi"])
def test_parameters_change_between_substeps(name):
    """A value that is given after `finalize_mu_lam` acts from then on, as one from before; E and nu do not."""
    kind, first, last = {
        **{"friction_angle": ("sand", 20.0, 40.0), "plastic_viscosity": ("foam", 1.0, 50.0)},
        **{"softening": ("plasticine", 1.0, 9e3), "xi": ("metal", 0.0, 3.0)},
    }[name]
    common = {"material": kind, "E": 1e5, "nu": 0.3, "density": 500.0, "yield_stress": 100.0, "hardening": 1}

    def moved(before, later):
        one = solver(200)
        one.import_particle_v_from_torch(torch.sin(30 * one.state.x))
        one.set_parameters_dict(common | {name: before})
        one.finalize_mu_lam()
        one.set_parameters_dict({name: later, "E": 1e3} if later is not None else {})
        for k in range(20):
            one.p2g2p(k, 1e-3)
        return one.export_particle_x_to_torch()

    assert torch.equal(moved(first, last), moved(last, None))
    assert not torch.equal(moved(first, last), moved(first, None))


@pytest.mark.parametrize(
    "law",
    [
        mpm.Viscoelastic(E=1e4, nu=0.3, branch_modulus=1e3, relaxation_time=0.1),
        mpm.WeaklyCompressible(bulk_modulus=1e4),
    ],
    ids=lambda law: type(law).__name__,
)
def test_laws_that_errors_recommend_run(law):
    one = solver()
    one.set_parameters_dict({"material": law, "density": 100.0, "g": [0, 0, -9.8]})
    one.finalize_mu_lam()
    for k in range(5):
        one.p2g2p(k, 1e-4)
    one.step.check(one.state)
    assert one.export_particle_v_to_torch()[:, 2].max() < -4e-3


@pytest.mark.parametrize("key", ["substep_dt", "frame_dt"])
@pytest.mark.parametrize("value", [0.0, -1e-4, float("nan"), float("inf")])
def test_lengths_of_steps_and_frames_are_positive(tmp_path, key, value):
    with pytest.raises(ValueError, match=f"{key} must be positive and finite"):
        decode_param_json(written(tmp_path, {key: value}), "physgaussian")


@pytest.mark.parametrize(
    ("x", "volume", "message"),
    [
        ([[0.5, 0.5, 0.5], [float("nan"), 0.5, 0.5]], [1.0, 1.0], "tensor_x must be finite, got .* in row 1"),
        ([[0.5, 0.5, 0.5], [0.4, 0.5, 0.5]], [0.0, 1.0], "tensor_volume must be positive and finite, got 0.0 in row 0"),
        ([[0.5, 0.5, 0.5], [0.4, 0.5, 0.5]], [1.0, float("inf")], "tensor_volume must be positive and finite, got inf"),
    ],
)
def test_bad_particles_are_errors(x, volume, message):
    solver = MPM_Simulator_WARP(10)
    with pytest.raises(ValueError, match=message):
        solver.load_initial_data_from_torch(torch.tensor(x), torch.tensor(volume), n_grid=20)
