"""Impulses on obstacles and walls in implicit steps."""

import pytest
import torch
from cases.implicit_gradients import NAMES, TIGHT, inputs
from cases.implicit_obstacles import check, obstacle, parameters
from helpers import relative_error
from pairs import in_pairs

import torch_mpm as mpm
from torch_mpm.implicit import Implicit

FIELDS = ("x", "v", "F", "C", "mass", "volume")
WALLS = [None, "slip", "sticky", mpm.Walls("separate", friction=0.3)]


def stepped(grid, values, boundaries=(), walls=None, integrator=None, dt=None, **more):
    """A step with impulses counted, and the states before and after it."""
    law = mpm.NeoHookean(mu=values["mu"], lam=values["lam"])
    integrator = Implicit(**TIGHT) if integrator is None else integrator
    step = mpm.Step(grid, law, values["gravity"], walls, boundaries=list(boundaries), integrator=integrator)
    before = step.with_impulses(mpm.State(**{name: values[name] for name in FIELDS}, **more))
    return step, before, step(before, values["dt"] if dt is None else dt)


@pytest.mark.parametrize("walls", WALLS, ids=str)
@pytest.mark.parametrize(*in_pairs(kind=["sticky", "slip", "separate"], dim=[2, 3]))
def test_what_is_taken_is_missing(kind, walls, dim, device):
    """The change of the momentum of the particles is what gravity gives and boundaries take."""
    grid, values = inputs(dim, device)
    plane = obstacle("plane", parameters(dim, device), kind)
    step, before, after = stepped(grid, values, [plane], walls)
    assert bool(step.solve_report.converged)
    gained = (values["mass"][:, None] * (after.v - before.v)).sum(0)
    weight = values["mass"].sum() * values["gravity"] * values["dt"]
    taken = step.impulses(after)
    assert float(taken[plane].linear.norm()) > 0.01 * float(weight.norm())
    assert relative_error(taken.total[0], weight - gained) < 1e-9


@pytest.mark.parametrize(
    *in_pairs(floor=[None, "slip", "sticky", "rough"], kind=["sticky", "slip", "separate"], dim=[2, 3])
)
def test_short_steps_give_what_explicit_ones_do(kind, floor, dim, device):
    """On each surface, with its moment, where no two of them meet at a node."""
    grid, values = inputs(dim, device)
    rest, found = ("open",) * (dim - 2), []
    friction = (0.0, 0.3, 0.0)[:dim] if floor == "rough" else 0.0
    contact = "separate" if floor == "rough" else floor
    walls = None if floor is None else mpm.Walls(("open", (contact, "open"), *rest), friction=friction)
    for integrator in ("explicit", Implicit(**TIGHT)):
        boundaries = [
            obstacle("plane", parameters(dim, device), kind),
            mpm.Sphere((0.47, 0.22, 0.45)[:dim], 0.1, "slip", velocity=(1.0, 0.0, 0.0)[:dim]),
        ]
        step, _, after = stepped(grid, values, boundaries, walls, integrator, dt=1e-7)
        found.append(step.impulses(after).values)
    explicit, implicit = found
    assert float(explicit.abs().amax((0, 2)).gt(0).sum()) >= 2
    for surface in range(explicit.shape[1]):
        assert float((explicit - implicit)[:, surface].norm()) < 1e-4 * float(explicit.norm())


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize(("friction", "dim"), [(0.2, 2), (1.0, 2), (0.2, 3)])
def test_gradients_of_the_impulses(friction, dim, device):
    """By all that a step depends on, and by where the obstacle is and how it moves."""
    grid, values = inputs(dim, device)
    p = {**parameters(dim, device), **values}
    p["friction"].fill_(friction)
    weights = torch.randn(1, 1 + 2 * dim, 3 if dim == 2 else 6, dtype=torch.float64, device=device)

    def loss(p):
        _, _, after = stepped(grid, p, [obstacle("plane", p, "slip")], "slip")
        return (weights * after.impulse).sum()

    check(loss, p, ("position", "velocity", "angular_velocity", *(n for n in NAMES if n != "volume")))


def test_each_scene_has_its_own(device):
    grid, values = inputs(2, device)
    pair = mpm.Grid(grid.dx, grid.lower, grid.upper, scenes=2)
    speeds = torch.tensor([[0.2, -1.0], [0.1, -0.5]], dtype=torch.float64, device=device)
    both = {**values, **{name: torch.cat([values[name]] * 2) for name in FIELDS}}
    scene = torch.arange(2, device=device).repeat_interleave(len(values["x"])).int()
    ball = mpm.Sphere((0.5, 0.6), 0.2, "sticky", velocity=speeds)
    _, _, together = stepped(pair, both, [ball], "sticky", scene=scene)
    for b in range(2):
        ball = mpm.Sphere((0.5, 0.6), 0.2, "sticky", velocity=speeds[b])
        _, _, alone = stepped(grid, values, [ball], "sticky")
        assert relative_error(together.impulse[b], alone.impulse[0]) < 1e-9


def test_a_block_presses_on_the_floor_with_its_weight(device):
    """Stiff, after it has settled, in steps of many times the explicit limit; the floor is a wall or a plane."""
    grid, values = inputs(2, device)
    values |= {name: values[name] * 0 for name in ("v", "C")}
    values["F"] = torch.eye(2, dtype=torch.float64, device=device).expand_as(values["F"])
    values["mu"], values["lam"] = 100 * values["mu"], 100 * values["lam"]
    wall = mpm.Walls(("open", ("sticky", "open")))
    for walls, boundaries, floor in ((wall, (), "-y"), (None, [mpm.Plane((0, 0), (0, 1), "slip")], 0)):
        step, before, after = stepped(grid, values, boundaries, walls, dt=0.1)
        for _ in range(30):
            before, after = after, step(after, 0.1)
        force = (step.impulses(after) - step.impulses(before)) / 0.1
        weight = values["mass"].sum() * values["gravity"]
        assert relative_error(force[floor].linear[0], weight) < 1e-3
        assert step.integrator is not None and bool(step.solve_report.converged)


def test_what_is_not_counted_says_so():
    grid, values = inputs(2, "cpu")
    with pytest.raises(NotImplementedError, match="beside mirrors"):
        stepped(grid, values, walls="mirror")
    law = mpm.Mixture([mpm.NeoHookean(E=1e4, nu=0.3), mpm.WeaklyCompressible(1e4)])
    step = mpm.Step(grid, law, integrator=Implicit(explicit=[1]))
    state = mpm.State(**{name: values[name] for name in FIELDS}, material=torch.arange(len(values["x"])).int() % 2)
    with pytest.raises(NotImplementedError, match="beside explicit materials"):
        step(step.with_impulses(state), 1e-4)
