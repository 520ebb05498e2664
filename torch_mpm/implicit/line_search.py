"""Start of Newton's method and step lengths along its directions, for each scene separately."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .bounds import NodeBounds
from .contact import Limit
from .system import ImplicitSystem

SUFFICIENT = 1e-4
"""Minimum decrease as a share of that predicted by the slope (Nocedal and Wright 2006, section 3.1)."""
ROUNDING = 32
"""Error of sums of energies in units in the last place."""
MOST_HALVINGS = 60
"""Maximum number of halvings of a step: where a body resists only after it has moved, as a cable across its span,
the first step of a static load is as long as the body would fall.
"""
STRETCH = 4
"""Maximum factor of |F|² of a particle in one iteration, as a stretch by e along one axis. The energy of logarithmic
strain grows so slowly beyond it that a supported body in a long step has less energy torn off and falling than at rest.
"""


class Point(NamedTuple):
    """Velocities [N, D], and the results of `ImplicitSystem.energy` for them, [B] each: their energy, its size, and the
    size of its rounding.
    """

    v: Tensor
    energy: Tensor
    size: Tensor
    rounded: Tensor


def starting_point(system: ImplicitSystem, bounds: NodeBounds | None) -> tuple[Point, Tensor]:
    """Start of the iteration, the `reference` of later energies, and the velocities to whose residual the tolerance is
    relative.

    These are v* within bounds or no motion, whichever has less energy; where neither has a finite energy, a share of v*
    that has. The iteration begins there, or at the velocities before gravity where these have still less energy, as in
    a body that is held and moves slowly. Velocities that stretch a particle too much are the last choice.
    """
    plain = _lower(
        system, _candidate(system, bounds, system.start), _candidate(system, bounds, torch.zeros_like(system.start))
    )
    lost, share = ~plain.energy.isfinite(), 1.0
    for _ in range(MOST_HALVINGS):
        if not bool(lost.any()):
            break
        share /= 2
        part = _candidate(system, bounds, share * system.start)
        plain = _lower(system, plain, part._replace(energy=torch.where(lost, part.energy, torch.inf)))
        lost = ~plain.energy.isfinite()
    begun = plain
    if system.before_gravity is not None:
        begun = _lower(system, plain, _candidate(system, bounds, system.before_gravity))
    system.reference = begun.v
    return Point(begun.v, *system.energy(begun.v)), plain.v


class _Candidate(NamedTuple):
    """Candidate for the start: a `Point`, and scenes in which it stretches a particle too much, bool [B]."""

    v: Tensor
    energy: Tensor
    size: Tensor
    rounded: Tensor
    torn: Tensor


def _candidate(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor) -> _Candidate:
    """Nearest velocities within bounds."""
    v = v if bounds is None else bounds.clamped(v)
    return _Candidate(v, *system.energy(v), system.exceeds(v, STRETCH * system.squared_stretch(system.state)))


def _lower(system: ImplicitSystem, a: _Candidate, b: _Candidate) -> _Candidate:
    """For each scene the candidate of less energy, of those that are not torn if possible."""
    less = b.energy < torch.where(a.energy.isfinite(), a.energy, torch.inf)
    lower = torch.where(b.energy.isfinite() & a.energy.isfinite() & (a.torn != b.torn), a.torn, less)
    rest = (torch.where(lower, y, x) for x, y in zip(a[1:], b[1:], strict=True))
    return _Candidate(torch.where(system.of_nodes(lower), b.v, a.v), *rest)


class Search:
    """Longest of the steps 1, ½, ¼ ... that decreases the energy of each scene sufficiently, including dissipation by
    friction, and stretches no particle by more than `STRETCH`. It begins with the whole step; the host waits for it
    only in `too_long`.

    Args:
        system, bounds: system and bounds of the velocities.
        limit: limit of friction at the end of the step; None without friction.
        residual: gradient of the energy at the start [N, D] [kg m/s].
        start: start of the step.
        end: end of the whole step [N, D] [m/s].
        done: scenes that are not changed, bool [B].

    Attributes:
        point: after the step.
        enough: scenes with a sufficient decrease, bool [B].
    """

    def __init__(
        self,
        system: ImplicitSystem,
        bounds: NodeBounds | None,
        limit: Limit | None,
        residual: Tensor,
        start: Point,
        end: Tensor,
        done: Tensor,
    ) -> None:
        self._system, self._bounds, self._limit, self._residual = system, bounds, limit, residual
        self._start, self._end = start, end
        self._most = STRETCH * system.squared_stretch(system.trial(start.v))
        self._rubbed = residual
        if limit is not None and bounds is not None:
            self._rubbed = residual + limit.slope(bounds, start.v)
        self._share = torch.where(done, 0.0, 1.0).double()
        self.point, self.enough = self._tried()

    def too_long(self) -> bool:
        """Whether the step of any scene is too long."""
        return not bool(self.enough.all())

    def shorten(self) -> None:
        """Halve the steps of scenes where they are too long until none is. Scenes without an acceptable step are
        unchanged.
        """
        for _ in range(MOST_HALVINGS):
            self._share = torch.where(self.enough, self._share, self._share / 2)
            self.point, self.enough = self._tried()
            if not self.too_long():
                return
        self._share = torch.where(self.enough, self._share, 0.0)
        v = torch.where(self._system.of_nodes(self.moved()), self._moved(), self._start.v)
        self.point, self.enough = Point(v, *self._system.energy(v)), torch.ones_like(self.enough)

    def moved(self) -> Tensor:
        """Scenes that have moved, bool [B]."""
        return self._share > 0

    def _moved(self) -> Tensor:
        share = self._system.of_nodes(self._share).to(self._end.dtype)
        v = torch.where(share == 1, self._end, self._start.v + share * (self._end - self._start.v))
        return v if self._bounds is None else self._bounds.clamped(v)

    def _tried(self) -> tuple[Point, Tensor]:
        """Point after the next shares of the step, and scenes with a sufficient decrease."""
        system, start = self._system, self._start
        v = self._moved()
        changed = system.node_sum(v != start.v) > 0  # A step below rounding helps no more than one of zero length.
        self._share = torch.where(changed, self._share, 0.0)
        point = Point(v, *system.energy(v))
        torn = system.exceeds(v, self._most)
        gain = system.gain(start.v, self._residual, v, point.energy - start.energy)
        change = v - start.v if self._bounds is None else self._bounds.change(start.v, v)
        slope = system.node_sum(self._rubbed * change)
        if self._limit is not None and self._bounds is not None:
            excess = system.node_sum(self._limit.excess(self._bounds, start.v, v))
            gain = gain + system.node_sum((self._rubbed - self._residual) * change) + excess
            slope = slope + excess
        rounding = ROUNDING * torch.finfo(v.dtype).eps * (start.rounded + point.rounded)
        enough = gain <= SUFFICIENT * slope + rounding
        return point, (enough & ~torn & point.energy.isfinite() & (slope <= 0)) | (self._share == 0)
