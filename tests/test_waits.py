"""Calls for which the host does not wait: they return while a GPU has not begun with them."""

import pytest
import torch

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box

CYCLES = 3_000_000_000
"""Clock cycles that keep a GPU busy for more than a second."""


def scene(kind: str, device: str) -> tuple[mpm.Step, mpm.State]:
    count = {"few": 1000, "many": 300_000}.get(kind, 50_000)
    state = blob(device, 3, count, torch.float32)
    options: dict = {"gravity": (0.0, -9.8, 0.0), "walls": "separate"}
    law: mpm.Material = mpm.NeoHookean(E=1e4, nu=0.3)
    grid = unit_box(3)
    if kind == "mixture":
        law = mpm.Mixture([law, mpm.QuarticSand(E=1e4, nu=0.3)])
        state = state.replace(material=(torch.arange(count, device=device) % 2).int())
        options["boundaries"] = [mpm.Sphere((0.5, 0.2, 0.5), 0.1, velocity=(0.1, 0.0, 0.0))]
    if kind in ("batch", "small scenes"):
        scenes = 8 if kind == "batch" else 100
        grid = unit_box(3, scenes=scenes)
        state = state.replace(scene=(torch.arange(count, device=device) * scenes // count).int())
    if kind == "heat":  # whose replays wait for the block count of a growing pool
        grid = unit_box(3, max_blocks=200)
        state = state.replace(temperature=torch.full_like(state.mass, 300.0))
    step = mpm.Step(grid, law, **options)
    if kind == "heat":
        step.heat = mpm.Heat(grid, conductivity=1.0, specific_heat=1e3)
    return step, state


@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize("kind", ["few", "some", "many", "mixture", "batch", "small scenes", "heat"])
def test_a_rollout_returns_before_a_gpu_begins(kind, gradient, device):
    if device == "cpu":
        pytest.skip("of CUDA")
    step, state = scene(kind, device)
    if gradient:
        state = state.replace(v=state.v.requires_grad_())

    n = 15 if gradient else 100  # some 1000 launches fill the queue of a device, and then any program waits

    def call() -> None:
        with torch.set_grad_enabled(gradient):
            end = mpm.rollout(step, state, n, 1e-5)
            if gradient:
                torch.autograd.grad(end.x.sum(), state.v)

    for _ in range(2):  # the pool of blocks and the memory of graphs are made
        call()
        torch.cuda.synchronize()
    torch.cuda._sleep(CYCLES)
    busy = torch.cuda.Event()
    busy.record()
    call()
    assert not busy.query(), "the host has waited"
    torch.cuda.synchronize()
