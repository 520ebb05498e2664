"""Gradients of heat in rollouts of the fused op, against single steps composed of ops."""

import copy
import random

import pytest
import torch
from heat_scenes import DT, LAWS, THERMAL, TRANSFERS, bodies, composed, held, scene, terms, thermal
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.catalogue.laws import named
from torch_mpm import heat_boundaries
from torch_mpm.laws.parameters import PerMaterial
from torch_mpm.rollouts import plan_rollout
from torch_mpm.rollouts.op_memory import _Sizes, recorded_bytes

F64 = torch.float64
STATE = ("x", "v", "C", "F", "J", "mass", "volume", "temperature")
ALL = (*STATE, "extra")
MIXTURE = ["expansion", "wax", "two tables", "expanding fluid", "melting and flow", "viscoelastic wax"]
MIXTURE += ["neo_hookean", "fluid", "viscoelastic"]
TEMPERED = (*THERMAL, "mixture by temperature")
OF_DIFFERENCES = ("expansion", "wax")
PARAMETERS = ("conductivity", "specific_heat", "melting_point", "latent_heat")


def melting(state):
    """A state with particles that melt or freeze from the first step on."""
    if "liquid" not in state.extra:
        return state
    part = torch.arange(len(state), device=state.x.device) % 3 != 0
    share = torch.linspace(0.2, 0.8, len(state), dtype=state.x.dtype, device=state.x.device)
    return state.replace(extra=state.extra | {"liquid": torch.where(part, share, state.extra["liquid"])})


def uneven(step, state, places=0.05, speeds=0.0):
    """The state with other places, by a share of dx, and speeds [m/s].

    The area of a free surface and the rate of strain are norms. Their derivatives at zero are directions of rounding.
    """
    g = torch.Generator().manual_seed(5)
    noise = [(2 * torch.rand(state.x.shape, generator=g, dtype=F64) - 1).to(state.x) for _ in range(2)]
    return state.replace(x=state.x + places * step.grid.dx * noise[0], v=state.v + speeds * noise[1])


def with_leaves(step, state):
    """The state with leaves in the place of its tensors, and all leaves by name; sets those of the parameters."""
    leaves = {name: t for name in STATE if (t := getattr(state, name)) is not None} | state.extra
    leaves = {name: t.detach().clone().requires_grad_() for name, t in leaves.items()}
    extra = {name: leaves[name] for name in state.extra}
    state = state.replace(**{name: leaves[name] for name in STATE if name in leaves}, extra=extra)
    for name in PARAMETERS if step.heat.melts else PARAMETERS[:2]:
        value = getattr(step.heat, name)
        if not isinstance(value, PerMaterial):
            leaves[name] = torch.as_tensor(value).to(state.x).detach().clone().requires_grad_()
            setattr(step.heat, name, leaves[name])
    return state, leaves


DENSE = {2: 256, 3: 64}
"""Particles of a cell with which records have the nodes of each step, by dimension."""


def loss_of(end, of=ALL):
    """A sum of fields with random weights; the sine keeps large ones from hiding others."""
    g, total = torch.Generator().manual_seed(1), 0.0
    names = [name for name in of if name not in ("mass", "volume", "extra")]
    fields = [t for name in names if (t := getattr(end, name)) is not None]
    for t in (*fields, *(end.extra.values() if "extra" in of else ())):
        weight = torch.rand(t.shape, generator=g, dtype=F64).to(t)
        total = total + (weight * t.sin()).sum()
    return total


def tempered(name, *given, **options):
    """A scene of laws that read the temperature, with shear, and with particles on both sides of a collapse."""
    step, state = thermal(MIXTURE if name == "mixture by temperature" else [name], *given, **options)
    liquid = (1.5 * state.extra["liquid"] - 0.25).clamp(0, 1)
    return step, state.replace(v=40 * (state.x - 0.45).flip(1), extra=state.extra | {"liquid": liquid})


def gradients(run, step, state, n, dt, of=ALL, **options):
    """Gradients of a loss of some fields by all leaves, zero where a leaf takes no part."""
    state, leaves = with_leaves(step, state)
    if isinstance(dt, torch.Tensor):
        dt = leaves["dt"] = dt.detach().clone().requires_grad_(not step.flip)
    end = run(step, state, n, dt, **options)
    leaves = {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}
    grads = torch.autograd.grad(loss_of(end, of), list(leaves.values()), allow_unused=True, materialize_grads=True)
    return dict(zip(leaves, grads, strict=True))


