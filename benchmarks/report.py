"""The tables and figures of the documents, from the result files: `python -m benchmarks.report [--write]`.

Prints the tables. With --write, inserts them between the lines `<!-- benchmarks -->` and `<!-- /benchmarks -->` of
docs/measured.md (all tables), README.md (one of speed and one of accuracy), docs/implicit.md, docs/envs.md and the
pages for users of other projects, and draws the figures of several devices beside the results. Each program draws its
other figures.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from . import common, envs_ppo
from .accuracy.limits import tables as limit_tables
from .accuracy.runout import PUBLISHED, published, slopes
from .speed import doors, heat_kernels, network_steps, roofline, scaling, thermal
from .speed import training as speed_of_training
from .speed.rollouts import row_beside, row_of_peer, row_of_steps
from .speed.training_scripts import PROJECTS
from .stability.adversarial import summary as rollouts
from .stability.heat import cell as heat_cell
from .stability.heat import kind as heat_kind
from .stability.heat_step import table as heat_step_table

README, MEASURED = common.ROOT / "README.md", common.ROOT / "docs" / "measured.md"
IMPLICIT = common.ROOT / "docs" / "implicit.md"
ENVS = common.ROOT / "docs" / "envs.md"
MIGRATING = common.ROOT / "docs" / "migrating"
BEGIN, END = "<!-- benchmarks -->", "<!-- /benchmarks -->"
FORWARD = ("step", "step, CUDA graph")
BOTH = ("step, forward and backward", "step, forward and backward, CUDA graph")


def speed(results: list[dict[str, Any]]) -> str:
    """Whole steps compared with the peers, with the environments, and the parts compared with the memory."""
    notes = [f"- {common.describe(result['environment'])}" for result in results]
    figure = (
        "The bytes that a part must move, over its time.\nThe line is a copy of an uncached tensor, which writes half "
        "of its bytes: parts that mostly read, or on the CPU find some of their data in the cache, may exceed it.\n"
        "Marks, in results that have them, are the faster of a copy and a read of as many bytes as the part."
    )
    picture = "![bytes per second of each part, and of a copy](benchmarks/results/roofline.png)"
    return "\n".join([speed_table(results), "", *notes, "", figure, "", picture])


def speed_table(results: list[dict[str, Any]]) -> str:
    """Whole steps compared with the peers, and the rates of the transfers."""
    rows = []
    for result in results:
        for entry in result["sizes"]:
            steps = {row["name"]: row["ms"] for row in entry["steps"]}
            ours, both = (min((steps[n] for n in names if n in steps), default=None) for names in (FORWARD, BOTH))
            others = {p["name"]: p["ms"] for p in result["peers"] if p["particles"] == entry["particles"]}
            rates = {part["name"]: entry["particles"] / part["ms"] * 1e-6 for part in entry["parts"]}
            rows.append(
                (
                    result["environment"]["device"],
                    f"{entry['particles'] / 1e6:.3g} M",
                    ours,
                    *(_ratio(others.get(name), ours) for name in ("warp", "taichi")),
                    _ratio(both, ours),
                    rates.get("p2g"),
                    rates.get("g2p"),
                    max(entry["errors"].values(), default=None),
                )
            )
    header = (
        "device", "particles", "step [ms]", "Warp's step", "Taichi's step", "with backward", "P2G [G/s]", "G2P [G/s]",
        "float32 error",
    )  # fmt: skip
    intro = (
        "One explicit neo-Hookean step, 3-D, float32, quadratic kernel, 8 particles per cell, everything included.\n"
        "Columns with x are multiples of its time in the same run; rates are in billions of particles per second; the "
        "error is the largest of P2G, G2P and their gradients against float64."
    )
    return "\n".join([intro, "", common.table(header, rows)])


def as_run(results: list[dict[str, Any]]) -> str:
    """Example scenes and rollouts as users run them."""
    notes = [f"- {common.describe(result['environment'])}" for result in results]
    rows = [
        (result["environment"]["device"], *row_of_steps(r), r.get("seconds"))
        for result in results
        for r in (*result["rollouts"], *result["scenes"])
    ]
    header = ("device", "", "particles", "substeps", "us per substep", "M particles/s", "simulation, s")
    return "\n".join(
        [
            "Substeps of one call of `rollout` (the neo-Hookean cube), and scenes by `torch-mpm run` with their files "
            "(benchmarks/speed/rollouts.py).",
            *("", common.table(header, rows), "", *notes, ""),
            *beside_peers(results),
            "One scene; dotted lines: particles per second.",
            *("", "![time per substep over particles](benchmarks/results/rollouts.png)"),
        ]
    )


def beside_peers(results: list[dict[str, Any]]) -> list[str]:
    """Tables of peers that step the same cubes, and of scenes compared with Warp's step launched from Python."""

    def rows(key: str, row: Callable[[dict[str, Any]], tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        return [(result["environment"]["device"], *row(r)) for result in results for r in result.get(key, ())]

    header = ("device", "a step", "of", "particles", "us", "speed-up by a rollout")
    peers = common.table(header, rows("peers", row_of_peer))
    header = ("device", "scene", "particles of Warp's step", "us", "speed-up by the scene")
    return [
        "Steps of the same work by peers, in plain standard use: Warp by CUDA graphs on a GPU, scenes of a batch "
        "side by side in one dense grid:",
        *("", peers, ""),
        "Warp's step launched from Python, of a neo-Hookean cube with about as many particles as a scene, which has "
        "additional laws, obstacles, heat and output:",
        *("", common.table(header, rows("plain", row_beside)), ""),
    ]


def training(results: list[dict[str, Any]]) -> str:
    """Gradients through rollouts, compared with peers, and steps with networks."""

    def rows(part: Callable[[dict[str, Any]], Iterable[tuple[Any, ...]]]) -> Iterator[tuple[Any, ...]]:
        return ((result["environment"]["device"], *row) for result in results for row in part(result))

    notes = [f"- {common.describe(result['environment'])}" for result in results]
    held = rows(lambda result: map(speed_of_training.row_of_rollout, result["rollouts"]))
    networks = rows(lambda result: network_steps.table_rows(result["networks"]))
    parts = [
        "The gradient of a rollout of the neo-Hookean cube by the velocities at its start "
        "(benchmarks/speed/training.py), by the number of steps that the backward pass holds at a time:",
        common.table(("device", *speed_of_training.HELD), held),
        peers_of_training(results, list(PROJECTS)),
        f"{network_steps.STEPS} consecutive steps with a network as their law:",
        common.table(("device", *network_steps.HEADER), networks),
        "\n".join(notes),
    ]
    return "\n\n".join(parts)


def interfaces(results: list[dict[str, Any]]) -> str:
    """Steps through the interfaces of other simulators beside rollouts."""
    rows = ((r["environment"]["device"], r["particles"], *doors.row_of(row)) for r in results for row in r["rows"])
    notes = "\n".join(f"- {common.describe(result['environment'])}" for result in results)
    text = (
        "Steps through the interfaces of other simulators, as their own programs call them, beside `rollout` with the "
        "same options (benchmarks/speed/doors.py); float32, without gradients.\nThose that are called with a stress "
        "return all fields of the particles in every step."
    )
    return "\n\n".join([text, common.table(("device", "particles", *doors.HEADER), rows), notes])


def peers_of_training(results: list[dict[str, Any]], projects: Sequence[str]) -> str:
    """Gradients through the work of some projects, in a rollout, in their scripts and by their algorithms."""
    rows = [
        (result["environment"]["device"], *row)
        for result in results
        for row in speed_of_training.rows_of_peers(result)
        if row[0] in projects
    ]
    intro = (
        "A fixed corotated cube in a rollout, in a script of another project, and by the algorithm of that project "
        "(benchmarks/speed/training_scripts.py), with the gradient by the velocities at the start; columns with x are "
        "multiples of the rollout of the same work.\nThe algorithms of NCLaw and PhysGaussian use Warp, which has one "
        "thread on CPUs."
    )
    return "\n\n".join([intro, common.table(("device", *speed_of_training.BESIDE), rows)])


def migrating(directory: Path) -> dict[Path, str]:
    """Speed and memory in the pages for users of other projects."""
    results = common.read(directory, "training_*.json")
    notes = "\n".join(f"- {common.describe(result['environment'])}" for result in results)
    pages = {f"{page}.md": [peers_of_training(results, [project]), notes] for page, project in
             (("mpm_pytorch", "MPM-PyTorch"), ("nclaw", "NCLaw"), ("physgaussian", "PhysGaussian"))}  # fmt: skip
    return {MIGRATING / name: "\n\n".join(parts) for name, parts in pages.items()}


def learning(results: list[dict[str, Any]]) -> str:
    """Returns of the tasks of `torch_mpm.envs` by PPO."""
    intro = (
        "A training of each task from seed 0, with the defaults of the example (benchmarks/envs_ppo.py).\n"
        "The return is the sum of the rewards of an episode: in m, but for `write`, where 1 is all of the clay in the "
        "groove.\n"
        "Columns of the test are means over scenes that the training has not seen, and the deviation among them; "
        "success is the share of scenes that reach their goal; the commit is that of the measurement.\n"
        "The plans are for one scene, in which the trained network is tested too: the first guess, and the best one by "
        "gradients."
    )
    notes = [f"- {common.describe(result['environment'])}" for result in results]
    return "\n\n".join([intro, *map(envs_ppo.table, results), "\n".join(notes)])


def implicit_costs(results: list[dict[str, Any]]) -> str:
    """Measured costs of implicit steps on each device."""
    parts = []
    for result in results:
        parts.append(f"{common.describe(result['environment'])}:")
        for title, rows in result.items():
            if title != "environment" and rows:
                parts += [f"{title}:", common.table(list(rows[0]), [list(row.values()) for row in rows])]
    return "\n\n".join(parts)


def data_sets(results: list[dict[str, Any]]) -> str:
    """Generating data sets."""
    notes = [f"- {common.describe(result['environment'])}" for result in results]
    rows = []
    for result in results:
        for r in result["sets"]:
            per_frame = r["seconds"] / max(r["valid"], 1) / (r["frames"] - 1)
            rows.append(
                (
                    *(result["environment"]["device"], r["name"], r["processes"], r["frames"], r["seconds"]),
                    *(r["busy"], 1e6 * per_frame, _ratio(r.get("peer"), per_frame)),
                )
            )
    header = ("device", "data set", "processes", "frames", "s", "GPU busy", "us a frame and scene", "Taichi")
    intro = (
        "`torch-mpm generate` with its files (benchmarks/datasets.py); the last column is the time of a frame of "
        "scenes one by one in a script in Taichi, with files, without compilation (benchmarks/datasets_peer.py)."
    )
    return "\n".join([intro, "", common.table(header, rows), "", *notes])


def _ratio(value: float | None, base: float | None) -> str | None:
    return f"{value / base:.1f}x" if value and base else None


def convergence(result: dict[str, Any]) -> str:
    """Orders and errors against the manufactured solution."""
    header = ("case", "n", "order in dx", "displacement error", "run time [s]")
    rows = []
    for case in result["cases"]:
        last = case["rows"][-1]
        order = f"{case['order']['displacement']:.2f}"
        rows.append((case["name"], last["n"], order, last["displacement"], last["seconds"]))
    intro = (
        "A manufactured solution (benchmarks/accuracy/convergence.py), one period; errors relative to the amplitude on "
        "the finest lattice, order fitted over all.\n`slip` walls limit the order to 1, `mirror` walls restore 2."
    )
    figure = "![error over dx and over run time](benchmarks/results/convergence.png)"
    return "\n".join([intro, "", common.table(header, rows), "", figure])


def dam_break(result: dict[str, Any]) -> str:
    """Fronts against Ritter's solution."""
    levels = list(result["cases"][0]["rows"][0]["error"])
    header = ("case", "particles", *(f"{float(level):.0%} of h0" for level in levels), "tip / 2 c t", "run time [s]")
    rows = []
    for case in result["cases"]:
        late = [row for row in case["rows"] if row["time"] >= result["judged"] - 1e-9]
        worst = [max((abs(row["error"][level]) for row in late), default=None) for level in levels]
        shown = [None if e is None else f"{e:.1%}" for e in worst]
        rows.append((case["name"], case["particles"], *shown, f"{case['rows'][-1]['tip']:.3f}", case["seconds"]))
    intro = (
        "2-D dam break over a frictionless dry bed against Ritter's solution (defined in "
        "benchmarks/accuracy/ritter.py): largest distance between the fronts of some depths and Ritter's, relative to "
        "the distance of his dry front, for t √(g/h0) from "
        f"{result['judged']:g} to {result['cases'][0]['duration']:g}; and the position of the foremost particle at the "
        "end.\n9 particles per cell and mirror walls unless stated otherwise."
    )
    figure = "![depth, fronts over time, errors over dx](benchmarks/results/ritter.png)"
    return "\n".join(
        [intro, "", common.table(header, rows), "", figure, "", f"- {common.describe(result['environment'])}"]
    )


def precision(result: dict[str, Any]) -> str:
    """Rounding over a rollout."""
    header = ("n", "particles", "steps", "float32 [s]", "float64 [s]", "position error / dx", "energy error")
    rows = [
        [*(lattice[k] for k in ("n", "particles", "steps", "float32_seconds", "float64_seconds"))]
        + [lattice["rows"][-1]["position"], lattice["rows"][-1]["energy"]]
        for lattice in result["lattices"]
    ]
    intro = "float32 against float64 after a block has fallen, bounced and risen (benchmarks/accuracy/precision.py)."
    return "\n".join([intro, "", common.table(header, rows)])


def stability(result: dict[str, Any]) -> str:
    """Measured limits of the time step."""
    cases = result["materials"]
    ratios = sorted({c["nu"] for c in cases})
    rows = []
    for dim, stretch in sorted({(c["dim"], c["stretch"]) for c in cases}):
        mine = [c for c in cases if (c["dim"], c["stretch"]) == (dim, stretch)]
        rows.append([dim, f"{stretch:g}", *(f"{min(c['stable'] for c in mine if c['nu'] == nu):.2f}" for nu in ratios)])
    intro = (
        "Largest stable time step in multiples of `step.stable_dt(state, cfl=1)`, the least over "
        f"E = {', '.join(f'{E:.0e}' for E in sorted({c['E'] for c in cases}))} Pa; s < 1 is uniform compression, s > 1 "
        "stretch at constant volume.\nOther layouts, transfers and kernels: benchmarks/results/stability.md."
    )
    return "\n".join([intro, "", common.table(("D", "s", *(f"ν = {nu:g}" for nu in ratios)), rows)])


def stability_laws(result: dict[str, Any]) -> str:
    """Measured limits of the time step of the laws in principal strains."""
    cases = result["cases"]
    stretches = sorted({c["stretch"] for c in cases})
    rows = []
    for law in dict.fromkeys(c["law"] for c in cases):
        mine = [c for c in cases if c["law"] == law]
        limits = ([c["stable"] for c in mine if c["stretch"] == s and c["elliptic"]] for s in stretches)
        rows.append([law, *(f"{min(values):.2f}" if values else "–" for values in limits)])
    intro = (
        "The same for the other laws, the least over 2-D and 3-D, "
        f"ν = {', '.join(f'{nu:g}' for nu in sorted({c['nu'] for c in cases}))} and "
        f"E = {', '.join(f'{E:.0e}' for E in sorted({c['E'] for c in cases}))} Pa, where the law is "
        "elliptic (elsewhere disturbances grow with any time step).\nBy ν: benchmarks/results/stability_laws.md."
    )
    return "\n".join([intro, "", common.table(("law", *(f"s = {s:g}" for s in stretches)), rows)])


def runout(result: dict[str, Any]) -> str:
    """Collapse of columns of sand compared with published measurements, and the steepest stable slopes."""
    aspects = [row["a"] for row in result["collapse"][0]["rows"]]
    lines = []
    for source, (name, *_) in PUBLISHED.items():
        values = [f"{published(source, a):.2f}" for a in aspects]
        lines.append((f"{source}: {name}", *values, *(f"{p[1]:.2f}" for p in PUBLISHED[source][2:]), None))
    for case in result["collapse"]:
        runouts = [f"{row['run-out']:.2f}" for row in case["rows"]]
        exponents = [f"{case['exponents'][k]:.2f}" for k in ("wide", "narrow")]
        lines.append((case["name"], *runouts, *exponents, case["seconds"]))
    header = ("run-out at a =", *(f"{a:g}" for a in aspects), "exponent, a ≤ 2", "a ≥ 3", "run time [s]")
    intro = (
        "Run-out (r − r₀)/r₀ of columns of aspect ratio a on a rough floor (benchmarks/accuracy/runout.py, "
        f"{result['environment']['device']}), each row one batch."
    )
    parts = [intro, common.table(header, lines), "![run-out over aspect ratio](benchmarks/results/runout.png)"]
    if result["standing"]:
        parts.append(slopes(result))
    return "\n\n".join(parts)


def collapse(result: dict[str, Any]) -> str:
    """Long runs of columns of any stiffness and friction."""
    rows = [
        (
            name,
            len(rows),
            sum(not row["finite"] for row in rows),
            max(row["rise"] for row in rows),
            min(row["time"] for row in rows),
            result["seconds"][name],
        )
        for name in result["seconds"]
        if (rows := [row for row in result["rows"] if row["case"] == name])
    ]
    header = ("law", "columns", "not finite", "largest rise of energy", "least time / √(H/g)", "run time [s]")
    intro = (
        f"{result['steps']} steps of collapsing columns, E from 1e3 to 1e9 Pa, friction angles 0° to 60°, at half of "
        "`step.stable_dt(state, cfl=1)` (benchmarks/stability/collapse.py); energy relative to the first."
    )
    return "\n\n".join([intro, common.table(header, rows)])


def limits(result: dict[str, Any]) -> str:
    """Losses of the method."""
    intro = (
        "A disc that spins freely, a disc that bounces off a wall, blocks on an incline of 30°, and the gradient of "
        "R = U Vᵀ through `svd3` (benchmarks/accuracy/limits.py); consequences: docs/limitations.md."
    )
    return "\n\n".join([intro, *limit_tables(result).values(), f"- {common.describe(result['environment'])}"])


def adversarial(result: dict[str, Any]) -> str:
    """Random rollouts at the limit of the time step."""
    intro = (
        f"Random rollouts of {result['steps']} steps that are meant to invert particles, at up to three times the "
        "speed of sound (benchmarks/stability/adversarial.py), with dt = `step.stable_dt(state, cfl)` computed anew at "
        "every step: number of failures, by cfl.\nFlattened: the stretch of a particle fell below rounding "
        "error before its sign was lost, which a law of finite energy cannot prevent.\nEnergy: above 1.1 times the "
        "initial one in a closed system without FLIP."
    )
    parts = [intro, rollouts(result, "law")]
    return "\n\n".join([*parts, f"- {common.describe(result['environment'])}"])


def small_matrices(results: list[dict[str, Any]]) -> str:
    """Times of the decomposition and of the return map."""
    names = list(dict.fromkeys(row["name"] for result in results for row in result["times"]))
    header = ("ns per matrix", *(result["environment"]["device"] for result in results))
    times = [{row["name"]: row["ns"] for row in result["times"]} for result in results]
    intro = (
        "float32, 3-D, deformations I + 0.1 G with normally distributed G, the whole op; sand at a friction angle at "
        "which all branches occur."
    )
    notes = [f"- {common.describe(result['environment'])}" for result in results]
    rows = [[name, *(t.get(name) for t in times)] for name in names]
    return "\n".join([intro, "", common.table(header, rows), "", *notes])


def svd_accuracy(result: dict[str, Any]) -> str:
    """Errors of decompositions."""
    methods = list(result["rows"][0]["errors"])
    measures = ("singular values", "product")
    header = ("matrices", *(f"{m}: {measure}" for measure in measures for m in methods))
    rows = [
        [row["matrices"], *(row["errors"][m][measure][1] for measure in measures for m in methods)]
        for row in result["rows"]
    ]
    intro = (
        "float32, the largest over 20 thousand matrices of each kind: error of a singular value relative to itself, "
        "and of U diag(σ) Vᵀ relative to the largest singular value.\nMedians: benchmarks/results/svd_accuracy.md."
    )
    return "\n".join([intro, "", common.table(header, rows)])


def sand_accuracy(result: dict[str, Any]) -> str:
    """Errors of the return map."""
    header = ("case", "states on the cone", "error of h", "error over condition", "allowed", "wrong branches")
    rows = [
        (
            f"{row['energy']}, {row['flow']} flow, {name}", row[name]["on the cone"], row[name]["error"][2],
            row[name]["error over condition"][2], row[name]["allowed"], row[name]["wrong branches"],
        )
        for row in result["rows"]
        for name in ("float32", "float64")
    ]  # fmt: skip
    worst = max(row["reference against 50 digits"] for row in result["rows"])
    intro = (
        "The return map against extended precision (benchmarks/accuracy/sand.py): mean strains 1e-8 to 0.5, overshoot "
        "1e-3 to 1e4, all Lode angles, φ 1° to 60°, ν 0 to 0.49; largest errors.\nThe reference itself differs from 50 "
        f"digits by at most {worst:.0e} over the condition."
    )
    return "\n".join([intro, "", common.table(header, rows)])


def sand_gradient(result: dict[str, Any]) -> str:
    """Errors of the float32 gradients of the return map."""
    gaps = [case["gap"] for case in result["rows"][0]["gaps"]]
    others = ("of the usual norm, largest", "one unit of F, largest")
    rows = [
        (
            f"{row['energy']}, {row['flow']} flow, {row['result']}", *(case["largest"] for case in row["gaps"]),
            row["at rest"], *(max(case[name] for case in row["gaps"]) for name in others),
        )
        for row in result["rows"]
    ]  # fmt: skip
    states = sum(case["states"] for row in result["rows"] for case in row["gaps"])
    intro = (
        "float32 gradients of the new F and of the stress on the cone against float64 at the same F, by the gap of two "
        f"singular values: the largest relative error of {states / 1e6:.2g} million states with mean strains from "
        "1e-4 to 0.2 (benchmarks/accuracy/sand_gradient.py).\nThe last columns are the largest error over the usual "
        "norm of the gradient, and what one unit in the last place of F changes in the exact gradient."
    )
    header = ("gradient of", *(f"gap {gap:g}" for gap in gaps), "F = I", "usual norm", "one unit of F")
    return "\n".join([intro, "", common.table(header, rows)])


def heat(result: dict[str, Any]) -> str:
    """Errors of conduction and melting against analytic solutions."""
    forms = [("quadratic", name) for name in ("hybrid", "apic", "flip", "pic")] + [("cubic", "hybrid")]
    rows = []
    for problem in dict.fromkeys(case["problem"] for case in result["cases"]):
        cases = {(c["kernel"], c["transfer"]): c for c in result["cases"] if c["problem"] == problem}
        first = cases[forms[0]]
        row: list[Any] = [problem, first["number"], first["rows"][-1]["n"], first["rows"][-1]["seconds"]]
        for form in forms:
            case = cases.get(form)
            row.append(f"{case['rows'][-1]['error']:.1e} ({case['order']:.1f})" if case else None)
        rows.append(row)
    lost = result["float32"]
    intro = (
        "Relative error on the finest lattice, with the order over all in brackets (benchmarks/accuracy/heat.py): RMS "
        "of the temperature, position of the melting front; time of the hybrid [s].\n200 steps with a diffusion number "
        f"r = 1e-5 around 300 K in float32 lose {lost['relative to 300 K']:.1%} of the change, with temperatures "
        "relative to 300 K.\nErrors of the front below 1e-3 change sign with dx, so that an order fitted to them has "
        "little meaning."
    )
    header = ("problem", "r", "n", "run time [s]", *(f"{t}, cubic" if k == "cubic" else t for k, t in forms))
    figure = "![error over dx and over run time](benchmarks/results/heat.png)"
    return "\n".join([intro, "", common.table(header, rows), "", figure])


def heat_solve(result: dict[str, Any]) -> str:
    """Iterations and errors of the solve by method, diffusion number and contrast."""
    kinds = ("cg float64", "multigrid float64", "cg float32", "multigrid float32", "multigrid float32 refined")
    cells = {(row["r"], row["contrast"], heat_kind(row)): heat_cell(row) for row in result["rows"]}
    ends = [f(row["contrast"] for row in result["rows"]) for f in (min, max)]
    places = dict.fromkeys((row["r"], row["contrast"]) for row in result["rows"])
    places = [(r, contrast) for r, contrast in places if r >= 1 and contrast in ends]
    rows = [[f"{r:g}", f"{contrast:g}", *(cells.get((r, contrast, k)) for k in kinds)] for r, contrast in places]
    intro = (
        "Number of iterations, and relative RMS error against a direct solve (benchmarks/stability/heat.py), for "
        "64 × 64 cells.\nHalf of the cells conduct worse by the factor `contrast`.\nThe solve ends at 1e-10 (float32: "
        "1e-6) of the first residual.\nSmaller r and Chebyshev iteration: benchmarks/results/heat_stability.md."
    )
    return "\n\n".join([intro, common.table(("r", "contrast", *kinds), rows)])


def heat_step(result: dict[str, Any]) -> str:
    """Growth of a whole heat step."""
    intro = (
        f"The larger of ρ − 1 and ‖A‖ − 1, with the spectral radius ρ and the energy norm of a whole heat step A, "
        f"transfer there and back and exact solve, in {result['cases']} cases: jumps of κ or ρ C by up to 1e8, "
        "lattice, random and Poisson-disc layouts of 1 to 16 particles per cell, 2-D and 3-D, both kernels, insulated, "
        "held and exchanging (benchmarks/stability/heat_step.py)."
    )
    return "\n\n".join([intro, heat_step_table(result)])


def heat_speed(results: list[dict[str, Any]]) -> str:
    """Times of the heat solve compared with transfers and assembled matrices."""
    header = ("device", "particles", "scalar P2G [ms]", "G2P [ms]", "iteration [ms]", "peer", "peer's time")
    rows = []
    for result in results:
        one = result["one"]
        parts = [one[k] for k in ("p2g", "g2p", "iteration")]
        rows += [
            [result["environment"]["device"], f"{one['particles'] / 1e6:.3g} M", *parts]
            + [f"{peer['peer']}, {peer['count']} iterations", _ratio(peer["peer_ms"], peer["ms"])]
            for peer in result["peers"]
        ]
    large = [
        [result["environment"]["device"], f"{row['r']:g}", row["cg"], row["cg iterations"], row["multigrid"]]
        + [row["multigrid iterations"]]
        for result in results
        for row in result.get("large", [])
    ]
    intro = (
        "3-D, float32, quadratic kernel, 8 particles per cell (benchmarks/speed/heat.py).\nThe peer's matrix is "
        "assembled beforehand; on the CPU its time includes the assembly."
    )
    parts = [intro, common.table(header, rows)]
    if large:
        header = ("device", "r", "conjugate gradients [ms]", "iterations", "multigrid [ms]", "iterations")
        parts += ["Whole solves to 1e-6 of the first residual:", common.table(header, large)]
    parts.append("\n".join(f"- {common.describe(result['environment'])}" for result in results))
    return "\n\n".join(parts)


def thermal_speed(results: list[dict[str, Any]]) -> str:
    """Times of steps with heat, laws of temperature, hardening, and time steps that follow the limit."""
    intro = (
        "3-D, float32, quadratic kernel, 8 particles per cell, one call of `rollout`; each row beside another of the "
        "same run (benchmarks/speed/thermal.py)."
    )
    parts = [intro]
    for result in results:
        parts += [common.describe(result["environment"]) + ":", thermal.table(result)]
        parts += filter(None, ["\n".join(thermal.notes(result))])
        parts += [heat_kernels.text(entry) for entry in result.get("sizes", ())]
    if any("sizes" in result for result in results):
        parts += ["![bytes per second of each kernel, and of a copy](benchmarks/results/heat_roofline.png)"]
    return "\n\n".join(parts)


def accuracy(directory: Path) -> str:
    """One error of each part of the library that has results."""
    parts = {
        "convergence": _motion_errors,
        "ritter": _front_errors,
        "heat": _conduction_errors,
        "precision": _rounding_errors,
        "svd_accuracy": _decomposition_errors,
        "sand_accuracy": _return_map_errors,
        "sand_gradient": _gradient_errors,
    }
    rows = []
    for name, part in parts.items():
        if (file := directory / f"{name}.json").exists():
            result = json.loads(file.read_text())
            for *row, seconds in part(result):
                rows.append([*row, seconds and f"{seconds:.3g} s, {result['environment']['device']}"])
    header = ("quantity", "compared with", "error", "order in dx", "run time")
    intro = (
        "Errors are relative unless stated otherwise: on the finest lattice (solutions), or the largest (functions)."
    )
    return "\n".join([intro, "", common.table(header, rows)])


Row = tuple[str, str, Any, str | None, float | None]


def _motion_errors(result: dict[str, Any]) -> Iterator[Row]:
    for case in result["cases"]:
        if case["name"].endswith("cubic, mls, mirror walls"):
            last, order = case["rows"][-1], f"{case['order']['displacement']:.2f}"
            what = f"motion of an elastic body, {case['dim']}-D, {last['n']} cells"
            yield what, "manufactured solution", last["displacement"], order, last["seconds"]


def _front_errors(result: dict[str, Any]) -> Iterator[Row]:
    (case,) = (case for case in result["cases"] if case["name"] == "h0/dx = 32")
    late = [row["error"] for row in case["rows"] if row["time"] >= result["judged"] - 1e-9]
    worst = max(abs(e) for row in late for level, e in row.items() if float(level) >= 0.02 and e is not None)
    yield "dam break, fronts of 2% of the depth and more", "Ritter 1892", worst, None, case["seconds"]


def _conduction_errors(result: dict[str, Any]) -> Iterator[Row]:
    for problem in ("heated bar", "melting front, St = 0.5"):
        for case in result["cases"]:
            if (case["problem"], case["kernel"], case["transfer"]) == (problem, "quadratic", "hybrid"):
                last = case["rows"][-1]
                yield problem, "exact solution", last["error"], f"{case['order']:.1f}", last["seconds"]


def _rounding_errors(result: dict[str, Any]) -> Iterator[Row]:
    lattice = result["lattices"][-1]
    what = f"position after {lattice['steps']} steps in float32, in units of dx"
    yield what, "float64", lattice["rows"][-1]["position"], None, lattice["float32_seconds"]


def _decomposition_errors(result: dict[str, Any]) -> Iterator[Row]:
    worst = max(row["errors"]["svd3"]["product"][1] for row in result["rows"])
    yield "`svd3` in float32: U diag(σ) Vᵀ", "the matrix", worst, None, None


def _return_map_errors(result: dict[str, Any]) -> Iterator[Row]:
    worst = max(row["float32"]["error over condition"][2] for row in result["rows"])
    yield "return map of sand in float32, over the condition number", "extended precision", worst, None, None


def _gradient_errors(result: dict[str, Any]) -> Iterator[Row]:
    worst = max(case["largest"] for row in result["rows"] for case in row["gaps"])
    yield "gradients of the return map in float32", "float64", worst, None, None


def overview(directory: Path) -> str:
    """The two tables of the README."""
    results = common.read(directory, "speed_*.json")
    return "\n\n".join([*(["### Speed", speed_table(results)] if results else []), "### Accuracy", accuracy(directory)])


def sections(directory: Path) -> dict[str, str]:
    """All sections for which there are results, by title."""
    found = {}
    for pattern, title, section in (
        ("speed_*.json", "Speed", speed),
        ("rollouts_*.json", "Speed of rollouts and scenes", as_run),
        ("training_*.json", "Training", training),
        ("doors_*.json", "Interfaces of other simulators", interfaces),
        ("datasets_*.json", "Data sets", data_sets),
        ("svd_*_*.json", "Small matrices and sand", small_matrices),
        ("heat_*_*.json", "Speed of the heat solve", heat_speed),
        ("thermal_*.json", "Speed of steps with heat", thermal_speed),
    ):
        if results := common.read(directory, pattern):
            found[title] = section(results)
    for name, title, section_of_one in (
        ("convergence", "Convergence", convergence),
        ("ritter", "Dam break", dam_break),
        ("heat", "Heat", heat),
        ("heat_stability", "Heat solve", heat_solve),
        ("stability_heat_step", "Heat step", heat_step),
        ("precision", "Precision", precision),
        ("stability", "Stability", stability),
        ("stability_laws", "Stability of every law", stability_laws),
        ("adversarial", "Stability of random rollouts", adversarial),
        ("limits", "Losses of the method", limits),
        ("svd_accuracy", "Singular values", svd_accuracy),
        ("sand_accuracy", "Sand: return map", sand_accuracy),
        ("sand_gradient", "Sand: gradients", sand_gradient),
        ("runout", "Sand: run-out of columns", runout),
        ("collapse", "Sand: long runs", collapse),
    ):
        if (file := directory / f"{name}.json").exists():
            found[title] = section_of_one(json.loads(file.read_text()))
    return found


def draw(directory: Path) -> None:
    """The figures of several devices."""
    for name, pattern, plot in (
        ("roofline", "speed_*.json", roofline.plot),
        ("heat_roofline", "thermal_*.json", roofline.plot),
        ("rollouts", "rollouts_*.json", scaling.plot),
    ):
        if results := common.read(directory, pattern):
            plot(results, directory / f"{name}.png")


def documents(directory: Path) -> dict[Path, str]:
    """The text between the marks of each document."""
    details = "\n\n".join(f"### {title}\n\n{text}" for title, text in sections(directory).items())
    measured = details.replace("](benchmarks/", "](../benchmarks/")
    costs = implicit_costs(common.read(directory, "implicit_cost_*.json"))
    by_ppo = learning(common.read(directory, "envs_ppo_*.json"))
    pages = {README: overview(directory), MEASURED: measured, IMPLICIT: costs, ENVS: by_ppo}
    return pages | migrating(directory)


def insert(text: str, tables: str) -> str:
    """A document with the tables between its marks.

    Raises:
        ValueError: where the marks are missing.
    """
    pattern = re.compile(f"{BEGIN}.*?{END}", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"the document needs the lines {BEGIN} and {END}")
    return pattern.sub(lambda _: f"{BEGIN}\n{tables}\n{END}", text, count=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=common.RESULTS)
    parser.add_argument("--write", action="store_true", help="update the documents")
    arguments = parser.parse_args()
    for document, tables in documents(arguments.results).items():
        print(tables)
        if arguments.write:
            document.write_text(insert(document.read_text(), tables))
    if arguments.write:
        draw(arguments.results)


if __name__ == "__main__":
    main()
