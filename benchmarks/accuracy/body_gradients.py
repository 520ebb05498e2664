"""Gradients through rigid bodies and material beside differences; a part of `benchmarks.accuracy.rigid_bodies`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.bodies import Body, Driven, FreeBodies, Hinge

F64 = torch.float64
DT, STEPS, CONTROL = 5e-4, 200, 10
"""Time step [s], steps of the material, and steps between two actions of the policy."""
SMALL = {"pose": 1e-6, "velocity": 1e-6}
"""Displacement of the differences over the largest number of an input; 1e-5 for other inputs. Poses and velocities have
the smaller one because nodes that enter or leave a body are jumps."""
RADIUS, DENSITY = 0.2, 1000.0
Values = dict[str, Tensor]


class Case(NamedTuple):
    """Inputs, and a function of them that returns numbers by name."""

    inputs: Values
    outputs: Callable[[Values], Values]


def tensors(device: str, **numbers: Any) -> Values:
    return {name: torch.tensor(value, dtype=F64, device=device, requires_grad=True) for name, value in numbers.items()}


def block(dim: int, device: str) -> tuple[mpm.Grid, mpm.State]:
    """An elastic block at rest."""
    grid = mpm.Grid(0.1, (0.0,) * dim, (2.0,) * dim)
    points = mpm.seed.box((0.6,) * dim, (1.4, 1.0, 1.4)[:dim], grid, per_cell=2**dim)
    return grid, mpm.State.at_rest(points, DENSITY, dtype=F64, device=device)


def step_of(grid: mpm.Grid, E: Tensor, boundaries: tuple[mpm.Obstacle, ...] = ()) -> mpm.Step:
    gravity = (0.0, -9.81, 0.0)[: grid.dim]
    return mpm.Step(grid, mpm.NeoHookean(E=E, nu=0.3), gravity, "slip", boundaries)


def row_of(values: Values, dim: int) -> Tensor:
    """Row [1, 1, 6 or 13] of a pose and a velocity; the quaternion is normalized."""
    pose = values["pose"]
    turn = pose[dim:] / pose[dim:].norm() if dim == 3 else pose[dim:]
    return torch.cat([pose[:dim], turn, values["velocity"]])[None, None]


def weighted(values: Tensor) -> Tensor:
    """Sum of values with different weights."""
    return (values * torch.arange(values.numel(), dtype=F64, device=values.device).cos().view_as(values)).sum()


def loss(state: mpm.State) -> Tensor:
    """Twice the kinetic energy of the material, and the mean height of its particles."""
    return (state.v.square() * state.mass[:, None]).sum() + state.x[:, 1].mean()


def free(dim: int, device: str) -> Case:
    """A spinning ball that falls on the block: its pose and velocity at the end, and the loss."""
    grid, state = block(dim, device)

    def outputs(values: Values) -> Values:
        ball = mpm.Sphere((0.0,) * dim, RADIUS, friction=values["friction"])
        bodies = FreeBodies(step_of(grid, values["E"]), [Body(ball, values["mass"], values["inertia"])])
        end, rows = bodies.advance(state, row_of(values, dim), STEPS, DT)
        bodies.check()
        return {"pose and velocity": weighted(rows), "loss": loss(end)}

    if dim == 2:
        moving = tensors(device, pose=(1.03, 1.21, 0.1), velocity=(0.3, -1.0, 3.0), mass=80.0, inertia=1.6)
    else:
        pose, velocity = (1.03, 1.21, 0.97, 0.9, 0.2, -0.3, 0.1), (0.3, -1.0, 0.2, 3.0, 1.0, -2.0)
        moving = tensors(device, pose=pose, velocity=velocity, mass=25.0, inertia=(0.3, 0.4, 0.5))
    return Case(moving | tensors(device, friction=0.3, E=2e4), outputs)


def driven(dim: int, device: str) -> Case:
    """A ball that moves through the surface of the block with a constant velocity: the mean wrench on it."""
    grid, state = block(dim, device)

    def outputs(values: Values) -> Values:
        ball = mpm.Sphere((0.0,) * dim, RADIUS, friction=values["friction"])
        bodies = mpm.RigidBodies(step_of(grid, values["E"], (ball,)), [ball])
        return {"wrench": weighted(bodies.advance(state, row_of(values, dim), STEPS, DT)[1])}

    if dim == 2:
        moving = tensors(device, pose=(1.03, 1.19, 0.1), velocity=(0.3, -1.0, 3.0))
    else:
        pose, velocity = (1.03, 1.19, 0.97, 0.9, 0.2, -0.3, 0.1), (0.3, -1.0, 0.2, 3.0, 1.0, -2.0)
        moving = tensors(device, pose=pose, velocity=velocity)
    return Case(moving | tensors(device, friction=0.3, E=2e4), outputs)


def policy(device: str) -> Case:
    """A network turns a paddle on a hinge by a torque, and moves a disc: the loss."""
    grid, state = block(2, device)
    network = torch.nn.Sequential(torch.nn.Linear(16, 8), torch.nn.Tanh(), torch.nn.Linear(8, 3))
    network.to(device, F64)
    generator = torch.Generator().manual_seed(0)
    normal = {n: torch.randn(w.shape, generator=generator, dtype=F64) for n, w in network.named_parameters()}
    weights = {name: (0.3 * value).to(device).requires_grad_() for name, value in normal.items()}
    scale, E = torch.tensor([200.0, 1.0, 1.0], dtype=F64, device=device), torch.tensor(2e4, dtype=F64, device=device)
    start = [[[0.7, 1.21, 0.2, *3 * [0.0]], [1.3, 1.17, 0.0, *3 * [0.0]]]]

    def outputs(values: Values) -> Values:
        paddle = Body(mpm.Box((0.0, 0.0), (0.5, 0.4), friction=0.3), 150.0, 6.0, joint=Hinge((0.7, 1.35)))
        disc = Body(mpm.Sphere((0.0, 0.0), RADIUS, friction=0.3), 80.0, 1.6, joint=Driven())
        bodies, now = FreeBodies(step_of(grid, E), [paddle, disc]), state
        rows = torch.tensor(start, dtype=F64, device=device)
        for _ in range(STEPS // CONTROL):
            seen = torch.cat([rows.flatten(), now.x.mean(0), now.v.mean(0)])
            action = scale * torch.func.functional_call(network, values, (seen,)).tanh()
            zero = torch.zeros_like(action)
            wrenches = torch.stack([torch.cat([zero[:2], action[:1]]), zero])[None]
            disc_row = torch.cat([rows[0, 1, :3], action[1:], zero[:1]])
            now, rows = bodies.advance(now, torch.stack([rows[0, 0], disc_row])[None], CONTROL, DT, wrenches)
            bodies.check()
        return {"loss": loss(now)}

    return Case(weights, outputs)


CASES: dict[str, Callable[[str], Case]] = {
    "free ball, 2-D": lambda device: free(2, device),
    "free ball, 3-D": lambda device: free(3, device),
    "driven ball, 2-D": lambda device: driven(2, device),
    "driven ball, 3-D": lambda device: driven(3, device),
    "policy, 2-D": policy,
}


def compared(name: str, device: str = "cpu") -> Iterator[dict[str, Any]]:
    """Derivatives of each output in a direction of each input, and their deviations relative to central differences."""
    case, generator = CASES[name](device), torch.Generator().manual_seed(1)
    found = case.outputs(case.inputs)
    for output, value in found.items():
        gradients = torch.autograd.grad(value, list(case.inputs.values()), retain_graph=True)
        for (by, at), gradient in zip(case.inputs.items(), gradients, strict=True):
            way = torch.randn(at.shape, generator=generator, dtype=F64).to(device)
            h = SMALL.get(by, 1e-5) * max(1.0, float(at.detach().abs().max()))
            with torch.no_grad():
                ends = [case.outputs({**case.inputs, by: at + sign * h * way})[output] for sign in (1, -1)]
            difference, derivative = float(ends[0] - ends[1]) / (2 * h), float((gradient * way).sum())
            yield {
                "case": name,
                "of": output,
                "by": by,
                "derivative": derivative,
                "deviation": abs(derivative - difference) / abs(difference),
            }
