"""A MuJoCo gripper of two sliding fingers lifts a soft cube; with too little friction the cube slips out.

The fingers press with a force F each, so that the cube slides where its weight exceeds 2 μ F.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch

import torch_mpm as mpm
from torch_mpm import render
from torch_mpm.bodies import MujocoCoupling

GRIPPER = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 1" pos="0 0 0.1" friction="0.5"/>
    <body name="hand" pos="0.3 0.2 0.3" gravcomp="1">
      <joint name="lift" type="slide" axis="0 0 1" damping="5"/>
      <geom type="box" size="0.2 0.03 0.02" mass="1" contype="0" conaffinity="0"/>
      <body name="left" pos="-0.16 0 -0.12" gravcomp="1">
        <joint name="left" type="slide" axis="1 0 0" damping="5"/>
        <geom name="left" type="box" size="0.06 0.05 0.05" mass="0.5"/>
      </body>
      <body name="right" pos="0.16 0 -0.12" gravcomp="1">
        <joint name="right" type="slide" axis="-1 0 0" damping="5"/>
        <geom name="right" type="box" size="0.06 0.05 0.05" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="lift" joint="lift" kp="4000" dampratio="1"/>
    <motor name="left" joint="left"/>
    <motor name="right" joint="right"/>
  </actuator>
</mujoco>
"""
FINGERS = "left", "right"
FORCE = 30.0  # of each finger [N]
SIDE, DENSITY, GRAVITY = 0.12, 1000.0, 9.81  # of the cube [m], [kg/m³], and [m/s²]
CLOSED, LIFTED, HEIGHT = (
    0.3,
    0.8,
    0.12,
)  # times at which the fingers have closed and the hand is up [s], and how far [m]
LOWER, UPPER = (0.0, 0.0, 0.06), (0.6, 0.4, 0.5)  # of the domain [m]
TABLE, FINGER = 0.1, (0.12, 0.1, 0.1)  # height of the table, and size of a finger [m]
VIEW = (0.1, 0.1, 0.08), (0.5, 0.3, 0.38)  # of the pictures [m]
FRICTIONS = 0.5, 0.2  # the cube is held, and slips out


def scene(friction: float, dx: float, device: str) -> tuple[MujocoCoupling, mpm.State]:
    """The gripper above a cube that lies on the table."""
    grid = mpm.Grid(dx, LOWER, UPPER)
    step = mpm.Step(grid, mpm.NeoHookean(E=5e4, nu=0.3), (0.0, 0.0, -GRAVITY), transfer="pic", flip=0.9)
    low = (0.3 - 0.5 * SIDE, 0.2 - 0.5 * SIDE, TABLE)
    points = mpm.seed.box(low, [a + SIDE for a in low], grid, per_cell=8)
    model = mujoco.MjModel.from_xml_string(GRIPPER)
    coupling = mpm.couple(model, step, [*FINGERS, "world"])
    for name in FINGERS:
        coupling.obstacles[name].friction = friction
    return coupling, mpm.State.at_rest(points, DENSITY, device=device)


def command(seconds: float) -> Sequence[float]:
    """Height of the hand above its first one [m], and forces of the fingers [N]."""
    share = min(max((seconds - CLOSED) / (LIFTED - CLOSED), 0.0), 1.0)
    return HEIGHT * share**2 * (3 - 2 * share), FORCE, FORCE


def grasp(friction: float, dx: float = 0.02, seconds: float = 1.2, device: str = "cpu") -> dict[str, list]:
    """Lift the cube, and return times [s], heights above the first ones [m], the force that lifts the cube [N], and
    frames: positions of the particles, and centres of the fingers by name."""
    coupling, state = scene(friction, dx, device)
    (data,) = coupling.data
    found: dict[str, list] = {"time": [], "cube": [], "hand": [], "lift": [], "frames": []}
    every, n = 10, round(seconds / coupling.model.opt.timestep)
    first = float(state.x[:, 2].mean())
    for k in range(n):
        data.ctrl[:] = command(data.time)
        state = coupling.advance(state)
        if k % every == every - 1:
            found["time"].append(data.time)
            found["cube"].append(float(state.x[:, 2].mean()) - first)
            found["hand"].append(float(data.joint("lift").qpos[0]))
            found["lift"].append(-float(coupling.wrenches[0, : len(FINGERS), 2].sum()))
            found["frames"].append((state.x.cpu(), [data.geom(name).xpos.copy() for name in FINGERS]))
    coupling.step.check(state)
    return found


def draw(runs: dict[float, dict[str, list]], out: Path) -> None:
    """A video of each run, and a picture with times of both."""
    bounds = (LOWER[0], LOWER[1], TABLE), UPPER
    finger = render.shapes.box((0.0, 0.0, 0.0), FINGER)
    images = []
    with render.Renderer(bounds, (640, 480), None, gravity=(0.0, 0.0, -1.0), azimuth=20.0, view=VIEW) as renderer:
        for friction, run in runs.items():
            with render.VideoWriter(out / f"gripper_{friction:g}.mp4", fps=25) as video:
                frames = [
                    renderer.frame(x, obstacles=[finger.posed(at, np.eye(3)) for at in fingers], time=seconds)
                    for (x, fingers), seconds in zip(run["frames"], run["time"], strict=True)
                ]
                for frame in frames:
                    video.append(frame)
            images += [frames[round(share * (len(frames) - 1))] for share in (0.2, 0.5, 1.0)]
    render.write_png(out / "gripper.png", render.contact_sheet(images, 3), width=640)


def main(out: Path, device: str = "cpu", dx: float = 0.02, seconds: float = 1.2) -> dict[float, float]:
    """Returns the height of the cube at the end [m] by the friction of the fingers."""
    out.mkdir(parents=True, exist_ok=True)
    weight = DENSITY * SIDE**3 * GRAVITY
    print(f"weight {weight:.2f} N, held from a friction of {weight / (2 * FORCE):.3f} on")
    runs = {friction: grasp(friction, dx, seconds, device) for friction in FRICTIONS}
    for friction, run in runs.items():
        print(f"friction {friction:g}: cube at {run['cube'][-1]:.3f} m, lifted with {run['lift'][-1]:.2f} N")
    draw(runs, out)
    return {friction: run["cube"][-1] for friction, run in runs.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/gripper"), help="folder of the picture and the videos")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    torch.set_num_threads(1)  # Two thousand particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    main(options.out, options.device)
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'gripper.png'}")
