# Targets: build, test, thorough, check, format, demo, examples, wheel, bench, study, sanitize, gpu, clean (see CONTRIBUTING.md).
# PYTHON creates the virtual environment; version TORCH of torch is installed there unless torch is present.
PYTHON ?= python3
TORCH ?= 2.13.0
VENV ?= .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.torch_mpm
QUICK := -q -m "not slow and not thorough"

SOURCES := $(shell find csrc -name '*.h' -o -name '*.cuh' -o -name '*.cpp' -o -name '*.cu')

.PHONY: build libraries test thorough check format demo examples wheel bench study sanitize gpu clean

build: $(STAMP)
	$(PY) setup.py -q build_ext --inplace

# Libraries for users: CPU, and CUDA where there is a GPU. `build` adds the module of the tests.
libraries: $(STAMP)
	$(PY) setup.py -q build_ext --inplace --targets=cpu,cuda

# A single library: cpu, cuda or math (the pybind11 module of the tests).
build-cuda: export TORCH_MPM_CUDA = 1
build-%: $(STAMP)
	$(PY) setup.py -q build_ext --inplace --targets=$*

# This rule only links the environment to the sources; `build` compiles, and shows its progress.
$(STAMP): pyproject.toml
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PY) -c "import torch" 2>/dev/null || $(PY) -m pip install -q torch==$(TORCH)
	$(PY) -m pip install -q "setuptools>=77" ninja "pybind11>=2.12"
	TORCH_MPM_SKIP_BUILD=1 $(PY) -m pip install -q --no-build-isolation -e '.[dev]'
	touch $@

# One process per core, with one thread each; then the tests of all kinds of threaded loops, in one process with all
# threads, which wait without spinning. Checks of derivatives and compiled code call the same loops as the other tests.
THREADED := tests/test_rollouts.py tests/test_topology.py tests/ops/test_transfer_cpu.py tests/boundaries/test_contact.py
test: build
	OMP_NUM_THREADS=1 $(PY) -m pytest $(QUICK) -n auto --dist worksteal
	OMP_WAIT_POLICY=PASSIVE $(PY) -m pytest $(QUICK) $(THREADED) -k "not gradcheck and not opcheck and not compile"

thorough: build
	OMP_NUM_THREADS=1 $(PY) -m pytest -q -m "thorough and not slow" -n auto --dist worksteal

check: $(STAMP)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(VENV)/bin/clang-format --dry-run -Werror $(SOURCES)
	$(PY) -m mypy

format: $(STAMP)
	$(PY) -m ruff check --fix -q .
	$(PY) -m ruff format .
	$(VENV)/bin/clang-format -i $(SOURCES)

demo: libraries
	rm -rf out/demo
	$(PY) -m torch_mpm run examples/demo.toml -o out/demo
	rm -rf out/demo_dataset
	$(PY) -m torch_mpm generate examples/datasets/demo.toml -o out/demo_dataset
	$(PY) -m torch_mpm finalize out/demo_dataset

# Each scene has its own folder. Finished scenes are skipped, unfinished ones are resumed.
examples: $(patsubst examples/%.toml,out/%/trajectory.h5,$(wildcard examples/*.toml))

out/%/trajectory.h5: examples/%.toml | libraries
	$(PY) -m torch_mpm run $< -o $(@D) --resume

# Wheel for every machine: all instruction-set levels, and two GPU architectures where nvcc is found. build/lib* is
# removed first, because files of an earlier build would be packed too.
wheel: $(STAMP)
	rm -rf build/lib* dist/*.whl
	$(PY) setup.py -q bdist_wheel
	@echo "The wheel is $$(ls dist/*.whl); pip install $$(ls dist/*.whl) puts it into any environment."

bench: build
	$(PY) -m benchmarks

study: build
	$(PY) -m pytest -q -m slow

# Tests of a CPU library with the address and undefined-behaviour sanitizers, for this machine's instruction set, in a
# separate package tree. libstdc++ is preloaded, because otherwise the sanitizer does not find the function that throws.
SANITIZED := build/sanitized
SANITIZERS := address,undefined
PRELOAD = $(foreach name,libasan.so libstdc++.so.6,$(shell $(or $(CXX),g++) -print-file-name=$(name)))
sanitize: $(STAMP)
	TORCH_MPM_SANITIZE=$(SANITIZERS) TORCH_MPM_CUDA=0 TORCH_MPM_ISA_LEVELS=native $(PY) setup.py -q build --build-lib $(SANITIZED)
	LD_PRELOAD='$(PRELOAD)' ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 \
	  TORCH_MPM_SANITIZE=$(SANITIZERS) TORCH_MPM_CUDA=0 PYTHONPATH=$(CURDIR)/$(SANITIZED):$(CURDIR) $(VENV)/bin/pytest $(QUICK)

# Build, tests and benchmarks on a GPU machine with torch, ninja and pytest in its Python, without a virtual environment
# and without network access.
gpu:
	TORCH_MPM_CUDA=1 TORCH_MPM_ISA_LEVELS=all $(PYTHON) setup.py -q build_ext --inplace
	PYTHONPATH=. $(PYTHON) -m benchmarks.tests --processes $(shell nproc)
	PYTHONPATH=. $(PYTHON) -m benchmarks --device cuda

clean:
	rm -rf build dist out torch_mpm/lib torch_mpm/_math*.so
