"""Reasons why an executor does not support the steps of a rollout."""

from __future__ import annotations

import collections
from typing import Any

import torch
from torch import Tensor, nn

from ..boundaries import Obstacle
from ..boundaries.damping import split_damping
from ..cuda_graphs.capture import (
    NUMBERS,
    CapturedGraphs,
    DeviceConstantCache,
    is_captured,
    is_eager,
    is_of_library,
)
from ..errors import shape_of
from ..grid.grid import Grid
from ..laws import CompiledLaw
from ..laws.calls import laws_of, passive
from ..laws.custom import CustomLaw
from ..laws.parameters import has_hooks, modules_in
from ..laws.thermal_calls import is_thermal, laws_in, why_not_thermal
from ..ops.contact import MAX_OBSTACLES, fusible
from ..state.state import State, tensors_of
from ..step.clocks import requires_grad
from ..step.particle_operations import Operations
from ..step.status import ErrorStatus
from ..step.step import Step
from . import graph_segments
from .anomaly import detecting
from .facts import has_mirrors
from .fused_heat import why_not_fused_heat
from .graph_replay import LEAST_STEPS
from .heat_at_rest import is_heat, step_at_rest, why_not_at_rest
from .steps import Steps


def why_not_fused(step: Any, state: State, n: int, dt: float | Tensor) -> str | None:
    """Reason why the fused op does not support n steps; None if it does."""
    if is_heat(step):
        return why_not_at_rest(step) or why_not_fused(step_at_rest(step), state, n, dt)
    if type(step) is not Step:
        return f"{type(step).__name__} may do more than a Step" if isinstance(step, Step) else "it is no Step"
    x, law, boundaries = state.x, step.law, step.boundaries
    if torch.is_grad_enabled() and (step._flip_share or boundaries.reads_time):
        for name, value in (("dt", dt), ("the time of the state", state.scene_time)):
            if requires_grad(value):
                return f"{name} requires a gradient, with FLIP or boundaries that may read the time"
    if isinstance(dt, Tensor) and dt.dtype != x.dtype:
        return f"dt is a tensor, but not in {str(x.dtype).removeprefix('torch.')}"
    if (reason := _why_not_eager(x)) is not None:
        return reason
    if step.heat is not None and (reason := why_not_fused_heat(step, state, n, dt)) is not None:
        return reason
    if step.integrator is not None:
        return "it is implicit"
    if step.on_grid is not None:
        return "it calls on_grid"
    if step.on_particles is not None:
        return f"it calls on_particles, {_name_of(step.on_particles)}"
    if step._flip_share and state.impulse is not None and has_mirrors(step):
        return "FLIP keeps a share of the impulses on mirrors"
    materials = [passive(part) for part in laws_of(law)]
    laws = materials if step.heat is None else [part for material in materials for part in laws_in(material)]
    for part in laws:
        if not isinstance(part, CompiledLaw) or not part.is_all_of_its_update() or type(part).forward is not _FORWARD:
            return f"{type(part).__name__} is more than a compiled law"
    if step.heat is not None and (reason := _why_not_heated(step, x)) is not None:
        return reason
    if any([has_hooks(module) for module in (step, *modules_in(law))]):
        return "there are hooks"
    _, obstacles = split_damping(boundaries.entries)
    if len(obstacles) < len(boundaries.entries) and state.impulse is not None:
        return "the state counts impulses on boundaries, and the op counts none on damping"
    others = [b for b in obstacles if not (isinstance(b, Obstacle) and fusible(b, 0.0, paths=True))]
    if others:
        return f"a boundary acts by torch operations, {type(others[0]).__name__}"
    if len(obstacles) > MAX_OBSTACLES:
        return f"there are more than {MAX_OBSTACLES} obstacles"
    if torch.is_grad_enabled() and step.heat is None and any(part.has_functions for part in laws):
        return "a parameter is a function, which may have a gradient"
    return None


_FORWARD = CompiledLaw.forward


def _name_of(operation: Any) -> str:
    """Name of an operation on particles, or of the first of several."""
    first = operation[0] if isinstance(operation, Operations) and len(operation) else operation
    return getattr(first, "__name__", type(first).__name__)


