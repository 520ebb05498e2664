"""Runs of scenes: the physics of their results; no data is lost or half-written, errors and signals included."""

import json
import math
import random
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import FILE, command, disc

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

import h5py

from torch_mpm import SimulationError, State, Trajectory
from torch_mpm.data.export import export_ply, export_vtk
from torch_mpm.scene import Scene, SceneError, folder, heap, writer
from torch_mpm.scene import run as module
from torch_mpm.scene.diagnose import SceneFailure, replay
from torch_mpm.scene.folder import OutputError
from torch_mpm.scene.run import Interrupted
from torch_mpm.state.state_file import load

PRECISE = {"precision": "float64", "device": "cpu"}


def simulate(folder, **words):
    """Summary and trajectory of the disc scene with changes."""
    summary = Scene(**disc(**{"device": "cpu", **words})).run(folder)
    with Trajectory(folder) as read:
        return summary, {name: read[name] for name in read.file}, read.attributes


@pytest.fixture(params=[False, True], ids=["waits", "runs ahead"])
def ahead(request, monkeypatch):
    """Whether the host hands over a frame when the next substeps have begun, as it does beside a GPU."""
    monkeypatch.setattr(module.Simulation, "_runs_ahead", lambda self: request.param)
    return request.param


# ---- physics


def test_free_fall(tmp_path):
    summary, data, _ = simulate(tmp_path / "out", **PRECISE, body__0__velocity=(1.0, 0.0), output={"fields": ["F"]})
    center = (data["position"] * data["mass"][:, None]).sum(1) / data["mass"].sum()
    t = data["time"]
    # Symplectic Euler falls g dt t / 2 further than the parabola.
    fallen = center[:, 1] - center[0, 1]
    np.testing.assert_allclose(fallen, -5 * t**2, atol=5 * summary["smallest_dt"] * 2 * t[-1])
    np.testing.assert_allclose(center[:, 0] - center[0, 0], t, atol=1e-10)
    np.testing.assert_allclose(data["F"], np.broadcast_to(np.eye(2), data["F"].shape), atol=1e-9)
    np.testing.assert_allclose(t, np.linspace(0, 0.1, 6), rtol=1e-14)
    assert summary["particles_lost"] == 0 and abs(summary["mass_drift"]) < 1e-14


def test_momentum_of_a_collision_is_kept_to_rounding(tmp_path):
    body = {"shape": "sphere", "radius": 0.15, "material": "jelly"}
    bodies = [
        {**body, "center": (0.3, 0.5), "velocity": (2.0, 0.0)},
        {**body, "center": (0.65, 0.55), "velocity": (-1.0, 0.0)},
    ]
    _, data, _ = simulate(tmp_path / "out", **PRECISE, body=bodies, gravity=None, duration=0.1)
    scale = data["mass"].sum()
    np.testing.assert_allclose(data["momentum"], np.broadcast_to(data["momentum"][0], (6, 2)), atol=1e-12 * scale)
    assert data["elastic_energy"].max() > 0.01 * data["kinetic_energy"][0]  # they did meet


def test_energy_of_a_bouncing_disc_is_that_of_its_trajectory(tmp_path):
    _, data, _ = simulate(tmp_path / "out", **PRECISE)
    kinetic = 0.5 * (data["mass"] * (data["velocity"] ** 2).sum(2)).sum(1)
    np.testing.assert_allclose(data["kinetic_energy"], kinetic, rtol=1e-12)
    potential = 10 * (data["mass"] * data["position"][:, :, 1]).sum(1)
    np.testing.assert_allclose(data["potential_energy"], potential, rtol=1e-12)


