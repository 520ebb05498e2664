"""Bytes and operations of the kernels of a substep with heat are those of csrc, and their times a partition."""

import shutil
import subprocess
from pathlib import Path

import pytest
import torch

import torch_mpm as mpm
from benchmarks import common, regressions, report
from benchmarks.speed import heat_kernels, roofline, step, thermal, work
from benchmarks.speed.heat_kernels import KERNELS, WORDS, Size
from benchmarks.speed.timing import Clock, float32_rate

# Names that the compiler gives the kernels of the substep, and some of other kernels.
EACH = "void mpm::cuda::each_kernel<&(void mpm::baseline::{}<float, 3>(mpm::{}<float, 3> const&, long))>"
ANONYMOUS = "mpm::cuda::(anonymous namespace)::"
NAMES = {
    f"void {ANONYMOUS}activate_at_once<2, float, 3>(mpm::ActivateArguments<float, 3>, int, long)": None,
    EACH.format("heat_volume", "HeatVolumesArguments"): None,
    "Memset (Device)": None,
    "void mpm::cuda::scatter_kernel<mpm::cuda::ReorderingSource<mpm::baseline::NeoHookean, float, 3> >": "law and P2G",
    f"void {ANONYMOUS}next_grid_kernel<false, float, 3>(mpm::NextGridArguments<float, 3>)": "grid update",
    f"void {ANONYMOUS}advance_kernel<{ANONYMOUS}HeatAdvance<2, float, 3, false> >": "G2P and P2G of heat",
    EACH.format("begin_node", "HeatNodesArguments"): None,
    f"void {ANONYMOUS}pack_kernel<2, float, 3>({ANONYMOUS}SimpleKernel<2, float, 3>)": None,
    f"void {ANONYMOUS}product_kernel<2, float, 3>({ANONYMOUS}SimpleKernel<2, float, 3>)": "products with H",
    "void mpm::cuda::heat_kernel<2, float, 3>(mpm::cuda::HeatKernel<2, float, 3>)": None,
    EACH.format("finish", "HeatFinishArguments"): "increments of the nodes",
    f"void mpm::cuda::gather_kernel<false, {ANONYMOUS}HeatGather<2, float, 3, true> >": "G2P of heat",
    f"void mpm::cuda::scatter_kernel<{ANONYMOUS}HeatSurfaceSource<2, float, 3> >": None,
    "void at::native::vectorized_elementwise_kernel<4, at::native::FillFunctor<float>>": None,
    "Memcpy DtoD (Device -> Device)": None,
}

COUNTER = """
#define TORCH_MPM_BACKEND cpu
#include <cstdio>
#include "heat/cell.h"
int operations = 0;
struct Counted {
  double value;
  Counted() : value(0) {}
  template <class T> Counted(T v) : value(double(v)) {}
};
#define COUNTED(op) \\
  Counted operator op(const Counted& a, const Counted& b) { operations++; return a.value op b.value; } \\
  Counted& operator op##=(Counted& a, const Counted& b) { return a = a op b; }
COUNTED(+) COUNTED(-) COUNTED(*)
Counted operator-(const Counted& a) { return -a.value; }
int main() {
  Counted f[3] = {0.7, 1.1, 0.9}, u[27], sum[27], w[3];
  mpm::add_particle<mpm::HeatSum::product, 2, Counted, 3, Counted>(f, Counted(1), u, sum);
  std::printf("%d ", operations);
  operations = 0;
  for (int axis = 0; axis < 3; axis++) mpm::BSpline<2>::weights(f[axis], w);
  std::printf("%d", operations);
}
"""


def test_kernels_are_known_by_their_names() -> None:
    found = {name: kernel.name if (kernel := heat_kernels.kernel_of(name)) else None for name in NAMES}
    assert found == NAMES and set(filter(None, NAMES.values())) == {kernel.name for kernel in KERNELS}
    assert all(sum(any(s in name for s in kernel.symbols) for kernel in KERNELS) <= 1 for name in NAMES)


def test_times_of_overlapping_kernels_are_a_partition() -> None:
    spans = [("b", 3.0, 9.0), ("a", 0.0, 4.0), ("inside", 5.0, 6.0), ("after", 10.0, 12.0)]
    assert list(heat_kernels.own_times(spans)) == [("a", 4.0), ("b", 5.0), ("inside", 0.0), ("after", 2.0)]


def test_times_of_a_call_are_shared_by_its_substeps() -> None:
    names = [name for name, phase in NAMES.items() if phase != "products with H"]
    n = heat_kernels.SUBSTEPS
    with pytest.raises(RuntimeError, match="got none of: products with H"):
        heat_kernels.by_kernel((name, 1.0) for name in names)
    found = heat_kernels.by_kernel((name, 1.0) for name in [*NAMES, *NAMES])
    assert found["products with H"] == pytest.approx((2 / n, 2 / n))
    assert found["others"] == pytest.approx((2 * 9 / n, 2 * 9 / n))


