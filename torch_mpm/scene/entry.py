"""One scene of a batch with all inherited words of the file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import Field

from . import schema


class ResolvedEntry(schema.Entry):
    """One scene of a batch, complete. ``path`` begins the keys of its own words in messages.

    Its lists begin with ``own`` words of its own, by kind, followed by those outside the scenes of the file.
    """

    path: str = ""
    own: dict[str, int] = Field(default_factory=dict)
    own_gravity: bool = False

    @classmethod
    def resolved(cls, entry: schema.Content, shared: schema.Content | None = None, index: int = 0) -> ResolvedEntry:
        """Entry with its inherited words; or, without ``shared``, the only scene of a file."""
        kinds = ("body", "obstacle", "emitter")
        lists: dict[str, Any] = {kind: list(getattr(entry, kind)) for kind in kinds}
        if shared is None:
            return cls.model_construct(gravity=entry.gravity, material=entry.material, **lists)
        own = {kind: len(items) for kind, items in lists.items()}
        for kind in kinds:
            lists[kind] += getattr(shared, kind)
        return cls.model_construct(
            name=getattr(entry, "name", "") or f"scene {index}",
            path=f"scene[{index}].",
            own=own,
            seed=getattr(entry, "seed", None),
            own_gravity=bool(entry.gravity),
            gravity=entry.gravity or shared.gravity,
            material=shared.material | entry.material,
            **lists,
        )

    def keyed(self, kind: str) -> Iterator[tuple[str, Any]]:
        """(key in the file, words) of all valid words of a kind."""
        own = self.own.get(kind, 0)
        for k, item in enumerate(getattr(self, kind)):
            if item is not None:
                yield f"{self.path}{kind}[{k}]" if k < own or not self.path else f"{kind}[{k - own}]", item
