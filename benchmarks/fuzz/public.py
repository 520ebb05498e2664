"""Valid calls of the public functions and classes, of about a millisecond each."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch

import torch_mpm as mpm
from benchmarks.fuzz.mutations import refuses
from torch_mpm import heat_boundaries, splats
from torch_mpm.geometry import seed
from torch_mpm.implicit import Implicit

Call = tuple[Callable[..., Any], dict[str, Any]]
E, NU = 1e4, 0.3
POINTS = 16


class _World:
    """Small objects for the arguments of calls, made anew for each call, which may change them."""

    def __init__(self) -> None:
        self.grid = mpm.Grid(0.25, (0.0, 0.0), (1.0, 1.0), max_blocks=9)
        random = torch.Generator().manual_seed(0)
        self.x = 0.2 + 0.6 * torch.rand(POINTS, 2, generator=random)
        self.one = torch.ones(POINTS)
        self.matrix = torch.eye(2).repeat(POINTS, 1, 1)
        self.law = mpm.NeoHookean(E=E, nu=NU)
        self.state = mpm.State(
            x=self.x, v=0 * self.x, mass=self.one, volume=0.01 * self.one, C=0 * self.matrix, F=self.matrix,
            J=self.one, temperature=0 * self.one,
        )  # fmt: skip
        self.points = seed.Points(self.x, 0.01 * self.one)

    @property
    def blocks(self) -> mpm.Blocks:
        return self.grid.activate(self.x)

    def batch(self) -> tuple[mpm.Grid, mpm.State]:
        grid = mpm.Grid(0.25, (0.0, 0.0), (1.0, 1.0), scenes=3, max_blocks=27)
        return grid, self.state.replace(scene=(torch.arange(POINTS) % 3).int())

    def heat(self) -> mpm.Heat:
        return mpm.Heat(self.grid, conductivity=1.0, specific_heat=1.0)


def calls() -> dict[str, Callable[[], Call]]:
    """By name: a function that makes (callable, arguments by name)."""
    single = {**_grids_and_states(), **_steps(), **_laws(), **_boundaries(), **_heat(), **_seed(), **_ops()}
    return {**single, **_rollouts(), **_particles(), **_batches()}


LARGEST = 32
"""Largest number of steps, rows or scenes."""


def _limited(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that refuses numbers beyond the time limit of this program."""

    def called(**arguments: Any) -> Any:
        for name in ("n", "most", "room", "scenes", "blocks"):
            value = arguments.get(name)
            if isinstance(value, (int, float)) and value > LARGEST:
                raise mpm.SimulationError(f"{name} is too large for this program")
        return function(**arguments)

    return called


