"""MuJoCo's steps of many scenes: by any number of threads as by one, bit by bit, and as by a loop over `mj_step`."""

import numpy as np
import pytest
import torch

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block, unit_box
from torch_mpm.bodies import MujocoCoupling, mujoco_scenes, mujoco_threads

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.batch")

MODEL = """<mujoco><option timestep="0.002"/><worldbody>
<geom type="plane" size="3 3 1"/>
<body name="hand" pos="0.5 0.5 0.66"><joint name="lift" type="slide" axis="0 0 1" damping="1"/>
  <geom name="hand" size="0.15" mass="5"/><site name="tip"/></body>
<body name="box" pos="2 2 0.1" euler="0 10 0"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>
</worldbody><actuator><motor name="lift" joint="lift" gear="20"/></actuator>
<sensor><accelerometer site="tip"/><touch site="tip"/></sensor></mujoco>"""
WELD = """<mujoco><worldbody><body name="hand" pos=".5 .5 .8"><freejoint/><geom size=".15" mass="1"/></body></worldbody>
<equality><weld body1="world" body2="hand"/></equality></mujoco>"""
SCENES = 3
FIELDS = "qpos", "qvel", "qacc", "qacc_warmstart", "xfrc_applied", "xipos", "xquat", "cvel", "sensordata", "time"


def coupled(model: "mujoco.MjModel", top: float = 0.5, **options: object) -> tuple[MujocoCoupling, mpm.State]:
    """A hand above blocks up to a height, in each of the scenes."""
    step = mpm.Step(unit_box(3, 0.1, scenes=SCENES), mpm.NeoHookean(E=2e4, nu=0.2), (0.0, 0.0, -9.81), walls="slip")
    state = mpm.State.concatenate([block((0.3, 0.3, 0.0), (0.7, 0.7, top), 0.1)] * SCENES, scene=True)
    return mpm.couple(model, step, ["hand"], substeps=4, **options), state


def contents(data: "mujoco.MjData") -> dict[str, np.ndarray]:
    """What users read of MjData."""
    return {name: np.array(getattr(data, name)) for name in FIELDS} | {
        "contacts": np.array([[*contact.pos, contact.dist] for contact in data.contact]),
        "warnings": data.warning.number.copy(),
    }


def assert_same(one: "mujoco.MjData", other: "mujoco.MjData") -> None:
    for name, values in contents(one).items():
        np.testing.assert_array_equal(values, contents(other)[name], err_msg=name)


@pytest.mark.parametrize("threads", [1, 2])
def test_steps_are_those_of_mj_step(threads):
    """Far from the material, with controls of each scene, changes of the model, and a scene that is reset."""
    model, alone = (mujoco.MjModel.from_xml_string(MODEL) for _ in range(2))
    coupling, state = coupled(model, top=0.1, threads=threads)
    expected = [mujoco.MjData(alone) for _ in range(SCENES)]
    for call, n in enumerate([4, 1, 3, 5]):
        for b in range(SCENES):
            coupling.data[b].ctrl[0] = expected[b].ctrl[0] = 3.0 + b - call
        if call == 2:
            model.opt.gravity[2] = alone.opt.gravity[2] = -5.0
            coupling.reset([1])
            mujoco.mj_resetData(alone, expected[1])
        state = coupling.advance(state, n)
        for data in expected:
            for _ in range(n):
                mujoco.mj_step(alone, data)
            mujoco.mj_kinematics(alone, data)
    for data, other in zip(coupling.data, expected, strict=True):
        assert data.ncon > 0 and np.ptp([one.qpos[0] for one in expected]) > 1e-4
        assert_same(data, other)


@pytest.mark.parametrize("threads", [2, 5])
@pytest.mark.parametrize("exchanges", [1, 3])
def test_results_do_not_depend_on_threads(threads, exchanges, monkeypatch):
    """Bit by bit, of MuJoCo and of the material that it pushes; all solutions but the last are those of threads."""
    calls = []
    run = mujoco_threads.MujocoThreads.step
    monkeypatch.setattr(mujoco_threads.MujocoThreads, "step", lambda *given: calls.append(1) or run(*given))

    def end(threads: int) -> tuple[MujocoCoupling, mpm.State]:
        coupling, state = coupled(mujoco.MjModel.from_xml_string(MODEL), threads=threads, exchanges=exchanges)
        for b, data in enumerate(coupling.data):
            data.qvel[0] = -0.2 - 0.5 * b
        for n in (4, 1, 3):
            for b, data in enumerate(coupling.data):
                data.ctrl[0] = b
            state = coupling.advance(state, n)
        return coupling, state

    (one, state), (many, other) = end(1), end(threads)
    assert len(calls) == 8 * exchanges - 3
    assert float(one.wrenches.norm(dim=2).min()) > 1.0
    assert torch.equal(one.wrenches, many.wrenches) and torch.equal(one.pending, many.pending)
    assert torch.equal(state.x, other.x) and torch.equal(state.v, other.v)
    for data, same in zip(one.data, many.data, strict=True):
        assert_same(data, same)


