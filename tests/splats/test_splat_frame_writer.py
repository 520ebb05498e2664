"""Files of frames that threads write: contents, errors, interrupts, and the number of frames in memory."""

import errno
import os
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from splat_objects import random_gaussians

from torch_mpm import splats
from torch_mpm.splats import frame_writer

FULL = "No space left on device"


def frames(count: int, device: str = "cpu", degree: int = 1) -> list[splats.Gaussians]:
    return [random_gaussians(50, degree, torch.float32, seed=k).to(device) for k in range(count)]


def broken(gaussians: splats.Gaussians) -> splats.Gaussians:
    harmonics = gaussians.harmonics.clone()
    harmonics[7, 2, 1] = torch.inf
    return gaussians.replace(harmonics=harmonics)


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def writing(monkeypatch):
    """Function that replaces the writing of a file by (original function, path, further arguments) -> size."""

    def replace(work):
        write_rows = frame_writer.write_rows
        monkeypatch.setattr(frame_writer, "write_rows", lambda *arguments: work(write_rows, *arguments))

    return replace


@pytest.mark.parametrize(("threads", "most"), [(1, 1), (3, 2), (4, 8)])
def test_files_are_those_of_write(threads, most, device, tmp_path):
    """Also where the tensors of a frame are overwritten after the call, as those of buffers are."""
    (tmp_path / "threads").mkdir()
    buffer = frames(1, device)[0]
    with splats.FrameWriter(threads, most) as files:
        for k, frame in enumerate(frames(9, device)):
            splats.write(tmp_path / f"{k}.ply", frame)
            for name in ("x", "axes", "opacity_logit", "harmonics"):
                getattr(buffer, name).copy_(getattr(frame, name))
            files.write(tmp_path / "threads" / f"{k}.ply", buffer)
    assert names(tmp_path / "threads") == [f"{k}.ply" for k in range(9)]
    for k in range(9):
        assert (tmp_path / "threads" / f"{k}.ply").read_bytes() == (tmp_path / f"{k}.ply").read_bytes()


def test_frames_of_several_sizes_and_no_gaussians(device, tmp_path):
    several = [random_gaussians(count, degree, seed=count).to(device) for count, degree in ((5, 0), (0, 3), (9, 2))]
    with splats.FrameWriter() as files:
        for k, frame in enumerate(several):
            files.write(tmp_path / f"{k}.ply", frame)
            splats.write(tmp_path / f"{k}_alone.ply", frame)
    for k in range(3):
        assert (tmp_path / f"{k}.ply").read_bytes() == (tmp_path / f"{k}_alone.ply").read_bytes()


@pytest.mark.parametrize("threads", [1, 4])
def test_a_frame_that_is_not_finite_is_named(threads, device, tmp_path):
    """The error is raised by a later frame or at the end; the frames before it are written."""
    several = frames(5, device)
    several[3] = broken(several[3])
    with pytest.raises(ValueError, match=r"3\.ply must be finite, and number 7 is not"):
        with splats.FrameWriter(threads) as files:
            for k, frame in enumerate(several):
                files.write(tmp_path / f"{k}.ply", frame)
    assert set(names(tmp_path)) - {"4.ply"} == {"0.ply", "1.ply", "2.ply"}


def test_numbers_whose_sum_overflows_are_written(device, tmp_path):
    large = random_gaussians(4, 0, torch.float32)
    large = large.replace(harmonics=torch.full_like(large.harmonics, 3e38)).to(device)
    with splats.FrameWriter() as files:
        files.write(tmp_path / "large.ply", large)
    assert torch.equal(splats.read(tmp_path / "large.ply").harmonics, large.harmonics.cpu())


@pytest.mark.parametrize("most", [1, 4])
def test_a_full_disk_is_named_and_ends_the_loop(most, tmp_path, monkeypatch):
    """The third synchronisation with the disk fails; then no file is begun, and none is left incomplete."""
    synchronise, done, begun = os.fsync, [], []

    def fails_once(handle):
        done.append(handle)
        if len(done) == 3:
            raise OSError(errno.ENOSPC, FULL)
        synchronise(handle)

    monkeypatch.setattr(os, "fsync", fails_once)
    with pytest.raises(OSError, match=FULL) as caught, splats.FrameWriter(1, most) as files:
        for k, frame in enumerate(frames(9)):
            begun.append(k)
            files.write(tmp_path / f"{k}.ply", frame)
    assert caught.value.filename == str(tmp_path / "2.ply")
    assert names(tmp_path) == ["0.ply", "1.ply"]
    assert len(begun) <= 3 + most and len(done) == 3


