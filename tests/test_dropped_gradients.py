"""Errors for arguments that require grad and cannot have one; they name the argument."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.geometry import shapes
from torch_mpm.step import particle_operations

GRID = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0))
LAW = mpm.NeoHookean(1e4, 0.3)
POINTS = mpm.seed.box((0.3, 0.3), (0.7, 0.7), GRID, per_cell=1)


def state() -> mpm.State:
    return mpm.State.at_rest(POINTS)


def touched(obstacle: mpm.Sphere, position: Any) -> Any:
    obstacle.position = position
    return mpm.rollout(mpm.Step(GRID, LAW, boundaries=[obstacle]), state(), 2, 1e-3)


def sized(box: mpm.Box, size: Any) -> Any:
    box.size = size
    return mpm.rollout(mpm.Step(GRID, LAW, boundaries=[box]), state(), 2, 1e-3)


def ended(operation: particle_operations.Hold, end: Any) -> Any:
    operation.end = end
    return mpm.rollout(mpm.Step(GRID, LAW, on_particles=operation), state(), 2, 1e-3)


def walled(walls: mpm.Walls, friction: Any) -> Any:
    walls.friction = friction
    return mpm.rollout(mpm.Step(GRID, LAW, walls=walls), state(), 2, 1e-3)


def wanted(values: Any) -> Tensor:
    return torch.tensor(values, requires_grad=True)


REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "temperature of a table": (
        lambda: mpm.Table(wanted([0.0, 1.0]), [1.0, 2.0]),
        "temperature of a table must not req",
    ),
    "samples": (
        lambda: shapes.Sampled(torch.ones(3, 3, requires_grad=True), (0, 0), 0.1),
        "values must not require grad",
    ),
    "assigned samples": (
        lambda: setattr(
            shapes.Sampled.of(shapes.Sphere(0.1), (-0.3, -0.3), (0.3, 0.3), 0.1), "values", wanted([[1.0, 1.0]] * 2)
        ),
        "values must not require grad",
    ),
    "start of a push": (lambda: particle_operations.Push((1.0, 0.0), wanted(0.5)), "start must not require grad"),
    "assigned end of a hold": (
        lambda: ended(particle_operations.Hold((1.0, 0.0)), wanted(0.5)),
        "end must not require grad",
    ),
    "assigned friction of walls": (
        lambda: walled(mpm.Walls("slip"), wanted(0.5)),
        "use a Plane for friction with a gradient",
    ),
    "sampled shape": (
        lambda: shapes.Sampled.of(shapes.Capsule(wanted([0.1, 0.0]), 0.1), (-0.3, -0.3), (0.3, 0.3), 0.1),
        "values must not require grad",
    ),
    "radius": (lambda: mpm.Sphere((0.5, 0.5), wanted(0.1)), "radius must not require grad"),
    "end": (lambda: mpm.rollout_to(mpm.Step(GRID, LAW), state(), wanted(1e-3)), "time must not require grad"),
    "clock": (
        lambda: mpm.rollout_to(mpm.Step(GRID, LAW), state().replace(time=wanted([0.0])), 1e-3),
        "the time of the state must not require grad",
    ),
    "previous": (
        lambda: mpm.rollout_to(mpm.Step(GRID, LAW), state(), 1e-3, previous=wanted(1e-4)),
        "previous must not require grad",
    ),
    "velocities in a list": (
        lambda: mpm.State.at_rest(POINTS, 1000.0, [wanted(1.0), 0.0]),
        "velocity must be numbers or one tensor, got tensors in a list",
    ),
    "assigned position in a list": (
        lambda: touched(mpm.Sphere((0.3, 0.3), 0.1), [wanted(0.3), 0.3]),
        "position must be numbers or one tensor, got tensors in a list",
    ),
    "assigned size in a list": (
        lambda: sized(mpm.Box((0.3, 0.3), (0.1, 0.1)), [wanted(0.3), 0.3]),
        "size must be numbers or one tensor, got tensors in a list",
    ),
    "position in a list": (
        lambda: mpm.Sphere([wanted(0.3), 0.3], 0.1),
        "position must be numbers or one tensor, got tensors in a list",
    ),
    "gravity in a list": (
        lambda: mpm.Step(GRID, LAW, [0.0, wanted(-9.8)]),
        "gravity must be numbers or one tensor, got tensors in a list",
    ),
    "force in a list": (lambda: particle_operations.Push([wanted(1.0), 0.0]), "force must be a number"),
    "friction of walls": (lambda: mpm.Walls("slip", friction=wanted(0.5)), "use a Plane for friction with a gradient"),
    "flip": (lambda: mpm.Step(GRID, LAW, flip=wanted(0.5)), "flip must be a number"),
    "start": (lambda: mpm.Sphere((0.5, 0.5), 0.1, start=wanted(0.5)), "start must be a number"),
    "spacing": (lambda: mpm.Grid(wanted(0.1), (0, 0), (1, 1)), "dx must be a number"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_tensors_without_a_gradient_are_refused(name):
    make, message = REFUSED[name]
    with pytest.raises((TypeError, ValueError), match=message):
        make()
