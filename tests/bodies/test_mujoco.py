"""Bodies of a MuJoCo model in the material: their shapes, momentum, weights, light bodies, batches, errors."""

import math
import sys

import numpy as np
import pytest
import torch
from cases.impulses import F64, momentum
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block, unit_box
from torch_mpm.bodies import MujocoCoupling

mujoco = pytest.importorskip("mujoco")

FREE = """<mujoco><option timestep="{h}" gravity="0 0 {gravity}"/><worldbody>
    <body name="body" pos="{at}" euler="{euler}"><freejoint/>
    <geom name="geom" type="{type}" size="{size}" mass="{mass}"/></body></worldbody></mujoco>"""


def free_body(h=0.002, gravity=0.0, at="0.5 0.5 0.6", type="sphere", size="0.15", mass=20.0, euler="0 0 0"):
    values = {"h": h, "gravity": gravity, "at": at, "type": type, "size": size, "mass": mass, "euler": euler}
    return mujoco.MjModel.from_xml_string(FREE.format(**values))


def elastic(gravity: float = 0.0, scenes: int = 1, **options: object) -> mpm.Step:
    law = mpm.NeoHookean(E=2e4, nu=0.2)
    return mpm.Step(unit_box(3, 0.1, scenes=scenes), law, (0.0, 0.0, gravity), **options)


# ---- the exchange


@pytest.mark.parametrize("exchanges", [1, 3])
def test_momentum_of_material_and_body_is_kept(exchanges):
    """Linear and angular, to rounding; MuJoCo keeps the spin of a ball too."""
    model, step = free_body(euler="10 20 30"), elastic()
    coupling = mpm.couple(model, step, ["body"], kind="sticky", exchanges=exchanges)
    (data,) = coupling.data
    data.qvel[:] = [0.2, -0.3, -1.0, 1.0, 2.0, -3.0]
    state = step.with_impulses(step.prepare(block((0.2,) * 3, (0.8, 0.8, 0.5), 0.1, velocity=(0.0, 0.5, 0.5))))
    inertia = 0.4 * 20.0 * 0.15**2

    def total() -> Tensor:
        mujoco.mj_forward(model, data)
        v, omega = (torch.tensor(a) for a in (data.qvel[:3].copy(), data.xmat[1].reshape(3, 3) @ data.qvel[3:]))
        angular = torch.linalg.cross(torch.tensor(data.qpos[:3].copy()), 20.0 * v) + inertia * omega
        material = torch.cat([part[0] for part in momentum(state, step.grid)])
        return material + torch.cat([20.0 * v, angular]) + coupling.pending[0, 0]

    before, met = total(), 0.0
    for _ in range(25):
        state = coupling.advance(state)
        met += float(coupling.wrenches[0, 0, :3].norm()) * 0.002
    assert met > 5.0
    assert float((total() - before).abs().max()) < 1e-12 * met


@pytest.mark.thorough(exchanges=3)
@pytest.mark.parametrize("exchanges", [1, 3])
def test_a_body_comes_to_rest_on_a_block(exchanges):
    """Carried with its weight."""
    model = free_body(0.005, -9.81, "0.52 0.49 0.42", "box", "0.21 0.19 0.1", mass=100.0)
    step = elastic(-9.81, walls="slip", transfer="pic")
    coupling = mpm.couple(model, step, ["body"], exchanges=exchanges)
    state = block((0.0,) * 3, (1.0, 1.0, 0.3), 0.1)
    state = coupling.advance(state, seconds=0.8)
    before = state.impulse
    state = coupling.advance(state, 40)
    mean = (state.impulse - before)[0, 0, 2] / 0.2
    assert float(mean) == pytest.approx(-100.0 * -9.81, rel=1e-2)
    assert abs(coupling.data[0].qvel).max() < 0.02
    assert state.time == pytest.approx(1.0) and coupling.data[0].time == pytest.approx(1.0)


