"""Minimum of an implicit step's energy: Newton's method with line search and conjugate gradients."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from .bounds import NodeBounds
from .contact import Contact, contact_at
from .line_search import ROUNDING, Point, Search, starting_point
from .preconditioner import preconditioned, times
from .quadratic_model import TIGHTEST, QuadraticModel, Tangents
from .system import ImplicitSystem

LOOSEST = 0.1
"""Relative tolerance of linear solves within Newton's method."""
NEAR, PATIENCE = 0.05, 6
"""Share of the first residual, and number of iterations, from which the Hessian is no longer projected."""
KEPT = 0.01
"""Share of the first residual from which the preconditioner is reused: changes are small there."""
SYMMETRIC = 1e-3
"""Skew part of the tangents, relative to the rest, up to which they are treated as symmetric."""
ERROR_OF_MOTION = 0.1
"""Maximum error of the velocities, as √(g · H⁻¹ g), relative to the square root of the energy of the motion, of a
converged scene: the energy is then accurate to 1%. A residual may be small because dt is long, or because the remaining
error is smooth.
"""
ERROR_OF_PLACE = 1e-3
"""Share of dx that the error may move the material in a step, if it is also small compared with the motion to v*: where
rounding hides the strains of a stiff body, its motion is accurate nevertheless.
"""
UNRESOLVED = 128
"""Units in the last place of the elastic energy that the gradient of the displacement of a step would have if all of it
were strain: the energy of a smaller motion is lost in the rounding of the Hessian, whose solves are then meaningless.
"""


@dataclasses.dataclass
class Options:
    """Settings of `Implicit`."""

    tolerance: float
    max_iterations: int
    max_cg_iterations: int


