"""Distributed packages: source distribution, metadata and licence."""

import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
APACHE = "cfc7749b96f63bd31c3c42b5c471bf756814053e847c10f3eb003417bc523d30"
"""SHA-256 of https://www.apache.org/licenses/LICENSE-2.0.txt."""
GENERATED = re.compile(r"PKG-INFO|setup\.cfg|torch_mpm\.egg-info/.*")


def tracked(*others: str) -> list[str]:
    """The files of the repository; with "--others" also those that are about to be."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git repository")
    command = ["git", "ls-files", "--cached", "--exclude-standard", *others]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()


@pytest.fixture(scope="module")
def clean_copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the repository alone."""
    copy = tmp_path_factory.mktemp("sources")
    for name in tracked("--others"):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, copy / name)
    return copy


def setup(directory: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "setup.py", "-q", *words]
    return subprocess.run(command, cwd=directory, env={**os.environ, **environment}, capture_output=True, text=True)


def test_source_distribution_has_every_tracked_file(clean_copy: Path, tmp_path: Path) -> None:
    done = setup(clean_copy, "sdist", "--dist-dir", str(tmp_path))
    assert done.returncode == 0, done.stderr
    (archive,) = tmp_path.iterdir()
    with tarfile.open(archive) as contents:
        names = {member.name.partition("/")[2] for member in contents if member.isfile()}
    names = {name for name in names if not GENERATED.fullmatch(name)}
    assert set(tracked()) <= names <= set(tracked("--others"))


def test_metadata_names_licence_and_authors(clean_copy: Path, tmp_path: Path) -> None:
    done = setup(clean_copy, "dist_info", "--output-dir", str(tmp_path))
    assert done.returncode == 0, done.stderr
    (directory,) = tmp_path.glob("*.dist-info")
    metadata = (directory / "METADATA").read_text()
    for line in ("License-Expression: Apache-2.0", "License-File: LICENSE", "Author: The torch_mpm authors"):
        assert line in metadata.splitlines()
    assert (directory / "licenses" / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()


def test_wheel_without_libraries_is_refused(clean_copy: Path, tmp_path: Path) -> None:
    done = setup(clean_copy, "bdist_wheel", "--dist-dir", str(tmp_path), TORCH_MPM_SKIP_BUILD="1")
    assert done.returncode != 0
    assert "TORCH_MPM_SKIP_BUILD=1 leaves the libraries out" in done.stderr
    assert list(tmp_path.iterdir()) == []


COMPILER = """#!/bin/sh
while [ $# -gt 0 ]; do
  case $1 in --version) echo "stub release 1.0" ;; -o) touch "$2" ;; esac
  shift
done
"""


def test_wheel_has_the_libraries_of_every_machine(clean_copy: Path, tmp_path: Path) -> None:
    """Built by a compiler that writes empty files: which are compiled and packed, not what is in them."""
    (tmp_path / "bin").mkdir()
    for name in ("nvcc", "g++"):
        (tmp_path / "bin" / name).write_text(COMPILER)
        (tmp_path / "bin" / name).chmod(0o755)
    compilers = {"CXX": str(tmp_path / "bin" / "g++"), "CUDA_HOME": str(tmp_path)}
    unset = dict.fromkeys(("TORCH_MPM_CUDA", "TORCH_MPM_CUDA_ARCHS", "TORCH_MPM_ISA_LEVELS", "TORCH_MPM_SANITIZE"), "")
    done = setup(clean_copy, "bdist_wheel", "--dist-dir", str(tmp_path / "dist"), **compilers, **unset)
    assert done.returncode == 0, done.stderr
    (archive,) = (tmp_path / "dist").glob("torch_mpm-*-py3-none-*.whl")
    with zipfile.ZipFile(archive) as contents:
        names = set(contents.namelist())
        build = json.loads(contents.read("torch_mpm/lib/build.json"))
    libraries = {"torch_mpm/lib/libtorch_mpm_cpu.so", "torch_mpm/lib/libtorch_mpm_cuda.so", "torch_mpm/py.typed"}
    assert libraries | {name for name in tracked("--others") if name.startswith("torch_mpm/")} <= names
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"torch_mpm"}, "tests are not in the wheel"
    assert build["cuda"]["archs"] == ["8.0", "9.0"]
    assert build["cpu"]["isa"] == (["baseline", "avx2", "avx512"] if platform.machine() == "x86_64" else ["baseline"])


def test_editable_install_needs_no_libraries(clean_copy: Path, tmp_path: Path) -> None:
    done = setup(clean_copy, "editable_wheel", "--dist-dir", str(tmp_path), TORCH_MPM_SKIP_BUILD="1")
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("*.whl"))) == 1


def test_licence_is_the_standard_text() -> None:
    text = (ROOT / "LICENSE").read_text()
    owner = re.search(r"^   Copyright \d{4} (The torch_mpm authors)$", text, re.MULTILINE)
    assert owner
    standard = text.replace(owner[0], "   Copyright [yyyy] [name of copyright owner]")
    assert hashlib.sha256(standard.encode()).hexdigest() == APACHE


def test_citation_agrees_with_the_metadata() -> None:
    project = dict(
        re.findall(r'^(name|version|license) = "(.*)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    )
    citation = dict(re.findall(r"^([\w-]+): (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    assert {"cff-version", "message", "title", "version", "license"} <= citation.keys()
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
