"""Wrong arguments of public functions: the message names the argument, what was expected and what came."""

import math
import re
from typing import Any

import pytest
import torch

import torch_mpm as mpm
from torch_mpm import boundaries, heat_boundaries
from torch_mpm.geometry import seed
from torch_mpm.ops import g2p, g2p_advance, gather, grid_update, p2g, scatter

NAN, INF = math.nan, math.inf
HUGE = 10**400
"""Beyond float64."""


def grid(**options: Any) -> mpm.Grid:
    return mpm.Grid(**{"dx": 0.1, "lower": (0, 0), "upper": (1, 1), **options})


def law() -> mpm.Material:
    return mpm.NeoHookean(E=1e4, nu=0.3)


def step(**options: Any) -> mpm.Step:
    return mpm.Step(**{"grid": grid(), "law": law(), **options})


def state(**fields: Any) -> mpm.State:
    return mpm.State.at_rest(seed.box((0.4, 0.4), (0.6, 0.6), 0.1)).replace(**fields)


def at_rest(**options: Any) -> mpm.State:
    return mpm.State.at_rest(seed.box((0.4, 0.4), (0.6, 0.6), 0.1), **options)


def blocks() -> mpm.Blocks:
    return grid().activate(state().x)


def ball(**options: Any) -> mpm.Sphere:
    return mpm.Sphere(**{"position": (0.5, 0.5), "radius": 0.1, **options})


def moved(**given: Any) -> mpm.State:
    return mpm.rollout(**{"step": step(), "state": state(), "n": 1, "dt": 1e-3, **given})


def heat(**options: Any) -> mpm.Heat:
    return mpm.Heat(**{"grid": grid(), "conductivity": 1.0, "specific_heat": 1.0, **options})


def warm(boundary: Any) -> mpm.State:
    """A state after a step with a term of heat."""
    return heat(boundaries=[boundary])(state(temperature=torch.zeros(len(state()))), 1e-3)


FREE = heat_boundaries.FreeSurface()
USES = (
    lambda v: step()(v, 1e-3),
    lambda v: heat()(v, 1e-3),
    lambda v: moved(state=v),
    lambda v: mpm.stable_dt(grid(), law(), v),
)

GRID = [
    (lambda v: grid(dx=v), "dx", [NAN, INF, 0, -1.0, "x", None, HUGE, 1e300, 1e-300]),
    (lambda v: grid(lower=v), "lower", [(0, NAN), (0, "a"), 3, "ab", (0,), None]),
    (lambda v: grid(upper=v), "upper", [(1, INF), (1, 1, 1), {}, (-1, 1)]),
    (lambda v: grid(scenes=v), "scenes", [-1, 1.5, NAN, True, "2"]),
    (lambda v: grid(kernel=v), "kernel", ["linear", 2, ["quadratic"]]),
    (lambda v: grid(max_blocks=v), "max_blocks", [-1, 2.5, NAN, "all", 10**9]),
    (lambda v: grid(deterministic=v), "deterministic", [torch.zeros(3), None, "x", 2]),
    (lambda v: grid().activate(state().x, v), "scene", [5, torch.zeros(3, dtype=torch.int32)]),
]

