"""Rollouts in one op and step by step, whose gradients are compared."""

from collections.abc import Callable

import torch
from helpers import TOLERANCE
from torch import Tensor

import torch_mpm as mpm
from cases.rollouts import one_by_one, tensors

F64 = torch.float64
DT, STEPS = 1e-4, 5
Rollout = Callable[[mpm.Step, mpm.State], mpm.State]


def in_op(every: int | mpm.Checkpoints | None = None, n: int = STEPS, dt: float = DT) -> Rollout:
    def run(step: mpm.Step, state: mpm.State) -> mpm.State:
        assert step.explain(state, dt).startswith("all steps between two stored states in one op")
        return mpm.rollout(step, state, n, dt, checkpoint=every)

    return run


def single(n: int = STEPS, dt: float = DT) -> Rollout:
    return lambda step, state: one_by_one(step, state, n, dt)


def loss(end: mpm.State) -> Tensor:
    """A random sum of all that is floating."""
    generator = torch.Generator().manual_seed(1)
    total = end.x.new_zeros(())
    for value in tensors(end).values():
        if value.is_floating_point() and value.requires_grad:
            weights = torch.randn(value.shape, generator=generator, dtype=F64).to(value)
            total = total + (weights * value).nan_to_num(0.0).sum()
    return total


def gradients(run: Rollout, step: mpm.Step, state: mpm.State) -> dict[str, Tensor | None]:
    """By every floating field of a state and every tensor of a step that requires grad."""
    leaves = {k: t.detach().clone().requires_grad_() for k, t in tensors(state).items() if t.is_floating_point()}
    extra = {name: leaves.get(name, value) for name, value in state.extra.items()}
    fields = {name: leaf for name, leaf in leaves.items() if name not in extra}
    constants = {name: t for name, t in [*step.named_parameters(), *step.named_buffers()] if t.requires_grad}
    end = run(step, state.replace(**fields, extra=extra))
    wanted = leaves | constants
    return dict(zip(wanted, torch.autograd.grad(loss(end), list(wanted.values()), allow_unused=True), strict=True))


def assert_same(
    got: dict[str, Tensor | None], expected: dict[str, Tensor | None], tolerance: str = "", text: str = ""
) -> None:
    for name, reference in expected.items():
        value = got[name]
        if reference is None or float(reference.norm()) == 0:
            assert value is None or float(value.norm()) == 0, name
            continue
        assert value is not None and bool(value.isfinite().all()), name
        kind = tolerance or ("rollout gradient on CUDA" if value.is_cuda else "rollout gradient")
        error = float((value - reference).norm() / reference.norm())
        assert error < TOLERANCE[kind][value.dtype], f"{name}: {error} {text}"


def with_gradients(law: mpm.Material, dtype: torch.dtype = F64) -> mpm.Material:
    """All numbers of a law, and of the laws of a mixture, as tensors that require grad."""
    for part in law.modules():
        for name, value in list(vars(part).items()):
            if isinstance(value, float):
                delattr(part, name)
                part.register_buffer(name, torch.tensor(value, dtype=dtype, requires_grad=True))
    return law


def moving(step: mpm.Step, state: mpm.State) -> mpm.State:
    """A state with C and a strain of a few per cent."""
    state = step.prepare(state)
    P, D = state.x.shape
    noise = torch.randn(P, D, D, generator=torch.Generator().manual_seed(5), dtype=F64).to(state.x)
    strained = {} if state.F is None else {"F": state.F + 0.02 * noise}
    return state.replace(C=noise, **strained)