def compare(step, state, n=6, dt=DT, tolerance=1e-10, of=ALL, **options):
    """Gradients of the op are those of single steps, relative to the largest of each; returns the former. On CUDA sums
    of nodes have another order in each run."""
    device = state.x.device
    step, dt = step.to(device), dt.to(device) if isinstance(dt, torch.Tensor) else dt
    tolerance *= 10 if state.x.is_cuda else 1
    step.heat.tolerance, state = 1e-12 if state.x.dtype == F64 else 1e-6, melting(state)
    assert plan_rollout(step, with_leaves(step, state)[0], n, dt).executor == "fused"
    found = gradients(mpm.rollout, step, state, n, dt, of, **options)
    expected = gradients(composed, step, state, n, dt, of)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        scale = float(value.abs().max())
        if name in PARAMETERS:  # A sum of terms that nearly cancel.
            scale = max(scale, float(expected["temperature"].abs().sum()) / 1e3)
        error = float((found[name] - value).abs().max())
        assert error <= tolerance * scale, f"{name}: {error / scale}"
    return found


@pytest.mark.parametrize("melts", [False, True])
@pytest.mark.parametrize("transfer", TRANSFERS)
def test_transfers(dim, transfer, melts, device):
    found = compare(*scene(dim, transfer=transfer, melts=melts, device=device))
    wanted = ["x", "mass", "volume", "temperature", "conductivity", "specific_heat"]
    wanted += ["temperature_gradient"] if transfer in ("hybrid", "apic") else []
    wanted += ["liquid", "melting_point", "latent_heat"] if melts else []
    assert all(float(found[name].abs().max()) > 0 for name in wanted)


@pytest.mark.parametrize("law", [*LAWS, "mixture"])
def test_laws(dim, law, device):
    compare(*scene(dim, law=law, device=device, melts=True))


@pytest.mark.parametrize("seed", range(16))
def test_random_combinations(seed, device):
    """Laws x transfers x kernels x batches x parameters x time steps x checkpoints, in both dtypes."""
    r = random.Random(seed)
    scenes, dtype, law = r.choice((1, 3)), r.choice((torch.float32, F64)), r.choice((*LAWS, "mixture", *TEMPERED))
    given = (r.choice((2, 3)), dtype, scenes)
    options = {
        "per_particle": r.random() < 0.5, "kernel": r.choice(("quadratic", "cubic")), "transfer": r.choice(TRANSFERS),
        "flip": r.choice((0.0, 0.4)), "compensated": r.choice((True, False)), "device": device,
        "deterministic": r.choice((True, False)),
    }  # fmt: skip
    if law in TEMPERED:
        step, state = tempered(law, *given, **options)
    else:
        step, state = scene(*given, law, melts=r.random() < 0.5, **options)
    dt = torch.linspace(1, 2, scenes, dtype=dtype) * DT if r.random() < 0.5 else DT
    checkpoint = r.choice((None, 2, mpm.Checkpoints(states=2), mpm.Checkpoints(memory=1e9)))
    compare(step, state, r.choice((2, 5)), dt, 1e-9 if dtype == F64 else 2e-3, checkpoint=checkpoint)


@pytest.mark.parametrize("law", ["neo_hookean", "expansion", "wax"])
@pytest.mark.parametrize("transfer", ["hybrid", "apic", "flip", "pic"])
def test_single_precision(transfer, law, dim, device):
    given, options = (dim, torch.float32), {"transfer": transfer, "device": device}
    made = tempered(law, *given, **options) if law in THERMAL else scene(*given, melts=True, **options)
    compare(*made, n=3, tolerance=1e-5 if dim == 2 else 3e-5)  # sums over more particles


def test_stiff_conduction(device):
    """Diffusion numbers far above one, at which the solves take many iterations."""
    step, state = scene(2, device=device)
    step.heat.conductivity = 2e7
    compare(step, state, 3, tolerance=1e-8)


