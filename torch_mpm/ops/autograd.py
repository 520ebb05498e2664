"""Tracking of an op by autograd with little work for the host, which would exceed that of a small scene's kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch._functorch.utils import enable_single_level_autograd_function
from torch.autograd import forward_ad
from torch.autograd.graph import saved_tensors_hooks

from ..grid.topology import PackedTopology

_transformed = torch._C._are_functorch_transforms_active
_LIBRARY = torch.library.Library("torch_mpm", "IMPL")


def dispatch(op: Any, *arguments: Any) -> Any:
    """`op(*arguments)`, without the kernel of `register_autograd` where nothing requires grad or has a tangent."""
    if _is_differentiated(*arguments):
        return op(*arguments)
    with torch._C._AutoDispatchBelowAutograd():
        return op(*arguments)


def is_tracked(*tensors: torch.Tensor) -> bool:
    """Whether a call is differentiated, transformed or compiled."""
    return _is_differentiated(*tensors) or _transformed()


def _is_differentiated(*arguments: Any) -> bool:
    """Whether autograd tracks a call or it has a tangent, or this is unknown yet."""
    return (
        torch.compiler.is_compiling()
        or forward_ad._current_level >= 0
        or (torch.is_grad_enabled() and torch._C._any_requires_grad(*arguments))
    )


def _below_autograd(op: Any, arguments: Sequence[Any]) -> Any:
    with torch._C._AutoDispatchBelowAutograd():
        return op(*arguments)


def graph_at_once() -> saved_tensors_hooks:
    """Context in which a graph is built and differentiated at once: without the hooks of checkpoints, which would
    recompute their steps for it, and those that move tensors to the host.
    """
    return saved_tensors_hooks(_same, _same)


def _same(t: torch.Tensor) -> torch.Tensor:
    return t


def register_autograd(
    name: str, backward: Callable[..., Any], setup: Callable[[Any, tuple[Any, ...], Any], None] | None = None
) -> None:
    """As `torch.library.register_autograd`, without its parsing of the op's schema at every call, which takes most of
    its time.

    The tensors of a `topology` are integers: they are passed on in their list, and `save_with_topology` stores them.

    Args:
        name: name of the op; its arguments with default values come last.
        backward: function (ctx, *grads) that returns the gradients of all arguments; a list of them for a list of
            tensors.
        setup: function (ctx, inputs, output), or None where backward needs nothing.
    """
    op = getattr(torch.ops.torch_mpm, name).default
    kinds = ("List[Tensor]", "List[Optional[Tensor]]")
    lists = [i for i, a in enumerate(op._schema.arguments) if str(a.type) in kinds and a.name != "topology"]
    defaults = tuple(a.default_value for a in op._schema.arguments)  # of trailing arguments, which torch omits

    def forward(ctx: Any, lengths: list[int], *flat: Any) -> Any:
        arguments = _nested(flat, lists, lengths)
        output = _for_outer_levels(op, arguments) if _transformed() else _below_autograd(op, arguments)
        ctx.lengths = lengths
        if setup is not None:
            setup(ctx, arguments, output)
        return tuple(output) if isinstance(output, list) else output

    def nested_backward(ctx: Any, *grads: Any) -> Any:
        flat = ctx.needs_input_grad
        ctx.needs_input_grad = _nested(flat[1:], lists, ctx.lengths)
        try:
            result = backward(ctx, *grads)
        finally:
            ctx.needs_input_grad = flat
        return None, *_flat(result if isinstance(result, tuple) else (result,), lists)

    methods = {"forward": staticmethod(forward), "backward": staticmethod(nested_backward)}
    function: Any = type(f"torch_mpm_{name}", (torch.autograd.Function,), methods)  # Name of the node in graphs.
    # `Function.apply` handles the levels of torch.func first; the dispatcher has done so where it calls `kernel`.
    apply = super(torch.autograd.Function, function).apply

    def kernel(*given: Any) -> Any:
        arguments = (*given, *defaults[len(given) :])
        if forward_ad._current_level >= 0:
            _refuse_tangents(name, _flat(arguments, lists))
        if not (torch.is_grad_enabled() and torch._C._any_requires_grad(*arguments)):
            return _below_autograd(op, arguments)
        flat = [len(arguments[i]) for i in lists], *_flat(arguments, lists)
        if _transformed():
            with enable_single_level_autograd_function():
                return apply(*flat)
        return apply(*flat)

    _LIBRARY.impl(name, kernel, "Autograd")


def save_with_topology(
    ctx: Any, tensors: Sequence[torch.Tensor | None], topology: PackedTopology, **attributes: Any
) -> None:
    """Store the tensors of an op and the topology of its last three arguments for the backward pass."""
    ctx.save_for_backward(*tensors, *topology[0])
    ctx.topology = len(tensors), *topology[1:]
    for name, value in attributes.items():
        setattr(ctx, name, value)


def saved_with_topology(ctx: Any) -> tuple[list[Any], PackedTopology]:
    """Tensors stored by `save_with_topology`."""
    saved = list(ctx.saved_tensors)  # Once: a checkpointed region unpacks a tensor only once.
    count, *lattice = ctx.topology
    return saved[:count], (saved[count:], *lattice)


def _for_outer_levels(op: Any, arguments: Sequence[Any]) -> Any:
    """Below autograd come the outer levels of torch.func, which differentiate too: `Function.forward` disables that."""
    with torch.enable_grad(), forward_ad._set_fwd_grad_enabled(True):
        return _below_autograd(op, arguments)


def _refuse_tangents(name: str, arguments: Sequence[Any]) -> None:
    for argument in arguments:
        if isinstance(argument, torch.Tensor) and forward_ad.unpack_dual(argument).tangent is not None:
            raise NotImplementedError(
                f"torch_mpm::{name} has no forward-mode derivative (torch.func.jvp, jacfwd, dual tensors): "
                "use reverse mode, torch.func.vjp or backward(); torch.autograd.functional.jvp, which takes it twice, "
                "gives the product of the Jacobian with a vector"
            )


def _flat(arguments: tuple[Any, ...], lists: Sequence[int]) -> tuple[Any, ...]:
    """Arguments with the elements of the lists `lists` among the others, as `autograd.Function` requires."""
    for i in reversed(lists):
        arguments = (*arguments[:i], *arguments[i], *arguments[i + 1 :])
    return arguments


def _nested(flat: tuple[Any, ...], lists: Sequence[int], lengths: Sequence[int]) -> tuple[Any, ...]:
    """Inverse of `_flat`."""
    for i, length in zip(lists, lengths, strict=True):
        flat = (*flat[:i], list(flat[i : i + length]), *flat[i + length :])
    return flat