def _rollouts() -> dict[str, Callable[[], Call]]:
    def taken(function: Callable[..., Any], /, **given: Any) -> Callable[[], Call]:
        """Call with a step of a batch and its state, if they are arguments of the function."""

        def make() -> Call:
            w = _World()
            grid, state = w.batch()
            step = mpm.Step(grid, w.law, walls="slip", gravity=(0.0, -9.8))
            return _limited(function), dict(step=step, state=state, **given)

        return make

    def environments() -> Call:
        w = _World()
        step = mpm.Step(w.batch()[0], w.law)
        return _limited(mpm.Environments), dict(step=step, states=[w.state, w.state, w.state], room=POINTS + 2)

    def advanced() -> Call:
        function, given = environments()
        return _limited(function(**given).advance), dict(n=2, dt=torch.tensor([1e-4, 2e-4, 2e-4]))

    def of_bodies() -> Call:
        w = _World()
        grid, state = w.batch()
        ball = mpm.Sphere((0.5, 0.5), 0.2)
        step = mpm.Step(grid, w.law, boundaries=[ball])
        poses = torch.zeros(grid.scenes, 1, 6, dtype=torch.float64)
        return _limited(mpm.RigidBodies(step, [ball]).advance), dict(state=state, bodies=poses, n=2, dt=1e-4)

    def of_free_bodies() -> Call:
        w = _World()
        grid, state = w.batch()
        body = mpm.bodies.Body(mpm.Sphere((0.0, 0.0), 0.2), 3.0, 0.1)
        bodies = mpm.bodies.FreeBodies(mpm.Step(grid, w.law), [body], gravity=(0.0, -1.0))
        rows = torch.zeros(grid.scenes, 1, 6, dtype=torch.float64)
        return _limited(bodies.advance), dict(
            state=state, bodies=rows, n=2, dt=1e-4, wrenches=torch.ones_like(rows[..., 3:]), checkpoint=1
        )

    def method(name: str, /, **given: Any) -> Callable[[], Call]:
        def make() -> Call:
            w = _World()
            return getattr(mpm.Step(w.batch()[0], w.law), name), dict(state=w.batch()[1], **given)

        return make

    def implicit() -> Call:
        def use(**arguments: Any) -> Any:
            w = _World()
            return mpm.Step(w.grid, w.law, integrator=Implicit(**arguments))(w.state, 1e-4)

        limits = dict(tolerance=1e-4, max_iterations=5, max_cg_iterations=50, adjoint_tolerance=1e-8)
        return use, dict(**limits, plasticity="after", explicit=())

    several = dict(n=2, dt=torch.tensor([1e-4, 2e-4, 2e-4]))
    return {
        "rollout of a batch": taken(mpm.rollout, **several, checkpoint=2, hook=lambda state, k: None, every=1),
        "rollout with norms": taken(mpm.rollout, n=2, dt=1e-4, norms=mpm.GradientNorms(), graph=2),
        "rollout_to": taken(mpm.rollout_to, time=2e-4, cfl=0.5, longest=1e-3, every=2, most=8, checkpoint=2),
        "frames": taken(mpm.frames, n=2, dt=1e-4, every=1, fields=("x", "F"), prefix=1, truncate=1),
        "estimate_rollout": taken(mpm.estimate_rollout, n=2, dt=1e-4, checkpoint=1, prefix=0, truncate=1),
        "plan_rollout": taken(mpm.plan_rollout, n=2, dt=1e-4, checkpoint=1, schedule="per_step"),
        "substeps_arguments": taken(mpm.substeps_arguments, n=2, dt=1e-4, records=True, blocks=27),
        "Environments": environments,
        "Environments.advance": advanced,
        "RigidBodies.advance": of_bodies,
        "FreeBodies.advance": of_free_bodies,
        "Checkpoints": lambda: (mpm.Checkpoints, dict(every=2, offload=False)),
        "GradientNorms": lambda: (mpm.GradientNorms, dict(every=2)),
        "Step.stable_dt": method("stable_dt", cfl=0.5),
        "Step.explain": method("explain", dt=1e-4),
        "Step.failures": method("failures"),
        "Step.with_impulses": method("with_impulses"),
        "Implicit": implicit,
    }


def _particles() -> dict[str, Callable[[], Call]]:
    """Operations on particles, functions that join and split states, and files of splats."""

    def acting(kind: Callable[..., Any], /, **given: Any) -> Callable[[], Call]:
        def use(**arguments: Any) -> Any:
            w = _World()
            return mpm.Step(w.grid, w.law, on_particles=kind(**arguments))(w.state, 1e-4)

        when = dict(start=torch.zeros(POINTS), end=1.0, particles=torch.ones(POINTS, dtype=torch.bool))
        return lambda: (use, dict(given, **when))

    def waypoints() -> Call:
        def use(**arguments: Any) -> Any:
            w = _World()
            hand = mpm.Sphere(mpm.Waypoints(**arguments), 0.1)
            return mpm.rollout(mpm.Step(w.grid, w.law, boundaries=[hand]), w.state, 2, 1e-4)

        return use, dict(time=[0.0, 1.0, 2.0], position=torch.full((3, 2), 0.5))

    operations = mpm.particle_operations
    return {
        "Push": acting(operations.Push, force=torch.zeros(POINTS, 2)),
        "Hold": acting(operations.Hold, velocity=(0.0, 1.0)),
        "Present": acting(operations.Present),
        "Waypoints": waypoints,
        "State.split": lambda: (_limited(_World().batch()[1].split), dict(scenes=3)),
        "splats.FrameWriter": lambda: (splats.FrameWriter, dict(threads=2, most=4)),
        "State.of_scenes": lambda: (_World().batch()[1].of_scenes, dict(scenes=3)),
    }


