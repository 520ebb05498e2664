"""Failed scenes: counted reasons, and the decision whether a data set has too many of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

from .shard import SceneRecord

MOST_FAILED = 0.25
"""Maximum share of failed scenes of a valid data set."""
MOST_REASONS = 5
"""Maximum number of listed reasons."""


class FailedScenesError(ValueError):
    """A data set without a valid scene, or with too many failed scenes."""


def reasons(scenes: Iterable[SceneRecord]) -> list[str]:
    """One line for each reason of failures, the most frequent first, with its number of scenes.

    Reasons that differ only in numbers are merged; the line has the first of them.
    """
    counts: Counter[str] = Counter()
    examples: dict[str, str] = {}
    for scene in scenes:
        if not scene.valid:
            kind = re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", scene.failure)
            counts[kind] += 1
            examples.setdefault(kind, scene.failure or "no reason is recorded")
    lines = [f"{count} failed: {examples[kind]}" for kind, count in counts.most_common(MOST_REASONS)]
    rest = sum(counts.values()) - sum(count for _, count in counts.most_common(MOST_REASONS))
    return [*lines, *([f"{rest} failed for other reasons"] if rest else [])]


def check_failures(scenes: list[SceneRecord], most: float = MOST_FAILED) -> None:
    """Raise where no scene is valid, or a larger share than `most` has failed.

    Args:
        scenes: the attempted scenes.
        most: maximum share of failed scenes, between 0 and 1.

    Raises:
        FailedScenesError: with the reasons.
    """
    failed = sum(not scene.valid for scene in scenes)
    if scenes and (failed == len(scenes) or failed > most * len(scenes)):
        limit = "no scene is valid" if failed == len(scenes) else f"more than {most:.0%} of the scenes failed"
        raise FailedScenesError("\n".join([f"{failed} of {len(scenes)} scenes failed: {limit}", *reasons(scenes)]))
