"""Quadratic model of the energy of an implicit step, and its minimum within bounds and with friction."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..ops import implicit_cg
from ..ops.implicit import CONVERGED, NEGATIVE_CURVATURE
from .bounds import NodeBounds
from .contact import Contact, Limit
from .contact_model import ContactModel, ModelContact
from .gmres import gmres
from .preconditioner import inverse_blocks, times
from .system import ImplicitSystem

TIGHTEST = 1e-12
"""Relative tolerance of linear solves."""
FREE_ROUNDS, MOST_ROUNDS = 8, 20
"""Numbers of linear solves with other components held: from the first number on no held component is released."""


class Tangents(NamedTuple):
    """Derivatives of the stresses of the particles.

    Attributes:
        symmetric: argument of `implicit_cg` [P, n].
        scenes: scenes with nonsymmetric derivatives, bool [B].
        whole: the same, not projected in these scenes; None where there are none.
        skew: nonsymmetric part in these scenes [P, D, D]; None where there are none.
    """

    symmetric: Tensor
    scenes: Tensor
    whole: Tensor | None = None
    skew: Tensor | None = None


class ModelMinimum(NamedTuple):
    """Approximate minimum of the model, with friction; scenes separately.

    Attributes:
        v: velocities of the nodes [N, D] [m/s].
        limit: limit of friction there; None without friction.
        found: whether the gradient reached its target, bool [B].
        indefinite: whether the model has no minimum, bool [B].
        iterations: iterations of linear solves, int32 [B].
    """

    v: Tensor
    limit: Limit | None
    found: Tensor
    indefinite: Tensor
    iterations: Tensor


class QuadraticModel:
    """Model about an iterate.

    Args:
        system, bounds: system and bounds of the energy.
        start: the iterate [N, D] [m/s].
        gradient: gradient of the energy there [N, D] [kg m/s].
        blocks: node blocks of the Hessian [N, D, D] [kg].
        tangents: tangents of the particles.
        total_mass: mass of the scenes [B] [kg].
        most: maximum number of iterations of a linear solve.
    """

    def __init__(
        self,
        system: ImplicitSystem,
        bounds: NodeBounds | None,
        start: Tensor,
        gradient: Tensor,
        blocks: Tensor,
        tangents: Tangents,
        total_mass: Tensor,
        most: int,
    ) -> None:
        self._system, self._bounds, self._start, self._gradient = system, bounds, start, gradient
        self._blocks, self._tangents, self._total_mass, self._most = blocks, tangents, total_mass, most
        whole = tangents.symmetric if tangents.whole is None else tangents.whole
        self._product = system.derivative(whole, tangents.skew)
        self._contact = ContactModel(system, bounds, blocks)
        self._indefinite = torch.zeros_like(tangents.scenes)
        self._iterations = torch.zeros_like(tangents.scenes, dtype=torch.int32)

    def solved(self, contact: Contact, inverse: Tensor, relative: Tensor, done: Tensor) -> ModelMinimum:
        """Minimum with the free components of given contact at the iterate, by one linear solve.

        Args:
            contact: contact without bounds that a step could cross, and without friction.
            inverse: B⁻¹ of the free components.
            relative: target of the gradient, relative to the first, [B].
            done: scenes that are not changed, bool [B].
        """
        right = torch.where(self._system.of_nodes(done), 0, -contact.gradient)
        held = None if self._bounds is None else self._bounds.held_normals(contact.free)
        change, found = self._solve(right, inverse, relative, contact.free, held, None)
        return ModelMinimum(self._start + change, None, found, self._indefinite, self._iterations)

    def minimum(self, residual: Tensor, relative: Tensor, target: Tensor, done: Tensor) -> ModelMinimum:
        """Minimum where a step may cross bounds, or with friction, by linear solves until the held components do not
        change; the host waits for the device once per solve.

        The remaining gradient reaches its relative target, and is so small that the step realises the corresponding
        energy decrease of the model.

        Args:
            residual: residual of the iterate [B] [m/s].
            relative: relative target, [B].
            target: absolute target of the residual [B] [m/s].
            done: scenes that are not changed, bool [B].
        """
        system, bounds = self._system, self._bounds
        assert bounds is not None
        v, gradient, found, goal = self._start, self._gradient, done, relative.double() * residual
        contact: ModelContact | None = None
        for number in range(MOST_ROUNDS):
            last, contact, before = contact, self._contact.at(v, gradient, contact, number < FREE_ROUNDS), v
            if last is not None:
                contact = contact.kept(last, system.of_nodes(found))
            v = contact.v
            if number:
                gradient = self._gradient + self._product(v - self._start)
            force = gradient if contact.force is None else gradient + contact.force
            force = bounds.kept(force, contact.free)
            blocks = self._blocks if contact.across is None else self._blocks + contact.across
            inverse = inverse_blocks(bounds, blocks, contact.free)
            left = self._size(force, times(inverse, force))
            if number:
                remains = left + self._size(v - before, times(blocks, v - before))
                enough = self.gain(v, (self._gradient + gradient) / 2, contact.limit) >= self._total_mass * remains**2
                near = remains <= goal
                found = found | self._indefinite | (near & (enough | (goal <= target / 2))) | ~remains.isfinite()
                goal = torch.where(near & ~enough, torch.minimum(torch.maximum(goal / 10, target / 2), goal), goal)
                if bool(found.all()):
                    break
            share = (0.5 * goal / torch.where(left > 0, left, 1)).clamp(TIGHTEST, 0.9)
            right = torch.where(system.of_nodes(found), 0, -force)
            held = bounds.held_normals(contact.free)
            change, _ = self._solve(right, inverse, share.to(v.dtype), contact.free, held, contact.across)
            v, gradient = v + change, gradient + self._product(change)
        assert contact is not None
        return ModelMinimum(v, contact.limit, found & ~self._indefinite, self._indefinite, self._iterations)

    def gain(self, end: Tensor, gradient: Tensor, limit: Limit | None) -> Tensor:
        """Energy change on the way to velocities [N, D] [m/s] with a constant gradient [N, D] [kg m/s], and of
        friction, float64 [B] [J].
        """
        system, bounds, start = self._system, self._bounds, self._start
        if bounds is None:
            return -system.node_sum(gradient * (end - start))
        if limit is None:
            return -system.node_sum(gradient * bounds.change(start, end))
        gradient = gradient + limit.slope(bounds, start)
        return -system.node_sum(gradient * bounds.change(start, end)) - system.node_sum(
            limit.excess(bounds, start, end)
        )

    def _size(self, force: Tensor, change: Tensor) -> Tensor:
        """√(force · change/Σ m) of each scene [m/s], float64 [B]."""
        return (self._system.node_sum(force * change).abs() / self._total_mass).sqrt()

    def _solve(
        self,
        right: Tensor,
        inverse: Tensor,
        relative: Tensor,
        free: Tensor,
        held: Tensor | None,
        across: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Step whose product with the Hessian is `right` up to a relative tolerance, or B⁻¹ times `right` where there
        is none; and the scenes where it was found, bool [B].
        """
        system, most, tangents = self._system, self._most, self._tangents
        whole = None if tangents.whole is None else system.of_nodes(tangents.scenes)
        own = right if whole is None else torch.where(whole, 0, right)
        solve = implicit_cg(
            *(system.blocks, system.state.x, own, system.mass, inverse, tangents.symmetric, relative, most),
            *(system.stress_form, across, system.images, held),
        )
        indefinite, found = solve.state == NEGATIVE_CURVATURE, solve.state == CONVERGED
        steepest = system.of_nodes(indefinite & (solve.iterations == 0))
        step = torch.where(steepest, times(inverse, right), solve.solution)
        self._indefinite = self._indefinite | indefinite
        self._iterations = self._iterations + solve.iterations
        if whole is None:
            return step, found
        product = self._of_free(free, across)
        other = gmres(system, product, inverse, torch.where(whole, right, 0), relative, most)
        descends = system.node_sum(right * other.solution) > 0
        others = torch.where(system.of_nodes(descends), other.solution, times(inverse, right))
        self._iterations = self._iterations + other.iterations
        found = torch.where(tangents.scenes, other.converged & descends, found)
        return torch.where(whole, others, step), found

    def _of_free(self, free: Tensor, across: Tensor | None) -> Callable[[Tensor], Tensor]:
        """Derivative of the residual with that of friction, for free components."""

        def product(d: Tensor) -> Tensor:
            result = self._product(d) if across is None else self._product(d) + times(across, d)
            return result if self._bounds is None else self._bounds.kept(result, free)

        return product
