"""`survey` against the same in plain torch: limits of the time step, speeds and particles that are wrong."""

import math

import pytest
import torch
from helpers import TOLERANCE
from oracle import cfl as reference

import torch_mpm as mpm
from benchmarks.catalogue.laws import named
from torch_mpm.ops import survey
from torch_mpm.step.stability import law_diagnostics

F64 = torch.float64
BOUND = 4 / 0.125**2


def particles(dim: int, scenes: int, device: str, dtype: torch.dtype = F64, count: int = 300) -> dict[str, object]:
    g = torch.Generator().manual_seed(5)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=g, dtype=F64).to(device, dtype)

    scene = None if scenes == 1 else (torch.arange(count, device=device) * scenes // count).int()
    x = 0.1 + 0.8 * torch.rand(count, dim, generator=g, dtype=F64).to(device, dtype)
    mass, volume = (0.5 + normal().abs() for _ in range(2))
    state = mpm.State(x=x, v=normal(dim), mass=mass, volume=volume, C=normal(dim, dim), scene=scene)
    return {"state": state, "stress": 1e3 * normal(dim, dim), "stiffness": 1e4 * normal().abs()}


def grid(dim: int, scenes: int = 1) -> mpm.Grid:
    return mpm.Grid(dx=0.125, lower=(0.0,) * dim, upper=(1.0,) * dim, scenes=scenes)


def compare(given: dict[str, object], box: mpm.Grid, **options: object) -> torch.Tensor:
    found = torch.stack(survey(box, **given, bound=BOUND, kept=2.0, **options), 1)
    expected = reference.survey(box, **given, bound=BOUND, kept=2.0, **options)
    tolerance = TOLERANCE["transfer"][given["state"].x.dtype]
    torch.testing.assert_close(found, expected, rtol=10 * tolerance, atol=0)
    return found


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("scenes", [1, 5])
@pytest.mark.parametrize("options", [{}, {"volumetric": True}, {"viscosity": True}, {"energy": True, "speed": True}])
def test_figures(dim, scenes, dtype, options, device):
    given = particles(dim, scenes, device, dtype)
    tensors = {k: given["stiffness"].roll(int(k == "speed")) / 1e3 for k, v in options.items() if k != "volumetric"}
    options = {k: tensors.get(k, v) for k, v in options.items()}
    found = compare(given, grid(dim, scenes), **options)
    assert (found[:, :2] > 0).all()
    assert (found[:, 2] == 0).all()


def test_scenes_that_take_turns(device):
    """Neighbours in memory of different scenes, and a scene without particles."""
    given = particles(3, 1, device)
    state = given["state"].replace(scene=(torch.arange(300, device=device) % 6).int())
    found = compare({**given, "state": state}, grid(3, 7))
    assert (found[6] == 0).all()


def test_without_particles(device):
    given = particles(2, 1, device, count=0)
    assert torch.stack(survey(grid(2), **given, bound=BOUND, kept=1.0)).tolist() == [[0.0], [0.0], [0.0]]


def test_what_is_wrong_is_counted_and_limits_nothing(device):
    given = particles(3, 2, device)
    state, energy = given["state"], torch.ones(300, dtype=F64, device=device)
    state.x[3, 1] = math.nan
    state.x[200, 0] = 1.126  # more than a cell outside
    state.x[201, 0] = 1.124
    state.v[7, 2] = math.inf
    state.v[8, 2] = math.nan
    energy[9] = math.inf
    found = torch.stack(survey(grid(3, 2), **given, bound=BOUND, kept=2.0, energy=energy), 1)
    assert found[:, 2].tolist() == [4, 1]
    assert found[0, 0] == math.inf  # of an infinite speed, but not of one that is not known
    finite = given["state"].v[10:150].norm(dim=1).max()
    state.v[7] = 0
    figures = survey(grid(3, 2), **given, bound=BOUND, kept=2.0)
    assert figures.rate.isfinite().all()
    assert figures.speed[0] >= finite


def test_no_mass_and_huge_numbers(device):
    given = particles(2, 1, device, torch.float32)
    given["state"].mass[4] = 0
    assert survey(grid(2), **given, bound=BOUND, kept=2.0).rate.tolist() == [math.inf]
    given = particles(2, 1, device, torch.float32)
    given["stress"] = 1e30 * given["stress"] / given["stress"].abs().max()
    figures = survey(grid(2), **given, bound=BOUND, kept=2.0)
    assert figures.rate.isfinite().all()


def test_moving_obstacles_near_particles_count(device):
    """A sphere and a plane, whose distances are exact: the speeds are those of `Obstacle.speed`."""
    given, box = particles(3, 2, device), grid(3, 2)
    obstacles = [
        mpm.Sphere((0.5, 0.5, 0.5), 0.1, velocity=(40.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 30.0)),
        mpm.Plane((0.0, 0.2, 0.0), (0.0, 1.0, 0.0), velocity=(0.0, 60.0, 0.0), scene=1),
        mpm.Sphere((0.5, 0.5, 0.5), 0.4, velocity=(1e4, 0.0, 0.0), start=1.0),
    ]
    obstacles = [o.to(device, F64) for o in obstacles]
    state, reach = given["state"].replace(time=0.01), 0.05
    speeds = torch.stack([o.speed(state.x, state.scene, 0.01, reach) for o in obstacles]).amax(0)
    given = {**given, "state": state}
    found = survey(box, **given, bound=BOUND, kept=2.0, obstacles=obstacles, reach=reach)
    expected = reference.survey(box, **given, bound=BOUND, kept=2.0, speed=speeds)
    assert speeds.max() > 40
    torch.testing.assert_close(found.rate, expected[:, 0], rtol=1e-12, atol=0)


def test_steps_survey_their_state(device):
    """The rate is that of `stable_dt`, also of a mixture, where each law speaks of its own particles."""
    given = particles(3, 2, device)
    state = given["state"].replace(material=(torch.arange(300, device=device) % 2).int())
    step = mpm.Step(grid(3, 2), mpm.Mixture([mpm.NeoHookean(E=1e5, nu=0.3), mpm.WeaklyCompressible(1e4)]))
    figures = step.stability_report(state)
    assert torch.equal(1 / figures.rate, step.stable_dt(state, 1.0))
    alone = [mpm.Step(step.grid, law).stable_dt(state.select((state.material == k).nonzero()[:, 0]), 1.0)
             for k, law in enumerate(step.law.laws)]  # fmt: skip
    assert torch.all(step.stable_dt(state, 1.0) <= torch.stack(alone).amin(0) * (1 + 1e-12))
    prepared = step.prepare(state)
    prepared.F[5] = -torch.eye(3, dtype=F64, device=device)  # a particle of the fluid
    assert step.stability_report(prepared).wrong.tolist() == [0, 0]
    prepared.F[4] = -torch.eye(3, dtype=F64, device=device)
    assert step.stability_report(prepared).wrong.tolist() == [1, 0]


def test_op_is_well_formed(device):
    given, box = particles(2, 3, device), grid(2, 3)
    state = given["state"]
    obstacle = torch.randn(1, 1, 10, dtype=F64, device=device)
    arguments = (
        *(state.x, state.v, state.mass, state.volume, state.C, given["stress"], given["stiffness"]),
        *(None, state.mass, None, state.scene, BOUND, 2.0, True, 0.1, box.upper, 3),
        *(obstacle, state.x.new_zeros(0), [1], [0], [1], [-1], [0.0], [1.0], None, 0.5, *box.packed),
    )
    torch.library.opcheck(torch.ops.torch_mpm.survey, arguments)


LAWS = named("neo_hookean", "sand", "sand_hardening", "von_mises", "snow", "fluid", "softening")


def deformed(law, dim, device, dtype, scenes=3):
    """Particles, some flowing and some inverted."""
    given = particles(dim, scenes, device, dtype)["state"]
    random = torch.Generator().manual_seed(2)
    F = torch.eye(dim, dtype=F64) + 0.15 * torch.randn(len(given), dim, dim, generator=random, dtype=F64)
    F[7] *= -1 if dim == 3 else torch.tensor([1.0, -1.0])
    theta = torch.rand(len(given), generator=random, dtype=F64)
    state = given.replace(F=F.to(device, dtype), J=F.det().to(device, dtype), temperature=theta.to(device, dtype))
    return state.replace(extra={name: law.initial(name, state) + 0.01 for name in law.extra_fields})


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("name", LAWS)
def test_law_diagnostics_a_law(name, dim, dtype, device):
    """Values of one op equal those of the law's methods, also for flow, inversion and parameters that are functions."""
    law = LAWS[name]()
    state = deformed(law, dim, device, dtype)
    with torch.no_grad():
        stress, stiffness, energy = law_diagnostics(law, state, True)
        assert torch.equal(stress, law.stress(state))
        assert torch.equal(stiffness, law.stiffness(state))
        assert torch.equal(energy, law.energy_density(state))
        assert law_diagnostics(law, state, False)[2] is None
    assert not bool(energy.isfinite().all())


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_law_diagnostics_a_mixture(dim, dtype, device):
    laws = [LAWS[name]() for name in ("neo_hookean", "von_mises", "fluid", "snow")]
    law = mpm.Mixture(laws)
    state = deformed(law, dim, device, dtype)
    state = state.replace(material=(torch.arange(len(state), device=device) % 4).int())
    with torch.no_grad():
        found = law_diagnostics(law, state, True)
        for k, part in enumerate(laws):
            of = state.material == k
            expected = part.stress(state), part.stiffness(state), part.energy_density(state)
            assert all(torch.equal(a[of], b[of]) for a, b in zip(found, expected, strict=True))


def test_law_diagnostics_what_a_law_adds(device):
    """The methods of a subclass are used where it overrides one."""

    class Harder(mpm.NeoHookean):
        def stiffness(self, state):
            return 2 * super().stiffness(state)

    state = deformed(LAWS["neo_hookean"](), 3, device, F64)
    once, twice = (law_diagnostics(law(E=2e4, nu=0.3), state, False)[1] for law in (mpm.NeoHookean, Harder))
    assert torch.equal(2 * once, twice)


def test_mixture_of_one_law_asks_for_its_material(device):
    law = mpm.Mixture([LAWS["neo_hookean"]()])
    step = mpm.Step(grid(3), law)
    state = deformed(law, 3, device, F64, scenes=1)
    for material in (None, torch.full((len(state),), 5, dtype=torch.int32, device=device)):
        for run in (step.stable_dt, lambda given: mpm.rollout(step, given, 20, 1e-6)):
            with pytest.raises(ValueError, match=r"state\.material"):
                run(state.replace(material=material))
