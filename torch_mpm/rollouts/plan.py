"""Plans of rollouts: executor and schedule, chosen once before the first step, as a value."""

from __future__ import annotations

import collections
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from .._library import graph_loops
from ..boundaries import Obstacle
from ..boundaries.obstacles import motion_tensors
from ..cuda_graphs.capture import (
    NUMBERS,
    CapturedGraphs,
    DeviceConstantCache,
    is_captured,
    is_of_library,
    is_traced,
    is_transformed,
)
from ..errors import check_count, shape_of
from ..grid.grid import Grid
from ..laws import CompiledLaw
from ..laws.active import Active
from ..laws.calls import laws_of, passive
from ..laws.custom import CustomLaw
from ..laws.parameters import has_hooks, modules_in, tensors_in
from ..ops.arguments import check_choice, split_dt
from ..ops.contact import MAX_OBSTACLES, fusible
from ..ops.obstacle_tables import numbers_of_a_step, path_requires_grad
from ..state.state import State, check_state, tensors_of
from ..step.clocks import StepTimes, requires_grad
from ..step.status import ErrorStatus
from ..step.step import Step
from . import graph_segments
from .anomaly import detecting
from .budget import EVERYTHING, resolved, steps_of_a_call
from .checkpoints import Checkpoints, as_checkpoints
from .graph_replay import LEAST_STEPS
from .steps import Steps

Executor = Literal["fused", "replay", "graph", "loop"]
SCHEDULES = ("per_step", "fused_g2p2g", "persistent", "block_per_scene", "sorted_cpu")
"""Schedules of the fused op, in the order of csrc/rollout/plan.h."""
_WORDS = {
    "fused": "all steps in one op",
    "replay": "from a CUDA graph of one step",
    "graph": "from CUDA graphs",
    "loop": "step by step",
}


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


class CallPlan(NamedTuple):
    """The plan of one call of the fused op."""

    schedule: str
    max_blocks: int | None
    """Least number of blocks of its pool; None for those of the grid."""
    steps: int
    """Largest number of steps of the call."""
    order: int
    """Order of unsorted particles: 0 as given; 1 sorted before the call and restored after it; 2 sorted by the schedule
    itself."""
    reasons: tuple[tuple[str, str], ...]
    """Why each other schedule was not chosen."""


@functools.lru_cache(maxsize=1024)
def plan_call(schedule: str | None, facts: Facts) -> CallPlan:
    """The plan of the next call of the fused op.

    Raises:
        RuntimeError: for a schedule that does not support the call.
    """
    number = -1 if schedule is None else SCHEDULES.index(schedule)
    chosen, blocks, steps, order, reasons = torch.ops.torch_mpm.plan_substeps(number, *facts)
    against = tuple(tuple(line.split(": ", 1)) for line in reasons.splitlines())
    return CallPlan(SCHEDULES[chosen], None if blocks < 0 else blocks, steps, order, against)


@dataclasses.dataclass(frozen=True)
class RolloutPlan:
    """Executor and schedule of a rollout, and the reasons against the others; `str` returns both in words.

    Attributes:
        executor: "fused" for calls of one op; "replay" for replays of a CUDA graph of one step; "graph" for CUDA graphs
            of some steps with their gradients (`rollout(graph=)`); "loop" for steps from Python.
        schedule: of the first call of the fused op, see docs/schedules; None for other executors.
        steps_per_call: steps of a call of the op, or of a graph, at most.
        max_blocks: least number of blocks of the pool of the first call; None for those of the grid.
        sorts: whether particles are sorted before the steps, and restored to their order after them.
        checkpoints: which states are stored for the backward pass; None for those of the fused op itself, or for all.
            `Checkpoints(memory=...)` has become the number of states that fits.
        reasons: why each other executor and schedule was not chosen, by name.
        forced: whether the schedule was given. Otherwise each call chooses in the same way.
        facts: facts of the first call; None for other executors.
    """

    executor: Executor
    schedule: str | None
    steps_per_call: int
    max_blocks: int | None
    sorts: bool
    checkpoints: Checkpoints | None
    reasons: dict[str, str]
    forced: bool = False
    facts: Facts | None = dataclasses.field(default=None, repr=False, compare=False)

    @property
    def stores_all(self) -> bool:
        """Whether all that the backward pass needs is stored, and no step is recomputed."""
        return self.checkpoints is EVERYTHING

    def call(self, n: int, max_blocks: int | None) -> CallPlan:
        """The plan of a call with n steps left, from a pool of `max_blocks`."""
        facts, blocks = self.facts, -1 if max_blocks is None else max_blocks
        assert facts is not None
        if facts.steps != n or facts.max_blocks != blocks:
            facts = facts._replace(steps=n, max_blocks=blocks)
        return plan_call(self.schedule if self.forced else None, facts)

    def of_sorted(self) -> RolloutPlan:
        """The plan for particles that were sorted."""
        assert self.facts is not None
        return dataclasses.replace(self, sorts=False, facts=self.facts._replace(sorted=True))

    def headline(self) -> str:
        """Executor and schedule in words."""
        words = _WORDS[self.executor]
        if self.executor == "fused":
            assert self.facts is not None
            words = "all steps between two stored states in one op" if self.facts.gradients else words
            return f"{words} (executor fused, schedule {self.schedule})"
        if self.executor == "graph":
            words += f" of {self.steps_per_call} steps"
        return f"{words}, because {self.reasons['fused']} (executor {self.executor})"

    def __str__(self) -> str:
        others = [f"not {name}: {reason}" for name, reason in self.reasons.items()]
        return "\n".join([self.headline(), *others])


