"""Builds the native libraries of torch_mpm with ninja.

torch is located but never imported, so metadata phases (egg_info, dist_info, sdist) work without it. Both libraries use
the LibTorch stable ABI, so a CPU build of torch is enough to compile the CUDA library.
"""

from __future__ import annotations

import fcntl
import functools
import importlib.util
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

from build_backend import torch_directory

ROOT = Path(__file__).resolve().parent
CSRC = ROOT / "csrc"
DEVICE_FILES = Path("/dev")

# The oldest torch whose stable ABI the libraries require: 2.11.
TORCH_TARGET_VERSION = "0x020b000000000000"

# No option here gives up the value of an expression, unlike -ffast-math: errno and the floating-point exception flags
# are never read, and contraction only replaces a product and a sum by one fused, more exact operation (nvcc does the
# same by default). NaN, infinity, signed zero and the order of operations are kept.
CPU_FLAGS = ["-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"]
COMMON_FLAGS = ["-std=c++20", f"-DTORCH_TARGET_VERSION={TORCH_TARGET_VERSION}"]
# Objects are made in build/<platform>; checks report __FILE__ relative to the source tree.
UP = "../../"
HOST_FLAGS = ["-fPIC", "-fvisibility=hidden", "-Wall", f"-ffile-prefix-map={UP}="]
# One thread of nvcc per architecture (--threads).
NVCC_THREADS = 2
# Device code that calls a function of the host alone would compile with a warning, and the call would do nothing.
NVCC_FLAGS = [
    "--expt-relaxed-constexpr",
    "--Werror",
    "cross-execution-space-call",
    f"--threads={NVCC_THREADS}",
]

# Files *.op.cpp are host code, which launches kernels: with -O2 it is a seventh smaller.
NVCC_LEVELS = {"nvcc": "-O3", "nvcc_host": "-O2"}

# Compiles the kernels of a law in a tenth of the time; the kernels are several times slower (CUDA 12.9 or newer).
NVCC_FAST_COMPILE = "--Ofast-compile=max"

# Definitions that distinguish the objects of one source.
VARIANTS = ("-DTORCH_MPM_ISA=", "-DMPM_SCALAR=", "-DMPM_DIMENSION=", "-DMPM_LAW_HEADER=")

# Files csrc/*/**/*.cpu.cpp are compiled once per level, in the namespace named by TORCH_MPM_ISA.
X86_LEVELS = {"baseline": "x86-64", "avx2": "x86-64-v3", "avx512": "x86-64-v4"}


def isa_levels(native: bool) -> dict[str, list[str]]:
    """Compiler options of the instruction-set levels to build: all of this architecture, or only the best of this
    machine.

    TORCH_MPM_ISA_LEVELS, "all" or "native", overrides the default.
    """
    choice = os.environ.get("TORCH_MPM_ISA_LEVELS") or ("native" if native else "all")
    if choice not in ("all", "native"):
        raise SystemExit(f"TORCH_MPM_ISA_LEVELS must be all, native or unset, got {choice!r}")
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return {"baseline": []}
    levels = {name: [f"-march={march}"] for name, march in X86_LEVELS.items()}
    if choice == "all":
        return levels
    best = best_level()
    return {best: levels[best]}


def best_level() -> str:
    """The best instruction-set level of this machine, as the compiler sees it."""
    command = [os.environ.get("CXX", "g++"), "-march=native", "-dM", "-E", "-x", "c++", os.devnull]
    macros = set(re.findall(r"#define (__\w+__) 1", subprocess.run(command, capture_output=True, text=True).stdout))
    if {"__AVX512F__", "__AVX512BW__", "__AVX512CD__", "__AVX512DQ__", "__AVX512VL__"} <= macros:
        return "avx512"
    return "avx2" if {"__AVX2__", "__FMA__", "__BMI2__", "__F16C__", "__LZCNT__", "__MOVBE__"} <= macros else "baseline"