@dataclasses.dataclass
class Minimum:
    """Result of Newton's method.

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
    """Node velocities of least energy within bounds, for each scene separately.

    The host waits for the device once per iteration, to read whether the last step has decreased the energy of all
    scenes and whether all are done; otherwise once for each halving and once more; and where a step may cross bounds,
    or with friction, once per linear solve. A scene is done when its residual is `tolerance` times that of v*, or of
    the size of rounding, and the predicted energy decrease of Newton's method is small compared with the energy of the
    motion; or when no step decreases its energy. Contact and friction are a part of the quadratic model of a step.
    """
    return _Newton(system, bounds, options).minimum()


@dataclasses.dataclass
class _Iterate:
    """Node velocities and derived values of the method; flags of scenes are bool [B].

    Attributes:
        elastic: gradient of the energy, without friction [N, D] [kg m/s].
        convex: projected tangents of the particles [P, n], None where the node blocks are those of the previous
            iterate.
        diagonal: node blocks of the Hessian [N, D, D] [kg].
        inverse, change, residual: `preconditioned`.
        target: residual that is small enough, float64 [B] [m/s].
        small: whether the residual is.
        done: small, or no step decreases the energy.
        exact: whether the Hessian is not projected.
        kept: whether the next iterate reuses the node blocks.
    """

    point: Point
    elastic: Tensor
    convex: Tensor | None
    diagonal: Tensor
    contact: Contact
    inverse: Tensor
    change: Tensor
    residual: Tensor
    target: Tensor
    small: Tensor
    done: Tensor
    exact: Tensor
    kept: Tensor


class _Look(NamedTuple):
    """Values that the host reads, for all scenes together."""

    finished: bool
    all_exact: bool
    none_exact: bool
    all_kept: bool
    lowered: bool
    """Whether the step that led here decreases the energy sufficiently."""


class _Newton:
    """Newton's method for one system, with its state between iterations."""

    def __init__(self, system: ImplicitSystem, bounds: NodeBounds | None, options: Options) -> None:
        self._system, self._bounds, self._options = system, bounds, options
        self._begun, self._plain = starting_point(system, bounds)
        device, scenes = self._plain.device, len(self._begun.energy)
        self._iterations = torch.zeros(scenes, dtype=torch.int32, device=device)
        self._cg_iterations = self._iterations.clone()
        mass = system.node_sum(system.mass)
        self._total_mass = torch.where(mass > 0, mass, 1)
        self._wave = _wave_speed_squared(system, self._total_mass)
        self._momentum = system.mass[:, None] * system.start
        self._first: Tensor | None = None
        self._previous: Tensor | None = None
        self._forcing: Tensor | None = None
        none = torch.zeros(scenes, dtype=torch.bool, device=device)
        self._stalled = self._indefinite = self._whole = self._still = none
        # Twice the predicted energy decrease of the last step of each scene, without contact, [J].
        self._expected = torch.full_like(self._begun.energy, torch.inf)

    def minimum(self) -> Minimum:
        """Result."""
        now, careful = self._at(self._begun), False
        look = self._look(now)
        while not look.finished:
            search = self._step(now, look)
            # Where one step was too long the next often is, and computing an iterate there would be wasted.
            careful = careful and search.too_long()
            if careful:
                self._shorten(search, now)
            after = self._at(search.point, now, look.all_kept)
            next_look = self._look(after, search)
            if not next_look.lowered:
                del after
                careful = True
                self._shorten(search, now)
                after = self._at(search.point, now, look.all_kept)
                next_look = self._look(after)
            now, look = after, next_look
        # No step decreases the energy where the remaining decrease is below its rounding.
        v, energy, _, rounded = now.point
        rounding = ROUNDING * torch.finfo(v.dtype).eps * rounded
        stuck = self._stalled & (now.residual.square() * self._total_mass <= rounding)
        small = now.small | (stuck & self._near(now.point, now.contact))
        small = small & now.residual.isfinite() & energy.isfinite()
        v = _with_momentum(self._system, self._bounds, v, self._total_mass)
        return Minimum(v, now.contact.free, small, now.residual, self._iterations, self._cg_iterations)

    def _at(self, point: Point, before: _Iterate | None = None, all_kept: bool = False) -> _Iterate:
        """Iterate at a point, after another one whose node blocks may be reused."""
        system, bounds, v = self._system, self._bounds, point.v
        elastic = system.residual(v)
        convex: Tensor | None = None
        if before is not None and all_kept:
            diagonal = before.diagonal
        else:
            convex = system.tangent(v)
            diagonal = system.diagonal(convex)
            if before is not None:
                diagonal = torch.where(system.of_nodes(before.kept)[:, :, None], before.diagonal, diagonal)
        contact = contact_at(system, bounds, v, elastic)
        inverse, change, residual = preconditioned(system, bounds, diagonal, contact, self._total_mass)
        first = self._first_residual(point, diagonal, residual)
        floor = _rounding(system, inverse, v, self._wave, self._momentum, self._total_mass)
        # At least one iteration: a smooth load may be smaller than the rounding of stresses, which averages out.
        target = torch.maximum(self._options.tolerance * first, torch.where(self._iterations > 0, floor, 0))
        small = (residual <= target) & self._near(point, contact)
        done = self._stalled | small
        exact = ~self._indefinite & ((residual <= NEAR * first) | (self._iterations >= PATIENCE))
        kept = done | (residual <= KEPT * first)
        rest = {"inverse": inverse, "change": change, "residual": residual, "target": target}
        flags = {"small": small, "done": done, "exact": exact, "kept": kept}
        return _Iterate(point, elastic, convex, diagonal, contact, **rest, **flags)

    def _near(self, point: Point, contact: Contact) -> Tensor:
        """Scenes whose error is small compared with their motion, or with that of v* and dx, bool [B]: by the last
        step, which was no shorter than the remaining error, or by the mass of the nodes, which the Hessian exceeds.
        """
        system, mass, v = self._system, self._system.mass[:, None], point.v
        by_mass = system.node_sum(contact.gradient.square() / torch.where(mass > 0, mass, 1))
        size = torch.maximum(point.size, torch.where(self._begun.energy.isfinite(), self._begun.size, 0))
        most = 2 * ERROR_OF_MOTION**2 * size
        resolved = size >= UNRESOLVED * torch.finfo(v.dtype).eps * system.unrotated(v)
        change = (system.node_sum(mass * (v - system.start).square()) / self._total_mass).sqrt()
        cell = system.blocks.grid.dx / torch.as_tensor(system.dt, device=v.device).double()
        harmless = self._total_mass * torch.minimum(ERROR_OF_MOTION * change, ERROR_OF_PLACE * cell).square()
        return (by_mass <= most) | ((self._expected <= most) & resolved) | (self._expected <= harmless)

    def _first_residual(self, point: Point, diagonal: Tensor, residual: Tensor) -> Tensor:
        """Reference of the tolerance [m/s], [B]: a good start saves work, but does not raise the accuracy."""
        if self._first is None:
            self._first = residual
            if self._plain is not point.v:
                system, bounds = self._system, self._bounds
                there = contact_at(system, bounds, self._plain, system.residual(self._plain))
                plain = preconditioned(system, bounds, diagonal, there, self._total_mass)[2]
                self._first = torch.fmax(residual, plain)
        return self._first

    def _look(self, now: _Iterate, search: Search | None = None) -> _Look:
        over = now.done | (self._iterations >= self._options.max_iterations)
        lowered = torch.ones_like(over) if search is None else search.enough
        looks = over, now.done | now.exact, ~now.exact, now.kept, lowered
        return _Look(*torch.stack(looks).all(1).tolist())

    def _shorten(self, search: Search, now: _Iterate) -> None:
        """Shorten steps from an iterate that are too long."""
        search.shorten()
        self._still = ~(search.moved() | now.done)
        self._stalled = self._stalled | (self._still & ~self._whole)

    def _step(self, now: _Iterate, look: _Look) -> Search:
        """Line search along the direction of Newton's method."""
        system, bounds, v = self._system, self._bounds, now.point.v
        self._forcing = _forcing(now.residual, self._previous, self._forcing, now.target)
        self._previous = now.residual
        # Rounding of a residual must not end a solve before its smooth part is found.
        assert self._first is not None
        tight = (LOOSEST * self._first / torch.where(now.residual > 0, now.residual, 1)).clamp_max(0.5)
        reached = now.residual <= now.target
        forcing = torch.where(reached, torch.minimum(self._forcing, tight), self._forcing).clamp_min(TIGHTEST)
        relative = torch.where(now.done, 1.0, forcing).to(v.dtype)
        model = QuadraticModel(
            *(system, bounds, v, now.elastic, now.diagonal, self._tangents(now, look), self._total_mass),
            self._options.max_cg_iterations,
        )
        if bounds is not None and bounds.crossable:
            minimum = model.minimum(now.residual, relative, now.target, now.done)
        else:
            minimum = model.solved(now.contact, now.inverse, relative, now.done)
        self._indefinite = minimum.indefinite
        self._cg_iterations += minimum.iterations
        expected = model.gain(minimum.v, now.elastic, minimum.limit)
        counts = reached | (now.target <= self._options.tolerance * self._first)
        expected = torch.where(minimum.found & (forcing <= tight) & counts & (expected >= 0), expected, torch.inf)
        self._expected = torch.where(now.done, self._expected, expected)
        self._iterations += (~now.done).int()
        self._still = torch.zeros_like(now.done)
        return Search(system, bounds, minimum.limit, now.elastic, now.point, minimum.v, now.done)

    def _tangents(self, now: _Iterate, look: _Look) -> Tangents:
        """Tangents of the particles at an iterate, not projected in scenes that are exact; also their nonsymmetric
        part.
        """
        system, v = self._system, now.point.v
        tangent = _tangent(system, v, now.convex, now.exact, look.all_exact, look.none_exact)
        now.convex = None
        self._whole = torch.zeros_like(now.done)
        if not system.flows:
            return Tangents(tangent, self._whole)
        skew = system.skew(v)
        self._whole = skewed(system, skew, tangent, SYMMETRIC) & ~(now.done | self._still)
        if not bool(self._whole.any()):
            return Tangents(tangent, self._whole)
        here = system.of_particles(self._whole)
        whole = tangent if look.all_exact else torch.where(here, system.tangent(v, projected=False), tangent)
        return Tangents(tangent, self._whole, whole, torch.where(here[:, :, None], skew, 0))


