"""Where Newton's method begins, and how far it goes along its directions, for each scene apart."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .bounds import NodeBounds
from .contact import Limit
from .system import ImplicitSystem

SUFFICIENT = 1e-4
"""Share of the decrease that the slope promises, which a step must bring (Nocedal and Wright 2006, section 3.1)."""
ROUNDING = 32
"""Units in the last place by which sums of energies may be wrong."""
MOST_HALVINGS = 60
"""Where a body resists only once it has moved, as a cable across its span does, the first step of a static load is as
long as the body would fall."""


class Point(NamedTuple):
    """Velocities [N, D], and what `ImplicitSystem.energy` returns for them, [B] each: their energy, its size, and that
    of its rounding."""

    v: Tensor
    energy: Tensor
    size: Tensor
    rounded: Tensor


def starting_point(system: ImplicitSystem, bounds: NodeBounds | None) -> tuple[Point, Tensor]:
    """Where the search begins, the `reference` of the energies from there on, and the velocities whose residual the
    tolerance is relative to.

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
    begun = plain
    if system.before_gravity is not None:
        begun = _lower(system, plain, _point(system, bounds, system.before_gravity))
    system.reference = begun.v
    return Point(begun.v, *system.energy(begun.v)), plain.v


def _point(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor) -> Point:
    """The nearest velocities within bounds."""
    v = v if bounds is None else bounds.clamped(v)
    return Point(v, *system.energy(v))


def _lower(system: ImplicitSystem, a: Point, b: Point) -> Point:
    """Of each scene the one of less energy."""
    lower = b.energy < torch.where(a.energy.isfinite(), a.energy, torch.inf)
    rest = (torch.where(lower, y, x) for x, y in zip(a[1:], b[1:], strict=True))
    return Point(torch.where(system.of_nodes(lower), b.v, a.v), *rest)


class Search:
    """The longest of the steps 1, ½, ¼ ... that lowers the energy of each scene enough, what friction dissipates
    counted. It begins with the whole step, and the host does not wait for it until it asks what is `too_long`.

    Args:
        system, bounds: whose velocities they are.
        limit: of friction, that of the end of the step; None without friction.
        residual: gradient of the energy at the start [N, D] [kg m/s].
        start: where the step begins.
        end: of the whole step [N, D] [m/s].
        done: scenes that stay where they are, bool [B].

    Attributes:
        point: after the step.
        enough: scenes whose energy is low enough there, bool [B].
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
        self._rubbed = residual
        if limit is not None and bounds is not None:
            self._rubbed = residual + limit.slope(bounds, start.v)
        self._share = torch.where(done, 0.0, 1.0).double()
        self.point, self.enough = self._tried()

    def too_long(self) -> bool:
        """Whether the step of any scene is too long."""
        return not bool(self.enough.all())

    def shorten(self) -> None:
        """Halve the steps of scenes where they are too long until none is. Scenes that no step helps stay where they
        were."""
        for _ in range(MOST_HALVINGS):
            self._share = torch.where(self.enough, self._share, self._share / 2)
            self.point, self.enough = self._tried()
            if not self.too_long():
                return
        self._share = torch.where(self.enough, self._share, 0.0)
        v = torch.where(self._system.of_nodes(self.moved()), self._moved(), self._start.v)
        self.point, self.enough = Point(v, *self._system.energy(v)), torch.ones_like(self.enough)

    def moved(self) -> Tensor:
        """Scenes that are not where they were, bool [B]."""
        return self._share > 0

    def _moved(self) -> Tensor:
        share = self._system.of_nodes(self._share).to(self._end.dtype)
        v = torch.where(share == 1, self._end, self._start.v + share * (self._end - self._start.v))
        return v if self._bounds is None else self._bounds.clamped(v)

    def _tried(self) -> tuple[Point, Tensor]:
        """The point after the shares of the step that are next, and where its energy is low enough."""
        system, start = self._system, self._start
        v = self._moved()
        changed = system.node_sum(v != start.v) > 0  # a step below rounding helps no more than one of no length
        self._share = torch.where(changed, self._share, 0.0)
        point = Point(v, *system.energy(v))
        gain = system.gain(start.v, self._residual, v, point.energy - start.energy)
        change = v - start.v if self._bounds is None else self._bounds.change(start.v, v)
        slope = system.node_sum(self._rubbed * change)
        if self._limit is not None and self._bounds is not None:
            excess = system.node_sum(self._limit.excess(self._bounds, start.v, v))
            gain = gain + system.node_sum((self._rubbed - self._residual) * change) + excess
            slope = slope + excess
        rounding = ROUNDING * torch.finfo(v.dtype).eps * (start.rounded + point.rounded)
        enough = gain <= SUFFICIENT * slope + rounding
        return point, (enough & point.energy.isfinite() & (slope <= 0)) | (self._share == 0)
