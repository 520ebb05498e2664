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

from torch_mpm import cli
from torch_mpm.cli import main
from torch_mpm.data import export_gns
from torch_mpm.data.whole_files import building_path, remove_leftovers, write_whole


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


def test_termination_is_an_exception_of_commands(tmp_path, monkeypatch, capsys):
    """What is being written is removed on the way out."""
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