def cuda_wanted(native: bool) -> bool:
    """Whether to build the CUDA library: where nvcc is found and, if for this machine only, it has a GPU.

    TORCH_MPM_CUDA, 1, 0 or check, overrides this.
    """
    choice = os.environ.get("TORCH_MPM_CUDA", "")
    if choice not in ("", "0", "1", "check"):
        raise SystemExit(f"TORCH_MPM_CUDA must be 0, 1, check or unset, got {choice!r}")
    if choice == "check" and not native:
        raise SystemExit("TORCH_MPM_CUDA=check compiles slow kernels, which no wheel may have: use 1, 0 or unset")
    required = choice in ("1", "check")
    if required and nvcc() is None:
        raise SystemExit(f"TORCH_MPM_CUDA={choice}, but nvcc is neither in CUDA_HOME/bin nor in PATH")
    if choice or nvcc() is None:
        return required
    if native and not gpu_present():
        print("The CUDA library is left out, since this machine has no GPU; TORCH_MPM_CUDA=1 builds it all the same.")
        return False
    return True


def gpu_present() -> bool:
    """Whether this machine has an NVIDIA GPU: a device file of its driver, or one that nvidia-smi lists."""
    if any(DEVICE_FILES.glob("nvidia[0-9]*")):
        return True
    lister = shutil.which("nvidia-smi")
    listed = subprocess.run([lister, "-L"], capture_output=True, text=True) if lister else None
    return listed is not None and listed.returncode == 0 and "GPU" in listed.stdout


def nvcc() -> str | None:
    home = os.environ.get("CUDA_HOME")
    return (shutil.which("nvcc", path=f"{home}/bin") if home else None) or shutil.which("nvcc")


def cuda_archs() -> list[str]:
    wanted = os.environ.get("TORCH_MPM_CUDA_ARCHS") or "8.0;9.0"
    return [arch.strip() for arch in wanted.split(";") if arch.strip()]


def gencode() -> list[str]:
    """Machine code for every architecture, and PTX of the newest for the GPUs after it."""
    numbers = [arch.replace(".", "") for arch in cuda_archs()]
    options = [f"-gencode=arch=compute_{n},code=sm_{n}" for n in numbers]
    return [*options, f"-gencode=arch=compute_{numbers[-1]},code=compute_{numbers[-1]}"]


def nvcc_release() -> tuple[int, int]:
    release = re.search(r"release (\d+)\.(\d+)", compiler_version(str(nvcc())))
    return (int(release[1]), int(release[2])) if release else (0, 0)


def nvcc_flags() -> list[str]:
    """Options of nvcc: compressed fat binaries, which are large for template kernels, or compilation in little time.

    The smallest fat binaries need the driver of CUDA 12.4, which every driver of CUDA 13 is newer than, but not every
    one of CUDA 12. TORCH_MPM_CUDA=check asks for little time: a machine without a GPU compiles to find errors.
    """
    if os.environ.get("TORCH_MPM_CUDA") == "check" and nvcc_release() >= (12, 9):
        return [*NVCC_FLAGS, NVCC_FAST_COMPILE, "--compress-mode=none"]
    return [*NVCC_FLAGS, "--compress-mode=size" if nvcc_release() >= (13, 0) else "-Xfatbin=-compress-all"]


def max_jobs() -> int:
    return int(os.environ.get("MAX_JOBS") or len(os.sched_getaffinity(0)))


@functools.cache
def compiler_version(compiler: str) -> str:
    """The line of `compiler --version` that holds its version number."""
    lines = subprocess.run([compiler, "--version"], check=True, capture_output=True, text=True).stdout.splitlines()
    return next((line for line in lines if "release" in line), lines[0]).strip()


@dataclass
class Library:
    """One linked file: `objects` are (source, rule, extra flags) in link order."""

    output: str
    objects: list[tuple[Path, str, list[str]]]
    rule: str

    @property
    def name(self) -> str:
        return Path(self.output).name


