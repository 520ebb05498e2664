"""Shapes that are known by their distance alone: a function, or samples of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from ...errors import check_number, check_vector, shape_of
from ...ops.autograd import graph_at_once
from ..vectors import norm, unit
from .base import Shape


class SDF(Shape):
    """Shape given by its signed distance.

    Args:
        distance: function of points [N, D] [m] that returns distances [N] [m], negative inside. Torch operations; it
            need not be exact away from its zero level.
        normal: function of the same points that returns outward normals [N, D]; None for the gradient of `distance` by
            automatic differentiation. Of any length.
    """

    name = "sdf"

    def __init__(self, distance: Callable[[Tensor], Tensor], normal: Callable[[Tensor], Tensor] | None = None) -> None:
        for name, function in (("distance", distance), ("normal", normal)):
            if not callable(function) and (name == "distance" or function is not None):
                raise TypeError(f"{name} must be a function of positions [N, D], got {shape_of(function)}")
        self.distance, self.normal = distance, normal

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if self.normal is not None:
            distance, normal = self.distance(x), self.normal(x)
        else:
            distance, normal = with_gradient(self.distance, x)
        self._check(distance, normal, x)
        return distance, unit(normal)

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        distance = self.distance(x)
        self._check(distance, x, x)
        return distance

    @staticmethod
    def _check(distance: Tensor, normal: Tensor, x: Tensor) -> None:
        if distance.shape != x.shape[:1] or normal.shape != x.shape:
            raise ValueError(
                f"distance and normal of an SDF must have shape [N] and [N, D] = {list(x.shape)}, "
                f"got {shape_of(distance)} and {shape_of(normal)}"
            )


def _checked_samples(name: str, values: Any) -> Tensor:
    """Samples that are given or assigned."""
    if not isinstance(values, Tensor) or values.dim() not in (2, 3) or min(values.shape) < 2:
        raise ValueError(f"{name} must be a tensor [X, Y] or [X, Y, Z] of 2 or more each, got {shape_of(values)}")
    if values.requires_grad:
        raise ValueError(f"{name} must not require grad: which nodes are inside is not differentiable")
    return values


class Sampled(Shape):
    """Shape given by its signed distance at the nodes of a lattice, multilinear between them.

    Its obstacles act in the kernel, while those of `SDF` and `Mesh` act by torch operations; `Sampled.of` converts
    them. The error of a curved surface is about spacing²/(8 radius), and edges are rounded.

    Args:
        values: signed distances [m], negative inside, positive on the border: [X, Y] or [X, Y, Z], at least 2 of each.
            Values that are steeper than distances are divided by their largest slope between nodes of a cell, which
            preserves their zero level.
        lower: the first node in the coordinates of the shape [m], D numbers.
        spacing: distance of the nodes [m].

    Raises:
        TypeError, ValueError: for values of another type or shape, not finite, or not positive on the border.
    """

    name = "sampled"
    arguments = ("values", "lower", "spacing")
    number = 5
    CHECKS: ClassVar = {"values": _checked_samples}
    _thinnest: float | None

    def __init__(self, values: Tensor, lower: Sequence[float], spacing: float) -> None:
        _checked_samples("values", values)
        self.lower = check_vector("lower", lower, values.dim())
        self.spacing = float(check_number("spacing", spacing, "positive", lambda v: 0 < v < math.inf))
        values = values.to("cpu", torch.float64)
        if not bool(values.isfinite().all()):
            raise ValueError("values must be finite")
        if any(bool((values.select(axis, end) <= 0).any()) for axis in range(values.dim()) for end in (0, -1)):
            raise ValueError("values must be positive on the border of the lattice: enlarge it")
        self.values = values / max(1.0, _steepest(values) / self.spacing)

    @classmethod
    def of(cls, shape: Shape, lower: Sequence[float], upper: Sequence[float], spacing: float) -> Sampled:
        """Sample a shape between two corners [m] of a box around it."""
        first, last = check_vector("lower", lower), check_vector("upper", upper, len(lower))
        counts = [max(2, math.ceil((b - a) / spacing - 1e-9) + 1) for a, b in zip(first, last, strict=True)]
        axes = [a + spacing * torch.arange(n, dtype=torch.float64) for a, n in zip(first, counts, strict=True)]
        nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        return cls(shape.signed_distance(nodes.reshape(-1, len(counts))).reshape(counts), first, spacing)

    @classmethod
    def from_row(cls, vector: Tensor, radius: Tensor, data: Tensor) -> Sampled:
        shape, dim = cls.__new__(cls), vector.shape[-1]
        shape.lower, shape.spacing = tuple(data[:dim].tolist()), float(data[dim])
        shape.values = data[2 * dim + 1 :].reshape([int(n) for n in data[dim + 1 : 2 * dim + 1]])
        return shape

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("values", "spacing"):
            self._thinnest = None
        super().__setattr__(name, value)

    def thinnest_wall(self) -> float:
        """Thickness [m] by the samples in the middle of walls, which are no less deep than their neighbours; of walls
        of constant thickness. A wall between samples may be thinner by a spacing. The spacing where no sample is
        inside. It is computed once for assigned values."""
        if self._thinnest is None:
            self._thinnest = self._thinnest_of_samples()
        return self._thinnest

    def _thinnest_of_samples(self) -> float:
        depth, pool = -self.values, torch.nn.functional.max_pool2d
        if depth.dim() == 3:
            pool = torch.nn.functional.max_pool3d
        deepest = pool(depth[None, None], 3, 1, 1)[0, 0]
        middle = depth[(depth > 0) & (depth >= deepest - 1e-6 * self.spacing)]
        return self.spacing + (2 * float(middle.min()) if len(middle) else 0.0)

    def data_count(self) -> int:
        return 2 * self.values.dim() + 1 + self.values.numel()

    def data(self, like: Tensor) -> Tensor:
        """Lower corner, spacing, numbers of nodes and values."""
        numbers = [*self.lower, self.spacing, *self.values.shape]
        return torch.cat([self.values.new_tensor(numbers), self.values.reshape(-1)]).to(like)

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        values, counts = self.values.to(x), self.values.shape
        along = (x - x.new_tensor(self.lower)) / self.spacing
        last = x.new_tensor([n - 1 for n in counts])
        inside = torch.minimum(along.clamp_min(0), last)
        cell = torch.minimum(inside.detach().nan_to_num().floor(), last - 1).long()
        weight = inside - cell
        distance, gradient = torch.zeros_like(x[:, 0]), [torch.zeros_like(x[:, 0]) for _ in counts]
        for corner in itertools.product((0, 1), repeat=len(counts)):
            value = values[tuple((cell + torch.tensor(corner, device=x.device)).unbind(1))]
            parts = [weight[:, i] if upper else 1 - weight[:, i] for i, upper in enumerate(corner)]
            distance = distance + math.prod(parts[1:], start=parts[0]) * value
            for i, upper in enumerate(corner):
                rest = math.prod(parts[:i] + parts[i + 1 :], start=torch.ones_like(value))
                gradient[i] = gradient[i] + (value if upper else -value) * rest
        beyond = (along - inside) * self.spacing
        far, away = (beyond != 0).any(1), norm(torch.cat([distance[:, None], beyond], 1))
        return torch.where(far, away, distance), unit(torch.stack(gradient, 1))

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        lower = torch.tensor(self.lower, dtype=torch.float64, device="cpu")
        return lower, lower + self.spacing * (torch.tensor(self.values.shape, dtype=torch.float64, device="cpu") - 1)


def _steepest(values: Tensor) -> float:
    """Largest slope between two nodes of one cell of a lattice of unit spacing; at most 1 where values are distances.

    The interpolant of these values has at most this slope along each axis, on which the kernel relies (csrc/grid/
    solid.h).
    """
    most = 0.0
    for step in itertools.product((-1, 0, 1), repeat=values.dim()):
        if step > (0,) * values.dim():  # One of each pair of opposite steps.
            starts = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, values.shape, strict=True))
            ends = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, values.shape, strict=True))
            most = max(most, float((values[ends] - values[starts]).abs().max()) / math.hypot(*step))
    return most


def with_gradient(function: Callable[[Tensor], Tensor], points: Tensor) -> tuple[Tensor, Tensor]:
    """Values [N] of a function of points [N, D], each depending on its own point, and their gradients;
    differentiable.
    """
    if torch.compiler.is_compiling() or torch._C._autograd._top_saved_tensors_default_hooks(False) is None:
        values, pull_back, *_ = torch.func.vjp(function, points)
        return values, pull_back(torch.ones_like(values))[0]
    # torch.func refuses the hooks of checkpointing, which would recompute its steps for a gradient taken in them.
    differentiable = torch.is_grad_enabled()
    with torch.enable_grad(), graph_at_once():
        leaf = points.view_as(points)
        leaf = leaf if leaf.requires_grad else leaf.requires_grad_()
        values = function(leaf)
        (gradient,) = torch.autograd.grad(values, leaf, torch.ones_like(values), create_graph=differentiable)
    return values, gradient