def test_bytes_are_those_of_the_tensors() -> None:
    """Of P2G with the law, which updates F, and of G2P with P2G of heat, from the tensors of the ops of one step: the
    fields of the particles, the velocities of the nodes, and sums of 4 channels."""
    s = thermal.heated(step.setup(work.make(8), "cpu"))
    state, blocks = s.state, s.grid.activate(s.state.x)
    theta, gradient = state.temperature, state.extra["temperature_gradient"]
    conductance = blend = rest = volume = torch.empty_like(state.mass)
    packed = torch.empty(len(state), 4)
    sums = torch.zeros(blocks.node_count, 4)
    law = [blocks.index, state.x, state.mass, rest, state.v, state.C, state.F, state.F, volume, sums, sums]
    motion = [blocks.index, state.x, state.v, state.C, state.x]
    heat = [state.mass, theta, gradient, volume, conductance, blend, packed, sums, sums, sums]
    active = int(blocks.active_nodes().sum())
    size = heat_kernels.size_of(s, state)
    assert size == Size(8**3, active, blocks.node_count)
    kernels = {kernel.name: kernel for kernel in KERNELS}
    for name, tensors in (("law and P2G", law), ("G2P and P2G of heat", [*motion, *heat])):
        assert kernels[name].bytes(size) == step.bytes_of(tensors, blocks, active)
    ours = {"x": state.x, "v": state.v, "C": state.C, "F": state.F, "mass": state.mass, "theta": theta}
    assert {name: t[0].numel() for name, t in ours.items()} == {name: WORDS[name] for name in ours}


def test_operations_are_those_of_the_headers(tmp_path: Path) -> None:
    """A product with H and the weights of a particle, counted by a number that counts."""
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("needs a C++ compiler")
    source, program = tmp_path / "count.cpp", tmp_path / "count"
    source.write_text(COUNTER)
    subprocess.run([compiler, "-std=c++20", "-I", common.ROOT / "csrc", source, "-o", program], check=True)
    counted = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    assert counted == f"{heat_kernels.applied()} {heat_kernels.weights()}"


def test_solve_takes_the_steps_that_are_counted() -> None:
    """csrc/heat/solve.h: the steps of the known bound c = 4 r of the spectrum, which reduce the residual enough."""
    c, tolerance = 4 * work.DIFFUSION, thermal.heated(step.setup(work.make(4), "cpu")).step.heat.tolerance
    assert heat_kernels.STEPS == 2 and 0.172 * c**2 < tolerance < c


def test_rate_of_arithmetic_is_measured() -> None:
    precision = torch.get_float32_matmul_precision()
    assert 1e6 < float32_rate(Clock("cpu", samples=3, budget=0.0), 64) < 1e14
    assert torch.get_float32_matmul_precision() == precision


def found_with_kernels(ms: float = 0.1) -> dict:
    size = Size(10**6, 2 * 10**5, 3 * 10**5)
    parts = [
        {
            "name": kernel.name,
            "launches": 1.0,
            "ms": ms,
            "bytes": kernel.bytes(size),
            "operations": kernel.operations * size.particles,
            "memory_ms": 0.02,
            "arithmetic_ms": 0.05 if kernel.name == "law and P2G" else 0.0,
        }
        for kernel in KERNELS
    ]
    entry = {"particles": size.particles, "rate": 6e13, "parts": parts, "others_ms": 0.001}
    row = {"name": "heat", "particles": size.particles, "us": 1.0, "rate": 1e6}
    return {"environment": {"device": "abacus"}, "rows": [row], "copy_GB_s": 2000.0, "sizes": [entry]}


def test_kernels_are_reported_with_their_limits() -> None:
    found = found_with_kernels()
    text = thermal.text(found)
    assert "Together 600 us, 150 us at the limits." in text and "60 TFLOP/s" in text
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    limits = {row[0]: row[-1] for row in rows}
    assert limits["law and P2G"] == "arithmetic" and limits["grid update"] == "memory"
    section = report.thermal_speed([found])
    assert "Kernels of a substep" in section and "heat_roofline.png" in section
    names = [name for name, _ in thermal.timed(found)]
    assert len(set(names)) == len(names) == 1 + len(KERNELS)
    assert len(regressions.slower(found, found_with_kernels(1.0), thermal.timed)) == len(KERNELS)


def test_figure_has_the_results_with_kernels(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    found = found_with_kernels()
    roofline.plot([found, {**found, "sizes": []}], tmp_path / "some.png")
    roofline.plot([{**found, "sizes": []}], tmp_path / "none.png")
    assert (tmp_path / "some.png").exists() and not (tmp_path / "none.png").exists()


@pytest.mark.cuda
def test_kernels_of_a_substep_are_profiled() -> None:
    """All phases are in the profile, and hardly anything else is in a substep."""
    found = thermal.kernels([22], samples=3)
    (entry,) = found["sizes"]
    assert [part["name"] for part in entry["parts"]] == [kernel.name for kernel in KERNELS]
    for part in entry["parts"]:
        assert part["ms"] > 0 and part["launches"] >= 1 and part["memory_ms"] > 0
    assert entry["others_ms"] < sum(part["ms"] for part in entry["parts"])
    s = thermal.heated(step.setup(work.make(22), "cuda"))
    mpm.rollout(s.step, s.state, 8, work.DT)
    s.step.check()
