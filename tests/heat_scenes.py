"""Scenes of heat in motion, for tests of rollouts and of their gradients."""

import torch

import torch_mpm as mpm
from benchmarks.catalogue.laws import named

DT = 2e-4
LAWS = ("neo_hookean", "fluid", "von_mises", "sand", "viscoelastic")
TRANSFERS = ("hybrid", "apic", "flip", "pic")


def scene(dim=3, dtype=torch.float64, scenes=1, law="neo_hookean", device="cpu", **options):
    """A step and a state: a block in motion whose temperature varies, in an order that is not that of cells."""
    g = torch.Generator().manual_seed(5)
    melts, per_particle = options.pop("melts", False), options.pop("per_particle", False)
    of_grid = {"kernel": options.pop("kernel", "quadratic"), "deterministic": options.pop("deterministic", False)}
    grid = mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim, scenes, **of_grid)
    points = mpm.seed.box((0.25,) * dim, (0.65,) * dim, grid, 2**dim, dtype=dtype)
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
