"""The minimum of an implicit step's energy: Newton's method with line search and conjugate gradients."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from ..ops import implicit_cg
from ..ops.implicit import NEGATIVE_CURVATURE
from .bounds import NodeBounds
from .system import ImplicitSystem

LOOSEST, TIGHTEST = 0.1, 1e-12
"""Relative tolerances of conjugate gradients within Newton's method."""
NEAR, PATIENCE = 0.05, 6
"""Share of the first residual, and number of iterations, from which the Hessian is not projected any more."""
KEPT = 0.01
"""Share of the first residual from which the preconditioner stays: so little changes any more."""
SUFFICIENT = 1e-4
"""Share of the decrease that the slope promises, which a step must bring (Nocedal and Wright 2006, section 3.1)."""
ROUNDING = 32
"""Units in the last place by which sums of energies may be wrong."""
MOST_HALVINGS = 30


@dataclasses.dataclass
class Options:
    """Numbers of `Implicit`."""

    tolerance: float
    max_iterations: int
    max_cg_iterations: int


@dataclasses.dataclass
class Minimum:
    """Where Newton's method ended.

    Attributes:
        v: node velocities [N, D] [m/s], finite.
        free: components that may move, in the axes of the nodes, bool [N, D].
        converged: bool [B].
        residual: √(g · B⁻¹ g / Σ m) [m/s], float64 [B].
        iterations, cg_iterations: int32 [B].
    """

    v: Tensor
    free: Tensor
    converged: Tensor
    residual: Tensor
    iterations: Tensor
    cg_iterations: Tensor


def free_components(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor, gradient: Tensor) -> Tensor:
    """Components of the node velocities that the step is to find, in the axes of the nodes, bool [N, D]."""
    massive = (system.mass > 0)[:, None].expand_as(v)
    return massive if bounds is None else massive & bounds.free(v, gradient)


def inverse_blocks(system: ImplicitSystem, bounds: NodeBounds | None, diagonal: Tensor, free: Tensor) -> Tensor:
    """B⁻¹ of the node blocks B [N, D, D] [kg] of the free components [1/kg], zero for the others."""
    blocks = diagonal.double()
    # Rounding of stiff blocks may leave a negative eigenvalue, with which a residual could seem to be zero.
    ridge = 16 * torch.finfo(system.mass.dtype).eps * blocks.diagonal(dim1=1, dim2=2).sum(1)
    blocks = blocks + torch.diag_embed(ridge[:, None].expand(blocks.shape[:2]))
    if bounds is not None:
        blocks = bounds.turned_blocks(blocks)
    both = free[:, :, None] & free[:, None, :]
    blocks = torch.where(both, blocks, 0) + torch.diag_embed((~free).double())
    inverse = torch.where(both, _inverse(blocks), 0)
    if bounds is not None:
        inverse = bounds.turned_blocks(inverse)
    inverse = (inverse + inverse.mT) / 2
    return inverse.to(system.mass.dtype)


def _inverse(a: Tensor) -> Tensor:
    """Of symmetric matrices [N, 2 or 3, 2 or 3]."""
    scale = a.diagonal(dim1=1, dim2=2).rsqrt()
    a = a * scale[:, :, None] * scale[:, None, :]
    if a.shape[-1] == 2:
        rows = [[a[:, 1, 1], -a[:, 0, 1]], [-a[:, 1, 0], a[:, 0, 0]]]
        cofactors = torch.stack([torch.stack(row, -1) for row in rows], -2)
        determinant = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    else:
        first, second, third = a.unbind(-1)
        rows3 = [torch.linalg.cross(second, third), torch.linalg.cross(third, first), torch.linalg.cross(first, second)]
        cofactors = torch.stack(rows3, -2)
        determinant = (first * rows3[0]).sum(-1)
    return cofactors / determinant[:, None, None] * scale[:, :, None] * scale[:, None, :]