@pytest.mark.parametrize("conductivity", [2e2, 2e4, 2e6])
@pytest.mark.parametrize("checkpoint", [2, mpm.Checkpoints(memory=1e9)])
def test_many_particles_in_a_cell(conductivity, checkpoint, device):
    """Their record has the nodes and the increments of each solve, which the adjoint does not compute once more."""
    step, state = scene(2, per_cell=DENSE[2], device=device)
    step.heat.conductivity = conductivity
    compare(step, state, 3, tolerance=1e-8, checkpoint=checkpoint)


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
@pytest.mark.parametrize("law", ["neo_hookean", "wax"])
@pytest.mark.parametrize("conductivity", [1e2, 2e6])
def test_particles_that_leave_their_base_blocks(conductivity, law, dtype, fixed, dim, device):
    """Particles move by 1.2 cells in one call. In a pool that grows, activations last on CUDA, unless conjugate
    gradients are needed; those of recomputed steps do not."""
    options = {"dtype": dtype, "device": device, "max_blocks": 3**dim if fixed else None}
    step, state = tempered(law, dim, **options) if law in THERMAL else scene(dim, law=law, **options)
    step.heat.conductivity = conductivity
    state = state.replace(v=state.v + 25.0)
    compare(step, state, 24, tolerance=1e-8 if dtype == F64 else 2e-3, checkpoint=24)
    step.check()


@pytest.mark.parametrize(
    *in_pairs(
        boundary=["none", "nodes", "surface", "terms", "plastic"], melts=[False, True], transfer=TRANSFERS, dim=[2, 3],
        recorded=[False, True], dtype=[F64, torch.float32], deterministic=[False, True],
    )
)  # fmt: skip
def test_recorded_nodes(boundary, melts, transfer, dim, recorded, dtype, deterministic, device):
    """Of many particles in a cell: all that a step has at its nodes is recorded, for each kind of boundary."""
    law, scenes = "von_mises" if boundary == "plastic" else "neo_hookean", 2
    step, state = scene(
        dim, dtype, scenes, law, melts=melts, transfer=transfer, deterministic=deterministic, per_cell=DENSE[dim]
    )
    ball = step.boundaries.entries[0]
    if boundary in ("nodes", "surface"):
        kind = heat_boundaries.Fixed if boundary == "nodes" else heat_boundaries.FixedSurface
        step = held(step, (kind, ball, torch.linspace(20.0, 30.0, scenes, dtype=dtype)))
    elif boundary == "terms":
        made = terms(scenes)
        step.heat.boundaries = [*made["convection"], *made["radiation"], *made["source"]]
    elif boundary == "plastic":
        step.heat.plastic_heating = 0.9
    step, state = step.to(device), state.to(device=device)
    prepared = step.prepare(state)
    pool = step.grid.measured_pool(prepared.x, prepared.scene)
    assert not _Sizes(step, prepared, pool)._grid_is_shared()
    checkpoint = mpm.Checkpoints(memory=1e9) if recorded else 2
    compare(step, state, 3, tolerance=1e-8 if dtype == F64 else 2e-3, checkpoint=checkpoint)


def test_parameters_of_materials(device):
    """Parts of a parameter, by the autograd of torch before the op."""
    step, state = scene(2, law="mixture", device=device)
    parts = [torch.tensor(500.0 * (1 + k), dtype=F64, device=device, requires_grad=True) for k in range(len(LAWS))]
    step.heat.conductivity = PerMaterial(parts)
    grads = []
    for run in (mpm.rollout, composed):
        end = run(step, state, 4, DT)
        grads.append(torch.stack(torch.autograd.grad(loss_of(end), parts)))
    assert plan_rollout(step, state, 4, DT).executor == "fused" and bool((grads[0] != 0).all())
    torch.testing.assert_close(*grads, rtol=1e-9, atol=0)


@pytest.mark.parametrize("law", ["neo_hookean", "mixture by temperature"])
@pytest.mark.parametrize("transfer", TRANSFERS)
def test_absent_particles_and_those_outside(dim, transfer, law, device):
    """The gradient of what they keep is one."""
    options = {"transfer": transfer, "scenes": 2, "device": device}
    step, state = tempered(law, dim, **options) if law in TEMPERED else scene(dim, melts=True, **options)
    step.walls = None
    absent = torch.arange(len(state), device=device) % 3 == 0
    outside = torch.tensor([500.0, *[0.0] * (dim - 1)], dtype=F64, device=device)
    state = state.replace(
        scene=state.scene.where(~absent, -1), v=torch.where(state.scene[:, None] == 1, outside, state.v)
    )
    compare(step, uneven(step, state, speeds=20.0), 12)
    start = state.replace(temperature=state.temperature.clone().requires_grad_())
    end = mpm.rollout(step, start, 12, DT).temperature
    (grad,) = torch.autograd.grad(end[absent].sum(), start.temperature)
    assert torch.equal(grad, absent.to(grad))


