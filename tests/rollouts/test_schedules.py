"""Every schedule of the fused op against kernel by kernel: by law, transfer, walls and obstacles."""

import pytest
import torch
from cases.rollouts import LAWS_HERE, TRANSFERS, WALLS, assert_equal, one_by_one
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, touched, unit_box
from torch_mpm._library import graph_loops
from torch_mpm.grid.topology import Status
from torch_mpm.rollouts.plan import SCHEDULES

DT = 2e-4
LAWS = {name: LAWS_HERE[name] for name in ("neo_hookean", "fluid", "von_mises", "sand", "viscoelastic")} | {
    "mixture": lambda: mpm.Mixture([LAWS_HERE["neo_hookean"](), LAWS_HERE["fluid"]()])
}


def serves(schedule: str, device: str, law: str, transfer: str, walls: str) -> bool:
    """The case that each schedule serves."""
    if schedule in ("per_step", "sorted_cpu"):
        return schedule == "per_step" or device == "cpu"
    if device == "cpu" or law == "mixture" or walls == "mirror" or "flip" in transfer:
        return False
    if schedule == "block_per_scene":
        return True
    return transfer == "apic" and (schedule != "persistent" or graph_loops())


def obstacles_of(kind: str, dim: int) -> list[mpm.Obstacle]:
    """Nodes meet several surfaces of a corner, at first or once it has come to the particles."""
    if kind == "sphere":
        return [mpm.Sphere((0.4,) * dim, 0.15, friction=0.3, velocity=(1.0, -0.5, 0.2)[:dim])]
    if kind in ("corner", "late corner"):
        x, speed = (0.2, 0.0) if kind == "corner" else (0.05, 20.0)
        floor = mpm.Box((0.5, 0.25, 0.5)[:dim], (1.4, 0.3, 1.4)[:dim], friction=0.3)
        return [floor, mpm.Box((x, 0.5, 0.5)[:dim], (0.3, 1.4, 1.4)[:dim], velocity=(speed, 0.0, 0.0)[:dim])]
    return []


def made(
    law: str, transfer: str, walls: str, obstacles: str, device: str, damping: float = 1.0
) -> tuple[mpm.Step, mpm.State]:
    """In 2-D or 3-D, in turn."""
    dim = 2 + (list(LAWS).index(law) + list(TRANSFERS).index(transfer) + WALLS.index(walls)) % 2
    boundaries = [*([mpm.boundaries.Damping(damping)] * (damping < 1)), *obstacles_of(obstacles, dim)]
    options = {"boundaries": boundaries, "gravity": (0.0, -9.8, 0.0)[:dim], **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(dim), LAWS[law](), walls=touched(walls, dim), **options)
    state = blob(device, dim, dtype=torch.float32)
    if law == "mixture":
        state = state.replace(material=(torch.arange(len(state), device=device) % 2).int())
    return step, state


@torch.no_grad()
@pytest.mark.parametrize(
    *in_pairs(
        law=LAWS,
        transfer=TRANSFERS,
        walls=WALLS,
        obstacles=["none", "sphere", "corner", "late corner"],
        damping=[1.0, 0.95],
        steps=[24, 73],  # on CUDA with graphs of two substeps, and of more
    )
)
def test_schedules_agree(law, transfer, walls, obstacles, damping, steps, device):
    """Damped steps are also compared with those of a loop in Python."""
    expected = None
    if damping < 1:
        step, state = made(law, transfer, walls, obstacles, device, damping)
        expected = one_by_one(step, state, steps, DT)
    for schedule in SCHEDULES:
        step, state = made(law, transfer, walls, obstacles, device, damping)
        if not serves(schedule, device, law, transfer, walls):
            with pytest.raises(ValueError, match=f"^schedule must be one that supports the call, got {schedule}: .+"):
                mpm.rollout(step, state, steps, DT, schedule=schedule)
            continue
        end = mpm.rollout(step, state, steps, DT, schedule=schedule)
        assert SCHEDULES[torch.ops.torch_mpm.latest_schedule(state.x)] == schedule
        step.check(end)
        assert int(step.status[0, Status.ACTIVATIONS]) == steps
        expected = expected or end
        assert_equal(end, expected, schedule)