def _batches() -> dict[str, Callable[[], Call]]:
    """Parameters as tensors, per scene or per particle, in steps of a batch of three scenes."""
    of_scenes, of_particles = torch.tensor([1.0, 2.0, 2.0]), torch.linspace(1.0, 2.0, POINTS)

    def stepped(law: Callable[..., mpm.Material], /, **given: Any) -> Callable[[], Call]:
        def use(**arguments: Any) -> Any:
            w = _World()
            grid, state = w.batch()
            state = state.replace(material=(torch.arange(POINTS) % 2).int(), extra={"liquid": 0.5 * state.mass})
            return mpm.Step(grid, law(**arguments))(state, 1e-5)

        return lambda: (use, {name: v.clone() if isinstance(v, torch.Tensor) else v for name, v in given.items()})

    def mixed(**arguments: Any) -> mpm.Material:
        """A mixture whose first law alone has particles."""
        return mpm.Mixture([mpm.NeoHookean(E=E, nu=NU), mpm.Hencky(E=E, nu=NU), mpm.FixedCorotated(**arguments)])

    def molten(**arguments: Any) -> mpm.Material:
        return mpm.Melting(mpm.NeoHookean(E=E, nu=NU), mpm.WeaklyCompressible(**arguments))

    def obstructed(obstacle: Callable[..., Any], /, **given: Any) -> Callable[[], Call]:
        def use(**arguments: Any) -> Any:
            w = _World()
            grid, state = w.batch()
            return mpm.Step(grid, w.law, boundaries=[obstacle(**arguments)])(state, 1e-4)

        motion = dict(velocity=torch.zeros(3, 2), friction=0.1 * of_scenes, rotation=0.1 * of_scenes, scene=1)
        return lambda: (use, dict(position=torch.full((3, 2), 0.5), **given, **motion))

    def heated(heat: Callable[..., Any], /, **given: Any) -> Callable[[], Call]:
        def use(**arguments: Any) -> Any:
            grid, state = _World().batch()
            return heat(grid, **arguments)(state, 1e-3)

        return lambda: (use, dict(given))

    def bounded(boundary: Callable[..., Any], /, **given: Any) -> Callable[[], Call]:
        def heat(grid: mpm.Grid, **arguments: Any) -> mpm.Heat:
            return mpm.Heat(grid, 1.0, 1.0, boundaries=[boundary(**arguments)])

        return heated(heat, **given)

    def by_gravity() -> Call:
        w = _World()
        grid, state = w.batch()
        return (lambda gravity: mpm.Step(grid, w.law, gravity=gravity)(state, 1e-4)), dict(gravity=torch.zeros(3, 2))

    def distance(x: torch.Tensor) -> torch.Tensor:
        return x.norm(dim=-1) - 0.1

    moduli = dict(E=E * of_scenes, nu=NU)
    b, ball = heat_boundaries, mpm.Sphere((0.5, 0.5), 0.3)
    place = torch.full((7, 2), 0.5)
    surface = b.Surface(place, 0.1, torch.tensor([0, 1, 1, 2, 2, 2, 2], dtype=torch.int32))
    return {
        "NeoHookean of a batch": stepped(mpm.NeoHookean, **moduli),
        "Hencky of Lamé parameters of a batch": stepped(mpm.Hencky, mu=E * of_scenes, lam=E * of_particles),
        "FixedCorotated of a batch": stepped(mpm.FixedCorotated, **moduli),
        "WeaklyCompressible of a batch": stepped(
            mpm.WeaklyCompressible, bulk_modulus=E * of_scenes, gamma=7 * of_particles, viscosity=0.1 * of_scenes
        ),
        "VonMises of a batch": stepped(mpm.VonMises, **moduli, yield_stress=10 * of_particles, hardening=of_scenes),
        "HerschelBulkley of a batch": stepped(
            mpm.HerschelBulkley, **moduli, yield_stress=10 * of_scenes, consistency=of_particles, exponent=of_scenes
        ),
        "Viscoelastic of a batch": stepped(
            mpm.Viscoelastic, **moduli, branch_modulus=E * of_particles, relaxation_time=of_scenes
        ),
        "Snow of a batch": stepped(
            mpm.Snow, **moduli, critical_compression=0.02 * of_scenes, critical_stretch=0.01 * of_particles,
            hardening=10 * of_scenes,
        ),
        "CamClay of a batch": stepped(
            mpm.CamClay, **moduli, critical_slope=of_scenes, consolidation=10 * of_particles, hardening=5 * of_scenes,
            cohesion=0.1 * of_scenes,
        ),
        "QuarticSand of a batch": stepped(
            mpm.QuarticSand, **moduli, friction_angle=0.3 * of_particles, cohesion=0.01 * of_scenes
        ),
        "Active of a batch": stepped(
            mpm.Active, law=mpm.NeoHookean(E=E, nu=NU), direction=torch.ones(POINTS, 2)
        ),
        "ThermalExpansion of a batch": stepped(
            mpm.ThermalExpansion, law=mpm.NeoHookean(E=E, nu=NU), coefficient=1e-5 * of_scenes
        ),
        "Mixture of a batch": stepped(mixed, mu=E * of_scenes, lam=E * of_particles),
        "Melting of a batch": stepped(molten, bulk_modulus=E * of_scenes, gamma=7 * of_particles),
        "gravity of a batch": by_gravity,
        "Plane of a batch": obstructed(mpm.Plane, normal=torch.ones(3, 2)),
        "Sphere of a batch": obstructed(mpm.Sphere, radius=0.1 * of_scenes),
        "Box of a batch": obstructed(mpm.Box, size=0.1 * torch.ones(3, 2)),
        "Capsule of a batch": obstructed(mpm.Capsule, half_axis=0.1 * torch.ones(3, 2), radius=0.1 * of_scenes),
        "SDF of a batch": obstructed(mpm.SDF, distance=distance),
        "Heat of a batch": heated(
            mpm.Heat, conductivity=of_scenes, specific_heat=of_particles, melting_point=of_scenes,
            latent_heat=of_particles,
        ),
        "Flux of a batch": bounded(b.Flux, surface=surface, flux=torch.ones(7)),
        "Convection of a batch": bounded(
            b.Convection, surface=b.FreeSurface(), coefficient=of_scenes, ambient=of_scenes
        ),
        "Radiation of a batch": bounded(b.Radiation, surface=surface, emissivity=0.1 * of_scenes, ambient=of_scenes),
        "Fixed of a batch": bounded(b.Fixed, region=ball, temperature=of_scenes),
        "FixedSurface of a batch": bounded(b.FixedSurface, region=ball, temperature=of_scenes),
        "Source of a batch": bounded(b.Source, power=of_particles),
    }  # fmt: skip


