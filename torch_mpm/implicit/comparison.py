"""Comparison of integrators for slow motion, from measured costs of steps."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, NamedTuple

import torch

from ..errors import check_number
from ..laws.parameters import Overlay

if TYPE_CHECKING:
    from ..state.state import State
    from ..step.step import Step

MOVED = 0.05
"""Displacement per implicit step as a share of dx with an error of about 2%, as in a gripper that squeezes rubber
(benchmarks/results/implicit_quasistatic_*.md).
"""


class Cost(NamedTuple):
    """Costs of a step [s]."""

    fixed: float
    per_particle: float

    def of(self, particles: int) -> float:
        return self.fixed + self.per_particle * particles


Costs = dict[str, dict[int, Cost]]
EXPLICIT: Costs = {
    "cpu": {2: Cost(5e-6, 48e-9), 3: Cost(5e-6, 88e-9)},
    "cuda": {2: Cost(15e-6, 0.14e-9), 3: Cost(10e-6, 0.1e-9)},
}
IMPLICIT: Costs = {
    "cpu": {2: Cost(9e-3, 5e-6), 3: Cost(20e-3, 9e-6)},
    "cuda": {2: Cost(15e-3, 66e-9), 3: Cost(20e-3, 21e-9)},
}
"""Costs by kind of device and dimension, explicit steps in one op. CPU: one thread (implicit_crossover_*.md of the
results); an implicit step costs as much as a hundred explicit ones of as many particles; small ones, more. CUDA: an
H200 (rollouts_nvidia_h200.md, implicit_crossover_nvidia_h200.md, implicit_cost_nvidia_h200.md); an implicit step costs
210 explicit ones of millions of particles in 3-D, 470 in 2-D, and one or two thousand of few particles, where the host
is the limit.
"""


class Comparison(NamedTuple):
    """Explicit and implicit steps for the same motion."""

    limit: float
    """Length of explicit steps, half of the stable one [s]."""
    length: float
    """Length of implicit steps with errors of about 2%, or shorter where explicit materials limit it [s]."""
    faster: float
    """Time of the explicit steps over that of the implicit ones."""
    limited: bool = False
    """Whether explicit materials limit the length of implicit steps, to half of the stable one."""

    def __str__(self) -> str:
        why = "half the limit of the explicit materials" if self.limited else "errors of some 2%"
        given = f"{self.length:.2g} s ({why}) beside explicit ones of {self.limit:.2g} s"
        if self.faster > 1:
            return f"implicit steps of {given} would be about {self.faster:.2g} times as fast"
        return f"implicit steps of {given} would be about {1 / self.faster:.2g} times as slow"


def compare(step: Step, state: State, speed: float) -> Comparison:
    """Compare the integrators for motion with irrelevant elastic waves; where they matter, explicit steps are faster.

    Waits for the device. Costs are those of the device type of the state.

    Args:
        step: a step with either integrator; its grid, law, boundaries and explicit materials are used.
        state: particles; their number and stiffness are used.
        speed: speed of the motion [m/s], including moving boundaries.

    Raises:
        TypeError, ValueError: for a speed that is not positive and finite, or a state without particles or a stable dt.
        NotImplementedError: for a law that implicit steps do not support.
    """
    check_number("speed", speed, "positive and finite", lambda v: 0 < v < math.inf)
    if not len(state):
        raise ValueError("state must have particles to compare integrators, got none")
    state = step.prepare(state)
    law, solved = (step.law, state) if step.integrator is None else step.integrator.solved(step.law, state)
    with torch.no_grad():
        law.trial_energy(Overlay(solved, C=None), solved)
        limit, allowed = _stable_dt(step, state)
    if not 0 < limit < math.inf:
        raise ValueError(f"state must have a stable time step, positive and finite, got {limit}")
    length = MOVED * step.grid.dx / speed
    kind, dim, P = "cuda" if state.x.is_cuda else "cpu", step.grid.dim, solved.x.shape[0]
    explicit, implicit = EXPLICIT[kind][dim], IMPLICIT[kind][dim]
    cost = implicit.of(P) + explicit.per_particle * (len(state) - P)
    faster = explicit.of(len(state)) / limit * min(length, allowed) / cost
    return Comparison(limit, min(length, allowed), faster, allowed < length)


def _stable_dt(step: Step, state: State) -> tuple[float, float]:
    """Half of the stable length of explicit steps, and of implicit ones with their explicit materials [s]."""
    given = float(step.stable_dt(state, cfl=0.5).double().min())
    if step.integrator is None or not step.integrator.explicit:
        return given, math.inf
    explicit = copy.copy(step)
    explicit.integrator = None
    return float(explicit.stable_dt(state, cfl=0.5).double().min()), given
