"""Sand as it should behave: at rest, on slopes, in a collapse, in batches; and its scene files."""

import math

import pytest
import torch
from helpers import disc, result, run_quick
from pairs import each_once

import torch_mpm as mpm
from benchmarks import report
from benchmarks.accuracy.runout import GRAVITY, QUARTIC, Case, collapse, fitted_exponent, front, standing

DENSITY, NU = 1600.0, 0.3


def moduli(load: float, compression: float) -> tuple[float, float]:
    """μ and λ of sand that a load [Pa] compresses so far in a confined column: load = 2 a (2 μ + λ) ε³."""
    modulus = load / (2 * QUARTIC * compression**3)
    return modulus * (1 - 2 * NU) / (2 * (1 - NU)), modulus * NU / (1 - NU)


# ---- at rest


@pytest.mark.parametrize(*each_once(energy=["unilateral", "full", "mixed"], dim=[2, 3]))
def test_confined_column_at_rest(device, dim, energy):
    """Dropped on itself and damped, it finds the elastic profile and K₀ = ν/(1 − ν)."""
    height, dx = 0.8, 0.1
    grid = mpm.Grid(dx, (0.0,) * dim, (0.2, 1.0, 0.2)[:dim])
    points = mpm.seed.box((0.0,) * dim, (0.2, height, 0.2)[:dim], grid, per_cell=2**dim, dtype=torch.float64)
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float64).to(device)
    mu, lam = moduli(DENSITY * GRAVITY * height, 0.04)
    law = mpm.QuarticSand(mu=mu, lam=lam, friction_angle=math.radians(30), energy=energy, smallest_strain=0.04)
    step = mpm.Step(grid, law, gravity=(0.0, -GRAVITY, 0.0)[:dim], walls="slip", transfer="pic")
    rest = state.x[:, 1].clone()
    with torch.no_grad():
        for _ in range(1000):
            state = step(state, step.stable_dt(state, 0.5))
        stress = law.stress(state)
    assert float(state.v.abs().max()) < 0.01 * math.sqrt(GRAVITY * height)
    middle = (rest > 0.2) & (rest < 0.6)  # away from the floor and from the thin load of the surface
    ratio = stress[:, 0, 0] / stress[:, 1, 1]
    assert torch.allclose(ratio[middle], torch.full_like(ratio[middle], NU / (1 - NU)), rtol=0.03)
    # First Piola-Kirchhoff stress bears the sand above, all of it counted in the rest configuration.
    stretch = state.F[:, 1, 1]
    strain = (DENSITY * GRAVITY * (height - rest) * stretch / (2 * QUARTIC * (2 * mu + lam))).pow(1 / 3)
    assert torch.allclose(-stretch.log()[middle], strain[middle], rtol=0.05)


def test_heaps_stand_below_the_friction_angle_and_fail_above(device):
    """2-D, 30 degrees: both slopes in one batch."""
    result = standing(Case("planar", 14), (22, 40), 3.0, device)
    stays, fails = result["displacement"]
    assert stays < 0.015
    assert fails > 0.05
    assert (result["steepest"], result["least failing"]) == (22, 40)


# ---- in motion


@pytest.mark.thorough
def test_collapse_keeps_mass_and_loses_energy(device):
    result = collapse(Case("planar", 120), (1.0, 3.0), 4.0, device)
    wide, narrow = result["rows"]
    for row in (wide, narrow):
        distance, depth = row["profile"]
        bins = torch.tensor(depth, dtype=torch.float64) / row["radius / dx"]
        assert float(bins.sum()) == pytest.approx(row["a"], rel=1e-3)  # the area of the column over r₀²
        assert row["largest energy rise"] < 0
        assert row["kinetic energy"] < 0.01
        assert len(distance) == len(depth)
    assert 0.3 < wide["run-out"] < narrow["run-out"] < 8
    assert 3 < wide["angle"] < 30


def test_sand_in_free_flight_keeps_its_momentum(device, dim):
    """A ball that hits another one off centre, far from all walls."""
    grid = mpm.Grid(0.05, (0.0,) * dim, (1.6, 1.0, 1.0)[:dim])
    balls = [
        mpm.State.at_rest(mpm.seed.sphere(at, 0.2, grid, 2**dim), DENSITY, v, torch.float64)
        for at, v in (
            ((0.5, 0.5, 0.5)[:dim], (2.0, 0.0, 0.0)[:dim]),
            ((1.0, 0.6, 0.5)[:dim], (0.0, 0.3, 0.0)[:dim]),
        )
    ]
    state = mpm.State.concatenate(balls).to(device)
    law = mpm.QuarticSand(E=1e5, nu=NU)
    step = mpm.Step(grid, law)
    momentum = (state.mass[:, None] * state.v).sum(0)
    kinetic = (state.mass * state.v.square().sum(1)).sum()
    with torch.no_grad():
        for _ in range(150):
            state = step(state, step.stable_dt(state, 0.5))
    step.check(state)
    after = (state.mass[:, None] * state.v).sum(0)
    assert torch.allclose(after, momentum, atol=1e-12 * float(momentum.norm()))
    assert (state.mass * state.v.square().sum(1)).sum() < 0.9 * kinetic


