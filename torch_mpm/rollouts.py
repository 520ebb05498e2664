"""Many steps in a row: in one op where a step is all of compiled parts, otherwise from Python."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .anomaly import begin, detecting, watch
from .boundaries import Obstacle
from .boundaries.control import control_step
from .boundaries.obstacles import motion_tensors
from .capture import is_captured, is_traced, is_transformed
from .captured_steps import in_graphs, obstacle_to_graphs
from .checkpoints import Checkpoints, as_checkpoints, binomial, fitting, in_segments, offloaded
from .errors import check_count, check_flag, shape_of
from .gradient_norms import GradientNorms
from .graphs import CHUNK, LEAST_STEPS, obstacle_to_replays, replayed
from .laws import CompiledLaw
from .laws.calls import law_calls, laws_of, passive
from .ops.arguments import split_dt
from .ops.autograd import dispatch
from .ops.contact import MAX_OBSTACLES, fusible, obstacle_arguments
from .ops.grid_update import per_scene, wall_arguments
from .ops.obstacle_tables import numbers_of_a_step, path_requires_grad
from .ops.substeps import ARGUMENTS
from .ops.transfer import STRESS_FORMS
from .orders import STEPS_IN_ORDER, in_no_order, put_back, put_in_order
from .parameters import Overlay, has_hooks
from .pause import paused
from .rollout_parts import Hook, Parts
from .signals import interruptible
from .state import State, check_state
from .step import Step
from .step_cost import state_bytes, step_bytes
from .step_times import StepTimes, clocks, requires_grad, time_after
from .topology import Status


def rollout(
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    checkpoint: int | Checkpoints | None = None,
    *,
    prefix: int = 0,
    truncate: int | None = None,
    hook: Hook | None = None,
    every: int = 1,
    norms: GradientNorms | None = None,
    graph: int | None = None,
) -> State:
    """The state n steps later.

    Args:
        step: a `Step`, or any function (state, dt) -> state.
        state: the initial state.
        n: number of steps.
        dt: time step [s], as `Step` takes it.
        checkpoint: what is kept for the backward pass, which takes the steps between again: the state of every so many
            steps (memory n/checkpoint + checkpoint states instead of n steps; sqrt(n) is best), or what `Checkpoints`
            says: so many states, a budget of memory, states that wait on the host. None: all steps.
        prefix: number of first steps that are taken without gradients.
        truncate: if given, gradients pass back through so many steps at most: the graph is cut before the steps
            n - truncate, n - 2 truncate, ... Without a hook that is a prefix of n - truncate steps.
        hook: called as `hook(state, k)` before step k = 0, every, 2 every, ...; it may look at the state, add to a
            loss, or return another state of as many particles. Where a hook acts a state is kept.
        every: steps from one call of the hook to the next.
        norms: records the norm of the gradient at states on the way; see `GradientNorms`.
        graph: steps from Python, on CUDA, are replays of CUDA graphs of so many of them, functions of the user's among
            them, and in the backward pass of these and of a graph of their gradients: for networks in a step, whose
            kernels take the host longer than the device. The state of every `graph` steps is kept, and its steps are
            taken again. See `captured` for what is recorded, and when anew; the step keeps the graphs for the next
            rollout. It must be a `Step` or another module. On the CPU, and where `Step.explain` tells of an obstacle,
            steps are taken as without.

    A `Step` of compiled laws without heat and functions of the user's takes all steps in one op, or some, with the
    results of single steps; `Step.explain` tells. On CUDA they are the same to the last bit, but for float32 without
    gradients, which like all of a CPU rounds differently, and for many particles that nobody has sorted (`state.ids` is
    None), which are sorted for 64 steps and more, and put back; the status does not count blocks that are there only
    between two activations. Its gradients take the steps again from kept states, those of every `checkpoint` steps,
    sqrt(n) of them by default and more where states are small. A kept state of a solid has 2 D + 2 D² numbers per
    particle (24 in 3-D, 96 bytes in float32) and its history; while the backward pass goes through `checkpoint` steps,
    it holds about 2 D + 4 D² (42 in 3-D) for each of them, and half as much of the grid at most. Where all steps fit
    into `Checkpoints(memory=...)` that is kept instead, and none is taken again. Second derivatives need single steps.
    On CUDA and without gradients, other steps that call no function of the user's are replays of a CUDA graph of one;
    see `captured` for what else there is, and `estimate_rollout` for what a rollout will take. Under
    `torch.autograd.detect_anomaly` a gradient that is NaN is reported with its operation, substep and scene.

    Raises:
        TypeError, ValueError: for a number of steps that is no whole number or out of range, or what `step` raises.
    """
    if not callable(step):
        raise TypeError(f"step must be a Step or a function (state, dt) -> state, got {shape_of(step)}")
    check_count("n", n)
    kept = as_checkpoints(checkpoint)
    if graph is not None:
        check_count("graph", graph, 1)
    if truncate is None and hook is None and norms is None and prefix == 0 and every == 1 and every is not True:
        check_state(state)
        with control_step(step, state, n, dt) as left:
            return left(_taken(step, state, n, dt, kept, graph=graph))
    parts = Parts(n, prefix, truncate, hook, every, norms)
    if isinstance(step, Step):
        state = step.prepare(state)
        split_dt(dt, step.grid.scenes, state.x)  # which checks it
    if kept is not None and kept.memory is not None and torch.is_grad_enabled():  # the same for all parts
        kept = resolved(kept, step, state, n - parts.first_with_gradient(), dt) or EVERYTHING
    grid = step.grid if isinstance(step, Step) else None
    scales = (1, 1.0, dt) if grid is None else (grid.scenes, grid.dx, dt)

    def advance(state: State, count: int, k: int) -> State:
        return _taken(step, state, count, dt, kept, k, graph)

    return parts.run(advance, state, scales, lambda state, count: control_step(step, state, count, dt))


def _taken(
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    kept: Checkpoints | None = None,
    first: int = 0,
    graph: int | None = None,
) -> State:
    """The state n steps later, of which the first is step `first` of a rollout, if possible by graphs of so many."""
    if isinstance(step, Step):
        check_state(state)
        state = step.with_residual(state, dt)
    if kept is not None and not torch.is_grad_enabled():
        kept = None
    keeps_all = False
    if kept is not None and kept.memory is not None:
        kept = None if kept == EVERYTHING else resolved(kept, step, state, n, dt)
        keeps_all = kept is None
    if isinstance(step, Step) and obstacle_to_substeps(step, state, dt) is None:
        return in_chunks(step, state, n, dt, kept, keeps_all)
    if isinstance(step, Step) and n > LEAST_STEPS and obstacle_to_replays(step, state, dt) is None:
        return replayed(step, state, n, dt)  # type: ignore[arg-type]
    grid = step.grid if isinstance(step, Step) else None

    by_graphs = graph is not None and obstacle_to_graphs(step, state, dt) is None and len(state) > 0

    def single(state: State, count: int, begins: int) -> State:
        if by_graphs:
            return in_graphs(step, state, count, dt, graph)  # type: ignore[arg-type]
        for k in range(first + begins, first + begins + count):
            mark = begin() if detecting() else None
            before, state = state, step(state, dt)
            if mark is not None:
                watch(before, state, mark, k, grid)
        return state

    if kept is not None and n > 0 and _begins_to_keep(step):
        state, first, n = single(state, 1, 0), first + 1, n - 1
    if kept is None or n == 0:
        return single(state, n, 0)
    if isinstance(step, Step):
        state = step.prepare(state)
    if kept.states is not None:
        return binomial(single, state, n, kept.states, step)
    return in_segments(single, state, n, kept, step)


def _begins_to_keep(step: Any) -> bool:
    """Whether a compiled step has never been called. What it makes at the first call, and keeps, is an argument of the
    code that is compiled for later ones: called again, that would keep other tensors for the backward pass."""
    if not isinstance(step, torch.nn.Module):
        return False
    modules = list(step.modules())
    compiled = any(hasattr(m, "_orig_mod") or m._compiled_call_impl is not None for m in modules)
    return compiled and any(isinstance(m, Step) and m.status is None for m in modules)


PADDING = 87 * 64
"""Between two rows of particles on the CPU at most [bytes], csrc/common/tensors.h."""
EVERYTHING = Checkpoints(memory=sys.float_info.max)
"""Of a memory into which all steps fit."""


def resolved(
    kept: Checkpoints, step: Callable[[State, float | Tensor], State], state: State, n: int, dt: float | Tensor
) -> Checkpoints | None:
    """Checkpoints of n steps that fit into the memory that some say [bytes]; None where all of them do."""
    assert kept.memory is not None
    return fitting(kept.memory, n, *bytes_kept(step, state, dt), kept.offload)


def bytes_kept(step: Callable[[State, float | Tensor], State], state: State, dt: float | Tensor) -> tuple[int, int]:
    """Of a kept state, and of each step that the backward pass has taken again [bytes]."""
    if isinstance(step, Step):
        state = step.prepare(state)
        if obstacle_to_substeps(step, state, dt) is None:
            return state_bytes(state), bytes_of_a_substep(state)
    return state_bytes(state), step_bytes(step, state, dt)


def obstacle_to_substeps(step: Step, state: State, dt: float | Tensor) -> str | None:
    """Why `substeps` cannot take the steps from a state; None where it can."""
    check_state(state)
    x, law = state.x, step.law
    laws = [passive(part) for part in laws_of(law)]
    if type(step) is not Step:
        return f"{type(step).__name__} may do more than a Step"
    for name, value in (("dt", dt), ("the time of the state", state.time)):
        if requires_grad(value) and (step._flip_share or step.boundaries.reads_time):
            return f"{name} requires a gradient, with FLIP or boundaries that may read the time"
    if isinstance(dt, Tensor) and dt.dtype != x.dtype:
        return f"dt is a tensor, but not in {str(x.dtype).removeprefix('torch.')}"
    if torch.compiler.is_compiling() or is_traced(x) or is_captured(x) or is_transformed():
        return "it is compiled, captured or transformed"
    if detecting():
        return "anomaly detection looks at every step"
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
    for part in laws:
        if not isinstance(part, CompiledLaw) or not part.is_all_of_its_update() or type(part).forward is not _FORWARD:
            return f"{type(part).__name__} is more than a compiled law"
    if any(has_hooks(module) for module in (step, *law.modules())):
        return "there are hooks"
    boundaries = step.boundaries.entries
    if not all(isinstance(b, Obstacle) and fusible(b, 0.0, paths=True) for b in boundaries):
        return "a boundary acts by torch operations"
    if len(boundaries) > MAX_OBSTACLES:
        return f"there are more than {MAX_OBSTACLES} obstacles"
    if torch.is_grad_enabled() and any(part.has_functions for part in laws):
        return "a parameter is a function, which may have a gradient"
    return None


MOST_STEPS = 2**16  # of one op, csrc/rollout/substeps.h
LEAST_PERSISTENT, MOST_PERSISTENT = 10, 2**15
"""Steps and particles of a call that one kernel takes on CUDA, csrc/rollout/persistent.h."""
FEW_BLOCKS, FEW_ITEMS = 2**12, {2: 250, 3: 140}
"""Of a domain, and of work in a step, for which about one wave of thread blocks is enough."""
WORK_OF_A_CALL, LEAST_STEPS_OF_A_CALL, LEAST_PARTICLES = 2**28, 512, 2**13
"""Particles times steps of a call on CUDA that may be one kernel, which nothing interrupts: about a quarter of a second
on an H100. A call of fewer steps would cost more, and fewer particles take no less time."""
LONG_CHUNK = 1024
"""Steps of a call whose pool has room for all blocks of the domain."""
MANY_PARTICLES, PARTICLES_PER_BLOCK = 2**18, 32
"""Of a call whose ends cost as much as a few steps (csrc/rollout/merged.h); and so many of them take as much memory as
the nodes of a block do."""
ROOMY, ROOMY_CHUNK = 3, 256
"""A pool with room for so many times the blocks of one that follows the scene, and steps of a call with it: four times
as many as with the other; and twice as many again where it has room for twice as many."""
TABLE_BYTES = 2**26
"""What obstacles on paths may take in a call, where they have a table for each of its steps."""
KEPT_BYTES = {"cpu": 2**24, "cuda": 2**29}
"""What the backward pass of one op may hold of its steps, even where sqrt(n) steps need less: what the caches of a CPU
hold, and so much that kernels on CUDA hide the time of Python."""


def in_chunks(
    step: Step, state: State, n: int, dt: float | Tensor, kept: Checkpoints | None = None, keeps_all: bool = False
) -> State:
    """The state n steps later, by calls of one op; `obstacle_to_substeps` must be None. The op takes steps again where
    it may not keep all that their gradient needs."""
    if in_no_order(state, n) and not sorts_itself(step, state, n, dt):
        return _in_order(step, step.prepare(state), n, dt, kept, keeps_all)
    chunk = most_steps_of_a_call(step, state)
    most_of_paths = _most_steps_of_paths(step, state, dt)
    with_gradient = wants_gradient(step, state, n, dt)

    def advance(state: State, count: int, first: int = 0) -> State:
        while count > 0:
            blocks, most = (None if with_gradient else pool_of_call(step, state, count)) or (None, chunk)
            now = min(count, most, most_of_paths)
            state, count = substeps(step, state, now, dt, keeps_all, blocks), count - now
        return state

    if not with_gradient or keeps_all:
        return advance(state, n)
    chunk = min(chunk, kept.every if kept is not None and kept.every else steps_of_a_call(state, n))
    if kept is not None and kept.states is not None and n > 0:
        return binomial(advance, step.prepare(state), n, kept.states, step)
    with offloaded(state) if kept is not None and kept.offload else contextlib.nullcontext():
        return advance(state, n)


def most_steps_of_a_call(step: Step, state: State) -> int:
    """Of one op whose pool follows the scene, or has `max_blocks`."""
    if not state.x.is_cuda:
        return MOST_STEPS
    if step.grid.grows:
        return CHUNK
    return min(max(WORK_OF_A_CALL // max(len(state), LEAST_PARTICLES), LEAST_STEPS_OF_A_CALL), MOST_STEPS)


def _in_order(step: Step, given: State, n: int, dt: float | Tensor, kept: Checkpoints | None, keeps_all: bool) -> State:
    """`in_chunks` of particles that are sorted now and then, and put back."""
    most = n if wants_gradient(step, given, n, dt) else STEPS_IN_ORDER
    end = given
    for first in range(0, n, most):
        start = put_in_order(step, end)
        end = in_chunks(step, start, min(most, n - first), dt, kept, keeps_all)
    return put_back(step, end, start, given)


def sorts_itself(step: Step, state: State, n: int, dt: float | Tensor) -> bool:
    """Whether the op puts particles into an order of its own on CUDA (`Substeps::merges`)."""
    one = isinstance(step.law, CompiledLaw) and state.scene is None and len(state) >= MANY_PARTICLES
    return one and _is_usual(step, state) and not wants_gradient(step, state, n, dt)


def _is_usual(step: Step, state: State) -> bool:
    """Whether steps are of the form that kernels of many phases are for."""
    form = (step.transfer, step._flip_share, step.stress_form, step.grid.kernel, has_mirrors(step))
    return form == ("apic", 0, "mls", "quadratic", False) and state.impulse is None and state.x.dtype == torch.float32


def _most_steps_of_paths(step: Step, state: State, dt: float | Tensor) -> int:
    """Steps of a call whose obstacles have a table of at most `TABLE_BYTES` for each."""
    if not follows_paths(step):
        return MOST_STEPS
    clocks_of_scenes = isinstance(dt, Tensor) or isinstance(state.time, Tensor)
    numbers = numbers_of_a_step(_obstacles(step), state.x, step.grid.scenes if clocks_of_scenes else 1)
    return max(TABLE_BYTES // (numbers * state.x.element_size()), 1)


def pool_of_call(step: Step, state: State, n: int) -> tuple[int, int] | None:
    """Blocks of the pool of a call without gradients and steps of the call at most; None where it follows the scene.

    Nobody looks whether a pool must grow that has room for all blocks of the domain: where there are few, and a kernel
    takes many steps of few particles (`Substeps::persists`), or where many particles take more memory. A pool that they
    leave room for is looked at less often, if steps do not pass over all of it. Of deterministic grids nothing depends
    on how many blocks they have had, or a second run would not be the first one bit by bit.
    """
    grid = step.grid
    if not (grid.grows and state.x.is_cuda):
        return None
    room = len(state) // PARTICLES_PER_BLOCK if len(state) >= MANY_PARTICLES else 0
    if room >= grid.block_count or takes_few_blocks(step, state, n):
        return grid.block_count, LONG_CHUNK
    passes = grid.deterministic or has_mirrors(step) or step._flip_share > 0
    times = 0 if grid.max_blocks is None or passes else room // (ROOMY * grid.max_blocks)
    return (room, ROOMY_CHUNK * min(times, 2)) if times else None


def has_mirrors(step: Step) -> bool:
    """Whether some faces of the domain are mirrors, which read nodes of other blocks."""
    return step.walls is not None and step.walls.mirrors() is not None


def takes_few_blocks(step: Step, state: State, n: int) -> bool:
    """Whether a kernel takes many steps of few particles, if the pool has room for all blocks."""
    grid = step.grid
    if grid.block_count > FEW_BLOCKS:
        return False
    if not _is_usual(step, state) or n < LEAST_PERSISTENT:
        return False
    if not isinstance(step.law, CompiledLaw) or len(state) > MOST_PERSISTENT:
        return False
    if grid.deterministic or grid.max_blocks is None:
        return grid.deterministic and len(state) <= MOST_PERSISTENT // 2
    return items_of_step(grid.dim, grid.max_blocks, len(state)) <= FEW_ITEMS[grid.dim]


def items_of_step(dim: int, blocks: int, particles: int) -> float:
    """About how many items so many particles make that a pool of `blocks` has room for (csrc/rollout/persistent.h)."""
    active = blocks / 1.5  # of a pool that has grown
    if dim == 2:  # most of these have particles, seldom more than one item
        return max(0.8 * active, particles / 150)
    most = 128 if particles <= 11000 else 256 if particles <= 20000 else 384
    return 0.5 * active + particles / (1.25 * most)


def wants_gradient(step: Step, state: State, n: int = 1, dt: float | Tensor = 1.0) -> bool:
    """Whether `substeps` is differentiated. Functions of time are asked at the first and the last of n steps."""
    if not torch.is_grad_enabled():
        return False
    if _differentiates(step, state, dt):
        return True
    if not follows_paths(step):
        return False
    times = StepTimes.of(state, n, dt, step.grid.scenes)
    return any(path_requires_grad(b, state.x, times) for b in _obstacles(step) if b.follows_path)


def _differentiates(step: Step, state: State, dt: float | Tensor) -> bool:
    """The same, whatever functions of time return."""
    return requires_grad(dt) or any(t.requires_grad for t in _differentiable(step, state))


def follows_paths(step: Step) -> bool:
    """Whether the position of an obstacle is a function of time."""
    return any(b.follows_path for b in _obstacles(step))


def _obstacles(step: Step) -> list[Obstacle]:
    return [b for b in step.boundaries.entries if isinstance(b, Obstacle)]


def steps_of_a_call(state: State, n: int) -> int:
    """Between two kept states of a rollout in one op that says nothing else."""
    return max(math.isqrt(n), KEPT_BYTES[state.x.device.type] // max(bytes_of_a_substep(state), 1), 1)


def bytes_of_a_substep(state: State) -> int:
    """What the backward pass of the op holds of each step of a solid, at most [bytes]: of particles, and half as much
    of the grid."""
    D, size = state.x.shape[1], state.x.element_size()
    rows = len(state) + (0 if state.x.is_cuda else PADDING // size)
    history = sum(t[0].numel() for t in state.extra.values()) if len(state) else 0
    return rows * (3 * (2 * D + 4 * D * D) // 2 + history) * size


_FORWARD = CompiledLaw.forward


def _differentiable(step: Step, state: State) -> list[Tensor]:
    """What `substeps` has gradients for."""
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
    return [*(t for t in fields if t is not None), *gravity, *step.law.parameters(), *step.law.buffers(), *obstacles]


def substeps(
    step: Step, state: State, n: int, dt: float | Tensor, records: bool = False, blocks: int | None = None
) -> State:
    """The state n steps later, by one op; `obstacle_to_substeps` must be None. It `records` what gradients need, if it
    has any, or takes the steps again. The pool has room for so many `blocks`, or follows the scene.

    Raises:
        ValueError: for a dt that is not positive and finite, or a material without a law.
        GridOverflowError: on the CPU, where a grid of fixed `max_blocks` is full.
    """

    def advanced(state: State, dt: float | Tensor) -> State:
        return _substeps(step, state, n, dt, records, blocks)

    return paused(advanced, step._activations, step.prepare(state), dt, step.grid.scenes, n)


def substeps_arguments(
    step: Step, state: State, n: int, dt: float | Tensor, records: bool = False, blocks: int | None = None
) -> dict[str, Any]:
    """The arguments of `torch.ops.torch_mpm.substeps` by name, for training code that calls the op itself.

    The op knows no paused scenes: each entry of a tensor dt must be positive. `Step.check` does not see its steps; its
    status is the one after them, for which `previous_status` is the one before.

    Args:
        step, state, n, dt: as `rollout`; n at most 65536.
        records: whether the op keeps what gradients need, or its backward pass takes the steps again.
        blocks: for which the pool has room; None for as many as the grid has now, which on CUDA must be enough for all
            steps.

    Raises:
        ValueError: where the op cannot take the steps, and why.
    """
    if not isinstance(step, Step):
        raise TypeError(f"step must be a Step, got {shape_of(step)}")
    check_count("n", n, 1)
    check_flag("records", records)
    if blocks is not None:
        check_count("blocks", blocks)
    if (reason := obstacle_to_substeps(step, state, dt)) is not None:
        raise ValueError(f"step must be one that `substeps` can take, got one of which {reason}")
    return _arguments(step, step.with_residual(step.prepare(state), dt), n, dt, records, blocks)[0]


def _arguments(
    step: Step, state: State, n: int, dt: float | Tensor, records: bool, blocks: int | None
) -> tuple[dict[str, Any], list[list[str]]]:
    """Those of the op, in its order, and the names of the history of each law; of a prepared state."""
    grid = step.grid
    number, scene_dt, scene_time = clocks(state, dt, grid.scenes)
    times = StepTimes.of(state, n, dt, grid.scenes) if follows_paths(step) else None
    pool = grid.pool(state.x, state.scene)
    step.law.check_parameters(len(state), grid.scenes)
    given: Any = Overlay(state, dt=dt)
    calls = law_calls(step.law, given)
    apic = step.transfer == "apic"
    table, *others = obstacle_arguments(step.boundaries.entries, state.x, grid.scenes, times)
    of_table = table is not None and table.requires_grad
    with_gradient = torch.is_grad_enabled() and (of_table or _differentiates(step, state, dt))
    arguments = (
        *(state.x, state.v, state.mass, state.volume, state.C, state.F, state.J),
        None if state.x_residual is None else state.x_residual.detach(),
        *(calls.history, state.scene, state.ids, calls.material, step._activations.status_for(state.x)),
        *(calls.names, calls.options, calls.parameters, calls.variables),
        *(int(n), number, apic, step._flip_share, apic or step.law.viscous, STRESS_FORMS[step.stress_form]),
        _gravity(step, state.x),
        *wall_arguments(step.walls, grid),
        *(table, *others),
        *(0.0 if scene_time is not None else float(state.time), grid.scenes),
        *(pool if blocks is None else max(pool, blocks), grid.grows, not with_gradient, with_gradient and records),
        *(state.impulse, scene_dt, scene_time, *grid.packed),
    )
    return dict(zip(ARGUMENTS, arguments, strict=True)), calls.history_names


def _substeps(step: Step, state: State, n: int, dt: float | Tensor, records: bool, blocks: int | None) -> State:
    """`substeps` of a prepared state, where no scene is paused."""
    grid, record = step.grid, step._activations
    record.begin(state, grid.scenes)
    arguments, history_names = _arguments(step, state, n, dt, records, blocks)
    x, v, C, F, J, history, status, impulse, time, residual, _ = interruptible(
        dispatch, torch.ops.torch_mpm.substeps, *arguments.values()
    )
    record.follow(record.status, status)
    grid.watch(status)
    if status.device.type == "cpu":  # where the op has let the pool grow, or stopped
        grid.follow(int(status[0, Status.BLOCKS_WANTED if grid.grows else Status.BLOCKS_NOW]))
    extra = _history(state, history_names, history)
    now = time_after(state.time, dt, n) if time is None else _in_shape(time.detach(), state.time, dt)
    if requires_grad(dt) or requires_grad(state.time):
        known: Any = state.time + n * (dt.double() if isinstance(dt, Tensor) else dt)
        now = now + (known - known.detach())  # which has the gradient
    residual = None if residual is None else residual.detach()
    return state.replace(x=x, v=v, C=C, F=F, J=J, extra=extra, time=now, impulse=impulse, x_residual=residual)


def _in_shape(times: Tensor, time: float | Tensor, dt: float | Tensor) -> Tensor:
    """Times of each scene as the sum of a time and dt has them: one where all have the same."""
    shape = max((tuple(t.shape) for t in (time, dt) if isinstance(t, Tensor)), key=lambda s: (len(s), s))
    return times if times.shape == shape or not len(times) else times[:1].reshape(shape)


def _gravity(step: Step, x: Tensor) -> Tensor | None:
    gravity = step.gravity_like(x)
    return None if gravity is None else per_scene(gravity, x, step.grid.scenes, step.grid.dim)


def _history(state: State, names: list[list[str]], columns: Tensor | None) -> dict[str, Tensor]:
    """The history of all laws by name; each particle has that of its law."""
    extra, first = dict(state.extra), 0
    for number, own_names in enumerate(names):
        for name in own_names:
            before = extra[name]
            width = 1 if before.dim() == 1 else before.shape[1] ** 2
            assert columns is not None
            value = columns[:, first] if before.dim() == 1 else columns[:, first : first + width].view_as(before)
            if len(names) > 1:
                assert state.material is not None
                own = (state.material == number).reshape(-1, *(1,) * (before.dim() - 1))
                value = torch.where(own, value, before)
            extra[name] = value
            first += width
    return extra
