"""The list of boundaries of a step."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, MutableSequence
from typing import Any

from torch import Tensor, nn

from ..errors import shape_of


class BoundaryList(nn.Module, MutableSequence[Any]):
    """A list of boundaries; those that are modules are its submodules.

    Attributes:
        entries: the boundaries as a plain list; read-only.

    Raises:
        TypeError: for anything but a list, or an entry that is neither a module nor has a method `apply`.
    """

    def __init__(self, boundaries: Iterable[Any] = ()) -> None:
        super().__init__()
        if not isinstance(boundaries, Iterable) or isinstance(boundaries, (str, Mapping)):
            raise TypeError(f"boundaries must be a list of obstacles, got {shape_of(boundaries)}: put it in a list")
        self._keep(list(boundaries))

    @property
    def reads_time(self) -> bool:
        """Whether an entry may read the time: true for entries without the attribute `reads_time`."""
        return any(getattr(entry, "reads_time", True) for entry in self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Any]:
        return iter(self.entries)

    def __getitem__(self, index: Any) -> Any:
        return self.entries[index]

    def __setitem__(self, index: Any, value: Any) -> None:
        entries = list(self.entries)
        entries[index] = value
        self._keep(entries)

    def __delitem__(self, index: Any) -> None:
        entries = list(self.entries)
        del entries[index]
        self._keep(entries)

    def insert(self, index: int, value: Any) -> None:
        self._keep([*self.entries[:index], value, *self.entries[index:]])

    def _keep(self, entries: list[Any]) -> None:
        for entry in entries:
            if not (isinstance(entry, nn.Module) or callable(getattr(entry, "apply", None))):
                raise TypeError(
                    f"boundaries must be a list of modules or objects with a method apply, got {shape_of(entry)}"
                )
        self.entries = entries
        self._modules = {str(k): entry for k, entry in enumerate(entries) if isinstance(entry, nn.Module)}

    def apply(self, function: Callable[[nn.Module], None]) -> Any:
        """As for any module, also where a user's own has an `apply` that is that of boundaries."""
        for module in self.children():
            nn.Module.apply(module, function)
        function(self)
        return self


def call_boundary(boundary: Any, *arguments: Any) -> Tensor:
    """Node velocities after a boundary: its own `apply`, or the call of a module that has none."""
    own = getattr(type(boundary), "apply", None) is not nn.Module.apply
    result: Tensor = boundary.apply(*arguments) if own else boundary(*arguments)
    return result