def _why_not_heated(step: Step, x: Tensor) -> str | None:
    """Reason why the fused op does not compute the laws of a step whose heat changes the temperature."""
    assert step.heat is not None
    laws = laws_of(step.law)
    thermal = [law for law in laws if is_thermal(passive(law))]
    if any([law is not passive(law) for law in thermal]):
        return "a law with muscles reads the temperature"
    if thermal and is_captured(x):
        return "a law reads the temperature, and the host computes its tables"
    return next(filter(None, (why_not_thermal(law, x, step.heat.melts) for law in thermal)), None)


def _why_not_eager(x: Tensor) -> str | None:
    """Reason why steps must be launched from Python one by one, where other code observes them."""
    if not is_eager(x):
        return "it is compiled, captured or transformed"
    return "anomaly detection inspects every step" if detecting() else None


def why_not_captured(step: nn.Module, dt: float | Tensor, x: Tensor) -> str | None:
    """Reason why steps of a module from positions x cannot be captured in CUDA graphs; None if they can."""
    if isinstance(dt, Tensor):
        return "dt is a tensor"
    if (reason := _why_not_eager(x)) is not None:
        return reason
    if any(has_hooks(module) for module in step.modules()):
        return "there are hooks"
    parts = [module for module in step.modules() if isinstance(module, Step)]
    if any(part.integrator is not None for part in parts):
        return "an implicit step waits for its solve"
    if any(part.heat is not None and part.heat.method == "multigrid" for part in parts):
        return "multigrid computes its largest number of iterations in a graph"
    return None


def why_not_replay(steps: Steps, state: State) -> str | None:
    """Reason why `replayed` does not support the steps; None if it does. Unknown functions are called from Python: a
    function may count its calls, or read the time."""
    step = steps.step
    if type(step) is not Step:
        return "it is not a plain Step"
    if not state.x.is_cuda:
        return "there are no graphs on the CPU"
    if (reason := why_not_captured(step, steps.dt, state.x)) is not None:
        return reason
    if isinstance(state.time, Tensor):
        return "the time of the state is a tensor"
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors_of(state).values(), *_all_of(step))):
        return "it is differentiated"
    if (reason := _foreign(step, state.x.device, {})) is not None:
        return reason
    return f"there are no more than {LEAST_STEPS} steps" if steps.n <= LEAST_STEPS else None


def why_not_graphs(steps: Steps, state: State) -> str | None:
    """Reason why `graphed_steps` does not support the steps; None if it does."""
    step = steps.step
    if not isinstance(step, nn.Module):
        return "it is no module"
    if not graph_segments.has_graphs(state.x.device):
        return "there are no graphs on the CPU"
    if (reason := why_not_captured(step, steps.dt, state.x)) is not None:
        return reason
    if (place := graph_segments.another_device(step, state.x.device)) is not None:
        return f"a tensor of it is on {place}, the particles on {state.x.device}"
    return "there are no particles" if len(state) == 0 else None


_OWN = (DeviceConstantCache, CapturedGraphs, ErrorStatus, Grid)
"""Types of the library that graphs support."""


def _foreign(part: Any, device: torch.device, seen: dict[int, Any]) -> str | None:
    """Description of a user object, or of a tensor on another device, in a step or a part of it; None without one.

    `seen` has the parts that were checked before, by their ids.
    """
    if part is None or isinstance(part, NUMBERS) or type(part) in _OWN or id(part) in seen:
        return None
    if isinstance(part, Tensor):
        return None if part.device == device else f"a tensor of it is on {part.device}, the particles on {device}"
    seen[id(part)] = part
    if type(part) in (dict, collections.OrderedDict):
        members = list(part.values())
    elif type(part) in (list, tuple, set) or (_is_known(part) and isinstance(part, tuple)):
        members = list(part)
    elif _is_known(part):
        members = list(vars(part).values())
    else:
        return f"it contains a user object, {shape_of(part)}"
    return next(filter(None, (_foreign(member, device, seen) for member in members)), None)


def _is_known(part: Any) -> bool:
    known = is_of_library(type(part)) or type(part) in (nn.ModuleList, nn.ModuleDict)
    return known and not isinstance(part, CustomLaw)


def _all_of(step: Step) -> list[Tensor]:
    gravity = [step.gravity] if isinstance(step.gravity, Tensor) else []
    return [*gravity, *step.parameters(), *step.buffers()]