def _grids_and_states() -> dict[str, Callable[[], Call]]:
    def activate() -> Call:
        grid, state = _World().batch()
        return grid.activate, dict(x=state.x, scene=state.scene, previous=None)

    def state() -> Call:
        s = _World().batch()[1]
        names = inspect.signature(mpm.State).parameters
        given = {name: getattr(s, name) for name in names if not name.startswith("_")}
        ids, material = torch.arange(POINTS), torch.zeros(POINTS, dtype=torch.int32)
        return mpm.State, {**given, "ids": ids, "material": material, "extra": {"a": s.mass}}

    def method(name: str, /, **arguments: Any) -> Callable[[], Call]:
        return lambda: (getattr(_World().state, name), arguments)

    def sorted_state() -> Call:
        w = _World()
        return w.state.sorted, dict(grid=w.grid)

    def at_rest() -> Call:
        given = dict(density=1e3, velocity=(0.0, 1.0), dtype=torch.float32, device="cpu")
        return mpm.State.at_rest, dict(points=_World().points, **given)

    def concatenate() -> Call:
        return mpm.State.concatenate, dict(states=[_World().state, _World().state], scene=True)

    lattice = dict(
        dx=0.1, lower=(0.0, 0.0), upper=(1.0, 1.0), scenes=2, kernel="cubic", max_blocks=20, deterministic=True
    )
    return {
        "Grid": lambda: (mpm.Grid, lattice),
        "Grid.activate": activate,
        "State": state,
        "State.at_rest": at_rest,
        "State.select": method("select", particles=torch.arange(3)),
        "State.to": method("to", device="cpu", dtype=torch.float64),
        "State.sorted": sorted_state,
        "State.concatenate": concatenate,
        "Table": lambda: (mpm.Table, dict(temperature=[0.0, 1.0], value=[1.0, 2.0])),
        "PerMaterial": lambda: (mpm.PerMaterial, dict(values=[1.0, 2.0])),
    }


