"""Estimated memory and time of a rollout and its backward pass."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from ..data.host_memory import in_words
from ..errors import check_count, shape_of
from ..state.state import State
from ..step.status import aside
from ..step.step import Step
from .budget import EVERYTHING, needs_of
from .checkpoints import Checkpoints, as_checkpoints
from .hooks import Parts
from .memory import differentiable, seconds
from .plan import RolloutPlan, in_steps, plan_of_steps
from .run import rollout
from .steps import Steps

TRIAL = 8
"""Largest number of steps of the measurement."""


@dataclasses.dataclass(frozen=True)
class RolloutEstimate:
    """Estimate of a rollout with gradients and its backward pass.

    Attributes:
        memory: upper bound of the memory of stored states and of the steps that the backward pass holds at a time with
            the adjoints of one, on the device [bytes]. Memory that allocators keep after their tensors is not included.
        host_memory: memory of stored states that are offloaded to the host [bytes].
        seconds: run time [s], extrapolated from a few steps.
        kept_states: maximum number of states stored at a time.
        steps: number of computed steps, including recomputed ones.
        particles: number of particles of the state.
    """

    memory: int
    host_memory: int
    seconds: float
    kept_states: int
    steps: int
    particles: int

    @property
    def per_particle(self) -> float:
        """Memory per particle; zero without particles [bytes]."""
        return self.memory / self.particles if self.particles else 0.0

    def __str__(self) -> str:
        host = f" and {in_words(self.host_memory)} on the host" if self.host_memory else ""
        return (
            f"{in_words(self.memory)} ({in_words(self.per_particle)} a particle){host}, {self.seconds:.3g} s: "
            f"{self.kept_states} stored states, {self.steps} steps including recomputed ones"
        )


def estimate_rollout(
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    checkpoint: int | Checkpoints | None = None,
    *,
    prefix: int = 0,
    truncate: int | None = None,
) -> RolloutEstimate:
    """Memory and time of `rollout` with these arguments and of the backward pass of a loss of its end.

    It computes a few steps three times, and three times more with their backward pass, invisibly for `Step.check`. The
    memory is that of the given state: pools that grow during the rollout are not foreseen. User functions are called.

    Args:
        step, state, n, dt, checkpoint, prefix, truncate: as `rollout`.

    Raises:
        TypeError, ValueError: as `rollout`.
    """
    if not callable(step):
        raise TypeError(f"step must be a Step or a function (state, dt) -> state, got {shape_of(step)}")
    check_count("n", n)
    parts, checkpoints = Parts(n, prefix, truncate), as_checkpoints(checkpoint)
    first = parts.first_with_gradient()
    (step, *_), state = in_steps(Steps(step, n, dt), state)
    start = differentiable(step.prepare(state) if isinstance(step, Step) else state)
    with aside(step, start.x), torch.enable_grad():
        plan = plan_of_steps(Steps(step, n - first, dt, checkpoints), start)
        return _estimate(step, start, n - first, first, dt, plan)


def _estimate(
    step: Callable[[State, float | Tensor], State],
    start: State,
    n: int,
    prefix: int,
    dt: float | Tensor,
    plan: RolloutPlan,
) -> RolloutEstimate:
    """Estimate of n steps with gradients, as planned, after `prefix` steps without."""
    in_op, stores_all = plan.executor == "fused", plan.stores_all
    checkpoints = None if stores_all else plan.checkpoints
    needs = needs_of(step, start, dt, in_op)
    forward, both = _seconds_per_step(step, start, n, dt, plan)
    if n == 0:
        return RolloutEstimate(0, 0, prefix * forward, 0, prefix, len(start))
    if checkpoints is None and (stores_all or not in_op):
        run_time = prefix * forward + n * both
        return RolloutEstimate(needs.bytes_of(1, n), 0, run_time, 1, prefix + n, len(start))
    if checkpoints is None or checkpoints.every is None:
        checkpoints = dataclasses.replace(checkpoints or Checkpoints(every=1), every=plan.steps_per_call)
    states, recomputed = checkpoints.kept(n, in_op), checkpoints.repetitions(n, in_op)
    extra = recomputed - n if in_op else recomputed  # Recomputed steps whose time is not part of `both`.
    run_time = prefix * forward + n * both + extra * forward
    every, on_host = min(checkpoints.every or 1, n), checkpoints.offload and start.x.is_cuda
    memory = needs.bytes_of(0 if on_host else states - in_op, every)  # A call of the op includes its own state.
    of_states = states * needs.state if on_host else 0
    return RolloutEstimate(memory, of_states, run_time, states, prefix + n + recomputed, len(start))


def _seconds_per_step(
    step: Callable[[State, float | Tensor], State], start: State, n: int, dt: float | Tensor, plan: RolloutPlan
) -> tuple[float, float]:
    """Run time per step, without gradients and with the backward pass, of a few of n planned steps [s]."""
    trial = max(min(n, TRIAL), 1)
    checkpoints = EVERYTHING
    if plan.executor == "fused" and not plan.stores_all:
        trial = max(min(n, TRIAL, plan.steps_per_call), 1)
        checkpoints = Checkpoints(every=trial)

    def few_steps() -> State:
        return rollout(step, start, trial, dt, checkpoints)

    @torch.no_grad()
    def forward() -> None:
        few_steps()

    tensors = [*step.parameters(), *step.buffers()] if isinstance(step, torch.nn.Module) else []
    leaves = [start.x, start.v, *(t for t in tensors if t.requires_grad)]

    def both() -> None:
        end = few_steps()
        torch.autograd.grad(end.x.sum() + end.v.sum(), leaves, allow_unused=True)

    device = start.x.device
    return seconds(forward, device) / trial, seconds(both, device) / trial
