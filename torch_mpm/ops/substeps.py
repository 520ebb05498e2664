"""Ops behind `torch_mpm.rollout`: n steps in one call, and their adjoint. Fake kernels and autograd.

    torch.ops.torch_mpm.substeps(x, v, mass, volume, C, F, J, residual, history, scene, ids, material, previous_status,
        laws, options, parameters, variables, n, dt, apic, velocity_shares, wants_C, stress_form, gravity, wall_kind,
        wall_plane, wall_friction, obstacles, data, shape, sizes, contact, obstacle_scene, start, end, time, scenes,
        max_blocks, grows, resident, records, impulse, scene_dt, scene_time, heat, heat_options, heat_scalars,
        held_obstacles, heat_terms, heat_boundaries, thermal, tables, lattice, layout, schedule=-1)
        -> (x, v, C, F, J, history, status, impulse, time, residual, heat, heat_status, record)

`torch_mpm.substeps_arguments(step, state, n, dt)` returns the arguments; docs/training.md has an example.

Particles and their history are those of `State`, the grid's arguments those of `activate`, `grid_update` and `contact`.
`laws` are names of `LAWS`, one per material, separated by commas, optionally followed by a plus and further laws whose
stress is added; their options, parameters and history variables are concatenated, with `variables` history variables
for each law. The time step dt [s] is one of the parameters of rate-dependent laws. `obstacles` is the table of
`contact`, or one for each substep [n, 1 or B, K, width] with the positions at its time. Absent results are None;
`history` has the entries of all laws side by side, [P, m]. The impulses on obstacles and walls are added to `impulse`,
where it is given. `velocity_shares` are two numbers from 0 to 1. The first is the share of FLIP: of the velocities of
particles, minus those of the nodes before the forces, it is added to the result of G2P. The second is the share of node
velocities that damping leaves after the walls and before the obstacles, 1 without damping. Scenes with separate clocks
have the time steps dt times `scene_dt` and begin at `scene_time`, both [B], the latter in float64. With `grows` the
pool grows with the scene on the CPU; otherwise the op stops on the CPU where it is full, and the status reports it. On
CUDA the host waits only to stay less than a fraction of a second ahead of the device. With `resident` batches of small
scenes may be computed on CUDA by one thread block per scene; sums, also those of gradients, may then round differently.
With `records` all inputs of the adjoint are stored in `record`, opaque bytes, and no step is recomputed, except where
impulses are counted or the pool had to grow. `residual` is `State.x_residual`; without it positions are not
compensated.

Heat is conducted where `heat` is not empty: temperature [P], conductivity and specific heat; for materials that melt
also liquid fraction [P], melting point and latent heat; and last, for the first two numbers in `TRANSFERS` of
torch_mpm.heat, the temperature gradient [P, D]. Parameters are [], [1], [B] or [P]. Where `laws` is empty the body is
at rest: a call without gradients only changes its heat.
`heat_options` are the number of the transfer, the maximum number of iterations, and whether the last of the
`held_obstacles` holds its surface (1) instead of the nodes in it; `heat_scalars` are tolerance, reference [K],
the share of the dissipated energy that becomes heat, and the tolerance of the adjoint solves.
`heat_terms` of the free surface, at most 15, are 0 for a flux, 1 for convection and 2 for radiation. `heat_boundaries`
are the temperatures of the held obstacles [K, B], two numbers of each term [K, B, 2] (flux, coefficient or emissivity
times the constant of Stefan and Boltzmann; and ambient temperature), and the power of a source [W/m³]; absent ones have
the shape [0]. The columns of the result `heat` [P, m] are temperature, gradient and liquid fraction; `heat_status`
[B, 3] has the number of solves that missed the tolerance, their largest residual [K], and the largest diffusion number
of particles whose liquid fraction changed.

Where temperatures change, a name in `laws` may be that of a solid and, after a ~, of its liquid, as `Melting` has them.
`thermal` are records of three numbers: a law, one of its parameters or -1 for the linear expansion of its material or
-2 for the coherency of a liquid, and one of the `tables` [2, K], increasing temperatures and values; K = 1 is a number.
The op is differentiable by the values of tables; a coherency has no gradient, and neither have temperatures.

    torch.ops.torch_mpm.substeps_with_bodies(bodies, body_shape, body_sizes, body_contact, body_owner, body_joint,
        max_iterations, tolerance, *arguments of substeps) -> (*results of substeps, rows, report)

are the steps with free bodies as `torch_mpm::free_bodies` takes them, which act in each step after the obstacles: their
rows at the end, and the report with the most iterations and the largest residuals of a step. It has no adjoint.

`schedule` is the number of a schedule in the order of csrc/rollout/plan.h; -1 chooses the fastest. A schedule that does
not support the call is an error with the reason; its sums may round differently.

    torch.ops.torch_mpm.plan_substeps(schedule, *facts) -> (schedule, max_blocks, steps, order, reasons)
    torch.ops.torch_mpm.latest_schedule(x) -> int

The first plans a call of any device by its facts (`torch_mpm.rollouts.facts.Facts`), without tensors: its schedule, the
blocks of its pool or -1, its steps at most, the order of its particles, and a line "schedule: reason" for each of the
others. The second returns the schedule of the latest call of this thread on the device of a tensor.

Several times a second both ops run the handlers of signals, on the main thread. Where one of them raises, the op ends
with a RuntimeError and without a result; `torch_mpm.rollout` raises the exception of the handler.

Differentiable once, with respect to x, v, mass, volume, C, F, J, history, parameters, gravity, obstacles, impulse,
heat, heat_boundaries, tables and scene_dt, the last without FLIP and without the dependence of obstacles on the time.
Autograd stores the arguments of a call and the record, if any: 2 D + 2 D² numbers per particle of a solid (24 in 3-D)
and its history.

    torch.ops.torch_mpm.substeps_backward(grads, needs, record, *arguments of substeps)
        -> (x, v, C, F, J, history, mass, volume, parameters, gravity, obstacles, dt, heat, heat_parameters,
            heat_boundaries, heat_status, tables)

recomputes the steps, where there is no record, and then computes their adjoints in reverse order; a record must be that
of `substeps`, and its contents are not checked. `grads` are the adjoints of the results x, v, C, F, J, history, impulse
and heat, None where they are zero: one list, since an op has at most 64 arguments. Meanwhile it stores the inputs of
each step: for a solid 2 D + 3 D² numbers per particle and step (33 in 3-D), D² more where a law is plastic, 2 D² + 2
more where one melts, the history and the columns of heat; and the grid of each step where that is at most half as much.
The node temperatures of each step are solved again where no grid is stored, and those of its adjoint once. The adjoints
are [P, ...], those of the parameters [P, number of parameters] and that of gravity, over the time step, a sum for each
block of the grids of all scenes [B * blocks, D]; that of the time step, but for gravity, is [P]. Those of the
parameters of heat are [P, 5], in the order of conductivity, specific heat, melting point, latent heat and power;
`heat_boundaries` [B, m] are those of both numbers of each term and of the temperatures of the held obstacles;
`heat_status` is that of the adjoint solves; `tables` [P, m] are those of the values of all tables one after another.
The bits of `needs` (`MASS`, `VOLUME`, `PARAMETERS`, `GRAVITY`, `OBSTACLES`, `TIME_STEP`, `HEAT_PARAMETERS`,
`HEAT_BOUNDARIES`, `TABLES`) select among the adjoints from that of mass on.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..signals import interruptible
from .arguments import refuse_vmap, sizes, soa_empty, sum_by_scene
from .autograd import dispatch, register_autograd
from .free_bodies import fake_bodies
from .law import _entries, _of_history, _of_parameters

MASS, VOLUME, PARAMETERS, GRAVITY, OBSTACLES, TIME_STEP, HEAT_PARAMETERS, HEAT_BOUNDARIES, TABLES = (
    1 << k for k in range(9)
)
"""Bits of `needs` in csrc/rollout/substeps_backward.op.cpp."""

_SCHEMA = {a.name: str(a.type) for a in torch.ops.torch_mpm.substeps.default._schema.arguments}
ARGUMENTS = tuple(_SCHEMA)
"""Names of the arguments of `substeps`."""
_TENSORS = [name for name, kind in _SCHEMA.items() if kind in ("Tensor", "Optional[Tensor]")]
_ADJOINTS = ("x", "v", "C", "F", "J", "history", "mass", "volume", "parameters", "gravity", "obstacles", "dt", "heat",
             "heat_parameters", "heat_boundaries", "heat_status", "tables")  # fmt: skip
_LISTS = ("history", "parameters", "heat", "heat_boundaries", "tables")
"""Lists of tensors that the op is differentiable by."""


# ---- fake kernels: shapes and strides only


@torch.library.register_fake("torch_mpm::substeps")
def _fake(
    x: Tensor,
    v: Tensor,
    mass: Tensor,
    volume: Tensor,
    C: Any,
    F: Any,
    J: Any,
    residual: Any,
    history: list[Tensor],
    *rest: Any,
) -> tuple[Tensor | None, ...]:
    P, D = sizes(x, "x", 2)
    given = dict(zip(ARGUMENTS[9:], rest, strict=False))  # torch leaves a default at the end out
    wants_C, scenes, impulse = given["wants_C"], given["scenes"], given["impulse"]
    return (
        soa_empty(x, (P, D)),
        soa_empty(x, (P, D)),
        soa_empty(x, (P, D, D)) if wants_C else None,
        None if F is None else soa_empty(x, (P, D, D)),
        None if J is None else soa_empty(x, (P,)),
        soa_empty(x, (P, _entries(history))) if history else None,
        x.new_empty((1 + scenes, 8), dtype=torch.int32),
        None if impulse is None else impulse.new_empty(impulse.shape),
        None if given["scene_time"] is None else x.new_empty(scenes, dtype=torch.float64),
        None if residual is None else soa_empty(x, (P, D)),
        None if not given["heat"] else soa_empty(x, (P, _columns_of_heat(given, D))),
        None if not given["heat"] else x.new_empty((scenes, 3), dtype=torch.float64),
        _fake_record(x) if given["records"] and impulse is None else None,
    )


@torch.library.register_fake("torch_mpm::substeps_with_bodies")
def _bodies_fake(bodies, *arguments):
    return (*_fake(*arguments[7:]), *fake_bodies(bodies))


def _columns_of_heat(given: dict[str, Any], dim: int) -> int:
    """Temperature, gradient and liquid fraction."""
    count = len(given["heat"])
    return 1 + (dim if count % 3 == 1 else 0) + (count >= 6)


def _fake_record(x: Tensor) -> Tensor:
    return x.new_empty(torch.library.get_ctx().new_dynamic_size(), dtype=torch.uint8)


@torch.library.register_fake("torch_mpm::latest_schedule")
def _latest_schedule_fake(like):
    raise ValueError(f"like must be on a device that computes steps, got {like.device}")


@torch.library.register_fake("torch_mpm::substeps_backward")
def _backward_fake(grads, needs, record, *arguments):
    given = dict(zip(_SCHEMA, arguments, strict=False))
    x, history = given["x"], given["history"]
    P, D = sizes(x, "x", 2)
    blocks = given["scenes"] * math.prod(given["layout"][2:])
    numbers = 2 * len(given["heat_terms"]) + len(given["held_obstacles"])
    shapes = {"x": (P, D), "v": (P, D), "C": (P, D, D), "F": (P, D, D), "J": (P,)}
    return (
        *(None if given[name] is None else soa_empty(x, shape) for name, shape in shapes.items()),
        soa_empty(x, (P, _entries(history))) if history else None,
        soa_empty(x, (P,)) if needs & MASS else None,
        soa_empty(x, (P,)) if needs & VOLUME else None,
        soa_empty(x, (P, len(given["parameters"]))) if needs & PARAMETERS else None,
        x.new_empty(blocks, D) if needs & GRAVITY and given["gravity"] is not None else None,
        torch.empty_like(given["obstacles"]) if needs & OBSTACLES and given["obstacles"] is not None else None,
        soa_empty(x, (P,)) if needs & TIME_STEP else None,
        soa_empty(x, (P, _columns_of_heat(given, D))) if given["heat"] else None,
        soa_empty(x, (P, 5)) if needs & HEAT_PARAMETERS and given["heat"] else None,
        x.new_empty((given["scenes"], numbers)) if needs & HEAT_BOUNDARIES and given["heat"] and numbers else None,
        x.new_empty((given["scenes"], 3), dtype=torch.float64) if given["heat"] else None,
        soa_empty(x, (P, sum(table.shape[1] for table in given["tables"]))) if needs & TABLES else None,
    )


# ---- autograd


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    given = dict(zip(_SCHEMA, inputs, strict=True)) | {"previous_status": None}  # The adjoint does not read these.
    lists = [given.pop(name) for name in _LISTS]  # Stored by autograd alone, so that checkpoints release them.
    ctx.lengths_of_lists = [len(tensors) for tensors in lists]
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(output[-1], *(given.pop(name) for name in _TENSORS), *(t for ts in lists for t in ts))
    ctx.given = given


def _saved(ctx: Any) -> tuple[Tensor | None, dict[str, Any]]:
    """The record, and the arguments by name."""
    record, *saved = ctx.saved_tensors  # Once: a checkpointed region unpacks a tensor only once.
    tensors, rest = dict(zip(_TENSORS, saved, strict=False)), saved[len(_TENSORS) :]
    lists = {}
    for name, length in zip(_LISTS, ctx.lengths_of_lists, strict=True):
        lists[name], rest = rest[:length], rest[length:]
    return record, ctx.given | tensors | lists


def _backward(ctx: Any, *grads: Any) -> Any:
    record, given = _saved(ctx)
    history, parameters, heat, boundaries, tables = (given[name] for name in _LISTS)
    wanted = dict(zip(_SCHEMA, ctx.needs_input_grad, strict=True))
    wants_dt = wanted["scene_dt"]
    needs = MASS * wanted["mass"] + VOLUME * wanted["volume"] + GRAVITY * (wanted["gravity"] or wants_dt)
    needs += TIME_STEP * wants_dt + HEAT_PARAMETERS * any([*wanted["heat"], *wanted["heat_boundaries"][2:]])
    needs += HEAT_BOUNDARIES * any(wanted["heat_boundaries"][:2]) + TABLES * any(wanted["tables"])
    needs += PARAMETERS * any(wanted["parameters"]) + OBSTACLES * wanted["obstacles"]
    by_impulse = None if grads[7] is None else grads[7].contiguous()
    arguments = (given[name] for name in _SCHEMA)
    op = torch.ops.torch_mpm.substeps_backward
    adjoints = interruptible(dispatch, op, [*grads[:6], by_impulse, grads[10]], needs, record, *arguments)
    found = dict(zip(_ADJOINTS, adjoints, strict=True)) | {"impulse": grads[7]}
    if found["heat_status"] is not None and hasattr(ctx, "report"):
        ctx.report(found["heat_status"])
    found["tables"] = _of_tables(found["tables"], tables, wanted["tables"])
    found["history"] = _of_history(found["history"], history, wanted["history"])
    found["parameters"] = _of_parameters(found["parameters"], parameters, wanted["parameters"], given["scene"])
    of_parameters, scene = found["heat_parameters"], given["scene"]
    found["heat"] = _of_heat(found["heat"], of_parameters, heat, wanted["heat"], scene)
    found["heat_boundaries"] = _of_boundaries(
        found["heat_boundaries"], of_parameters, boundaries, wanted["heat_boundaries"], scene
    )
    by_dt = found.pop("dt")
    if wants_dt:
        sums = sum_by_scene(by_dt, given["scene"], given["scenes"])  # One scene by default.
        found["scene_dt"] = given["dt"] * torch.cat([sums, sums.new_zeros(given["scenes"] - len(sums))])
    if found["gravity"] is not None:
        scenes, dim = given["gravity"].shape
        dt = given["dt"] if given["scene_dt"] is None else given["dt"] * given["scene_dt"][:, None]
        change = found["gravity"].reshape(scenes, math.prod(given["layout"][2:]), dim).sum(1)  # Of velocities, over dt.
        found["gravity"] = dt * change
        if wants_dt:
            found["scene_dt"] = found["scene_dt"] + given["dt"] * (given["gravity"] * change).sum(1)
    return tuple(found.get(name) if name in _LISTS or wanted[name] is True else None for name in _SCHEMA)


def _of_heat(
    fields: Tensor | None, parameters: Tensor | None, heat: list[Tensor], wanted: list[bool], scene: Tensor | None
) -> list[Tensor | None]:
    """Gradients of the tensors of `heat`, from those of the columns of the result and of the parameters [P, 5]."""
    if fields is None or parameters is None or not any(wanted):
        return [None] * len(heat)
    melts, dim = len(heat) >= 6, heat[-1].shape[1] if len(heat) % 3 == 1 else 0
    places = [1, 2, *([4, 5] if melts else [])]
    of_parameters = _of_parameters(parameters, [heat[k] for k in places], [wanted[k] for k in places], scene)
    grads = dict(zip(places, of_parameters, strict=True)) | {0: fields[:, 0]}
    if melts:
        grads[3] = fields[:, 1 + dim]
    if dim:
        grads[len(heat) - 1] = fields[:, 1 : 1 + dim]
    return [grads[k] if wanted[k] else None for k in range(len(heat))]


def _of_boundaries(
    sums: Tensor | None, parameters: Tensor | None, given: list[Tensor], wanted: list[bool], scene: Tensor | None
) -> list[Tensor | None]:
    """Gradients of `heat_boundaries`, from those of numbers and temperatures [B, m] and of the parameters [P, 5]."""
    grads: list[Tensor | None] = [None] * len(given)
    if sums is not None:
        first = 2 * given[1].shape[0] if given[1].numel() else 0
        grads[0] = sums[:, first:].T if wanted[0] else None
        grads[1] = sums[:, :first].unflatten(1, (-1, 2)).transpose(0, 1) if wanted[1] else None
    if parameters is not None and wanted[2:] == [True]:
        (grads[2],) = _of_parameters(parameters[:, 4:], given[2:], wanted[2:], scene)
    return grads


def _of_tables(by_values: Tensor | None, tables: list[Tensor], wanted: list[bool]) -> list[Tensor | None]:
    """Gradients of tables [2, K] from those of the values of all tables per particle; none of the temperatures."""
    if by_values is None:
        return [None] * len(tables)
    sums = by_values.sum(0).split([table.shape[1] for table in tables])
    return [torch.stack([torch.zeros_like(s), s]) if w else None for s, w in zip(sums, wanted, strict=True)]


def _no_second_derivatives(ctx: Any, *grads: Any) -> None:
    raise NotImplementedError(
        "steps of torch_mpm.rollout in one op have no second derivatives: differentiate them once, or take them one by "
        "one, in a loop of `state = step(state, dt)` or by rollout(lambda state, dt: step(state, dt), ...)"
    )


def _no_derivatives(ctx: Any, *grads: Any) -> None:
    raise NotImplementedError("steps with free bodies in one op have no derivative: torch_mpm.bodies.FreeBodies does")


register_autograd("substeps", _backward, _setup)
register_autograd("substeps_with_bodies", _no_derivatives)
register_autograd("substeps_backward", _no_second_derivatives)
refuse_vmap("substeps")
refuse_vmap("substeps_backward")
refuse_vmap("substeps_with_bodies")
