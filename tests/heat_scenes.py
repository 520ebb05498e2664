"""Scenes of heat in motion, for tests of rollouts and of their gradients."""

import torch

import torch_mpm as mpm
from benchmarks.catalogue.laws import named
from torch_mpm import heat_boundaries

DT = 2e-4
LAWS = ("neo_hookean", "fluid", "von_mises", "sand", "viscoelastic")
TRANSFERS = ("hybrid", "apic", "flip", "pic")


def scene(dim=3, dtype=torch.float64, scenes=1, law="neo_hookean", device="cpu", **options):
    """A step and a state: a block in motion whose temperature varies, in an order that is not that of cells."""
    g = torch.Generator().manual_seed(5)
    melts, per_particle = options.pop("melts", False), options.pop("per_particle", False)
    of_grid = {"kernel": options.pop("kernel", "quadratic"), "deterministic": options.pop("deterministic", False)}
    of_grid["max_blocks"] = options.pop("max_blocks", None)
    grid = mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim, scenes, **of_grid)
    points = mpm.seed.box((0.25,) * dim, (0.65,) * dim, grid, options.pop("per_cell", 2**dim), dtype=dtype)
    x = points.x[torch.randperm(len(points.x), generator=g)].repeat(scenes, 1)
    count = len(x)
    ids = torch.arange(scenes, dtype=torch.int32).repeat_interleave(count // scenes) if scenes > 1 else None
    given = mpm.seed.Points(x, points.volume[:1].expand(count).clone(), ids)
    velocity = 2 * torch.rand(count, dim, generator=g, dtype=torch.float64) - 1
    state = mpm.State.at_rest(given, 1000.0, dtype=dtype).replace(
        v=velocity.to(dtype), temperature=(10 * x[:, 0].sin() + x[:, -1]).to(dtype)
    )

    def value(number):
        if per_particle:
            return number * (1 + torch.rand(count, generator=g, dtype=torch.float64).to(dtype))
        return number * torch.linspace(1, 2, scenes, dtype=dtype) if scenes > 1 else number

    melting = {"melting_point": value(3.0), "latent_heat": value(500.0)} if melts else {}
    heat = mpm.Heat(
        grid, value(2000.0), value(100.0), transfer=options.pop("transfer", "hybrid"), tolerance=1e-9, **melting
    )
    laws = list(named(*LAWS).values()) if law == "mixture" else [named(law)[law]]
    if law == "mixture":
        state = state.replace(material=(torch.arange(count) % len(laws)).int())
    step = mpm.Step(
        grid, mpm.Mixture([each() for each in laws]) if law == "mixture" else laws[0](), (0.0, -10.0, 0.0)[:dim],
        "separate", boundaries=[mpm.Sphere((0.51, 0.22, 0.48)[:dim], 0.1, friction=0.2)], heat=heat, **options,
    )  # fmt: skip
    return step.to(device), step.prepare(state.to(device=device))


def composed(step, state, n, dt):
    for _ in range(n):
        state = step(state, dt)
    return state


def bodies(dim):
    """Obstacles of each shape with a kernel, near the block."""
    at, up = (0.45, 0.25, 0.45)[:dim], (0.1, 1.0, 0.2)[:dim]
    ball = mpm.shapes.Sphere(0.11)
    return {
        "plane": mpm.Plane((0.0, 0.27, 0.0)[:dim], up),
        "sphere": mpm.Sphere(at, 0.12, velocity=(3.0, 1.0, -2.0)[:dim]),
        "box": mpm.Box(at, (0.3, 0.15, 0.2)[:dim], rotation=0.3 if dim == 2 else (0.1, 0.2, 0.3)),
        "capsule": mpm.Capsule(at, up, 0.1, angular_velocity=20.0 if dim == 2 else (0.0, 0.0, 20.0)),
        "revolved": mpm.boundaries.Revolved(at, ((0.0, 0.0), (0.2, 0.0), (0.0, 0.15)), up),
        "torus": mpm.Obstacle(mpm.shapes.Torus((0.0, 0.12, 0.0)[:dim], 0.07), at),
        "sampled": mpm.Obstacle(mpm.shapes.Sampled.of(ball, (-0.2,) * dim, (0.2,) * dim, 0.02), at),
        "path": mpm.Sphere(lambda t: torch.stack([0.45 + 5 * t, *[0.3 + 0 * t] * (dim - 1)], -1), 0.12),
        "for a time": mpm.Sphere(at, 0.12, start=2.5 * DT, end=6.5 * DT),
    }


def held(step, *terms):
    """The step with obstacles that hold a temperature."""
    step.heat.boundaries = [kind(region, temperature) for kind, region, temperature in terms]
    step.boundaries = list(dict.fromkeys([*step.boundaries.entries, *(region for _, region, _ in terms)]))
    return step


def surface_and_nodes(dim):
    """Arguments of `held`: an obstacle that holds a temperature at its surface, and one at the nodes in it."""
    return [
        (heat_boundaries.FixedSurface, bodies(dim)["sphere"], 40.0),
        (heat_boundaries.Fixed, bodies(dim)["plane"], -5.0),
    ]


def terms(scenes=1, particles=0):
    """Terms of boundaries at the free surface and inside, by name."""
    surface = heat_boundaries.FreeSurface()
    each = torch.linspace(1, 2, scenes, dtype=torch.float64)
    return {
        "flux": [heat_boundaries.Flux(surface, 4e6 * each if scenes > 1 else 4e6)],
        "convection": [heat_boundaries.Convection(surface, 3e4, 40.0 * each if scenes > 1 else -20.0)],
        "radiation": [heat_boundaries.Radiation(surface, 0.9, 3000.0)],
        "source": [heat_boundaries.Source(2e8 * (torch.ones(particles).double() if particles else each[:1]))],
    }


Table = mpm.Table
SOFTENING = Table([-10.0, 2.0, 20.0], [2e5, 1e5, 1e4])
WATER = {"bulk_modulus": 1e5, "viscosity": 5.0}
THERMAL = {
    "softening": lambda: mpm.NeoHookean(E=SOFTENING, nu=0.3),
    "thinning": lambda: mpm.WeaklyCompressible(1e5, 7.0, Table([0.0, 5.0], [10.0, 1.0])),
    "two tables": lambda: mpm.VonMises(E=SOFTENING, nu=0.3, yield_stress=Table([0.0, 6.0], [3e2, 1e2])),
    "expansion": lambda: mpm.ThermalExpansion(mpm.NeoHookean(E=1e5, nu=0.3), 1e-3),
    "expansion by a table": lambda: mpm.ThermalExpansion(mpm.Hencky(E=1e5, nu=0.3), Table([0.0, 5.0], [1e-3, 2e-3])),
    "expansion and flow": lambda: mpm.ThermalExpansion(mpm.VonMises(E=SOFTENING, nu=0.3, yield_stress=1e2), 1e-3),
    "expanding fluid": lambda: mpm.ThermalExpansion(mpm.WeaklyCompressible(1e5), 1e-3),
    "expanding sand": lambda: mpm.ThermalExpansion(named("sand")["sand"](), 1e-3),
    "melting": lambda: mpm.Melting(mpm.FixedCorotated(E=1e5, nu=0.3), mpm.WeaklyCompressible(**WATER)),
    "melting and flow": lambda: mpm.Melting(named("von_mises")["von_mises"](), mpm.WeaklyCompressible(**WATER), 0.3),
    "melting of water": lambda: mpm.Melting(mpm.NeoHookean(E=1e5, nu=0.3), mpm.WeaklyCompressible(1e5), 0.6),
    "thinning melt": lambda: mpm.Melting(
        mpm.Hencky(E=1e5, nu=0.3),
        mpm.WeaklyCompressible(Table([0.0, 6.0], [1e5, 5e4]), 7.0, Table([0.0, 5.0], [10.0, 1.0])),
    ),
    "wax": lambda: mpm.ThermalExpansion(
        mpm.Melting(mpm.NeoHookean(E=SOFTENING, nu=0.3), mpm.WeaklyCompressible(**WATER), 0.5), 1e-3
    ),
    "viscoelastic wax": lambda: mpm.ThermalExpansion(
        mpm.Melting(named("viscoelastic")["viscoelastic"](), mpm.WeaklyCompressible(**WATER), 0.5), 1e-3
    ),
}


def thermal(names, dim=3, dtype=torch.float64, scenes=1, device="cpu", **options):
    """A scene of laws that read the temperature, of each or of a mixture."""
    step, state = scene(dim, dtype, scenes, melts=True, **options)
    laws = [THERMAL[name]() if name in THERMAL else named(name)[name]() for name in names]
    step.law = laws[0] if len(laws) == 1 else mpm.Mixture(laws)
    material = (torch.arange(len(state)) % len(laws)).int() if len(laws) > 1 else None
    liquid = {"liquid": torch.rand(len(state), generator=torch.Generator().manual_seed(2)).to(dtype)}
    state = state.replace(F=None, J=None, material=material, extra=state.extra | liquid)
    return step.to(device), step.prepare(state.to(device=device))