@pytest.mark.parametrize("law", ["neo_hookean", "wax"])
def test_paused_scenes(law, device):
    """A scene whose time step is zero passes its gradients on."""
    options = {"scenes": 3, "device": device}
    step, state = tempered(law, 2, **options) if law in THERMAL else scene(2, melts=True, **options)
    compare(step, state, 3, torch.tensor([1.0, 0.0, 2.0], dtype=F64) * DT)


@pytest.mark.parametrize(
    ("law", "melts"), [("neo_hookean", False), ("neo_hookean", True), ("expansion", True), ("wax", True)]
)
@pytest.mark.parametrize("transfer", TRANSFERS)
def test_gradcheck(transfer, melts, law, device):
    """Two steps of a few particles, against differences."""
    options = {"transfer": transfer, "device": device}
    step, state = tempered(law, 2, **options) if law in THERMAL else scene(2, melts=melts, **options)
    step.heat.tolerance, state = 1e-13, melting(state).select(torch.arange(6, device=device))
    names = ["x", "mass", "volume", "temperature", *state.extra]
    parameters = PARAMETERS if melts else PARAMETERS[:2]

    def run(*tensors):
        given = dict(zip([*names, *parameters], tensors, strict=True))
        for name in parameters:
            setattr(step.heat, name, 1000 * given[name])
        extra = {name: given[name] for name in state.extra}
        start = state.replace(**{name: given[name] for name in names[:4]}, extra=extra)
        end = mpm.rollout(step, start, 2, 20 * DT)
        return end.temperature, end.x, *end.extra.values()

    numbers = (2.0, 0.1, 0.003, 0.5)[: len(parameters)]
    scaled = [torch.tensor(v, dtype=F64, device=device) for v in numbers]
    leaves = [getattr(state, name) for name in names[:4]] + [*state.extra.values(), *scaled]
    leaves = [t.detach().clone().requires_grad_() for t in leaves]
    assert torch.autograd.gradcheck(run, leaves, eps=1e-6, atol=1e-6, rtol=1e-5, nondet_tol=1e-9)


@pytest.mark.parametrize("law", ["fluid", *(pytest.param(name, marks=pytest.mark.thorough) for name in OF_DIFFERENCES)])
@pytest.mark.parametrize("transfer", TRANSFERS)
def test_differences_over_200_steps_with_melting(transfer, law, device):
    """The derivative along a direction of all inputs is that of differences."""
    options = {"transfer": transfer, "device": device}
    step, state = tempered(law, 2, **options) if law in THERMAL else scene(2, melts=True, law=law, **options)
    step.heat.tolerance = 1e-13
    state = melting(state)

    def end(name, shift):
        given = copy.deepcopy(step)
        start, leaves = with_leaves(given, state)
        leaf = leaves[name]
        move = float(leaf.detach().abs().max()) * torch.rand(
            leaf.shape, generator=torch.Generator().manual_seed(4), dtype=F64
        )
        with torch.no_grad():
            leaf += shift * move.to(leaf)
        after = mpm.rollout(given, start, 200, DT)
        return loss_of(after), leaf, move.to(leaf), after

    for name in ("temperature", "liquid", "mass", "volume", *PARAMETERS):
        loss, leaf, move, after = end(name, 0.0)
        assert float((after.extra["liquid"] - state.extra["liquid"]).detach().abs().max()) > 0.1
        found = float((torch.autograd.grad(loss, leaf)[0] * move).sum())
        h = 1e-6 if law == "fluid" else 1e-5  # 200 steps of a solid have more rounding
        with torch.no_grad():
            expected = float(end(name, h)[0] - end(name, -h)[0]) / (2 * h)
        # On CUDA sums of nodes have another order in each run.
        least = 0.1 if state.x.is_cuda or law != "fluid" else 0.01
        rounding = 4 * torch.finfo(F64).eps * abs(float(loss.detach())) / h  # of the differences
        assert abs(found - expected) <= 1e-6 * max(abs(found), least) + rounding, f"{name}: {found} and {expected}"


@pytest.mark.parametrize(*in_pairs(with_held=[False, True], name=[*terms(), "all"], dim=[2, 3], melts=[False, True]))
def test_free_surface_and_sources(dim, name, with_held, melts, device):
    """Terms of boundaries, alone, together and beside obstacles that hold the nodes in them."""
    step, state = scene(dim, melts=melts, device=device)
    step.heat.reference = 290.0
    chosen = [t for own in terms().values() for t in own] if name == "all" else terms()[name]
    step.heat.boundaries = chosen
    if with_held:
        region, plate = bodies(dim)["sphere"], bodies(dim)["plane"]
        step = held(step, (heat_boundaries.Fixed, region, 40.0), (heat_boundaries.Fixed, plate, -5.0))
        step.heat.boundaries = [*chosen, *step.heat.boundaries.entries]
    compare(step, uneven(step, state), 4)


