"""Functions of each particle or node alone (csrc/pointwise), fused: Python wrapper, fake kernels and autograd."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .. import _library
from ..cuda_graphs.capture import is_traced
from ..errors import FLOATING
from .arguments import refuse_vmap, soa_empty
from .autograd import dispatch, is_tracked, register_autograd

Places = list[int]


@dataclasses.dataclass(frozen=True)
class Function:
    """Description of a function of csrc/pointwise.

    Attributes:
        name: argument of `pointwise`.
        arguments, results: shape of each in a row, (rows, columns): zero for a missing dimension, -1 for D.
    """

    name: str
    arguments: tuple[tuple[int, int], ...]
    results: tuple[tuple[int, int], ...]


def _read() -> dict[str, Function]:
    found = {}
    for entry in _library.listed("torch_mpm_functions"):
        lists = {key: tuple((rows, columns) for rows, columns in entry[key]) for key in ("arguments", "results")}
        found[entry["name"]] = Function(entry["name"], **lists)
    return found


FUNCTIONS: dict[str, Function] = _read()
"""All functions by name."""


def fuses(*tensors: Tensor) -> bool:
    """Whether `pointwise` may replace torch operations, which have all derivatives and transforms: where nothing is
    differentiated, transformed or compiled, and all tensors are float32, or all float64.
    """
    return not (
        is_tracked(*tensors) or tensors[0].dtype not in FLOATING or any(t.dtype != tensors[0].dtype for t in tensors)
    )


def pointwise(function: str, dim: int, *arguments: Tensor | float, wanted: Sequence[int] | None = None) -> list[Tensor]:
    """Results of a function of csrc/pointwise, one kernel for all rows.

    Args:
        function: a name in `FUNCTIONS`, which lists its arguments; they are documented with the function.
        dim: D.
        arguments: a tensor with a row for each particle or node, or without that dimension (for a scalar also [1]) one
            for all, or a number. A number represents a vector of equal entries, or a multiple of the identity matrix.
            All tensors float32, or all float64, and one of them with rows; one [] may be on the CPU where the others
            are not, as for torch's own operations.
        wanted: indices of the results to return; None for all.

    Differentiable with respect to every tensor, twice.

    Raises:
        KeyError: for an unknown function.
        RuntimeError: for a wrong shape, dtype or device.
    """
    tensors: list[Tensor] = []
    places: Places = []
    numbers: list[float] = []
    for k, argument in enumerate(arguments):
        if isinstance(argument, Tensor) and argument.dim() == 0:
            argument = _beside(argument, _device_of_rows(arguments))
        if isinstance(argument, Tensor):
            tensors.append(argument)
            places.append(k)
            numbers.append(0.0)
        else:
            numbers.append(float(argument))
    results = list(range(len(FUNCTIONS[function].results))) if wanted is None else list(wanted)
    return list(dispatch(torch.ops.torch_mpm.pointwise, function, dim, tensors, places, numbers, results))


def _device_of_rows(arguments: Sequence[Any]) -> torch.device | None:
    return next((a.device for a in arguments if isinstance(a, Tensor) and a.dim() > 0), None)


def _beside(scalar: Tensor, device: torch.device | None) -> Tensor | float:
    """A tensor [] for a call on a device: one on the CPU becomes a number, so that graphs may capture the call."""
    if device is None or scalar.device == device:
        return scalar
    return scalar.to(device) if scalar.requires_grad or is_traced(scalar) or scalar.is_cuda else float(scalar)


# ---- fake kernels


def _rows(info: Function, tensors: Sequence[Tensor], places: Places) -> tuple[Any, Tensor]:
    """Number of rows of a call, and a tensor that has them."""
    ranks = [sum(size != 0 for size in info.arguments[k]) for k in places]
    given = [t for t, rank in zip(tensors, ranks, strict=True) if t.dim() == rank + 1]
    torch._check(bool(given), lambda: "one of tensors must have a row for each particle")
    most = given[0]
    for t in given[1:]:
        most = t if most.shape[0] == 1 or t.shape[0] == 0 else most
    return most.shape[0], most


def row_shape(entries: tuple[int, int], rows: Any, dim: int) -> list[Any]:
    """Shape of an argument or result with a number of rows."""
    return [rows, *(dim if size == -1 else size for size in entries if size != 0)]


def _empty(kinds: Sequence[tuple[int, int]], places: Places, of: tuple[Any, Tensor], dim: int) -> list[Tensor]:
    rows, like = of
    return [soa_empty(like, row_shape(kinds[k], rows, dim)) for k in places]


@torch.library.register_fake("torch_mpm::pointwise")
def _pointwise_fake(
    function: str, dim: int, tensors: list[Tensor], places: Places, numbers: list[float], wanted: Places
) -> list[Tensor]:
    info = FUNCTIONS[function]
    return _empty(info.results, wanted, _rows(info, tensors, places), dim)


@torch.library.register_fake("torch_mpm::pointwise_backward")
def _pointwise_backward_fake(
    function: str, dim: int, tensors: list[Tensor], places: Places, *others: Any
) -> list[Tensor]:
    info, wanted = FUNCTIONS[function], others[-1]
    return _empty(info.arguments, [places[i] for i in wanted], _rows(info, tensors, places), dim)


@torch.library.register_fake("torch_mpm::pointwise_second")
def _pointwise_second_fake(
    function: str, dim: int, tensors: list[Tensor], places: Places, *others: Any
) -> list[Tensor]:
    info, (_, _, adjoint_places, *_) = FUNCTIONS[function], others
    by_arguments = _pointwise_backward_fake(function, dim, tensors, places, *others)
    return by_arguments + _empty(info.results, adjoint_places, _rows(info, tensors, places), dim)


# ---- autograd


def _keep(ctx: Any, inputs: Any, output: Any) -> None:
    function, dim, tensors, places, numbers, wanted = inputs
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*tensors)
    ctx.call = function, dim, places, numbers, wanted


def _backward(ctx: Any, *grads: Tensor | None) -> Any:
    function, dim, places, numbers, results = ctx.call
    tensors = list(ctx.saved_tensors)
    given = [(g, k) for g, k in zip(grads, results, strict=True) if g is not None]
    wanted = [i for i, needed in enumerate(ctx.needs_input_grad[2]) if needed]
    if not given or not wanted:
        return None, None, [None] * len(tensors), None, None, None
    adjoints, adjoint_places = [g for g, _ in given], [k for _, k in given]
    arguments = function, dim, tensors, places, numbers, adjoints, adjoint_places, wanted
    found = dispatch(torch.ops.torch_mpm.pointwise_backward, *arguments)
    return None, None, _placed(found, wanted, tensors), None, None, None


def _placed(found: Sequence[Tensor], wanted: Places, tensors: Sequence[Tensor]) -> list[Tensor | None]:
    """Gradients of the tensors from those by row: summed for tensors that all rows share."""
    result: list[Tensor | None] = [None] * len(tensors)
    for gradient, i in zip(found, wanted, strict=True):
        same = gradient.shape == tensors[i].shape
        result[i] = gradient if same else gradient.sum(0).reshape(tensors[i].shape)
    return result


def _keep_backward(ctx: Any, inputs: Any, output: Any) -> None:
    function, dim, tensors, places, numbers, adjoints, adjoint_places, wanted = inputs
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*tensors, *adjoints)
    ctx.call = function, dim, places, numbers, adjoint_places, wanted


def _double_backward(ctx: Any, *along: Tensor | None) -> Any:
    function, dim, places, numbers, adjoint_places, differentiated = ctx.call
    saved = list(ctx.saved_tensors)
    tensors, adjoints = saved[: len(places)], saved[len(places) :]
    given = [(v, places[i]) for v, i in zip(along, differentiated, strict=True) if v is not None]
    if not given:
        return None, None, [None] * len(tensors), None, None, [None] * len(adjoints), None, None
    wanted = [i for i, needed in enumerate(ctx.needs_input_grad[2]) if needed]
    found = torch.ops.torch_mpm.pointwise_second(
        *(function, dim, tensors, places, numbers, adjoints, adjoint_places),
        *([v for v, _ in given], [k for _, k in given], wanted),
    )
    by_tensors = _placed(found[: len(wanted)], wanted, tensors)
    return None, None, by_tensors, None, None, list(found[len(wanted) :]), None, None


def _no_third_derivative(ctx: Any, *grads: Any) -> Any:
    raise NotImplementedError("pointwise functions have no third derivatives: differentiate them twice")


register_autograd("pointwise", _backward, _keep)
register_autograd("pointwise_backward", _double_backward, _keep_backward)
register_autograd("pointwise_second", _no_third_derivative)
for _name in ("pointwise", "pointwise_backward", "pointwise_second"):
    refuse_vmap(_name)