def _steps() -> dict[str, Callable[[], Call]]:
    def step() -> Call:
        w = _World()
        given = dict(
            grid=w.grid, law=w.law, gravity=(0.0, -9.8), walls="slip", boundaries=[mpm.Sphere((0.5, 0.5), 0.1)],
            transfer="apic", flip=0.1, stress_form="mls", on_grid=None, heat=w.heat(),
        )  # fmt: skip
        return (lambda **arguments: mpm.Step(**arguments)(w.state, 1e-4)), given

    def forward() -> Call:
        w = _World()
        return mpm.Step(w.grid, w.law, walls="slip"), dict(state=w.state, dt=1e-4)

    def batch() -> Call:
        w = _World()
        grid, state = w.batch()
        return mpm.Step(grid, w.law, gravity=torch.zeros(3, 2)), dict(state=state, dt=torch.tensor([1e-4, 2e-4, 2e-4]))

    def state_fields() -> Call:
        w = _World()
        step = mpm.Step(w.grid, w.law)
        fields = {name: getattr(w.state, name) for name in ("x", "v", "mass", "volume", "C", "F")}
        return (lambda **changes: step(w.state.replace(**changes), 1e-4)), fields

    def rollout() -> Call:
        w = _World()
        step, taken = mpm.Step(w.grid, w.law), []

        def at_most_five(state: mpm.State, dt: Any) -> mpm.State:
            taken.append(dt)
            if len(taken) > 5:
                raise mpm.SimulationError("n is too large for this program")
            return step(state, dt)

        return mpm.rollout, dict(
            step=at_most_five, state=w.state, n=2, dt=1e-4, checkpoint=1, prefix=0, truncate=1, every=1
        )

    def stable_dt() -> Call:
        w = _World()
        given = dict(grid=w.grid, law=w.law, state=w.state, cfl=0.5, transfer="apic", stress_form="mls")
        return mpm.stable_dt, given

    return {
        "Step": step,
        "Step.forward": forward,
        "Step.forward of a batch": batch,
        "Step.forward with other fields": state_fields,
        "rollout": rollout,
        "stable_dt": stable_dt,
    }


