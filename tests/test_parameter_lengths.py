"""Parameters have one value, one per scene or one per particle; any other number of values is an error by name."""

import dataclasses
import itertools
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.laws import LAWS as LAWS_OF_CATALOGUE
from torch_mpm import heat_boundaries
from torch_mpm.geometry import seed
from torch_mpm.ops import LAWS, law_energy, law_update

B, EACH = 3, 4
P = B * EACH
WRONG = (2, P - 1, P + 1, 64)
"""Lengths that are neither 1 nor B nor P."""

SOLID = {"E": 1e4, "nu": 0.3}
TAKES_NUMBERS = {name: law for name, law in LAWS_OF_CATALOGUE.items() if not name.startswith("custom")}
MAKES: dict[str, tuple[Callable[..., mpm.Material], dict[str, Any]]] = {
    **{name: (law.make, law.arguments()) for name, law in TAKES_NUMBERS.items()},
    "lame": (mpm.Hencky, {"mu": 4e3, "lam": 6e3}),
    "water": (mpm.WeaklyCompressible, {"bulk_modulus": 1e4, "gamma": 7.0}),
    "cohesive_sand": (mpm.QuarticSand, SOLID | {"friction_angle": 0.5, "cohesion": 0.01}),
    "hardening_sand": (
        lambda h0, h1, h2, h3, **solid: mpm.QuarticSand(**solid, hardening=(h0, h1, h2, h3)),
        SOLID | {"h0": 0.6, "h1": 0.1, "h2": 0.2, "h3": 0.1},
    ),
}
"""Constructor of each law, and its arguments; numbers are parameters."""
PARAMETERS = [(law, name) for law, (_, given) in MAKES.items() for name, v in given.items() if type(v) is float]


def lattice(scenes: int = B) -> mpm.Grid:
    return mpm.Grid(0.1, (0, 0), (1, 1), scenes=scenes, max_blocks=25 * scenes)


def batch(device: str = "cpu", dtype: torch.dtype = torch.float64) -> mpm.State:
    """B scenes of four particles each, deformed a little."""
    one = mpm.State.at_rest(seed.box((0.4, 0.4), (0.6, 0.6), 0.1, per_cell=1), dtype=dtype)
    states = []
    for k in range(B):
        generator = torch.Generator().manual_seed(k)
        F = torch.eye(2, dtype=dtype) + 0.03 * torch.randn(EACH, 2, 2, generator=generator, dtype=dtype)
        v = torch.randn(EACH, 2, generator=generator, dtype=dtype)
        theta = 0.1 * torch.ones(EACH, dtype=dtype)
        extra = {"liquid": torch.full((EACH,), 0.3, dtype=dtype)}
        states.append(one.replace(F=F, J=torch.linalg.det(F), v=v, temperature=theta, extra=extra))
    material = torch.ones(P, dtype=torch.int32)  # of the second law of a mixture
    return mpm.State.concatenate(states, scene=True).replace(material=material).to(device)


def law_with(law: str, name: str, value: Tensor) -> mpm.Material:
    make, numbers = MAKES[law]
    return make(**{**numbers, name: value})


def values(law: str, name: str, n: int | None, device: str = "cpu") -> Tensor:
    """n values around that of the table."""
    number = MAKES[law][1][name]
    shape = () if n is None else (n,)
    return number * (1 + 0.3 * torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)).to(
        device
    )


WAYS: dict[str, Callable[[mpm.Grid, mpm.Material, mpm.State], Any]] = {
    "a step": lambda grid, law, state: mpm.Step(grid, law)(state, 1e-5),
    "a rollout": lambda grid, law, state: mpm.rollout(mpm.Step(grid, law), state, 3, 1e-5),
    "its limit": lambda grid, law, state: mpm.Step(grid, law).stable_dt(state),
    "the limit of a law": lambda grid, law, state: mpm.stable_dt(grid, law, state),
    "a state alone": lambda grid, law, state: law.stress(state),
    "an energy": lambda grid, law, state: law.energy(state),
}


@pytest.mark.parametrize(("law", "name"), PARAMETERS)
def test_other_lengths_are_errors(law: str, name: str, device: str) -> None:
    """Every parameter of every law, in all uses, also in the first use of a state."""
    for use, n in zip(WAYS.values(), itertools.cycle(WRONG)):
        made = law_with(law, name, values(law, name, n, device))
        with pytest.raises(ValueError, match=rf"^{name} must have shape .*got \[{n}\] with B = {B}$"):
            use(lattice(), made, batch(device))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("n", WRONG)
