"""The built package: its libraries, their needs from torch, and the report of `info`."""

import ast
import json
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import torch_mpm
from torch_mpm import _library
from torch_mpm.info import info

PACKAGE = Path(torch_mpm.__file__).parent
LIBRARIES = [path for path in (_library.CPU_LIBRARY, _library.CUDA_LIBRARY) if path.exists()]


def symbols(library: Path, which: str) -> list[str]:
    if shutil.which("nm") is None:
        pytest.skip("nm is not installed")
    command = ["nm", "--dynamic", "--demangle", which, str(library)]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return [line.split(maxsplit=1)[1] if which == "--undefined-only" else line for line in lines]


@pytest.mark.parametrize("library", LIBRARIES, ids=lambda path: path.stem)
def test_library_uses_only_the_stable_abi_of_torch(library: Path) -> None:
    unstable = [name for name in symbols(library, "--undefined-only") if "c10::" in name or "at::" in name]
    assert unstable == []


@pytest.mark.parametrize("library", LIBRARIES, ids=lambda path: path.stem)
def test_library_defines_all_functions_of_its_own(library: Path) -> None:
    assert [name for name in symbols(library, "--undefined-only") if "mpm::" in name] == []


@pytest.mark.parametrize("library", LIBRARIES, ids=lambda path: path.stem)
def test_library_exports_none_of_its_functions(library: Path) -> None:
    assert [name for name in symbols(library, "--defined-only") if "mpm::" in name] == []


AVX_NAMES = "avx2", "avx512"
"""Part of the name of each function of a level above the baseline."""


@pytest.fixture(scope="module")
def functions() -> list[tuple[str, list[str]]]:
    """Functions of the CPU library, with their instructions."""
    if shutil.which("objdump") is None:
        pytest.skip("objdump is not installed")
    if platform.machine() != "x86_64":
        pytest.skip("other processors have one instruction-set level")
    command = ["objdump", "--disassemble", "--demangle", "--no-show-raw-insn", str(_library.CPU_LIBRARY)]
    found: list[tuple[str, list[str]]] = []
    for line in subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines():
        if line.endswith(">:"):
            found.append((line, []))
        elif found and "\t" in line:
            found[-1][1].append(line)
    return found


def of_avx(name: str) -> bool:
    return any(level in name for level in AVX_NAMES)


@pytest.mark.thorough
def test_only_code_of_the_avx_levels_uses_avx(functions: list[tuple[str, list[str]]]) -> None:
    """An inline function merged across levels must be the one that every x86-64 processor can run."""
    avx = {name for name, lines in functions if any("%ymm" in line or "%zmm" in line for line in lines)}
    assert bool(avx) == bool(set(AVX_NAMES) & set(info()["build"]["cpu"]["isa"]))
    assert [name for name in avx if not of_avx(name)] == []


@pytest.mark.thorough
def test_code_that_runs_at_load_uses_no_avx(functions: list[tuple[str, list[str]]]) -> None:
    """A processor without AVX-512 loads the library too: initialisers of its levels may not call their code."""
    names = "<_GLOBAL__sub_I_", "__static_initialization_and_destruction"
    initialisers = [(name, lines) for name, lines in functions if any(part in name for part in names)]
    assert len(initialisers) > len(AVX_NAMES)  # laws register themselves
    for name, lines in initialisers:
        wrong = [line for line in lines if re.search(r"%[yz]mm|\tv[a-z]", line) or ("call" in line and of_avx(line))]
        assert wrong == [], name


def test_info_describes_build_and_devices() -> None:
    values = info()
    assert values["torch"] == torch.__version__
    assert set(values["build"]["cpu"]["isa"]) <= {"baseline", "avx2", "avx512"}
    assert values["cuda"]["usable"] or values["cuda"]["reason"]
    assert values["cuda"]["usable"] == (torch.cuda.is_available() and _library.cuda_error is None)


@pytest.mark.thorough
def test_command_line_prints_info() -> None:
    command = [sys.executable, "-m", "torch_mpm", "info"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert f"torch: {torch.__version__}" in output


def imported_modules(path: Path) -> set[str]:
    """Full names of all imports of a module of the package."""
    package = ("torch_mpm", *path.relative_to(PACKAGE).parts[:-1])
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return found


def test_production_imports_neither_tests_nor_benchmarks() -> None:
    others = {"benchmarks", "cases", "helpers", "oracle", "tests"}
    paths = list(PACKAGE.rglob("*.py"))
    assert len(paths) > 50
    imports = {path: {name.partition(".")[0] for name in imported_modules(path)} for path in paths}
    assert [path for path, names in imports.items() if names & others] == []


def copy_package(directory: Path, *left_out: str) -> None:
    shutil.copytree(PACKAGE, directory / "torch_mpm", ignore=shutil.ignore_patterns("__pycache__", *left_out))


def run_python(directory: Path, script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", script], cwd=directory, capture_output=True, text=True)


@pytest.mark.thorough
def test_import_without_libraries_says_how_to_build(tmp_path: Path) -> None:
    copy_package(tmp_path, "*.so")
    result = run_python(tmp_path, "import torch_mpm")
    assert "ImportError: torch_mpm is not built" in result.stderr
    assert "make build" in result.stderr


def test_import_of_a_foreign_library_names_the_file(tmp_path: Path) -> None:
    copy_package(tmp_path, "*.so")
    library = tmp_path / "torch_mpm" / "lib" / _library.CPU_LIBRARY.name
    library.write_bytes(b"not a shared library")
    result = run_python(tmp_path, "import torch_mpm")
    assert f"ImportError: torch_mpm cannot load {library}" in result.stderr


@pytest.mark.thorough
def test_info_says_that_the_cuda_library_is_missing(tmp_path: Path) -> None:
    copy_package(tmp_path, _library.CUDA_LIBRARY.name)
    result = run_python(tmp_path, "import json; from torch_mpm.info import info; print(json.dumps(info()['cuda']))")
    assert json.loads(result.stdout)["usable"] is False, result.stderr
    assert "built without its CUDA library" in json.loads(result.stdout)["reason"]


@pytest.mark.thorough
def test_old_names_of_modules_are_the_same_modules() -> None:
    program = (
        "import torch_mpm; import torch_mpm.heat_boundaries as old; import torch_mpm.heat.boundaries as new; "
        "from torch_mpm.heat_boundaries import Flux; assert old is new is torch_mpm.heat_boundaries; "
        "assert Flux is new.Flux"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