@pytest.mark.parametrize("run", [mpm.rollout, composed])
def test_the_surface_inside_of_a_lattice(dim, run, device):
    """Places that differ by rounding have the same gradient: inside of a lattice the area of a node is rounding."""
    step, state = scene(dim, transfer="apic", device=device)  # the hybrid has a norm too, of the rate of strain
    step.heat.boundaries, step.heat.tolerance = terms()["flux"], 1e-12
    state = state.replace(v=torch.zeros_like(state.v))
    eps = torch.finfo(F64).eps
    nudged = state.replace(x=state.x * (1 + 2 * eps * torch.rand(state.x.shape, dtype=F64).to(state.x)))
    found, expected = (gradients(run, step, s, 1, DT) for s in (nudged, state))
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=0, atol=1e-6 * float(value.abs().max()))


@pytest.mark.parametrize(*in_pairs(shape=bodies(2), dim=[2, 3], melts=[False, True], others=[False, True]))
def test_held_surfaces(dim, shape, melts, others, device):
    """Of obstacles of all shapes, alone, and beside terms of the free surface and nodes that are held."""
    step, state = scene(dim, melts=melts, device=device)
    chosen = [t for own in terms().values() for t in own] if others else []
    held_nodes = [(heat_boundaries.Fixed, mpm.Plane((0.0, 0.3, 0.0)[:dim], (0.0, 1.0, 0.0)[:dim]), -5.0)]
    step = held(step, (heat_boundaries.FixedSurface, bodies(dim)[shape], 40.0), *(held_nodes if others else []))
    step.heat.boundaries = [*chosen, *step.heat.boundaries.entries]
    compare(step, uneven(step, state), 4)


@pytest.mark.parametrize("per_particle", [False, True])
def test_boundaries_of_scenes(per_particle, device):
    """Numbers of scenes, with time steps of their own."""
    step, state = scene(2, scenes=3, device=device)
    step.heat.reference = 290.0
    chosen = [term for own in terms(3, len(state) if per_particle else 0).values() for term in own]
    temperatures = torch.tensor([10.0, 20.0, 40.0], dtype=F64, device=device)
    region = bodies(2)["sphere"] if per_particle else mpm.Sphere((0.4, 0.3), 0.1, scene=1)
    step = held(
        step,
        (heat_boundaries.FixedSurface, region, temperatures.flip(0)),
        (heat_boundaries.Fixed, bodies(2)["plane"], temperatures),
    )
    step.heat.boundaries = [*chosen, *step.heat.boundaries.entries]
    compare(step, uneven(step, state), 4, torch.tensor([1.0, 2.0, 0.5], dtype=F64) * DT)


@pytest.mark.parametrize(*in_pairs(shape=["sphere", "box", "capsule", "path"], dim=[2, 3], scenes=[1, 2]))
def test_obstacles_beside_a_held_surface(dim, shape, scenes, device):
    """Gradients by the obstacle with the surface, and by another one, through contact and heat."""
    step, state = scene(dim, scenes=scenes, device=device)
    step.heat.tolerance = 1e-12
    at, turn = torch.tensor([0.45, 0.25, 0.45][:dim], dtype=F64), torch.ones(1 if dim == 2 else 3, dtype=F64)
    numbers = {
        "at": at.expand(scenes, dim), "velocity": torch.tensor([3.0, 1.0, -2.0][:dim], dtype=F64), "turn": 0.3 * turn,
        "rate": 20 * turn, "other": at + 0.15,
    }  # fmt: skip
    leaves = {name: t.to(device).clone().requires_grad_() for name, t in numbers.items()}
    c, v, turn, rate, other = leaves.values()
    region = {
        "sphere": lambda: mpm.Sphere(c, 0.12, velocity=v),
        "box": lambda: mpm.Box(c, (0.3, 0.15, 0.2)[:dim], rotation=turn, velocity=v, angular_velocity=rate),
        "capsule": lambda: mpm.Capsule(c, (0.1, 1.0, 0.2)[:dim], 0.1, velocity=v, angular_velocity=rate),
        "path": lambda: mpm.Sphere(lambda t: c[0] + v * t, 0.12),
    }[shape]()
    step = held(step, (heat_boundaries.FixedSurface, region, 40.0))
    step.boundaries = [*step.boundaries.entries, mpm.Sphere(other, 0.1)]
    state = uneven(step, state)
    assert plan_rollout(step, state, 4, DT).executor == "fused"
    ends = mpm.rollout(step, state, 4, DT), composed(step, state, 4, DT)
    for of in (["temperature"], ALL):
        grads = [
            torch.autograd.grad(loss_of(end, of), list(leaves.values()), allow_unused=True, retain_graph=True)
            for end in ends
        ]
        for name, found, expected in zip(leaves, *grads, strict=True):
            if expected is None:
                assert found is None
                continue
            error, scale = float((found - expected).abs().max()), float(expected.abs().max())
            assert error <= (1e-8 if state.x.is_cuda else 1e-10) * scale, f"{name}: {error / scale}"
        used = dict(zip(leaves, grads[0], strict=True))
        assert float(used["at"].abs().max()) > 0 and float(used["other"].abs().max()) > 0


