"""Tensor arguments of the other interfaces have their gradient, by central differences, or are refused by name."""

import pytest
import torch

import torch_mpm as mpm
from torch_mpm.compat import mpm_pytorch, nclaw, physgaussian
from torch_mpm.compat.mpm_pytorch import constitutive_models
from torch_mpm.compat.nclaw import material, sim
from torch_mpm.compat.physgaussian import MPM_Simulator_WARP

DT, N = 1e-3, 20
COMMON = {"E": 1e5, "nu": 0.3, "density": 500.0}
MATERIALS = {
    "jelly": {},
    "metal": {"yield_stress": 1e3, "hardening": 1, "xi": 0.05},
    "plasticine": {"yield_stress": 1e3, "softening": 5e2, "hardening": 1, "xi": 0.02},
    "foam": {"yield_stress": 1e3, "plastic_viscosity": 10.0},
    "sand": {"friction_angle": 30.0},
}
EVERYWHERE = {"g": [1.0, 2.0, -9.8], "rpic_damping": 0.2, "grid_v_damping_scale": 0.97}


def cube(device, low=0.4, high=0.6):
    axis = torch.linspace(low, high, 4, dtype=torch.float64, device=device)
    x = torch.cartesian_prod(axis, axis, axis)
    return x + 0.01 * torch.sin(40 * x.flip(1))


def motion(x):
    c = x - x.mean(0)
    return torch.stack([5 * c[:, 2], -3 * c[:, 0], -1 - 4 * c[:, 2]], 1)


def compared(function, value, device):
    """The gradient of a function of a tensor along a direction, against a central difference."""
    value = torch.tensor(value, dtype=torch.float64, device=device)
    given = value.clone().requires_grad_()
    (grad,) = torch.autograd.grad(function(given), given)
    direction = torch.cos(torch.arange(value.numel(), dtype=value.dtype, device=device)).reshape(value.shape)
    h = 1e-4 * float(value.abs().max()) + 1e-9
    with torch.no_grad():
        difference = (function(value + h * direction) - function(value - h * direction)) / (2 * h)
    assert float((grad * direction).sum()) == pytest.approx(float(difference), rel=1e-3)
    assert float(difference) != 0


def compared_or_refused(loss, name, value, differentiable, device):
    """A tensor that requires a gradient gets it, or an error that names the argument."""
    if differentiable:
        compared(loss, value, device)
        return
    given = torch.tensor(value, dtype=torch.float64, device=device, requires_grad=True)
    with pytest.raises((TypeError, ValueError), match=f"^{name} must"):
        loss(given)


def loss_of(x):
    return ((x - 0.5) ** 2 * torch.arange(1.0, 4.0, dtype=x.dtype, device=x.device)).sum()


# ---- PhysGaussian


def simulated(device, parameters, act=lambda solver: None, steps=8, dialect=None):
    x = cube(device)
    solver = MPM_Simulator_WARP(10, dialect=dialect)
    solver.load_initial_data_from_torch(x, torch.full_like(x[:, 0], 1e-4), n_grid=N)
    solver.import_particle_v_from_torch(motion(x))
    solver.set_parameters_dict(COMMON | parameters)
    act(solver)
    solver.finalize_mu_lam()
    for k in range(steps):
        solver.p2g2p(*(() if dialect == "motionphysics" else (k,)), DT)
    return loss_of(solver.export_particle_x_to_torch())


USED = [(m, name) for m, own in MATERIALS.items() for name in (*COMMON, *own, *EVERYWHERE) if name != "hardening"]


@pytest.mark.parametrize(("kind", "name"), USED)
def test_parameters_of_the_simulator(kind, name, device):
    parameters = {"material": kind} | MATERIALS[kind] | EVERYWHERE

    def loss(value):
        return simulated(device, parameters | {name: value})

    compared(loss, (COMMON | parameters)[name], device)


OF_DIALECTS = {
    ("physics3d", "jelly"): {"E": 1e-2, "mu_N": 2e4, "lam_N": 3e4, "viscosity": 50.0},
    ("dreamphysics", "jelly"): {"E": 1e-2},
    ("physflow", "newtonian"): {"E": 1e-2},
    ("physflow", "non_newtonian"): {"E": 1e-2, "yield_stress": 1e-2, "plastic_viscosity": 1e-3},
    ("physflow", "plasticine"): {"E": 1e-2, "yield_stress": 1e-2, "softening": 5e2},
    ("motionphysics", "newtonian"): {"mu": 4e-3, "bulk": 0.8},
    ("motionphysics", "fluid"): {"bulk": 0.8},
    ("pixie", "fluid"): {"bulk_modulus": 8e4},
    ("gaussianfluent", "watermelon"): {
        "beta": 0.5,
        "alpha_0": -0.02,
        "xi": 2.0,
        "hardening": 1,
        "friction_angle": 30.0,
    },
    ("warp_mpm", "neo-hookean"): {},
}