def test_columns_of_a_batch_are_what_they_are_alone(device, dim):
    aspects = (0.5, 1.0, 3.0)
    columns, laws = [], []
    for a in aspects:
        width = math.sqrt(0.16 / a)
        points = mpm.seed.box((0.0,) * dim, (width, a * width, 0.1)[:dim], 0.05, 2**dim)
        columns.append(mpm.State.at_rest(points, DENSITY, dtype=torch.float64).to(device))
        laws.append(moduli(DENSITY * GRAVITY * a * width, 0.03))
    dt = torch.tensor([2e-4, 3e-4, 1.5e-4], dtype=torch.float64, device=device)

    def run(parts: list[mpm.State], chosen: slice) -> mpm.State:
        mu, lam = (torch.tensor(v, dtype=torch.float64, device=device) for v in zip(*laws[chosen], strict=True))
        # Deterministic: a branch of the return map that falls otherwise by rounding moves F by more than rounding.
        grid = mpm.Grid(0.05, (0.0,) * dim, (1.5, 1.0, 0.1)[:dim], scenes=len(parts), deterministic=True)
        step = mpm.Step(
            grid, mpm.QuarticSand(mu=mu, lam=lam), gravity=(0.0, -GRAVITY, 0.0)[:dim], walls=mpm.Walls("separate")
        )
        with torch.no_grad():
            return mpm.rollout(step, mpm.State.concatenate(parts, scene=True), 120, dt[chosen])

    together = run(columns, slice(0, 3))
    for b, column in enumerate(columns):
        alone = run([column], slice(b, b + 1))
        mine = together.scene == b
        assert float((alone.x - column.x).norm(dim=1).max()) > 1e-3
        assert torch.allclose(together.x[mine], alone.x, rtol=0, atol=1e-11)
        assert torch.allclose(together.F[mine], alone.F, rtol=0, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("program", ["accuracy.runout", "stability.collapse"])
def test_sand_programs(program, tmp_path):
    pytest.importorskip("matplotlib")
    run_quick(f"benchmarks.{program}", tmp_path, "--device", "cpu")
    result(tmp_path, f"{program.split('.')[1]}.json")
    assert any(title.startswith("Sand") for title in report.sections(tmp_path))


def test_measures_of_a_deposit():
    depth = torch.tensor([0.05, 0.04, 0.02, 0.005, 0.0], dtype=torch.float64)
    assert front(depth) == pytest.approx(0.025 + 0.01 * (0.02 - 0.01) / (0.02 - 0.005))
    rows = [{"a": a, "run-out": 1.9 * a ** (2 / 3)} for a in (3, 5, 10)]
    assert fitted_exponent(rows) == pytest.approx(2 / 3)


# ---- in scene files

SAND = {"law": "quartic_sand", "E": 1e7}


def test_sand_of_a_scene_file():
    pytest.importorskip("pydantic")
    words = {**SAND, "friction_angle": 40, "energy": "unilateral", "apex": "keep", "smallest_strain": 0.01}
    built = mpm.Scene(**disc(material={"jelly": words})).build("cpu")
    law = built.step.law
    assert isinstance(law, mpm.QuarticSand)
    assert float(law.friction_angle) == pytest.approx(math.radians(40))
    assert (law.energy_form, law.apex, law.smallest_strain) == ("unilateral", "keep", 0.01)
    mu, lam = law.values()[:2]
    assert (mu, lam) == pytest.approx((1e7 / 2.6, 1e7 * 0.3 / (1.3 * 0.4)))
    assert float(built.state.mass.sum()) == pytest.approx(1600 * math.pi * 0.04)
    assert (law.flow, law.cohesion, law.extra_fields) == ("radial", 0.0, ())
    words = {"law": "quartic_sand", "mu": 2e6, "lam": 3e6, "flow": "exact", "cohesion": 0.01, "volume_correction": True}
    words["hardening"] = (35, 9, 0.2, 10)
    law = mpm.Scene(**disc(material={"jelly": words})).build("cpu").step.law
    assert law.values()[:2] == (2e6, 3e6)
    expected = (math.radians(35), 0.01, 0.05, math.radians(9), 0.2, math.radians(10))
    assert law.values()[2:] == pytest.approx(expected)
    assert (law.flow, law.extra_fields) == ("exact", ("volume_correction", "hardening"))


def test_sand_with_a_history_runs_beside_other_matter(tmp_path):
    """Fields of the history pass through emitters and mixtures."""
    pytest.importorskip("pydantic")
    pytest.importorskip("h5py")
    material = {"jelly": {**SAND, "E": 1e6, "volume_correction": True}, "ball": {"law": "neo_hookean", "E": 1e4}}
    body = {"shape": "sphere", "center": (0.3, 0.2), "radius": 0.1, "material": "ball"}
    emitter = {"center": (0.3, 0.6), "radius": 0.1, "velocity": (0, -2), "material": "jelly", "end": 0.05}
    summary = mpm.Scene(**disc(material=material, body=[body], emitter=[emitter])).run(tmp_path / "out")
    assert summary["particles_lost"] == 0
    assert summary["mass_drift"] == pytest.approx(0, abs=1e-6)


def test_sands_of_a_batch_share_a_law_where_they_can():
    pytest.importorskip("pydantic")
    angles = [{"material": {"jelly": {**SAND, "friction_angle": angle}}} for angle in (20, 45)]
    law = mpm.Scene(**disc(scene=angles)).build("cpu").step.law
    assert torch.allclose(law.friction_angle.double(), torch.tensor([20.0, 45.0]).double().deg2rad())
    energies = [{"material": {"jelly": {**SAND, "energy": energy}}} for energy in ("full", "hencky")]
    law = mpm.Scene(**disc(scene=energies)).build("cpu").step.law
    assert [part.energy_form for part in law.laws] == ["full", "hencky"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"mu": 1e6}, "takes E and nu, or mu and lam, got E, mu, nu"),
        ({"E": None}, "takes E and nu, or mu and lam, got none of them"),
        ({"energy": "full", "apex": "keep"}, "apex = 'keep' needs energy = 'unilateral'"),
        ({"friction_angle": 90}, "friction_angle: should be less than 90"),
    ],
)
def test_sand_that_makes_no_sense(words, message):
    pytest.importorskip("pydantic")
    with pytest.raises(ValueError, match=r"material\.jelly") as error:
        mpm.Scene(**disc(material={"jelly": {**SAND, **words}}))
    assert message in str(error.value)