NUMBERS = {"flux": 4e6, "coefficient": 3e4, "ambient": 40.0, "emissivity": 0.9, "power": 2e8, "temperature": 20.0}


@pytest.mark.parametrize("size", ["number", "one", "scenes"])
@pytest.mark.parametrize("scenes", [1, 3])
def test_numbers_of_boundaries(scenes, size, device):
    """By fluxes, coefficients, ambient and held temperatures, emissivities and powers; the regions overlap."""
    count = {"number": None, "one": 1, "scenes": scenes}[size]
    grads = []
    for run in (mpm.rollout, composed):
        step, state = scene(2, scenes=scenes, melts=True, device=device)
        step.heat.reference, step.heat.tolerance = 290.0, 1e-12
        leaves = []

        def leaf(name, factor=1.0, leaves=leaves):
            value = torch.tensor(factor * NUMBERS[name], dtype=F64, device=device)
            leaves.append((value if count is None else value.expand(count).clone()).requires_grad_())
            return leaves[-1]

        surface, regions = heat_boundaries.FreeSurface(), bodies(2)
        step = held(
            step,
            (heat_boundaries.Fixed, regions["plane"], leaf("temperature")),
            (heat_boundaries.Fixed, regions["box"], leaf("temperature", 2.0)),
            (heat_boundaries.FixedSurface, regions["sphere"], leaf("temperature", 3.0)),
        )
        chosen = [
            heat_boundaries.Flux(surface, leaf("flux")),
            heat_boundaries.Convection(surface, leaf("coefficient"), leaf("ambient")),
            heat_boundaries.Radiation(surface, leaf("emissivity"), leaf("ambient", 50.0)),
            heat_boundaries.Source(leaf("power")),
        ]
        step.heat.boundaries = [*chosen, *step.heat.boundaries.entries]
        end = run(step, melting(state), 3, torch.linspace(1, 2, scenes, dtype=F64, device=device) * DT)
        grads.append(torch.autograd.grad(loss_of(end, ["temperature"]), leaves))
    assert plan_rollout(step, state, 3, DT).executor == "fused"
    for found, expected in zip(*grads, strict=True):
        assert float(expected.abs().max()) > 0
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-10 * float(expected.abs().max()))


def test_powers_of_particles(device):
    step, state = scene(2, device=device)
    step.heat.tolerance = 1e-12
    grads = []
    for run in (mpm.rollout, composed):
        power = torch.full((len(state),), 2e8, dtype=F64, device=device, requires_grad=True)
        step.heat.boundaries = [heat_boundaries.Source(power)]
        grads.append(torch.autograd.grad(loss_of(run(step, state, 3, DT), ["temperature"]), power)[0])
    torch.testing.assert_close(*grads, rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    *in_pairs(name=["von_mises", "sand", "viscoelastic", "mixture"], dim=[2, 3], with_source=[False, True])
)
def test_plastic_heating(dim, name, with_source, device):
    """The adjoint of the energy that laws dissipate, by all inputs of the laws."""
    step, state = scene(dim, law=name, melts=with_source, device=device)
    step.heat.plastic_heating, step.heat.specific_heat = 0.9, 1.0
    state = state.replace(v=20 * state.v)
    if with_source:
        step.heat.boundaries = terms()["source"]
    dt, of = DT if with_source else torch.tensor([DT], dtype=F64), ["temperature"]
    found = compare(step, state, 4, dt, of=of)
    step.heat.plastic_heating = 0.0
    without = gradients(mpm.rollout, step, melting(state), 4, DT, of)
    assert float((found["v"] - without["v"]).abs().max()) > 1e-6 * float(found["v"].abs().max())


