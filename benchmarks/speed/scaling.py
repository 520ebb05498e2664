"""Figure of the time per substep over the number of particles, from the results of `rollouts`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

RATES = {1e7: "10 M/s", 1e8: "100 M/s", 1e9: "1 G/s", 1e10: "10 G/s"}
"""Particles per second that are drawn as lines."""


def plot(results: Sequence[dict[str, Any]], path: Path) -> None:
    """All devices in one figure."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(8.5, 5.5))
    for result in results:
        rows = [row for row in result["rollouts"] if row["name"] == "one scene"]
        place = result["environment"]
        label = f"{place['device']}, {place['threads']} threads" if "threads" in place else place["device"]
        axes.loglog([row["particles"] for row in rows], [row["us"] for row in rows], marker="o", label=label)
    axes.margins(0.08)
    left, right, bottom, top = axes.axis()
    for rate, name in RATES.items():
        axes.plot([left, right], [left / rate * 1e6, right / rate * 1e6], color="gray", linewidth=0.8, linestyle=":")
        x = min(right, top * rate * 1e-6)
        axes.annotate(name, (x, x / rate * 1e6), (4, 4), textcoords="offset points", color="gray", fontsize=8)
    axes.axis((left, right, bottom, top))
    axes.set(xlabel="particles", ylabel="time per substep [µs]")
    axes.legend()
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    print(f"wrote {path}")
