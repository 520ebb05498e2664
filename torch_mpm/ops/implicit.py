"""Hessian of an implicit step on the nodes: its product, its diagonal blocks, and the solve.

    H = diag(m) + Σ_p (∇N)ᵀ T_p ∇N,

with T_p the tangent of a particle (`law_tangent`) and velocity gradients L_p = D⁻¹ Σ N_i v_i (x_i − x_p)ᵀ for the
stress form "mls", or Σ v_i ∇N_iᵀ for "gradient". None of these ops has derivatives: `torch_mpm.implicit` differentiates
the solution of a step by one more solve.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..errors import check_count, check_like, check_particles, shape_of
from ..grid.grid import Blocks, check_blocks
from ..grid.topology import Topology
from .arguments import check_choice, refuse_vmap, sizes
from .autograd import dispatch, register_autograd
from .transfer import STRESS_FORMS

SOLVING, CONVERGED, NEGATIVE_CURVATURE, NOT_FINITE = 0, 1, 2, 3
"""States of a solve (csrc/implicit/arguments.h)."""


def tangent_entries(dim: int) -> int:
    """Entries of the tangent of a particle (csrc/laws/tangent.h): two frames, the block of the principal stretches, and
    two moduli of each shear."""
    return 2 * dim * dim + dim * (dim + 1) // 2 + dim * (dim - 1)


def implicit_apply(
    blocks: Blocks,
    x: Tensor,
    direction: Tensor,
    tangent: Tensor,
    mass: Tensor | None = None,
    stress_form: str = "mls",
) -> Tensor:
    """Product of the Hessian of an implicit step with node velocities, by a gather, the tangents and a scatter.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        direction: [N, D] [m/s].
        tangent: tangents of the particles, `law_tangent` with the weights dt² V [P, n] [kg m²/m² per unit strain rate].
        mass: mass of the nodes [N] [kg]; None for the product of the tangents alone.
        stress_form: "mls" or "gradient".

    Returns:
        [N, D] [kg m/s].

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    Not differentiable.
    """
    _check(blocks, x, tangent, stress_form)
    check_like("direction", direction, x, (blocks.node_count, blocks.grid.dim), "[N, D]")
    check_like("mass", mass, x, (blocks.node_count,), "[N]")
    product = dispatch(
        torch.ops.torch_mpm.implicit_apply,
        *(x, direction.contiguous(), tangent, STRESS_FORMS[stress_form], *blocks.packed),
    )
    return product if mass is None else product.addcmul_(mass[:, None], direction)


def implicit_node_blocks(blocks: Blocks, x: Tensor, tangent: Tensor, stress_form: str = "mls") -> Tensor:
    """The diagonal blocks of Σ_p (∇N)ᵀ T_p ∇N, without the masses [N, D, D] [kg]; arguments as `implicit_apply`.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    Not differentiable.
    """
    _check(blocks, x, tangent, stress_form)
    upper = dispatch(torch.ops.torch_mpm.implicit_node_blocks, x, tangent, STRESS_FORMS[stress_form], *blocks.packed)
    return from_upper(upper, blocks.grid.dim)


class ImplicitSolve(NamedTuple):
    """Result of `implicit_cg`."""

    solution: Tensor
    """[N, D] [m/s]."""
    iterations: Tensor
    """int32 [B]."""
    residual: Tensor
    """√(r · B⁻¹ r) over that of the right side, float64 [B]."""
    state: Tensor
    """int32 [B]: SOLVING (out of iterations), CONVERGED, NEGATIVE_CURVATURE or NOT_FINITE."""


def implicit_cg(
    blocks: Blocks,
    x: Tensor,
    rhs: Tensor,
    mass: Tensor,
    inverse: Tensor,
    tangent: Tensor,
    relative: Tensor,
    max_iterations: int,
    stress_form: str = "mls",
    local: Tensor | None = None,
    images: Tensor | None = None,
    held: Tensor | None = None,
) -> ImplicitSolve:
    """Solve H d = rhs by conjugate gradients, preconditioned by node blocks, for each scene separately.

    On CUDA the device repeats a graph of one iteration until all scenes are done (built with CUDA 12 the host checks
    once in eight iterations), so that the op cannot be captured in a graph.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        rhs: [N, D] [kg m/s].
        mass: mass of the nodes [N] [kg].
        inverse: B⁻¹ of each node [N, D, D] [1/kg], symmetric and positive semi-definite. The solution stays in its
            range: zero for a held node, and a projected block for a sliding one.
        tangent: as in `implicit_apply`.
        relative: a scene is done when √(r · B⁻¹ r) is this share of its initial value, [B].
        max_iterations: maximum number of iterations of each scene.
        stress_form: "mls" or "gradient".
        local: additional diagonal block of H of each node [N, D, D] [kg], symmetric; None for none.
        images: rows of nodes that mirrors identify, int32 [G, 2^D]: entry k of a group is the node that the axes of the
            bits of k reflect, -1 for none. A node is in at most one group. H is then the Hessian of symmetric
            velocities, and rhs and `inverse` must be symmetric, too. None without mirrors.
        held: direction in which each node is held, unit vectors [N, D], zero for none; symmetric as rhs where there are
            images. Along it rhs and the range of `inverse` are zero to rounding, and the reaction is excluded from the
            residual. None where nodes are held along axes only, in which `inverse` is exactly zero.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    Not differentiable.
    """
    _check(blocks, x, tangent, stress_form)
    N, D, B = blocks.node_count, blocks.grid.dim, blocks.grid.scenes
    check_like("rhs", rhs, x, (N, D), "[N, D]")
    check_like("mass", mass, x, (N,), "[N]")
    check_like("inverse", inverse, x, (N, D, D), "[N, D, D]")
    check_like("relative", relative, x, (B,), "[B]")
    check_like("local", local, x, (N, D, D), "[N, D, D]")
    check_like("held", held, x, (N, D), "[N, D]")
    check_count("max_iterations", max_iterations)
    if images is not None:
        if not isinstance(images, Tensor) or images.dim() != 2 or images.shape[1] != 2**D:
            raise ValueError(f"images must have shape [G, 2^D] = [G, {2**D}], got {shape_of(images)}")
        if images.dtype != torch.int32:
            raise TypeError(f"images must be int32, got {images.dtype}")
        images = images.contiguous()
    solution, scalars = dispatch(
        torch.ops.torch_mpm.implicit_cg,
        *(x, rhs.contiguous(), mass.contiguous(), to_upper(inverse)),
        *(None if local is None else to_upper(local), None if held is None else held.contiguous(), images),
        *(tangent, relative.contiguous(), max_iterations, STRESS_FORMS[stress_form], *blocks.packed),
    )
    integers = scalars.view(torch.int32)
    first, square = scalars[:, 0], scalars[:, 1]
    residual = torch.where(first > 0, (square / torch.where(first > 0, first, 1)).sqrt(), 0)
    return ImplicitSolve(solution, integers[:, 8], residual, integers[:, 9])


def to_upper(matrices: Tensor) -> Tensor:
    """Upper triangles [N, D (D + 1)/2] of symmetric matrices [N, D, D]."""
    i, j = _triangle(matrices.shape[-1])
    return torch.stack([matrices[:, a, b] for a, b in zip(i, j, strict=True)], 1)


def from_upper(upper: Tensor, dim: int) -> Tensor:
    """Inverse of `to_upper`."""
    i, j = _triangle(dim)
    place = {(a, b): k for k, (a, b) in enumerate(zip(i, j, strict=True))}
    entries = [upper[:, place[min(a, b), max(a, b)]] for a in range(dim) for b in range(dim)]
    return torch.stack(entries, 1).unflatten(1, (dim, dim))


def add_deviator(tangent: Tensor, dim: int, modulus: Tensor) -> None:
    """Add modulus [P] times dev sym L to tangents [P, n] whose frames are the identity, in place."""
    first = 2 * dim * dim
    for k, (i, j) in enumerate(zip(*_triangle(dim), strict=True)):
        tangent[:, first + k] += modulus * ((1.0 if i == j else 0.0) - 1.0 / dim)
    shears = first + dim * (dim + 1) // 2
    tangent[:, shears : shears + dim * (dim - 1) // 2] += modulus[:, None]


def _triangle(dim: int) -> tuple[list[int], list[int]]:
    pairs = [(a, b) for a in range(dim) for b in range(a, dim)]
    return [a for a, _ in pairs], [b for _, b in pairs]


def _check(blocks: Blocks, x: Tensor, tangent: Tensor, stress_form: str) -> None:
    check_blocks(blocks)
    check_particles(x, blocks)
    check_choice("stress_form", stress_form, STRESS_FORMS)
    if not isinstance(tangent, Tensor):
        raise TypeError(f"tangent must be a tensor, got {shape_of(tangent)}")
    check_like("tangent", tangent, x, (x.shape[0], tangent_entries(x.shape[1])), "[P, n]")


# ---- fake kernels and autograd


@torch.library.register_fake("torch_mpm::implicit_apply")
def _apply_fake(x, direction, tangent, stress_form, *topology):
    return x.new_empty(Topology.unpack(*topology).node_count, sizes(x, "x", 2)[1])


@torch.library.register_fake("torch_mpm::implicit_node_blocks")
def _node_blocks_fake(x, tangent, stress_form, *topology):
    D = sizes(x, "x", 2)[1]
    return x.new_empty(Topology.unpack(*topology).node_count, D * (D + 1) // 2)


@torch.library.register_fake("torch_mpm::implicit_cg")
def _cg_fake(x, rhs, mass, inverse, local, held, images, tangent, relative, max_iterations, stress_form, *topology):
    blocks = Topology.unpack(*topology)
    solution = x.new_empty(blocks.node_count, sizes(x, "x", 2)[1])
    return solution, x.new_empty(blocks.scenes, 5, dtype=torch.float64)


def _no_backward(ctx: Any, *grads: Any) -> Any:
    raise NotImplementedError(
        "the ops of the implicit solve have no derivatives: a Step with integrator='implicit' has them"
    )


for _name in ("implicit_apply", "implicit_node_blocks", "implicit_cg"):
    register_autograd(_name, _no_backward)
    refuse_vmap(_name)
