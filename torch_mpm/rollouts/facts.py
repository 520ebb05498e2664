"""Facts of the steps of a rollout that determine the schedule of the fused op."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._library import graph_loops
from ..boundaries import Obstacle
from ..boundaries.obstacles import motion_tensors
from ..cuda_graphs.capture import is_captured
from ..heat.boundaries import Term
from ..heat.heat import Heat
from ..laws import CompiledLaw
from ..laws.active import Active
from ..laws.calls import laws_of, passive
from ..laws.parameters import PerMaterial, tensors_in
from ..laws.thermal_calls import laws_in
from ..ops.obstacle_tables import numbers_of_a_step, path_requires_grad
from ..state.state import ROLES, State
from ..step.clocks import StepTimes, requires_grad
from ..step.step import Step
from .steps import Steps


class Facts(NamedTuple):
    """Facts that determine the schedule: the arguments of `torch.ops.torch_mpm.plan_substeps` after the first,
    explained in csrc/rollout/plan.h."""

    cuda: bool
    float32: bool
    dim: int
    particles: int
    scenes: int
    steps: int
    blocks_per_scene: int
    max_blocks: int
    grows: bool
    deterministic: bool
    quadratic: bool
    apic: bool
    flips: bool
    mls: bool
    mirrors: bool
    impulses: bool
    clocks: bool
    scene_ids: bool
    sorted: bool
    laws: int
    materials: bool
    additive: bool
    uniform_parameters: bool
    one_deformation: bool
    gradients: bool
    records: bool
    captured: bool
    graph_loops: bool
    path_bytes: int
    obstacles: int
    heat: bool
    rests: bool
    bodies: bool


def facts_of(steps: Steps, state: State, stores_all: bool = False) -> Facts:
    """Facts of steps in the fused op."""
    step, x = steps.step, state.x
    assert isinstance(step, Step)
    gradients = wants_gradient(steps, state)
    records = gradients and stores_all and state.impulse is None and len(state) > 0
    of_paths = path_bytes(step, steps, state)
    if not x.is_cuda:
        return _facts_on_cpu(len(state), steps.n, state.ids is not None, gradients, records, of_paths, step._rests)
    grid, law = step.grid, step.law
    laws, moved = laws_of(law), law.state_fields
    return Facts(
        True,
        x.dtype == torch.float32,
        grid.dim,
        len(state),
        grid.scenes,
        steps.n,
        grid.block_count // max(grid.scenes, 1),
        -1 if grid.max_blocks is None else grid.max_blocks,
        grid.grows,
        grid.deterministic,
        grid.kernel == "quadratic",
        step.transfer == "apic",
        step._flip_share > 0,
        step.stress_form == "mls",
        has_mirrors(step),
        state.impulse is not None,
        isinstance(steps.dt, Tensor) or state.scene_time is not None,
        state.scene is not None,
        state.ids is not None,
        sum([2 if isinstance(part, Active) else len(laws_in(part)) for part in laws]),
        len(laws) > 1,
        False,
        _is_uniform(laws[0]),
        (state.F is not None or "F" in moved) != (state.J is not None or "J" in moved),
        gradients,
        records,
        is_captured(x),
        graph_loops(),
        of_paths,
        len(_obstacles(step)),
        step.heat is not None,
        step._rests,
        steps.bodies is not None,
    )


@functools.lru_cache(maxsize=1024)
def _facts_on_cpu(
    particles: int, steps: int, is_sorted: bool, gradients: bool, records: bool, path_bytes: int, rests: bool
) -> Facts:
    """Facts of steps on the CPU, whose schedules and order of particles depend on no others."""
    none = Facts(*[False] * len(Facts._fields))
    none = none._replace(particles=particles, steps=steps, sorted=is_sorted)
    return none._replace(gradients=gradients, records=records, path_bytes=path_bytes, rests=rests)


def _is_uniform(law: Any) -> bool:
    """Whether each parameter of a compiled law has one value for all particles."""
    part = passive(law)
    if not isinstance(part, CompiledLaw) or part.has_functions:
        return False
    return all(v.numel() == 1 for v in part.values() if isinstance(v, Tensor))


def path_bytes(step: Step, steps: Steps, state: State) -> int:
    """Size of the table of obstacles on paths, per step [bytes]; zero without such obstacles, and with shapes that have
    no entry in a table."""
    if not follows_paths(step) or any(o.shape.number is None for o in _obstacles(step)):
        return 0
    clocks_of_scenes = isinstance(steps.dt, Tensor) or isinstance(state.time, Tensor)
    numbers = numbers_of_a_step(_obstacles(step), state.x, step.grid.scenes if clocks_of_scenes else 1)
    return numbers * state.x.element_size()


def has_mirrors(step: Step) -> bool:
    """Whether some faces of the domain are mirrors, which read nodes of other blocks."""
    return step.walls is not None and step.walls.mirrors() is not None


def wants_gradient(steps: Steps, state: State) -> bool:
    """Whether the fused op is differentiated. Functions of time are called at the first and the last of the steps."""
    if not torch.is_grad_enabled():
        return False
    step, _, dt, *_ = steps
    assert isinstance(step, Step)
    return differentiates(step, state, dt) or _paths_require_grad(steps, state)


def _paths_require_grad(steps: Steps, state: State) -> bool:
    step, n, dt, *_ = steps
    assert isinstance(step, Step)
    if not follows_paths(step):
        return False
    times = StepTimes.of(state, n, dt, step.grid.scenes)
    return any(path_requires_grad(b, state.x, times) for b in _obstacles(step) if b.follows_path)


def differentiates(step: Step, state: State, dt: float | Tensor) -> bool:
    """`wants_gradient` without the gradients of functions of time."""
    return requires_grad(dt) or any([t.requires_grad for t in _differentiable(step, state)])


def follows_paths(step: Step) -> bool:
    """Whether the position of an obstacle is a function of time."""
    return any([b.follows_path for b in step.boundaries.entries if isinstance(b, Obstacle)])


def _obstacles(step: Step) -> list[Obstacle]:
    return [b for b in step.boundaries.entries if isinstance(b, Obstacle)]


_READ = tuple(name for name, role in ROLES.items() if role.differentiable and name not in ("extra", "temperature"))
"""Differentiable fields that the fused op reads, beside history and those of heat."""


def _differentiable(step: Step, state: State) -> list[Tensor]:
    """Tensors that the fused op is differentiable by."""
    fields = (*(getattr(state, name) for name in _READ), *state.extra.values())
    gravity = [step.gravity] if isinstance(step.gravity, Tensor) else []
    obstacles = [t for b in _obstacles(step) for t in motion_tensors(b)]
    heat = [] if step.heat is None else [state.temperature, *_parameters_of_heat(step.heat)]
    return [*(t for t in (*fields, *heat) if t is not None), *gravity, *tensors_in(step.law), *obstacles]


def _parameters_of_heat(heat: Heat) -> list[Tensor]:
    """Tensors among the parameters of heat and the numbers of its boundaries."""
    parts = [part for v in heat.parameter_values for part in (v.values() if isinstance(v, PerMaterial) else (v,))]
    terms = [t for term in heat.boundaries.entries if isinstance(term, Term) for t in tensors_in(term)]
    return [*(part for part in parts if isinstance(part, Tensor)), *terms]
