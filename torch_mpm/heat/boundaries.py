"""Boundary terms and sources of heat: flux, convection, radiation, held temperatures, sources.

Without any of these a body is insulated. Each acts on the nodes of an implicit step through `HeatNodes`; anything with
a method `apply(nodes)` can stand in the list of a `Heat`. Quantities of a surface are distributed to the nodes by
points x_s with areas A_s (`Surface`), h_i = Σ_s A_s η_s N_i(x_s), or by the free surface of the particles
(`FreeSurface`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..boundaries import Obstacle
from ..errors import NUMBER_OR_TENSOR, check_number, check_real, shape_of
from ..geometry.per_scene import per_node
from ..geometry.shapes import with_gradient
from ..geometry.timed import tried
from ..geometry.vectors import unit
from ..grid.bspline import base_node, bspline
from ..grid.grid import Blocks, Grid
from ..grid.topology import PADDING
from ..laws.compiled import check_value
from ..laws.parameters import TensorModule, Value, evaluate, needs_no_scenes
from ..ops import scatter
from ..ops.pointwise import pointwise
from ..step.clocks import time_like

if TYPE_CHECKING:
    from ..state.state import State

FROM_TIME = "what a function of the time returns"
STEFAN_BOLTZMANN = 5.670374419e-8
"""σ [W/(m² K⁴)] (CODATA 2018)."""

LIGHT = 1e-3
"""Heat capacity of a node, relative to the largest around a point of a surface, below which it gets less than its
weight: heat into nearly empty nodes would make them hotter than the solve can bear.
"""

Number = float | Tensor
Timed = Number | Callable[[float | Tensor], Number]
"""A number, a tensor, or a function of the time [s] that returns one of them."""


def area_rounding(grid: Grid, dtype: torch.dtype) -> float:
    """Area of a node that is rounding, of places and of the sum [m²] (m in 2-D).

    Inside of evenly spread particles the sum Σ_p V_p ∇N_i is only that. The derivative of its length would be its
    direction, which means nothing.
    """
    return torch.finfo(dtype).eps * (64 * grid.dx + 16 * grid.reach) * grid.dx ** (grid.dim - 2)


@dataclasses.dataclass
class HeatNodes:
    """Nodes of one implicit step, to which boundary terms contribute.

    Attributes:
        blocks: active blocks of the particles.
        state: the particles before the step.
        volume: their present volumes [P] [m³].
        conductance: conductivity times volume κ V of the particles [P] [W m²/K in 3-D].
        heat_capacity: heat capacity of the nodes [N] [J/K]; zero where there is no matter.
        theta: temperature of the nodes [N] [K], relative to `reference`.
        reference: absolute temperature that temperatures are relative to [K].
        source: heat into the nodes [N] [W], or None.
        exchange: derivative of the heat that leaves them by their temperature [N] [W/K], or None.
        fixed: nodes whose temperature is held at `held` [N] [K], bool [N], or None.
        share: remaining fraction of the conductivity of particles [P], or None for all of it.
        layers: exchange that replaces the rest, see `add_layer`.
        held_surfaces: obstacles of all `FixedSurface` of the step, in their order.
    """

    blocks: Blocks
    state: State
    volume: Tensor
    conductance: Tensor
    heat_capacity: Tensor
    theta: Tensor
    reference: float = 0.0
    source: Tensor | None = None
    exchange: Tensor | None = None
    fixed: Tensor | None = None
    held: Tensor | None = None
    share: Tensor | None = None
    layers: list[tuple[Tensor, Number]] = dataclasses.field(default_factory=list)
    held_surfaces: Sequence[Obstacle] = ()

    @property
    def time(self) -> float | Tensor:
        """Time of the step [s]."""
        return self.state.time

    @functools.cached_property
    def free_area(self) -> Tensor:
        """|Σ_p V_p ∇N_i(x_p)| [N] [m²], see `FreeSurface`."""
        grid = self.blocks.grid
        nothing, gradient = pointwise("surface_normals", grid.dim, self.volume)
        normal = scatter(self.blocks, self.state.x, nothing, gradient=gradient)
        least = area_rounding(grid, normal.dtype)
        normal = normal.where(~(normal.square().sum(1, keepdim=True) <= least**2), 0.0)  # NaN stays
        (area,) = pointwise("length", grid.dim, normal)
        return area

    @functools.cached_property
    def feet_on_held_surfaces(self) -> list[Tensor]:
        """The points of each of `held_surfaces` that are nearest to the particles [P, D] [m]; without gradient."""
        x = self.state.x.detach()

        def foot(region: Obstacle) -> Tensor:
            def distance(points: Tensor) -> Tensor:
                return region.signed_distance(points, self.state.scene, self.time)

            away, gradient = with_gradient(distance, x)
            return (x - away[:, None] * unit(gradient)).detach()

        return [foot(region) for region in self.held_surfaces]

    def scene(self) -> Tensor | None:
        """Scene of each node, int32 [N]; None for one scene."""
        return None if self.state.scene is None else self.blocks.node_scene()

    def per_node(self, value: Timed, name: str = "") -> Number:
        """A number, or a tensor [], [1], [B] or [N], or a function of the time that returns one, as a number or [N].

        Raises:
            ValueError: for another shape, with the name of the value.
        """
        value = _at(value, time_like(self.time, self.theta))
        if not isinstance(value, Tensor) or value.shape == self.theta.shape:
            return value.to(self.theta) if isinstance(value, Tensor) else value
        scenes = self.blocks.grid.scenes
        if value.shape not in ((), (1,), (scenes,)):
            what = f"{name}, a value at nodes," if name else "a value at nodes"
            raise ValueError(f"{what} must have shape [], [1], [B] = [{scenes}] or [N], got {shape_of(value)}")
        return per_node(value.to(self.theta), 0, self.scene())

    def add_source(self, power: Tensor) -> None:
        """Add heat [N] [W] into the nodes."""
        self.source = power if self.source is None else self.source + power

    def add_exchange(self, coefficient: Tensor, ambient: Number) -> None:
        """Add heat coefficient (ambient − θ) with coefficient [N] [W/K], evaluated at the end of the step."""
        self.add_linear(coefficient, coefficient * ambient)

    def add_linear(self, coefficient: Tensor, power: Tensor) -> None:
        """Add heat power − coefficient θ [N] [W], evaluated at the end of the step."""
        if self.exchange is not None and self.source is not None:  # Both in one kernel.
            self.exchange, self.source = torch._foreach_add([self.exchange, self.source], [coefficient, power])
            return
        self.exchange = coefficient if self.exchange is None else self.exchange + coefficient
        self.add_source(power)

    def hold(self, where: Tensor, temperature: Number) -> None:
        """Hold nodes, bool [N], at a temperature [K]; nodes that are already held are unchanged."""
        value = torch.where(where, torch.zeros_like(self.theta) + temperature, 0)
        if self.fixed is None or self.held is None:
            self.fixed, self.held = where, value
        else:
            self.held = torch.where(self.fixed, self.held, value)
            self.fixed = self.fixed | where

    def add_layer(self, share: Tensor, rate: Tensor, temperature: Number) -> None:
        """Reduce the conductivity of particles to a share [P], and add the exchange κ V rate (temperature − θ).

        Args:
            share: s [P] of the distance a from a surface.
            rate: s'/a [P] [1/m²]. Where layers overlap, s is the product of their shares.
            temperature: temperature of the surface [K], a number or [N].
        """
        before = self.share
        self.layers = [(other * share, value) for other, value in self.layers]
        self.layers.append((rate if before is None else rate * before, temperature))
        self.share = share if before is None else before * share

    def left_conductance(self) -> Tensor:
        """κ V of the particles [P] without the share that layers replace; adds their exchange.

        The remaining share becomes negative where a layer exchanges more (csrc/pointwise/heat.h); H + X stays positive.
        """
        if self.share is None:
            return self.conductance
        grid, left = self.blocks.grid, self.share * self.conductance
        for rate, temperature in self.layers:
            given, left = pointwise("heat_exchange", grid.dim, left, self.conductance, rate, grid.inverse_inertia)
            self.add_exchange(scatter(self.blocks, self.state.x, given[:, None])[:, 0], temperature)
        return left


# ---- surfaces


class Surface(TensorModule):
    """Points that represent a surface.

    Args:
        points: x_s [S, D] [m].
        area: A_s [m²] (m in 2-D): a number for each of them, or [S].
        scene: scene of each point, int32 [S]; None where the grid has one scene.

    A point distributes its heat in proportion to N_i(x_s) to the surrounding nodes with matter, and less to nearly
    empty nodes; a point without matter around it contributes nothing. Points do not move: replace `points` between
    steps if the surface moves.

    Raises:
        ValueError: for wrong shapes, points that are not finite, or an area that is not finite or is negative.
    """

    def __init__(self, points: Tensor, area: Number, scene: Tensor | None = None) -> None:
        if not isinstance(points, Tensor) or points.dim() != 2 or points.shape[1] not in (2, 3):
            raise ValueError(f"points must have shape [S, 2] or [S, 3], got {shape_of(points)}")
        if not points.is_floating_point():
            raise TypeError(f"points must be a floating tensor, got {points.dtype}")
        if callable(area) and not isinstance(area, Tensor):
            raise TypeError(f"area must be {NUMBER_OR_TENSOR}, got {shape_of(area)}")
        if isinstance(area, Tensor) and area.shape not in ((), points.shape[:1]):
            raise ValueError(f"area must be a number or have shape [S] = [{points.shape[0]}], got {shape_of(area)}")
        if points.is_meta or not bool(points.detach().isfinite().all()):
            raise ValueError("points must be finite, and some are NaN or infinite")
        self.area: Number = _checked("area", area, "not negative", lambda v: v >= 0)  # type: ignore[assignment]
        if scene is not None and (not isinstance(scene, Tensor) or scene.shape != points.shape[:1]):
            raise ValueError(f"scene must have shape [S] = [{points.shape[0]}], got {shape_of(scene)}")
        if scene is not None and scene.dtype != torch.int32:
            raise TypeError(f"scene must be int32, got {scene.dtype}")
        self.points, self.scene = points, scene

    def integrate(self, nodes: HeatNodes, density: Timed, name: str = "density") -> Tensor:
        """∫ N_i density dA [N] of a density per area: a number, a tensor [], [1], [S] or, of points with scenes,
        [B], or a function of the time.

        Raises:
            ValueError: for another shape, with the name of the density.
        """
        points = self.points.to(nodes.theta)
        density = self._of_points(_at(density, time_like(nodes.time, nodes.theta)), nodes.blocks.grid.scenes, name)
        rows, weight = node_weights(nodes.blocks, points, self.scene)
        matter = nodes.heat_capacity[rows]
        most = matter.amax(1, keepdim=True) if matter.shape[1] else matter
        weight = weight * (matter / torch.where(most > 0, LIGHT * most, 1)).clamp_max(1)
        total = weight.sum(1, keepdim=True)
        weight = torch.where(total > 0, weight / torch.where(total > 0, total, 1), 0)
        amount = (torch.ones_like(points[:, 0]) * self.area * density).to(points)
        given = amount[:, None] * weight
        return torch.zeros_like(nodes.theta).index_add(0, rows.reshape(-1), given.reshape(-1))

    def _of_points(self, density: Number, scenes: int, name: str) -> Number:
        """A density that is the same for all points, or one per point, [S]."""
        if not isinstance(density, Tensor) or needs_no_scenes(density, len(self.points)):
            return density
        if self.scene is None or density.shape != (scenes,):
            batch = "" if self.scene is None else f", [B] = [{scenes}]"
            raise ValueError(
                f"{name} must have shape [], [1]{batch} or [S] = [{len(self.points)}], got {shape_of(density)}"
            )
        return density.index_select(0, self.scene.clamp(0, scenes - 1))


class FreeSurface(TensorModule):
    """Present surface of the particles: the area of a node is |Σ_p V_p ∇N_i(x_p)| = |∮ N_i n dA|.

    Exact for a flat surface of evenly spread particles. Disorder inside a body adds a spurious area per node, a share
    of V/dx similar to that of the disorder. A side that touches an obstacle counts too.
    """

    def integrate(self, nodes: HeatNodes, density: Timed, name: str = "density") -> Tensor:
        """∫ N_i density dA [N] of a density per area: a number, a tensor [], [1], [B] or [N], or a function of
        the time.

        Raises:
            ValueError: for another shape, with the name of the density.
        """
        return nodes.free_area * nodes.per_node(density, name)


def node_weights(blocks: Blocks, x: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor]:
    """Rows [S, K] of the nodes around any points [S, D], and their weights N_i [S, K], zero for inactive nodes."""
    grid = blocks.grid
    cells = torch.stack([(x[:, a] - grid.lower[a]) / grid.dx + PADDING for a in range(grid.dim)], 1)
    steps = torch.arange(grid.order + 1, device=x.device)
    node = base_node(cells.detach(), grid.order)[:, None] + torch.cartesian_prod(*[steps] * grid.dim)
    weight = bspline(node - cells[:, None], grid.order).prod(-1)
    rows = blocks.rows_at(node, scene)
    return rows.clamp_min(0), torch.where(rows >= 0, weight, 0)


# ---- terms


class Term(TensorModule):
    """Boundary term with `apply(nodes)`, a module with the tensors and parameters of its arguments.

    Attributes:
        timed: names of arguments that may be functions of the time, or obstacles that move.
    """

    timed: tuple[str, ...] = ()

    @property
    def reads_time(self) -> bool:
        """Whether it depends on the time."""
        values = (getattr(self, name) for name in self.timed)
        return any(getattr(value, "reads_time", callable(value)) for value in values)


class Flux(Term):
    """A heat flux η = κ ∇θ · n into the body through a surface.

    Args:
        surface: a `Surface` or a `FreeSurface`.
        flux: η [W/m²], positive into the body: a number, a tensor [], [B] or per point [S], or a function of the time.

    Raises:
        ValueError: for a flux that is not finite.
    """

    timed = ("flux",)

    def __init__(self, surface: Surface | FreeSurface, flux: Timed) -> None:
        self.surface, self.flux = _surface(surface), _checked("flux", flux)

    def apply(self, nodes: HeatNodes) -> None:  # type: ignore[override]
        nodes.add_source(self.surface.integrate(nodes, self.flux, "flux"))


class Convection(Term):
    """Exchange with a fluid around the body, coefficient (ambient − θ) per area (Robin), implicit.

    Args:
        surface: a `Surface` or a `FreeSurface`.
        coefficient: [W/(m² K)], not negative: a number, a tensor [], [B] or per point [S], or a function of the time.
        ambient: temperature of the fluid [K]: a number, a tensor [] or [B], or a function of the time.

    Raises:
        ValueError: for a negative coefficient, or values that are not finite.
    """

    timed = ("coefficient", "ambient")

    def __init__(self, surface: Surface | FreeSurface, coefficient: Timed, ambient: Timed) -> None:
        self.surface, self.ambient = _surface(surface), _checked("ambient", ambient)
        self.coefficient = _checked("coefficient", coefficient, "not negative", lambda v: v >= 0)

    def apply(self, nodes: HeatNodes) -> None:  # type: ignore[override]
        coefficient = self.surface.integrate(nodes, self.coefficient, "coefficient")
        nodes.add_exchange(coefficient, nodes.per_node(self.ambient, "ambient"))


class Radiation(Term):
    """Exchange with surroundings by radiation, ε σ (T_a⁴ − T⁴) per area, linearised about the temperature of the step.

    Args:
        surface: a `Surface` or a `FreeSurface`.
        emissivity: ε in [0, 1]: a number, a tensor [], [B] or per point [S], or a function of the time.
        ambient: temperature of the surroundings [K], relative to the reference as all temperatures, which `Heat` needs
            to know in kelvin: a number, a tensor [] or [B], or a function of the time.

    Raises:
        ValueError: for an emissivity outside [0, 1], or an ambient temperature that is not finite.
    """

    timed = ("emissivity", "ambient")

    def __init__(self, surface: Surface | FreeSurface, emissivity: Timed, ambient: Timed) -> None:
        self.surface, self.ambient = _surface(surface), _checked("ambient", ambient)
        self.emissivity = _checked("emissivity", emissivity, "between 0 and 1", lambda v: (v >= 0) & (v <= 1))

    def apply(self, nodes: HeatNodes) -> None:  # type: ignore[override]
        emitting = self.surface.integrate(nodes, self.emissivity, "emissivity")
        ambient = nodes.per_node(self.ambient, "ambient")
        linear = pointwise(
            *("heat_radiation", nodes.blocks.grid.dim),
            *(emitting, STEFAN_BOLTZMANN, nodes.theta, ambient, nodes.reference),
        )
        nodes.add_linear(linear[0], linear[1])


class Fixed(Term):
    """Nodes that are held at a temperature (Dirichlet).

    Args:
        region: an obstacle of `torch_mpm.boundaries`, moving or not, whose inside nodes are held; or a function of node
            positions [N, D] [m] that returns bool [N]. The surface is resolved to one node distance. Where it lies on
            nodes, it appears 0.17 dx farther away from adjacent matter (cubic kernel 0.36 dx; 0.16 and 0.29 where
            matter extends into the region), because splines smooth the kink of the temperature there; between nodes, or
            where matter does not quite reach it, many times farther. See `FixedSurface`.
        temperature: [K]: a number, a tensor [] or [B], or a function of the time.

    Raises:
        ValueError: for a temperature that is not finite.
    """

    timed = ("region", "temperature")

    def __init__(self, region: Obstacle | Callable[[Tensor], Tensor], temperature: Timed) -> None:
        if not callable(region) or isinstance(region, type):
            raise TypeError(f"region must be an obstacle or a function of positions [N, D], got {shape_of(region)}")
        self.region, self.temperature = region, _checked("temperature", temperature)

    def apply(self, nodes: HeatNodes) -> None:  # type: ignore[override]
        positions = nodes.blocks.node_positions(nodes.theta.dtype)
        if isinstance(self.region, Obstacle):
            self.region.check_scenes(nodes.blocks.grid.dim, nodes.blocks.grid.scenes)
            where = self.region.contains(positions, nodes.scene(), nodes.time)
        else:
            where = self.region(positions)
            if not isinstance(where, Tensor) or where.shape != nodes.theta.shape or where.dtype != torch.bool:
                raise ValueError(f"region must return bool [N] = {list(nodes.theta.shape)}, got {shape_of(where)}")
        nodes.hold(where & (nodes.heat_capacity > 0), nodes.per_node(self.temperature, "temperature"))


class FixedSurface(Term):
    """Surface of an obstacle that is held at a temperature (Dirichlet), for any position between the nodes.

    Matter at a distance a < w from it conducts with the share s = 1 − (1 − a²/w²)³ of its conductivity, and exchanges
    the heat κ (s'/a) (temperature − θ) per volume with the surface itself. This exchange equals the missing part of ∇ ·
    (s κ ∇θ) where θ is linear, and on average over the layer for any θ. So the layer hardly affects the temperature.
    Its error is of first order in dx with a small factor: the error of a steady linear temperature is at most its
    change over 0.042 dx with 4 or 9 particles per cell, 0.22 dx with one, for any position of the surface between the
    nodes. In the mean it matches that of the surface within 0.02 dx, and within 0.1 dx with a gap of 0.5 dx to the
    matter. With FLIP the error is 1.2 dx, because nothing smooths the particles (benchmarks/results/heat_fronts.md).
    Matter inside the obstacle is held as at the surface. Several such regions act as one: a region has no surface where
    its nearest point lies on another one, as at the seam of two boxes.

    Args:
        region: an obstacle of `torch_mpm.boundaries`, wherever it moves.
        temperature: [K]: a number, a tensor [] or [B], or a function of the time.

    Raises:
        ValueError: for a region that is not an obstacle, or a temperature that is not finite.
    """

    timed = ("region", "temperature")

    WIDTH = 2.0
    """w in dx: below 1.5 the rows of particles become visible."""

    def __init__(self, region: Obstacle, temperature: Timed) -> None:
        if not isinstance(region, Obstacle):
            raise ValueError(f"region must be an obstacle of torch_mpm.boundaries, got {type(region).__name__}")
        self.region, self.temperature = region, _checked("temperature", temperature)

    def apply(self, nodes: HeatNodes) -> None:  # type: ignore[override]
        width, state = self.WIDTH * nodes.blocks.grid.dx, nodes.state
        self.region.check_scenes(nodes.blocks.grid.dim, nodes.blocks.grid.scenes)
        distance = self.region.signed_distance(state.x, state.scene, nodes.time).to(state.x)
        covered = self._covered(nodes, distance)
        if covered is not None:
            distance = torch.where(covered, 2 * width, distance)
        share, rate = pointwise("heat_layer", nodes.blocks.grid.dim, distance, width)
        nodes.add_layer(share, rate, nodes.per_node(self.temperature, "temperature"))

    def _covered(self, nodes: HeatNodes, distance: Tensor) -> Tensor | None:
        """Particles outside whose nearest point of the region lies on or in another held one, bool [P]. Where the
        nearest points of two regions are one, that of the first counts. None where there is no other region."""
        regions = list(nodes.held_surfaces)
        if len(regions) < 2:
            return None
        mine = next(k for k, region in enumerate(regions) if region is self.region)
        feet, scene, time = nodes.feet_on_held_surfaces, nodes.state.scene, nodes.time
        with torch.no_grad():
            near = 1e-4 * nodes.blocks.grid.dx
            covered = torch.zeros_like(distance, dtype=torch.bool)
            for k, region in enumerate(regions):
                if k != mine:
                    same = (feet[k] - feet[mine]).norm(dim=1) <= near
                    on = region.signed_distance(feet[mine], scene, time) <= near
                    covered |= on & ~same if mine < k else on
        return covered & (distance > 0)


class Source(Term):
    """Heat from inside the matter.

    Args:
        power: [W/m³] of present volume: a number, a tensor [], [B] or [P], or a function of the temperature [P].

    Raises:
        ValueError: for a power that is not finite.
    """

    def __init__(self, power: Value) -> None:
        self.power = check_value("power", power, "finite", lambda v: v == v)

    def apply(self, nodes: HeatNodes) -> None:  # type: ignore[override]
        power = evaluate("power", self.power, nodes.state) * nodes.volume
        nodes.add_source(scatter(nodes.blocks, nodes.state.x, power[:, None])[:, 0])


def _surface(surface: Any) -> Surface | FreeSurface:
    if not isinstance(surface, (Surface, FreeSurface)):
        raise TypeError(f"surface must be a Surface or a FreeSurface, got {shape_of(surface)}")
    return surface


def _at(value: Timed, time: float | Tensor) -> Number:
    """A number or a tensor, given or returned by a function of the time."""
    if isinstance(value, (float, Tensor)):
        return value
    if not callable(value):
        return _returned(value)
    if not isinstance(time, Tensor) or time.dim() == 0:
        return _returned(value(time))
    number, problem = tried(lambda: _returned(value(time)))
    if problem is None and number is not None:
        return number
    # A function of numbers, where scenes have times of their own.
    rows, _ = tried(lambda: [torch.as_tensor(_returned(value(one))).to(time).reshape(()) for one in time.unbind()])
    if rows is None:
        assert problem is not None
        raise problem from None
    return torch.stack(rows)


def _returned(value: Any) -> Number:
    return value if isinstance(value, Tensor) else float(check_real(FROM_TIME, value, NUMBER_OR_TENSOR))


def _checked(name: str, value: Timed, expected: str = "", holds: Callable[[Any], Any] = lambda v: v == v) -> Timed:
    """A number or tensor that is finite and for which the condition holds; a function of the time is not evaluated."""
    expected = f"{expected} and finite" if expected else "finite"
    if isinstance(value, Tensor):
        if value.is_complex() or value.dtype == torch.bool:
            raise TypeError(f"{name} must have a real dtype, got {value.dtype}")
        if value.is_meta:
            raise ValueError(f"{name} must have values, got a tensor on the device meta")
        if not bool((holds(value.detach()) & value.detach().isfinite()).all()):
            raise ValueError(f"{name} must be {expected}, got {value}")
        return value
    if callable(value):
        return value
    kinds = "a number, a tensor or a function of the time"
    return float(check_number(name, value, expected, lambda v: math.isfinite(v) and bool(holds(v)), kinds))