def test_layers_of_a_picture(tmp_path):
    """By height for what is there at the start, by time for what comes later."""
    pytest.importorskip("pydantic")
    pytest.importorskip("h5py")
    from torch_mpm.scene.pictures import _layers

    emitter = {"center": (0.5, 0.85), "radius": 0.1, "velocity": (0, -1), "material": "jelly"}
    scene = mpm.Scene(**disc(duration=0.2, emitter=[emitter]))
    scene.run(tmp_path / "out")
    with mpm.Trajectory(tmp_path / "out") as trajectory:
        layers = _layers(trajectory, scene, 5)
        start = trajectory.frame(0)["position"]
    height = torch.from_numpy(start[:, 1]).double()
    expected = (5 * (height - height.min()) / (height.max() - height.min())).long().clamp(max=4)
    assert torch.equal(torch.from_numpy(layers[: len(start)]), expected)
    later = layers[len(start) :]
    assert (later[1:] >= later[:-1]).all()
    assert set(later.tolist()) == set(range(5))


def test_layers_of_an_emitter_are_turned_against_each_other():
    pytest.importorskip("pydantic")
    emitter = {"center": (0.5, 0.7, 0.5), "radius": 0.2, "velocity": (0, -1, 0), "material": "jelly"}
    scene = disc(grid__lower=(0, 0, 0), grid__upper=(1, 1, 1), gravity=None, body=[], emitter=[emitter])
    (nozzle,) = mpm.Scene(**{**scene, "precision": "float64"}).build("cpu").nozzles
    first, second = nozzle.turned(0), nozzle.turned(1)
    assert torch.equal(first.x, nozzle.layer.x)
    centre = torch.tensor([0.5, 0.7, 0.5], dtype=torch.float64)
    assert torch.allclose((second.x - centre).norm(dim=1), (first.x - centre).norm(dim=1))
    assert torch.allclose(second.x[:, 1], first.x[:, 1])
    assert float(torch.cdist(second.x, first.x).amin(1).mean()) > 0.005
