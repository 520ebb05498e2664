"""Memory of large results on the CPU: csrc/cpu/memory_cache.h."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torch_mpm.ops import law_update

PARTICLES = 60_000  # a stress tensor of 2 MB, which comes from the cache


def deformation(scale: float) -> Tensor:
    return scale * torch.eye(3).repeat(PARTICLES, 1, 1)


def stress(F: Tensor) -> Tensor:
    """Stress of a neo-Hookean solid with mu = 1 and lam = 0: (s² − 1) I for F = s I."""
    return law_update("neo_hookean", F, [torch.tensor(1.0), torch.tensor(0.0)]).stress


def resident() -> int:
    """Memory of this process [bytes]."""
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * 4096


def test_memory_of_a_dead_result_is_used_again():
    F = deformation(1.0)
    alive = stress(F)
    dead = stress(F).data_ptr()
    assert stress(F).data_ptr() == dead != alive.data_ptr()


def test_living_results_do_not_share_memory():
    scales = [1 + i / 8 for i in range(12)]
    results = []
    for scale in scales:
        stress(deformation(3.0))  # dies at once
        results.append(stress(deformation(scale)))
    for scale, result in zip(scales, results, strict=True):
        expected = (scale**2 - 1) * torch.eye(3).expand_as(result)
        torch.testing.assert_close(result, expected)


def test_views_keep_memory_alive():
    row = stress(deformation(2.0))[:, 0]
    others = [stress(deformation(3.0)) for _ in range(4)]
    assert others
    torch.testing.assert_close(row, torch.tensor([3.0, 0.0, 0.0]).expand_as(row))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_little_is_kept_when_all_results_are_dead():
    F = deformation(1.5)
    before = resident()
    results = [stress(F) for _ in range(200)]
    assert resident() - before > 380 * 2**20
    results.clear()
    assert resident() - before < 140 * 2**20


def test_threads_take_and_return_memory_at_the_same_time():
    def work(scale: float) -> bool:
        F = deformation(scale)
        expected = (scale**2 - 1) * torch.eye(3)
        return all(torch.allclose(stress(F), expected.expand(PARTICLES, 3, 3), atol=1e-5) for _ in range(20))

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(work, [1.0, 1.25, 1.5, 2.0]))
