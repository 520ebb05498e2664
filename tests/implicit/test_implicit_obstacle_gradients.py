"""Gradients of implicit steps by where obstacles are, how they move and which way they face."""

import itertools

import pytest
import torch
from cases.implicit_gradients import TIGHT, inputs, run
from cases.implicit_obstacles import check, obstacle, parameters
from helpers import relative_error
from pairs import each_once

import torch_mpm as mpm
from torch_mpm.implicit import Implicit, equilibrium

MOTION = ("position", "velocity", "rotation", "angular_velocity")
SHAPES = {"sphere": (), "box": (), "plane": ("direction",), "capsule": ("direction",)}
KINDS = [("sticky", 0.0), ("slip", 0.0), ("separate", 0.0), ("slip", 0.2), ("separate", 0.2), ("slip", 1.0)]
"""Kinds of contact, and friction; with the largest most nodes stick."""
OF_ALL_KINDS = dict(zip(KINDS, itertools.cycle(SHAPES), strict=False))
"""The shape that a kind of contact has in 3-D, beside the one kind that all shapes have."""


def weighed(device, dim):
    """A loss of states: a random sum of their positions, velocities and deformation gradients."""
    grid, values = inputs(dim, device)
    weights = [torch.randn_like(values[name]) for name in ("x", "v", "F")]
    return grid, values, lambda s: sum((w * t).sum() for w, t in zip(weights, (s.x, s.v, s.F), strict=True))


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize(*each_once({("kind", "friction"): KINDS}, shape=SHAPES))
def test_gradients_by_motion_and_shape(shape, kind, friction, dim, device):
    if dim == 3 and (kind, friction) != ("separate", 0.2) and shape != OF_ALL_KINDS[kind, friction]:
        pytest.skip("2-D has it")
    grid, values, weigh = weighed(device, dim)
    walls, rubs = "slip" if dim == 2 else None, friction > 0

    def loss(p):
        return weigh(run(grid, values, walls=walls, boundaries=[obstacle(shape, p, kind, rubs)])[1])

    p = parameters(dim, device)
    p["friction"].fill_(friction)
    check(loss, p, *felt(shape, kind, friction, dim))


def felt(shape, kind, friction, dim):
    """The names that a step depends on, and those that it does not."""
    names = {*MOTION, *SHAPES[shape], *(["friction"] if friction else [])}
    nothing = {"rotation"} if shape == "sphere" and (dim == 2 or not friction) else set()
    if shape == "sphere" and kind != "sticky" and (dim == 2 or not friction):
        nothing |= {"angular_velocity"}
    if kind == "sticky":  # whichever way the surface faces
        nothing |= {"rotation", "direction"} & names
    if friction == 1:  # most nodes stick, for which neither counts
        return sorted(names - {"friction", "rotation", "direction"} - nothing), ()
    return sorted(names - nothing - ({"rotation"} if shape == "sphere" else set())), nothing


@pytest.mark.parametrize("kinds", [("slip", "sticky"), ("separate", "slip"), ("sticky", "separate")])
def test_gradients_of_two_obstacles_that_overlap(kinds, device):
    grid, values, weigh = weighed(device, 2)

    def loss(p):
        ball = mpm.Sphere(p["at"], 0.25, kinds[1], velocity=p["speed"])
        return weigh(run(grid, values, walls="slip", boundaries=[obstacle("box", p, kinds[0]), ball])[1])

    p = parameters(2, device)
    p["at"], p["speed"] = p["position"] - 0.12, -0.5 * p["velocity"]  # both bound the block from above
    check(loss, p, ("position", "velocity", "speed"))


@pytest.mark.parametrize("stress_form", ["mls", "gradient"])
@pytest.mark.parametrize("walls", ["mirror", "sticky"])
def test_gradients_beside_walls(walls, stress_form, device):
    grid, values, weigh = weighed(device, 2)

    def loss(p):
        boundaries = [obstacle("plane", p, "separate", True)]
        return weigh(run(grid, values, walls=walls, stress_form=stress_form, boundaries=boundaries)[1])

    check(loss, parameters(2, device), (*MOTION, "direction", "friction"))


def test_gradients_where_plastic_flow_is_inside_the_solve(device):
    grid, values, weigh = weighed(device, 2)

    def clay(mu, lam):
        return mpm.CamClay(mu=mu, lam=lam, critical_slope=1.0, consolidation=1e3, hardening=5.0)

    def loss(p):
        boundaries = [obstacle("capsule", p, "slip", True)]
        options = {**TIGHT, "plasticity": "inside"}
        return weigh(run(grid, values, clay, options=options, walls="slip", boundaries=boundaries)[1])

    check(loss, parameters(2, device), (*MOTION, "direction", "friction"))