def test_all_other_lengths_are_errors_in_all_ways(way: str, n: int, device: str) -> None:
    with pytest.raises(ValueError, match=rf"^mu must have shape .*got \[{n}\] with B = {B}$"):
        WAYS[way](lattice(), law_with("lame", "mu", values("lame", "mu", n, device)), batch(device))


@pytest.mark.parametrize(("law", "name"), PARAMETERS)
def test_scenes_and_particles_have_their_own_values(law: str, name: str, device: str) -> None:
    """A batch with [B] is that with the same values as [P], and each scene is the one with its number alone; what all
    share is the same in every form."""
    state, per_scene = batch(device), values(law, name, B, device)
    each = per_scene.repeat_interleave(EACH)
    results = [
        mpm.Step(lattice(), law_with(law, name, value))(state, 1e-4)
        for value in (per_scene, each, per_scene[:1], per_scene[0])
    ]
    torch.testing.assert_close(results[0].v, results[1].v, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(results[2].v, results[3].v, rtol=1e-12, atol=1e-14)
    for k, part in enumerate(state.split()):
        alone = mpm.Step(lattice(1), law_with(law, name, per_scene[k]))(part, 1e-4)
        torch.testing.assert_close(results[0].v[k * EACH : (k + 1) * EACH], alone.v, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(("law", "name"), [p for p in PARAMETERS if p[1] not in ("coefficient", "exponent")])
def test_gradients_have_the_shape_of_their_parameter(law: str, name: str, device: str) -> None:
    """Gradients of shared values are the sums over the particles."""
    state = batch(device)

    def gradient(value: Tensor) -> Tensor:
        leaf = value.clone().requires_grad_()
        end = mpm.rollout(mpm.Step(lattice(), law_with(law, name, leaf)), state, 2, 1e-3)
        (by_value,) = torch.autograd.grad((end.v * torch.arange(P * 2, device=device).reshape(P, 2)).sum(), leaf)
        assert by_value.shape == leaf.shape
        return by_value

    number = values(law, name, None, device)
    of_particles = gradient(number.expand(P).contiguous())
    scale = of_particles.abs().sum()
    for form, expected in (
        (number, of_particles.sum()),
        (number.reshape(1), of_particles.sum(0, True)),
        (number.expand(B).contiguous(), of_particles.reshape(B, EACH).sum(1)),
    ):
        assert float((gradient(form) - expected).abs().max()) <= 1e-9 * float(scale)


@pytest.mark.parametrize("scene", [None, torch.zeros(EACH, dtype=torch.int32)])
@pytest.mark.parametrize("way", WAYS)
def test_one_scene_has_no_second_value(way: str, scene: Tensor | None, device: str) -> None:
    state = batch(device).split()[0].replace(scene=None if scene is None else scene.to(device))
    for n in (2, EACH - 1, EACH + 1):
        with pytest.raises(ValueError, match=rf"^E must have shape .*\[P\] = \[{EACH}\], got \[{n}\] with B = 1$"):
            WAYS[way](lattice(1), mpm.NeoHookean(E=torch.full((n,), 1e4, device=device), nu=0.3), state)
    for value in (1e4, torch.tensor([1e4]), torch.full((EACH,), 1e4)):
        WAYS[way](lattice(1), mpm.NeoHookean(E=value if isinstance(value, float) else value.to(device), nu=0.3), state)


def test_as_many_scenes_as_particles_are_particles(device: str) -> None:
    """Where P = B, [P] is meant: the values follow `ids`, not `scene`."""
    state = batch(device).select(torch.arange(0, P, EACH, device=device)).replace(ids=None, extra={}, material=None)
    E = torch.tensor([1e3, 1e4, 1e5], dtype=torch.float64, device=device)
    turned = state.replace(scene=torch.tensor([2, 0, 1], dtype=torch.int32, device=device))
    stress = mpm.NeoHookean(E=E, nu=0.3).stress(turned)
    for k in range(B):
        alone = mpm.NeoHookean(E=float(E[k]), nu=0.3).stress(turned)
        torch.testing.assert_close(stress[k], alone[k])


def test_scenes_without_particles_count(device: str) -> None:
    """A step, and a state that it prepared, has the number of scenes; a state alone does not."""
    state = batch(device).select(torch.arange(2 * EACH, device=device))
    law = mpm.NeoHookean(E=torch.tensor([1e3, 1e4, 1e5], device=device), nu=0.3)
    fresh = mpm.State(**{f.name: getattr(state, f.name) for f in dataclasses.fields(state)})
    with pytest.raises(ValueError, match=r"got \[3\] with B = 2$"):
        law.stress(fresh)
    step = mpm.Step(lattice(), law)
    assert step.prepare(fresh).scenes == B == step(fresh, 1e-5).scenes == step(fresh, 1e-5).sorted(step.grid).scenes
    law.stress(step.prepare(fresh))
    absent = fresh.replace(scene=torch.where(fresh.scene == 1, -1, fresh.scene).int())
    assert absent.scenes == 1  # counted from the new tensor
    absent.scene[0] = 1
    assert absent.scenes == 2
    mpm.rollout(step, absent, 2, 1e-5)


def test_environments_have_values_per_scene(device: str) -> None:
    states = [s.replace(extra={}, material=None, temperature=None) for s in batch(device).split()]
    for n in (1, B, 2, 64):
        step = mpm.Step(lattice(), mpm.NeoHookean(E=torch.full((n,), 1e4, device=device), nu=0.3))
        environments = mpm.Environments(step, states, room=EACH + 1)
        if n in (1, B):
            environments.advance(2, 1e-5)
            continue
        with pytest.raises(ValueError, match=rf"^E must have .*\[P\] = \[{P + B}\], got \[{n}\] with B = {B}$"):
            environments.advance(2, 1e-5)


def test_parameters_that_are_assigned_are_checked(device: str) -> None:
    """In the place of a number, or of a tensor of the right length, also after a step has kept the latter."""
    state = batch(device)
    for first in (1e4, torch.full((B,), 1e4, device=device)):
        step = mpm.Step(lattice(), mpm.NeoHookean(E=first, nu=0.3))
        step(state, 1e-5)
        step.law.E = torch.full((2,), 1e4, device=device)
        for _ in range(2):
            with pytest.raises(ValueError, match=r"^E must have .*got \[2\]"):
                step(state, 1e-5)


def test_laws_without_particles_are_checked(device: str) -> None:
    """Laws of a mixture, and values of a parameter per material."""
    state = batch(device).replace(material=torch.zeros(P, dtype=torch.int32, device=device))
    wrong = torch.full((2,), 1e4, device=device)
    idle = mpm.Mixture([mpm.Hencky(**SOLID), mpm.NeoHookean(E=wrong, nu=0.3)])
    values = mpm.NeoHookean(E=mpm.PerMaterial([1e4, wrong]), nu=0.3)
    for law, name in ((idle, "E"), (values, "E of material 1")):
        for way in ("a step", "a rollout", "its limit"):
            with torch.no_grad(), pytest.raises(ValueError, match=rf"^{name} must have .*got \[2\]"):
                WAYS[way](lattice(), law, state)


def test_compiled_code_checks_too() -> None:
    state = batch().replace(extra={}, material=None, temperature=None)
    for n in (B, 2):
        step = mpm.Step(lattice(), mpm.NeoHookean(E=torch.full((n,), 1e4), nu=0.3))
        compiled = torch.compile(step, backend="eager", fullgraph=True)
        if n == B:
            torch.testing.assert_close(compiled(state, 1e-4).v, step(state, 1e-4).v)
            continue
        with pytest.raises(Exception, match=r"E must have shape .*got \[2\]"):
            compiled(state, 1e-4)


def test_implicit_steps_check_too(device: str) -> None:
    state = batch(device).replace(extra={}, material=None, temperature=None)
    for n in (B, P, *WRONG):
        law = mpm.NeoHookean(E=torch.full((n,), 1e4, device=device), nu=0.3)
        step = mpm.Step(lattice(), law, integrator="implicit")
        if n in (B, P):
            step(state, 1e-3)
            continue
        with pytest.raises(ValueError, match=rf"^E must have shape .*got \[{n}\]"):
            step(state, 1e-3)


# ---- heat


HEAT = {"conductivity": 1.0, "specific_heat": 2.0, "melting_point": 0.2, "latent_heat": 3.0}


@pytest.mark.parametrize("name", HEAT)
def test_parameters_of_heat(name: str, device: str) -> None:
    state = batch(device)

    def end(value: Tensor | float) -> Tensor:
        return mpm.Heat(lattice(), **{**HEAT, name: value})(state, 1e-3).temperature

    per_scene = HEAT[name] * torch.tensor([1.0, 1.2, 1.4], dtype=torch.float64, device=device)
    torch.testing.assert_close(end(per_scene), end(per_scene.repeat_interleave(EACH)), rtol=1e-12, atol=1e-14)
    for n in WRONG:
        with pytest.raises(ValueError, match=rf"^{name} must have shape .*got \[{n}\] with B = {B}$"):
            end(torch.full((n,), HEAT[name], device=device))


def surface(device: str) -> heat_boundaries.Surface:
    scene = torch.arange(B, dtype=torch.int32, device=device).repeat_interleave(5)
    return heat_boundaries.Surface(torch.full((5 * B, 2), 0.5, device=device), 0.1, scene)


FREE, BALL = heat_boundaries.FreeSurface(), mpm.Sphere((0.5, 0.5), 0.3)
BOUNDARIES: dict[str, tuple[str, Callable[[Any, str], Any]]] = {
    "flux": ("flux", lambda v, device: heat_boundaries.Flux(FREE, v)),
    "flux of points": ("flux", lambda v, device: heat_boundaries.Flux(surface(device), v)),
    "coefficient": ("coefficient", lambda v, device: heat_boundaries.Convection(FREE, v, 1.0)),
    "coefficient of points": ("coefficient", lambda v, device: heat_boundaries.Convection(surface(device), v, 1.0)),
    "ambient": ("ambient", lambda v, device: heat_boundaries.Convection(FREE, 1.0, v)),
    "emissivity": ("emissivity", lambda v, device: heat_boundaries.Radiation(FREE, v, 300.0)),
    "emissivity of points": ("emissivity", lambda v, device: heat_boundaries.Radiation(surface(device), v, 300.0)),
    "ambient of radiation": ("ambient", lambda v, device: heat_boundaries.Radiation(FREE, 0.1, v)),
    "temperature": ("temperature", lambda v, device: heat_boundaries.Fixed(BALL, v)),
    "temperature of a surface": ("temperature", lambda v, device: heat_boundaries.FixedSurface(BALL, v)),
    "power": ("power", lambda v, device: heat_boundaries.Source(v)),
}


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("timed", [False, True])
def test_values_of_heat_boundaries(boundary: str, timed: bool, device: str) -> None:
    """As tensors or by functions of the time: each scene has its own value, in the order of the scenes."""
    if timed and boundary == "power":
        pytest.skip("a power is no function of the time")
    state, (name, make) = batch(device), BOUNDARIES[boundary]

    def end(value: Tensor | float, state: mpm.State = state, scenes: int = B) -> Tensor:
        given: Any = (lambda time: value) if timed else value
        return mpm.Heat(lattice(scenes), 1.0, 1.0, boundaries=[make(given, device)])(state, 1e-2).temperature

    per_scene = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64, device=device)
    together = end(per_scene)
    for k in range(B):
        part = end(per_scene[k])[k * EACH : (k + 1) * EACH]
        torch.testing.assert_close(together[k * EACH : (k + 1) * EACH], part, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(end(per_scene[:1]), end(float(per_scene[0])), rtol=1e-12, atol=1e-14)
    for n in WRONG:
        with pytest.raises(ValueError, match=rf"^{name}\b.* must have shape .*got \[{n}\]"):
            end(torch.full((n,), 0.5, device=device))


# ---- boundaries


def ball(**options: Any) -> mpm.Sphere:
    return mpm.Sphere(**{"position": (0.5, 0.5), "radius": 0.2, **options})


OBSTACLES: dict[str, tuple[str, Callable[[Tensor], Any], tuple[int, ...]]] = {
    "position": ("position", lambda v: ball(position=0.5 * v), (2,)),
    "velocity": ("velocity", lambda v: ball(velocity=v), (2,)),
    "rotation": ("rotation", lambda v: mpm.Box((0.5, 0.5), (0.2, 0.3), rotation=v), ()),
    "angular velocity": ("angular_velocity", lambda v: ball(angular_velocity=v), ()),
    "friction": ("friction", lambda v: ball(friction=0.1 * v), ()),
    "radius": ("radius", lambda v: ball(radius=0.1 * v), ()),
    "normal": ("normal", lambda v: mpm.Plane((0.5, 0.5), v), (2,)),
    "size": ("size", lambda v: mpm.Box((0.5, 0.5), 0.2 * v), (2,)),
    "half axis": ("half_axis", lambda v: mpm.Capsule((0.5, 0.5), 0.1 * v, 0.1), (2,)),
    "axis": ("axis", lambda v: mpm.Revolved((0.5, 0.5), [(0.0, -0.1), (0.1, 0.0), (0.0, 0.1)], v), (2,)),
}


class ByTorch(mpm.SDF):
    """A ball that acts by torch operations."""

    def __init__(self, **motion: Any) -> None:
        super().__init__(lambda x: x.norm(dim=-1) - 0.2, **{"position": (0.5, 0.5), **motion})


TORCH = {
    "position": ("position", lambda v: ByTorch(position=0.5 * v), (2,)),
    "velocity": ("velocity", lambda v: ByTorch(velocity=v), (2,)),
    "rotation": ("rotation", lambda v: ByTorch(rotation=v), ()),
    "angular velocity": ("angular_velocity", lambda v: ByTorch(angular_velocity=v), ()),
    "friction": ("friction", lambda v: ByTorch(friction=0.1 * v), ()),
}
CASES = [*OBSTACLES.values(), *TORCH.values()]
IDS = [*OBSTACLES, *(f"{name} by torch" for name in TORCH)]


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
@pytest.mark.parametrize(("name", "make", "shape"), CASES, ids=IDS)
def test_parameters_of_obstacles(
    name: str, make: Callable[[Tensor], Any], shape: tuple[int, ...], integrator: str, device: str
) -> None:
    state = batch(device).replace(extra={}, material=None, temperature=None)

    def moved(n: int, scenes: int = B, state: mpm.State = state) -> None:
        value = torch.ones(n, *shape, dtype=torch.float64, device=device)
        step = mpm.Step(lattice(scenes), mpm.NeoHookean(**SOLID), boundaries=[make(value)], integrator=integrator)
        step(state, 1e-4)
        if integrator == "explicit":
            mpm.rollout(step, state, 2, 1e-4)

    for n in (1, B):
        moved(n)
    for n in (2, P, P + 1):
        with pytest.raises(ValueError, match=rf"^{name} must be given once or per scene, .* B = {B}, got \[{n}"):
            moved(n)
    with pytest.raises(ValueError, match=rf"^{name} must be given once or per scene, .* B = 1, got \[2"):
        moved(2, 1, state.split()[0])


def test_obstacles_are_of_scenes_that_there_are(device: str) -> None:
    state = batch(device).replace(extra={}, material=None, temperature=None)
    for make in (ball, ByTorch):
        step = mpm.Step(lattice(), mpm.NeoHookean(**SOLID), boundaries=[make(scene=B)])
        with pytest.raises(ValueError, match=f"^scene must be below B = {B}, got {B}$"):
            step(state, 1e-4)


def test_regions_of_heat_are_checked(device: str) -> None:
    region = ball(position=torch.full((2, 2), 0.5, dtype=torch.float64, device=device))
    for kind in (heat_boundaries.Fixed, heat_boundaries.FixedSurface):
        heat = mpm.Heat(lattice(), 1.0, 1.0, boundaries=[kind(region, 1.0)])
        with pytest.raises(ValueError, match=rf"^position must be given once or per scene, .* B = {B}, got \[2, 2\]"):
            heat(batch(device), 1e-3)


def test_times_of_another_batch_are_errors(device: str) -> None:
    state, step = batch(device), mpm.Step(lattice(), mpm.NeoHookean(**SOLID))
    for shape in ((2,), (P,), (B, 1)):
        late = state.replace(time=torch.zeros(shape, dtype=torch.float64, device=device))
        for use in (step, lambda s, dt: mpm.rollout(step, s, 2, dt)):
            with pytest.raises(ValueError, match=rf"^time must be a number or have shape .*\[B\] = \[{B}\], got"):
                use(late, 1e-5)


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.complex64])
def test_a_time_step_of_another_kind_pauses_nothing(dtype: torch.dtype, device: str) -> None:
    """As a whole number it is zero, which pauses a scene."""
    dt = torch.tensor([1e-4], device=device).to(dtype)
    step = mpm.Step(lattice(), mpm.NeoHookean(**SOLID))
    for use in (step, lambda s, dt: mpm.rollout(step, s, 2, dt)):
        with pytest.raises(TypeError, match=rf"^dt must be a number or a floating tensor, got {dtype}"):
            use(batch(device), dt)


