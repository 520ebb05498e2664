"""Backward Euler on the node velocities as the integrator of a `Step`."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ..cuda_graphs.capture import is_captured, is_traced, outside_transforms, without_transforms
from ..errors import check_count, check_number
from ..laws.material import Material
from ..laws.mixture import Mixture
from ..ops import grid_update
from ..step.failures import Problem, unsolved_steps
from .adjoint import differentiable
from .bounds import node_bounds
from .explicit_materials import checked_materials, solved_materials, solved_nodes
from .impulses import boundary_impulses
from .mirrors import mirrors_of
from .newton import Minimum, Options, minimise
from .system import ImplicitSystem

if TYPE_CHECKING:
    from ..grid.grid import Blocks
    from ..state.state import State
    from ..step.step import Step


class ImplicitReport(NamedTuple):
    """Report of the latest solve; tensors [B] on the device of the particles."""

    converged: Tensor
    """bool: whether the residual reached its tolerance, or rounding, and the error a tenth of the motion, measured by
    the predicted energy decrease of Newton's method.
    """
    residual: Tensor
    """√(g · B⁻¹ g / Σ m) [m/s] of the final gradient g of the energy, with the node blocks B; float64."""
    iterations: Tensor
    """Iterations of Newton's method, int32."""
    cg_iterations: Tensor
    """Iterations of conjugate gradients and GMRES, in total, int32."""


PLASTICITY = ("after", "inside")