@pytest.mark.parametrize(("dialect", "kind"), OF_DIALECTS)
def test_parameters_of_dialects(dialect, kind, device):
    """By multiples of all parameters of a material."""
    own = OF_DIALECTS[dialect, kind] or {"E": 1e5}
    names = [name for name in own if name != "hardening"]

    def loss(factors):
        given = {name: own[name] * factor for name, factor in zip(names, factors.unbind(), strict=True)}
        return simulated(device, {"material": kind} | own | given, dialect=dialect)

    compared(loss, [1.0] * len(names), device)


@pytest.mark.parametrize("name", ["yield_stress", "xi", "friction_angle", "plastic_viscosity", "softening"])
def test_parameters_per_particle(name, device):
    kind = next(m for m, own in MATERIALS.items() if name in own)
    value = MATERIALS[kind][name] * (1 + 0.1 * torch.sin(torch.arange(64.0, dtype=torch.float64)))
    compared(lambda v: simulated(device, {"material": kind} | MATERIALS[kind] | {name: v}), value.tolist(), device)


@pytest.mark.parametrize("name", ["E", "nu", "density"])
def test_values_in_a_box(name, device):
    box = {"point": [0.5, 0.5, 0.6], "size": [1.0, 1.0, 0.1], "E": 2e5, "nu": 0.2, "density": 900.0}

    def loss(value):
        return simulated(device, {"additional_material_params": [box | {name: value}]})

    compared(loss, box[name], device)


WHERE = {"point": [0.5, 0.5, 0.5], "size": [0.08, 0.2, 0.2]}
TIMES = {"start_time": 0.0, "end_time": 5.5 * DT}
CALLS = {
    "add_surface_collider": ({"point": [0.5, 0.5, 0.42], "normal": [0.0, 0.0, 1.0], "friction": 0.0, **TIMES}, ()),
    "set_velocity_on_cuboid": ({"velocity": [0.3, 0.1, 0.2], **WHERE, **TIMES}, ("velocity",)),
    "add_bounding_box": (TIMES, ()),
    "add_impulse_on_particles": (
        {"force": [0.3, 0.1, 0.2], "dt": DT, "num_dt": 3, "start_time": 0.0, **WHERE},
        ("force",),
    ),
    "enforce_particle_velocity_translation": ({"velocity": [0.3, 0.1, 0.2], **WHERE, **TIMES}, ("velocity",)),
    "enforce_particle_velocity_rotation": (
        {
            **{"point": [0.5, 0.5, 0.5], "normal": [0.2, 0.0, 1.0], "half_height_and_radius": [0.2, 0.08]},
            **{"rotation_scale": 3.0, "translation_scale": 0.2, **TIMES},
        },
        ("point", "normal", "rotation_scale", "translation_scale"),
    ),
    "release_particles_sequentially": (
        {"normal": [1, 0, 0], "start_position": 0.6, "end_position": 0.4, "num_layers": 50, **TIMES},
        (),
    ),
}
"""Arguments of each method, and those with a gradient."""
HALF = [k % 2 for k in range(64)]
CALLS |= {
    "enforce_grid_velocity_by_mask": ({"selection_mask": torch.ones(N, N, N, dtype=torch.int32).tolist()}, ()),
    "add_impulse_on_particles_with_mask": (
        {"force": [30.0, 10.0, 20.0], "particle_mask": HALF, **TIMES, **WHERE},
        ("force",),
    ),
    "add_constant_force": ({"force": [30.0, 10.0, 20.0], "point": [0.5] * 3, "radius": 0.1, **TIMES}, ("force",)),
    "add_impulse_on_object": (
        {"force": [0.3, 0.1, 0.2], "dt": DT, "num_dt": 3, "start_time": 0.0, **WHERE},
        ("force",),
    ),
    "enforce_scene_velocity_translation": ({"velocity": [0.3, 0.1, 0.2], **TIMES}, ("velocity",)),
    "release_particles_sequentially_size": (
        {"normal": [1, 0, 0], "start_position": 0.6, "end_position": 0.4, "num_layers": 5, **WHERE, **TIMES},
        (),
    ),
    "tear_object": (
        {"force": [0.3, 0.1, 0.2], "dt": DT, "num_dt": 3, "bbox": [[0.3, 0.7]] * 3, "axis": 0, "start_time": 0.0},
        ("force",),
    ),
}
"""Those of descendants."""
ARGUMENTS = [(method, name) for method, (arguments, _) in CALLS.items() for name in arguments]


