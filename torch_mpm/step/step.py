"""One MPM step."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from ..boundaries import BoundaryList, Obstacle, Walls
from ..boundaries.apply import after_boundaries, project
from ..boundaries.control import control_step, motions_now
from ..boundaries.impulses import Impulses, check_impulse, impulses_of, no_impulse
from ..boundaries.thickness import warn_of_thin_walls
from ..cuda_graphs.capture import DeviceConstantCache, is_eager
from ..errors import REAL, PrecisionWarning, check_flag, check_number, is_finite, shape_of
from ..geometry.per_scene import WRITABLE
from ..geometry.values import Value, constant, filled, shape_of_value
from ..grid import resolution
from ..grid.grid import Blocks, Grid, check_grid
from ..heat.heat import Heat
from ..implicit.comparison import compare
from ..implicit.implicit import Implicit, ImplicitReport, as_integrator, check_explicit_materials, check_implicit
from ..laws import locking
from ..laws.custom import as_law
from ..laws.material import Material
from ..laws.mixture import Mixture
from ..laws.parameters import Overlay, TensorModule
from ..ops import Survey, fusible, g2p, gather, grid_update, p2g, wall_impulses
from ..ops.arguments import check_choice, soa_empty
from ..ops.contact import MAX_OBSTACLES
from ..ops.g2p_advance import g2p_advance_compensated
from ..ops.precision import from_half, full_precision
from ..ops.transfer import STRESS_FORMS
from ..state.state import State, check_state, identity_deformation
from .clocks import time_after
from .failures import Failures, problems_of_state, raise_failures
from .inputs import given_problems
from .particle_operations import ParticleOperation, operated
from .pause import paused, standing
from .stability import LawDiagnostics, chosen_dt, law_diagnostics, stability_report
from .status import ErrorStatus

TRANSFERS = ("apic", "pic", "flip")


class Boundary(Protocol):
    """A boundary, which changes the grid velocity [N, D] of nodes at positions [N, D]; see `torch_mpm.boundaries`.

    A module may have `forward` with these arguments instead.
    """

    def apply(
        self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float | Tensor, dt: float | Tensor
    ) -> Tensor: ...


class Step(TensorModule):
    """Symplectic Euler: stress, P2G, grid update, boundaries, G2P, positions and deformation gradients.

    Args:
        grid: the lattice.
        law: a material; or a function or module F [P, D, D] -> Kirchhoff stress, which becomes a `CustomLaw`.
        gravity: [m/s²]: D numbers, B lists of D numbers, an array, or a tensor [D] or [B, D] that may require grad, on
            the device of the particles, a buffer or parameter of the step; None for none.
        walls: "slip", "sticky", "separate" or "mirror" on every face of the domain, a `Walls`, or None.
        boundaries: obstacles with the interface of `torch_mpm.boundaries`, applied in order; a list that may change.
        transfer: "apic" (Jiang et al. 2015), "pic", or "flip". All keep momentum; only "apic" keeps angular momentum
            too, and "pic" damps strongly (docs/limitations.md).
        flip: share of FLIP in [0, 1] that "apic" or "pic" is blended with; 1 for transfer="flip".
        stress_form: "mls" (Hu et al. 2018; F moves with C) or "gradient" (force −V τ ∇N; F moves with Σ v_i ∇N_i).
        on_grid: called as `velocity = on_grid(blocks, velocity, mass, dt)` with node tensors [N, D] and [N] after the
            boundaries: a network, a controller, a field of force.
        on_particles: called as `state = on_particles(state, dt)` before the law and P2G: an impulse, a prescribed
            velocity, a controller (`torch_mpm.particle_operations`). It may return a pair (state, enabled) with bool
            [P]: particles that are not enabled take no part in the step and stay as they are. The time is that of the
            start of the step, and the number of particles stays.
        heat: conduction of heat in the same particles, see `Heat`; the state then needs a temperature.
        compensated: whether the rounding error of positions is stored (`State.x_residual`, compensated summation), so
            that slow motion in small steps is not lost. None decides by the lattice, the dtype and dt: positions are
            compensated if rounding may change the motion of a step by more than a thousandth, at 1 m/s or, if less, at
            one length of the domain per second. A state with a residual keeps it. A tensor dt on CUDA is read once, at
            the first such step, and later ones are assumed to be alike.
        integrator: "explicit"; or "implicit" or an `Implicit`, which solves for the node velocities with the forces at
            the end of the step (backward Euler), so that stiffness does not limit dt.

    Unused features cost nothing: boundaries, walls, gravity, FLIP, heat. The arguments are attributes, which may be
    assigned in the forms of the arguments. Forward hooks act on the step, its law and its boundaries; backward
    hooks on the law, whose output is a tensor.

    Differentiable in reverse mode, by torch.func.grad and vjp too. `torch.compile(step, fullgraph=True)` needs a grid
    with `max_blocks`; it compiles again for another number dt (a tensor avoids that), for other strides, and once a
    field that was None is a tensor.

    Raises:
        TypeError, ValueError: for a wrong argument.
    """

    grid: Grid
    law: Material
    gravity: Any  # Numbers, a tensor or None.
    walls: Walls | None
    boundaries: BoundaryList
    on_grid: Callable[[Blocks, Tensor, Tensor, float | Tensor], Tensor] | None
    heat: Heat | None
    on_particles: ParticleOperation | None
    integrator: Implicit | None
    compensated: bool | None = None
    _warned = False
    _read_dt: float | None = None

    def __init__(
        self,
        grid: Grid,
        law: Material | Callable[[Tensor], Any],
        gravity: Value | None = None,
        walls: str | Walls | None = None,
        boundaries: Sequence[Boundary] = (),
        transfer: str = "apic",
        flip: float = 0.0,
        stress_form: str = "mls",
        on_grid: Callable[[Blocks, Tensor, Tensor, float | Tensor], Tensor] | None = None,
        heat: Heat | None = None,
        on_particles: ParticleOperation | None = None,
        integrator: str | Implicit = "explicit",
        compensated: bool | None = None,
    ) -> None:
        super().__init__()
        self.grid = grid
        self.law = law  # type: ignore[assignment]
        self.gravity = gravity
        self.walls = walls  # type: ignore[assignment]
        self.boundaries = boundaries  # type: ignore[assignment]
        self.transfer = transfer
        self.flip = flip
        self.stress_form = stress_form
        self.on_grid = on_grid
        self.heat = heat
        self.on_particles = on_particles
        self.integrator = integrator  # type: ignore[assignment]
        self.compensated = compensated
        self._error_status = ErrorStatus()
        self._rests = False  # Whether the body stays at rest, see rollouts/heat_at_rest.py.
        self._kept_gravity = DeviceConstantCache()
        locking.warn(self.law, self.grid.kernel, devices=False)

    def __setattr__(self, name: str, value: Any) -> None:
        """Arguments in any form, checked and converted."""
        super().__setattr__(name, _argument(self, name, value))
        if name in ("law", "heat"):
            self._fit_law()

    def _fit_law(self) -> None:
        """Pass settings of the step to its law, and settings of the law to the step."""
        parts = list(self.law.modules())
        self._rate_dependent = any(getattr(part, "rate_dependent", False) for part in parts)
        self._let_dissipate()

    def _let_dissipate(self) -> None:
        """Let the law return what it dissipates, where a share of that becomes heat: also if the share was assigned
        after the step was made."""
        heat = getattr(self, "heat", None)
        if heat is None or not heat.plastic_heating:
            return
        for part in self.law.modules():
            if isinstance(part, Material) and not part.dissipation:
                part.dissipation = True

    def register_full_backward_hook(self, *arguments: Any, **options: Any) -> Any:
        """Raises: PyTorch's hooks would never be called for a `State`.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(
            "a backward hook of a Step would never be called, because a State is not a tensor: hook its law "
            "(step.law.register_full_backward_hook), or a tensor of the state (state.x.register_hook)"
        )

    register_full_backward_pre_hook = register_full_backward_hook

    def forward(self, state: State, dt: float | Tensor) -> State:
        """The state one step later.

        Args:
            state: see `State`; missing C, F or J start at zero, identity and one.
            dt: time step [s]: a number, or a tensor of shape [], [1] or [B]. A scene with zero in a tensor is paused:
                its particles stay as they are, bit by bit, and gradients pass through them unchanged. One that is
                negative or NaN pauses the scene too, and `check` reports it.

        Raises:
            ValueError, TypeError: for wrong shapes, dtypes or devices, or a number dt that is not positive.
            GridOverflowError: on the CPU, where a grid of fixed `max_blocks` is full.
        """
        given, state = state, self.with_residual(self.prepare(state), dt)
        if torch.compiler.is_compiling():
            return paused(self._advanced, self._error_status, state, dt, self.grid.scenes)
        with self._error_status.call(given) as ended, control_step(self, state, 1, dt) as left:
            return ended(left(paused(self._advanced, self._error_status, state, dt, self.grid.scenes)))

    def _advanced(self, state: State, dt: float | Tensor) -> State:
        """A prepared state one step later."""
        if self.on_particles is None:
            return self._moved(state, dt)
        before, as_now = state, motions_now(self, state)
        state, enabled = operated(self.on_particles, state, dt)
        state = self.prepare(state)  # a function may have made another one
        with as_now():
            if enabled is None:
                return self._moved(state, dt)
            mass, volume = torch.where(enabled, state.mass, 0), torch.where(enabled, state.volume, 0)
            return standing(before, self._moved(state.replace(mass=mass, volume=volume), dt), enabled)

    def _moved(self, state: State, dt: float | Tensor) -> State:
        """A prepared state one step later, without `on_particles`."""
        grid, law, scene = self.grid, self.law, state.scene
        law.check_parameters(len(state), grid.scenes)
        self._error_status.begin(state, grid.scenes)
        blocks = self._error_status.activate(grid, state.x, scene, state.ids)
        form, affine = self.stress_form, state.C if self.transfer == "apic" else None
        self._let_dissipate()
        fields, stress = law(Overlay(state, dt=dt) if self._rate_dependent else state)
        stress = from_half(stress, state.x)
        dissipated = fields.pop("dissipated", None)
        if law.extra_fields:
            history = {name: fields.pop(name) for name in law.extra_fields if name in fields}
            state = state.replace(extra={**state.extra, **history})
        if self.integrator is None:
            nodes = p2g(blocks, state.x, state.mass, state.v, affine, stress, state.volume, dt, form)
            velocity, impulse = self.update_grid(blocks, nodes, state, dt)
        else:
            check_implicit(self, state)
            after: Any = Overlay(state, dt=dt, **fields)
            nodes, velocity, impulse = self._implicit_velocity(blocks, after, affine, stress, dt)
        if self.on_grid is not None:
            velocity = from_half(self.on_grid(blocks, velocity, nodes[:, 0], dt), nodes)
        deformed = {name: fields.get(name, getattr(state, name)) for name in ("F", "J")}
        x, v, C, F, J, residual = g2p_advance_compensated(
            *(blocks, state.x, state.x_residual, velocity, dt),
            **deformed,
            affine=self._keeps_C or self.heat is not None,
            stress_form=form,
        )
        if self._flip_share:  # positions move with the grid velocity, so that FLIP's noise does not reach them
            v, impulse = self._blend_flip(blocks, state, affine, v, impulse)
        changes: dict[str, Any] = {**fields, "F": F, "J": J, "x_residual": residual}
        if state.impulse is not None and impulse is not None:
            changes["impulse"] = state.impulse + impulse
        if self.heat is not None:
            motion = C if form == "mls" else g2p(blocks, state.x, velocity, affine=False, gradient=True)[2]
            with full_precision(state.x):
                changes |= self.heat.update(blocks, state, dt, motion, dissipated)
        return state.replace(x=x, v=v, C=C if self._keeps_C else None, time=time_after(state.time, dt), **changes)

    @property
    def _keeps_C(self) -> bool:
        """Whether states after a step have the affine velocity C."""
        return self.transfer == "apic" or bool(self.law.viscous)

    def prepare(self, state: State) -> State:
        """A state with all fields that this step needs."""
        check_state(state)
        state.check_assigned()
        self._check_dimension(state)
        law = self.law
        changes: dict[str, Any] = {}
        if "F" in law.state_fields and state.F is None:
            changes["F"] = identity_deformation(state.x)
        if "J" in law.state_fields and state.J is None:
            changes["J"] = torch.ones_like(state.mass)
        if missing := [name for name in law.extra_fields if name not in state.extra]:
            changes["extra"] = {**state.extra, **{name: law.initial(name, state) for name in missing}}
        if state.impulse is not None:
            check_impulse(self, state)
        state = (state.replace(**changes) if changes else state).of_scenes(self.grid.scenes)
        return state if self.heat is None else self.heat.prepare(state)

    def _check_dimension(self, state: State) -> None:
        if state.x.shape[1] != self.grid.dim:
            raise ValueError(
                f"x of the state must have the dimension of the grid, [P, {self.grid.dim}], got {shape_of(state.x)}"
            )

    def with_residual(self, state: State, dt: float | Tensor) -> State:
        """A state whose positions are compensated from here on, if steps of dt [s] need it; see `compensated`.

        Warns:
            PrecisionWarning: they need it and `compensated` is False.
        """
        if self.compensated is False:
            self._check_motion(state, dt)
            return state if state.x_residual is None else state.replace(x_residual=None)
        if state.x_residual is not None or not (self.compensated or self._loses_motion(state, dt)):
            return state
        return state.replace(x_residual=soa_empty(state.x, state.x.shape).zero_())

    def _loses_motion(self, state: State, dt: float | Tensor) -> bool:
        number = self._least_dt(dt) if isinstance(dt, Tensor) else dt
        if not isinstance(number, REAL) or (isinstance(number, int) and not is_finite(number)):
            return False  # The step refuses it.
        return resolution.loses_motion(self.grid, state.x.dtype, number)

    def _least_dt(self, dt: Tensor) -> float:
        """The smallest positive entry [s]; infinite without one, or if it is unknown without its values."""
        cuda = dt.device.type == "cuda"
        if cuda and self._read_dt is not None:
            return self._read_dt
        if not dt.is_floating_point():
            return math.inf  # The step refuses it.
        if dt.is_meta or not is_eager(dt):
            return math.inf
        values = dt.detach()
        least = float(torch.where(values > 0, values, math.inf).amin()) if values.numel() else math.inf
        if cuda:  # this waited for the device
            self._read_dt = least
        return least

    def _check_motion(self, state: State, dt: float | Tensor) -> None:
        """Warn of steps whose motion is lost, once for each step."""
        if self._warned or torch.compiler.is_compiling() or not self._loses_motion(state, dt):
            return
        self._warned = True
        warnings.warn(
            f"rounding of positions in {str(state.x.dtype).removeprefix('torch.')} changes the motion in steps of "
            f"dt = {dt} s, and what is slower than half a unit in the last place of a coordinate does not move: pass "
            "Step(compensated=True) or None, or use float64",
            PrecisionWarning,
            stacklevel=4,
        )

    def update_grid(
        self, blocks: Blocks, nodes: Tensor, state: Any, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Node velocities of an explicit step [N, D] [m/s] before `on_grid`, from mass and momentum [N, 1 + D], and the
        impulses on boundaries and walls if the state counts them."""
        gravity = self.gravity_like(state.x)
        velocity = grid_update(blocks, nodes, gravity, dt, self.walls)
        impulse: Tensor | None = None
        on_boundaries: list[Tensor] = []
        if boundaries := self.boundaries.entries:
            velocity, on_boundaries = after_boundaries(
                *(blocks, velocity, nodes[:, 0], boundaries, state, dt, self.walls), impulses=state.impulse is not None
            )
        if state.impulse is not None:
            impulse = torch.cat([*on_boundaries, wall_impulses(blocks, nodes, gravity, dt, self.walls)], 1)
        return velocity, impulse

    def _implicit_velocity(
        self, blocks: Blocks, state: Any, affine: Tensor | None, stress: Tensor, dt: float | Tensor
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Mass and momentum of the nodes, their velocities with the forces at the end of the step, and impulses as in
        `update_grid`, for particles after the return map. Forces of explicit materials are those of their stress at the
        start of the step."""
        assert self.integrator is not None
        early = self.integrator.explicit_stress(self.law, state, stress)
        impulse = () if early is None else (early, state.volume, dt, self.stress_form)
        nodes = p2g(blocks, state.x, state.mass, state.v, affine, *impulse)
        return nodes, *self.integrator.velocities(self, blocks, state, nodes, dt)

    @property
    def reads_time(self) -> bool:
        """Whether a part of the step may read the time."""
        lists = [self.boundaries] if self.heat is None else [self.boundaries, self.heat.boundaries]
        return self.on_particles is not None or any(boundaries.reads_time for boundaries in lists)

    @property
    def solve_report(self) -> ImplicitReport | None:
        """Report of the latest implicit solve; None before the first one, and for explicit steps."""
        return None if self.integrator is None else self.integrator.report

    @property
    def _flip_share(self) -> float:
        return 1.0 if self.transfer == "flip" else self.flip

    def _blend_flip(
        self,
        blocks: Blocks,
        state: State,
        affine: Tensor | None,
        v: Tensor,
        impulse: Tensor | None,
    ) -> tuple[Tensor, Tensor | None]:
        """(1 − flip) v_pic + flip (v_p + v_pic − Σ N_i v_i), with v_i before the forces (Zhu and Bridson 2005).

        Mirrors affect FLIP's share only by the change of the velocities by the forces: it keeps the velocity that the
        mirrors would remove before the forces.
        """
        # P2G of the step already includes the impulse of the stress, which is part of the change.
        mirrors = None if self.walls is None else self.walls.mirrors()
        nodes = p2g(blocks, state.x, state.mass, state.v, affine)
        before, _, _ = gather(blocks, state.x, grid_update(blocks, nodes, walls=mirrors))
        if impulse is not None and mirrors is not None:
            on_faces = self._flip_share * wall_impulses(blocks, nodes, walls=mirrors)
            impulse = impulse - torch.nn.functional.pad(on_faces, (0, 0, impulse.shape[1] - on_faces.shape[1], 0))
        return torch.add(v, state.v - before, alpha=self._flip_share), impulse

    def gravity_like(self, x: Tensor) -> Tensor | None:
        """Gravity as a tensor [D] or [B, D] of the dtype and on the device of x."""
        gravity = self.gravity
        if gravity is None:
            return None
        if isinstance(gravity, WRITABLE):  # which may have been written to
            gravity = _checked_gravity(gravity, self.grid)
        if isinstance(gravity, Tensor):
            gravity = gravity.to(x.dtype)
            return gravity.squeeze(0) if len(gravity) == 1 and gravity.dim() == 2 else gravity

        def make() -> Tensor:
            return filled(gravity, x).expand(self.grid.scenes, -1).contiguous()

        return self._kept_gravity.get((gravity, self.grid.scenes, x.dtype, x.device), make, x)

    def project(self, state: State) -> tuple[State, Tensor]:
        """A state whose particles inside obstacles are moved to the nearest point of free space, and how many of each
        scene were.

        One that is deeper than 3 dx inside several obstacles may be moved to a point of free space that is not the
        nearest. Particles may be found inside after seeding, or where an obstacle appears. They are pushed out slowly,
        with stress, or not at all where they are deep; a particle that was moved keeps all else that it has. Obstacles
        are where they are at `state.time`; those on which hooks or an `apply` of their own act are left alone. Without
        gradient; nothing here synchronises with a GPU.

        Returns:
            The state, and the numbers of particles that were moved, int64 [B].
        """
        check_state(state)
        self._check_dimension(state)
        x, moved = project(self.boundaries.entries, self.walls, self.grid, state)
        scenes = self.grid.scenes
        if state.scene is None:
            return state.replace(x=x), moved.sum().expand(scenes).clone()
        count = torch.zeros(scenes, dtype=torch.int64, device=x.device)
        count.index_add_(0, state.scene.clamp(0, scenes - 1).long(), moved.long())
        return state.replace(x=x), count

    def with_impulses(self, state: State) -> State:
        """A state that counts impulses: from here on steps accumulate those of the material on boundaries and walls.

        Read them with `impulses`. A state whose `impulse` is None counts none, at no cost.
        """
        check_state(state)
        self._check_dimension(state)
        return state.replace(impulse=no_impulse(self, state.x))

    def impulses(self, state: State) -> Impulses:
        """The impulses on boundaries and walls since `with_impulses`; see `Impulses`.

        Raises:
            ValueError: for a state that counts none, or those of another step.
        """
        return impulses_of(self, state)

    def sorted(self, state: State) -> State:
        """`State.sorted` for this step, after which a `Mixture` does not check its particles again (and wait for it).

        Raises:
            GridOverflowError: on the CPU, where a grid of fixed `max_blocks` is full.
        """
        ordered = state.sorted(self.grid)
        if isinstance(self.law, Mixture):
            self.law.reordered(state.material, ordered.material)
        return ordered

    def stable_dt(self, state: State, cfl: float = 0.5, previous: float | Tensor | None = None) -> Tensor:
        """Largest stable time step of each scene [s], [B], times `cfl`; see `torch_mpm.stable_dt`.

        Before every step, or every few, call it with the dt of the previous step:
        `dt = step.stable_dt(state, previous=dt)`. The result is that dt while it is between half of the limit and the
        limit.

        It has no gradient. Moving obstacles count; the effect of `on_grid` and other boundaries on the velocities is
        not included. Implicit steps may exceed this limit. With explicit materials it is the limit of these materials,
        which must not be exceeded.
        """
        check_number("cfl", cfl, "positive and finite", lambda v: 0 < v < math.inf)
        return chosen_dt(cfl / self.stability_report(state, with_energy=False).rate, previous).to(state.x.dtype)

    @torch.no_grad()
    def diagnostics(self, state: State, with_energy: bool = True) -> LawDiagnostics:
        """Stress, stiffness and, with `with_energy`, energy density of the law."""
        check_state(state)
        with full_precision(state.x):
            state = self.prepare(state)
            self.law.check_parameters(len(state), self.grid.scenes)
            return law_diagnostics(self.law, state, with_energy)

    @torch.no_grad()
    def stability_report(
        self, state: State, with_energy: bool = True, diagnostics: LawDiagnostics | None = None
    ) -> Survey:
        """Limit of the time step, speed and validity of each scene, without synchronising.

        Args:
            state: the particles.
            with_energy: whether to check the energy of the law, which is not finite for meaningless deformations.
            diagnostics: result of `diagnostics` for the state, if known.
        """
        check_state(state)
        moving = [b for b in self.boundaries.entries if isinstance(b, Obstacle) and b.moves]
        fused = [b for b in moving if fusible(b, state.time)][:MAX_OBSTACLES]
        others = [b for b in moving if not any(b is kept for kept in fused)]

        def found(law: Material, particles: Any, diagnostics: LawDiagnostics) -> Survey:
            return stability_report(
                *(self.grid, law, particles, diagnostics, "flip" if self._flip_share else self.transfer),
                *(self.stress_form, self._obstacle_speed(others, particles), fused),
            )

        with full_precision(state.x):
            state = self.prepare(state)
            report = found(self.law, state, diagnostics or self.diagnostics(state, with_energy))
            if self.integrator is not None and self.integrator.explicit:
                law, part = self.integrator.unsolved(self.law, state)
                report = report._replace(rate=found(law, part, law_diagnostics(law, part, False)).rate)
            return report

    def figures(self, state: State, judge: bool = True) -> LawDiagnostics:
        """Old name of `diagnostics`."""
        warnings.warn("Step.figures is now Step.diagnostics", DeprecationWarning, stacklevel=2)
        return self.diagnostics(state, judge)

    def survey(self, state: State, judge: bool = True, figures: LawDiagnostics | None = None) -> Survey:
        """Old name of `stability_report`."""
        warnings.warn("Step.survey is now Step.stability_report", DeprecationWarning, stacklevel=2)
        return self.stability_report(state, judge, figures)

    def _obstacle_speed(self, obstacles: list[Obstacle], state: Any) -> Tensor | None:
        """Largest speed of the obstacles that a particle may touch [P] [m/s]; None without obstacles."""
        if not obstacles:
            return None
        scene = None if state.scene is None else state.scene.clamp(0, self.grid.scenes - 1)
        reach = 2 * math.sqrt(self.grid.dim) * self.grid.dx  # of a particle's nodes
        return torch.stack([o.speed(state.x, scene, state.time, reach) for o in obstacles]).amax(0)

    @property
    def status(self) -> Tensor | None:
        """Status of all steps so far, int32 [1 + B, 8] on the device of the particles, see csrc/grid/status.h."""
        return self._error_status.status

    @torch.no_grad()
    def failures(self, state: State | None = None) -> Failures:
        """Failed scenes of the steps so far, with their problems; tensors on the device, without waiting for it.

        A training loop masks such scenes by their particles, since zero times the NaN of a lost scene is NaN:
        `failed = step.failures().failed[state.scene.long()]; v = torch.where(failed[:, None], 0, state.v)`.

        Args:
            state: its positions, masses, volumes, velocities and deformations are checked too.
        """
        state = None if state is None else self.prepare(state)
        problems = self._error_status.problems(self.grid, state)
        if self.heat is not None:
            problems |= self.heat.problems()
        if self.integrator is not None:
            problems |= self.integrator.problems()
        if state is not None:
            taken = self.status is not None
            problems |= problems_of_state(self.law, state, self.grid.scenes, taken)
        return Failures.of(problems, self.grid.scenes, self._error_status.given)

    def check(self, state: State | None = None) -> None:
        """Check the status of all steps so far, and a state if given; synchronises with the device.

        Replays of CUDA graphs are included, if a step was computed before the capture.

        Warns:
            PrecisionWarning: where the positions of the state do not resolve the cells, see `Grid`.
            FrontWarning: where steps were so long that fronts between phases lag behind, see `Heat`.
            LockingWarning: where an elastic law is nearly incompressible. A new step warns of values on the CPU.
            ThinWallWarning: for boxes, revolved and sampled shapes that are thinner than 4 dx.

        Raises:
            SimulationError: that names each scene (up to a dozen of a kind), when and how many, and has `failures`: if
                a particle left the grid or is not finite, if heat was not solved, if an entry of a tensor dt was
                negative or NaN; and in the state, if a position is outside the grid or not finite, if a mass or volume
                is not positive and finite, or if the law has no meaning for a particle's deformation (turned inside
                out, J ≤ 0); such a particle has zero stress from then on.
            GridOverflowError: if more blocks were active than the grid has room for, and nothing else is wrong.
        """
        failures = self.failures(state)
        if bool(failures.failed.any()):
            failures = dataclasses.replace(failures, given={**failures.given, **given_problems(self, failures, state)})
        raise_failures(failures, self._error_status.all(), self.grid)
        if self.heat is not None:
            self.heat.fronts.warn()
        locking.warn(self.law, self.grid.kernel)
        if state is not None:
            resolution.check(self.grid, state.x.dtype)
        warn_of_thin_walls(self.boundaries.entries, self.grid.dx)

    def explain(self, state: State, dt: float | Tensor = 1.0, speed: float | None = None, n: int = 1000) -> str:
        """The plan of `rollout` for n steps in words: executor and schedule, and a line with the reason against each of
        the others; see `plan_rollout`.

        Args:
            state: the particles.
            dt: time step [s].
            speed: speed of slow motion [m/s], to compare explicit and implicit steps too; waits for the device.
            n: number of steps.

        Raises:
            TypeError, ValueError, NotImplementedError: as `torch_mpm.implicit.compare`, for a speed.
        """
        from ..rollouts import plan_rollout

        first, *others = str(plan_rollout(self, state, n, dt)).splitlines()
        if self.with_residual(state, dt).x_residual is not None:
            first += ", with compensated positions"
        if speed is not None:
            first += f"; {compare(self, state, speed)}"
        return "\n".join([first, *others])

    def reset(self) -> None:
        """Forget the status of the steps so far."""
        self._error_status.reset()
        if self.heat is not None:
            self.heat.reset()
        if self.integrator is not None:
            self.integrator.reset()

    def forget_failures(self, scenes: Tensor) -> None:
        """Forget the problems of scenes, bool [B] on the device of the particles, without waiting for it."""
        self._error_status.forget(scenes)
        if self.heat is not None:
            self.heat.forget(scenes)
        if self.integrator is not None:
            self.integrator.forget(scenes)


def _argument(step: Step, name: str, value: Any) -> Any:
    """An argument of a `Step` in the form that the step keeps.

    Raises:
        TypeError, ValueError: for a wrong one.
    """
    if name == "grid":
        check_grid(value)
    if name == "law":
        law = as_law("law", value)
        check_explicit_materials(getattr(step, "integrator", None), law)
        return law
    if name == "transfer":
        check_choice("transfer", value, TRANSFERS)
    if name == "stress_form":
        check_choice("stress_form", value, STRESS_FORMS)
    if name == "flip":
        return float(check_number("flip", value, "between 0 and 1", lambda v: 0 <= v <= 1))
    if name == "gravity" and value is not None:
        gravity = _checked_gravity(value, step.grid)
        return value if isinstance(value, WRITABLE) else gravity
    if name == "walls" and value is not None and not isinstance(value, Walls):
        if not isinstance(value, str):
            raise TypeError(f"walls must be the name of a kind, Walls or None, got {shape_of(value)}")
        return Walls(value)
    if name == "boundaries":
        return BoundaryList(value)
    if name == "on_grid" and value is not None and not callable(value):
        raise TypeError(f"on_grid must be a function, a module or None, got {shape_of(value)}")
    if name == "on_particles" and value is not None and not callable(value):
        raise TypeError(f"on_particles must be a function, a module or None, got {shape_of(value)}")
    if name == "compensated" and value is not None:
        return check_flag("compensated", value)
    if name == "integrator" and value is not None:
        integrator = as_integrator(value)
        check_explicit_materials(integrator, step.law)
        return integrator
    if name == "heat" and value is not None and not isinstance(value, Heat):
        raise TypeError(f"heat must be a Heat or None, got {shape_of(value)}")
    return value


def _checked_gravity(given: Any, grid: Grid) -> Any:
    gravity = constant("gravity", given)
    if isinstance(gravity, Tensor) and not gravity.is_floating_point():
        raise TypeError(f"gravity must be numbers or a floating tensor, got {gravity.dtype}")
    shape = shape_of_value(gravity)
    if shape not in ((grid.dim,), (1, grid.dim), (grid.scenes, grid.dim)):
        found = list(shape) if isinstance(given, Tensor) else given
        raise ValueError(f"gravity must have shape [D] or [B, D] = [{grid.scenes}, {grid.dim}], got {found}")
    return gravity