def check_plan(plan: Any, **others: Any) -> None:
    """Check the plan of a caller, and that the arguments which it replaces are None."""
    if any(value is not None for value in others.values()):
        *first, last = others
        raise ValueError(f"{', '.join(first)} and {last} must be None with a plan, which has them")
    if not isinstance(plan, RolloutPlan):
        raise TypeError(f"plan must be a RolloutPlan or None, got {shape_of(plan)}")


def plan_rollout(
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    *,
    checkpoint: int | Checkpoints | None = None,
    graph: int | None = None,
    schedule: str | None = None,
) -> RolloutPlan:
    """Plan of `rollout` with these arguments.

    Nothing is computed or changed, and the host does not wait for the device. Exception: with a budget of memory for
    steps from Python, one step is computed and dropped to measure its memory.

    Args:
        step, state, n, dt, checkpoint, graph: as `rollout`.
        schedule: the schedule of the fused op: "per_step", "fused_g2p2g", "persistent", "block_per_scene" or
            "sorted_cpu" (docs/schedules). None: the fastest one.

    Raises:
        TypeError, ValueError: for a wrong argument, and for a schedule that does not support the steps, with the
            reason.
    """
    if not callable(step):
        raise TypeError(f"step must be a Step or a function (state, dt) -> state, got {shape_of(step)}")
    check_count("n", n)
    if graph is not None:
        check_count("graph", graph, 1)
    kept = as_checkpoints(checkpoint)
    check_state(state)
    if isinstance(step, Step):
        split_dt(dt, step.grid.scenes, state.x)
    return plan_of_steps(Steps(step, n, dt, kept, graph, schedule), state)


def plan_of_steps(steps: Steps, state: State) -> RolloutPlan:
    """`plan_rollout` for arguments that were checked."""
    if steps.schedule is not None:
        check_choice("schedule", steps.schedule, SCHEDULES)
    no_op = why_not_fused(steps.step, state, steps.dt)
    checkpoints = None if steps.checkpoints is None else _that_fit(steps, state, no_op is None)
    if no_op is None:
        return _fused(steps, state, checkpoints)
    if steps.schedule is not None:
        raise ValueError(
            f"schedule must be None for steps that the fused op does not support, got {steps.schedule!r}: {no_op}"
        )
    reasons = {"fused": no_op}
    no_replay = _why_not_replay(steps, state)
    if no_replay is None:
        reasons |= {"graph": "replays of one step suffice without user functions", "loop": "a graph is faster"}
        return RolloutPlan("replay", None, 1, None, False, checkpoints, reasons)
    reasons["replay"] = no_replay
    no_graph = _why_not_graphs(steps, state)
    if no_graph is None and steps.graph is not None:
        reasons["loop"] = "graphs are faster"
        return RolloutPlan("graph", None, max(min(steps.graph, steps.n), 1), None, False, checkpoints, reasons)
    reasons["graph"] = no_graph or "rollout(graph=...) launches some steps as a graph"
    return RolloutPlan("loop", None, 1, None, False, checkpoints, reasons)


def _that_fit(steps: Steps, state: State, fused: bool) -> Checkpoints | None:
    """Checkpoints without a budget of memory; `EVERYTHING` where all steps fit, None where nothing is stored."""
    if not torch.is_grad_enabled():
        return None
    return resolved(steps, state, fused)


_INSTEAD = {name: "the op computes all steps" for name in ("replay", "graph", "loop")}


def _fused(steps: Steps, state: State, checkpoints: Checkpoints | None) -> RolloutPlan:
    facts = facts_of(steps, state, checkpoints is EVERYTHING)
    plan = _planned(steps.schedule, facts)
    if checkpoints is None and not facts.gradients:
        return plan
    together = plan.steps_per_call
    if facts.gradients and checkpoints is not EVERYTHING:
        every = None if checkpoints is None else checkpoints.every
        together = min(together, every or steps_of_a_call(state, steps.n))
    return dataclasses.replace(plan, steps_per_call=together, checkpoints=checkpoints)


