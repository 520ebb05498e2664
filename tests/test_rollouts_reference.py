"""Rollouts in one op against steps of plain torch: sums over all nodes, laws, walls and contact by the oracles."""

import pytest
import torch
from helpers import TOLERANCE, relative_error
from oracle import advance, contact, grid_update, material, sand, transfer
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state
from torch_mpm.grid.topology import PADDING

F64 = torch.float64
DT, N = 1e-3, 6
CENTER, RADIUS, SPEED = 0.45, 0.12, 0.3
MU, LAM, ANGLE = 4e3, 6e3, 0.5


def law_of(name: str, dtype: torch.dtype) -> mpm.Material:
    if name == "sand":
        return mpm.QuarticSand(mu=MU, lam=LAM, friction_angle=ANGLE)
    return mpm.NeoHookean(mu=MU, lam=LAM) if name == "solid" else mpm.WeaklyCompressible(LAM)


def mapped(name: str, state: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
    """Deformation after the return map, and stress."""
    one = state["x"].new_ones(1)
    if name == "fluid":
        return state, material.stress("weakly_compressible", state["J"], (LAM * one, 7 * one), dim=state["x"].shape[1])
    if name == "solid":
        return state, material.stress("neo_hookean", state["F"], (MU * one, LAM * one))
    dim = state["x"].shape[1]
    alpha = sand.friction_alpha(ANGLE * one, dim)
    F, stress, *_ = sand.quartic_return_map(state["F"], MU * one, LAM * one, alpha)
    return {**state, "F": F}, stress


def after_contact(blocks, velocity: Tensor, time: float) -> Tensor:
    """Velocities after contact with a sphere with friction that moves along the first axis."""
    rows = blocks.active_nodes().nonzero()[:, 0]
    grid = blocks.grid
    x = (blocks.node_indices()[rows].double() - PADDING) * grid.dx + torch.tensor(
        grid.lower, dtype=F64, device=velocity.device
    )
    own = torch.zeros(x.shape[1], dtype=F64, device=velocity.device)
    own[0] = SPEED
    away = x - (torch.full_like(own, CENTER) + time * own)
    inside = away.norm(dim=1) <= RADIUS
    normal = away[inside] / away[inside].norm(dim=1, keepdim=True)
    touched = rows[inside]
    relative = contact.contact_velocity(velocity[touched] - own, normal, "separate", 0.4)
    return velocity.index_put((touched,), relative + own)


def one_step(step: mpm.Step, law: str, state: dict[str, Tensor], rest: mpm.State, time: float) -> dict[str, Tensor]:
    state, stress = mapped(law, state)
    x = state["x"]
    blocks = transfer.dense_blocks(step.grid.activate(x))
    C = state["C"] if step.transfer == "apic" else None
    nodes = transfer.p2g(blocks, x, rest.mass, state["v"], C, stress, rest.volume, DT, step.stress_form)
    gravity = torch.tensor(step.gravity, dtype=F64, device=x.device)
    faces = [] if step.walls is None else step.walls.faces(step.grid)
    velocity = grid_update.grid_update(blocks, nodes, gravity, DT, faces)[:, 1:]
    if step.boundaries:
        velocity = after_contact(blocks, velocity, time)
    moved = advance.g2p_advance(blocks, x, velocity, DT, state["F"], state["J"], step.stress_form)
    return dict(zip(("x", "v", "C", "F", "J"), moved, strict=True))


@pytest.mark.parametrize(
    *in_pairs(
        {("walls", "touching"): [("separate", True), ("sticky", False), ("mirror", True)]},
        law=["solid", "sand", "fluid"],
        transfer_=["apic", "pic"],
        form=["mls", "gradient"],
        dim=[2, 3],
    )
)
def test_a_rollout_is_that_of_plain_torch(law, transfer_, form, walls, touching, dim, device):
    grid = mpm.Grid(dx=0.1, lower=(0.0,) * dim, upper=(1.0,) * dim)
    center, velocity = (CENTER,) * dim, (SPEED,) + (0.0,) * (dim - 1)
    sphere = mpm.Sphere(center, RADIUS, kind="separate", friction=0.4, velocity=velocity)
    step = mpm.Step(
        grid, law_of(law, F64), gravity=(0.0, -9.8, 0.0)[:dim], walls=walls, transfer=transfer_, stress_form=form,
        boundaries=[sphere] if touching else [],
    )  # fmt: skip
    state = step.prepare(block_state(dim, device, low=0.02, high=0.5, spin=2.0))
    with torch.no_grad():
        assert step.explain(state, DT).startswith("all steps in one op")
        end = mpm.rollout(step, state, N, DT)
        now = {name: getattr(state, name) for name in ("x", "v", "C", "F", "J")}
        now["C"] = torch.zeros_like(now["x"])[:, :, None].expand(-1, -1, dim) if now["C"] is None else now["C"]
        for k in range(N):
            now = one_step(step, law, now, state, k * DT)
    for name in ("x", "v", "F", "J"):
        if now[name] is not None:
            assert relative_error(getattr(end, name), now[name]) < TOLERANCE["rollout"][F64], name