STEP = [
    (lambda v: step(grid=v), "grid", [{}, None, 0.1]),
    (lambda v: step(law=v), "law", ["neo", None, mpm.NeoHookean, 3, object()]),
    (lambda v: step(gravity=v), "gravity", [(0, NAN), (0, -INF), (0, 0, 9.8), 9.8, "down", torch.tensor([0, 1])]),
    (lambda v: step(gravity=v), "gravity", [torch.zeros(3), torch.zeros(2, 2)]),
    (lambda v: setattr(step(), "gravity", v), "gravity", [(0, NAN), (1,)]),
    (lambda v: step(walls=v), "walls?", [7, "sticky ", ("slip", "slip")]),
    (lambda v: step(boundaries=v), "boundaries", [ball(), 5, "slip", [7], [None]]),
    (lambda v: step().boundaries.append(v), "boundaries", [7]),
    (lambda v: step(transfer=v), "transfer", ["flap", 1, None]),
    (lambda v: step(flip=v), "flip", [NAN, -0.1, 1.1, "x", None]),
    (lambda v: step(stress_form=v), "stress_form", ["pk1", 0]),
    (lambda v: step(on_grid=v), "on_grid", [3, "wind"]),
    (lambda v: step(heat=v), "heat", [3, True, law()]),
    (lambda v: step()(state(), v), "dt", ["x", NAN, INF, 0, -1e-3, 1e300, [1e-3], torch.zeros(2, 2)]),
    (lambda v: step().stable_dt(state(), v), "cfl", [NAN, 0, -1, "x", HUGE]),
    *((lambda v, use=use: use(v), "state", [None, 0.5, {}, torch.zeros(3), mpm.State]) for use in USES),
    (lambda v: mpm.stable_dt(v, law(), state()), "grid", [None, 0.1]),
    (lambda v: mpm.stable_dt(grid(), v, state()), "law", [None, 5, mpm.NeoHookean]),
    (lambda v: mpm.stable_dt(grid(), law(), state(), stress_form=v), "stress_form", ["fem", [[1.0]]]),
    (lambda v: moved(n=v), "n", [NAN, 2.5, True, "3", -1, None]),
    (lambda v: moved(checkpoint=v), "checkpoint", [0, 1.5, True, "all"]),
    (lambda v: moved(prefix=v), "prefix", [NAN, 2.5, True, "3", -1, None]),
    (lambda v: moved(truncate=v), "truncate", [NAN, 2.5, True, "3", 0]),
    (lambda v: moved(every=v), "every", [NAN, 2.5, True, "3", 0, None]),
    (lambda v: moved(hook=v), "hook", [3, "x"]),
    (lambda v: moved(norms=v), "norms", [3, "x", mpm.GradientNorms]),
    (lambda v: mpm.Checkpoints(every=v), "every", [NAN, 2.5, True, "3", 0]),
    (lambda v: mpm.Checkpoints(states=v), "states", [NAN, 2.5, True, "3", 1]),
    (lambda v: mpm.Checkpoints(memory=v), "memory", [NAN, INF, "3", 0, -1.0]),
    (lambda v: mpm.Checkpoints(every=2, offload=v), "offload", [None, "x", 0.5]),
    (lambda v: moved(step=v), "step", [None, 3]),
    (lambda v: moved(dt=v), "dt", [NAN, -1.0, 1e300, "x"]),
]

STATE = [
    (lambda v: at_rest(density=v), "density", [NAN, INF, 0, -1, "x", None, torch.ones(3)]),
    (lambda v: at_rest(velocity=v), "velocity", [(0, NAN), (0, INF), (1, 2, 3), 5.0, "x", {}, torch.ones(3)]),
    (lambda v: mpm.State.at_rest(v), "points", [None, 3, torch.zeros(3, 2)]),
    (lambda v: state(x=v), "x", [None, torch.zeros(3), torch.zeros(3, 2, dtype=torch.int32)]),
    (lambda v: state(v=v), "v", [3, torch.zeros(2, 2)]),
    (lambda v: state(scene=v), "scene", [5, torch.zeros(3)]),
    (lambda v: state(extra={"kept": v}), r"extra\['kept'\]", [5, torch.zeros(3)]),
    (lambda v: state(extra=v), "extra", [[], None, 5]),
    (lambda v: state(time=v), "time", ["now", None, (0.0,), (), HUGE]),
    (lambda v: at_rest(dtype=v), "dtype", [-3, "float32", torch.int32, torch.float16]),
    (lambda v: at_rest(device=v), "device", [[], 0.5, torch.zeros(3), "neo", HUGE]),
    (lambda v: state().to(dtype=v), "dtype", [[[1.0]], torch.bfloat16]),
    (lambda v: state().to(device=v), "device", [True, "neo", 1.5]),
    (lambda v: state().to(v), "dtype", [torch.bfloat16, torch.int32, torch.zeros(1, dtype=torch.int64)]),
    (lambda v: state().to(v, torch.float64), "dtype", [torch.float32, torch.zeros(1)]),
    (lambda v: state().to("cpu", non_blocking=v), "non_blocking", ["yes", 2]),
    (
        lambda v: state().replace(time=v),
        "time",
        [torch.ones(1, dtype=torch.bool), torch.ones(1, dtype=torch.complex64), "now"],
    ),
    (lambda v: state().select(v), "particles", [None, [0], torch.zeros(2, 2).long(), torch.zeros(2)]),
    (lambda v: state().sorted(v), "grid", [None, 0.5, mpm.Grid]),
    (lambda v: mpm.State.concatenate([state()], scene=v), "scene", [torch.zeros(3), None, "x"]),
    (lambda v: mpm.State.concatenate(v), "states", [[], [3], None, 5]),
    (lambda v: mpm.State.concatenate([state()], scene=True, scenes=v), r"scenes(\[0\])?", [[1, 2], [0], ["x"]]),
]