@pytest.mark.parametrize(("method", "name"), ARGUMENTS)
def test_arguments_of_conditions(method, name, device):
    arguments, differentiable = CALLS[method]

    def act(solver, value):
        if method == "enforce_scene_velocity_translation":
            solver.mpm_state.object_selection = torch.tensor(HALF, device=device)
        masks = {k: torch.tensor(v, device=device) for k, v in arguments.items() if k.endswith("_mask")}
        getattr(solver, method)(**arguments | masks | {name: value})

    def loss(value):
        return simulated(device, {}, lambda solver: act(solver, value))

    compared_or_refused(loss, name, arguments[name], name in differentiable, device)


def test_vectors_of_single_tensors(device):
    """A list with a tensor that requires grad is a tensor."""

    def loss(value):
        def act(solver):
            solver.add_impulse_on_particles([0.1, value, 0.2], DT, num_dt=3, size=(2, 2, 2))

        return simulated(device, {"g": [0.0, 0.0, value]}, act)

    compared(loss, 0.7, device)


@pytest.mark.parametrize(
    ("parameters", "name", "message"),
    [
        ({"material": "jelly"}, "yield_stress", "no effect on material 'jelly'"),
        ({"material": "sand"}, "xi", "no effect on material 'sand'"),
        ({"material": "metal", "yield_stress": 1.0, "hardening": 0}, "xi", "while hardening is 0"),
        ({"material": mpm.NeoHookean(E=1e5, nu=0.3)}, "E", "no effect on a law"),
        ({}, "n_grid", "number of the whole simulation"),
        ({}, "grid_lim", "number of the whole simulation"),
        ({}, "hardening", "number of the whole simulation"),
        ({}, "rpic_damping", "be negative where it requires grad"),
    ],
)
def test_gradients_without_effect_are_refused(parameters, name, message):
    value = torch.tensor(-1.0 if name == "rpic_damping" else 1.0, requires_grad=True)
    with pytest.raises(ValueError, match=f"^{name} must not.*{message}"):
        simulated("cpu", parameters | {name: value})


@pytest.mark.parametrize("key", ["point", "size"])
def test_places_of_boxes_have_no_gradient(key):
    box = {"point": [0.5, 0.5, 0.6], "size": [1.0, 1.0, 0.1], "E": 2e5, "nu": 0.2, "density": 900.0}
    box[key] = torch.tensor(box[key], requires_grad=True)
    with pytest.raises(ValueError, match=f"{key} must not require grad: it selects particles"):
        simulated("cpu", {"additional_material_params": [box]})


STARTS = {
    "tensor_x": lambda x: x.tolist(),
    "tensor_volume": lambda x: [1e-4] * len(x),
    "tensor_cov": lambda x: (0.1 + x.repeat(1, 2)).tolist(),
    "x": lambda x: x.tolist(),
    "v": lambda x: motion(x).tolist(),
    "F": lambda x: (torch.eye(3, dtype=x.dtype) + 0.05 * torch.sin(9 * x[:, :, None] * x[:, None])).tolist(),
    "C": lambda x: torch.sin(9 * x[:, :, None] * x[:, None] + x[:, None]).tolist(),
    "all_particle_densities": lambda x: [500.0] * len(x),
}


@pytest.mark.parametrize("name", STARTS)
def test_tensors_of_the_start(name, device):
    x = cube("cpu")

    def loss(value):
        solver = MPM_Simulator_WARP(10)
        given = {"tensor_x": x.to(device), "tensor_volume": torch.full_like(x[:, 0], 1e-4, device=device)}
        solver.load_initial_data_from_torch(**given | ({name: value} if name.startswith("tensor") else {}), n_grid=N)
        if name != "v":
            solver.import_particle_v_from_torch(motion(x).to(device))
        if len(name) == 1:
            getattr(solver, f"import_particle_{name}_from_torch")(value)
        solver.set_parameters_dict(COMMON | {"g": [0.0, 0.0, -9.8]})
        if name == "all_particle_densities":
            solver.reset_densities_and_update_masses(value)
        solver.finalize_mu_lam()
        for k in range(6):
            solver.p2g2p(k, DT)
        return loss_of(solver.export_particle_x_to_torch()) + 0.1 * solver.export_particle_cov_to_torch().square().sum()

    compared(loss, STARTS[name](x), device)


