"""Implicit heat step on the nodes: Python wrapper, fake kernels and autograd of `heat_cg` and `heat_multigrid`."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..errors import NUMBER_OR_TENSOR, check_like, check_number, check_particles, shape_of
from ..grid.grid import Blocks, check_blocks
from ..grid.topology import PackedTopology, Topology
from .arguments import check_choice, refuse_vmap, split_dt
from .autograd import dispatch, register_autograd, save_with_topology, saved_with_topology
from .heat_multigrid import heat_multigrid
from .heat_refinement import REDUCTION
from .heat_refinement import refine as refinement

METHODS = {"cg": 0, "chebyshev": 1, "multigrid": 2}  # The first two are HeatMethod of csrc/heat/solve.h.


class HeatSolve(NamedTuple):
    """Result of `heat_cg`: increment [N] [K]; iterations int32 [B], residual [B] [K] and converged bool [B]."""

    increment: Tensor
    iterations: Tensor
    residual: Tensor
    converged: Tensor


def heat_cg(
    blocks: Blocks,
    x: Tensor,
    conductance: Tensor,
    heat_capacity: Tensor,
    theta: Tensor,
    dt: float | Tensor,
    source: Tensor | None = None,
    exchange: Tensor | None = None,
    fixed: Tensor | None = None,
    tolerance: float | Tensor = 1e-5,
    max_iterations: int | Tensor = 200,
    method: str = "cg",
    adjoint_tolerance: float = 1e-6,
    relative_tolerance: float = 0.0,
    refine: bool = False,
) -> HeatSolve:
    """Implicit step of the heat equation on the active nodes, by matrix-free conjugate gradients.

    Solves (M/dt + H + X) d = h − (H + X) θ for the increment d, with M the lumped heat capacity, X the exchange, h the
    source and H_ij = Σ_p κ_p V_p ∇Φ_i · ∇Φ_j, ∇Φ_i = D⁻¹ N_i (x_i − x_p) (Gao et al. 2018, supplement, equation 10).
    Scenes are solved separately, each with its own time step, tolerance and iterations, and stop separately.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        conductance: conductivity times volume κ_p V_p [P] [W m²/K in 3-D].
        heat_capacity: lumped heat capacity of the nodes M_i = Σ m_p C_p N_i [N] [J/K].
        theta: temperature of the nodes θ [N] [K], relative to a reference.
        dt: time step [s]: a number, or a tensor of shape [], [1] or [B].
        source: heat into the nodes h [N] [W].
        exchange: derivative of the outgoing heat of a node by its temperature X ≥ 0 [N] [W/K] (Robin boundaries); the
            contribution of the ambient temperature belongs to `source`.
        fixed: nodes that keep their temperature, bool [N].
        tolerance: tolerance of dt sqrt(Σ r_i²/M_i / Σ M_i) [K], r the residual, which bounds the mass-weighted RMS
            error of d: a number, or a tensor of shape [], [1] or [B].
        max_iterations: maximum number of iterations: a number, or an integer tensor of shape [], [1] or [B].
        method: "cg", conjugate gradients preconditioned by the diagonal, as one fused op. "chebyshev": Chebyshev
            iteration needs no scalar products; the number of iterations that reach the tolerance is known beforehand,
            from the largest diffusion number r (Saad 2003, algorithm 12.1). It grows like √r without bound: for r up to
            100. "multigrid": conjugate gradients preconditioned by a multigrid cycle (`torch_mpm.ops.heat_multigrid`):
            few iterations for any r and lattice, each as long as about ten of "cg", after a set-up as long as about a
            hundred. Shorter than "cg" for r from 1e3 on the CPU; on CUDA, where it is hundreds of launches and "cg" is
            one, on large lattices only (2-D from 400² nodes). The host waits once per iteration, except during graph
            capture: a graph runs `max_iterations`, which then must be a number and should be small. Needs about 100
            numbers per node (3-D: 300 during set-up).
        adjoint_tolerance: tolerance of the backward solve, relative to the size of its right side.
        relative_tolerance: a residual of this share of the first one is also accepted. The changes of many small steps
            add up, so that a tolerance in kelvin alone would stop too early.
        refine: float64 accuracy from float32 data: solves in float32 with residuals in float64 between them. The
            increment is then float64; `relative_tolerance` has no effect.

    Returns:
        HeatSolve(increment, iterations, residual, converged). The increment is zero on fixed nodes, on nodes without
        heat capacity and outside the active blocks. A scene with data that are not finite, or with a time step that is
        not positive, is unchanged (increment zero, converged false) and does not affect the others. A closed scene
        (neither exchange nor fixed nodes) conserves its energy, Σ M d = dt Σ h, however early the solve ends.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices, or numbers out of range.

    Differentiable with respect to every floating tensor but the tolerance, by one more solve.
    """
    check_blocks(blocks)
    grid = blocks.grid
    check_particles(x, blocks)
    P, N = x.shape[0], blocks.node_count
    check_like("conductance", conductance, x, (P,), "[P]", needed=True)
    for name, value in (("heat_capacity", heat_capacity), ("theta", theta), ("source", source), ("exchange", exchange)):
        check_like(name, value, x, (N,), "[N]", needed=name in ("heat_capacity", "theta"))
    if fixed is not None and (not isinstance(fixed, Tensor) or fixed.shape != (N,) or fixed.dtype != torch.bool):
        raise ValueError(f"fixed must be a bool tensor of shape [N] = [{N}], got {shape_of(fixed)}")
    if fixed is not None and fixed.device != x.device:
        raise ValueError(f"fixed must be on the device of x, {x.device}, got {fixed.device}")
    number, scene_dt = split_dt(dt, grid.scenes, x)
    least, scene_tolerance = _per_scene("tolerance", tolerance, grid.scenes, x)
    most, scene_limit = _per_scene("max_iterations", max_iterations, grid.scenes, x)
    if scene_limit is not None and scene_limit.is_floating_point():
        raise TypeError(f"max_iterations must be an integer tensor, got {scene_limit.dtype}")
    check_choice("method", method, METHODS)
    check_number("adjoint_tolerance", adjoint_tolerance, "between 0 and 1", lambda v: 0 < v < 1)
    check_number("relative_tolerance", relative_tolerance, "in [0, 1)", lambda v: 0 <= v < 1)
    if scene_tolerance is not None:
        scene_tolerance = scene_tolerance.to(x.dtype).contiguous()
    if scene_limit is not None:
        scene_limit = scene_limit.int().contiguous()
    limits = float(least), relative_tolerance, scene_limit, int(most), METHODS[method], adjoint_tolerance
    op = _op_of(METHODS[method])
    if not refine or x.dtype == torch.float64:
        return HeatSolve(
            *dispatch(
                op, x, conductance, heat_capacity, theta, source, exchange, fixed, scene_dt, number, scene_tolerance,
                *limits, *blocks.packed,
            )
        )  # fmt: skip
    constant = [None if t is None else t.detach() for t in (x, conductance, heat_capacity, exchange, scene_dt)]

    def solve(right: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        x, conductance, heat_capacity, exchange, scene_dt = constant
        return dispatch(
            op, x, conductance, heat_capacity, None, right, exchange, fixed, scene_dt, number, scene_tolerance,
            limits[0], REDUCTION, *limits[2:], *blocks.packed,
        )  # fmt: skip

    steps = number * (x.new_ones(grid.scenes) if scene_dt is None else scene_dt)
    goal = x.new_full((grid.scenes,), least) if scene_tolerance is None else scene_tolerance
    return HeatSolve(
        *refinement(blocks, x, conductance, heat_capacity, theta, steps, source, exchange, fixed, goal, solve)
    )


def heat_operator(blocks: Blocks, x: Tensor, conductance: Tensor, nodes: Tensor | None) -> Tensor:
    """Outgoing heat H u of each node at node values u; H as in `heat_cg`.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        conductance: conductivity times volume κ_p V_p [P] [W m²/K in 3-D].
        nodes: temperature of the nodes u [N] [K]; None for the diagonal of H.

    Returns:
        H u [N] [W], or the diagonal H_ii [N] [W/K].

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    H u is differentiable with respect to every tensor, twice in eager mode; the diagonal is not.
    """
    check_blocks(blocks)
    check_particles(x, blocks)
    check_like("conductance", conductance, x, (x.shape[0],), "[P]", needed=True)
    check_like("nodes", nodes, x, (blocks.node_count,), "[N]")
    return dispatch(torch.ops.torch_mpm.heat_operator, x, conductance, nodes, *blocks.packed)


def _op_of(method: int) -> Any:
    return torch.ops.torch_mpm.heat_multigrid if method == METHODS["multigrid"] else torch.ops.torch_mpm.heat_cg


def _per_scene(name: str, value: float | Tensor, scenes: int, x: Tensor) -> tuple[float, Tensor | None]:
    """A number, or a tensor [B] and zero."""
    if not isinstance(value, Tensor):
        return check_number(name, value, "a finite number >= 0", lambda v: 0 <= v < math.inf, NUMBER_OR_TENSOR), None
    if value.dim() > 1 or (value.dim() == 1 and value.shape[0] not in (1, scenes)):
        raise ValueError(f"{name} must be a number or have shape [], [1] or [B] = [{scenes}], got {shape_of(value)}")
    if value.device != x.device:
        raise ValueError(f"{name} must be on the device of x, {x.device}, got {value.device}")
    return 0.0, value.expand(scenes)


# ---- `heat_multigrid` consists of ops, with the schema of `heat_cg`

_schema = str(torch.ops.torch_mpm.heat_cg.default._schema).partition("heat_cg")[2]
torch.library.define("torch_mpm::heat_multigrid", _schema)
torch.library.impl("torch_mpm::heat_multigrid", "CompositeExplicitAutograd")(heat_multigrid)


# ---- fake kernels: shapes only


@torch.library.register_fake("torch_mpm::heat_cg")
@torch.library.register_fake("torch_mpm::heat_multigrid")
def _fake(x, conductance, heat_capacity, theta, source, exchange, fixed, *arguments):
    scenes = Topology.unpack(*arguments[-3:]).scenes
    return (
        torch.empty_like(heat_capacity, memory_format=torch.contiguous_format),
        x.new_empty(scenes, dtype=torch.int32),
        x.new_empty(scenes),
        x.new_empty(scenes, dtype=torch.bool),
    )


@torch.library.register_fake("torch_mpm::heat_operator")
def _operator_fake(x, conductance, nodes, *topology):
    return x.new_empty(Topology.unpack(*topology).node_count)


# ---- autograd: with A λ = ∂L/∂d on the free nodes, changes δA of the matrix and δb of the right side of A d = b change
# the loss by λ · (δb − δA d).


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    *tensors, scene_dt, dt, _, _, _, scene_limit, max_iterations, method, adjoint_tolerance = inputs[:-3]
    save_with_topology(ctx, (*tensors, scene_dt, scene_limit, output[0]), inputs[-3:], dt=dt)
    ctx.max_iterations, ctx.method, ctx.adjoint_tolerance = max_iterations, method, adjoint_tolerance
    ctx.mark_non_differentiable(*output[1:])


def _backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Any, ...]:
    tensors, topology = saved_with_topology(ctx)
    x, conductance, heat_capacity, theta, _, exchange, fixed, scene_dt, scene_limit, d = tensors
    need_x, need_conductance, need_capacity, need_theta, need_source, need_exchange, _, need_dt = ctx.needs_input_grad[
        :8
    ]
    adjoint = _op_of(ctx.method)(
        x, conductance, heat_capacity, None, grad.contiguous(), exchange, fixed, scene_dt, ctx.dt, None, 0.0,
        ctx.adjoint_tolerance, scene_limit, ctx.max_iterations, ctx.method, ctx.adjoint_tolerance, *topology,
    )[0]  # fmt: skip
    after = d if theta is None else theta + d
    grads: list[Tensor | None] = [None] * 8
    if need_x or need_conductance:
        for_x, for_conductance = _operator_adjoint(x, conductance, after, adjoint, topology, need_x)
        grads[0] = None if for_x is None else -for_x
        grads[1] = -for_conductance
    if need_theta:
        grads[3] = -dispatch(torch.ops.torch_mpm.heat_operator, x, conductance, adjoint, *topology)
        if exchange is not None:
            grads[3] = grads[3] - exchange * adjoint
    rate = -adjoint * d
    if need_capacity or need_dt:
        scene = Topology.unpack(*topology).node_scene().long().clamp_min(0)
        # Where dt is not positive, no system is solved: both d and λ are zero.
        steps = ctx.dt if scene_dt is None else torch.where(scene_dt > 0, ctx.dt * scene_dt, 1)[scene]
        if need_capacity:
            grads[2] = rate / steps
        if need_dt:
            per_node = -rate * heat_capacity / steps**2 * ctx.dt
            grads[7] = per_node.new_zeros(scene_dt.shape).index_add(0, scene, per_node)
    if need_source:
        grads[4] = adjoint
    if need_exchange:
        grads[5] = -adjoint * after
    return (*grads,) + (None,) * 11


def _operator_adjoint(
    x: Tensor, conductance: Tensor, u: Tensor, v: Tensor, topology: PackedTopology, need_x: bool
) -> tuple[Tensor | None, Tensor]:
    """Derivatives of v · H u = Σ_p κ_p V_p ∇u · ∇v by the positions and by κ V."""
    scale = Topology.unpack(*topology).grid.inverse_inertia
    nodes = [w[:, None].contiguous() for w in (u, v)]
    gradient = [dispatch(torch.ops.torch_mpm.gather, x, w, scale, True, False, *topology)[1] for w in nodes]
    by_conductance = (gradient[0] * gradient[1]).sum((1, 2))
    if not need_x:
        return None, by_conductance
    value = torch.zeros_like(gradient[0][:, :, 0])
    first, second = (
        dispatch(
            torch.ops.torch_mpm.position_gradient, x, value, conductance[:, None, None] * g, None, w, scale, *topology
        )
        for g, w in zip(gradient, reversed(nodes), strict=True)
    )
    return first + second, by_conductance


def _operator_setup(ctx: Any, inputs: Any, output: Any) -> None:
    x, conductance, nodes, *topology = inputs
    save_with_topology(ctx, (x, conductance, nodes), topology)


def _operator_backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    (x, conductance, nodes), topology = saved_with_topology(ctx)
    if nodes is None:
        raise NotImplementedError("the diagonal of heat_operator is not differentiable")
    need_x, need_conductance, need_nodes = ctx.needs_input_grad[:3]
    grad = grad.contiguous()
    for_x = for_conductance = for_nodes = None
    if need_x or need_conductance:
        for_x, for_conductance = _operator_adjoint(x, conductance, nodes, grad, topology, need_x)
    if need_nodes:
        for_nodes = dispatch(torch.ops.torch_mpm.heat_operator, x, conductance, grad, *topology)
    return (for_x, for_conductance if need_conductance else None, for_nodes) + (None,) * 3


for _name, _adjoint, _context in (
    ("heat_cg", _backward, _setup),
    ("heat_multigrid", _backward, _setup),
    ("heat_operator", _operator_backward, _operator_setup),
):
    register_autograd(_name, _adjoint, _context)
    refuse_vmap(_name)
