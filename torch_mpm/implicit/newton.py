"""The minimum of an implicit step's energy: Newton's method with line search and conjugate gradients."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..ops import implicit_cg
from ..ops.implicit import NEGATIVE_CURVATURE
from .bounds import NodeBounds
from .contact import Contact, Limit, contact_at
from .gmres import gmres
from .preconditioner import preconditioned, times
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
SYMMETRIC = 1e-3
"""Skew part of the tangents, relative to the rest, up to which they count as symmetric."""
SETTLED, OLDEST = 0.3, 5
"""Where renewing friction has raised the residual, it is kept until the share of the residual is left that does not
follow from its change; for this many iterations at most."""


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
    stalled = indefinite = kept = torch.zeros(scenes, dtype=torch.bool, device=v.device)
    diagonal: Tensor | None = None
    all_kept = False
    lag = _Lag(scenes, v.device)
    while True:
        elastic = system.residual(v)
        convex: Tensor | None = None
        if diagonal is None or not all_kept:
            convex = system.tangent(v)
            fresh = system.diagonal(convex)
            diagonal = fresh if diagonal is None else torch.where(system.of_nodes(kept)[:, :, None], diagonal, fresh)
        contact = contact_at(system, bounds, v, elastic)
        inverse, change, residual = preconditioned(system, bounds, diagonal, contact, total_mass)
        if first is None:
            first = residual
            if plain is not v:  # a good start saves work, and does not ask for more accuracy
                there = contact_at(system, bounds, plain, system.residual(plain))
                first = torch.fmax(first, preconditioned(system, bounds, diagonal, there, total_mass)[2])
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
        tangent = _tangent(system, v, convex, exact, all_exact, none_exact)
        skew = system.skew(v) if system.flows else None
        whole = torch.zeros_like(done)
        if skew is not None:
            whole = skewed(system, skew, tangent, SYMMETRIC) & ~(done | lag.still)
        model, blocks, across = contact, diagonal, None
        if contact.friction is not None:
            model = lag.contact(system, bounds, v, elastic, diagonal, contact, residual, total_mass)
            across = None if model.friction is None else model.friction.curvature(change.norm(dim=1, keepdim=True))
            blocks = blocks if across is None else blocks + across
            inverse, change, _ = preconditioned(system, bounds, blocks, model, total_mass)
        right = torch.where(system.of_nodes(done | whole), 0, -model.gradient)
        solve = implicit_cg(
            *(system.blocks, system.state.x, right, system.mass, inverse, tangent, relative),
            *(options.max_cg_iterations, system.stress_form),
            local=across,
            images=system.images,
        )
        indefinite = solve.state == NEGATIVE_CURVATURE
        direction = torch.where(system.of_nodes(indefinite & (solve.iterations == 0)), -change, solve.solution)
        cg_iterations += solve.iterations
        if skew is not None and bool(whole.any()):
            unprojected = tangent if all_exact else system.tangent(v, projected=False)
            derivative = _free_derivative(system, bounds, unprojected, skew, model, across)
            step, more = _not_symmetric(system, derivative, inverse, change, model, whole, relative, options)
            direction = torch.where(system.of_nodes(whole), step, direction)
            cg_iterations += more
        iterations += (~done).int()
        v, energy, size, moved = _search(system, bounds, model, elastic, v, energy, size, direction, done)
        lag.still = ~(moved | done)
        stalled = stalled | (lag.still & lag.renewed & ~whole)
    # No step lowers the energy where what is left to gain is less than its rounding.
    small = small | (stalled & (residual.square() * total_mass <= ROUNDING * torch.finfo(v.dtype).eps * size))
    finite = residual.isfinite() & energy.isfinite()
    v = _with_momentum(system, bounds, v, total_mass)
    return Minimum(v, contact.free, small & finite, residual, iterations, cg_iterations)


def _tangent(
    system: ImplicitSystem, v: Tensor, convex: Tensor | None, exact: Tensor, all_exact: bool, none_exact: bool
) -> Tensor:
    """Tangents of the particles, not projected in scenes that are exact, bool [B], and with the projected ones if these
    are known."""
    if all_exact:
        return system.tangent(v, projected=False)
    convex = system.tangent(v) if convex is None else convex
    if none_exact:
        return convex
    return torch.where(system.of_particles(exact), system.tangent(v, projected=False), convex)


def skewed(system: ImplicitSystem, skew: Tensor, tangent: Tensor, share: float | Tensor) -> Tensor:
    """Scenes where the skew parts of the tangents are more than a share of the rest, bool [B]."""
    dim = skew.shape[1]
    moduli = tangent[:, 2 * dim * dim :]
    sizes = torch.stack([skew.square().sum((1, 2)), moduli.square().sum(1)], 1).double()
    skew_size, size = system.particle_sum(sizes).unbind(1)
    return skew_size > share**2 * size


def _free_derivative(
    system: ImplicitSystem,
    bounds: NodeBounds | None,
    tangent: Tensor,
    skew: Tensor,
    model: Contact,
    across: Tensor | None,
) -> Callable[[Tensor], Tensor]:
    """The derivative of the residual with that of friction, of what is free."""
    derivative = system.derivative(tangent, skew)

    def product(d: Tensor) -> Tensor:
        result = derivative(d) if across is None else derivative(d) + times(across, d)
        return result if bounds is None else bounds.kept(result, model.free)

    return product


def _not_symmetric(
    system: ImplicitSystem,
    derivative: Callable[[Tensor], Tensor],
    inverse: Tensor,
    change: Tensor,
    model: Contact,
    scenes: Tensor,
    relative: Tensor,
    options: Options,
) -> tuple[Tensor, Tensor]:
    """Newton steps with the whole derivative in some scenes, bool [B], or −B⁻¹ g where they do not descend; and the
    iterations that they took."""
    right = torch.where(system.of_nodes(scenes), -model.gradient, 0)
    solve = gmres(system, derivative, inverse, right, relative, options.max_cg_iterations)
    descends = system.node_sum(model.gradient * solve.solution) < 0
    return torch.where(system.of_nodes(descends), solve.solution, -change), solve.iterations


class _Lag:
    """The limits of friction that Newton's method works with, those of an earlier iterate in some scenes.

    Attributes:
        renewed: scenes whose limits are those of this iterate, bool [B].
        still: scenes that the step before did not move, bool [B].
    """

    def __init__(self, scenes: int, device: torch.device) -> None:
        self.renewed = torch.ones(scenes, dtype=torch.bool, device=device)
        self.still = self._careful = ~self.renewed
        self._age = torch.zeros(scenes, dtype=torch.int32, device=device)
        self._limit: Limit | None = None
        self._residual: Tensor | None = None

    def contact(
        self,
        system: ImplicitSystem,
        bounds: NodeBounds | None,
        v: Tensor,
        elastic: Tensor,
        blocks: Tensor,
        now: Contact,
        residual: Tensor,
        total_mass: Tensor,
    ) -> Contact:
        """Contact with the limits of friction to go on with, of contact with those of this iterate."""
        assert now.friction is not None
        if self._limit is None or self._residual is None:
            self._limit, self._residual = now.friction.limit, residual
            return now
        self._careful = self._careful | (residual > self._residual)
        before = contact_at(system, bounds, v, elastic, self._limit)
        left = preconditioned(system, bounds, blocks, before, total_mass)[2]
        self.renewed = self.still | ~self._careful | (self._age >= OLDEST) | ~(left > SETTLED * residual)
        self._age = torch.where(self.renewed, 0, self._age + 1)
        self._limit, self._residual = self._limit.renewed(now.friction.limit, system.of_nodes(self.renewed)), residual
        return contact_at(system, bounds, v, elastic, self._limit)


def _with_momentum(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor, total_mass: Tensor) -> Tensor:
    """The velocities with the momentum of v* in scenes that nothing bounds: what an early end of the solve has left of
    its error that is a translation, which has no elastic energy."""
    missing = system.mass[:, None] * (system.start - v)
    change = torch.stack([system.node_sum(column) for column in missing.unbind(1)], 1) / total_mass[:, None]
    if bounds is not None:
        bounded = (bounds.lower.isfinite() | bounds.upper.isfinite()).any(1) & (system.mass > 0)
        if system.mirrors is not None:
            bounded |= system.mirrors.has(len(bounded))
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
    moved = system.node_sum(momentum * times(inverse, momentum)).clamp_min(0) / total_mass
    return 4 * torch.finfo(v.dtype).eps * (wave * (1 + cells) + moved).sqrt()


def _wave_speed_squared(system: ImplicitSystem, total_mass: Tensor) -> Tensor:
    """Σ V K/Σ m [m²/s²], [B]."""
    return (system.particle_sum(system.stiffness[:, None])[:, 0] / total_mass).clamp_min(0)


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
        part = _point(system, bounds, share * system.start)
        plain = _lower(system, plain, part._replace(energy=torch.where(lost, part.energy, torch.inf)))
        lost = ~plain.energy.isfinite()
    if system.before_gravity is None:
        return plain, plain.v
    return _lower(system, plain, _point(system, bounds, system.before_gravity)), plain.v


def _search(
    system: ImplicitSystem,
    bounds: NodeBounds | None,
    contact: Contact,
    residual: Tensor,
    v: Tensor,
    energy: Tensor,
    size: Tensor,
    step: Tensor,
    done: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Velocities after the longest of the steps 1, ½, ¼ ... that lowers the energy of each scene enough, what friction
    dissipates counted; their energy and its size; and which scenes moved, bool [B]."""
    rounding = ROUNDING * torch.finfo(v.dtype).eps
    friction = contact.friction

    def moved(share: Tensor) -> Tensor:
        trial = v + system.of_nodes(share).to(v.dtype) * step
        trial = trial if friction is None else friction.clamped(trial)
        return trial if bounds is None else bounds.clamped(trial)

    share = torch.where(done, 0.0, 1.0).double()
    best, best_energy, best_size = v, energy, size
    for _ in range(MOST_HALVINGS):
        trial = moved(share)
        trial_energy, trial_size = system.energy(trial)
        gain = system.gain(v, residual, trial, trial_energy - energy)
        if friction is not None:
            gain = gain + system.node_sum(friction.gain(trial))
        slope = system.node_sum(contact.gradient * (trial - v))
        enough = gain <= SUFFICIENT * slope + rounding * (size + trial_size)
        enough = (enough & trial_energy.isfinite() & (slope <= 0)) | (share == 0)
        best, best_energy, best_size = trial, trial_energy, trial_size
        if bool(enough.all()):
            break
        share = torch.where(enough, share, share / 2)
    else:  # scenes that no step helps stay where they were
        share = torch.where(enough, share, 0.0)
        best = torch.where(system.of_nodes(share > 0), moved(share), v)
        best_energy, best_size = system.energy(best)
    return best, best_energy, best_size, share > 0