def test_a_collapse_passes_the_gradient_of_F_to_J(dim, device):
    """F after a collapse is J^(1/D) 1, whose derivative is dJ 1 / D at J = 1; the viscoelastic solid has history."""
    law = mpm.Melting(named("viscoelastic")["viscoelastic"](), mpm.WeaklyCompressible(1e5), 0.5)
    step, state = tempered("wax", dim, device=device)
    step.law = law
    start = step.prepare(state.replace(F=None, J=None, extra={"liquid": torch.ones_like(state.mass)}))
    start = start.replace(v=torch.zeros_like(state.v), J=start.J.clone().requires_grad_())
    for run in (mpm.rollout, composed):
        end = run(step, start, 1, 1e-9)
        (grad,) = torch.autograd.grad(end.F.diagonal(dim1=1, dim2=2).sum(), start.J)
        torch.testing.assert_close(grad, torch.ones_like(grad), rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    *in_pairs(name=TEMPERED, dim=[2, 3], share=[0.0, 0.9], scenes=[1, 2], transfer=TRANSFERS, per_cell=[None, 16])
)
def test_laws_that_read_the_temperature(dim, name, share, scenes, transfer, per_cell, device):
    """Laws with tables, expansion and melting, through which temperature and liquid fraction move the particles."""
    options = {} if per_cell is None else {"per_cell": per_cell}
    step, state = tempered(name, dim, scenes=scenes, transfer=transfer, device=device, **options)
    step.heat.plastic_heating = share
    of = ["v", "F", "J", *(["temperature"] if share else [])]
    found = compare(step, state, 5, torch.linspace(1, 2, scenes, dtype=F64) * DT, of=of)
    assert float(found["temperature"].abs().max()) > 0
    assert float(found["liquid"].abs().max()) > 0


def leaf_laws(device):
    """Laws with parameters that are leaves, and these, by name."""

    def leaf(*numbers):
        value = torch.tensor(numbers if len(numbers) > 1 else numbers[0], dtype=F64, device=device)
        return value.requires_grad_()

    E, alpha, viscosity, stiffness = leaf(2e5, 1e5, 1e4), leaf(1e-3, 2e-3), leaf(10.0, 1.0), leaf(1e5)
    nu, one, yields, pressure = leaf(0.3), leaf(1e-3), leaf(3e2, 1e2), leaf(1e3)
    softening, knots = mpm.Table([-10.0, 2.0, 20.0], E), [0.0, 5.0]
    water = mpm.WeaklyCompressible(stiffness, 7.0, mpm.Table(knots, viscosity))
    solid = mpm.VonMises(E=softening, nu=nu, yield_stress=mpm.Table([1.0, 6.0], yields), hardening=pressure)
    return {
        "softening": (mpm.NeoHookean(E=softening, nu=nu), [E, nu]),
        "thinning": (water, [stiffness, viscosity]),
        "flow": (solid, [E, nu, yields, pressure]),
        "expansion by a table": (
            mpm.ThermalExpansion(mpm.Hencky(E=stiffness, nu=0.3), mpm.Table(knots, alpha)),
            [alpha],
        ),
        "expansion": (mpm.ThermalExpansion(water, one), [one, stiffness, viscosity]),
        "wax": (
            mpm.ThermalExpansion(mpm.Melting(solid, water, 0.5), mpm.Table(knots, alpha)),
            [E, nu, alpha, yields, stiffness, viscosity],
        ),
    }