def test_gradients_of_a_path_over_ten_steps(device):
    """A function of the time with parameters of its own, and the state beside it."""
    grid, values, weigh = weighed(device, 2)
    values["dt"] = values["dt"] / 4
    p = {"speed": torch.tensor([0.3, -1.2], dtype=torch.float64, device=device), "v": values["v"]}
    start = torch.tensor([0.55, 0.6], dtype=torch.float64, device=device)

    def loss(p):
        ball = mpm.Sphere(lambda t: start + torch.sin(20 * t)[..., None] * p["speed"] / 20, 0.2, "slip")
        return weigh(run(grid, {**values, "v": p["v"]}, n=10, walls="sticky", boundaries=[ball])[1])

    check(loss, p, ("speed", "v"))


def test_each_scene_has_the_gradient_of_its_own_obstacle(device):
    grid, values = inputs(2, device)
    pair = mpm.Grid(grid.dx, grid.lower, grid.upper, scenes=2)
    speeds = torch.tensor([[0.2, -1.0], [0.1, -0.5]], dtype=torch.float64, device=device, requires_grad=True)
    fields = {name: torch.cat([values[name]] * 2) for name in ("x", "v", "F", "C", "mass", "volume")}
    scene = torch.arange(2, device=device).repeat_interleave(len(values["x"])).int()
    law = mpm.NeoHookean(mu=values["mu"], lam=values["lam"])

    def end(grid, state, speed):
        ball = mpm.Sphere((0.5, 0.6), 0.2, "sticky", velocity=speed)
        step = mpm.Step(grid, law, walls="sticky", boundaries=[ball], integrator=Implicit(**TIGHT))
        return step(state, 0.02).x.square().sum()

    (together,) = torch.autograd.grad(end(pair, mpm.State(**fields, scene=scene), speeds), speeds)
    alone = mpm.State(**{name: values[name] for name in ("x", "v", "F", "C", "mass", "volume")})
    for b in range(2):
        own = speeds[b].detach().clone().requires_grad_()
        (grad,) = torch.autograd.grad(end(grid, alone, own), own)
        assert relative_error(together[b], grad) < 1e-9


def test_gradients_in_float32(device):
    grads = []
    for dtype in (torch.float64, torch.float32):
        torch.manual_seed(0)
        grid, values = inputs(2, device, dtype)
        p = {name: value.to(dtype).requires_grad_() for name, value in parameters(2, device).items()}
        _, end = run(
            grid, values, options={"tolerance": 1e-6}, walls="slip", boundaries=[obstacle("plane", p, "slip", True)]
        )
        grads.append(torch.autograd.grad(end.v.square().sum(), list(p.values())))
    for exact, single in zip(*grads, strict=True):
        assert relative_error(single, exact) < 1e-3


def test_gradients_of_a_state_do_not_depend_on_those_of_an_obstacle(device):
    """Held components have an adjoint only where the obstacle requires grad."""
    grid, values = inputs(2, device)
    grads = []
    for wanted in (False, True):
        p = {name: value.requires_grad_(wanted) for name, value in parameters(2, device).items()}
        v = values["v"].clone().requires_grad_()
        _, end = run(grid, {**values, "v": v}, walls="slip", boundaries=[obstacle("box", p, "separate", True)])
        grads.append(torch.autograd.grad(end.x.square().sum(), v)[0])
    assert relative_error(*grads) < 1e-10


def test_a_grip_in_equilibrium(device):
    """The work of plates on a block that they squeeze: what the energy of the block gains with their distance is the
    force, the same on both plates."""
    grid, values = inputs(2, device)
    state = mpm.State(**{name: values[name] for name in ("x", "v", "mass", "volume")})
    law = mpm.NeoHookean(mu=values["mu"], lam=values["lam"])
    speeds = torch.tensor([0.02, -0.03], dtype=torch.float64, device=device, requires_grad=True)
    zero = torch.zeros_like(speeds[0])
    plates = [
        mpm.Plane(at, (0, up), "sticky", velocity=torch.stack([zero, speed]))
        for at, up, speed in (((0, 0.1), 1.0, speeds[0]), ((0, 0.4), -1.0, speeds[1]))
    ]
    step = mpm.Step(grid, law, boundaries=plates, integrator=Implicit(**TIGHT))
    end = equilibrium(step, state, 1.0)
    energy = (values["volume"] * law.energy_density(end)).sum()
    forces = torch.autograd.grad(energy, speeds)[0]
    assert float(forces[0]) > 0 and relative_error(forces[0], -forces[1]) < 1e-6
