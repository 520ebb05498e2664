"""The return map of sand against extended precision: `python -m benchmarks.accuracy.sand`.

Random trial strains: |p| from 1e-8 to 0.5, overshoot of the yield surface from 1e-3 to 1e4, all Lode angles, friction
angles 1° to 60°, ν from 0 to 0.49. The reference has the 64-bit mantissa of np.longdouble (x86), by bisection and
Newton's method on equations written here, checked against mpmath with 50 digits on some of the states. The comparison
is for the map of strains of the CPU kernels, in packs: the stretches of an F near the identity cannot represent the
smallest of these strains.

The error of h is divided by the condition of the root: the change of the reference under a relative change of each
argument by 1e-13, over that change, at least 1. The yield residual is |y| over the sum of its terms.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import numpy.typing as npt

from torch_mpm import _math

from .. import common

Array = npt.NDArray[Any]
LONG = np.longdouble
CASES = (("full", "radial"), ("unilateral", "radial"), ("full", "exact"), ("unilateral", "exact"))
TYPES = (("float32", np.float32, 2e-6), ("float64", np.float64, 1e-12))
"""Names, types and the allowed error relative to the condition."""


# ---- the equations, in units of |p| and 4aμ|p|³


def cubes(h: Array, unilateral: bool) -> Array:
    return (np.minimum(h, 0) if unilateral else h) ** 3


def deviator(a: Array) -> Array:
    return a - a.mean(1, keepdims=True)


def yield_terms(h: Array, alpha: Array, ratio: Array, unilateral: bool) -> tuple[Array, Array]:
    """|dev τ| and α tr τ of h [n, 3]."""
    t = cubes(h, unilateral)
    norm = np.sqrt((deviator(t) ** 2).sum(1))
    return norm, alpha * (t.sum(1) + 1.5 * ratio * h.sum(1) ** 3)


def yield_value(h: Array, alpha: Array, ratio: Array, unilateral: bool) -> Array:
    norm, trace = yield_terms(h, alpha, ratio, unilateral)
    return norm + trace


def bisect(above: Any, low: Array, high: Array, steps: int) -> tuple[Array, Array]:
    """Bisection of [low, high], where `above` is true at the upper end."""
    for _ in range(steps):
        middle = (low + high) / 2
        right = above(middle)
        low, high = np.where(right, low, middle), np.where(right, middle, high)
    return low, high


def radial_map(h: Array, alpha: Array, ratio: Array, unilateral: bool) -> Array:
    """Points of the yield surface on the way from h, outside of it, to the hydrostatic axis."""
    p = h.mean(1, keepdims=True)
    s = (h - p) / np.abs(p)

    def value(kappa: Array) -> Array:
        return yield_value(kappa[:, None] * s - 1, alpha, ratio, unilateral)

    low, high = bisect(lambda kappa: value(kappa) > 0, np.zeros_like(alpha), np.ones_like(alpha), 48)
    y_low, y_high = value(low), value(high)
    for _ in range(12):  # Illinois method
        middle = high - y_high * (high - low) / np.where(y_high == y_low, 1, y_high - y_low)
        y = value(middle)
        right = y > 0
        y_low = np.where(right, y_low / 2, y)
        low = np.where(right, low, middle)
        high, y_high = np.where(right, middle, high), np.where(right, y, y_high)
    kappa = np.where(np.abs(y_high) < np.abs(value(low)), high, low)
    return np.abs(p) * (kappa[:, None] * s - 1)


def exact_map(guess: Array, h: Array, alpha: Array, ratio: Array, unilateral: bool) -> Array:
    """Newton's method on all four equations from a guess of the solution near enough."""
    scale = np.abs(h.mean(1, keepdims=True))
    x, h = deviator(guess / scale) - 1, h / scale
    d = deviator(cubes(x, unilateral))
    c = np.maximum(((h - x) * d).sum(1) / (d * d).sum(1), 0)
    for _ in range(6):
        d = deviator(cubes(x, unilateral))
        norm = np.sqrt((d * d).sum(1))
        slope = 3 * (np.minimum(x, 0) if unilateral else x) ** 2
        y_slope = slope * (d / norm[:, None] + alpha[:, None])
        inverse = 1 / (1 + c[:, None] * slope)

        def solve(b: Array, inverse: Array = inverse, slope: Array = slope, c: Array = c) -> Array:
            """(I + c dev diag(slope))⁻¹ b of a deviator b: its trace stays zero."""
            mean = -(inverse * b).sum(1, keepdims=True) / inverse.sum(1, keepdims=True)
            return (b + mean) * inverse

        residual, direction = solve(deviator(h - x - c[:, None] * d)), solve(d)
        y = yield_value(x, alpha, ratio, unilateral)
        change = (y + (y_slope * residual).sum(1)) / (y_slope * direction).sum(1)
        x = x + residual - change[:, None] * direction
        c = c + change
    return x * scale