def test_an_error_is_raised_again_by_each_frame(tmp_path):
    """A loop that ignores it neither waits for ever nor ends without it."""
    several = frames(6)
    with pytest.raises(ValueError, match=r"0\.ply must be finite"), splats.FrameWriter(1, 1) as files:
        files.write(tmp_path / "0.ply", broken(several[0]))
        for k in range(1, 6):
            with pytest.raises(ValueError, match=r"0\.ply must be finite"):
                files.write(tmp_path / f"{k}.ply", several[k])
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("in_loop", "at_end", "kept"),
    [
        (ZeroDivisionError(), None, range(4)),
        (KeyboardInterrupt(), None, range(1)),
        (None, KeyboardInterrupt(), range(1)),
    ],
    ids=["error", "Ctrl-C", "Ctrl-C at the end"],
)
def test_an_error_of_the_loop(in_loop, at_end, kept, writing, monkeypatch, tmp_path):
    """Frames before an error are written; Ctrl-C discards those whose files are not begun. No file is incomplete."""
    begun, ended = threading.Event(), threading.Event()
    shutdown, errors = ThreadPoolExecutor.shutdown, [at_end] if at_end else []

    def slow(write_rows, path, *rest):
        begun.set()
        assert ended.wait(10)
        return write_rows(path, *rest)

    def stopped(executor, cancel_futures):
        if errors:
            raise errors.pop()
        shutdown(executor, wait=False, cancel_futures=cancel_futures)
        ended.set()
        shutdown(executor)

    writing(slow)
    monkeypatch.setattr(ThreadPoolExecutor, "shutdown", stopped)
    with pytest.raises(type(in_loop or at_end)), splats.FrameWriter(threads=1) as files:
        for k, frame in enumerate(frames(4)):
            files.write(tmp_path / f"{k}.ply", frame)
        assert begun.wait(10)
        if in_loop:
            raise in_loop
    assert names(tmp_path) == [f"{k}.ply" for k in kept]


def test_an_error_of_a_thread_beside_one_of_the_loop(tmp_path):
    """Both are reported: that of the thread, whose file is missing, with that of the loop as its context."""
    with pytest.raises(ValueError, match=r"0\.ply must be finite") as caught, splats.FrameWriter() as files:
        files.write(tmp_path / "0.ply", broken(frames(1)[0]))
        raise ZeroDivisionError
    assert isinstance(caught.value.__context__, ZeroDivisionError)


@pytest.mark.parametrize(("threads", "most"), [(2, 3), (4, 2)])
def test_the_number_of_frames_in_memory(threads, most, writing, monkeypatch, tmp_path):
    """Files are begun when there are as many frames as may be; one more would be seen within the time of a wait."""
    total, begun, ended, largest = 8, 0, 0, 0
    changed = threading.Condition()
    rows_of = frame_writer.rows_of

    def assembled(gaussians):
        nonlocal begun, largest
        with changed:
            begun += 1
            largest = max(largest, begun - ended)
            changed.notify_all()
        return rows_of(gaussians)

    def wait_for_one_too_many(write_rows, path, *rest):
        nonlocal ended
        with changed:
            assert changed.wait_for(lambda: begun - ended >= most or begun == total, 10)
            changed.wait_for(lambda: begun - ended > most, 0.02)
        size = write_rows(path, *rest)
        with changed:
            ended += 1
            changed.notify_all()
        return size

    monkeypatch.setattr(frame_writer, "rows_of", assembled)
    writing(wait_for_one_too_many)
    with splats.FrameWriter(threads, most) as files:
        for k, frame in enumerate(frames(total)):
            files.write(tmp_path / f"{k}.ply", frame)
    assert (begun, ended, largest) == (total, total, most)


def test_calls_that_do_not_fit_are_named(tmp_path):
    frame = frames(1)[0]
    for words, message in (
        ({"threads": 0}, "threads must be at least 1, got 0"),
        ({"threads": 1.5}, "threads must be a whole number, got float 1.5"),
        ({"most": -1}, "most must be at least 1, got -1"),
        ({"most": True}, "most must be a whole number, got bool True"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            splats.FrameWriter(**words)
    files = splats.FrameWriter()
    with pytest.raises(RuntimeError, match="in the context of a FrameWriter"):
        files.write(tmp_path / "a.ply", frame)
    (tmp_path / "link").symlink_to(tmp_path)
    with files:
        files.write(tmp_path / "a.ply", frame)
        with pytest.raises(ValueError, match=r"path must be another one for each frame, got .*link/a\.ply twice"):
            files.write(tmp_path / "link" / "a.ply", frame)
        with pytest.raises(TypeError, match="gaussians must be Gaussians, got int"):
            files.write(tmp_path / "b.ply", 3)
        with pytest.raises(RuntimeError, match="has begun already"):
            files.__enter__()
    with pytest.raises(RuntimeError, match="in the context of a FrameWriter"):
        files.write(tmp_path / "c.ply", frame)
    assert names(tmp_path) == ["a.ply", "link"]


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(FileNotFoundError) as caught, splats.FrameWriter() as files:
        files.write(tmp_path / "none" / "a.ply", frames(1)[0])
    assert caught.value.filename == str(tmp_path / "none" / "a.ply")