def _laws() -> dict[str, Callable[[], Call]]:
    def applied(law: Callable[..., mpm.Material], /, **given: Any) -> Callable[[], Call]:
        """Construct and call."""

        def use(**arguments: Any) -> Any:
            state = _World().state.replace(extra={name: torch.ones(POINTS) for name in law.extra_fields})
            made = law(**arguments)
            return made.update(state), made.stiffness(state)

        return lambda: (use, dict(given))

    def stress(F: Any) -> torch.Tensor:
        if not isinstance(F, torch.Tensor):  # as another argument
            refuses()
        return F @ F.mT - torch.eye(2)

    def principal_stress(s: Any) -> torch.Tensor:
        return s - 1 if isinstance(s, torch.Tensor) else refuses()

    moduli = dict(E=E, nu=NU)
    return {
        "NeoHookean": applied(mpm.NeoHookean, **moduli),
        "NeoHookean of Lamé parameters": applied(mpm.NeoHookean, mu=torch.tensor(E), lam=torch.full((POINTS,), E)),
        "WeaklyCompressible": applied(mpm.WeaklyCompressible, bulk_modulus=E, gamma=7.0, viscosity=0.1),
        "FixedCorotated": applied(mpm.FixedCorotated, **moduli),
        "Hencky": applied(mpm.Hencky, **moduli),
        "VonMises": applied(mpm.VonMises, **moduli, yield_stress=10.0, hardening=1.0),
        "Snow": applied(mpm.Snow, **moduli, critical_compression=0.02, critical_stretch=0.01, hardening=10.0),
        "CamClay": applied(
            mpm.CamClay, **moduli, critical_slope=1.0, consolidation=10.0, hardening=5.0, cohesion=0.1
        ),
        "QuarticSand": applied(
            mpm.QuarticSand, **moduli, friction_angle=0.5, energy="full", apex="zero", smallest_strain=0.05,
            flow="radial", cohesion=0.01, volume_correction=False,
        ),
        "CustomLaw": applied(mpm.CustomLaw, function=stress, state_field="F", stiffness=1.0),
        "CustomPrincipalLaw": applied(mpm.CustomPrincipalLaw, function=principal_stress, stiffness=1.0),
        "Active": applied(mpm.Active, law=mpm.NeoHookean(**moduli), direction=(1.0, 0.0)),
        "ThermalExpansion": applied(mpm.ThermalExpansion, law=mpm.NeoHookean(**moduli), coefficient=1e-5),
        "HerschelBulkley": lambda: (
            mpm.HerschelBulkley, dict(**moduli, yield_stress=10.0, consistency=1.0, exponent=1.0)
        ),
        "Mixture": lambda: (mpm.Mixture, dict(laws=[mpm.NeoHookean(**moduli), mpm.Hencky(**moduli)])),
        "Melting": lambda: (
            mpm.Melting,
            dict(solid=mpm.NeoHookean(**moduli), liquid=mpm.WeaklyCompressible(E), coherency=0.8),
        ),
    }  # fmt: skip


def _boundaries() -> dict[str, Callable[[], Call]]:
    def applied(obstacle: Callable[..., Any], /, **given: Any) -> Callable[[], Call]:
        """Construct and use in a step."""

        def use(**arguments: Any) -> Any:
            w = _World()
            return mpm.Step(w.grid, w.law, boundaries=[obstacle(**arguments)])(w.state, 1e-4)

        motion = dict(velocity=(0.0, 1.0), friction=0.2, angular_velocity=1.0, start=0.0, end=1.0)
        return lambda: (use, dict(given, **motion))

    def walls() -> Call:
        def use(**arguments: Any) -> Any:
            w = _World()
            return mpm.Step(w.grid, w.law, walls=mpm.Walls(**arguments))(w.state, 1e-4)

        return use, dict(kind="slip", lower=(0.1, 0.1), upper=(0.9, 0.9), friction=0.1)

    def distance(x: torch.Tensor) -> torch.Tensor:
        return x.norm(dim=-1) - 0.1

    def damping() -> Call:
        def use(**arguments: Any) -> Any:
            w = _World()
            return mpm.Step(w.grid, w.law, boundaries=[mpm.boundaries.Damping(**arguments)])(w.state, 1e-4)

        return use, dict(share=0.9)

    centre = dict(position=(0.5, 0.5), kind="slip")
    return {
        "Walls": walls,
        "Damping": damping,
        "Plane": applied(mpm.Plane, **centre, normal=(0.0, 1.0)),
        "Sphere": applied(mpm.Sphere, **centre, radius=0.2),
        "Box": applied(mpm.Box, **centre, size=(0.2, 0.2)),
        "Capsule": applied(mpm.Capsule, **centre, half_axis=(0.1, 0.1), radius=0.1),
        "SDF": applied(mpm.SDF, **centre, distance=distance),
        "Revolved": applied(mpm.Revolved, **centre, outline=[(0.0, -0.1), (0.1, 0.0), (0.0, 0.1)]),
    }