@torch.no_grad()
def minimise(system: ImplicitSystem, bounds: NodeBounds | None, options: Options) -> Minimum:
    """The node velocities of least energy within bounds, for each scene apart.

    The host waits for the device once per iteration to learn whether all scenes are done, and once per halving of a
    step. A scene is done when its residual is `tolerance` times that of v*, or of the size of rounding; or when no step
    lowers its energy. Projected Newton of Bertsekas (1982): components at a bound that the gradient holds there are
    left out of the linear solve, and steps are clamped.
    """
    (v, energy, size), plain = _start(system, bounds)
    scenes = len(energy)
    zeros = torch.zeros(scenes, dtype=torch.int32, device=v.device)
    total_mass = system.node_sum(system.mass)
    total_mass = torch.where(total_mass > 0, total_mass, 1)
    wave, momentum = _wave_speed_squared(system, total_mass), system.mass[:, None] * system.start
    iterations, cg_iterations = zeros.clone(), zeros.clone()
    first: Tensor | None = None
    previous = forcing = None
    stalled = indefinite = torch.zeros(scenes, dtype=torch.bool, device=v.device)
    diagonal: Tensor | None = None
    while True:
        gradient = system.residual(v)
        convex: Tensor | None = None
        if diagonal is None:
            convex = system.tangent(v)
            diagonal = system.diagonal(convex)
        free = free_components(system, bounds, v, gradient)
        inverse = inverse_blocks(system, bounds, diagonal, free)
        change = _times(inverse, gradient)
        residual = (system.node_sum(gradient * change).abs() / total_mass).sqrt()
        if first is None:
            first = residual
            if plain is not v:  # a good start saves work, and does not ask for more accuracy
                slope = system.residual(plain)
                slope = system.node_sum(slope * _times(inverse, slope)).abs()
                first = torch.fmax(first, (slope / total_mass).sqrt())
        floor = _rounding(system, inverse, v, wave, momentum, total_mass)
        # One iteration at least: a smooth load may be smaller than the rounding of stresses, which averages out.
        target = torch.maximum(options.tolerance * first, torch.where(iterations > 0, floor, 0))
        small = residual <= target
        done = stalled | small
        exact = ~indefinite & ((residual <= NEAR * first) | (iterations >= PATIENCE))
        kept = done | (residual <= KEPT * first)
        looks = done | (iterations >= options.max_iterations), done | exact, ~exact, kept
        finished, all_exact, none_exact, all_kept = torch.stack(looks).all(1).tolist()
        if finished:
            break
        forcing = _forcing(residual, previous, forcing, target)
        previous = residual
        relative = torch.where(done, 1.0, forcing).to(v.dtype)
        tangent = None if none_exact and not all_exact else system.tangent(v, projected=False)
        if tangent is None or not all_exact:
            convex = system.tangent(v) if convex is None else convex
            tangent = convex if tangent is None else torch.where(system.of_particles(exact), tangent, convex)
        if not all_kept:
            diagonal = None
        solve = implicit_cg(
            *(system.blocks, system.state.x, torch.where(system.of_nodes(done), 0, -gradient), system.mass, inverse),
            *(tangent, relative, options.max_cg_iterations, system.stress_form),
        )
        indefinite = solve.state == NEGATIVE_CURVATURE
        direction = torch.where(system.of_nodes(indefinite & (solve.iterations == 0)), -change, solve.solution)
        cg_iterations += solve.iterations
        iterations += (~done).int()
        v, energy, size, moved = _search(system, bounds, v, energy, size, gradient, direction, done)
        stalled = stalled | ~(moved | done)
    # No step lowers the energy where what is left to gain is less than its rounding.
    small = small | (stalled & (residual.square() * total_mass <= ROUNDING * torch.finfo(v.dtype).eps * size))
    finite = residual.isfinite() & energy.isfinite()
    v = _with_momentum(system, bounds, v, total_mass)
    return Minimum(v, free, small & finite, residual, iterations, cg_iterations)


def _with_momentum(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor, total_mass: Tensor) -> Tensor:
    """The velocities with the momentum of v* in scenes that nothing bounds: what an early end of the solve has left of
    its error that is a translation, which has no elastic energy."""
    missing = system.mass[:, None] * (system.start - v)
    change = torch.stack([system.node_sum(column) for column in missing.unbind(1)], 1) / total_mass[:, None]
    if bounds is not None:
        bounded = (bounds.lower.isfinite() | bounds.upper.isfinite()).any(1) & (system.mass > 0)
        change = torch.where((system.node_sum(bounded) > 0)[:, None], 0, change)
    change = torch.where(change.isfinite(), change, 0)
    change = change.to(v.dtype)[system.slot_scene].repeat_interleave(system.blocks.grid.nodes_per_block, 0)
    return torch.where((system.mass > 0)[:, None], v + change, v)


def _forcing(residual: Tensor, previous: Tensor | None, forcing: Tensor | None, target: Tensor) -> Tensor:
    """Relative tolerances of the linear solves, that of the second choice of Eisenstat and Walker (1996): as tight as
    Newton's method converges, and no tighter than what is left to do."""
    if previous is None or forcing is None:
        rate = torch.full_like(residual, LOOSEST)
    else:
        rate = 0.9 * (residual / torch.where(previous > 0, previous, 1)).square()
        kept = 0.9 * forcing * forcing
        rate = torch.where(kept > 0.1, torch.maximum(rate, kept), rate).clamp_max(LOOSEST)
    enough = 0.5 * target / torch.where(residual > 0, residual, 1)
    return torch.maximum(rate, enough).clamp(TIGHTEST, 0.9).nan_to_num(LOOSEST)


