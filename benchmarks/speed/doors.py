"""Times of a substep through the interfaces of other simulators, beside `torch_mpm.rollout` of the same step:

    python -m benchmarks.speed.doors                       # CPU, 10 648 particles
    python -m benchmarks.speed.doors --device cuda         # 97 336 particles
    python -m benchmarks.speed.doors --quick               # seconds

A fixed corotated cube that has just begun to fall. Each interface is called as its own programs do: frames of 100
substeps, or one call of the solver and of its law per substep. Without gradients. `rollout` has no `eps` of NCLaw.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.compat import mpm_pytorch, nclaw, taichi_elements
from torch_mpm.compat.physgaussian import MPM_Simulator_WARP
from torch_mpm.compat.warp_mpm import MPMModelStruct, MPMStateStruct, MPMWARPDiff

from .. import common, regressions
from .rollouts import least

FRAME = 100
"""Substeps between two reads of the positions."""
SIDE = {"cpu": 22, "cuda": 46}
E, NU, DENSITY, GRAVITY = 1e5, 0.3, 1000.0, (0.0, -1.0, 0.0)
DT = 1e-5
"""A time step [s] in which the cube falls by few cells in all frames."""
SAMPLES = 3
"""Least number of measured frames."""

Frame = Callable[[], object]
"""Computes FRAME substeps."""


def cube(side: int, device: str) -> tuple[int, Tensor, float]:
    """Cells along an edge of the unit domain, positions [P, 3] of side³ particles, 8 per cell, and their volume."""
    n = side + 16
    axis = (n / 2 - side / 4 + 0.5 * (torch.arange(side) + 0.5)) / n
    x = torch.cartesian_prod(axis, axis, axis).to(torch.float32)
    return n, x.to(device), (0.5 / n) ** 3


def plain(side: int, device: str, damping: float = 1.0, **options: Any) -> Frame:
    """`torch_mpm.rollout`."""
    n, x, volume = cube(side, device)
    points = mpm.seed.Points(x, torch.full((len(x),), volume, device=device))
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float32, device=device)
    law = mpm.FixedCorotated(E=E, nu=NU)
    boundaries: list[Any] = [] if damping == 1 else [mpm.boundaries.Damping(damping)]
    step = mpm.Step(mpm.Grid(1 / n, (0.0,) * 3, (1.0,) * 3), law, GRAVITY, boundaries=boundaries, **options)
    return lambda: mpm.rollout(step, state, FRAME, DT)


def physgaussian(side: int, device: str, damping: float = 1.0, impulse: bool = False) -> Frame:
    n, x, volume = cube(side, device)
    sim = MPM_Simulator_WARP(10, device=device)
    sim.load_initial_data_from_torch(x, torch.full((len(x),), volume, device=device), n_grid=n)
    given = {"material": "jelly", "E": E, "nu": NU, "density": DENSITY, "g": list(GRAVITY)}
    sim.set_parameters_dict(given | {"grid_v_damping_scale": damping})
    if impulse:
        sim.add_impulse_on_particles([0.0, 0.1, 0.0], DT, num_dt=1)
    sim.finalize_mu_lam()

    def frame() -> Tensor:
        for k in range(FRAME):
            sim.p2g2p(k, DT)
        return sim.export_particle_x_to_torch()

    return frame


def warp_mpm(side: int, device: str) -> Frame:
    n, x, volume = cube(side, device)
    state, model, solver = MPMStateStruct(), MPMModelStruct(), MPMWARPDiff(len(x), n_grid=n, device=device)
    state.init(len(x), device=device)
    state.from_torch(x, torch.full((len(x),), volume, device=device), None, 0 * x, n_grid=n, device=device)
    model.init(len(x), device=device)
    model.init_other_params(n_grid=n, device=device)
    solver.set_parameters_dict(model, state, {"material": "jelly", "density": DENSITY, "g": list(GRAVITY)})
    solver.set_E_nu(model, torch.tensor(E, device=device), torch.tensor(NU, device=device))
    solver.prepare_mu_lam(model, state)

    def frame() -> Tensor:
        solver.rollout(model, state, state, FRAME, DT)
        return state.particle_x

    return frame


def taichi(side: int, device: str) -> Frame:
    n, x, _ = cube(side, device)
    solver = taichi_elements.MPMSolver((n,) * 3, E_scale=0.1, device=device)
    solver.set_gravity((0.0,) * 3)  # its own time step is long
    solver.add_particles(x.cpu().numpy(), solver.material_elastic)
    length = (FRAME - 0.5) * solver.default_dt

    def frame() -> object:
        solver.step(length)
        return solver.state

    return frame


def of_nclaw(side: int, device: str, eps: float = 0.0) -> Frame:
    n, x, volume = cube(side, device)
    shape = {"num_grids": n, "dt": DT, "bound": 3, "gravity": list(GRAVITY), "bc": "freeslip", "eps": eps}
    model = nclaw.sim.MPMModelBuilder().parse_cfg(shape).finalize(device)
    statics = model.statics(len(x))
    statics.vol, statics.rho = x.new_full((len(x),), volume), x.new_full((len(x),), DENSITY)
    statics.clip_bound = x.new_full((len(x),), 0.5)
    statics.enabled = torch.ones(len(x), dtype=torch.int32, device=device)
    law = nclaw.material.CorotatedElasticity({"E": E, "nu": NU}).to(device).requires_grad_(False)
    solver = nclaw.sim.MPMDiffSim(model)
    return stepwise(lambda x, v, C, F: solver(statics, x, v, C, F, law(F)), x)


def law_alone(side: int, device: str) -> Frame:
    """The part of a frame of NCLaw that is no substep: its law, which is a program of torch operations."""
    F = torch.eye(3, device=device).expand(side**3, 3, 3).contiguous()
    law = nclaw.material.CorotatedElasticity({"E": E, "nu": NU}).to(device).requires_grad_(False)

    def frame() -> Tensor:
        for _ in range(FRAME):
            stress = law(F)
        return stress

    return frame


def of_mpm_pytorch(side: int, device: str) -> Frame:
    n, x, volume = cube(side, device)
    solver = mpm_pytorch.MPMSolver(x, num_grids=n, dt=DT, gravity=GRAVITY, rho=DENSITY, device=device)
    solver.vol, solver.p_mass = volume, DENSITY * volume
    law = mpm_pytorch.get_constitutive("CorotatedElasticity", device=device)
    return stepwise(lambda x, v, C, F: solver(x, v, C, F, law(F)), x)


def stepwise(one: Callable[..., tuple[Tensor, ...]], x: Tensor) -> Frame:
    """FRAME calls of a function of x, v, C and F."""
    zero = x.new_zeros(len(x), 3, 3)
    particles: tuple[Tensor, ...] = (x, 0 * x, zero, torch.eye(3, device=x.device).expand_as(zero).contiguous())

    def frame() -> Tensor:
        nonlocal particles
        for _ in range(FRAME):
            particles = one(*particles)
        return particles[0]

    return frame


DAMPED = 0.9999
Make = Callable[[int, str], Frame]
PAIRS: dict[str, tuple[Make, Make]] = {
    "PhysGaussian": (physgaussian, plain),
    "PhysGaussian, damped": (
        lambda side, device: physgaussian(side, device, DAMPED),
        lambda side, device: plain(side, device, damping=DAMPED),
    ),
    "PhysGaussian, after an impulse": (lambda side, device: physgaussian(side, device, impulse=True), plain),
    "MPMWARPDiff": (warp_mpm, plain),
    "taichi_elements": (taichi, lambda side, device: plain(side, device, stress_form="mls")),
    "NCLaw": (of_nclaw, lambda side, device: plain(side, device, stress_form="mls", walls="separate")),
    "NCLaw, eps 1e-7": (
        lambda side, device: of_nclaw(side, device, 1e-7),
        lambda side, device: plain(side, device, stress_form="mls", walls="separate"),
    ),
    "the law of NCLaw alone": (
        law_alone,
        lambda side, device: plain(side, device, stress_form="mls", walls="separate"),
    ),
    "MPM-PyTorch": (of_mpm_pytorch, plain),
}
"""Interfaces by name, and the rollout with the same options."""


def microseconds(frame: Frame, device: str) -> float:
    """Least time of a substep [us], after a frame of warming up."""
    frame()
    return 1e6 / FRAME * least(device, frame, SAMPLES)


@torch.no_grad()
def measure(device: str, side: int) -> dict[str, Any]:
    result: dict[str, Any] = {"environment": common.environment(device), "particles": side**3, "rows": []}
    for name, (door, beside) in PAIRS.items():
        own, rollout = (microseconds(make(side, device), device) for make in (door, beside))
        result["rows"].append({"name": name, "us": own, "rollout": rollout})
        print(common.table(HEADER, [row_of(result["rows"][-1])]).splitlines()[-1], flush=True)
    return result


HEADER = ("interface", "us a substep", "rollout, us", "times")


def row_of(r: dict[str, Any]) -> tuple[Any, ...]:
    return r["name"], r["us"], r["rollout"], r["us"] / r["rollout"]


def text(result: dict[str, Any]) -> str:
    place = f"{common.describe(result['environment'])} {result['particles']} particles, float32, without gradients."
    table = common.table(HEADER, [row_of(r) for r in result["rows"]])
    return "\n".join(["# Interfaces of other simulators beside rollout", "", place, "", table, ""])


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Microseconds of a substep, for `regressions`."""
    for r in result["rows"]:
        yield r["name"], r["us"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="few particles, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    options = parser.parse_args()
    result = measure(options.device, 8 if options.quick else SIDE[options.device])
    name = f"doors_{common.slug(result['environment']['device'])}"
    if not options.quick:
        regressions.show(name, result, timed)
    common.write(options.out, name, result, text(result))


if __name__ == "__main__":
    main()
