"""Bodies of MuJoCo Warp through the protocol of two tensors, as docs/bodies.md describes it, beside those of MuJoCo."""

import contextlib

import numpy as np
import pytest
import torch
from cases.impulses import F64

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block, unit_box
from torch_mpm.bodies import with_velocities

mujoco = pytest.importorskip("mujoco")
mujoco_warp = pytest.importorskip("mujoco_warp")
warp = pytest.importorskip("warp")

MODEL = """<mujoco><option timestep="0.002"/><worldbody><body name="body" pos="0.5 0.5 0.64" euler="10 20 30">
    <freejoint/><geom type="sphere" size="0.15" mass="20" friction="0.3"/></body></worldbody></mujoco>"""
SECONDS, SUBSTEPS, SCENES, STEPS = 0.002, 4, 3, 40


def scenes(device: str) -> tuple[mpm.Step, mpm.State]:
    """Blocks of scenes."""
    step = mpm.Step(unit_box(3, 0.1, scenes=SCENES), mpm.NeoHookean(E=2e4, nu=0.2), (0.0, 0.0, -9.81), "slip")
    return step, mpm.State.concatenate([block((0.2,) * 3, (0.8, 0.8, 0.5), 0.1)] * SCENES, scene=True).to(device)


def velocities() -> torch.Tensor:
    """Of the bodies [B, 6]: each scene has its own."""
    spin = torch.tensor([1.0, 2.0, -3.0], dtype=F64)
    return torch.stack([torch.cat([torch.tensor([0.1 * b, -0.2, -1.0], dtype=F64), b * spin]) for b in range(SCENES)])


def on_the_stream_of_torch(device: str) -> contextlib.AbstractContextManager:
    if device == "cpu":
        return contextlib.nullcontext()
    return warp.ScopedStream(warp.stream_from_torch(torch.cuda.current_stream()))


@pytest.mark.thorough
def test_bodies_move_as_those_of_mujoco(device):
    """The first call compiles the kernels of MuJoCo Warp."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    step, state = scenes(device)
    with warp.ScopedDevice(device), on_the_stream_of_torch(device):
        rigid = mujoco_warp.put_model(model)
        worlds = mujoco_warp.put_data(model, data, nworld=SCENES)
        qpos, qvel, positions, turns, applied = (
            warp.to_torch(getattr(worlds, name)) for name in ("qpos", "qvel", "xipos", "xquat", "xfrc_applied")
        )
        qvel[:] = velocities().to(qvel)
        ball = mpm.Sphere((0.0,) * 3, 0.15, "separate", friction=0.3)
        step.boundaries.append(ball)
        bodies = mpm.RigidBodies(step, [ball])

        def poses() -> torch.Tensor:
            mujoco_warp.kinematics(rigid, worlds)
            return torch.cat([positions[:, 1:], turns[:, 1:]], 2).double()  # Without the world, body 0.

        begin = poses()
        for _ in range(STEPS):
            mujoco_warp.step(rigid, worlds)
            end = poses()
            state, wrenches = bodies.advance(state, with_velocities(begin, end, SECONDS), SUBSTEPS, SECONDS / SUBSTEPS)
            force, torque = wrenches.split(3, 2)
            torque = torque - torch.linalg.cross(end[..., :3] - begin[..., :3], force)  # About the new position.
            applied[:, 1:] = torch.cat([force, torque], 2).to(applied)
            begin = end

    expected = mpm.couple(model, scenes(device)[0], ["body"], substeps=SUBSTEPS)
    for own, velocity in zip(expected.data, velocities(), strict=True):
        own.qvel[:] = velocity.numpy()
    other = expected.advance(scenes(device)[1], STEPS)
    assert float(expected.wrenches[..., 2].min()) > 100.0
    for found, name, within in ((qpos, "qpos", 2e-5), (qvel, "qvel", 2e-3)):
        np.testing.assert_allclose(found.cpu().numpy(), [getattr(d, name) for d in expected.data], rtol=0, atol=within)
    torch.testing.assert_close(state.x, other.x, rtol=0, atol=2e-5)