POSITIVE, NOT_NEGATIVE, ANY = [0.0, -1.0], [-1.0], []
PARAMETERS: list[tuple[Any, str, list[Any]]] = [
    (lambda v: mpm.NeoHookean(E=v, nu=0.3), "E", NOT_NEGATIVE),
    (lambda v: mpm.Hencky(E=1.0, nu=v), "nu", [-1.0, 0.5]),
    (lambda v: mpm.FixedCorotated(mu=v, lam=1.0), "mu", NOT_NEGATIVE),
    (lambda v: mpm.FixedCorotated(mu=1.0, lam=v), "lam", ANY),
    (lambda v: mpm.WeaklyCompressible(v), "bulk_modulus", NOT_NEGATIVE),
    (lambda v: mpm.WeaklyCompressible(1.0, gamma=v), "gamma", POSITIVE),
    (lambda v: mpm.WeaklyCompressible(1.0, viscosity=v), "viscosity", NOT_NEGATIVE),
    (lambda v: mpm.VonMises(E=1.0, nu=0.3, yield_stress=v), "yield_stress", NOT_NEGATIVE),
    (lambda v: mpm.VonMises(E=1.0, nu=0.3, yield_stress=1.0, hardening=v), "hardening", NOT_NEGATIVE),
    (lambda v: mpm.HerschelBulkley(E=1.0, nu=0.3, yield_stress=v, consistency=1.0), "yield_stress", NOT_NEGATIVE),
    (lambda v: mpm.HerschelBulkley(E=1.0, nu=0.3, yield_stress=1.0, consistency=v), "consistency", NOT_NEGATIVE),
    (
        lambda v: mpm.HerschelBulkley(E=1.0, nu=0.3, yield_stress=1.0, consistency=1.0, exponent=v),
        "exponent",
        POSITIVE,
    ),
    (lambda v: mpm.Snow(E=1.0, nu=0.3, critical_compression=v), "critical_compression", [-0.1, 1.0]),
    (lambda v: mpm.Snow(E=1.0, nu=0.3, critical_stretch=v), "critical_stretch", NOT_NEGATIVE),
    (lambda v: mpm.Snow(E=1.0, nu=0.3, hardening=v), "hardening", NOT_NEGATIVE),
    *(
        (
            lambda v, name=name: mpm.CamClay(
                E=1.0, nu=0.3, **{"critical_slope": 1.0, "consolidation": 1.0, "hardening": 1.0, name: v}
            ),
            name,
            bad,
        )
        for name, bad in (
            ("critical_slope", POSITIVE),
            ("consolidation", POSITIVE),
            ("hardening", POSITIVE),
            ("cohesion", [-0.1, 1.1]),
        )
    ),
    (lambda v: mpm.ThermalExpansion(law(), v), "coefficient", ANY),
]
"""Each is tried with numbers that are not finite, words and tensors that are wrong too."""

LAWS = [
    *(
        (make, name, [*bad, NAN, INF, "x", torch.tensor([NAN]), torch.zeros(2, 2), HUGE, law()])
        for make, name, bad in PARAMETERS
    ),
    (lambda v: mpm.CustomLaw(v), "function", [None, "neo", 3]),
    (lambda v: mpm.CustomLaw(lambda F: F, v), "state_field", ["C", None]),
    (lambda v: mpm.CustomLaw(lambda F: F, stiffness=v), "stiffness", [NAN, INF, -1.0, "x"]),
    (lambda v: mpm.CustomPrincipalLaw(v), "function", [None, "neo", 3]),
    (lambda v: mpm.CustomPrincipalLaw(lambda s: s, v), "stiffness", [NAN, -1.0, "x"]),
    (lambda v: mpm.PerMaterial(v), r"values(\[0\])?", [5, "12", [None], ["1"], [HUGE]]),
    (lambda v: mpm.QuarticSand(E=1.0, nu=0.3, smallest_strain=v), "smallest_strain", [None, "x", NAN, -1.0]),
    (lambda v: mpm.Mixture(v), "laws", [law(), None, "neo"]),
    (lambda v: mpm.Mixture([law(), v]), r"laws\[1\]", ["neo", None, mpm.NeoHookean]),
    (lambda v: mpm.Active(v, (1.0, 0.0)), "law", ["neo", None]),
    (lambda v: mpm.Active(law(), v), "direction", [None, "x", [1.0], [NAN, 0.0], torch.zeros(4), torch.zeros(2).int()]),
    (lambda v: mpm.ThermalExpansion(v, 1e-3), "law", ["neo", None]),
    (lambda v: mpm.Melting(v, mpm.WeaklyCompressible(1.0)), "solid", ["neo", None]),
    (lambda v: mpm.Melting(law(), v), "liquid", ["water", None]),
    (lambda v: mpm.Melting(law(), mpm.WeaklyCompressible(1.0), v), "coherency", [NAN, 0.0, 1.1, "x"]),
    (lambda v: mpm.Table(v, [1.0, 2.0]), "temperature", ["ab", None, [0.0, NAN], [1.0, 0.0], [0.0, "x"], [0.0]]),
    (lambda v: mpm.Table([0.0, 1.0], v), "value", ["ab", None, [0.0, NAN], [0.0, "x"], [0.0]]),
]