# ---- MPM-PyTorch


def stepped(device, options=None, conditions=(), steps=6):
    x = cube(device)
    solver = mpm_pytorch.MPMSolver(x, dt=DT, num_grids=N, size=(0.2, 0.2, 0.2), **options or {})
    mpm_pytorch.set_boundary_conditions(solver, conditions)
    model = constitutive_models.CorotatedElasticity(E=1e5).to(device)
    v, C, F = motion(x), torch.zeros(len(x), 3, 3, dtype=x.dtype, device=device), torch.eye(3, dtype=x.dtype)
    F = F.to(device).repeat(len(x), 1, 1)
    for _ in range(steps):
        x, v, C, F = solver(x, v, C, F, model(F))
    return loss_of(x)


@pytest.mark.parametrize(
    ("name", "value"),
    [("rho", 800.0), ("gravity", [1.0, 2.0, -9.8]), ("size", [0.2, 0.2, 0.2]), ("center", [0.5, 0.5, 0.5])]
    + [("clip_bound", 0.5), ("damping", 0.9), ("dt", DT), ("num_grids", 20.0)],
)
def test_arguments_of_the_solver(name, value, device):
    if name in ("rho", "gravity"):
        compared(lambda v: stepped(device, {name: v}), value, device)
        return
    tensor = torch.tensor(value, requires_grad=True)
    with pytest.raises((TypeError, ValueError), match=f"^{name} must"):
        mpm_pytorch.MPMSolver(cube("cpu"), **{name: tensor})


TYPES = {
    "cuboid": (CALLS["set_velocity_on_cuboid"][0], ("velocity",)),
    "surface_collider": ({**CALLS["add_surface_collider"][0], "surface": "slip"}, ()),
    "particle_impulse": ({"force": [0.3, 0.1, 0.2], "num_dt": 3, "start_time": 0.0, **WHERE}, ("force",)),
    "enforce_particle_translation": CALLS["enforce_particle_velocity_translation"],
    "enforce_particle_velocity_rotation": CALLS["enforce_particle_velocity_rotation"],
    "sdf_collider": ({"bound": 0.45, "dim": 0, **TIMES}, ()),
}


@pytest.mark.parametrize(
    ("kind", "name"), [(k, n) for k, (arguments, _) in TYPES.items() for n in arguments if n not in ("surface", "dim")]
)
def test_arguments_of_conditions_of_the_solver(kind, name, device):
    arguments, differentiable = TYPES[kind]

    def loss(value):
        return stepped(device, None, [{"type": kind, **arguments, name: value}])

    compared_or_refused(loss, name, arguments[name], name in differentiable, device)


@pytest.mark.parametrize("name", ["x", "v", "C", "F", "stress"])
def test_tensors_of_a_call(name, device):
    x = cube(device)
    shear = torch.sin(9 * x[:, :, None] * x[:, None])
    tensors = {"x": x, "v": motion(x), "C": shear, "F": shear + torch.eye(3, dtype=x.dtype, device=device)}
    tensors["stress"] = 1e4 * (shear + shear.mT)

    def loss(value):
        solver = mpm_pytorch.MPMSolver(x, dt=DT, num_grids=N, size=(0.2, 0.2, 0.2))
        after = solver(*(tensors | {name: value}).values())
        return loss_of(after[0]) + sum(1e-3 * part.square().sum() for part in after[1:])

    compared(loss, tensors[name].tolist(), device)


@pytest.mark.parametrize("name", ["E", "nu", "sigma_y", "friction_angle", "cohesion"])
def test_models_copy_numbers(name):
    """Arguments of a model are refused; a tensor that is assigned has its gradient."""
    kind = next(
        k
        for k in (constitutive_models.VonMisesPlasticity, constitutive_models.DruckerPragerPlasticity)
        if name in k.__init__.__code__.co_varnames
    )
    with pytest.raises(ValueError, match=f"^{name} must not require grad: .*model.{'log_E' if name == 'E' else name}"):
        kind(**{name: torch.tensor(0.3, requires_grad=True)})
    law = kind().double()
    attribute = "log_E" if name == "E" else name
    F = torch.eye(3).double() + 0.1 * torch.linspace(-1, 1, 45).double().reshape(5, 3, 3).sin()

    def loss(value):
        setattr(law, attribute, value)
        return loss_of(law(F).reshape(-1, 3))

    compared(loss, (getattr(law, attribute) + (0.01 if name == "cohesion" else 0)).tolist(), "cpu")


# ---- NCLaw

