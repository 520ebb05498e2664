"""Every schedule of the fused op against kernel by kernel: by law, transfer, walls and obstacles."""

import pytest
import torch
from cases.rollouts import LAWS_HERE, TRANSFERS, WALLS, assert_equal

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, touched, unit_box
from torch_mpm._library import graph_loops
from torch_mpm.rollouts.plan import SCHEDULES

STEPS, DT = 24, 2e-4
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


def made(law: str, transfer: str, walls: str, obstacles: bool, device: str) -> tuple[mpm.Step, mpm.State]:
    """In 2-D or 3-D, in turn."""
    dim = 2 + (list(LAWS).index(law) + list(TRANSFERS).index(transfer) + WALLS.index(walls)) % 2
    sphere = mpm.Sphere((0.4,) * dim, 0.15, friction=0.3, velocity=(1.0, -0.5, 0.2)[:dim])
    options = {"boundaries": [sphere] if obstacles else [], "gravity": (0.0, -9.8, 0.0)[:dim], **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(dim), LAWS[law](), walls=touched(walls, dim), **options)
    state = blob(device, dim, dtype=torch.float32)
    if law == "mixture":
        state = state.replace(material=(torch.arange(len(state), device=device) % 2).int())
    return step, state


@torch.no_grad()
@pytest.mark.parametrize("obstacles", [False, True], ids=["", "obstacles"])
@pytest.mark.parametrize("walls", WALLS)
@pytest.mark.parametrize("transfer", TRANSFERS)
@pytest.mark.parametrize("law", LAWS)
def test_schedules_agree(law, transfer, walls, obstacles, device):
    expected = None
    for schedule in SCHEDULES:
        step, state = made(law, transfer, walls, obstacles, device)
        if not serves(schedule, device, law, transfer, walls):
            with pytest.raises(ValueError, match=f"schedule must be one that supports the call, got {schedule}: .+"):
                mpm.rollout(step, state, STEPS, DT, schedule=schedule)
            continue
        end = mpm.rollout(step, state, STEPS, DT, schedule=schedule)
        assert SCHEDULES[torch.ops.torch_mpm.latest_schedule(state.x)] == schedule
        step.check(end)
        assert int(step.status[0, 5]) == STEPS
        expected = expected or end
        assert_equal(end, expected, schedule)