BOUNDARIES = [
    (lambda v: mpm.Walls(v), "walls?", [7, "stick", None, [("slip", "x"), "slip"]]),
    (lambda v: mpm.Walls("slip", friction=v), "friction", [NAN, INF, -0.1, "x", None, [(0.1, NAN), 0.1]]),
    (lambda v: mpm.Walls("slip", lower=v), "lower", [(0, NAN), "ab", 3, (0, None)]),
    (lambda v: mpm.Walls("slip", upper=v), "upper", [(INF, 1), {}]),
    (lambda v: ball(position=v), "position", [None, (0, NAN), "ab", (0, "x"), INF]),
    (lambda v: ball(radius=v), "radius", [None, NAN, INF, -0.1, "x"]),
    (lambda v: ball(kind=v), "kind", ["stick", None, 3]),
    (lambda v: ball(friction=v), "friction", [NAN, INF, -0.1, "x", None, HUGE]),
    (lambda v: ball(velocity=v), "velocity", [(0, NAN), "ab", (INF, 0)]),
    (lambda v: ball(rotation=v), "rotation", [NAN, "x", (0, INF, 0), len]),
    (lambda v: ball(angular_velocity=v), "angular_velocity", [NAN, "x", dict, HUGE]),
    (lambda v: step(boundaries=[ball(friction=v)])(state(), 1e-3), "friction", [torch.zeros(0)]),
    (lambda v: ball(start=v), "start", [NAN, INF, "x", None]),
    (lambda v: ball(end=v), "end", [NAN, -1.0, "x", None]),
    (lambda v: ball(scene=v), "scene", [-1, 1.5, True, "x"]),
    (lambda v: mpm.Plane((0, 0), v), "normal", [(0, 0), (0, NAN), None, "ab", (0, "x")]),
    (lambda v: mpm.Box((0, 0), v), "size", [(1, -1), (1, NAN), None, "ab"]),
    (lambda v: mpm.Capsule((0, 0), v, 0.1), "half_axis", [(0, NAN), "ab", None]),
    (lambda v: mpm.Capsule((0, 0), (1, 0), v), "radius", [-1, NAN, None]),
    (
        lambda v: boundaries.Revolved((0, 0), v),
        "outline",
        [[(0, 0)], [(0, NAN), (1, 0), (1, 1)], "abc", 3, [(0, "x")] * 3],
    ),
    (lambda v: boundaries.Revolved((0, 0), [(0, 0), (1, 0), (1, 1)], axis=v), "axis", [(0, 0), (NAN, 1), "ab"]),
    (lambda v: mpm.SDF(v, (0, 0)), "distance", [None, 3.0]),
    (lambda v: mpm.SDF(lambda x: x[:, 0], (0, 0), normal=v), "normal", [3.0, "up"]),
]