@pytest.mark.parametrize(
    *in_pairs(
        name=[*leaf_laws("cpu"), "mixture"], dim=[2, 3], scenes=[1, 2], checkpoint=[None, mpm.Checkpoints(memory=1e9)]
    )
)
def test_parameters_of_laws_that_read_the_temperature(dim, name, scenes, checkpoint, device):
    """Values of tables, coefficients of expansion and constants beside them."""
    step, state = tempered("wax", dim, scenes=scenes, device=device)
    step.heat.tolerance = 1e-12
    laws = leaf_laws(device)
    leaves = laws[name][1] if name in laws else laws["flow"][1] + laws["expansion"][1] + laws["wax"][1]
    if name in laws:
        step.law = laws[name][0]
    else:
        step.law = mpm.Mixture([laws[name][0] for name in ("flow", "expansion", "wax", "softening")])
        state = state.replace(material=(torch.arange(len(state)) % 4).int().to(device))
    state = step.prepare(state.replace(F=None, J=None))
    dt = torch.linspace(1, 2, scenes, dtype=F64).to(device) * DT
    assert plan_rollout(step, state, 4, dt).executor == "fused"
    ends = mpm.rollout(step, state, 4, dt, checkpoint=checkpoint), composed(step, state, 4, dt)
    grads = [torch.autograd.grad(loss_of(end, ["v", "F", "J"]), leaves) for end in ends]
    for found, expected in zip(*grads, strict=True):
        largest = float(expected.abs().max())
        assert largest > 0
        torch.testing.assert_close(found, expected, rtol=0, atol=(1e-8 if state.x.is_cuda else 1e-10) * largest)


def test_reasons_for_single_steps(device):
    """What the op has no adjoint of."""
    step, state = scene(2, device=device)
    state = state.replace(temperature=state.temperature.clone().requires_grad_())
    region = bodies(2)["plane"]
    step = held(step, (heat_boundaries.Fixed, region, lambda t: t))
    assert plan_rollout(step, state, 3, DT).reasons["fused"] == "temperature of Fixed is a function"


def test_adjoint_solves_that_miss_their_tolerance_are_reported(device):
    step, state = scene(2, device=device)
    step.heat.conductivity, step.heat.tolerance, step.heat.max_iterations = 2e7, 0.5, 3
    state = state.replace(temperature=state.temperature.clone().requires_grad_())
    end = mpm.rollout(step, state, 2, DT)
    step.check(end)
    loss_of(end).backward()
    with pytest.raises(mpm.SimulationError, match="2 heat solves"):
        step.check(end)


@pytest.mark.parametrize("law", ["neo_hookean", "melting and flow"])
def test_the_memory_is_known_beforehand(law):
    step, state = tempered(law) if law in THERMAL else scene(3, melts=True)
    start, _ = with_leaves(step, step.prepare(state))
    arguments = mpm.substeps_arguments(step, start, 5, DT, records=True)
    record = torch.ops.torch_mpm.substeps(**arguments)[-1]
    assert record is not None and record.numel() <= 5 * recorded_bytes(step, state) + 4096


@pytest.mark.parametrize("law", ["neo_hookean", "wax"])
def test_raw_ops(law, device):
    options = {"scenes": 2, "device": device}
    step, state = tempered(law, 2, **options) if law in THERMAL else scene(2, melts=True, **options)
    step.heat.boundaries = terms()["convection"]
    start, _ = with_leaves(step, melting(state))
    arguments = tuple(mpm.substeps_arguments(step, start, 2, DT).values())
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.torch_mpm.substeps.default, arguments, test_utils=checks)
    results = torch.ops.torch_mpm.substeps(*arguments)
    grads = [None if t is None else torch.randn_like(t) for t in (*results[:6], results[7], results[10])]
    plain = [t.detach() if isinstance(t, torch.Tensor) else t for t in arguments]
    plain = [
        [t.detach() for t in v] if isinstance(v, list) and v and isinstance(v[0], torch.Tensor) else v for v in plain
    ]
    adjoint = (grads, 511 - 16, None, *plain)
    torch.library.opcheck(torch.ops.torch_mpm.substeps_backward.default, adjoint, test_utils=checks)
    with pytest.raises(RuntimeError, match=r"grads\[7\] must have shape"):
        torch.ops.torch_mpm.substeps_backward([*grads[:7], grads[7][:, 1:]], *adjoint[1:])


def test_leaves_in_place_of_arguments(dim, device):
    """Of the op itself, whose other arguments were made where nothing needed gradients (docs/training.md)."""
    step, state = scene(dim, device=device)
    ends = []
    arguments = mpm.substeps_arguments(step, state, 4, DT)
    v = state.v.clone().requires_grad_()
    results = torch.ops.torch_mpm.substeps(**arguments | {"v": v})
    ends.append(torch.autograd.grad(results[0].square().sum() + results[10][:, 0].square().sum(), v)[0])
    v = state.v.clone().requires_grad_()
    end = composed(step, state.replace(v=v), 4, DT)
    ends.append(torch.autograd.grad(end.x.square().sum() + end.temperature.square().sum(), v)[0])
    torch.testing.assert_close(*ends, rtol=1e-9, atol=1e-9 * float(ends[1].abs().max()))