CONFIGURATION = {"num_grids": N, "dt": DT, "bound": 3, "gravity": [0.0, 0.0, -9.8], "eps": 1e-7, "bc": "freeslip"}


def advanced(device, eps=0.0, gravity=(0.0, 0.0, -9.8), change=lambda statics: None, steps=4):
    model = sim.MPMModel(N, DT, 3, gravity, eps, device)
    x = cube(device)
    statics = model.statics(len(x))
    statics.vol, statics.rho = statics.vol.double(), statics.rho.double()
    sections = [30, 34]
    statics.update_vol(sections, [1e-4, 1e-4])
    statics.update_rho(sections, [500.0, 700.0])
    statics.update_clip_bound(sections, [0.5, 0.5])
    statics.update_enabled(sections, [(0, 9), (0, 9)])
    change(statics)
    law = material.CorotatedElasticity({"E": 1e5, "nu": 0.3}).to(device)
    v, C, F = motion(x), torch.zeros(len(x), 3, 3, dtype=x.dtype, device=device), torch.eye(3, dtype=x.dtype)
    F = F.to(device).repeat(len(x), 1, 1)
    for _ in range(steps):
        x, v, C, F = sim.MPMDiffSim(model)(statics, x, v, C, F, law(F))
    return loss_of(x)


@pytest.mark.parametrize("eps", [0.0, 1e-7])
@pytest.mark.parametrize("name", ["vol", "rho", "gravity"])
def test_statics_and_gravity(name, eps, device):
    if name == "gravity":
        compared(lambda g: advanced(device, eps, g), [0.3, 0.2, -9.8], device)
        return

    def loss(value):
        return advanced(device, eps, change=lambda statics: getattr(statics, f"update_{name}")([30, 34], list(value)))

    compared(loss, [1e-4, 2e-4] if name == "vol" else [500.0, 700.0], device)


@pytest.mark.parametrize("name", ["num_grids", "dt", "bound", "gravity", "eps"])
def test_values_of_a_configuration_are_copied(name):
    value = torch.tensor(CONFIGURATION[name] if name == "gravity" else float(CONFIGURATION[name]), requires_grad=True)
    with pytest.raises(ValueError, match=f"^{name} must not require grad: values of a configuration are copied"):
        nclaw.sim.MPMModelBuilder().parse_cfg(CONFIGURATION | {name: value})
    with pytest.raises(ValueError, match=r"^E must not require grad: .*law\.log_E"):
        material.CorotatedElasticity({"E": torch.tensor(1e5, requires_grad=True), "nu": 0.3})


@pytest.mark.parametrize("name", ["x", "v", "C", "F", "stress", "rho", "vol"])
def test_a_forward_simulator_refuses_what_requires_grad(name):
    model = sim.MPMModel(N, DT, 3, (0.0, 0.0, -9.8))
    state, statics = model.state(4), model.statics(4)
    state.particle.x = torch.full((4, 3), 0.5)
    statics.vol, statics.rho = statics.vol + 1e-4, statics.rho + 500
    statics.enabled += 1
    holder = statics if name in ("rho", "vol") else state.particle
    setattr(holder, name, getattr(holder, name).clone().requires_grad_())
    with pytest.raises(ValueError, match=f"^{name} must not require grad: MPMForwardSim has no gradients"):
        sim.MPMForwardSim(model)(statics, state)
    with torch.no_grad():
        sim.MPMForwardSim(model)(statics, state)


def test_arrays_of_bodies_have_no_gradient():
    tensor = torch.zeros(1, 3, requires_grad=True)
    with pytest.raises(ValueError, match=r"^pos must not require grad"):
        sim.MPMInitData(rho=1.0, clip_bound=0.5, span=(0, 1), num_particles=1, vol=1.0, pos=tensor)
    body = sim.MPMInitData(rho=1.0, clip_bound=0.5, span=(0, 1), num_particles=1, vol=1.0, pos=tensor.detach().numpy())
    for name in ("lin_vel", "ang_vel", "ind_vel"):
        with pytest.raises(ValueError, match=f"^{name} must not require grad"):
            getattr(body, f"set_{name}")(list(tensor[0]))


def test_physgaussian_names_every_method():
    """No method that takes arguments is missing here."""
    methods = [
        n
        for n in dir(physgaussian.MPM_Simulator_WARP)
        if n.startswith(("add_", "set_", "enforce_", "release_", "tear_"))
    ]
    others = {"add_boundary", "set_parameters", "set_parameters_dict", "set_E_nu", "set_E_nu_from_torch"}
    assert set(methods) - others - {"set_velocity_by_index"} == set(CALLS)