HEAT = [
    (lambda v: heat(grid=v), "grid", [None, 0.1]),
    (lambda v: heat(plastic_heating=v), "plastic_heating", [None, "x", NAN, 1.5]),
    (lambda v: heat(reference=v), "reference", [torch.zeros(3), None, NAN, HUGE]),
    (lambda v: heat(tolerance=v), "tolerance", [[1.0], 0, NAN]),
    (lambda v: heat(max_iterations=v), "max_iterations", [INF, NAN, 0, "x"]),
    (lambda v: heat(method=v), "method", [[], "gmres"]),
    (lambda v: heat_boundaries.Surface(torch.zeros(3, 2), v), "area", [None, {}, [None], len, -1.0, HUGE]),
    (lambda v: heat_boundaries.Surface(torch.zeros(3, 2), 1.0, v), "scene", ["", dict, torch.zeros(3)]),
    (lambda v: heat_boundaries.Flux(v, 1.0), "surface", [None, 1j, heat_boundaries.FreeSurface]),
    (lambda v: heat_boundaries.Flux(FREE, v), "flux", [None, (), "x", NAN, HUGE]),
    (lambda v: heat_boundaries.Convection(FREE, 1.0, v), "ambient", [None, b"x", 1j, HUGE]),
    (lambda v: heat_boundaries.Radiation(FREE, v, 0.0), "emissivity", [(), None, 1.5]),
    (lambda v: heat_boundaries.Fixed(v, 1.0), "region", [None, 1j, torch.zeros(3)]),
    (lambda v: warm(heat_boundaries.Fixed(v, 1.0)), "region", [lambda x: None, lambda x: x[:, 0], lambda x: x > 0]),
    (lambda v: warm(heat_boundaries.Flux(FREE, lambda t: v)), "a function of the time", [None, "x"]),
    (lambda v: warm(heat_boundaries.Convection(FREE, 1.0, v)), "a value at nodes", [torch.zeros(0), torch.zeros(3)]),
]

SEED = [
    (lambda v: seed.box(v, (1, 1), 0.1), "lower", [(0, NAN), "ab", None, (2, 2), (0,), (0, "x")]),
    (lambda v: seed.box((0, 0), v, 0.1), "upper", [(0, INF), (1, 1, 1), 3]),
    (lambda v: seed.box((0, 0), (1, 1), v), "grid", [{}, NAN, 0, "x", None]),
    (lambda v: seed.box((0, 0), (1, 1), 0.1, v), "per_cell", [NAN, 0, -1, "x", None]),
    (lambda v: seed.box((0, 0), (1, 1), 0.1, dtype=v), "dtype", ["neo", 1j, torch.zeros(3), torch.int64]),
    (lambda v: seed.box((0, 0), (1, 1), 0.1, device=v), "device", [0.5, (), torch.zeros(0), "neo"]),
    (lambda v: seed.fill(v, 0.1), "shape", [None, dict, torch.zeros(3)]),
    (lambda v: seed.box((0, 0), (1, 1), 0.1, method=v), "method", ["random", None]),
    (lambda v: seed.sphere(v, 0.2, 0.1), "center", [(0, NAN), "ab", 3]),
    (lambda v: seed.sphere((0, 0), v, 0.1), "radius", [NAN, 0, -1, "x", None, HUGE]),
    (lambda v: seed.capsule((0, 0), v, 0.1, 0.1), "a to b", [(0, 0)]),
    (lambda v: seed.cylinder(v, (0, 0, 1), 0.1, 0.1), "a", [(0, 0, NAN), "abc"]),
]

OPS = [
    (
        lambda v: g2p_advance(blocks(), state().x, torch.zeros(3, 2), 1e-3, stress_form=v),
        "stress_form",
        [{}, "pk1", None],
    ),
    *(
        (lambda v, op=op, arguments=arguments: op(v, *arguments), "blocks", [-1, None, {}])
        for op, arguments in (
            (p2g, [torch.zeros(3, 2)] * 3),
            (g2p, [torch.zeros(3, 2)] * 2),
            (scatter, [torch.zeros(3, 2)] * 2),
            (gather, [torch.zeros(3, 2)] * 2),
            (grid_update, [torch.zeros(3, 3)]),
            (g2p_advance, [torch.zeros(3, 2), torch.zeros(3, 2), 1e-3]),
        )
    ),
]

ROWS = [
    pytest.param(call, name, values, id=f"{group}-{number}-{name}")
    for group, table in (
        ("grid", GRID), ("step", STEP), ("state", STATE), ("law", LAWS), ("boundary", BOUNDARIES), ("heat", HEAT),
        ("seed", SEED), ("op", OPS),
    )
    for number, (call, name, values) in enumerate(table)
]  # fmt: skip


@pytest.mark.parametrize(("call", "name", "values"), ROWS)
def test_messages_name_the_argument(call, name, values):
    for value in values:
        with pytest.raises((TypeError, ValueError)) as caught:
            call(value)
        message = str(caught.value)
        assert re.search(rf"(?<!\w){name}(?!\w)", message), message
        assert " must " in message and " got " in message, message