def _tangent(
    system: ImplicitSystem, v: Tensor, convex: Tensor | None, exact: Tensor, all_exact: bool, none_exact: bool
) -> Tensor:
    """Tangents of the particles, not projected in scenes that are exact, bool [B], combined with the projected ones if
    these are known.
    """
    if all_exact:
        return system.tangent(v, projected=False)
    convex = system.tangent(v) if convex is None else convex
    if none_exact:
        return convex
    return torch.where(system.of_particles(exact), system.tangent(v, projected=False), convex)


def skewed(system: ImplicitSystem, skew: Tensor, tangent: Tensor, share: float | Tensor) -> Tensor:
    """Scenes where the skew parts of the tangents exceed a share of the rest, bool [B]."""
    dim = skew.shape[1]
    moduli = tangent[:, 2 * dim * dim :]
    sizes = torch.stack([skew.square().sum((1, 2)), moduli.square().sum(1)], 1).double()
    skew_size, size = system.particle_sum(sizes).unbind(1)
    return skew_size > share**2 * size


def _with_momentum(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor, total_mass: Tensor) -> Tensor:
    """Velocities with the momentum of v* in scenes without bounds: an early end of the solve leaves an error that is a
    translation, which has no elastic energy.
    """
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
    """Relative tolerances of the linear solves, by the second choice of Eisenstat and Walker (1996): as tight as the
    convergence of Newton's method, and no tighter than the remaining work.
    """
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
    """Residual due to rounding [m/s], [B]: of momenta, and of stresses, where strains of one unit move waves of the
    given speed, and as much again for each cell that the material moves in the step.
    """
    speed = system.node_sum(system.mass[:, None] * v.square()) / total_mass
    cells = speed * (torch.as_tensor(system.dt, device=v.device).double() / system.blocks.grid.dx).square()
    moved = system.node_sum(momentum * times(inverse, momentum)).clamp_min(0) / total_mass
    return 2 * torch.finfo(v.dtype).eps * (wave * (1 + cells) + moved).sqrt()


def _wave_speed_squared(system: ImplicitSystem, total_mass: Tensor) -> Tensor:
    """Σ V K/Σ m [m²/s²], [B]."""
    return (system.particle_sum(system.stiffness[:, None])[:, 0] / total_mass).clamp_min(0)
