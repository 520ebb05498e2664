"""Figure of the bytes per second of each part or kernel of a step, compared with the bandwidth of the memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any


def plot(results: Sequence[dict[str, Any]], path: Path) -> None:
    """A panel for each device, with its largest size; none without results that have sizes."""
    results = [result for result in results if result.get("sizes")]
    if not results:
        return
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, len(results), figsize=(7.5 * len(results), 5.5), squeeze=False)
    for axes, result in zip(panels[0], results, strict=True):
        entry = max(result["sizes"], key=lambda entry: entry["particles"])
        parts = entry["parts"]
        rates = [part["bytes"] / part["ms"] * 1e-6 for part in parts]
        axes.barh([part["name"] for part in parts], rates, color="tab:blue", label="part")
        if copy := result.get("copy_GB_s"):
            axes.axvline(copy, color="tab:orange", label="copy of 1 GiB")
        limits = [(part["bytes"] / part["memory_ms"] * 1e-6, part["name"]) for part in parts if "memory_ms" in part]
        if limits:
            axes.plot(*zip(*limits, strict=True), "k|", markersize=12, label="copy or read of as many bytes")
        axes.invert_yaxis()
        title = f"{result['environment']['device']}, {entry['particles'] / 1e6:.3g} M particles"
        axes.set(xlabel="bytes that a part must move over its time [GB/s]", title=title)
        axes.legend(loc="upper center", bbox_to_anchor=(0.35, -0.12), ncol=3)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    print(f"wrote {path}")
