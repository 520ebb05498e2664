"""Figures of the studies of implicit steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from .sand import pulled

Rows = list[dict[str, Any]]
COLORS = {"full": "tab:red", "unilateral": "tab:blue"}


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _saved(figure: Any, path: Path) -> None:
    from matplotlib.ticker import NullFormatter

    for panel in figure.axes:  # labels between decades overlap
        if panel.get_xscale() == "log":
            panel.xaxis.set_minor_formatter(NullFormatter())
        if panel.get_yscale() == "log":
            panel.yaxis.set_minor_formatter(NullFormatter())
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    _pyplot().close(figure)
    print(f"wrote {path}")


def draw_work(squeeze: Rows, path: Path) -> None:
    """Error in time against processor time of the gripper, one panel per stiffness."""
    moduli = list(dict.fromkeys(row["E"] for row in squeeze))
    figure, panels = _pyplot().subplots(
        1, len(moduli), figsize=(3.6 * len(moduli), 3.8), sharey=True, squeeze=False, layout="constrained"
    )
    for panel, E in zip(panels[0], moduli, strict=True):
        own = [r for r in squeeze if r["E"] == E and r["dtype"] == "float64"]
        explicit = own[0]
        implicit = [r for r in own if r["tolerance"] == 1e-4]
        loose = [r for r in own if r["tolerance"] == 1e-2]
        panel.loglog(*points(implicit, "time [s]", "error in time"), "o-", color="tab:blue", label="implicit")
        panel.loglog(
            *points(loose, "time [s]", "error in time"), "^", color="tab:cyan", label="implicit, tolerance 0.01"
        )
        panel.loglog([explicit["time [s]"]], [explicit["error in time"]], "s", color="tab:red", label="explicit")
        panel.axhline(explicit["error in all"], color="gray", linestyle=":", label="error of the lattice")
        for row in implicit:
            panel.annotate(str(row["steps"]), (row["time [s]"], row["error in time"]), (4, 4),
                           textcoords="offset points", fontsize=8)  # fmt: skip
        panel.set_title(f"E = {E:.0e} Pa")
        panel.set_xlabel("processor time [s]")
    panels[0, 0].set_ylabel("RMS error of displacements")
    panels[0, 0].legend(fontsize=8)
    figure.suptitle("A gripper squeezes rubber for a second; numbers: implicit steps")
    _saved(figure, path)


def points(rows: Rows, across: str, up: str) -> tuple[list[Any], list[Any]]:
    return [row[across] for row in rows], [row[up] for row in rows]


def draw_order(in_time: Rows, in_space: Rows, path: Path) -> None:
    figure, (left, right) = _pyplot().subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    left.loglog(*points(in_time, "dt [s]", "error"), "o-", label="vibrating bar, FLIP")
    left.loglog([1.5e-4, 6e-3], [1.5e-3, 6e-2], color="gray", label="order 1")
    left.set_xlim(1e-4, 1e-2)
    left.set_ylim(1e-3, 1e-1)
    left.set_xlabel("dt [s]")
    left.set_ylabel("relative error against explicit steps")
    bodies = dict.fromkeys((row["body"], row["kernel"]) for row in in_space)
    colors = {body: f"C{k}" for k, body in enumerate(dict.fromkeys(body for body, _ in bodies))}
    for body, kernel in bodies:
        own = [row for row in in_space if (row["body"], row["kernel"]) == (body, kernel)]
        style = "o-" if kernel == "quadratic" else "s--"
        right.loglog(*points(own, "cells", "error"), style, color=colors[body], label=f"{body}, {kernel}")
    cells = [2.0, 64.0]
    for order, style in ((1, "-"), (2, ":")):
        right.loglog(cells, [0.4 * (2 / n) ** order for n in cells], style, color="gray", label=f"order {order}")
    right.set_ylim(1e-5, 0.6)
    right.set_xticks([2, 4, 8, 16, 32, 64], ["2", "4", "8", "16", "32", "64"])
    right.set_xlabel("cells of the column, and of the beam's height")
    right.set_ylabel("relative error against analytic solutions")
    for panel in (left, right):
        panel.legend(fontsize=8)
        panel.grid(alpha=0.3)
    _saved(figure, path)


def draw_sand(clump: Rows, collapse: Rows, path: Path) -> None:
    """Above the clump, below the collapse by FLIP: particles at the end of one length of the step, and all lengths."""
    collapse = [row for row in collapse if row["transfer"] == "flip"]
    figure, panels = _pyplot().subplots(2, 4, figsize=(16, 5.5), layout="constrained", width_ratios=(1.2, 1.2, 1.2, 1))
    _, start = pulled((8, 4), 0.025, 2.0)
    _draw_bodies(panels[0, :3], clump, 1e-2, start.x)
    _draw_bodies(panels[1, :3], collapse, 2e-3, None)
    for panel, rows, measure in ((panels[0, 3], clump, "spread"), (panels[1, 3], collapse, "run-out")):
        for energy, color in COLORS.items():
            own = [row for row in rows if row["energy"] == energy]
            for number, name in enumerate(dict.fromkeys(row["return map"] for row in own)):
                these = [row for row in own if row["return map"] == name]
                if name == "explicit":
                    panel.axhline(these[0][measure], color=color, linestyle=":", label=f"{energy}, explicit")
                else:
                    style = ("o-", "s--", "^-.")[number - 1]
                    panel.semilogx(*points(these, "dt [s]", measure), style, color=color, label=f"{energy}, {name}")
        panel.set_ylim(0)
        panel.set_xlabel("dt [s]")
        panel.set_title("share of the growth" if measure == "spread" else "run-out / half width, FLIP")
    panels[1, 3].legend(fontsize=7, loc="lower left")
    _saved(figure, path)


def _draw_bodies(panels: Any, rows: Rows, dt: float, start: torch.Tensor | None) -> None:
    implicit = [row for row in rows if row["return map"] == "after the solve"]
    near = min({row["dt [s]"] for row in implicit}, key=lambda length: abs(length - dt))
    shown = [next(row for row in rows if row["return map"] == "explicit" and row["energy"] == "unilateral")]
    shown += [row for energy in COLORS for row in implicit if row["energy"] == energy and row["dt [s]"] == near]
    for panel, row in zip(panels, shown, strict=True):
        if start is not None:
            panel.plot(*start.T, "x", color="silver", markersize=3)
        explicit = row["return map"] == "explicit"
        size = 2 if start is None else 4
        panel.plot(*row["end"].x.T, ".", color="black" if explicit else COLORS[row["energy"]], markersize=size)
        panel.set_aspect("equal")
        starts = "" if start is None else " (crosses: at the start)"
        panel.set_title(f"explicit{starts}" if explicit else f"implicit, dt = {near:.2g} s, {row['energy']}")
    ends = torch.cat([row["end"].x for row in shown])
    margin = 0.05 * (ends.amax(0) - ends.amin(0)).max()
    (left, bottom), (right, top) = (ends.amin(0) - margin).tolist(), (ends.amax(0) + margin).tolist()
    for panel in panels:
        panel.set_xlim(left, right)
        panel.set_ylim(bottom, top)