def _rounding(
    system: ImplicitSystem, inverse: Tensor, v: Tensor, wave: Tensor, momentum: Tensor, total_mass: Tensor
) -> Tensor:
    """The residual that rounding leaves [m/s], [B]: of momenta, and of stresses, where strains of the size of one unit
    move waves of the given speed, and as much again for each cell that the material moves in the step."""
    speed = system.node_sum(system.mass[:, None] * v.square()) / total_mass
    cells = speed * (torch.as_tensor(system.dt, device=v.device).double() / system.blocks.grid.dx).square()
    moved = system.node_sum(momentum * _times(inverse, momentum)).clamp_min(0) / total_mass
    return 4 * torch.finfo(v.dtype).eps * (wave * (1 + cells) + moved).sqrt()


def _wave_speed_squared(system: ImplicitSystem, total_mass: Tensor) -> Tensor:
    """Σ V K/Σ m [m²/s²], [B]."""
    return (system.particle_sum(system.stiffness[:, None])[:, 0] / total_mass).clamp_min(0)


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """[N, D, D] times [N, D]."""
    return (matrices * vectors[:, None, :]).sum(-1)


class _Point(NamedTuple):
    """Velocities [N, D], and their energy and its size, `ImplicitSystem.energy` [B]."""

    v: Tensor
    energy: Tensor
    size: Tensor


def _point(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor) -> _Point:
    """The nearest velocities within bounds."""
    v = v if bounds is None else bounds.clamped(v)
    return _Point(v, *system.energy(v))


def _lower(system: ImplicitSystem, a: _Point, b: _Point) -> _Point:
    """Of each scene the one of less energy."""
    lower = b.energy < torch.where(a.energy.isfinite(), a.energy, torch.inf)
    rest = (torch.where(lower, y, x) for x, y in zip(a[1:], b[1:], strict=True))
    return _Point(torch.where(system.of_nodes(lower), b.v, a.v), *rest)


def _start(system: ImplicitSystem, bounds: NodeBounds | None) -> tuple[_Point, Tensor]:
    """Where the search begins, and the velocities whose residual the tolerance is relative to.

    These are v* within bounds or no motion, whichever has less energy; where both have none, a share of v* that has
    one. The search begins there, or at the velocities before gravity where these have less energy still, as they do in
    a body that is held and moves slowly.
    """
    plain = _lower(system, _point(system, bounds, system.start), _point(system, bounds, torch.zeros_like(system.start)))
    lost, share = ~plain.energy.isfinite(), 1.0
    for _ in range(MOST_HALVINGS):
        if not bool(lost.any()):
            break
        share /= 2
        plain = _lower(system, plain, _point(system, bounds, share * system.start))
        lost = ~plain.energy.isfinite()
    if system.before_gravity is None:
        return plain, plain.v
    return _lower(system, plain, _point(system, bounds, system.before_gravity)), plain.v


def _search(
    system: ImplicitSystem,
    bounds: NodeBounds | None,
    v: Tensor,
    energy: Tensor,
    size: Tensor,
    gradient: Tensor,
    step: Tensor,
    done: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Velocities after the longest of the steps 1, ½, ¼ ... that lowers the energy of each scene enough; their energy
    and its size; and which scenes moved, bool [B]."""
    rounding = ROUNDING * torch.finfo(v.dtype).eps
    share = torch.where(done, 0.0, 1.0).double()
    best, best_energy, best_size = v, energy, size
    for _ in range(MOST_HALVINGS):
        trial = v + system.of_nodes(share).to(v.dtype) * step
        trial = trial if bounds is None else bounds.clamped(trial)
        trial_energy, trial_size = system.energy(trial)
        slope = system.node_sum(gradient * (trial - v))
        enough = trial_energy <= energy + SUFFICIENT * slope + rounding * (size + trial_size)
        enough = (enough & trial_energy.isfinite() & (slope <= 0)) | (share == 0)
        best, best_energy, best_size = trial, trial_energy, trial_size
        if bool(enough.all()):
            break
        share = torch.where(enough, share, share / 2)
    else:  # scenes that no step helps stay where they were
        share = torch.where(enough, share, 0.0)
        best = v + system.of_nodes(share).to(v.dtype) * step
        best = torch.where(system.of_nodes(share > 0), best if bounds is None else bounds.clamped(best), v)
        best_energy, best_size = system.energy(best)
    return best, best_energy, best_size, share > 0
