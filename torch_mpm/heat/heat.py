"""Heat in the particles: one implicit step of conduction, and the temperature that moves with them.

M ∂θ/∂t + H θ = h on the nodes (Gao et al. 2018, supplement, equation 10), solved by `heat_cg` for the increment d of
the node temperatures θ_i = Σ_p N_i m_p C_p (θ_p + g_p · (x_i − x_p)) / M_i, with M_i = Σ_p N_i m_p C_p. Back on the
particles

    θ_p ← θ_p + Σ_i N_i [d_i + β_p (θ̄_i − θ_p)],
    g_p ← g_p + D⁻¹ Σ_i N_i (d_i + β_p θ̄_i) (x_i − x_p) − β_p g_p,

where θ̄_i is the average of the particles with weights β_p m_p C_p instead of m_p C_p. β = 0 is FLIP; β = 1 is APIC, or
PIC without g. PIC and APIC diffuse by the transfer alone, PIC with a diffusion number of 0.25 in every step; FLIP keeps
noise that the grid cannot represent. The hybrid has β_p = min(1, 4 r) with the diffusion number r = κ dt/(ρ C dx²): the
transfer smooths only where conduction does, and insulators take no part in it.

Heat is conserved exactly. At rest and without heat from outside, a step is symmetric with the energy Σ_p m_p C_p (θ_p²
+ D |g_p|²) = Σ_pi N_i m_p C_p f_pi², f_pi = θ_p + g_p · (x_i − x_p), and has eigenvalues between 0 and 1, for any β_p
in [0, 1], κ, C and dt: conduction dissipates the part that f and the nodes share, the blend the rest, because variances
about a node with the weights β_p m_p C_p are at most those with m_p C_p.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from ..boundaries import BoundaryList
from ..boundaries.control import control_step
from ..cuda_graphs.capture import DeviceConstantCache, outside_transforms, without_transforms
from ..errors import check_like, check_number
from ..geometry.vectors import determinant
from ..grid.grid import Blocks, Grid, check_grid
from ..laws.compiled import check_value
from ..laws.parameters import Value, check_length, evaluate, needed_temperature, store
from ..laws.thermal import LIQUID
from ..ops import gather, heat_cg, scatter
from ..ops.arguments import check_choice, per_particle
from ..ops.heat import METHODS
from ..ops.pointwise import pointwise
from ..state.state import State, check_state
from ..step.clocks import time_after
from ..step.failures import Failures, Problem, raise_failures, unsolved_heat
from ..step.pause import paused
from ..step.status import ErrorStatus
from .boundaries import FixedSurface, HeatNodes
from .fronts import FrontStatus

TRANSFERS = ("hybrid", "apic", "flip", "pic")
NEGLIGIBLE = 1e-12
"""Residual [K] that a solve may always leave: 1e6 of them are a microkelvin; far smaller ones underflow in float32."""
SWEEPS = 4
"""Number of averages of the initial gradient: steps then conduct within 2% of the exact field."""
ADJOINT_TOLERANCE = 1e-6
"""Largest tolerance of an adjoint solve: at 1e-4 gradients with respect to positions are wrong by 1e-3."""
GRADIENT = "temperature_gradient"
"""Key of `State.extra` of the temperature gradient g_p [P, D] [K/m] of the hybrid and APIC."""


class HeatBoundary(Protocol):
    """Term of a heat step; see `torch_mpm.heat_boundaries`."""

    def apply(self, nodes: HeatNodes) -> None: ...


class Heat(nn.Module):
    """Conduction of heat in the particles, as part of a `Step` or alone, `state = heat(state, dt)`, in a body at rest.

    Args:
        grid: the lattice.
        conductivity: κ [W/(m K)], not negative; a `Value`: a number, a tensor [], [1], [B] or [P], or a function of the
            temperature [P] (a `Table`, a network, any torch code), taken at the beginning of the step.
        specific_heat: C [J/(kg K)], positive; a `Value`.
        boundaries: terms of `torch_mpm.heat_boundaries`; none for an insulated body.
        transfer: "hybrid", "apic", "flip" or "pic"; see above. "hybrid" and "apic" store the temperature gradient in
            state.extra["temperature_gradient"] [P, D] [K/m]. By default it starts as that of the nodes (`prepare`), so
            that the first steps conduct as later ones do.
        melting_point: θ_m [K], relative to the reference; a `Value`, infinite for materials that do not melt.
        latent_heat: L [J/kg], positive; a `Value`. With it the liquid mass fraction of each particle is stored in
            state.extra["liquid"] [P]; a particle stays at the melting point while it absorbs or releases L (enthalpy
            buffer, Stomakhin et al. 2014). Its default follows from the temperature. The solve of a step has no latent
            heat, so that a front in a body whose solid is colder than the melting point lags behind: by up to 0.1 dx,
            plus 0.45 √(κ dt/(ρ C)) for any dx. `check` warns of fronts that move at diffusion numbers κ dt/(ρ C dx²)
            above 1.
        plastic_heating: share of the energy dissipated by the law that becomes heat (Taylor and Quinney 1934), in
            [0, 1].
        reference: absolute temperature to which state.temperature is relative [K], finite; only radiation needs it. Use
            a reference in the middle of the temperatures: float32 then resolves small changes.
        tolerance: residual of each solve relative to its first, in (0, 1). The error of the change in a step is at most
            1 + 4 r times as large relative to it, with the largest diffusion number r, both as mass-weighted RMS.
        max_iterations: maximum number of iterations of each solve.
        method: method of `heat_cg`: "cg", or "multigrid" for steps with diffusion numbers from about 1e3.

    Differentiable with respect to temperatures, positions, masses, volumes, dt and all parameters.

    Raises:
        TypeError, ValueError: for a wrong argument. Values of tensors are checked here only, not when they are changed
            or trained; a scene fails where a function returns a negative conductivity, which `check` reports.
    """

    boundaries: BoundaryList
    conductivity: Any
    specific_heat: Any
    melting_point: Any
    latent_heat: Any

    def __init__(
        self,
        grid: Grid,
        conductivity: Value,
        specific_heat: Value,
        boundaries: Sequence[HeatBoundary] = (),
        transfer: str = "hybrid",
        melting_point: Value | None = None,
        latent_heat: Value | None = None,
        plastic_heating: float = 0.0,
        reference: float = 0.0,
        tolerance: float = 1e-6,
        max_iterations: int = 500,
        method: str = "cg",
    ) -> None:
        super().__init__()
        check_grid(grid)
        if transfer not in TRANSFERS:
            raise ValueError(f"transfer must be one of {sorted(TRANSFERS)}, got {transfer!r}")
        if (melting_point is None) != (latent_heat is None):
            raise ValueError("melting_point and latent_heat must be given together")
        check_number("plastic_heating", plastic_heating, "between 0 and 1", lambda v: 0 <= v <= 1)
        check_number("tolerance", tolerance, "between 0 and 1", lambda v: 0 < v < 1)
        check_number("reference", reference)
        check_number("max_iterations", max_iterations, "at least 1", lambda v: 1 <= v < math.inf)
        check_choice("method", method, METHODS)
        if method == "chebyshev" and any(isinstance(boundary, FixedSurface) for boundary in boundaries):
            raise ValueError('method must be "cg" or "multigrid" where a boundary is a FixedSurface, got "chebyshev"')
        self.grid, self.transfer = grid, transfer
        self.boundaries = boundaries  # type: ignore[assignment]
        self.plastic_heating, self.reference = float(plastic_heating), float(reference)
        self.tolerance, self.max_iterations, self.method = float(tolerance), int(max_iterations), method
        not_negative, positive = (lambda v: v >= 0), (lambda v: v > 0)
        store(self, "conductivity", check_value("conductivity", conductivity, "not negative", not_negative))
        store(self, "specific_heat", check_value("specific_heat", specific_heat, "positive", positive))
        self.melts = latent_heat is not None
        if melting_point is not None and latent_heat is not None:
            check_value("melting_point", melting_point, "a number", lambda v: v == v, infinite=True)
            store(self, "melting_point", melting_point)
            store(self, "latent_heat", check_value("latent_heat", latent_heat, "positive", positive))
        self._error_status = ErrorStatus()
        self.unsolved: Tensor | None = None
        """Solves of each scene so far that missed their tolerance, int32 [B], and the largest residual [B] [K]."""
        self.residual: Tensor | None = None
        self.fronts = FrontStatus()
        self._kept_numbers, self._kept_terms = DeviceConstantCache(), DeviceConstantCache()

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, BoundaryList(value) if name == "boundaries" else value)

    @property
    def status(self) -> Tensor | None:
        """Status of the activations of `forward`, as `Step.status`."""
        return self._error_status.status

    @property
    def affine(self) -> bool:
        """Whether particles store a temperature gradient."""
        return self.transfer in ("hybrid", "apic")

    @property
    def parameter_values(self) -> tuple[Any, ...]:
        """Conductivity and specific heat; of materials that melt also melting point and latent heat."""
        melting = (self.melting_point, self.latent_heat) if self.melts else ()
        return (self.conductivity, self.specific_heat, *melting)

    @property
    def adjoint_tolerance(self) -> float:
        """Residual of each adjoint solve relative to its first."""
        return min(self.tolerance, ADJOINT_TOLERANCE)

    def prepare(self, state: State) -> State:
        """Add missing fields to a state.

        The gradient is that of the node temperatures, recomputed from particles with their gradients: it approaches the
        gradient with which neighbours agree best at the nodes between them. Differentiable.

        Raises:
            ValueError: for a state without temperature, or fields of a wrong shape.
        """
        check_state(state)
        state = state.of_scenes(self.grid.scenes)
        temperature = needed_temperature(state)
        extra = dict(state.extra)
        if self.affine and GRADIENT not in extra:
            extra[GRADIENT] = self._gradient(state, temperature)
        if self.melts:
            extra[LIQUID] = self._liquid(state)
        check_like(GRADIENT, extra.get(GRADIENT), state.x, tuple(state.x.shape), "[P, D]")
        check_like(LIQUID, extra.get(LIQUID), state.x, tuple(state.mass.shape), "[P]")
        return state if extra.keys() == state.extra.keys() else state.replace(extra=extra)

    def forward(self, state: State, dt: float | Tensor) -> State:
        """State of a body at rest one step later.

        Args:
            state: with a temperature.
            dt: time step [s]: a number, or a tensor of shape [], [1] or [B]. Any size is stable. A scene with zero in a
                tensor is paused, as by `Step.forward`.

        Raises:
            ValueError, TypeError: for a state without temperature, wrong shapes, dtypes or devices, or a number dt that
                is not positive.
        """
        state = self.prepare(state)
        if torch.compiler.is_compiling():
            return paused(self._advanced, self._error_status, state, dt, self.grid.scenes)
        with control_step(self, state, 1, dt) as left:
            return left(paused(self._advanced, self._error_status, state, dt, self.grid.scenes))

    def _advanced(self, state: State, dt: float | Tensor) -> State:
        """Prepared state one step later."""
        blocks = self._error_status.activate(self.grid, state.x, state.scene, state.ids)
        return state.replace(**self.update(blocks, state, dt), time=time_after(state.time, dt))

    def update(
        self,
        blocks: Blocks,
        state: State,
        dt: float | Tensor,
        velocity_gradient: Tensor | None = None,
        dissipated: Tensor | None = None,
    ) -> dict[str, Any]:
        """Fields of the state that a step changes: temperature, and extra where it has fields of this.

        Particles that are absent or outside the grid keep their values.

        Args:
            blocks: active blocks of the state's positions.
            state: prepared.
            dt: as for `forward`; the results of particles of a paused scene have no meaning.
            velocity_gradient: ∇v [P, D, D] [1/s] that the particles move with; None at rest.
            dissipated: energy that the law turned into heat in this step, per rest volume [P] [J/m³], or None.
        """
        self._check_parameters(len(state))
        theta, gradient = needed_temperature(state), state.extra.get(GRADIENT) if self.affine else None
        step = dt if not isinstance(dt, Tensor) else per_particle(dt.reshape(-1).to(theta), state.scene, len(theta))
        motion: Tensor | float = 0.0 if velocity_gradient is None else velocity_gradient
        specific_heat = evaluate("specific_heat", self.specific_heat, state)
        conductivity = evaluate("conductivity", self.conductivity, state)
        matter = *_deformation(state), specific_heat, conductivity, state.mass
        volume, heat_capacity, conductance, varying, *number = pointwise(
            "heat_weights",
            self.grid.dim,
            state.volume,
            *matter,
            step,
            motion,
            self.grid.dx,
            wanted=range(4 + self.melts),
        )
        blend = varying if self.transfer == "hybrid" else 0.0 if self.transfer == "flip" else 1.0
        weights = (heat_capacity,) if isinstance(blend, float) else (heat_capacity, blend)
        (total, *_), means = _averages(blocks, state.x, weights, theta, gradient)
        smooth = means[-1]
        nodes = HeatNodes(blocks, state, volume, conductance, total, means[0], self.reference)
        nodes.held_surfaces = [b.region for b in self.boundaries if isinstance(b, FixedSurface)]
        for boundary in self.boundaries:
            boundary.apply(nodes)
        if self.plastic_heating and dissipated is not None:
            seconds = step.where(step > 0, 1) if isinstance(step, Tensor) else step
            power = self.plastic_heating * dissipated * state.volume / seconds
            nodes.add_source(scatter(blocks, state.x, power[:, None])[:, 0])
        increment = self._solve(nodes, dt)
        theta, gradient = self._to_particles(nodes, increment, smooth, blend, theta, gradient, motion, step)
        inside, extra = blocks.transferred(), dict(state.extra)
        if gradient is not None:
            extra[GRADIENT] = torch.where(inside[:, None], gradient, extra[GRADIENT])
        if self.melts:
            theta, liquid, changing = self._melt(state, specific_heat, theta, extra[LIQUID], number[0].detach())
            extra[LIQUID] = torch.where(inside, liquid, extra[LIQUID])
            self.fronts.add(torch.where(inside, changing, 0), state.scene, self.grid.scenes)
        theta = torch.where(inside, theta, needed_temperature(state))
        return {"temperature": theta, "extra": extra} if extra else {"temperature": theta}

    def _check_parameters(self, particles: int) -> None:
        melting = ("melting_point", "latent_heat") if self.melts else ()
        for name in ("conductivity", "specific_heat", *melting):
            check_length(name, getattr(self, name), particles, self.grid.scenes)

    def _solve(self, nodes: HeatNodes, dt: float | Tensor) -> Tensor:
        """Change of the node temperatures in the step [N]."""
        conductance = nodes.left_conductance()
        start = nodes.theta
        if nodes.fixed is not None and nodes.held is not None:
            start = torch.where(nodes.fixed, nodes.held, start)
        boundary = nodes.source, nodes.exchange, nodes.fixed
        solve = heat_cg(
            nodes.blocks, nodes.state.x, conductance, nodes.heat_capacity, start, dt, *boundary, tolerance=NEGLIGIBLE,
            relative_tolerance=self.tolerance, max_iterations=self.max_iterations, method=self.method,
            adjoint_tolerance=self.adjoint_tolerance,
        )  # fmt: skip
        solved = solve.converged
        if isinstance(dt, Tensor):
            solved = solved | (dt.detach() == 0)  # A paused scene has nothing to solve.
        self._store(solved, solve.residual)
        return solve.increment if start is nodes.theta else solve.increment + (start - nodes.theta)

    def _to_particles(
        self,
        nodes: HeatNodes,
        increment: Tensor,
        smooth: Tensor,
        blend: float | Tensor,
        theta: Tensor,
        gradient: Tensor | None,
        motion: Tensor | float,
        step: Tensor | float,
    ) -> tuple[Tensor, Tensor | None]:
        """Temperature and gradient of the particles, as at the top of this file; the gradient is transported with the
        matter.
        """
        varies, affine = isinstance(blend, Tensor), gradient is not None
        channels = torch.stack([increment, smooth], 1) if varies else (increment + blend * smooth)[:, None]
        scale = self.grid.inverse_inertia
        value, moment, _ = gather(nodes.blocks, nodes.state.x, channels, moment=affine, moment_scale=scale)
        gathered = value, 0.0 if moment is None else moment, theta, 0.0 if gradient is None else gradient
        after = pointwise(
            f"heat_update_{channels.shape[1]}", self.grid.dim, *gathered, blend, motion, step,
            wanted=(0, 1) if affine else (0,),
        )  # fmt: skip
        return after[0], after[1] if affine else None

    def _gradient(self, state: State, temperature: Tensor) -> Tensor:
        """Initial temperature gradient of particles [P, D] [K/m]; zero where they do not conduct.

        Weights κ V equal those of θ̄_i, β_p m_p C_p, in small steps: an insulator has no weight for its neighbours.
        """
        blocks = self.grid.activate(state.x, state.scene)
        weight = evaluate("conductivity", self.conductivity, state) * present_volume(state)
        gradient = None
        for _ in range(SWEEPS):
            _, (mean,) = _averages(blocks, state.x, (weight,), temperature, gradient)
            scale = self.grid.inverse_inertia
            _, moment, _ = gather(blocks, state.x, mean[:, None], moment=True, moment_scale=scale)
            assert moment is not None
            gradient = moment[:, 0]
        assert gradient is not None
        return torch.where(weight[:, None] > 0, gradient, 0)

    def _liquid(self, state: State) -> Tensor:
        """Liquid fraction [P]: that of the state, or a function of its temperature."""
        if LIQUID in state.extra:
            return state.extra[LIQUID]
        temperature = needed_temperature(state)
        return (temperature.detach() > evaluate("melting_point", self.melting_point, state)).to(temperature)

    def _melt(
        self, state: State, specific_heat: Tensor | float, theta: Tensor, liquid: Tensor, number: Tensor
    ) -> Sequence[Tensor]:
        """Temperature and liquid fraction with the excess over the melting point moved into the latent heat, or out of
        it; and the diffusion numbers of the particles where that changes the fraction, else zero.
        """
        melting_point = evaluate("melting_point", self.melting_point, state)
        latent_heat = evaluate("latent_heat", self.latent_heat, state)
        matter = melting_point, specific_heat, latent_heat
        return pointwise("heat_melt", self.grid.dim, theta, liquid, *matter, number)

    def heat_content(self, state: State) -> Tensor:
        """m (C θ + L f) of each particle [P] [J], relative to the solid at the reference temperature.

        With a specific heat that depends on temperature this is not an energy.
        """
        content = evaluate("specific_heat", self.specific_heat, state) * needed_temperature(state)
        if self.melts:
            content = content + evaluate("latent_heat", self.latent_heat, state) * self._liquid(state)
        return state.mass * content

    @torch.no_grad()
    def _store(self, converged: Tensor, residual: Tensor) -> None:
        """Store the values that `check` reports, on the device."""
        converged, residual = without_transforms(converged), without_transforms(residual)
        with outside_transforms():
            self._add(~converged, torch.where(converged, 0, residual))

    def _add(self, unsolved: Tensor, residual: Tensor) -> None:
        """Count solves of each scene that missed their tolerance, with the largest residuals of these, else zero."""
        if self.unsolved is None or self.residual is None or self.unsolved.device != unsolved.device:
            with torch.inference_mode(False):
                self.unsolved = torch.zeros(unsolved.shape, dtype=torch.int32, device=unsolved.device)
                self.residual = torch.zeros(residual.shape, dtype=torch.float64, device=residual.device)
        self.unsolved += unsolved.to(torch.int32)
        torch.maximum(self.residual, residual.to(self.residual.dtype), out=self.residual)

    @torch.no_grad()
    def count(self, status: Tensor) -> None:
        """Add the status of steps in one op, [B, 3]: solves that missed their tolerance, their largest residual [K],
        and the largest diffusion number at a front."""
        self._add(status[:, 0], status[:, 1])
        if self.melts:
            self.fronts.add_largest(status[:, 2])

    @torch.no_grad()
    def count_adjoint(self, status: Tensor) -> None:
        """Add the status of the adjoint solves of steps in one op: a gradient of a solve that missed its tolerance is
        no more exact than that."""
        self._add(status[:, 0], status[:, 1])

    def problems(self) -> dict[str, Problem]:
        """Failures of the solves so far, by kind as in `Failures`, without synchronising."""
        if self.unsolved is None or self.residual is None:
            return {}
        return unsolved_heat(self.unsolved, self.residual, self.max_iterations)

    def concerns(self) -> Tensor | None:
        """Whether a solve of a scene missed its tolerance or a front lags behind, bool [B] on the device; None before
        the first solve.
        """
        if self.unsolved is None:
            return None
        missed, lags = self.unsolved > 0, self.fronts.lags()
        return missed if lags is None else missed | lags

    def check(self) -> None:
        """Check the solves so far; synchronises with the device.

        Warns:
            FrontWarning: where steps were so long that fronts between phases lag behind.

        Raises:
            SimulationError: for scenes in which a solve missed its tolerance, or data were not finite; for particles
                that left the grid or are not finite; for entries of a tensor dt that were negative or NaN.
            GridOverflowError: if more blocks were active than the grid has room for, and there is no other error.
        """
        if self.unsolved is None:
            return
        problems = self._error_status.problems(self.grid) | self.problems()
        raise_failures(Failures.of(problems, self.grid.scenes), self._error_status.all(), self.grid)
        self.fronts.warn()

    def reset(self) -> None:
        """Discard the status of the solves so far."""
        self._error_status.reset()
        self.fronts.reset()
        for kept in (self.unsolved, self.residual):
            if kept is not None:  # CUDA graphs may write to it.
                kept.zero_()

    def forget(self, scenes: Tensor) -> None:
        """Discard the status of scenes, bool [B] on the device of the particles."""
        self._error_status.forget(scenes)
        self.fronts.forget(scenes)
        for kept in (self.unsolved, self.residual):
            if kept is not None:
                kept.masked_fill_(scenes, 0)


def _averages(
    blocks: Blocks, x: Tensor, weights: Sequence[Tensor], theta: Tensor, gradient: Tensor | None
) -> tuple[list[Tensor], list[Tensor]]:
    """Σ_p N_i w_p and the averages Σ_p N_i w_p (θ_p + g_p · (x_i − x_p)) / Σ_p N_i w_p on the nodes, [N] each, for one
    weight [P], or for two, the second given by its share in the first.
    """
    count, dim = len(weights), blocks.grid.dim
    share, wanted = weights[1] if count == 2 else 0.0, (0,) if gradient is None else (0, 1)
    known = theta, 0.0 if gradient is None else gradient
    values, *moment = pointwise(f"heat_moments_{count}", dim, *known, weights[0], share, wanted=wanted)
    sums = scatter(blocks, x, values, moment[0] if moment else None)
    weight, mean = pointwise(f"heat_means_{count}", dim, sums)
    return list(weight.unbind(1)), list(mean.unbind(1))


def _deformation(state: State) -> tuple[Tensor | float, Tensor | float]:
    """J and F; one of them is the number one, as the other determines the volume."""
    if state.J is not None:
        return state.J, 1.0
    return 1.0, 1.0 if state.F is None else state.F


def present_volume(state: State) -> Tensor:
    """Volume of the particles now [P] [m³]."""
    if state.J is not None:
        return state.volume * state.J
    return state.volume if state.F is None else state.volume * determinant(state.F)