class Ninja:
    """The text of a build.ninja: one rule per compiler, one edge per object file and per library."""

    def __init__(self, directory: Path, torch: Path, sanitize: str) -> None:
        self.directory = directory
        includes = [f"-I{UP}csrc"]
        torch_includes = [*includes, "-isystem", str(torch / "include")]
        # torch loads its libraries privately, so ours must name libtorch.so, the umbrella of whatever torch is running
        # (CPU or CUDA), to find its symbols. The process has it loaded: no path to it is recorded.
        libtorch = [f"-L{torch / 'lib'}", "-Xlinker", "--no-as-needed", "-ltorch"]
        # The C++ library of the process, by its file name, since the compiler may come with a static one only: errors
        # thrown here are caught in torch.
        libtorch += ["-Xlinker", "-l:libstdc++.so.6"]
        # Undefined functions fail the link. Not in the CUDA library, since a CPU torch has no CUDA functions, nor with
        # sanitizers, whose functions come from the process.
        defined = [] if sanitize else ["-Xlinker", "--no-undefined", "-ltorch_cpu"]
        compilers = max(1, max_jobs() // min(NVCC_THREADS, len(cuda_archs())))
        self.lines = ["ninja_required_version = 1.5", f"pool nvcc\n  depth = {compilers}"]
        cxx = os.environ.get("CXX", "g++")
        # At -O3, instrumented kernels take more than ten minutes to compile.
        sanitizer = [f"-fsanitize={sanitize}", "-fno-omit-frame-pointer", "-g1", "-O1"] if sanitize else []
        compile_cpu = [cxx, *COMMON_FLAGS, *CPU_FLAGS, *HOST_FLAGS, "-Wextra", *sanitizer]
        compile_one = ["$flags", "-MMD", "-MF", "$out.d", "-c", "$in", "-o", "$out"]
        self.rule("cxx", [*compile_cpu, *torch_includes, *compile_one], depfile=True)
        # torch carries a pybind11 of its own, which may not be used together with the stable ABI.
        self.rule("cxx_module", [*compile_cpu, *includes, *compile_one], depfile=True)
        self.rule("link_cpu", [cxx, "-shared", *sanitizer, "$in", "-o", "$out", *libtorch, *defined])
        self.rule("link_module", [cxx, "-shared", *sanitizer, "$in", "-o", "$out"])
        if nvcc() is not None:
            # The host compiler sees `#pragma unroll`, which only the device compiler knows.
            host = f"-Xcompiler={','.join([*HOST_FLAGS, '-Wno-unknown-pragmas'])}"
            before = [str(nvcc()), f"-ccbin={cxx}", *gencode(), *COMMON_FLAGS]
            after = [*nvcc_flags(), host, "-DUSE_CUDA", *torch_includes]
            for rule, level in NVCC_LEVELS.items():
                device = [*before, level, *after, "$flags", "-MD", "-MF", "$out.d", "-c", "$in", "-o", "$out"]
                self.rule(rule, device, depfile=True)
                self.lines[-1] += "\n  pool = nvcc"
            # cudart is linked statically (the default), so the library does not depend on the CUDA runtime of torch.
            # Symbols that only a debugger reads, 5% of the library, are left out.
            link_device = [str(nvcc()), f"-ccbin={cxx}", *gencode(), "-shared", "-Xlinker=-s"]
            self.rule("link_cuda", [*link_device, "$in", "-o", "$out", *libtorch])

    def rule(self, name: str, command: list[str], depfile: bool = False) -> None:
        quoted = " ".join(word if word.startswith("$") else shlex.quote(word) for word in command)
        text = f"rule {name}\n  command = {quoted}\n  description = {name} $out"
        self.lines.append(text + ("\n  depfile = $out.d\n  deps = gcc" if depfile else ""))

    def library(self, library: Library) -> None:
        """Edges are listed in reverse, since ninja starts the first ones first and the kernels take longest."""
        objects, edges = [], []
        for source, rule, flags in library.objects:
            relative = source.relative_to(ROOT)
            variant = [Path(f.partition("=")[2].strip('"')).stem for f in flags if f.startswith(VARIANTS)]
            target = f"{library.name}.obj/{'.'.join([str(relative), *variant])}.o"
            edges.append(f"build {target}: {rule} {UP}{relative}\n  flags = {shlex.join(flags)}")
            objects.append(target)
        self.lines += reversed(edges)
        self.lines.append(f"build {library.name}: {library.rule} {' '.join(objects)}")

    def run(self, targets: list[str]) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        (self.directory / "build.ninja").write_text("\n".join(self.lines) + "\n")
        ninja = [sys.executable, "-m", "ninja"] if importlib.util.find_spec("ninja") else ["ninja"]
        result = subprocess.run([*ninja, "-C", str(self.directory), f"-j{max_jobs()}", *targets])
        if result.returncode:
            raise SystemExit(f"the build of {', '.join(targets)} failed (see the compiler's messages above)")


def cpu_library(levels: dict[str, list[str]]) -> Library:
    # csrc/cpu/isa.h forwards calls to the levels that exist.
    flags = ["-DTORCH_MPM_BACKEND=cpu", *(f"-DTORCH_MPM_HAS_{level.upper()}" for level in levels)]
    plain_options = [f"-march={X86_LEVELS['baseline']}"] if next(iter(levels.values())) else []
    plain = sorted([*CSRC.glob("*/**/*.op.cpp"), *(CSRC / "cpu").glob("*.cpp")])
    objects = [(source, "cxx", [*flags, *plain_options]) for source in plain]
    # The baseline comes first: of an inline function that several objects define, the linker keeps the first, and that
    # one must run on every machine.
    for level, options in levels.items():
        own = [*flags, *options, f"-DTORCH_MPM_ISA={level}"]
        objects += [(source, "cxx", [*own, *part]) for source, part in parts(CSRC.glob("*/**/*.cpu.cpp"))]
    return Library("torch_mpm/lib/libtorch_mpm_cpu.so", objects, "link_cpu")


def cuda_library() -> Library:
    sources = [*parts(CSRC.glob("*/**/*.op.cpp")), *parts(CSRC.glob("*/**/*.cu"))]
    backend = "-DTORCH_MPM_BACKEND=cuda"
    objects = [
        (source, "nvcc_host" if source.suffix == ".cpp" else "nvcc", [backend, *part]) for source, part in sources
    ]
    return Library("torch_mpm/lib/libtorch_mpm_cuda.so", objects, "link_cuda")


def parts(sources: Iterable[Path]) -> list[tuple[Path, list[str]]]:
    """Sources with the options of each part that they are compiled in (csrc/common/instantiate.h)."""
    scalars = [[f"-DMPM_SCALAR={scalar}"] for scalar in ("float", "double")]
    shapes = [[*scalar, f"-DMPM_DIMENSION={dimension}"] for scalar in scalars for dimension in (2, 3)]
    headers = sorted(h for h in (CSRC / "laws").glob("*.h") if "\nMPM_REGISTER_LAW(" in h.read_text())
    each_law = [[f'-DMPM_LAW_HEADER="laws/{header.name}"'] for header in headers]
    names = (
        "backward.cu",
        "gather.cu",
        "scatter.cu",
        "heat.cu",
        "heat_advance.cu",
        "heat_operator.cu",
        "simple_steps.cu",
        "tangent_gather.cu",
        "transfer.cu",
    )
    split = dict.fromkeys(names, shapes)
    split |= {"g2p_advance.cu": scalars, "law.cpu.cpp": each_law, "law.cu": each_law, "fused_law.cu": each_law}
    return [(source, part) for source in sorted(sources) for part in split.get(source.name, [[]])]


def math_library(version: str) -> Library | None:
    """The pybind11 module torch_mpm._math. It supports one Python version only and is meant for tests."""
    pybind11 = importlib.util.find_spec("pybind11")
    python = Path(sysconfig.get_path("include"))
    if pybind11 is None or not pybind11.origin or not (python / "Python.h").exists():
        print(f"torch_mpm._math is left out: {sys.executable} has no pybind11 or no Python.h")
        return None
    flags = [f"-isystem{python}", f"-isystem{Path(pybind11.origin).parent / 'include'}"]
    flags += [f'-DTORCH_MPM_VERSION="{version}"']
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    objects = [(CSRC / "common" / "python_module.cpp", "cxx_module", flags)]
    return Library(f"torch_mpm/_math{suffix}", objects, "link_module")


def torch_version(torch: Path) -> str:
    text = (torch / "include/torch/headeronly/version.h").read_text()
    return re.search(r'#define TORCH_VERSION \\\s*"([^"]+)"', text)[1]  # type: ignore[index]


def replace(source: Path, target: Path) -> None:
    """Copy by renaming, so that a process which has loaded the old file keeps it."""
    if target.exists() and target.stat().st_mtime_ns == source.stat().st_mtime_ns:
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(target.name + ".new")
    shutil.copy2(source, temporary)
    temporary.replace(target)


class Build(build_ext):
    """build_ext that builds the libraries named by --targets (cpu, cuda, math) through one build.ninja."""

    user_options: ClassVar = [
        *build_ext.user_options,
        ("targets=", None, "what to build: cpu, cuda, math (default: all)"),
    ]

    def initialize_options(self) -> None:
        super().initialize_options()
        self.targets = None

    def run(self) -> None:
        if os.environ.get("TORCH_MPM_SKIP_BUILD") == "1":
            return
        destination = ROOT if self.inplace or self.editable_mode else Path(self.build_lib)
        sanitize = os.environ.get("TORCH_MPM_SANITIZE", "")
        # A build in place is for this machine; a wheel is for all machines.
        self.native = bool(self.inplace or self.editable_mode)
        self.levels = isa_levels(self.native)
        # One place for in-place, editable and wheel builds, so that each reuses the objects of the others.
        name = f"{sysconfig.get_platform()}-{sys.implementation.cache_tag}"
        directory = ROOT / "build" / (f"{name}-sanitize" if sanitize else name)
        directory.mkdir(parents=True, exist_ok=True)
        # Parallel builds queue here instead of racing in one directory.
        with open(directory / "lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            self.build(directory, destination, sanitize)

    def build(self, directory: Path, destination: Path, sanitize: str) -> None:
        torch = torch_directory()
        if torch is None:
            raise SystemExit(f"building torch_mpm needs torch 2.11 or newer, which {sys.executable} does not have")
        ninja = Ninja(directory, torch, sanitize)
        libraries = self.libraries_to_build()
        for library in libraries.values():
            ninja.library(library)
        ninja.run([library.name for library in libraries.values()])
        for library in libraries.values():
            replace(directory / library.name, destination / library.output)
        self.describe(destination / "torch_mpm/lib/build.json", list(libraries), torch_version(torch), sanitize)

    def libraries_to_build(self) -> dict[str, Library]:
        """Requested targets that this machine can build."""
        wanted = self.targets.split(",") if self.targets else ["cpu", "cuda", "math"]
        if unknown := set(wanted) - {"cpu", "cuda", "math"}:
            raise SystemExit(f"--targets must be of cpu, cuda, math, got {sorted(unknown)}")
        libraries = {}
        if "cpu" in wanted:
            libraries["cpu"] = cpu_library(self.levels)
        if "cuda" in wanted and cuda_wanted(self.native):
            libraries["cuda"] = cuda_library()
        if "math" in wanted and (library := math_library(self.distribution.get_version())):
            libraries["math"] = library
        return libraries

    def describe(self, path: Path, built: list[str], torch: str, sanitize: str) -> None:
        """Write the data of `python -m torch_mpm info`; targets that are not built now keep their entry."""
        record = json.loads(path.read_text()) if path.exists() else {}
        record |= {"version": self.distribution.get_version(), "torch_headers": torch}
        record["torch_target"] = "2.11"
        if "cpu" in built:
            compiler = compiler_version(os.environ.get("CXX", "g++"))
            record["cpu"] = {"compiler": compiler, "flags": CPU_FLAGS, "isa": list(self.levels), "sanitize": sanitize}
        if "cuda" in built:
            compiler = compiler_version(str(nvcc()))
            flags = [NVCC_LEVELS["nvcc"], *nvcc_flags()]
            record["cuda"] = {"compiler": compiler, "flags": flags, "archs": cuda_archs()}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record, indent=2) + "\n")


class Wheel(bdist_wheel):
    """One wheel for every Python 3: the libraries do not touch the Python C API (torch_mpm._math is optional)."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]

    def run(self) -> None:
        if os.environ.get("TORCH_MPM_SKIP_BUILD") == "1":
            raise SystemExit(
                "TORCH_MPM_SKIP_BUILD=1 leaves the libraries out, and a wheel without them does not work: unset it, or "
                "link an environment to the sources with `pip install -e .` and run `make build`"
            )
        super().run()


if __name__ == "__main__":
    setup(
        ext_modules=[Extension("torch_mpm._math", ["csrc/common/python_module.cpp"], optional=True)],
        cmdclass={"build_ext": Build, "bdist_wheel": Wheel},
    )