def _heat() -> dict[str, Callable[[], Call]]:
    def heat() -> Call:
        w = _World()
        given = dict(
            grid=w.grid, conductivity=1.0, specific_heat=1.0, transfer="hybrid", melting_point=1.0, latent_heat=1.0,
            plastic_heating=0.5, reference=300.0, tolerance=1e-4, max_iterations=20, method="cg", boundaries=[],
        )  # fmt: skip
        return (lambda **arguments: mpm.Heat(**arguments)(w.state, 1e-3)), given

    def applied(boundary: Callable[..., Any], /, **given: Any) -> Callable[[], Call]:
        def use(**arguments: Any) -> Any:
            w = _World()
            return mpm.Heat(w.grid, 1.0, 1.0, boundaries=[boundary(**arguments)])(w.state, 1e-3)

        return lambda: (use, dict(given))

    b, ball = heat_boundaries, mpm.Sphere((0.5, 0.5), 0.3)
    surface = b.Surface(torch.full((3, 2), 0.5), 0.1)
    return {
        "Heat": heat,
        "Surface": lambda: (b.Surface, dict(points=torch.full((3, 2), 0.5), area=0.1, scene=None)),
        "Flux": applied(b.Flux, surface=surface, flux=1.0),
        "Convection": applied(b.Convection, surface=b.FreeSurface(), coefficient=1.0, ambient=0.0),
        "Radiation": applied(b.Radiation, surface=surface, emissivity=0.5, ambient=300.0),
        "Fixed": applied(b.Fixed, region=ball, temperature=1.0),
        "FixedSurface": applied(b.FixedSurface, region=ball, temperature=1.0),
        "Source": applied(b.Source, power=1.0),
    }


def _seed() -> dict[str, Callable[[], Call]]:
    options: dict[str, Any] = dict(grid=0.25, per_cell=4, method="lattice", seed=0, dtype=torch.float32, device="cpu")
    return {
        "seed.box": lambda: (seed.box, dict(lower=(0.0, 0.0), upper=(1.0, 1.0), **options)),
        "seed.sphere": lambda: (seed.sphere, dict(center=(0.0, 0.0), radius=1.0, **options)),
        "seed.capsule": lambda: (seed.capsule, dict(a=(0.0, 0.0), b=(1.0, 0.0), radius=0.5, **options)),
        "seed.cylinder": lambda: (seed.cylinder, dict(a=(0.0, 0.0, 0.0), b=(1.0, 0.0, 0.0), radius=0.5, **options)),
        "seed.fill": lambda: (seed.fill, dict(shape=seed.Box((0.0, 0.0), (1.0, 1.0)), **options)),
    }


