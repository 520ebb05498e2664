"""How an op is recorded by autograd, with little work for the host: it has less to do than a small scene's kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

_LIBRARY = torch.library.Library("torch_mpm", "IMPL")


def dispatch(op: Any, *arguments: Any) -> Any:
    """`op(*arguments)`, past the kernel of `register_autograd` where nothing requires grad."""
    if torch.compiler.is_compiling() or (torch.is_grad_enabled() and torch._C._any_requires_grad(*arguments)):
        return op(*arguments)
    return _below_autograd(op, arguments)


def _below_autograd(op: Any, arguments: Sequence[Any]) -> Any:
    with torch._C._AutoDispatchBelowAutograd():
        return op(*arguments)


def register_autograd(
    name: str, backward: Callable[..., Any], setup: Callable[[Any, tuple[Any, ...], Any], None] | None = None
) -> None:
    """As `torch.library.register_autograd`, which reads the op's schema anew at every call: most of the time it takes.

    Args:
        name: of the op. No argument may have a default value.
        backward: (ctx, *grads) to the gradients of all arguments; a list of them for a list of tensors.
        setup: (ctx, inputs, output), or None where backward needs nothing.
    """
    op = getattr(torch.ops.torch_mpm, name).default
    lists = [i for i, argument in enumerate(op._schema.arguments) if str(argument.type) == "List[Tensor]"]

    def forward(ctx: Any, lengths: list[int], *flat: Any) -> Any:
        arguments = _nested(flat, lists, lengths)
        output = _below_autograd(op, arguments)
        ctx.lengths = lengths
        if setup is not None:
            setup(ctx, arguments, output)
        return output

    def nested_backward(ctx: Any, *grads: Any) -> Any:
        flat = ctx.needs_input_grad
        ctx.needs_input_grad = _nested(flat[1:], lists, ctx.lengths)
        try:
            result = backward(ctx, *grads)
        finally:
            ctx.needs_input_grad = flat
        return None, *_flat(result if isinstance(result, tuple) else (result,), lists)

    methods = {"forward": staticmethod(forward), "backward": staticmethod(nested_backward)}
    function: Any = type(f"torch_mpm_{name}", (torch.autograd.Function,), methods)  # its name stands in the graph

    def kernel(*arguments: Any) -> Any:
        if torch.is_grad_enabled() and torch._C._any_requires_grad(*arguments):
            return function.apply([len(arguments[i]) for i in lists], *_flat(arguments, lists))
        return _below_autograd(op, arguments)

    _LIBRARY.impl(name, kernel, "Autograd")


def _flat(arguments: tuple[Any, ...], lists: Sequence[int]) -> tuple[Any, ...]:
    """The elements of the arguments `lists` among the others, as `autograd.Function` needs them."""
    for i in reversed(lists):
        arguments = (*arguments[:i], *arguments[i], *arguments[i + 1 :])
    return arguments


def _nested(flat: tuple[Any, ...], lists: Sequence[int], lengths: Sequence[int]) -> tuple[Any, ...]:
    """The inverse of `_flat`."""
    for i, length in zip(lists, lengths, strict=True):
        flat = (*flat[:i], list(flat[i : i + length]), *flat[i + length :])
    return flat