# ---- ops


def test_faces_of_laws(device: str) -> None:
    """Where their number is not given, there may be more scenes than have particles. On the CPU there are no fewer."""
    state = batch(device)
    nu = torch.full((), 0.3, dtype=torch.float64, device=device)

    def energy(n: int, scenes: int | None = None) -> Tensor:
        moduli = [torch.full((n,), 1e4, dtype=torch.float64, device=device), nu]
        return law_energy("neo_hookean", state.F, moduli, scene=state.scene, scenes=scenes)

    for n in (1, B, P):
        assert energy(n).isfinite().all() and energy(n, B).isfinite().all()
    assert energy(7, 7).isfinite().all()  # some have no particles
    for n in WRONG:
        with pytest.raises(ValueError, match=rf"^mu must have .* got \[{n}\] with B = {B}$"):
            energy(n, B)
    if device == "cpu":
        with pytest.raises(ValueError, match=rf"^mu must have .* got \[2\] with B at least {B}$"):
            energy(2)
    with pytest.raises(ValueError, match=r"^mu must have shape \[\], \[1\] or \[P\] = \[12\] without scene, got \[3\]"):
        law_update("neo_hookean", state.F, [torch.ones(3, dtype=torch.float64, device=device), nu])


@pytest.mark.parametrize("law", LAWS)
def test_ops_read_no_further_than_their_parameters(law: str, device: str) -> None:
    """A scene without an entry is an error on the CPU. On other devices its particles are invalid, as nothing waits for
    the device, and the others are as they should be."""
    info, dim = LAWS[law], 2 if LAWS[law].in_2d else 3
    F = torch.eye(dim, dtype=torch.float64, device=device).repeat(P, 1, 1) * 1.01
    state = F if info.field == "F" else F[:, 0, 0].contiguous()
    scene = torch.arange(P, dtype=torch.int32, device=device) % B
    history = [0.1 * (F if h.matrix else F[:, 0, 0]) for h in info.history_with(())]
    for k, _ in enumerate(info.parameters):

        def energy(entries: int, k: int = k) -> Tensor:
            parameters = [torch.full((), 0.4, dtype=torch.float64, device=device) for _ in info.parameters]
            parameters[k] = torch.full((entries,), 0.4, dtype=torch.float64, device=device)
            return torch.ops.torch_mpm.law_energy(state, parameters, history, scene, law, dim)

        right = energy(B)
        torch.testing.assert_close(energy(1), right)
        if device == "cpu":
            with pytest.raises(RuntimeError, match=rf"parameters\[{k}\] must .* B at least {B},.* got \[2\]"):
                energy(2)
        else:
            torch.testing.assert_close(energy(2)[scene < 2], right[scene < 2])
            assert not energy(2)[scene == 2].isfinite().any()