def _ops() -> dict[str, Callable[[], Call]]:
    def on_blocks(name: str, /, **further: Any) -> Callable[[], Call]:
        """With the arguments `further`, or those of the name of a field below."""
        op = getattr(mpm.ops, name)

        def make() -> Call:
            w = _World()
            blocks = w.blocks
            nodes = torch.ones(blocks.node_count, 3)
            fields = dict(
                blocks=blocks, x=w.x, mass=w.one, v=w.x, C=w.matrix, stress=w.matrix, volume=w.one, dt=0.1, F=w.matrix,
                J=w.one, nodes=nodes, velocity=nodes[:, 1:], value=w.x, moment=w.matrix, gradient=w.matrix,
                gravity=torch.ones(2), walls=mpm.Walls("slip"), conductance=w.one, heat_capacity=nodes[:, 0],
                theta=nodes[:, 0], source=nodes[:, 0], exchange=nodes[:, 0], fixed=nodes[:, 0] < 0,
                obstacles=[mpm.Sphere((0.5, 0.5), 0.2), mpm.Plane((0.5, 0.5), (0.0, 1.0))], time=0.0,
            )  # fmt: skip
            wanted = {n: fields[n] for n in inspect.signature(op).parameters if n in fields}
            return op, {**wanted, **further}

        return make

    def on_F(name: str, /, **further: Any) -> Callable[[], Call]:
        return lambda: (getattr(mpm.ops, name), dict(F=_World().matrix, **further))

    def of_law(name: str, **further: Any) -> Callable[[], Call]:
        w = _World()
        scene = torch.zeros(POINTS, dtype=torch.int32)
        parameters = [w.one, torch.ones(()), w.one, torch.ones(1)]
        given = dict(
            law="von_mises", state=w.matrix, parameters=parameters, history=[w.one], scene=scene, dim=2, scenes=1
        )
        return lambda: (getattr(mpm.ops, name), given | further)

    w = _World()
    scene = torch.zeros(POINTS, dtype=torch.int32)
    sand: dict[str, Any] = dict(mu=1.0, lam=w.one, scene=scene, energy="unilateral", scenes=1)
    plastic = dict(friction_angle=0.5, apex="zero", flow="exact", cohesion=0.1, volume_correction=w.one, details=True)
    moving = dict(x=w.x, v=w.x, dt=0.1, C=w.matrix, F=w.matrix, J=w.one, scene=sand["scene"], scenes=2)
    return {
        "p2g": on_blocks("p2g", stress_form="mls"),
        "g2p": on_blocks("g2p", affine=True, gradient=True),
        "scatter": on_blocks("scatter", moment_scale=2.0),
        "gather": on_blocks("gather", moment=True, gradient=True, moment_scale=2.0),
        "g2p_advance": on_blocks("g2p_advance", affine=True, stress_form="mls"),
        "grid_update": on_blocks("grid_update"),
        "contact": on_blocks("contact", mass=torch.ones(9 * 16)),
        "heat_operator": on_blocks("heat_operator", nodes=torch.ones(9 * 16)),
        "heat_cg": on_blocks(
            "heat_cg", tolerance=1e-3, max_iterations=20, method="cg", adjoint_tolerance=1e-3, relative_tolerance=0.0
        ),
        "advance": lambda: (mpm.advance, dict(moving)),
        "svd3": on_F("svd3"),
        "polar": on_F("polar"),
        "quartic_return_map": on_F("quartic_return_map", **sand, **plastic),
        "quartic_energy": on_F("quartic_energy", **sand),
        "quartic_stress": on_F("quartic_stress", **sand),
        "quartic_stiffness": on_F("quartic_stiffness", **sand, smallest_strain=0.1),
        "law_update": of_law("law_update", details=True),
        "law_energy": of_law("law_energy"),
        "law_stiffness": of_law("law_stiffness"),
        "law_wave_modulus": of_law("law_wave_modulus"),
        "law_energy_gradient": of_law("law_energy_gradient"),
        "law_tangent": of_law("law_tangent", before=w.matrix, weight=w.one, projected=True),
        "wall_impulses": on_blocks("wall_impulses"),
        "contact_impulses": on_blocks("contact_impulses", mass=torch.ones(9 * 16)),
    }
