"""Unfinished files: commands leave none after SIGTERM, and the next call removes those that a kill has left."""

import os
import signal
import subprocess
import sys
import threading
import weakref

import pytest

pytest.importorskip("h5py")

import small_dataset as datasets
from helpers import scene_command

from torch_mpm import cli
from torch_mpm.cli import main
from torch_mpm.data import export_gns
from torch_mpm.data.whole_files import LEFTOVER, building_path, remove_leftovers, write_whole


def process_that_is_gone() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_only_what_nobody_finishes_any_more_is_removed(tmp_path, monkeypatch):
    own = building_path(tmp_path / "video.mp4", ".mp4")
    gone = process_that_is_gone()
    monkeypatch.setattr(os, "getpid", lambda: gone)
    left = building_path(tmp_path / "video.mp4", ".mp4")
    monkeypatch.setattr("socket.gethostname", lambda: "another.machine")
    elsewhere = building_path(tmp_path / "video.mp4", ".mp4")
    monkeypatch.undo()
    others = [tmp_path / name for name in (".mine.building", "gns", ".x.building.d", ".a.1-2.other")]
    for path in (own, left, elsewhere, *others):
        path.write_text("x")
    folder = left.with_name(left.name.replace("video", "gns"))
    (folder / "inner").mkdir(parents=True)
    (folder / "inner" / "file").write_text("x")
    (folder / "link").symlink_to(tmp_path / "gns")
    remove_leftovers(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([own, elsewhere, *others])


@pytest.mark.thorough(command="render")
@pytest.mark.parametrize("command", ["export", "export --vtk", "generate", "render"])
def test_the_next_call_removes_what_a_kill_has_left(tmp_path, monkeypatch, command):
    path = datasets.make_dataset(tmp_path / "set")
    place = {"export": path, "export --vtk": path, "generate": path / "shards", "render": path / "pictures"}[command]
    place.mkdir(exist_ok=True)
    gone = process_that_is_gone()
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: gone)
        left = building_path(place / "scenes.mp4", ".mp4")
    left.write_text("x")
    if command == "export":
        export_gns(path)
    elif command == "generate":
        from torch_mpm.data.claim import Claim
        from torch_mpm.data.workers import worker

        with Claim(path, datasets.record(), "", worker()):
            pass
    elif command == "render":
        pytest.importorskip("matplotlib")
        pytest.importorskip("PIL")
        assert main(["render", str(path), "--no-video"]) == 0
    else:
        pytest.importorskip("meshio")
        assert main(["export", str(path), "--vtk"]) == 0
    assert not left.exists() and not list(path.rglob(".*building*"))


@pytest.mark.parametrize("complete", [False, True])
def test_a_run_that_is_resumed_removes_what_a_kill_has_left(tmp_path, monkeypatch, complete):
    pytest.importorskip("pydantic")
    words, out = scene_command(tmp_path, "run", "seed=1"), tmp_path / "out"
    out.mkdir()
    if complete:
        assert main(words) == 0
    names = ("checkpoint.h5", "trajectory.partial.h5", "run.json")
    gone = process_that_is_gone()
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: gone)
        left = [building_path(out / name) for name in names] + [out / "checkpoint.h5"] * complete
    for path in left:
        path.write_text("x")
    assert main([*words, "--resume"]) == 0
    assert sorted(p.name for p in out.iterdir()) == ["run.json", "run.lock", "trajectory.h5"]


def test_files_of_a_run_are_those_of_a_process_while_they_are_written(tmp_path, monkeypatch):
    """So that another process can detect whether the writer is alive."""
    pytest.importorskip("pydantic")
    words, seen, fsync = scene_command(tmp_path, "run", "seed=1"), [], os.fsync
    monkeypatch.setattr("torch_mpm.scene.writer.CHECKPOINT_SECONDS", 0.0)

    def synced(handle):
        seen.extend(p.name for p in (tmp_path / "out").iterdir())
        fsync(handle)

    monkeypatch.setattr(os, "fsync", synced)
    assert main(words) == 0
    assert not [name for name in seen if name.endswith(".building") and not LEFTOVER.search(name)]
    assert {building_path(tmp_path / "out" / name).name for name in ("trajectory.partial.h5", "checkpoint.h5")} <= {
        *seen
    }


def test_termination_is_an_exception_of_commands(tmp_path, monkeypatch, capsys):
    """The file being written is removed."""
    path = datasets.make_dataset(tmp_path / "set")
    written = []

    def terminated(file, *arguments, **options):
        file.write(b"half")
        written.append(list(path.glob(".gns.*.building/*")))
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("SIGTERM comes at once")

    monkeypatch.setattr("torch_mpm.data.exports.gns.np.savez", lambda path, **_: terminated(open(path, "wb")))
    before = signal.getsignal(signal.SIGTERM)
    assert main(["export", str(path), "--format", "gns"]) == 143
    assert "terminated" in capsys.readouterr().err and len(written[0]) == 1
    assert not (path / "gns").exists() and not list(path.glob(".*")) and signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_that_python_drops_come_again(monkeypatch, capfd, number, status):
    """As in callbacks of weak references, whose exceptions are printed alone."""

    class Target:
        pass

    def command(options):
        target = Target()
        reference = weakref.ref(target, lambda _: signal.raise_signal(number))
        del target
        threading.Event().wait(20.0)
        assert reference is None, "the signal was lost"

    monkeypatch.setattr("torch_mpm.cli._schema", command)
    assert main(["schema"]) == status and "Traceback" not in capfd.readouterr().err


def test_signals_that_a_library_makes_another_error_of(monkeypatch, capsys):
    def command(options):
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise ValueError("Invalid bounding box") from None  # as compiled code that was called with a list

    monkeypatch.setattr("torch_mpm.cli._schema", command)
    assert main(["schema"]) == 143 and capsys.readouterr().err == "torch-mpm: terminated\n"


def test_commands_in_threads_leave_signals_alone(tmp_path):
    path, status = datasets.make_dataset(tmp_path / "set"), []
    thread = threading.Thread(target=lambda: status.append(main(["export", str(path), "--format", "gns"])))
    thread.start()
    thread.join()
    assert status == [0]


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(handle):
        raise cli.Terminated

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "a.json", b"1")
    assert list(tmp_path.iterdir()) == []