@functools.lru_cache(maxsize=1024)
def _planned(schedule: str | None, facts: Facts) -> RolloutPlan:
    """The plan for facts, without gradients."""
    try:
        call = plan_call(schedule, facts)
    except RuntimeError as error:
        raise ValueError(str(error).partition("\n")[0]) from None
    reasons = {**_INSTEAD, **dict(call.reasons)}
    sorts, forced = call.order == 1, schedule is not None
    return RolloutPlan("fused", call.schedule, call.steps, call.max_blocks, sorts, None, reasons, forced, facts)


# ---- why not


def why_not_fused(step: Any, state: State, dt: float | Tensor) -> str | None:
    """Reason why the fused op does not support the steps; None if it does."""
    if type(step) is not Step:
        return f"{type(step).__name__} may do more than a Step" if isinstance(step, Step) else "it is no Step"
    x, law, boundaries = state.x, step.law, step.boundaries
    for name, value in (("dt", dt), ("the time of the state", state.scene_time)):
        if requires_grad(value) and (step._flip_share or boundaries.reads_time):
            return f"{name} requires a gradient, with FLIP or boundaries that may read the time"
    if isinstance(dt, Tensor) and dt.dtype != x.dtype:
        return f"dt is a tensor, but not in {str(x.dtype).removeprefix('torch.')}"
    if (reason := _why_not_eager(x)) is not None:
        return reason
    if step.heat is not None:
        return "it conducts heat"
    if step.integrator is not None:
        return "it is implicit"
    if step.on_grid is not None:
        return "it calls on_grid"
    if step.on_particles is not None:
        return "it calls on_particles"
    if step._flip_share and state.impulse is not None and has_mirrors(step):
        return "FLIP keeps a share of the impulses on mirrors"
    laws = [passive(part) for part in laws_of(law)]
    for part in laws:
        if not isinstance(part, CompiledLaw) or not part.is_all_of_its_update() or type(part).forward is not _FORWARD:
            return f"{type(part).__name__} is more than a compiled law"
    if any([has_hooks(module) for module in (step, *modules_in(law))]):
        return "there are hooks"
    if not all([isinstance(b, Obstacle) and fusible(b, 0.0, paths=True) for b in boundaries.entries]):
        return "a boundary acts by torch operations"
    if len(boundaries.entries) > MAX_OBSTACLES:
        return f"there are more than {MAX_OBSTACLES} obstacles"
    if torch.is_grad_enabled() and any(part.has_functions for part in laws):
        return "a parameter is a function, which may have a gradient"
    return None


_FORWARD = CompiledLaw.forward


def _why_not_eager(x: Tensor) -> str | None:
    """Reason why steps must be launched from Python one by one, where other code observes them."""
    if is_traced(x) or is_captured(x) or is_transformed():
        return "it is compiled, captured or transformed"
    return "anomaly detection inspects every step" if detecting() else None


def _why_no_graph(step: nn.Module, state: State, dt: float | Tensor) -> str | None:
    """Reason why steps cannot be captured in CUDA graphs."""
    if isinstance(dt, Tensor):
        return "dt is a tensor"
    if (reason := _why_not_eager(state.x)) is not None:
        return reason
    if any(has_hooks(module) for module in step.modules()):
        return "there are hooks"
    steps = [module for module in step.modules() if isinstance(module, Step)]
    if any(part.integrator is not None for part in steps):
        return "an implicit step waits for its solve"
    if any(part.heat is not None and part.heat.method == "multigrid" for part in steps):
        return "multigrid computes its largest number of iterations in a graph"
    return None


def _why_not_replay(steps: Steps, state: State) -> str | None:
    """Reason why `replayed` does not support the steps; None if it does. Unknown functions are called from Python: a
    function may count its calls, or read the time."""
    step = steps.step
    if type(step) is not Step:
        return "it is not a plain Step"
    if not state.x.is_cuda:
        return "there are no graphs on the CPU"
    if (reason := _why_no_graph(step, state, steps.dt)) is not None:
        return reason
    if isinstance(state.time, Tensor):
        return "the time of the state is a tensor"
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors_of(state).values(), *_all_of(step))):
        return "it is differentiated"
    if (reason := _foreign(step, state.x.device, [])) is not None:
        return reason
    return f"there are no more than {LEAST_STEPS} steps" if steps.n <= LEAST_STEPS else None