def reference(
    h: Array, alpha: Array, ratio: Array, unilateral: bool, flow: str, guess: Array | None = None
) -> tuple[Array, Array]:
    """Mapped strains and whether the trial strains are outside the cone; all of negative trace."""
    scale = np.abs(h.mean(1, keepdims=True))
    outside = yield_value(h / scale, alpha, ratio, unilateral) > 0
    mapped = h.copy()
    some = (h[outside], alpha[outside], ratio[outside])
    if flow == "radial":
        mapped[outside] = radial_map(*some, unilateral)
    else:
        assert guess is not None
        mapped[outside] = exact_map(guess[outside].astype(h.dtype), *some, unilateral)
    return mapped, outside


def fifty_digits(h: Array, alpha: LONG, ratio: LONG, unilateral: bool, flow: str, guess: Array) -> list[mpmath.mpf]:
    """One mapped strain by mpmath."""

    def exact(x: LONG) -> mpmath.mpf:
        high = float(x)
        return mpmath.mpf(high) + mpmath.mpf(float(x - LONG(high)))

    trial, a, r = [exact(x) for x in h], exact(alpha), exact(ratio)
    p = sum(trial) / 3
    trial = [x / abs(p) for x in trial]

    def terms(x: list[mpmath.mpf]) -> tuple[list[mpmath.mpf], mpmath.mpf, mpmath.mpf]:
        t = [min(v, 0) ** 3 if unilateral else v**3 for v in x]
        mean = sum(t) / 3
        d = [v - mean for v in t]
        norm = mpmath.sqrt(sum(v * v for v in d))
        return d, norm, norm + a * (3 * mean + r * 3 / 2 * sum(x) ** 3)

    start = [exact(LONG(v)) / abs(p) for v in guess]
    if flow == "radial":
        s = [x + 1 for x in trial]
        first = sum(u * (v + 1) for u, v in zip(s, start, strict=True)) / sum(u * u for u in s)

        def along(kappa: mpmath.mpf) -> mpmath.mpf:
            return terms([kappa * u - 1 for u in s])[2]

        kappa = mpmath.findroot(along, first)
        return [abs(p) * (kappa * u - 1) for u in s]
    d = terms(start)[0]
    c = sum((u - v) * w for u, v, w in zip(trial, start, d, strict=True)) / sum(w * w for w in d)

    def system(x0: mpmath.mpf, x1: mpmath.mpf, x2: mpmath.mpf, c: mpmath.mpf) -> list[mpmath.mpf]:
        d, norm, y = terms([x0, x1, x2])
        return [u + c * w - v for u, w, v in zip((x0, x1, x2), d, trial, strict=True)] + [y / norm]

    solution = mpmath.findroot(system, [*start, c])
    return [abs(p) * solution[k] for k in range(3)]


# ---- states