def test_numbers_of_other_libraries_are_numbers():
    import numpy as np

    made = step(grid=grid(dx=np.float32(0.1), lower=np.zeros(2), scenes=np.int64(1)), gravity=np.array([0.0, -9.8]))
    end = mpm.rollout(made, at_rest(velocity=np.ones(2), density=np.float32(900)), np.int64(2), np.float32(1e-3))
    assert end.time == pytest.approx(2e-3) and float(end.v[0, 1]) == pytest.approx(1 - 2e-3 * 9.8, rel=1e-5)
    ball(position=np.array([0.5, 0.5]), radius=np.float64(0.1), friction=np.float32(0.3))


def test_arguments_that_are_assigned_are_checked():
    """As those of the constructor; a list of boundaries keeps nothing that it refuses."""
    step = mpm.Step(mpm.Grid(0.1, (0, 0), (1, 1)), mpm.NeoHookean(E=1e3, nu=0.3))
    for name, value in (("transfer", "xpic"), ("flip", 1.5), ("stress_form", "cauchy"), ("flip", "all")):
        with pytest.raises((TypeError, ValueError), match=f"^{name} must be "):
            setattr(step, name, value)
    step.transfer = "flip"
    moving = state(v=torch.randn(len(state()), 2))
    expected = mpm.Step(step.grid, step.law, transfer="flip")(moving, 1e-3)
    assert step.flip == 0 and torch.equal(step(moving, 1e-3).v, expected.v)
    step.boundaries = [mpm.Sphere((0, 0), 1)]
    for change in (lambda b: b.append(3), lambda b: b.__setitem__(0, 3)):
        with pytest.raises(TypeError, match="boundaries must be a list of modules"):
            change(step.boundaries)
        assert len(step.boundaries) == 1 and isinstance(step.boundaries[0], mpm.Sphere)


def test_ids_of_an_activation_are_checked():
    x = torch.full((4, 2), 0.5)
    for ids, message in ((torch.arange(3), "ids must have shape"), (torch.arange(4).int(), "ids must be int64")):
        with pytest.raises((TypeError, ValueError), match=message):
            mpm.Grid(0.1, (0, 0), (1, 1)).activate(x, ids=ids)


# ---- dimensions


def of_dimension(dim: int) -> tuple[mpm.Grid, mpm.State]:
    lattice = mpm.Grid(0.1, (0,) * dim, (1,) * dim)
    return lattice, mpm.State.at_rest(seed.box((0.3,) * dim, (0.5,) * dim, lattice), 1000.0)


OF_STATES = {
    "step": lambda step, state: step(state, 1e-3),
    "rollout": lambda step, state: mpm.rollout(step, state, 2, 1e-3),
    "rollout_to": lambda step, state: mpm.rollout_to(step, state, 1e-2),
    "frames": lambda step, state: list(mpm.frames(step, state, 2, 1e-3)),
    "environments": lambda step, state: mpm.Environments(step, [state]).advance(1, 1e-3),
    "stable_dt": lambda step, state: step.stable_dt(state),
    "project": lambda step, state: step.project(state),
    "impulses": lambda step, state: step.with_impulses(state),
}


@pytest.mark.parametrize("use", OF_STATES)
@pytest.mark.parametrize("dim", [2, 3])
def test_states_of_another_dimension(dim, use):
    (lattice, _), (_, other) = of_dimension(dim), of_dimension(5 - dim)
    message = rf"x of the state must have the dimension of the grid, \[P, {dim}\], got \[{len(other)}, {5 - dim}\]"
    with pytest.raises(ValueError, match=message):
        OF_STATES[use](mpm.Step(lattice, law()), other)


@pytest.mark.parametrize("dim", [2, 3])
def test_shapes_of_another_dimension(dim):
    lattice, other = of_dimension(dim)[0], (0.4,) * (5 - dim)
    message = f"shape must have the dimension of the grid, {dim}, got one of {5 - dim} dimensions"
    for make in (lambda: seed.sphere(other, 0.2, lattice), lambda: seed.box((0.1,) * (5 - dim), other, lattice)):
        with pytest.raises(ValueError, match=message):
            make()


def test_positions_of_other_particles_than_were_activated():
    """They are named, and not the scenes of the activation."""
    x = torch.rand(5, 2)
    active = grid(scenes=2).activate(x, torch.zeros(5, dtype=torch.int32))
    for use in (g2p, lambda b, x, v: gather(b, x, v)):
        with pytest.raises(
            ValueError, match=r"x must have the shape of the positions that were activated.* got \[3, 2\]"
        ):
            use(active, x[:3], torch.zeros(active.node_count, 2))