@pytest.mark.parametrize("op", ["substeps", "contact", "contact_impulses", "survey", "grid_update", "wall_impulses"])
def test_ops_know_their_scenes(op: str) -> None:
    """Tensors per scene with one entry more or fewer than there are scenes."""
    from benchmarks.fuzz import operators

    names = ("gravity", "scene_dt", "obstacles", "scene_time", "parameters")
    for dim in (2, 3):
        for name, arguments in operators.calls(dim):
            if name != op:
                continue
            for key in set(names) & arguments.keys():
                value = arguments[key]
                for n in (3, 4, operators.PARTICLES + 1):
                    if key == "parameters":
                        wrong = [torch.ones(n, dtype=torch.float64), *value[1:]]
                    else:
                        wrong = value[:1].repeat(n, *(1,) * (value.dim() - 1))
                    with pytest.raises(RuntimeError, match=rf"{key}(\[0\])? must (have|be) "):
                        getattr(torch.ops.torch_mpm, op)(*(arguments | {key: wrong}).values())


def test_messages_are_the_same_for_all_laws() -> None:
    """The name of the argument comes first, then what was expected, then what came."""
    law = mpm.WeaklyCompressible(torch.ones(2), viscosity=torch.ones(2))
    with pytest.raises(ValueError) as caught:
        law.stress(batch())
    expected = f"bulk_modulus must have shape [], [1], [B] or [P] = [{P}], got [2] with B = {B}"
    assert str(caught.value) == expected
    with pytest.raises(ValueError, match=re.escape("viscosity must have shape")):
        mpm.WeaklyCompressible(1.0, viscosity=torch.ones(2)).stress(batch())
