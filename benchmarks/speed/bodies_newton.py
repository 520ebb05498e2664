"""Environment steps per second of water in a cup beside a glass, by torch_mpm and by Newton's coupled solver.

    python -m benchmarks.speed.bodies_newton --of torch_mpm [--device cuda]
    python -m benchmarks.speed.bodies_newton --of newton [--device cuda]        # with the packages newton and warp-lang

735 particles of water rest in a cup that swings on a hinge, and beside it a glass slides along an axis, in 3-D: two
round bodies that the water moves and that move the water. There are 2048 such worlds on CUDA, and 2 on the
CPU. An environment step is 0.01 s of all of them, as in Newton's example of a coupled MPM solver. Times are by the wall
clock over several steps, with one wait for the device.

torch_mpm: `FreeBodies`, water of a finite speed of sound, explicit steps of at most a fraction of the stable time step
("cfl"), one native op for a call. The velocities of the bodies are solved for together with the contact of the nodes.

Newton (1.8): `SolverCoupledProxy` with `SolverImplicitMPM` and a solver of rigid bodies, as in its example
`mujoco_mpm_coupled_solver`: one implicit step of incompressible water of at most 50 iterations, four steps of the rigid
bodies, and forces on the bodies that lag by a step; water as in its example `water_dam_break`; the worlds are separate.
On CUDA a step is one CUDA graph, as in the examples. The rigid solver is MuJoCo Warp where it is installed, and XPBD
otherwise. On the CPU the grid is dense, since sparse grids of separate worlds need CUDA.

What differs: Newton's water is incompressible and its steps are implicit, so that it needs one step where torch_mpm
needs 7 to 24; its kernels are linear and those of torch_mpm quadratic, with 8 and 27 nodes per particle; it solves
the bodies and the water one after another, torch_mpm together. Bodies meet the water alone, not each other. Particles,
geometry, masses, joints, gravity, cell width and the time of a step are the same.

The error of a row is how far the mean height of the water, which comes to rest, is above that of incompressible water
at rest in the cup, in cells.
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torch_mpm as mpm
from torch_mpm.bodies import Body, FreeBodies, Hinge, Slider

from .. import common

DX, THICK = 0.03, 0.12
"""Width of a cell, and thickness of the walls, four cells [m]."""
RADIUS, DEPTH = 0.075, 0.3
"""Of the inside of the cup and of the glass, which are round [m]."""
COUNTS, SPACING = (7, 7, 15), 0.015
"""Particles of the water along each axis, 735, and their spacing [m]."""
CUP, GLASS, ANCHOR = (0.4, 0.3, 0.5), (1.0, 0.3, 0.2), (0.4, 0.3, 0.9)
"""Middles of the bottoms inside of the cup and the glass, and a point on the hinge of the cup, whose axis is y [m]."""
UPPER = (1.4, 0.6, 1.2)
"""Domain from the origin [m]."""
MASS, INERTIA, DENSITY, GRAVITY, FRICTION = 8.0, 0.2, 1000.0, 9.81, 0.1
"""Of the bodies [kg, kg m²] and of the water [kg/m³], and friction at the walls of the bodies."""
CELLS, BLOCKS = 512, 32
"""Active cells of a world for which Newton reserves memory on CUDA, and blocks of 64 cells for which torch_mpm does, so
that no step waits for their number; the water has some 130 cells, in 18 blocks with those around it."""
FRAME = 0.01
"""Time of an environment step [s]."""
CFL = (0.25, 0.5, 0.9)
"""Fractions of the stable time step; it is the limit of all rollouts of the stability benchmark."""
Run = Callable[[int], None]


def vessel() -> mpm.shapes.Revolved:
    """The cup or the glass around its axis z, from the middle of its bottom inside."""
    inner, outer = RADIUS, RADIUS + THICK
    outline = [(0.0, -THICK), (outer, -THICK), (outer, DEPTH), (inner, DEPTH), (inner, 0.0), (0.0, 0.0)]
    return mpm.shapes.Revolved(outline, (0.0, 0.0, 1.0))


def water() -> torch.Tensor:
    """Positions of the particles [735, 3] [m]."""
    axes = [SPACING * (torch.arange(n) + 0.5) for n in COUNTS]
    corner = torch.tensor(CUP) - torch.tensor([0.5 * n * SPACING for n in COUNTS[:2]] + [0.0])
    return torch.cartesian_prod(*axes) + corner


def level() -> float:
    """Mean height of the water at rest [m]."""
    volume = math.prod(COUNTS) * SPACING**3
    return CUP[2] + 0.5 * volume / (math.pi * RADIUS**2)


def of_torch_mpm(worlds: int, device: str, cfl: float = 0.5) -> tuple[Run, Callable[[], dict[str, float]]]:
    """Advances by a number of environment steps; heights [m] for a comparison."""
    grid = mpm.Grid(DX, (0.0, 0.0, 0.0), UPPER, scenes=worlds, max_blocks=BLOCKS * worlds)
    step = mpm.Step(grid, mpm.WeaklyCompressible(bulk_modulus=1e5), (0.0, 0.0, -GRAVITY), "separate")
    x = water()
    volume = torch.full((len(x),), SPACING**3)
    one = mpm.State(x=x, v=torch.zeros_like(x), volume=volume, mass=DENSITY * volume).to(device)
    state = mpm.State.concatenate([one] * worlds, scene=True)

    joints = Hinge(ANCHOR, (0.0, 1.0, 0.0)), Slider((1.0, 0.0, 0.0))
    solids = [mpm.Obstacle(vessel(), (0.0, 0.0, 0.0), "separate", FRICTION) for _ in joints]
    bodies = FreeBodies(
        step, [Body(solid, MASS, INERTIA, joint=joint) for solid, joint in zip(solids, joints, strict=True)]
    )
    first = [[*place, 1.0, *9 * [0.0]] for place in (CUP, GLASS)]
    rows = torch.tensor([first] * worlds, dtype=torch.float64, device=device)
    substeps = math.ceil(FRAME / float(step.stable_dt(state, cfl).min()))
    print(f"{substeps} substeps in a step")
    now = [state, rows]

    @torch.no_grad()
    def run(n: int) -> None:
        for _ in range(n):
            now[0], now[1] = bodies.advance(now[0], now[1], substeps, FRAME / substeps)

    def found() -> dict[str, float]:
        bodies.check()
        step.check(now[0])
        return {"water": float(now[0].x[:, 2].mean()), "cup": float(now[1][:, 0, 2].mean())}

    return run, found


def of_newton(worlds: int, device: str, rigid: str) -> tuple[Run, Callable[[], dict[str, float]]]:
    """As `of_torch_mpm`."""
    import warp as wp

    wp.config.enable_backward = False  # Kernels for gradients take minutes to compile.
    wp.set_device("cuda:0" if device == "cuda" else "cpu")
    import newton

    model = _newton_model(worlds)
    solver, state, control = _newton_solver(model, worlds, device, rigid), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    print(f"newton {newton.__version__}, warp {wp.__version__}, rigid bodies by {rigid}")

    def step() -> None:
        state.clear_forces()
        solver.step(state, state, control, None, FRAME)

    launch: Callable[[], object] = step
    if device == "cuda":
        step()  # which compiles the kernels
        try:
            with wp.ScopedCapture() as capture:
                step()
            launch = functools.partial(wp.capture_launch, capture.graph)
        except RuntimeError as error:
            print(f"steps are no CUDA graph: {error}")

    def run(n: int) -> None:
        for _ in range(n):
            launch()
        wp.synchronize()

    def found() -> dict[str, float]:
        solver.solver("mpm").check_sparse_grid_rebuild_status()
        cups = state.body_q.numpy()[::2, 2]
        return {"water": float(state.particle_q.numpy()[:, 2].mean()), "cup": float(cups.mean())}

    return run, found


def _newton_model(worlds: int) -> Any:
    """Worlds with the cup on its hinge, the glass on its axis, and the water."""
    import newton
    import warp as wp
    from newton.solvers import SolverImplicitMPM

    def builder() -> Any:
        made = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
        SolverImplicitMPM.register_custom_attributes(made)
        return made

    def place(at: Sequence[float]) -> Any:
        return wp.transform(wp.vec3(*at))

    world, wall = builder(), newton.ModelBuilder.ShapeConfig(density=0.0, mu=FRICTION, has_shape_collision=False)
    inertia = wp.mat33(*(INERTIA * torch.eye(3)).flatten().tolist())
    cup, glass = (world.add_link(mass=MASS, inertia=inertia) for _ in range(2))
    (surface,) = vessel().mesh(np.zeros(3), np.array(UPPER))
    mesh = newton.Mesh(surface.vertices, surface.faces.flatten(), compute_inertia=False)
    for link in (cup, glass):
        world.add_shape_mesh(link, mesh=mesh, cfg=wall)
    arm = place([a - b for a, b in zip(ANCHOR, CUP, strict=True)])
    axes = wp.vec3(0.0, 1.0, 0.0), wp.vec3(1.0, 0.0, 0.0)
    world.add_articulation(
        [world.add_joint_revolute(-1, cup, parent_xform=place(ANCHOR), child_xform=arm, axis=axes[0])]
    )
    world.add_articulation([world.add_joint_prismatic(-1, glass, parent_xform=place(GLASS), axis=axes[1])])
    for x in water().tolist():
        world.add_particle(wp.vec3(*x), wp.vec3(0.0), DENSITY * SPACING**3, radius=0.5 * SPACING)
    every = builder()
    every.replicate(world, worlds)
    model = every.finalize()
    for name, value in {"friction": 0.0, "tensile_yield_ratio": 1.0, "viscosity": 0.0}.items():
        getattr(model.mpm, name).fill_(value)
    return model


def _newton_solver(model: Any, worlds: int, device: str, rigid: str) -> Any:
    """The coupled solver."""
    from newton.solvers import SolverImplicitMPM, SolverMuJoCo, SolverXPBD
    from newton.solvers.experimental.coupled import SolverCoupledProxy

    config = SolverImplicitMPM.Config()
    config.voxel_size, config.max_iterations, config.tolerance = DX, 50, 1e-3
    config.warmstart_mode, config.strain_basis, config.collider_basis = "particles", "P0", "pic8"
    config.separate_worlds = worlds > 1
    if device == "cuda":
        config.max_active_cell_count = CELLS * worlds  # of a sparse grid, which a CUDA graph rebuilds in place
    else:
        config.grid_type = "dense"  # Sparse grids of separate worlds exist on CUDA alone.

    def of_bodies(view: Any) -> Any:
        return SolverMuJoCo(view, njmax=100) if rigid == "mujoco" else SolverXPBD(view)

    entry, proxy = SolverCoupledProxy.Entry, SolverCoupledProxy.Proxy
    bodies, joints, particles = (list(range(n)) for n in (model.body_count, model.joint_count, model.particle_count))
    return SolverCoupledProxy(
        model=model,
        entries=[
            entry(name="rigid", solver=of_bodies, bodies=bodies, joints=joints, substeps=4),
            entry(
                name="mpm",
                solver=lambda view: SolverImplicitMPM(model=view, config=config),
                particles=particles,
                in_place=True,
            ),
        ],
        coupling=SolverCoupledProxy.Config(
            proxies=[
                proxy(
                    source="rigid",
                    destination="mpm",
                    bodies=bodies,
                    mode="lagged",
                    collision_pipeline=lambda _: None,
                )
            ],
            iterations=1,
        ),
    )


def text(result: dict[str, Any]) -> str:
    rows = [
        [
            row["of"],
            row["cfl"] or "implicit",
            f"{row['ms']:.4g}",
            f"{row['rate']:.4g}",
            row["steps"],
            f"{row['error']:+.2f}",
            f"{row['found']['cup']:.6f}",
        ]
        for row in result["rows"]
    ]
    head = ["of", "cfl", "a step of all [ms]", "steps/s of a world", "after steps", "error [cells]", "cup [m]"]
    title = f"# Cup and glass beside Newton\n\n{common.describe(result['environment'])}\n\n"
    return f"{title}{result['worlds']} worlds.\n\n" + common.table(head, rows) + "\n"


def measured(made: Callable[[], tuple[Run, Callable[[], dict[str, float]]]], steps: int, cuda: bool) -> dict[str, Any]:
    """Time of a step [ms], and what is found after the steps."""
    begin = time.perf_counter()
    run, found = made()

    def timed() -> float:
        start = time.perf_counter()
        run(steps)
        if cuda:
            torch.cuda.synchronize()
        return time.perf_counter() - start

    timed()
    print(f"{time.perf_counter() - begin:.0f} s to prepare, then {found()}")
    seconds = min(timed() for _ in range(3))
    last = found()
    return {
        "ms": 1e3 * seconds / steps,
        "steps": 4 * steps,
        "error": (last["water"] - level()) / DX,
        "found": last,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--of", choices=["torch_mpm", "newton"], required=True)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--worlds", type=int, help="number of worlds")
    rigid = "mujoco" if find_spec("mujoco_warp") else "xpbd"
    parser.add_argument("--rigid", choices=["mujoco", "xpbd"], default=rigid, help="rigid solver of Newton")
    parser.add_argument("--steps", type=int, default=20, help="environment steps of a measurement")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    device, cuda = arguments.device, arguments.device == "cuda"
    worlds = arguments.worlds or (2048 if cuda else 2)
    rows = []
    for cfl in CFL if arguments.of == "torch_mpm" else (None,):

        def made(cfl: float | None = cfl) -> tuple[Run, Callable[[], dict[str, float]]]:
            return of_newton(worlds, device, arguments.rigid) if cfl is None else of_torch_mpm(worlds, device, cfl)

        row = measured(made, arguments.steps, cuda)
        rows.append({"of": arguments.of, "cfl": cfl, "rate": 1e3 * worlds / row["ms"]} | row)
    environment = common.environment(device)
    result = {"environment": environment, "worlds": worlds, "rows": rows}
    print(text(result))
    common.write(arguments.out, f"bodies_{arguments.of}_{common.slug(environment['device'])}", result, text(result))


if __name__ == "__main__":
    main()