class Implicit:
    """Backward Euler: `Step(integrator=Implicit(...))`, or `integrator="implicit"` for the defaults.

    The node velocities minimise ½ Σ m |v − v*|² + Σ V ψ((I + dt L(v)) F) (Martin et al. 2011; Gast et al. 2015), scene
    by scene, by Newton's method with line search and conjugate gradients preconditioned by the blocks of the nodes. Any
    dt is stable, except with explicit materials. Walls and obstacles bound the velocities of their nodes in the solve,
    and exert friction. Laws with an elastic energy are supported; plastic flow follows the solve, at the start of the
    next step, or is a part of it.

    Args:
        tolerance: tolerance of the residual relative to that of v*, the velocities without elastic forces, in (0, 1).
        max_iterations: maximum number of Newton iterations in a step.
        max_cg_iterations: maximum number of conjugate gradient iterations in each of these.
        adjoint_tolerance: relative tolerance of the one linear solve of a backward pass; at least 1e-5 in float32.
        plasticity: "after": the solve uses the elastic stress of the trial deformation, and the flow follows. "inside":
            it uses the stress after the flow, so that the stress on the motion does not exceed the strength of the
            material.
        explicit: materials, numbers of laws of the step's `Mixture`, excluded from the solve: their stress at the start
            of the step acts on the nodes, as in an explicit step, which limits dt (`Step.stable_dt`). For soft
            materials beside stiff ones, such as a fluid beside rubber.

    Attributes:
        explicit: these materials, in order.
        report: `ImplicitReport` of the latest step, None before the first.
        adjoint_converged: bool [B], whether all solves of backward passes since the latest step converged; None before
            the first. Gradients of a scene are NaN where its solve did not converge.

    A step stores a copy, so that several steps may share one `Implicit`: the reports are those of `step.integrator`.

    Raises:
        TypeError, ValueError: for a wrong argument.
    """

    def __init__(
        self,
        tolerance: float = 1e-4,
        max_iterations: int = 30,
        max_cg_iterations: int = 1000,
        adjoint_tolerance: float = 1e-8,
        plasticity: str = "after",
        explicit: Sequence[int] = (),
    ) -> None:
        for name, value in (("tolerance", tolerance), ("adjoint_tolerance", adjoint_tolerance)):
            check_number(name, value, "between 0 and 1", lambda v: 0 < v < 1)
        check_count("max_iterations", max_iterations, 1)
        check_count("max_cg_iterations", max_cg_iterations, 1)
        if plasticity not in PLASTICITY:
            raise ValueError(f"plasticity must be one of {sorted(PLASTICITY)}, got {plasticity!r}")
        self.plasticity = plasticity
        self.explicit = checked_materials(explicit)
        self.options = Options(float(tolerance), int(max_iterations), int(max_cg_iterations))
        self.adjoint_tolerance = float(adjoint_tolerance)
        self.report: ImplicitReport | None = None
        self.adjoint_converged: Tensor | None = None
        self._adjoint_begins = True
        self._unsolved: Tensor | None = None
        self._residual: Tensor | None = None

    def velocities(
        self, step: Step, blocks: Blocks, state: Any, nodes: Tensor, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Node velocities at the end of a step [N, D] [m/s], and the impulses on boundaries and walls where the state
        counts them.

        Args:
            step: the step with law, gravity, walls and boundaries.
            blocks: the active blocks.
            state: the particles after the return map.
            nodes: mass and momentum before gravity [N, 1 + D] [kg, kg m/s], with the impulse of `explicit_stress`.
            dt: [s], a number or a tensor [], [1] or [B].

        Differentiable by everything that the state, the law, gravity, the obstacles and the nodes depend on, by one
        linear solve.
        """
        gravity = step.gravity_like(state.x)
        walls = None if step.walls is None else step.walls.mirrors()
        start = grid_update(blocks, nodes, gravity, dt, walls)
        if not blocks.grid.scenes:
            return start, state.impulse
        before = None if gravity is None else grid_update(blocks, nodes.detach(), walls=walls)
        form, flows = step.stress_form, self.plasticity == "inside"
        law, particles = self.solved(step.law, state)
        if not self.explicit:
            mirrors = mirrors_of(blocks, walls, nodes[:, 0].detach())
            system = ImplicitSystem(blocks, law, state, nodes[:, 0], start, dt, form, flows, before, mirrors)
            return self._solution(step, system, counts=state.impulse is not None)
        part, mass = solved_nodes(blocks, particles), nodes[:, 0]
        images = mirrors_of(blocks, walls, mass.detach())
        if images is not None:
            mass = images.gathered(mass, part.chosen)
        mass, start = part.taken(mass), part.taken(start)
        before = None if before is None else part.taken(before)
        mirrors = mirrors_of(part.blocks, walls, mass.detach())
        system = ImplicitSystem(part.blocks, law, particles, mass, start, dt, form, flows, before, mirrors)
        velocity = part.placed(self._solution(step, system)[0], step.update_grid(blocks, nodes, state, dt)[0])
        return velocity if images is None else images.followed(velocity, part.chosen), None

    def _solution(self, step: Step, system: ImplicitSystem, counts: bool = False) -> tuple[Tensor, Tensor | None]:
        """Minimum of a system within the bounds of the walls and boundaries of a step, and the impulses on them if
        these are counted; differentiable.
        """
        wants_gradient, boundaries = torch.is_grad_enabled(), step.boundaries.entries
        bounds = node_bounds(system.blocks, step.walls, boundaries, system.start, system.state.time, counts)
        with torch.no_grad():
            fixed = system.detached() if wants_gradient else system
            minimum = minimise(fixed, bounds, self.options)
            fixed.forget()
        self._store(minimum)
        v = differentiable(self, system, fixed, bounds, minimum) if wants_gradient else minimum.v
        if not counts:
            return v, None
        return v, boundary_impulses(system, bounds, v, len(boundaries) + 2 * step.grid.dim)

    def solved(self, law: Material, state: Any) -> tuple[Material, Any]:
        """Law and particles of the solve: those of a step without its explicit materials."""
        if not self.explicit:
            return law, state
        assert isinstance(law, Mixture)
        return law.only(state, solved_materials(law, self.explicit))

    def unsolved(self, law: Material, state: Any) -> tuple[Material, Any]:
        """Law of the explicit materials and their particles."""
        assert isinstance(law, Mixture)
        return law.only(state, self.explicit)

    def explicit_stress(self, law: Material, state: Any, stress: Tensor) -> Tensor | None:
        """Stress of all particles [P, D, D] [Pa], zero for those of the solve; None without explicit materials."""
        if not self.explicit:
            return None
        assert isinstance(law, Mixture)
        return stress.index_fill(0, law.particles_of(state, solved_materials(law, self.explicit)), 0)

    def store_adjoint(self, converged: Tensor) -> None:
        """Store the convergence of one solve of a backward pass, bool [B]."""
        kept = None if self._adjoint_begins else self.adjoint_converged
        self.adjoint_converged = converged if kept is None else kept & converged
        self._adjoint_begins = False

    def _store(self, minimum: Minimum) -> None:
        if torch._C._current_graph_task_id() == -1:  # Not recomputed in a backward pass.
            self._adjoint_begins = True
        self.report = ImplicitReport(minimum.converged, minimum.residual, minimum.iterations, minimum.cg_iterations)
        with outside_transforms(), torch.inference_mode(False):
            missed = without_transforms(~minimum.converged).to(torch.int32)
            residual = without_transforms(minimum.residual)
            kept = self._unsolved
            same = kept is not None and kept.device == missed.device and kept.shape == missed.shape
            self._unsolved = kept + missed if same and kept is not None else missed
            largest = self._residual if same and self._residual is not None else torch.zeros_like(residual)
            self._residual = torch.where(missed > 0, torch.maximum(largest, residual), largest)

    def problems(self) -> dict[str, Problem]:
        """Scenes whose steps missed their tolerance, for `Step.check`."""
        if self._unsolved is None or self._residual is None:
            return {}
        return unsolved_steps(self._unsolved, self._residual)

    def fresh(self) -> Implicit:
        """Copy without the status of its steps."""
        result = copy.copy(self)
        result.options = dataclasses.replace(self.options)
        result.reset()
        return result

    def reset(self) -> None:
        """Discard the status of the steps so far."""
        self.report = self._unsolved = self._residual = self.adjoint_converged = None

    def forget(self, scenes: Tensor) -> None:
        """Discard the status of scenes, bool [B]."""
        for kept in (self._unsolved, self._residual):
            if kept is not None:
                kept.masked_fill_(scenes, 0)


def check_implicit(step: Step, state: State) -> None:
    """Raise for features that implicit steps do not support.

    Raises:
        NotImplementedError: for impulses counted beside mirrors or explicit materials, and for compiled, captured or
            transformed steps.
    """
    if is_traced(state.x) or is_captured(state.x) or torch._C._are_functorch_transforms_active():
        raise NotImplementedError(
            "an implicit step waits for the results of its solve: it cannot be compiled, captured in a CUDA graph, or "
            "transformed by torch.func; its gradients are those of backward() and torch.autograd.grad"
        )
    if state.impulse is None:
        return
    mirrors = step.walls is not None and step.walls.mirrors() is not None
    if mirrors or (step.integrator is not None and step.integrator.explicit):
        raise NotImplementedError(
            f"an implicit step does not count impulses beside {'mirrors' if mirrors else 'explicit materials'} yet"
        )


def check_explicit_materials(integrator: Implicit | None, law: Material) -> None:
    """Check that the explicit materials of an integrator are laws of a mixture, and not all of them.

    Raises:
        ValueError: as `solved_materials`.
    """
    if integrator is not None and integrator.explicit:
        solved_materials(law, integrator.explicit)


INTEGRATORS = ("explicit", "implicit")


def as_integrator(value: Any) -> Implicit | None:
    """Integrator of a step, a copy without the status of its steps; None for the explicit one.

    Raises:
        TypeError, ValueError: for an invalid integrator.
    """
    if isinstance(value, Implicit):
        return value.fresh()
    if not isinstance(value, str):
        raise TypeError(f"integrator must be 'explicit', 'implicit' or an Implicit, got {type(value).__name__}")
    if value not in INTEGRATORS:
        raise ValueError(f"integrator must be one of {sorted(INTEGRATORS)} or an Implicit, got {value!r}")
    return Implicit() if value == "implicit" else None
