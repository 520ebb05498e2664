"""`State` in containers of torch: as a pytree, in files, in the batches of a `DataLoader`, and as a TensorDict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.utils import _pytree
from torch.utils.data._utils.collate import default_collate_fn_map

from ..cuda_graphs.capture import is_traced
from .state import FIELDS, State

if TYPE_CHECKING:
    from ..boundaries.control import Poses

TENSORS = sorted((name for name in FIELDS if name not in ("extra", "time")), reverse=True)
"""Sort key: a name comes before its prefixes, which `torch.export` needs to distinguish `v` from `volume`."""


class Kept:
    """Data that belongs to a layout, but takes no part in comparisons: states of one layout may have any poses."""

    def __init__(self, poses: Poses) -> None:
        self.poses = poses

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Kept)

    def __hash__(self) -> int:
        return hash(Kept)


Layout = tuple[tuple[str, ...], tuple[str, ...], "float | None", Kept]
"""Names of the fields and of the entries of `extra` that are leaves, the time where it is a number, and the poses."""


def _flatten(state: State) -> tuple[list[Any], Layout]:
    """The tensors of a state are leaves; absent fields are not."""
    names = tuple(name for name in TENSORS if getattr(state, name) is not None)
    time = state.time
    leaves = [getattr(state, name) for name in names] + [
        state.extra[name] for name in sorted(state.extra, reverse=True)
    ]
    number = None if isinstance(time, Tensor) else time
    # Traced states differ in each run.
    kept = Kept({} if is_traced(state.x) else state.poses)
    return (leaves if number is not None else [*leaves, time]), (names, tuple(state.extra), number, kept)


def _flatten_with_keys(state: State) -> tuple[list[tuple[Any, Any]], Layout]:
    leaves, layout = _flatten(state)
    names, extra, time, _ = layout
    keys = [*names, *(f"extra.{name}" for name in sorted(extra, reverse=True)), *(["time"] if time is None else [])]
    return [(_pytree.GetAttrKey(key), leaf) for key, leaf in zip(keys, leaves, strict=True)], layout


def _unflatten(leaves: Any, layout: Layout) -> State:
    """State of any leaves, as a function of the tree may have made: nothing is checked."""
    names, extra, time, beside = layout
    values = list(leaves)
    state: State = object.__new__(State)
    state.__dict__.update(dict.fromkeys(TENSORS))
    state.__dict__.update(zip(names, values, strict=False))
    kept = dict(zip(sorted(extra, reverse=True), values[len(names) :], strict=False))
    state.extra = {name: kept[name] for name in extra}
    if time is None:
        state.__dict__["_time"] = values[-1]
    else:
        state.time = time
    if beside.poses:
        state.__dict__["_poses"] = beside.poses
    return state


def _collate(batch: Sequence[State], *, collate_fn_map: dict[type, Callable[..., Any]] | None = None) -> State:
    """States as the scenes of one batch."""
    return State.concatenate(batch, scene=True)


def to_tensordict(state: State) -> Any:
    """Fields of a state as a TensorDict without batch size, those of `extra` nested; needs the package tensordict.

    Absent fields are omitted, and a time that is a number is not a tensor there. The tensors are shared, with their
    graphs.

    Raises:
        ModuleNotFoundError: without the package.
    """
    from tensordict import TensorDict

    fields: dict[str, Any] = {name: value for name in TENSORS if (value := getattr(state, name)) is not None}
    result = TensorDict({**fields, "extra": TensorDict(dict(state.extra), batch_size=[])}, batch_size=[])
    if isinstance(state.time, Tensor):
        result["time"] = state.time
    else:
        result.set_non_tensor("time", state.time)
    return result


def from_tensordict(fields: Any) -> State:
    """State of a TensorDict made by `to_tensordict`; anything else in it is an unknown field.

    Raises:
        TypeError, ValueError: as `State`.
    """
    values = {name: fields.get(name) for name in fields.keys() if name not in ("extra", "time")}
    extra = dict(fields["extra"].items()) if "extra" in fields.keys() else {}
    time = fields.get("time", 0.0)
    return State(**values, extra=extra, time=getattr(time, "data", time) if not isinstance(time, Tensor) else time)


def register() -> None:
    """Register `State` in torch: pytrees, `torch.load(weights_only=True)` and `default_collate`."""
    _pytree.register_pytree_node(
        State,
        _flatten,
        _unflatten,
        serialized_type_name="torch_mpm.State",
        to_dumpable_context=lambda layout: list(layout[:3]),
        from_dumpable_context=lambda read: (tuple(read[0]), tuple(read[1]), read[2], Kept({})),  # Lists of a file.
        flatten_with_keys_fn=_flatten_with_keys,
    )
    torch.serialization.add_safe_globals([State])
    default_collate_fn_map[State] = _collate