@pytest.mark.parametrize("tilt", ["0 0 0", "5 10 20"])
def test_light_bodies_need_exchanges(tilt):
    """A plate on a block that is eleven times heavier: lagged wrenches let it oscillate without bound."""
    model = free_body(type="box", size="0.3 0.3 0.1", mass=10.0, euler=tilt)

    def speeds(exchanges: int, n: int) -> tuple[float, float]:
        step = elastic()
        coupling = mpm.couple(model, step, ["body"], kind="sticky", exchanges=exchanges)
        state = block((0.2,) * 3, (0.8, 0.8, 0.5), 0.1, velocity=(0.0, 0.0, 0.5))
        most, heavy = 0.0, float(state.mass.sum())
        for _ in range(n):
            state = coupling.advance(state)
            most = max(most, abs(coupling.data[0].qvel[2]))
        p = float((state.mass * state.v[:, 2]).sum() + 10.0 * coupling.data[0].qvel[2] + coupling.pending[0, 0, 2])
        return most, abs(p / (0.5 * heavy) - 1)

    assert speeds(1, 16)[0] > 10.0
    most, lost = speeds(4, 40)
    assert most < 0.6 and lost < 1e-12


@pytest.mark.parametrize("exchanges", [1, 4])
def test_the_error_is_of_first_order_in_the_time_step(exchanges):
    """Of a plate that shakes on a block, with equal substeps."""

    def end(n: int) -> np.ndarray:
        model = free_body(n * 5e-4, at="0.51 0.5 0.52", type="box", size="0.25 0.25 0.065", mass=100.0)
        options = {"kind": "sticky", "substeps": n, "exchanges": exchanges}
        coupling = mpm.couple(model, elastic(walls="sticky"), ["body"], **options)
        coupling.data[0].qvel[:] = [0.0, 0.0, -0.01, 0.02, 0.0, 0.0]
        coupling.advance(block((0.2, 0.2, 0.0), (0.8, 0.8, 0.5), 0.1), 32 // n)
        return coupling.data[0].qvel.copy()

    first, second, third = end(1), end(2), end(4)
    assert np.linalg.norm(third - second) / np.linalg.norm(second - first) == pytest.approx(2.0, rel=0.15)


def test_scenes_are_those_of_single_runs():
    """Each with data of its own; one is reset and runs again."""
    model = free_body(at="0.5 0.5 0.55")

    def run(speeds: list[float], scenes: int) -> tuple[MujocoCoupling, mpm.State]:
        step = elastic(scenes=scenes)
        coupling = mpm.couple(model, step, ["body"], exchanges=2)
        for data, speed in zip(coupling.data, speeds, strict=True):
            data.qvel[2] = speed
        states = [block((0.2,) * 3, (0.8, 0.8, 0.5), 0.1)] * scenes
        state = mpm.State.concatenate(states, scene=True) if scenes > 1 else states[0]
        return coupling, coupling.advance(state, 10)

    both, state = run([-1.0, -0.2], 2)
    for b, speed in enumerate([-1.0, -0.2]):
        single, alone = run([speed], 1)
        np.testing.assert_allclose(both.data[b].qpos, single.data[0].qpos, rtol=0, atol=1e-12)
        torch.testing.assert_close(both.wrenches[b], single.wrenches[0], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(state.x[state.scene == b], alone.x, rtol=0, atol=1e-12)
    assert float(both.wrenches.norm(dim=2).min()) > 1.0
    both.reset([0])
    assert (both.pending[0] == 0).all() and (both.pending[1] != 0).any()
    assert both.data[0].time == 0.0 and both.data[1].time > 0.0


def test_a_body_is_put_elsewhere():
    """At once, without pushing what is on the way; the floor of the world takes the weight of the material."""
    xml = """<mujoco><option timestep="0.005"/><worldbody>
    <geom name="floor" type="plane" size="1 1 1" pos="0 0 0.2"/>
    <body name="ball" pos="0.5 0.5 0.8" gravcomp="1"><freejoint/><geom size="0.1" mass="1"/></body>
    </worldbody></mujoco>"""
    step = elastic(-9.81, transfer="pic", walls="slip")
    coupling = mpm.couple(mujoco.MjModel.from_xml_string(xml), step, ["world", "ball"], substeps=4)
    assert list(coupling.obstacles) == ["floor", "geom 1"]
    state = coupling.advance(block((0.0, 0.0, 0.2), (1.0, 1.0, 0.5), 0.1), 100)
    coupling.data[0].qpos[2] = 0.9
    speed = float(state.v.abs().max())
    state = coupling.advance(state, 1)
    assert float(state.v.abs().max()) < speed + 1e-2  # and not 20 m/s
    assert float(coupling.wrenches[0, 0, 2]) == pytest.approx(-9.81 * float(state.mass.sum()), rel=2e-2)
    assert float(coupling.wrenches[0, 1].norm()) < 1e-9


# ---- geoms

ALL = """<mujoco><asset><mesh name="wedge" vertex="0 0 0  .3 0 0  0 .25 0  0 0 .2"/></asset><worldbody>
<body name="probe" mocap="true"><geom size="0.001"/></body>
<body name="body" pos=".4 .5 .45" euler="20 30 40"><freejoint/>
<geom name="picture" size=".3" contype="0" conaffinity="0"/>
<geom name="other" size=".1" pos=".3 .3 .3"/>
<geom name="geom" type="{type}" {size} pos="{at}" euler="50 10 70" friction="0.37"/></body></worldbody></mujoco>"""
GEOMS = {
    "sphere": ('size=".12"', 1e-9),
    "capsule": ('size=".06 .1"', 1e-9),
    "cylinder": ('size=".09 .12"', 1e-6),
    "box": ('size=".1 .05 .15"', 1e-6),
    "mesh": ('mesh="wedge"', 0.02),  # Sampled, which rounds its edges.
}


@pytest.mark.parametrize("type", GEOMS)
def test_obstacles_have_the_surfaces_of_geoms(type):
    """By the distances that MuJoCo computes from a tiny ball, while the body moves and turns."""
    if type == "mesh":
        pytest.importorskip("trimesh")
    size, tolerance = GEOMS[type]
    model = mujoco.MjModel.from_xml_string(ALL.format(type=type, size=size, at="0.1 -0.05 0.02"))
    step = elastic()
    coupling = mpm.couple(model, step, ["body"], geoms=["geom"], substeps=1)
    (data,) = coupling.data
    data.qvel[:] = [1.0, 2.0, -1.0, 10.0, -20.0, 15.0]
    state = coupling.advance(block((0.9,) * 3, (0.95,) * 3, 0.1), 5)
    (obstacle,) = step.boundaries
    assert obstacle.friction == 0.37
    mujoco.mj_kinematics(model, data)
    points = torch.tensor(data.xipos[2]) + 0.4 * (torch.rand(200, 3, dtype=F64) - 0.5)
    expected = []
    for point in points.numpy():
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        geoms = (model.geom(name).id for name in ("geom", 0))
        expected.append(mujoco.mj_geomDistance(model, data, *geoms, 10.0, None) + 0.001)
    expected = torch.tensor(expected, dtype=F64)
    found = obstacle.signed_distance(points, None, state.time)
    outside = (expected > 0.01) & (expected < (0.1 if type == "mesh" else 1.0))
    assert int(outside.sum()) > 5
    # Turning by a constant rate, the centre of a geom beside the centre of mass leaves its arc by |ω|² r h²/2.
    assert float((found - expected)[outside].abs().max()) < tolerance + 730 * 0.3 * model.opt.timestep**2 / 2


def test_planes_and_errors_of_geoms():
    xml = '<mujoco><worldbody><geom name="g" type="{}" size="1 1 1" pos="0 0 0.3" euler="0 30 0"/></worldbody></mujoco>'
    step = elastic()
    coupling = mpm.couple(mujoco.MjModel.from_xml_string(xml.format("plane")), step, ["world"])
    coupling.advance(block((0.5,) * 3, (0.6,) * 3, 0.1), 1)
    x = torch.tensor([[0.2, 0.7, 0.9]], dtype=F64)
    expected = 0.2 * math.sin(math.radians(30)) + 0.6 * math.cos(math.radians(30))
    assert float(coupling.obstacles["g"].signed_distance(x, None, 0.0)) == pytest.approx(expected)
    with pytest.raises(ValueError, match=r"geoms must be of a type among .*'sphere'\], got 'g' of type 'ellipsoid'"):
        mpm.couple(mujoco.MjModel.from_xml_string(xml.format("ellipsoid")), step, ["world"])


# ---- errors


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"bodies": ["hand"]},
            ValueError,
            r"bodies must be names of bodies of the model, \['body', 'world'\], got 'hand'",
        ),
        ({"bodies": [1]}, ValueError, "got 1"),
        ({"bodies": ["body", "body"]}, ValueError, r"bodies must be different, got \['body', 'body'\]"),
        ({"bodies": "body"}, TypeError, "bodies must be a list of names, got str"),
        ({"bodies": []}, ValueError, "bodies must have at least one name"),
        ({"bodies": ["world"]}, ValueError, "bodies must have a colliding geom each, got 'world' without one"),
        ({"geoms": ["palm"]}, ValueError, r"geoms must be colliding geoms of the bodies, \['geom'\], got 'palm'"),
        ({"kind": "glue"}, ValueError, "kind must be one of"),
        ({"friction": -1.0}, ValueError, "friction must be a finite number >= 0"),
        ({"substeps": 0}, ValueError, "substeps must be at least 1"),
        ({"exchanges": 0}, ValueError, "exchanges must be at least 1"),
        ({"exchanges": 1.5}, TypeError, "exchanges must be a whole number"),
        ({"threads": 0}, ValueError, "threads must be at least 1"),
        ({"threads": 2.0}, TypeError, "threads must be a whole number"),
        ({"data": []}, ValueError, "data must be one MjData for each of 1 scenes, got 0"),
        ({"data": 3}, TypeError, "data must be a mujoco.MjData or a list of them, got int"),
        ({"model": "scene.xml"}, TypeError, "model must be a mujoco.MjModel, got str"),
        ({"step": None}, TypeError, "step must be a Step, got NoneType"),
    ],
)
def test_wrong_arguments(options, error, message):
    with pytest.raises(error, match=message):
        mpm.couple(**{"model": free_body(), "step": elastic(), "bodies": ["body"]} | options)