def _why_not_graphs(steps: Steps, state: State) -> str | None:
    """Reason why `graphed_steps` does not support the steps; None if it does."""
    step = steps.step
    if not isinstance(step, nn.Module):
        return "it is no module"
    if not graph_segments.has_graphs(state.x.device):
        return "there are no graphs on the CPU"
    if (reason := _why_no_graph(step, state, steps.dt)) is not None:
        return reason
    if (place := graph_segments.another_device(step, state.x.device)) is not None:
        return f"a tensor of it is on {place}, the particles on {state.x.device}"
    return "there are no particles" if len(state) == 0 else None


_OWN = (DeviceConstantCache, CapturedGraphs, ErrorStatus, Grid)
"""Made for graphs."""


def _foreign(part: Any, device: torch.device, seen: list[Any]) -> str | None:
    """Description of a user object, or of a tensor on another device, in a step or a part of it; None without one."""
    if part is None or isinstance(part, NUMBERS) or type(part) in _OWN or any(part is known for known in seen):
        return None
    if isinstance(part, Tensor):
        return None if part.device == device else f"a tensor of it is on {part.device}, the particles on {device}"
    seen.append(part)
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


# ---- facts of the fused op


def facts_of(steps: Steps, state: State, stores_all: bool = False) -> Facts:
    """Facts of steps in the fused op."""
    step, n, dt = steps.step, steps.n, steps.dt
    assert isinstance(step, Step)
    x, grid = state.x, step.grid
    law = step.law
    laws, moved = laws_of(law), law.state_fields
    gradients = wants_gradient(steps, state)
    return Facts(
        x.is_cuda,
        x.dtype == torch.float32,
        grid.dim,
        len(state),
        grid.scenes,
        n,
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
        isinstance(dt, Tensor) or state.scene_time is not None,
        state.scene is not None,
        state.ids is not None,
        sum([2 if isinstance(part, Active) else 1 for part in laws]),
        len(laws) > 1,
        False,
        not x.is_cuda or _is_uniform(laws[0]),
        (state.F is not None or "F" in moved) != (state.J is not None or "J" in moved),
        gradients,
        gradients and stores_all and state.impulse is None and len(state) > 0,
        is_captured(x),
        x.is_cuda and graph_loops(),
        _path_bytes(step, state, dt) if step.boundaries.entries else 0,
        len(step.boundaries.entries),
    )


def _is_uniform(law: Any) -> bool:
    """Whether each parameter of a compiled law has one value for all particles."""
    part = passive(law)
    if not isinstance(part, CompiledLaw) or part.has_functions:
        return False
    return all(v.numel() == 1 for v in part.values() if isinstance(v, Tensor))


def _path_bytes(step: Step, state: State, dt: float | Tensor) -> int:
    """Size of the table of obstacles on paths, per step [bytes]; zero without such obstacles, and with shapes that have
    no entry in a table."""
    if not follows_paths(step) or any(o.shape.number is None for o in _obstacles(step)):
        return 0
    clocks_of_scenes = isinstance(dt, Tensor) or isinstance(state.time, Tensor)
    numbers = numbers_of_a_step(_obstacles(step), state.x, step.grid.scenes if clocks_of_scenes else 1)
    return numbers * state.x.element_size()


def has_mirrors(step: Step) -> bool:
    """Whether some faces of the domain are mirrors, which read nodes of other blocks."""
    return step.walls is not None and step.walls.mirrors() is not None


def wants_gradient(steps: Steps, state: State) -> bool:
    """Whether the fused op is differentiated. Functions of time are called at the first and the last of the steps."""
    if not torch.is_grad_enabled():
        return False
    step, n, dt, *_ = steps
    assert isinstance(step, Step)
    if differentiates(step, state, dt):
        return True
    if not follows_paths(step):
        return False
    times = StepTimes.of(state, n, dt, step.grid.scenes)
    return any(path_requires_grad(b, state.x, times) for b in _obstacles(step) if b.follows_path)


def differentiates(step: Step, state: State, dt: float | Tensor) -> bool:
    """The same, without the results of functions of time."""
    return requires_grad(dt) or any([t.requires_grad for t in _differentiable(step, state)])


def follows_paths(step: Step) -> bool:
    """Whether the position of an obstacle is a function of time."""
    return any([b.follows_path for b in step.boundaries.entries if isinstance(b, Obstacle)])


def _obstacles(step: Step) -> list[Obstacle]:
    return [b for b in step.boundaries.entries if isinstance(b, Obstacle)]


def _differentiable(step: Step, state: State) -> list[Tensor]:
    """Tensors that the fused op is differentiable by."""
    fields = (
        state.x,
        state.v,
        state.mass,
        state.volume,
        state.C,
        state.F,
        state.J,
        *state.extra.values(),
        state.impulse,
    )
    gravity = [step.gravity] if isinstance(step.gravity, Tensor) else []
    obstacles = [t for b in _obstacles(step) for t in motion_tensors(b)]
    return [*(t for t in fields if t is not None), *gravity, *tensors_in(step.law), *obstacles]
