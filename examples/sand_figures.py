"""Two pictures of the sand model: its energies, and its yield surfaces (figures 1 and 2 of the supplement of Gao et al.
2018): `python examples/sand_figures.py [--out docs/pictures]`. Needs matplotlib.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
import torch

from torch_mpm.ops import quartic_energy, quartic_return_map

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Array = npt.NDArray[np.float64]
MU, LAM = 1.0, 1.5
"""Lamé parameters: ν = 0.3."""
FRICTION_ANGLE = math.radians(30)


def energies(axes: list[Any]) -> None:
    """Full and unilateral energy over two Hencky strains."""
    x = torch.linspace(-0.5, 0.5, 81, dtype=torch.float64)
    h = torch.stack(torch.meshgrid(x, x, indexing="ij"), 2)
    F = torch.diag_embed(h.reshape(-1, 2).exp())
    for axis, energy in zip(axes, ("full", "unilateral"), strict=True):
        value = quartic_energy(F, MU, LAM, energy=energy).reshape(h.shape[:2]).numpy()
        axis.plot_surface(*h.permute(2, 0, 1).numpy(), value, cmap="viridis", rcount=81, ccount=81, linewidth=0)
        levels = np.linspace(0.25, 5.75, 12)
        axis.contour(*h.permute(2, 0, 1).numpy(), value, levels=levels, zdir="z", offset=-2.0, cmap="viridis")
        axis.set(title=f"{energy} quartic energy", zlim=(-2, 6), zlabel="ψ/μ")
        axis.set(xlabel="$h_0$", ylabel="$h_1$")
        axis.view_init(25, -130)


def yield_surface(energy: str, turns: Array, pressure: Array) -> Array:
    """Points [len(pressure), len(turns), 3] of the cone: the return map of strains far outside of it."""
    n = math.sqrt(2 / 3) * np.cos(turns[:, None] - np.array([0, 2, 4]) * math.pi / 3)
    F = torch.diag_embed(torch.tensor(0.001 * (100 * n - 1)).exp())
    mapped = quartic_return_map(F, MU, LAM, FRICTION_ANGLE, energy=energy).F
    h = mapped.diagonal(dim1=1, dim2=2).log().numpy()
    return pressure[:, None, None] * (h / 0.001)


def surfaces(axis: Any) -> None:
    """The cones of the quartic and the quadratic energy about the hydrostatic axis."""
    turns, pressure = np.linspace(0, 2 * math.pi, 181), np.linspace(0, 0.1, 21)
    for energy, color, alpha in (("hencky", "tab:red", 0.9), ("full", "tab:green", 0.35)):
        axis.plot_surface(*np.moveaxis(yield_surface(energy, turns, pressure), 2, 0), color=color, alpha=alpha)
    line = np.array([-0.14, 0.04])
    axis.plot(line, line, line, color="black")
    axis.set(xlabel="$h_0$", ylabel="$h_1$", zlabel="$h_2$", title="yield surfaces: quartic (green), quadratic (red)")
    axis.set_box_aspect((1, 1, 1))
    axis.view_init(10, -60)


def cross_sections(axis: Any) -> None:
    """The same across the hydrostatic axis, in units of |p|, with the unilateral energy."""
    turns = np.linspace(0, 2 * math.pi, 361)
    for energy, color in (("full", "tab:green"), ("unilateral", "tab:blue"), ("hencky", "tab:red")):
        s = yield_surface(energy, turns, np.ones(1))[0] + 1
        radius = np.sqrt((s**2).sum(1))
        axis.plot(turns, radius, color=color, label="quadratic" if energy == "hencky" else f"quartic, {energy}")
    axis.set_title("|dev h|/|p| across the axis")
    axis.set_xticks(np.arange(6) * math.pi / 3, [f"{60 * k}°" for k in range(6)])
    axis.legend(loc="lower left", bbox_to_anchor=(-0.35, -0.15), fontsize=8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    first, second = (plt.figure(figsize=(10, 4.5)) for _ in range(2))
    energies([first.add_subplot(1, 2, k, projection="3d") for k in (1, 2)])
    surfaces(second.add_subplot(1, 2, 1, projection="3d"))
    cross_sections(second.add_subplot(1, 2, 2, projection="polar"))
    for figure, name in ((first, "sand_energy.png"), (second, "sand_yield_surface.png")):
        figure.tight_layout()
        figure.savefig(out / name, dpi=100)
        print(f"wrote {out / name}")


if __name__ == "__main__":
    main()
