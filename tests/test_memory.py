"""Errors of memory of all libraries are recognised, and name the amount that was requested."""

import errno
import os
import sys

import numpy as np
import pytest
import torch

from torch_mpm import cli, optional
from torch_mpm.data import host_memory


def raised(work):
    with pytest.raises(Exception) as info:
        work()
    return info.value


SHORT = [
    MemoryError(),
    OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
    OSError("Can't synchronously read data (memory allocation failed for data chunk)"),
    OSError("Unable to synchronously open file (unable to allocate memory block)"),
    RuntimeError("std::bad_alloc"),
    RuntimeError("can't start new thread"),
    ImportError("libvtkCommonCore.so: failed to map segment from shared object"),
    ImportError("libhdf5.so: cannot allocate memory"),
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
]
OTHERS = [
    ValueError("E must be positive"),
    OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    OSError("Can't synchronously read data (inflate() failed)"),
    ImportError("libGL.so.1: cannot open shared object file"),
    None,
]


@pytest.mark.parametrize("error", SHORT, ids=str)
def test_errors_of_memory(error):
    assert host_memory.is_short(error)
    other = ValueError("the scene cannot be read")
    other.__cause__ = error
    assert host_memory.is_short(other)


@pytest.mark.parametrize("error", OTHERS, ids=str)
def test_other_errors(error):
    assert not host_memory.is_short(error)


def test_errors_of_numpy_and_torch_say_what_was_wanted():
    of_torch = raised(lambda: torch.empty(2**60, dtype=torch.int8))
    of_numpy = raised(lambda: np.empty(2**60, np.int8))
    assert host_memory.is_short(of_torch) and host_memory.shortage(of_torch).startswith("1.15e+09 GB were wanted; ")
    assert host_memory.is_short(of_numpy) and "Unable to allocate 1.00 EiB" in host_memory.shortage(of_numpy)


def test_the_limit_of_the_process_counts(monkeypatch):
    taken = host_memory.available
    limit = 2**60
    monkeypatch.setattr(host_memory.resource, "getrlimit", lambda kind: (limit, limit))
    assert taken() < 2**60
    limit = 2**20  # below what is taken
    assert host_memory.available() == 0
    with pytest.raises(MemoryError, match=r"a picture takes about 1\.5 GB, and 0 bytes are available"):
        host_memory.require(1.5e9, "a picture")
    assert "of the 1.05 MB of address space that this process may take" in host_memory.shortage(MemoryError())


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (ModuleNotFoundError("No module named 'foreign'", name="foreign"), ImportError, r"not installed: pip install"),
        (ModuleNotFoundError("No module named 'other'", name="other"), ImportError, "is installed and cannot be"),
        (
            ImportError("libx.so: cannot open shared object file"),
            ImportError,
            "is installed and cannot be imported: libx",
        ),
        (ImportError("libx.so: failed to map segment from shared object"), MemoryError, "too little memory to import"),
        (MemoryError(), MemoryError, "too little memory to import"),
        (OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), MemoryError, "too little memory to import"),
    ],
)
def test_an_installed_package_is_not_called_missing(monkeypatch, error, kind, message):
    class Finder:
        @staticmethod
        def find_spec(name, path=None, target=None):
            if name == "foreign":
                raise error

    monkeypatch.setattr(sys, "meta_path", [Finder, *sys.meta_path])
    with pytest.raises(kind, match=message):
        optional.load("foreign.part", "pictures", "render")


def test_an_interrupt_during_an_import_waits_for_its_end(monkeypatch, tmp_path):
    """Packages in C++ turn it into another error."""
    (tmp_path / "foreign.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\ncomplete = True\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "foreign", raising=False)
    with pytest.raises(KeyboardInterrupt):
        optional.load("foreign", "pictures", "render")
    assert sys.modules.pop("foreign").complete


def test_the_command_line_says_what_was_wanted(monkeypatch, capsys):
    def command(options):
        torch.empty(2**60, dtype=torch.int8)

    monkeypatch.setattr(cli, "_schema", command)
    assert cli.main(["schema"]) == 1
    assert capsys.readouterr().err.startswith("torch-mpm: out of memory: 1.15e+09 GB were wanted; ")


def test_too_little_address_space_is_an_error_before_compiled_code_ends_the_process(monkeypatch, capsys):
    pytest.importorskip("h5py")
    from torch_mpm.data.hdf5 import h5py_module

    monkeypatch.setattr(host_memory, "_of_process", lambda: 1e6)
    h5py_module()  # without a limit, all free memory
    monkeypatch.setattr(host_memory, "_limit", lambda: 10**9)
    with pytest.raises(MemoryError, match=r"HDF5 takes about 16\.8 MB of address space, and 1 MB are available"):
        h5py_module()
    assert cli.main(["schema"]) == 1
    assert "out of memory: a command with the packages that it imports takes about 67.1 MB" in capsys.readouterr().err


def test_memory_that_cannot_be_looked_at_is_none(monkeypatch):
    def short():
        raise MemoryError

    monkeypatch.setattr(host_memory, "_of_machine", short)
    assert host_memory.available() == 0.0 and "0 bytes are free" in host_memory.shortage(MemoryError("x"))
