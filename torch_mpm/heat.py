"""Heat in the particles: one implicit step of conduction, and the temperature that moves with them.

M ∂θ/∂t + H θ = h on the nodes (Gao et al. 2018, supplement, equation 10), solved by `heat_cg` for the increment d of
the node temperatures θ_i = Σ_p N_i m_p C_p (θ_p + g_p · (x_i − x_p)) / M_i, with M_i = Σ_p N_i m_p C_p. Back on the
particles

    θ_p ← θ_p + Σ_i N_i [d_i + β_i (θ_i − θ_p − g_p · (x_i − x_p))],
    g_p ← (1 − Σ_i N_i β_i) g_p + D⁻¹ Σ_i N_i [d_i + β_i (θ_i − θ_p)] (x_i − x_p),

where β_i is the average of the particles' β_p as θ_i is of their temperatures, so that heat is conserved exactly
whatever their β. β = 0 is FLIP; β = 1 is APIC, or PIC without g. PIC and APIC diffuse by the transfer alone, PIC with a
diffusion number of 0.25 in every step; FLIP keeps whatever noise the grid does not see. The hybrid has
β_p = min(1, 4 r) with the diffusion number r = κ dt/(ρ C dx²): what the transfer smooths, conduction smooths too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from .boundaries import BoundaryList, _norm
from .errors import SimulationError, check_like
from .grid import ActivationRecord, Blocks, Grid
from .heat_boundaries import FixedSurface, HeatNodes
from .materials import _check_value
from .ops import gather, heat_cg, scatter
from .ops.arguments import per_particle, soa_empty
from .ops.heat import METHODS
from .parameters import Value, evaluate, needed_temperature, store
from .state import State
from .thermal import LIQUID, determinant

TRANSFERS = ("hybrid", "apic", "flip", "pic")
NEGLIGIBLE = 1e-12
"""Residual [K] that a solve may always leave: 1e6 of them are a microkelvin, and far less underflows in float32."""
GRADIENT = "temperature_gradient"
"""Key of `State.extra` under which the hybrid and APIC keep the temperature gradient g_p [P, D] [K/m]."""


class HeatBoundary(Protocol):
    """What adds to the nodes of a heat step; see `torch_mpm.heat_boundaries`."""

    def apply(self, nodes: HeatNodes) -> None: ...


class Heat(nn.Module):
    """Conduction of heat in the particles, as part of a `Step` or alone, `state = heat(state, dt)`, in a body at rest.

    Args:
        grid: the lattice.
        conductivity: κ [W/(m K)], not negative; a `Value`: a number, a tensor [], [1], [B] or [P], or a function of the
            temperature [P] (a `Table`, a network, any torch code), taken at the beginning of the step.
        specific_heat: C [J/(kg K)], positive; a `Value`.
        boundaries: terms of `torch_mpm.heat_boundaries`; none for an insulated body.
        transfer: "hybrid", "apic", "flip" or "pic"; see above. "hybrid" and "apic" keep the temperature gradient in
            state.extra["temperature_gradient"] [P, D] [K/m], which starts at zero where the caller does not give it.
        melting_point: θ_m [K], relative to the reference; a `Value`, infinite for what does not melt.
        latent_heat: L [J/kg], positive; a `Value`. With it the liquid mass fraction of each particle is kept in
            state.extra["liquid"] [P]; a particle stays at the melting point while it takes up or gives off L
            (enthalpy buffer, Stomakhin et al. 2014). It starts from the temperature where the caller does not give it.
        plastic_heating: share of the energy dissipated by the law that becomes heat (Taylor and Quinney 1934), in
            [0, 1].
        reference: absolute temperature that state.temperature is relative to [K]; only radiation asks for it.
            Temperatures are best kept relative to one in their middle: float32 then resolves small changes.
        tolerance: residual of each solve relative to its first, in (0, 1). The error of the change in a step is at most
            1 + 4 r times as large relative to it, with the largest diffusion number r, both as mass-weighted RMS.
        max_iterations: of each solve.
        method: of `heat_cg`: "cg", or "multigrid" for steps with diffusion numbers from about 1e3.

    Differentiable with respect to temperatures, positions, masses, volumes, dt and all parameters.

    Raises:
        ValueError: for a wrong argument. Values of tensors are checked here, and not again when they are changed or
            trained; a function that returns a negative conductivity makes the scene fail, which `check` reports.
    """

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
        if transfer not in TRANSFERS:
            raise ValueError(f"transfer must be one of {sorted(TRANSFERS)}, got {transfer!r}")
        if (melting_point is None) != (latent_heat is None):
            raise ValueError("melting_point and latent_heat must be given together")
        if not 0 <= plastic_heating <= 1:
            raise ValueError(f"plastic_heating must be between 0 and 1, got {plastic_heating}")
        if not 0 < tolerance < 1:
            raise ValueError(f"tolerance must be between 0 and 1, got {tolerance}")
        if max_iterations < 1:
            raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")
        if method not in METHODS:
            raise ValueError(f"method must be one of {sorted(METHODS)}, got {method!r}")
        if method == "chebyshev" and any(isinstance(boundary, FixedSurface) for boundary in boundaries):
            raise ValueError('method must be "cg" or "multigrid" where a boundary is a FixedSurface, got "chebyshev"')
        self.grid, self.boundaries, self.transfer = grid, boundaries, transfer
        self.plastic_heating, self.reference = float(plastic_heating), float(reference)
        self.tolerance, self.max_iterations, self.method = float(tolerance), int(max_iterations), method
        not_negative, positive = (lambda v: v >= 0), (lambda v: v > 0)
        store(self, "conductivity", _check_value("conductivity", conductivity, "not negative", not_negative))
        store(self, "specific_heat", _check_value("specific_heat", specific_heat, "positive", positive))
        self.melts = latent_heat is not None
        if melting_point is not None and latent_heat is not None:
            store(self, "melting_point", melting_point)
            store(self, "latent_heat", _check_value("latent_heat", latent_heat, "positive", positive))
        self._activations = ActivationRecord()
        self.unsolved: Tensor | None = None
        """Solves of each scene so far that missed their tolerance, int32 [B], and the largest residual [B] [K]."""
        self.residual: Tensor | None = None

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, BoundaryList(value) if name == "boundaries" else value)

    @property
    def status(self) -> Tensor | None:
        """Status of the activations of `forward`, as `Step.status`."""
        return self._activations.status

    @property
    def affine(self) -> bool:
        """Whether particles keep a temperature gradient."""
        return self.transfer in ("hybrid", "apic")

    def prepare(self, state: State) -> State:
        """Give a state the fields that this needs and that it lacks.

        Raises:
            ValueError: for a state without temperature, or fields of a wrong shape.
        """
        temperature = needed_temperature(state)
        extra = dict(state.extra)
        if self.affine and GRADIENT not in extra:
            extra[GRADIENT] = soa_empty(state.x, tuple(state.x.shape)).zero_()
        if self.melts and LIQUID not in extra:
            extra[LIQUID] = (temperature.detach() > evaluate("melting_point", self.melting_point, state)).to(
                temperature
            )
        check_like(GRADIENT, extra.get(GRADIENT), state.x, tuple(state.x.shape), "[P, D]")
        check_like(LIQUID, extra.get(LIQUID), state.x, tuple(state.mass.shape), "[P]")
        return state if extra.keys() == state.extra.keys() else state.replace(extra=extra)

    def forward(self, state: State, dt: float | Tensor) -> State:
        """The state of a body at rest one step later.

        Args:
            state: with a temperature.
            dt: time step [s]: a number, or a tensor of shape [], [1] or [B]. Any size is stable.

        Raises:
            ValueError, TypeError: for a state without temperature, wrong shapes, dtypes or devices, or a number dt that
                is not positive.
        """
        state = self.prepare(state)
        blocks = self._activations.activate(self.grid, state.x, state.scene)
        return state.replace(**self.update(blocks, state, dt), time=state.time + dt)

    def update(
        self,
        blocks: Blocks,
        state: State,
        dt: float | Tensor,
        velocity_gradient: Tensor | None = None,
        dissipated: Tensor | None = None,
    ) -> dict[str, Any]:
        """Fields of the state that a step changes: temperature, and extra where it has fields of this.

        Args:
            blocks: active blocks of the state's positions.
            state: prepared.
            dt: as for `forward`.
            velocity_gradient: ∇v [P, D, D] [1/s] that the particles move with; None at rest.
            dissipated: energy that the law turned into heat in this step, per rest volume [P] [J/m³], or None.
        """
        theta, gradient = needed_temperature(state), state.extra.get(GRADIENT) if self.affine else None
        volume = present_volume(state)
        step = dt if not isinstance(dt, Tensor) else per_particle(dt.reshape(-1).to(theta), state.scene, len(theta))
        heat_capacity = evaluate("specific_heat", self.specific_heat, state) * state.mass
        conductivity = evaluate("conductivity", self.conductivity, state)
        if isinstance(conductivity, Tensor):
            conductivity = torch.where(conductivity >= 0, conductivity, torch.nan)
        conductance = conductivity * volume
        number = step * conductance / (heat_capacity * self.grid.dx**2)
        blend = self._blend(number, step, velocity_gradient)
        nodes, weight = self._to_nodes(blocks, state, volume, conductance, heat_capacity, theta, gradient, blend)
        before = nodes.theta
        for boundary in self.boundaries:
            boundary.apply(nodes)
        if self.plastic_heating and dissipated is not None:
            power = self.plastic_heating * dissipated * state.volume / step
            nodes.add_source(scatter(blocks, state.x, power[:, None])[:, 0])
        increment = self._solve(nodes, dt) - before
        theta, gradient = self._to_particles(nodes, before, increment, weight, theta, gradient)
        extra = dict(state.extra)
        if gradient is not None:
            extra[GRADIENT] = _convected(gradient, velocity_gradient, step)
        if self.melts:
            theta, extra[LIQUID] = self._melt(state, theta, extra[LIQUID])
        return {"temperature": theta, "extra": extra} if extra else {"temperature": theta}

    def _blend(self, number: Tensor, step: float | Tensor, velocity_gradient: Tensor | None) -> float | Tensor:
        """β_p: a number for all particles, or [P]."""
        if self.transfer != "hybrid":
            return 0.0 if self.transfer == "flip" else 1.0
        rate = 4 * number
        if velocity_gradient is not None:
            # Where matter is strained, g_p of the particle is forgotten for that of the grid.
            strain = 0.5 * (velocity_gradient + velocity_gradient.mT)
            rate = rate + step * _norm(strain.flatten(1))
        return rate.clamp(max=1)

    def _to_nodes(
        self,
        blocks: Blocks,
        state: State,
        volume: Tensor,
        conductance: Tensor,
        heat_capacity: Tensor,
        theta: Tensor,
        gradient: Tensor | None,
        blend: float | Tensor,
    ) -> tuple[HeatNodes, float | Tensor]:
        """Heat capacity and temperature of the nodes, and their β_i [N]."""
        values = [heat_capacity * theta, heat_capacity]
        if isinstance(blend, Tensor):
            values.append(heat_capacity * blend)
        moment = None
        if gradient is not None:
            moment = nn.functional.pad((heat_capacity[:, None] * gradient)[:, None], (0, 0, 0, len(values) - 1))
        energy, capacity, *weighted = scatter(blocks, state.x, torch.stack(values, 1), moment).unbind(1)
        full = capacity > 0
        inverse = torch.where(full, 1 / torch.where(full, capacity, 1), 0)
        nodes = HeatNodes(blocks, state, volume, conductance, capacity, energy * inverse, self.reference)
        return nodes, weighted[0] * inverse if weighted else float(blend)

    def _solve(self, nodes: HeatNodes, dt: float | Tensor) -> Tensor:
        """Temperature of the nodes at the end of the step [N]."""
        conductance = nodes.left_conductance()
        start = nodes.theta
        if nodes.fixed is not None and nodes.held is not None:
            start = torch.where(nodes.fixed, nodes.held, start)
        boundary = nodes.source, nodes.exchange, nodes.fixed
        solve = heat_cg(
            nodes.blocks, nodes.state.x, conductance, nodes.capacity, start, dt, *boundary, tolerance=NEGLIGIBLE,
            relative_tolerance=self.tolerance, max_iterations=self.max_iterations, method=self.method,
        )  # fmt: skip
        self._record(solve.converged, solve.residual)
        return start + solve.increment

    def _to_particles(
        self,
        nodes: HeatNodes,
        before: Tensor,
        increment: Tensor,
        weight: float | Tensor,
        theta: Tensor,
        gradient: Tensor | None,
    ) -> tuple[Tensor, Tensor | None]:
        """Temperature and gradient of the particles, as at the top of this file."""
        affine = gradient is not None
        change = increment + weight * before
        channels = torch.stack([change, weight], 1) if isinstance(weight, Tensor) else change[:, None]
        value, moment, _ = gather(
            nodes.blocks, nodes.state.x, channels, moment=affine, moment_scale=self.grid.inverse_inertia
        )
        if not isinstance(weight, Tensor):
            kept = None if gradient is None or moment is None else (1 - weight) * gradient + moment[:, 0]
            return (1 - weight) * theta + value[:, 0], kept
        assert gradient is not None and moment is not None
        blend, skew = value[:, 1], moment[:, 1]
        theta_new = (1 - blend) * theta + value[:, 0] - (gradient * skew).sum(1) / self.grid.inverse_inertia
        return theta_new, (1 - blend)[:, None] * gradient + moment[:, 0] - theta[:, None] * skew

    def _melt(self, state: State, theta: Tensor, liquid: Tensor) -> tuple[Tensor, Tensor]:
        """Temperature and liquid fraction with the excess over the melting point in the latent heat, or out of it."""
        melting_point = evaluate("melting_point", self.melting_point, state)
        ratio = evaluate("specific_heat", self.specific_heat, state) / evaluate("latent_heat", self.latent_heat, state)
        fraction = (liquid + ratio * (theta - melting_point)).clamp(0, 1)
        return theta - (fraction - liquid) / ratio, fraction

    def heat_content(self, state: State) -> Tensor:
        """m (C θ + L f) of each particle [P] [J], relative to the solid at the reference temperature.

        With a specific heat that depends on temperature this is no energy.
        """
        content = evaluate("specific_heat", self.specific_heat, state) * needed_temperature(state)
        if self.melts:
            content = content + evaluate("latent_heat", self.latent_heat, state) * self.prepare(state).extra[LIQUID]
        return state.mass * content

    @torch.no_grad()
    def _record(self, converged: Tensor, residual: Tensor) -> None:
        """Keep what `check` reports, on the device."""
        if self.unsolved is None or self.residual is None or self.unsolved.device != converged.device:
            with torch.inference_mode(False):
                self.unsolved = torch.zeros(converged.shape, dtype=torch.int32, device=converged.device)
                self.residual = torch.zeros(residual.shape, dtype=torch.float64, device=residual.device)
        self.unsolved += ~converged
        self.residual.copy_(torch.where(converged, self.residual, torch.maximum(self.residual, residual.double())))

    def check(self) -> None:
        """Read what became of the solves so far; synchronises with the device.

        Raises:
            SimulationError: for scenes in which a solve missed its tolerance, or data were not finite.
        """
        if self.unsolved is None or self.residual is None:
            return
        unsolved, residual = self.unsolved.tolist(), self.residual.tolist()
        failed = [b for b, count in enumerate(unsolved) if count]
        if not failed:
            return
        b = failed[0]
        if residual[b] != residual[b]:
            what = "a temperature, a conductivity or a boundary is not finite, or a conductivity is negative"
        else:
            what = (
                f"a residual of {residual[b]:.3g} K was left after {self.max_iterations} iterations: "
                "reduce dt, or raise max_iterations or tolerance"
            )
        raise SimulationError(
            f"heat was not solved in {len(failed)} scenes, first in scene {b}, {unsolved[b]} times: {what}"
        )

    def reset(self) -> None:
        """Forget what became of the solves so far."""
        self._activations.reset()
        for kept in (self.unsolved, self.residual):
            if kept is not None:  # and CUDA graphs may write to it
                kept.zero_()


def present_volume(state: State) -> Tensor:
    """Volume of the particles now [P] [m³]."""
    if state.J is not None:
        return state.volume * state.J
    return state.volume if state.F is None else state.volume * determinant(state.F)


def _convected(gradient: Tensor, velocity_gradient: Tensor | None, step: float | Tensor) -> Tensor:
    """∇θ of matter that moved by 1 + dt ∇v: its inverse transpose times the gradient, to second order in dt."""
    if velocity_gradient is None:
        return gradient
    rate = velocity_gradient.mT * (step[:, None, None] if isinstance(step, Tensor) else step)
    first = (rate @ gradient[..., None])[..., 0]
    return gradient - first + (rate @ first[..., None])[..., 0]