def random_states(count: int, unilateral: bool, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Trial strains [n, 3], α and Λ [n], float64, placed relative to the radial root of their direction."""
    sine = np.sin(np.radians(rng.uniform(1, 60, count)))
    alpha = np.sqrt(2 / 3) * 2 * sine / (3 - sine)
    nu = rng.uniform(0, 0.49, count)
    ratio = 2 * nu / (1 - 2 * nu)
    lode = rng.uniform(0, np.pi / 3, count)[:, None] + np.array([0, -2, 2]) * np.pi / 3
    n = np.sqrt(2 / 3) * np.cos(lode)
    far = 1e4
    has_root = yield_value(far * n - 1, alpha, ratio, unilateral) > 0
    root = radial_map(far * n - 1, alpha, ratio, unilateral)
    radius = np.where(has_root, np.sqrt(((root + 1) ** 2).sum(1)), 1.0)
    p = 10 ** rng.uniform(-8, np.log10(0.5), count)
    overshoot = 10 ** rng.uniform(-3, 4, count) * np.where(rng.uniform(size=count) < 0.1, -1, 1)
    trial = radius * np.maximum(1 + overshoot, 1e-3)
    return p[:, None] * (trial[:, None] * n - 1), alpha, ratio


def condition(h: Array, alpha: Array, ratio: Array, unilateral: bool, flow: str, mapped: Array) -> Array:
    """Relative change of the mapped strain over relative changes of the arguments, added up."""
    size = np.sqrt((mapped**2).sum(1))
    total = np.zeros_like(size)
    step = LONG(1e-13)
    changes = [(1 + step * (np.arange(3) == k), 1, 1) for k in range(3)] + [(1, 1 + step, 1), (1, 1, 1 + step)]
    for on_h, on_alpha, on_ratio in changes:
        changed, _ = reference(h * on_h, alpha * on_alpha, ratio * on_ratio, unilateral, flow, mapped)
        total += np.sqrt(((changed - mapped) ** 2).sum(1)) / step / size
    return np.maximum(1, total)


def quantiles(a: Array) -> list[float]:
    return [float(np.quantile(a, q)) for q in (0.5, 0.99)] + [float(a.max())]


def compare(count: int, energy: str, flow: str, checked: int) -> dict[str, Any]:
    """Errors of one energy and flow in both types."""
    unilateral = energy == "unilateral"
    states = random_states(count, unilateral, np.random.default_rng(0))
    row: dict[str, Any] = {"energy": energy, "flow": flow}
    for name, dtype, limit in TYPES:
        h, alpha, ratio = (np.ascontiguousarray(a.astype(dtype)) for a in states)
        found, branch, steps = _math.sand_return_map(h, alpha, ratio, energy, flow)
        wide = [a.astype(LONG) for a in (h, alpha, ratio)]
        negative = wide[0].sum(1) < 0  # Rounding may have changed a strain to extension.
        wide, result = [a[negative] for a in wide], found[negative].astype(LONG)
        branch, steps = branch[negative], steps[negative]
        mapped, outside = reference(*wide, unilateral, flow, _guess(wide, energy, flow))
        scale = np.abs(wide[0].mean(1, keepdims=True))
        norm, trace = yield_terms(wide[0] / scale, *wide[1:], unilateral)
        boundary = np.abs(norm + trace) <= 64 * np.finfo(dtype).eps * (norm - trace) * condition_of_mean(wide[0])
        wrong = (branch % 4 == 1) != outside
        cone = outside & (branch == 1)
        at = [a[cone] for a in wide]
        kappa = condition(*at, unilateral, flow, mapped[cone])
        error = np.sqrt(((result - mapped)[cone] ** 2).sum(1) / (mapped[cone] ** 2).sum(1))
        ratio_of_error = error / kappa
        norm, trace = yield_terms(result[cone] / scale[cone], *at[1:], unilateral)
        residual = np.abs(norm + trace) / (norm - trace)
        row[name] = {
            "states": int(negative.sum()),
            "on the cone": int(cone.sum()),
            "error": quantiles(error),
            "error over condition": quantiles(ratio_of_error),
            "allowed": limit,
            "residual": quantiles(residual / kappa),
            "condition": quantiles(kappa),
            "wrong branches": int((wrong & ~boundary).sum()),
            "near a boundary": int((wrong & boundary).sum()),
            "not converged": int((branch > 3).sum()),
            "evaluations": np.bincount(steps[cone]).tolist(),
        }
        if name == "float64":
            row["reference against 50 digits"] = _check_reference(at, mapped[cone], kappa, energy, flow, checked)
            row["difference of the flows"] = _difference(at, mapped[cone], energy, flow)
    return row


def condition_of_mean(h: Array) -> Array:
    """Effect of cancellation in the mean strain on the trial strain relative to it."""
    return np.abs(h).max(1) / np.abs(h.mean(1))


def _guess(wide: list[Array], energy: str, flow: str) -> Array:
    h, alpha, ratio = (np.ascontiguousarray(a.astype(np.float64)) for a in wide)
    return np.asarray(_math.sand_return_map(h, alpha, ratio, energy, flow)[0])


def _check_reference(at: list[Array], mapped: Array, kappa: Array, energy: str, flow: str, count: int) -> float:
    """Largest relative difference of the reference and mpmath over the condition, over some states."""
    worst = 0.0
    with mpmath.workdps(50):
        for k in np.linspace(0, len(mapped) - 1, count).astype(int):
            h, alpha, ratio = (a[k] for a in at)
            exact = fifty_digits(h, alpha, ratio, energy == "unilateral", flow, mapped[k])
            size = max(abs(x) for x in exact)
            own = [mpmath.mpf(float(x)) + mpmath.mpf(float(x - LONG(float(x)))) for x in mapped[k]]
            error = max(abs(a - b) for a, b in zip(own, exact, strict=True))
            worst = max(worst, float(error / size) / float(kappa[k]))
    return worst


def _difference(at: list[Array], mapped: Array, energy: str, flow: str) -> list[dict[str, float]] | None:
    """Median relative difference of the radial map from the exact one by overshoot, and over the plastic increment."""
    if flow == "radial":
        return None
    radial, _ = reference(*at, energy == "unilateral", "radial")
    size = {name: np.sqrt(((a - a.mean(1, keepdims=True)) ** 2).sum(1)) for name, a in (("h", at[0]), ("r", radial))}
    overshoot = size["h"] / size["r"] - 1
    difference = np.sqrt(((radial - mapped) ** 2).sum(1))
    increment = np.sqrt(((at[0] - mapped) ** 2).sum(1))
    rows = []
    for low in (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0, 1000.0):
        inside = (overshoot >= low) & (overshoot < 10 * low)
        rows.append(
            {
                "overshoot": low,
                "relative": float(np.median((difference / np.sqrt((mapped**2).sum(1)))[inside])),
                "of the increment": float(np.median((difference / increment)[inside])),
            }
        )
    return rows


# ---- report


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Histograms of the evaluations of the yield function."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3), sharey=True)
    for axis, (name, _, _) in zip(axes, TYPES, strict=True):
        for row in rows:
            counts = np.array(row[name]["evaluations"][:40]) / row[name]["on the cone"]
            axis.plot(np.arange(len(counts)), counts, marker=".", label=f"{row['energy']}, {row['flow']}")
        axis.set(title=name, xlabel="evaluations of the yield function", yscale="log", ylim=(1e-6, 1))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("share of states on the cone")
    axes[1].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def share_of(counts: list[int]) -> tuple[int, int]:
    """Median and largest number of evaluations."""
    total = np.cumsum(counts)
    return int(np.searchsorted(total, total[-1] / 2)), len(counts) - 1


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    header = (
        "case", "on the cone", "error of h / condition: median", "99%", "largest", "allowed", "|y| / terms / condition",
        "wrong branches", "not converged", "evaluations: median", "most",
    )  # fmt: skip
    rows = []
    for row in result["rows"]:
        for name, _, _ in TYPES:
            r = row[name]
            rows.append(
                (
                    f"{row['energy']}, {row['flow']}, {name}", r["on the cone"], *r["error over condition"],
                    r["allowed"],
                    r["residual"][2], r["wrong branches"], r["not converged"], *share_of(r["evaluations"]),
                )
            )  # fmt: skip
    lines = ["# Return map of sand against extended precision", "", common.describe(result["environment"]), ""]
    lines += [
        common.table(header, rows),
        "",
        "Reference against mpmath with 50 digits, largest relative difference over the condition:",
        "",
    ]
    checks = [(f"{r['energy']}, {r['flow']}", r["reference against 50 digits"]) for r in result["rows"]]
    lines += [common.table(("case", "difference"), checks), "", "![evaluations](sand_accuracy.png)", ""]
    lines += ["Radial map against the exact flow, medians: |Δh|/|h| and |Δh| over the plastic increment", ""]
    flows = [
        (r["energy"], d) for r in result["rows"] if r["difference of the flows"] for d in r["difference of the flows"]
    ]
    header = ("energy", "overshoot from", "relative", "of the increment")
    lines.append(common.table(header, [(e, d["overshoot"], d["relative"], d["of the increment"]) for e, d in flows]))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=100_000, help="of each energy and flow")
    parser.add_argument("--quick", action="store_true", help="few states, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    count, checked = (2000, 10) if arguments.quick else (arguments.states, 200)
    result = {
        "environment": common.environment(),
        "rows": [compare(count, energy, flow, checked) for energy, flow in CASES],
    }
    print(text(result))
    common.write(arguments.out, "sand_accuracy", result, text(result))
    figure(result["rows"], arguments.out / "sand_accuracy.png")


if __name__ == "__main__":
    main()