def test_data_and_steps_of_others():
    model, step = free_body(), elastic()
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ValueError, match="got MjData of another one"):
        mpm.couple(model, step, ["body"], data=mujoco.MjData(other))
    flat = mpm.Step(unit_box(2, 0.1), mpm.NeoHookean(E=1e4, nu=0.2))
    with pytest.raises(ValueError, match="step must have a grid of 3 dimensions, got 2"):
        mpm.couple(model, flat, ["body"])
    assert len(step.boundaries) == 0  # unlike after one that is right
    data = mujoco.MjData(model)
    coupling = mpm.couple(model, step, ["body"], data=data)
    assert coupling.data == [data] and len(step.boundaries) == 1
    state = block((0.2,) * 3, (0.3,) * 3, 0.1)
    with pytest.raises(ValueError, match=r"seconds must be a multiple of the time step 0\.002 s, got 0\.003"):
        coupling.advance(state, seconds=0.003)
    with pytest.raises(ValueError, match="scenes must be from 0 to 0, got 1"):
        coupling.reset([1])


def test_gradients_are_refused():
    step = elastic()
    coupling = mpm.couple(free_body(), step, ["body"])
    state = block((0.2,) * 3, (0.3,) * 3, 0.1)
    tracked = state.replace(v=state.v.clone().requires_grad_())
    with pytest.raises(NotImplementedError, match=r"state\.v requires grad, and gradients do not pass through MuJoCo"):
        coupling.advance(tracked)
    with torch.no_grad():
        assert not coupling.advance(tracked).x.requires_grad
    step.law.E = torch.nn.Parameter(torch.tensor(1e4, dtype=F64))
    with pytest.raises(NotImplementedError, match=r"step\.law\.E requires grad"):
        coupling.advance(state)
    coupling.obstacles["geom"].friction, step.law.E = torch.tensor(0.1, requires_grad=True), 1e4
    with pytest.raises(NotImplementedError, match=r"step\.boundaries\.0\.friction requires grad"):
        coupling.advance(state)


def test_unstable_simulations_are_errors(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    step = elastic()
    coupling = mpm.couple(free_body(), step, ["body"], substeps=1)
    state = block((0.2,) * 3, (0.8,) * 3, 0.1)
    with pytest.raises(mpm.SimulationError, match="wrench on body 0 of scene 0 is not finite"):
        coupling.advance(state.replace(v=torch.full_like(state.v, torch.nan)))
    coupling.data[0].qvel[0] = 1e12
    with pytest.raises(mpm.SimulationError, match=r"MuJoCo reports unstable data at 0\.002 s in scene 0"):
        coupling.advance(state)
    chooses = mpm.couple(free_body(), elastic(), ["body"])
    with pytest.raises(mpm.SimulationError, match=r"needs time steps of .* s, and MuJoCo takes 0\.002 s"):
        chooses.advance(state.replace(v=1e9 * torch.ones_like(state.v)))


def test_the_package_may_be_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"coupling with MuJoCo: the package mujoco .*torch-mpm\[mujoco\]"):
        mpm.couple(None, elastic(), ["body"])
