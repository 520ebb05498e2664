"""Targets that setup.py builds, by machine."""

from pathlib import Path

import pytest

import setup


def program(directory: Path, name: str, prints: str = "", status: int = 0) -> None:
    file = directory / name
    file.write_text(f"#!/bin/sh\necho '{prints}'\nexit {status}\n")
    file.chmod(0o755)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that stands for /dev and holds the programs of a machine that has nvcc and no GPU."""
    monkeypatch.setattr(setup, "DEVICE_FILES", tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("CUDA_HOME", "TORCH_MPM_CUDA"):
        monkeypatch.delenv(name, raising=False)
    program(tmp_path, "nvcc")
    return tmp_path


def test_a_build_in_place_compiles_cuda_for_a_gpu_only(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not setup.cuda_wanted(native=True)
    assert "TORCH_MPM_CUDA=1 builds it" in capsys.readouterr().out
    (machine / "nvidia0").touch()
    assert setup.cuda_wanted(native=True)


def test_a_wheel_has_cuda_where_nvcc_is_found(machine: Path) -> None:
    assert setup.cuda_wanted(native=False)
    (machine / "nvcc").unlink()
    assert not setup.cuda_wanted(native=False)
    (machine / "nvidia0").touch()
    assert not setup.cuda_wanted(native=True)


@pytest.mark.parametrize("native", [True, False])
def test_the_variable_decides_where_it_is_set(machine: Path, monkeypatch: pytest.MonkeyPatch, native: bool) -> None:
    monkeypatch.setenv("TORCH_MPM_CUDA", "1")
    assert setup.cuda_wanted(native)
    (machine / "nvidia0").touch()
    monkeypatch.setenv("TORCH_MPM_CUDA", "0")
    assert not setup.cuda_wanted(native)
    monkeypatch.setenv("TORCH_MPM_CUDA", "yes")
    with pytest.raises(SystemExit, match="TORCH_MPM_CUDA must be 0, 1, check or unset, got 'yes'"):
        setup.cuda_wanted(native)


@pytest.mark.parametrize(
    ("release", "choice", "option"),
    [
        ("13.0", "check", setup.NVCC_FAST_COMPILE),
        ("12.9", "check", setup.NVCC_FAST_COMPILE),
        ("12.8", "check", "-Xfatbin=-compress-all"),
        ("12.9", "1", "-Xfatbin=-compress-all"),
        ("13.0", "1", "--compress-mode=size"),
    ],
)
def test_options_of_nvcc_are_those_of_its_release(
    machine: Path, monkeypatch: pytest.MonkeyPatch, release: str, choice: str, option: str
) -> None:
    program(machine, "nvcc", f"Cuda compilation tools, release {release}, V{release}.88")
    monkeypatch.setenv("TORCH_MPM_CUDA", choice)
    assert setup.cuda_wanted(native=True)
    options = setup.nvcc_flags()
    assert option in options
    assert (setup.NVCC_FAST_COMPILE in options) == (option == setup.NVCC_FAST_COMPILE)


def test_a_wheel_of_slow_kernels_is_refused(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_MPM_CUDA", "check")
    assert setup.cuda_wanted(native=True)
    with pytest.raises(SystemExit, match="TORCH_MPM_CUDA=check compiles slow kernels, which no wheel may have"):
        setup.cuda_wanted(native=False)


@pytest.mark.parametrize("choice", ["1", "check"])
def test_cuda_without_its_compiler_is_refused(machine: Path, monkeypatch: pytest.MonkeyPatch, choice: str) -> None:
    (machine / "nvcc").unlink()
    monkeypatch.setenv("TORCH_MPM_CUDA", choice)
    with pytest.raises(SystemExit, match="nvcc is neither in CUDA_HOME/bin nor in PATH"):
        setup.cuda_wanted(native=True)


@pytest.mark.parametrize(
    ("prints", "status", "present"),
    [
        ("GPU 0: NVIDIA H100 80GB HBM3 (UUID: GPU-0)", 0, True),
        ("No devices found.", 0, False),
        ("NVIDIA-SMI has failed: GPU access blocked by the operating system", 9, False),
    ],
)
def test_a_gpu_without_device_files_is_listed_by_the_driver(
    machine: Path, prints: str, status: int, present: bool
) -> None:
    program(machine, "nvidia-smi", prints, status)
    assert setup.gpu_present() == present


def test_a_build_in_place_has_one_instruction_set_and_a_wheel_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TORCH_MPM_ISA_LEVELS", raising=False)
    monkeypatch.setattr(setup.platform, "machine", lambda: "x86_64")
    assert list(setup.isa_levels(native=True)) == [setup.best_level()]
    assert list(setup.isa_levels(native=False)) == ["baseline", "avx2", "avx512"]
