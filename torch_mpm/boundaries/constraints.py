"""The velocity of nodes that meet several surfaces at once, in torch operations: csrc/grid/constraints.h."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from ..geometry.vectors import norm
from .contact import contact_change
from .walls import Face

KINDS = {"sticky": 1, "slip": 2, "separate": 3}
"""Numbers of csrc/grid/friction.h."""


@dataclasses.dataclass
class Constraints:
    """The surfaces that nodes meet, of obstacles and then of walls: C of each node.

    Attributes:
        owner: obstacle of each, int64 [n, C]: −1 for none, −2 for a wall.
        kind: a number of `KINDS`, int64 [n, C].
        friction: [n, C].
        normal: unit normals into the material [n, C, D].
        velocity: of the surfaces [n, C, D] [m/s].
    """

    owner: Tensor
    kind: Tensor
    friction: Tensor
    normal: Tensor
    velocity: Tensor

    def with_walls(self, faces: Sequence[Face], at: Tensor) -> Constraints:
        """With the walls that nodes are at, bool [n, 2 D], where they do not look the way of another surface.

        They keep the normal velocity that the grid update gave the nodes. Sticky ones leave the nodes to the obstacle.
        """
        normals, owners = [self.normal], [self.owner]
        kinds = [self.kind]
        for number, face in enumerate(faces):
            if face.kind in ("open", "sticky"):
                continue
            axis, up = number // 2, 1 - 2 * (number % 2)
            known = torch.cat(owners, 1) != -1
            parallel = ((torch.cat(normals, 1)[:, :, axis].abs() > 0.99) & known).any(1)
            has = at[:, number] & ~parallel & (self.owner[:, 0] >= 0)
            normal = torch.zeros_like(self.normal[:, :1])
            normal[:, :, axis] = up
            normals.append(normal)
            owners.append(torch.where(has, -2, -1)[:, None])
            kinds.append(torch.full_like(self.kind[:, :1], KINDS["separate" if face.kind == "separate" else "slip"]))
        more = len(normals) - 1
        empty = torch.zeros_like(self.normal[:, :1]).expand(-1, more, -1)
        return Constraints(
            torch.cat(owners, 1),
            torch.cat(kinds, 1),
            torch.cat([self.friction, empty[:, :, 0]], 1),
            torch.cat(normals, 1),
            torch.cat([self.velocity, empty], 1),
        )

    def changes(self, v: Tensor) -> Tensor:
        """Changes of velocities v [n, D] by each surface [n, C, D] [m/s]. Differentiable, twice."""
        is_there = self.owner != -1
        sticky = is_there & (self.kind == KINDS["sticky"]) & (self.owner >= 0)
        first = sticky & (sticky.cumsum(1) == 1)
        stopped = torch.where(first[:, :, None], self.velocity - v[:, None], 0)
        alone = is_there.sum(1) == 1
        result = torch.where(alone[:, None, None], self._of_one(v), 0)
        if self.owner.shape[1] > 1 and (not reads_values(v) or bool((~alone & is_there[:, 0]).any())):
            result = torch.where(alone[:, None, None], result, self._of_several(v, is_there))
        result = torch.where(sticky.any(1)[:, None, None], stopped, result)
        return torch.where(is_there[:, :, None], result, 0)

    def _of_one(self, v: Tensor) -> Tensor:
        """By the first surface alone."""
        normal, friction = self.normal[:, 0], self.friction[:, :1]
        relative = v - self.velocity[:, 0]
        change = torch.zeros_like(v)
        for kind in ("slip", "separate"):
            own = (self.kind[:, :1] == KINDS[kind]) & (self.owner[:, :1] >= 0)
            change = torch.where(own, contact_change(torch.where(own, relative, 0), normal, kind, friction), change)
        return torch.cat([change[:, None], torch.zeros_like(self.velocity[:, 1:])], 1)

    def _of_several(self, v: Tensor, is_there: Tensor) -> Tensor:
        with torch.no_grad():
            chosen = self._pressing(v, is_there)
        missing = (self.normal * (self.velocity - v[:, None])).sum(2)
        stopped = _solve(self._gram(chosen), torch.where(chosen, missing, 0))
        change = stopped[:, :, None] * self.normal
        return change + self._friction(v + change.sum(1), stopped, chosen)

    def _gram(self, chosen: Tensor) -> Tensor:
        """Products of the normals of some surfaces, bool [n, C]; the identity for others [n, C, C]."""
        both = chosen[:, :, None] & chosen[:, None]
        eye = torch.eye(chosen.shape[1], dtype=self.normal.dtype, device=self.normal.device)
        return torch.where(both, self.normal @ self.normal.mT, eye)

    def _pressing(self, v: Tensor, is_there: Tensor) -> Tensor:
        """The surfaces that are met exactly, bool [n, C]: of all sets that with the least violation."""
        count, dim = self.owner.shape[1], v.shape[1]
        missing = (self.normal * (self.velocity - v[:, None])).sum(2)
        one_sided = self.kind == KINDS["separate"]
        best, chosen = torch.full_like(v[:, 0], torch.inf), torch.zeros_like(is_there)
        unmet = torch.finfo(v.dtype).tiny
        for bits in range(1 << count):
            members = [i for i in range(count) if bits >> i & 1]
            if len(members) > dim:
                continue
            own = torch.stack([torch.full_like(is_there[:, i], i in members) for i in range(count)], 1)
            possible = (is_there | ~own).all(1)
            gram = self._gram(own & is_there)
            possible = possible & independent(gram)
            gram = torch.where(possible[:, None, None], gram, torch.eye(count, dtype=gram.dtype, device=gram.device))
            stopped = _solve(gram, torch.where(own & possible[:, None], missing, 0))
            after = missing - ((stopped[:, :, None] * self.normal).sum(1)[:, None] * self.normal).sum(2)
            lacking = torch.where(one_sided, after, after.abs() + unmet)
            violation = torch.where(own, torch.where(one_sided, -stopped, 0), lacking)
            violation = torch.where(is_there, violation, 0).amax(1).clamp_min(0)
            better = possible & (violation < best)
            best = torch.where(better, violation, best)
            chosen = torch.where(better[:, None], own & is_there, chosen)
        return chosen

    def _friction(self, v: Tensor, stopped: Tensor, chosen: Tensor) -> Tensor:
        """Change by friction along the surfaces of a set, of velocities v [n, D], in parts by surface [n, C, D]."""
        presses = chosen & (stopped > 0)
        limit = torch.where(presses, self.friction * stopped, 0)
        total = limit.sum(1, keepdim=True)
        share = torch.where(total > 0, limit / torch.where(total > 0, total, 1), 0)
        last = presses & (presses.flip(1).cumsum(1).flip(1) == 1)
        share = torch.where(total > 0, share, last.to(share.dtype))
        u = v - (share[:, :, None] * self.velocity).sum(1)
        along = _solve(self._gram(chosen), torch.where(chosen, (self.normal * u[:, None]).sum(2), 0))
        tangential = u - (along[:, :, None] * self.normal).sum(1)
        speed = norm(tangential)[:, None]
        slides = (speed > total) & (speed > 0)
        kept = torch.where(slides, limit / torch.where(slides, speed, 1), torch.where(total > 0, share, 0))
        return -kept[:, :, None] * tangential[:, None]


def reads_values(x: Tensor) -> bool:
    """Whether contact leaves out nodes and faces by their values: on the CPU, where reading them is free."""
    return x.device.type == "cpu" and not torch.compiler.is_compiling()


def independent(gram: Tensor) -> Tensor:
    """Where Gram matrices [n, C, C] are not nearly singular, bool [n]."""
    g, least = gram, gram[:, 0, 0]
    for k in range(gram.shape[1] - 1):
        pivot = g[:, k, k]
        g = g - g[:, :, k, None] * g[:, None, k, :] / torch.where(pivot > 1e-3, pivot, 1)[:, None, None]
        least = torch.minimum(least, g[:, k + 1, k + 1])
    return least > 1e-3


def _solve(gram: Tensor, rest: Tensor) -> Tensor:
    """x [n, C] with gram x = rest, by elimination, for few unknowns; differentiable."""
    count = gram.shape[1]
    rows = [gram[:, i] for i in range(count)]
    values = list(rest.unbind(1))
    for k in range(count):
        for i in range(k + 1, count):
            factor = rows[i][:, k] / rows[k][:, k]
            rows[i] = rows[i] - factor[:, None] * rows[k]
            values[i] = values[i] - factor * values[k]
    for k in reversed(range(count)):
        for j in range(k + 1, count):
            values[k] = values[k] - rows[k][:, j] * values[j]
        values[k] = values[k] / rows[k][:, k]
    return torch.stack(values, 1)