def test_emitters_pour_exactly_their_rate(tmp_path):
    emitter = {"center": (0.2, 0.8), "radius": 0.07, "velocity": (1.0, 0.0), "material": "jelly", "start": 0.02}
    summary, data, _ = simulate(tmp_path / "out", **PRECISE, body=[], emitter=[emitter])
    assert float(data["mass"].sum()) == pytest.approx(1000 * 0.14 * 1.0 * 0.08, rel=1e-12)
    assert data["particles"][:2].tolist() == [0, data["particles"][1]] and data["particles"][-1] == len(data["mass"])
    assert np.isnan(data["position"][0]).all() and np.isfinite(data["position"][-1]).all()
    # Before the fall has bent the jet, its matter is at speed x age from the nozzle.
    first = np.nanmax(data["position"][-1][:, 0])
    assert first == pytest.approx(0.2 + 0.08, abs=0.01)
    assert summary["particles_lost"] == 0


def test_a_moving_obstacle_pushes(tmp_path):
    wall = {"shape": "box", "center": (0.1, 0.5), "size": (0.2, 1.0), "velocity": (2.0, 0.0), "contact": "sticky"}
    _, data, _ = simulate(tmp_path / "out", gravity=None, obstacle=[wall], duration=0.2)
    assert data["position"][-1][:, 0].min() > 0.2 + 2.0 * 0.2 - 0.05
    assert data["momentum"][-1, 0] > 0 == data["momentum"][0, 0]


def test_a_batch_gives_what_each_scene_gives_alone(tmp_path):
    entries = [
        {"material": {"jelly": {"law": "neo_hookean", "E": 1e4}}, "gravity": (0, -3)},
        {"material": {"jelly": {"law": "neo_hookean", "E": 2e4}}, "gravity": (0, -9)},
    ]
    same = {**PRECISE, "dt": 1e-3, "body__0__center": (0.5, 0.22)}
    _, batch, _ = simulate(tmp_path / "batch", **same, material={}, gravity=None, scene=entries)
    for k, entry in enumerate(entries):
        _, alone, _ = simulate(tmp_path / f"{k}", **same, **entry)
        rows = batch["scene"] == k
        np.testing.assert_allclose(batch["position"][:, rows], alone["position"], atol=1e-12)


def test_the_trajectory_knows_where_it_comes_from(tmp_path):
    _, data, attributes = simulate(tmp_path / "out", seed=7, output={"fields": ["stress", "C"]})
    assert attributes["seed"] == 7 and attributes["torch"] == torch.__version__
    assert Scene(**json.loads(attributes["scene"])).seed == 7
    assert data["stress"].shape == (6, len(data["mass"]), 2, 2) and data["C"].shape == data["stress"].shape


def test_frames_of_a_mixture_show_what_its_laws_say(tmp_path):
    honey = {"law": "weakly_compressible", "bulk_modulus": 1e4, "viscosity": 5.0}
    materials = {"jelly": {"law": "neo_hookean", "E": 1e4}, "honey": honey}
    drop = {"shape": "sphere", "center": (0.5, 0.82), "radius": 0.1, "material": "honey"}
    jelly = disc()["body"][0]
    words = disc(**PRECISE, material=materials, body=[jelly, drop], output={"fields": ["stress", "F", "J", "C"]})
    scene = Scene(**words)
    scene.run(tmp_path / "out")
    law = scene.build().step.law
    with Trajectory(tmp_path / "out") as trajectory:
        for frame in trajectory:
            given = {name: torch.from_numpy(frame[name]) for name in ("mass", "volume", "F", "J", "C", "material")}
            state = State(torch.from_numpy(frame["position"]), torch.from_numpy(frame["velocity"]), **given)
            cauchy = law.stress(state) / law.volume_ratio(state)[:, None, None]
            np.testing.assert_allclose(frame["stress"], cauchy, rtol=1e-12, atol=1e-20)
            assert frame["elastic_energy"] == pytest.approx(float(law.energy(state).sum()), rel=1e-12, abs=1e-12)