@pytest.mark.parametrize("threads", [1, 2])
def test_an_unstable_scene_among_good_ones(threads, tmp_path, monkeypatch):
    """It is named, and its warning counted; the others have taken their step."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    coupling, state = coupled(mujoco.MjModel.from_xml_string(MODEL), threads=threads)
    state = coupling.advance(state, 3)
    coupling.data[1].qvel[0] = 1e12
    with pytest.raises(mpm.SimulationError, match=r"MuJoCo reports unstable data at 0\.006 s in scene 1: use"):
        coupling.advance(state, 3)
    assert [data.time for data in coupling.data] == pytest.approx([0.008, 0.002, 0.008])
    counts = [int(data.warning[mujoco.mjtWarning.mjWARN_BADQVEL].number) for data in coupling.data]
    assert counts == [0, 1, 0]
    coupling.reset()
    coupling.advance(state, 3)


@pytest.mark.parametrize("threads", [1, 2])
def test_errors_of_mujoco_name_the_scene(threads):
    model = mujoco.MjModel.from_xml_string(WELD)
    coupling, state = coupled(model, top=0.1, threads=threads)
    model.eq_type[0] = 99
    coupling.data[0].eq_active[0] = 0
    with pytest.raises(mpm.SimulationError, match=r"MuJoCo stopped in scene 1: .*99"):
        coupling.advance(state, 2)


# ---- the choice


@pytest.fixture
def sizes(monkeypatch) -> list[int]:
    """Numbers of threads that are started."""
    started: list[int] = []
    start = mujoco_threads.MujocoThreads.__init__

    def note(self: object, model: object, scenes: int, threads: int) -> None:
        started.append(threads)
        start(self, model, scenes, threads)

    monkeypatch.setattr(mujoco_threads.MujocoThreads, "__init__", note)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    return started


@pytest.mark.parametrize(("least", "threads"), [(21, [3]), (22, [])])
def test_threads_are_those_of_torch_for_many_degrees_of_freedom(least, threads, sizes, monkeypatch):
    """Here there are 7 in each of 3 scenes."""
    monkeypatch.setattr(mujoco_scenes, "LEAST_DOFS", least)
    coupled(mujoco.MjModel.from_xml_string(MODEL))
    assert sizes == threads


SLEEP = MODEL.replace('<option timestep="0.002"/>', '<option timestep="0.002"><flag sleep="enable"/></option>')
PLUGIN = MODEL.replace("</worldbody>", "</worldbody><extension><plugin plugin='mujoco.pid'/></extension>").replace(
    "<motor name=", "<plugin plugin='mujoco.pid' joint='lift'><config key='kp' value='1'/></plugin><motor name="
)


@pytest.mark.parametrize(
    ("xml", "error", "message"),
    [
        (SLEEP, ValueError, "threads must be 1 for this model: sleep"),
        (PLUGIN, ValueError, "threads must be 1 for a model with plugins"),
        (MODEL, ImportError, r"threads of MuJoCo need mujoco 3\.17 or later, got \d"),
    ],
)
def test_models_and_versions_without_threads(xml, error, message, sizes, monkeypatch):
    """An error where threads are required, and otherwise a loop."""
    monkeypatch.setattr(mujoco_scenes, "LEAST_DOFS", 1)
    if error is ImportError:
        monkeypatch.setattr(mujoco_threads, "find_spec", lambda name: None)
    model = mujoco.MjModel.from_xml_string(xml)
    with pytest.raises(error, match=message):
        coupled(model, threads=2)
    coupling, state = coupled(model)
    coupling.advance(state, 2)
    assert sizes[:2] == [2, 3]
    assert [data.time for data in coupling.data] == pytest.approx([0.004] * SCENES)


def test_python_callbacks_are_called_by_a_loop(sizes, monkeypatch):
    """Also where they are installed during a run; an error where threads are required."""
    monkeypatch.setattr(mujoco_scenes, "LEAST_DOFS", 1)
    model = mujoco.MjModel.from_xml_string(MODEL)
    (required, state), (coupling, _) = coupled(model, top=0.1, threads=2), coupled(model, top=0.1)

    def lift(model: "mujoco.MjModel", data: "mujoco.MjData") -> None:
        data.ctrl[0] = 10.0

    mujoco.set_mjcb_control(lift)
    try:
        with pytest.raises(ValueError, match="threads must be 1 for this model: mjcb_control is a Python function"):
            required.advance(state, 2)
        coupling.advance(state, 2)
    finally:
        mujoco.set_mjcb_control(None)
    assert all(data.qvel[0] > 0 for data in coupling.data)