def test_every_device_writes_the_frames_of_the_cpu(tmp_path, device):
    emitter = {"center": (0.8, 0.8), "radius": 0.07, "velocity": (-1.0, 0.0), "material": "jelly"}
    words = {"precision": "float64", "dt": 1e-3, "emitter": [emitter], "output": {"fields": ["F", "stress"]}}
    _, expected, _ = simulate(tmp_path / "cpu", **words)
    _, data, attributes = simulate(tmp_path / "device", **{**words, "device": device})
    assert attributes["device"].startswith(device)
    for name in ("position", "velocity", "F", "mass", "material", "particles", "momentum"):
        np.testing.assert_allclose(data[name], expected[name], rtol=1e-9, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(data["stress"], expected["stress"], atol=1e-5)


# ---- output folders


def test_folders_that_hold_something_else_are_refused(tmp_path):
    scene = Scene(**disc(device="cpu", duration=0.02))
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("keep")
    with pytest.raises(OutputError, match="holds files that are not a run of torch_mpm"):
        scene.run(tmp_path / "notes")
    with pytest.raises(OutputError, match="is a file"):
        scene.run(tmp_path / "notes" / "mine.txt")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.building").write_text("{")  # what a kill at the very start may leave
    summary = scene.run(tmp_path / "out")
    with pytest.raises(OutputError, match="holds the complete run of this scene"):
        scene.run(tmp_path / "out")
    assert scene.run(tmp_path / "out", resume=True) == json.loads(json.dumps(summary))
    with pytest.raises(OutputError, match="holds the run of another scene"):
        Scene(**disc(device="cpu", duration=0.04)).run(tmp_path / "out", resume=True)
    assert (tmp_path / "notes" / "mine.txt").read_text() == "keep"


def test_a_disk_too_small_is_noticed_first(tmp_path, monkeypatch):
    usage = folder.shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(folder.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(OutputError, match=r"the trajectory needs .* 1 kB are free; free some space"):
        simulate(tmp_path / "out")


def test_a_disk_that_fills_up_leaves_whole_frames(tmp_path, monkeypatch):
    _, whole, _ = simulate(tmp_path / "whole")
    scene = Scene(**disc(device="cpu"))
    save, calls = module.state_file.save, []

    def full(path, *arguments):
        calls.append(path)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        save(path, *arguments)

    monkeypatch.setattr(writer, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(module.state_file, "save", full)
    with pytest.raises(OutputError, match=r"no room on the disk .*No space left.* frames written so far are complete"):
        scene.run(tmp_path / "out")
    monkeypatch.undo()
    with Trajectory(tmp_path / "out") as read:
        assert 1 <= len(read) < len(whole["time"])
        np.testing.assert_array_equal(read["position"], whole["position"][: len(read)])
    scene.run(tmp_path / "out", resume=True)
    with Trajectory(tmp_path / "out") as read:
        np.testing.assert_array_equal(read["position"], whole["position"])


# ---- stops and kills


JET = {"center": (0.2, 0.8), "radius": 0.07, "velocity": (1.0, 0.0), "material": "jelly"}


def test_a_stop_signal_ends_after_a_whole_frame_and_resumes_bit_for_bit(tmp_path, ahead):
    _, whole, _ = simulate(tmp_path / "whole", emitter=[JET])
    scene = Scene(**disc(device="cpu", emitter=[JET]))

    def interrupt(figures):
        if figures["frame"] == 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted, match="stopped after frame 2 of 5; add --resume"):
        scene.run(tmp_path / "out", progress=interrupt)
    with pytest.raises(OutputError, match="holds an unfinished run of this scene; add --resume"):
        scene.run(tmp_path / "out")
    with Trajectory(tmp_path / "out") as read:
        assert len(read) == 3
    _, record = load(tmp_path / "out" / "checkpoint.h5")
    assert record["frame"] == 2 and record["totals"]["substeps"] == whole["substeps"][:3].sum()
    summary = scene.run(tmp_path / "out", resume=True)
    with Trajectory(tmp_path / "out") as read:
        for name in whole:
            np.testing.assert_array_equal(read[name], whole[name])
    assert summary["substeps"] == whole["substeps"].sum()
    assert not list((tmp_path / "out").glob("*.building")) and not (tmp_path / "out" / "checkpoint.h5").exists()


@pytest.mark.parametrize("changes", [{"transfer": "flip"}, {"transfer": "pic"}, {"transfer": "flip", "emitter": [JET]}])
def test_runs_of_bodies_that_spin_resume_without_apic(changes, tmp_path):
    words = {"body__0__spin": 3.0, **changes}
    _, whole, _ = simulate(tmp_path / "whole", **words)

    def stop(figures):
        if figures["frame"] == 2:
            raise ZeroDivisionError

    scene = Scene(**disc(device="cpu", **words))
    with pytest.raises(ZeroDivisionError):
        scene.run(tmp_path / "out", progress=stop)
    scene.run(tmp_path / "out", resume=True)
    with Trajectory(tmp_path / "out") as read:
        for name in whole:
            np.testing.assert_array_equal(read[name], whole[name])


def test_exports_of_frames_without_particles(tmp_path):
    meshio = pytest.importorskip("meshio")
    _, data, _ = simulate(tmp_path / "out", body=[], emitter=[{**JET, "start": 0.03}])
    assert data["particles"][0] == 0 < data["particles"][-1]
    ply, vtk = export_ply(tmp_path / "out"), export_vtk(tmp_path / "out").parent
    assert [len(meshio.read(file).points) for file in sorted(ply.iterdir())] == list(data["particles"])
    for file, count in zip(sorted(vtk.glob("*.vtu")), data["particles"], strict=True):
        assert f'NumberOfPoints="{count}"' in file.read_text()


def test_a_stop_signal_ends_a_frame_that_takes_long(tmp_path):
    scene = Scene(**disc(device="cpu", duration=1e4, fps=1e-3))
    before = signal.signal(signal.SIGVTALRM, lambda *_: signal.raise_signal(signal.SIGTERM))
    signal.setitimer(signal.ITIMER_VIRTUAL, 0.2)
    try:
        with pytest.raises(Interrupted, match="stopped after frame 0 of 10; add --resume"):
            scene.run(tmp_path / "out")
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)
    _, record = load(tmp_path / "out" / "checkpoint.h5")
    assert record["frame"] == 0


def test_a_signal_after_the_last_frame_is_passed_on(tmp_path):
    """To what comes after the run, such as drawing it."""
    scene, came = Scene(**disc(device="cpu")), []

    def interrupt(figures):
        if figures["frame"] == figures["frames"]:
            signal.raise_signal(signal.SIGTERM)

    before = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    try:
        scene.run(tmp_path / "out", progress=interrupt)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert came == [signal.SIGTERM] and (tmp_path / "out" / "trajectory.h5").exists()


def test_equal_runs_have_equal_files(tmp_path):
    """HDF5 would store times, of one second each."""
    for name in ("one", "other"):
        Scene(**disc(device="cpu", duration=0.02)).run(tmp_path / name)
    one, other = (tmp_path / name / "trajectory.h5" for name in ("one", "other"))
    assert one.read_bytes() == other.read_bytes()
    with h5py.File(one) as file:
        assert not any(data.id.get_create_plist().get_obj_track_times() for data in file.values())


def killed_and_resumed(tmp_path, kills, duration, delay):
    """Run a scene with SIGKILLs after random delays; returns the number of kills and both trajectories."""
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(duration=duration) + "\n[output]\nfields = ['F', 'C']\n")
    assert command("run", path, "-o", tmp_path / "whole", "--quiet").wait() == 0
    rng, done = random.Random(5), 0
    arguments = ("run", path, "-o", tmp_path / "out", "--quiet", "--resume")
    while done < kills:
        process = command(*arguments)
        try:
            process.communicate(timeout=delay(rng, done))
            break  # it came to its end
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            done += 1
    process = command(*arguments)
    _, errors = process.communicate()
    assert process.returncode == 0 or "complete run" in errors, errors
    with Trajectory(tmp_path / "whole") as a, Trajectory(tmp_path / "out") as b:
        assert a.complete and b.complete and list(a.file) == list(b.file)
        for name in a.file:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    assert not list((tmp_path / "out").glob("*.building"))
    return done


def wait_for_frames(folder, frames, process):
    """Wait until `frames` frames are complete or the process ends."""
    while process.poll() is None:
        try:
            with Trajectory(folder) as read:
                if len(read) >= frames:
                    return
        except (FileNotFoundError, OSError):
            pass


@pytest.mark.thorough
def test_sigkill_in_the_middle_loses_and_repeats_nothing(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(duration=0.8))
    assert command("run", path, "-o", tmp_path / "whole", "--quiet").wait() == 0
    arguments = ("run", path, "-o", tmp_path / "out", "--quiet", "--resume")
    for frames in (5, 21):
        process = command(*arguments)
        wait_for_frames(tmp_path / "out", frames, process)
        process.kill()
        process.communicate()
    assert command(*arguments).wait() == 0
    with Trajectory(tmp_path / "whole") as a, Trajectory(tmp_path / "out") as b:
        assert a.complete and b.complete
        for name in a.file:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.slow
def test_twenty_sigkills_at_random_moments(tmp_path):
    # The scene takes longer than all the delays together, so that every kill meets a run at work.
    done = killed_and_resumed(tmp_path, 20, 200.0, lambda rng, k: rng.uniform(1.0, 4.0))
    assert done == 20


# ---- frames that are handed over while the next substeps are taken


def events_of(folder, monkeypatch, words):
    """Events of a run in their order, and the record of each frame in its checkpoints."""
    events, records = [], []
    rollout, submit = module.rollout, writer.FrameWriter.submit

    def taken(step, state, n, dt):
        events.append("substeps")
        return rollout(step, state, n, dt)

    def handed(self, frame):
        events.append(frame.number)
        tensors = {name: t.clone() for name, t in frame.state.items()}
        totals = {name: value for name, value in frame.record["totals"].items() if name != "simulating"}
        records.append((tensors, {**frame.record, "totals": totals}))
        submit(self, frame)

    monkeypatch.setattr(module, "rollout", taken)
    monkeypatch.setattr(writer.FrameWriter, "submit", handed)
    Scene(**disc(device="cpu", **words)).run(folder)
    return events, records


def test_a_frame_is_handed_over_once_the_next_substeps_have_begun(tmp_path, ahead, monkeypatch):
    events, _ = events_of(tmp_path / "out", monkeypatch, {})
    frames = [[0, "substeps"], [1, "substeps"], [2, "substeps"], [3, "substeps"], [4, "substeps"]]
    order = [event for pair in frames for event in (reversed(pair) if ahead else pair)]
    assert events == [*order, 5]


def test_a_frame_that_waits_is_reported_as_it_was(tmp_path, monkeypatch):
    """Its state and its record lack what was emitted and counted since."""
    found = []
    for waits in (True, False):
        with monkeypatch.context() as patch:
            patch.setattr(module.Simulation, "_runs_ahead", lambda self, waits=waits: not waits)
            found.append(events_of(tmp_path / f"{waits}", patch, {"emitter": [JET]})[1])
    for (tensors, record), (others, other) in zip(*found, strict=True):
        assert record == other and tensors.keys() == others.keys()
        for name, value in tensors.items():
            assert torch.equal(value, others[name]), name
    assert found[0][0][1]["emitted"] < found[0][-1][1]["emitted"]


@pytest.mark.parametrize("where", ["_choose_dt", "_moved"])
def test_the_frame_before_a_failure_is_written(tmp_path, ahead, monkeypatch, where):
    work = getattr(module.Simulation, where)

    def fails(self, *arguments):
        result = work(self, *arguments)
        if self.frame == 2:
            raise SceneFailure("it went wrong")
        return result

    monkeypatch.setattr(module.Simulation, where, fails)
    reported = []
    scene = Scene(**disc(device="cpu"))
    with pytest.raises(SceneFailure, match="it went wrong"):
        scene.run(tmp_path / "out", progress=reported.append)
    with Trajectory(tmp_path / "out") as read:
        assert len(read) == 3
        substeps = int(read["substeps"][:3].sum())
    _, record = load(tmp_path / "out" / "checkpoint.h5")
    assert record["frame"] == 2 and record["totals"]["substeps"] == substeps
    assert [figures["frame"] for figures in reported] == [1, 2]


def test_threads_take_turns_soon_while_a_run_lasts(tmp_path):
    before, seen = sys.getswitchinterval(), []
    Scene(**disc(device="cpu")).run(tmp_path / "out", progress=lambda figures: seen.append(sys.getswitchinterval()))
    assert max(seen) < 1e-3 <= before == sys.getswitchinterval()


def test_substeps_are_repeated_where_their_pool_was_too_small():
    """Not those of a call that had more room, though the pool has to grow for what comes."""
    scene = Scene(**disc(device="cpu"))
    simulation = module.Simulation(scene, scene.build())
    grid = simulation.step.grid
    room = grid.pool(simulation.state.x, simulation.state.scene)
    assert not simulation._overflowed([], room)
    assert not simulation._overflowed([[room, 0, -1, 0, -1, 1, 4, room]], room) and grid.max_blocks == room
    assert not simulation._overflowed([[room + 1, 0, -1, 0, -1, 1, -1, room]], room) and grid.max_blocks > room
    assert simulation._overflowed([[room + 1, 0, -1, 0, -1, 1, 4, room]], room)


# ---- what goes wrong


def test_a_fixed_dt_above_the_limit_is_refused_with_one_that_works(tmp_path):
    with pytest.raises(SceneError, match=r"dt: 0.1 s is above the stability limit .*; use 0.00") as error:
        simulate(tmp_path / "out", dt=0.1)
    wanted = float(str(error.value).split("; use ")[1].split(",")[0])
    simulate(tmp_path / "again", dt=wanted)


def test_a_particle_that_leaves_is_named_and_the_state_before_it_is_kept(tmp_path):
    with pytest.raises(SceneFailure, match=r"(?s)particle \d+: it left the domain, at \[.*open wall") as error:
        simulate(tmp_path / "out", grid__walls="open", body__0__velocity=(0, -20.0), duration=0.2)
    failure = error.value.failure
    assert failure.quantity.startswith("it left the domain") and failure.step > 1
    state, record = load(tmp_path / "out" / "last_good.h5")
    assert bool((state.x[:, 1] > -0.051).all()) and record["time"] < failure.time
    assert str(failure.particle) in record["failure"]
    with Trajectory(tmp_path / "out") as read:
        assert 1 <= len(read) < 11


@pytest.mark.parametrize("quantity", ["velocity", "deformation"])
def test_what_went_first_is_found(quantity):
    built = Scene(**disc(device="cpu", gravity=None)).build("cpu")
    step, state = built.step, built.state

    def spoil(blocks, velocity, mass, dt):
        spoil.steps += 1
        if spoil.steps < 5:
            return velocity
        x = blocks.node_positions(velocity.dtype)[:, :1]
        turn_over = -1.5 * (x - 0.35) / dt * torch.tensor([1.0, 0.0])
        return torch.where(x < 0.4, math.nan if quantity == "velocity" else turn_over, velocity)

    spoil.steps = 0
    step.on_grid = spoil
    failure = replay(step, state, 1e-3, 20, 100, built.scenes)
    assert failure is not None and failure.step == 105
    assert quantity in failure.quantity
    row = int((failure.good.ids == failure.particle).nonzero())
    assert float(failure.good.x[row, 0]) < 0.5
    assert bool(failure.good.v.isfinite().all())


def test_an_unstable_run_says_that_dt_was_above_the_limit(tmp_path, monkeypatch):
    scene = Scene(**disc(device="cpu"))
    built = scene.build()
    simulation = module.Simulation(scene, built)
    monkeypatch.setattr(simulation, "_choose_dt", lambda span, rates: (0.05, 32))
    moving = built.state.x - 0.5
    simulation.state = built.state.replace(v=moving * 10)
    with pytest.raises(
        SimulationError, match=r"the time step 0.05 s is above the stability limit 0.00.* s; use dt = 0.00"
    ):
        with torch.no_grad():
            simulation._advance(0.0, 1.6)


def test_free_memory_goes_back_to_the_system() -> None:
    """A run stays small: what dead tensors leave below a living one on the heap is not kept."""
    if heap._malloc_trim is None:
        pytest.skip("the C library has no malloc_trim")

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    for _ in range(3):  # the C library learns to keep blocks of this size on its heap
        blocks = [torch.ones(200_000) for _ in range(300)]
        last = blocks.pop()
        blocks.clear()
        heap.trim()
    blocks = [torch.ones(200_000) for _ in range(300)]
    last = blocks.pop()
    full = resident()
    blocks.clear()
    heap.trim()
    assert resident() < full - 150e6 and float(last.sum()) == 200_000


# ---- longer segments, which a GPU takes


@pytest.fixture
def long_segments(monkeypatch):
    """The lengths of the segments that are tried."""
    monkeypatch.setitem(module.LONGEST_SEGMENT, "cpu", 256)
    taken, rollout = [], module.rollout

    def counted(step, state, n, dt):
        taken.append(n)
        return rollout(step, state, n, dt)

    monkeypatch.setattr(module, "rollout", counted)
    return taken


STEADY = {**PRECISE, "duration": 0.1, "fps": 10, "cfl": 0.01}


def test_segments_grow_while_the_limit_is_steady(tmp_path, long_segments):
    _, long, _ = simulate(tmp_path / "long", **STEADY)
    lengths, substeps = list(long_segments), sum(long_segments)
    assert lengths[:3] == [32, 64, 128] and max(lengths) <= 256
    module.LONGEST_SEGMENT["cpu"] = module.SEGMENT
    long_segments.clear()
    _, short, _ = simulate(tmp_path / "short", **STEADY)
    assert max(long_segments) == 32 and abs(sum(long_segments) - substeps) < 0.01 * substeps
    np.testing.assert_allclose(long["position"], short["position"], atol=1e-6)


def test_segments_stay_short_while_the_limit_changes(tmp_path, long_segments, monkeypatch):
    monkeypatch.setitem(module.UNSTEADY_SEGMENT, "cpu", 48)
    monkeypatch.setattr(module, "STEADY", 0.0)
    simulate(tmp_path / "out", **STEADY)
    assert long_segments[:3] == [32, 48, 48] and max(long_segments) == 48


def test_a_device_is_waited_for_once_per_segment(tmp_path, long_segments, monkeypatch):
    """The frame at the end of a segment is copied together with its survey."""
    waits, on_host = [], module.on_host
    monkeypatch.setattr(module, "on_host", lambda tensors: waits.append(list(tensors)) or on_host(tensors))
    _, data, _ = simulate(tmp_path / "out", **STEADY)
    assert len(waits) == len(long_segments) + 1
    assert sum("momentum" in names for names in waits) == len(data["time"]) < len(waits)


def test_a_long_segment_that_goes_wrong_is_taken_again_in_short_ones(tmp_path, long_segments, monkeypatch):
    """Where something is wrong at its end, and where dt was above the limit by then."""
    wanted, counted = simulate(tmp_path / "as it is", **STEADY)[1], module.rollout
    long_segments.clear()

    def fails(step, state, n, dt):
        end = counted(step, state, n, dt)
        if n > 32:
            raise SimulationError("too long")
        return end

    monkeypatch.setattr(module, "rollout", fails)
    _, data, _ = simulate(tmp_path / "again", **STEADY)
    assert set(long_segments) >= {32, 64} and max(long_segments) == 64
    np.testing.assert_allclose(data["position"], wanted["position"], atol=1e-6)

    def speeds_up(step, state, n, dt):
        end = counted(step, state, n, dt)
        return end.replace(v=1e6 * end.v) if n > 32 else end

    monkeypatch.setattr(module, "rollout", speeds_up)
    _, data, _ = simulate(tmp_path / "fast", **STEADY)
    np.testing.assert_allclose(data["position"], wanted["position"], atol=1e-6)
