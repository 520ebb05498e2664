"""Valid calls of every op in `torch.ops.torch_mpm`, with few particles in two scenes."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.ops import LAWS
from torch_mpm.ops.heat_patches import Patches
from torch_mpm.ops.implicit import tangent_entries
from torch_mpm.ops.pointwise import FUNCTIONS, row_shape

PARTICLES = 37


def operators() -> list[str]:
    """Names of all ops."""
    schemas = torch._C._jit_get_all_schemas()
    return sorted({s.name.removeprefix("torch_mpm::") for s in schemas if s.name.startswith("torch_mpm::")})


def calls(dim: int, dtype: torch.dtype = torch.float64) -> list[tuple[str, dict[str, Any]]]:
    """(op, arguments by name) of at least one valid call of every op."""
    make = _Calls(dim, dtype)
    found = [
        *make.transfers(),
        *make.grid(),
        *make.heat(),
        *make.pointwise(),
        *make.laws(),
        *make.sand(),
        *make.implicit(),
        *make.rollouts(),
    ]
    return [(op, _named(op, values)) for op, values in found]


def _named(op: str, values: tuple[Any, ...]) -> dict[str, Any]:
    names = [a.name for a in getattr(torch.ops.torch_mpm, op).default._schema.arguments]
    return dict(zip(names, values, strict=False))  # missing ones have defaults


class _Calls:
    """Tensors of one dimension and dtype, and lists of (op, arguments in the order of the schema)."""

    def __init__(self, dim: int, dtype: torch.dtype) -> None:
        self.random = torch.Generator().manual_seed(dim)
        self.dim, self.dtype = dim, dtype
        P, D = PARTICLES, dim
        self.x = 0.1 + 0.8 * self.uniform(P, D)
        self.scene = torch.arange(P, dtype=torch.int32) % 2
        self.lattice = mpm.Grid(0.21, (0.0,) * D, (2.0,) * D, scenes=2)
        self.blocks = self.lattice.activate(self.x, self.scene)
        self.topology = self.blocks.packed
        self.N = self.blocks.node_count
        self.dt = 0.5 + self.uniform(2)
        self.F = torch.eye(D, dtype=dtype) + 0.1 * self.normal(P, D, D)

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.random, dtype=torch.float64).to(self.dtype)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.random, dtype=torch.float64).to(self.dtype)

    def transfers(self) -> list[tuple[str, tuple[Any, ...]]]:
        P, D, top, x = PARTICLES, self.dim, self.topology, self.x
        mass, J, v = self.uniform(P), self.uniform(P), self.normal(P, D)
        C, stress = self.normal(P, D, D), self.normal(P, D, D)
        given = (x, mass, v, C, stress, self.uniform(P), self.dt, 0.1, 0)
        rows, velocity = self.normal(self.N, 1 + D), self.normal(self.N, D)
        moving = (x, v, C, self.F, J, self.scene, self.dt, 0.1)
        activation = (x, self.scene, torch.arange(P), self.blocks.status, 2, 40, *self.lattice.packed)
        return [
            ("activate", activation),
            ("cell_order", (x, *top)),
            ("take", ([x, C, self.scene, mass > 0.5], torch.arange(P).flip(0))),
            ("p2g", (*given, *top)),
            ("p2g_backward", (rows, *given, 127, *top)),
            ("scatter", (x, v, C, stress, 2.0, *top)),
            ("gather", (x, rows, 2.0, True, True, *top)),
            ("g2p", (x, velocity, True, True, *top)),
            ("g2p_advance", (x, velocity, self.F, J, None, self.dt, 0.1, True, 1, *top)),
            ("position_gradient", (x, v, C, stress, velocity, 2.0, *top)),
            ("advance", moving),
            ("advance_backward", (v, C, mass, *moving, 31)),
        ]

    def grid(self) -> list[tuple[str, tuple[Any, ...]]]:
        D, top = self.dim, self.topology
        walls = ([2, 4] + [1, 3] * (D - 1), [0.0, 1.0] * D, [0.1] * 2 * D)
        rows, velocity = self.uniform(self.N, 1 + D), self.normal(self.N, D)
        update = (rows, self.normal(2, D), self.dt, 0.1, *walls, *top)
        table, data = self.uniform(2, 6, 10 if D == 2 else 17), self.uniform(8 + 2 * D + 1 + 2**D)
        data[8 + D + 1 : 8 + 2 * D + 1] = 2.0  # samples along each axis
        sizes = [0, 0, 0, 0, 8, 2 * D + 1 + 2**D]
        kinds = ([0, 1, 2, 3, 4, 5], sizes, [1, 2, 3, 2, 3, 1], [-1, -1, 0, 1, -1, -1], [0.0] * 6, [float("inf")] * 6)
        obstacles = (velocity, table, data, *kinds, self.uniform(2).double(), 0.1, *top)
        self.walls, self.obstacles = walls, obstacles[1 : -len(top) - 2]
        width, mass = D + (1 if D == 2 else 3), self.uniform(self.N)
        return [
            ("grid_update", update),
            ("grid_update_backward", (self.uniform(self.N, 1 + D), True, *update)),
            ("contact", obstacles),
            ("contact_backward", (self.normal(self.N, D), True, *obstacles)),
            ("wall_impulses", update),
            ("wall_impulses_backward", (self.normal(2, 2 * D, width).double(), True, *update)),
            ("contact_impulses", (mass, *obstacles)),
            ("contact_impulses_backward", (self.normal(2, 6, width).double(), True, mass, *obstacles)),
            ("free_bodies", (velocity, mass, *self.bodies(), 0.1, True, *top)),
        ]

    def bodies(self) -> tuple[Any, ...]:
        """Two free bodies of three obstacles in two scenes."""
        D, turns = self.dim, 1 if self.dim == 2 else 3
        rows = self.uniform(2, 2, 6 if D == 2 else 13).double()
        table = self.uniform(2, 3, 10 if D == 2 else 17)
        constants = 0.5 + self.uniform(2, 1 + turns + 2 * D).double()
        parts, forces = 0.1 * self.normal(3, D + turns).double(), self.normal(2, 2, D + turns).double()
        tensors = [rows, table, self.uniform(0), constants, parts, self.normal(1, D).double(), forces]
        return tensors, [1, 2, 1], [0, 0, 0], [3, 2, 1], [0, 0, 1], [1, 0], 20, 1e-5

    def heat(self) -> list[tuple[str, tuple[Any, ...]]]:
        x, N, blocks, top = self.x, self.N, self.blocks, self.topology
        conductance = self.uniform(PARTICLES)
        heat_capacity = mpm.scatter(blocks, x, self.uniform(PARTICLES, 1))[:, 0].contiguous()
        nodes = (heat_capacity, self.normal(N), self.normal(N), self.uniform(N), self.uniform(N) < 0.1)
        limits = (0.1 * self.uniform(2), 1e-6, 0.0, torch.tensor([20, 30], dtype=torch.int32), 40)
        patches = Patches(blocks, x, conductance, heat_capacity, heat_capacity > 0)
        return [
            ("heat_cg", (x, conductance, *nodes, self.dt, 0.5, *limits, 0, 1e-6, *top)),
            ("heat_cg", (x, conductance, *nodes, self.dt, 0.5, *limits, 1, 1e-6, *top)),
            ("heat_multigrid", (x, conductance, *nodes, self.dt, 0.5, *limits, 2, 1e-6, *top)),
            ("heat_operator", (x, conductance, nodes[1], *top)),
            ("heat_stencil", (x, conductance, *top)),
            ("heat_patches", (patches.inverse, patches.rows, patches.patches, self.normal(N))),
        ]

    def pointwise(self) -> list[tuple[str, tuple[Any, ...]]]:
        found = []
        for function, info in FUNCTIONS.items():
            rows, results = ([self.entries(shape) for shape in shapes] for shapes in (info.arguments, info.results))
            tensors = [self.uniform() if k and shape == (0, 0) else t  # for all rows
                       for k, (shape, t) in enumerate(zip(info.arguments, rows, strict=True))]  # fmt: skip
            places, wanted = list(range(len(tensors))), list(range(len(results)))
            call = function, self.dim, tensors, places, [0.5] * len(tensors)
            found += [
                ("pointwise", (*call, wanted)),
                ("pointwise_backward", (*call, results, wanted, places)),
                ("pointwise_second", (*call, results, wanted, rows, places, places)),
            ]
        return found

    def entries(self, shape: tuple[int, int]) -> Tensor:
        return self.uniform(*row_shape(shape, PARTICLES, self.dim))

    def laws(self) -> list[tuple[str, tuple[Any, ...]]]:
        P, D, found = PARTICLES, self.dim, []
        for law, info in LAWS.items():
            if D == 2 and not info.in_2d:
                continue
            shapes = itertools.islice(itertools.cycle(((2,), (P,), (), (1,))), len(info.parameters))
            p = [0.5 + self.uniform(*shape) for shape in shapes]
            q = [0.5 + (self.uniform(P, D, D) if h.matrix else self.uniform(P)) for h in info.history_with(())]
            state = self.F if info.field == "F" else 0.5 + self.uniform(P)
            C = self.normal(P, D, D) if info.viscous else None
            tail = (self.scene, law, D)
            entries = sum(D * D if h.matrix else 1 for h in info.history_with(()))
            grads = (
                self.normal(P, D, D) if info.plastic else None,
                *(self.normal(P, D, D), self.normal(P, entries) if q else None, self.normal(P), self.normal(P)),
            )
            found += [
                ("law_update", (state, C, p, q, *tail, 0, 7)),
                ("law_update_backward", (*grads, state, C, p, q, *tail, 0, 15)),
                ("law_energy", (state, p, q, *tail)),
                ("law_energy_backward", (self.normal(P), state, p, q, *tail, 13)),
                ("law_stiffness", (state, p, q, *tail)),
                ("law_wave_modulus", (state, p, q, *tail)),
            ]
            if info.twice_differentiable_energy and not info.twice_differentiable:
                found.append(
                    (
                        "law_energy_double_backward",
                        (self.normal(P, D, D), self.normal(P, len(p)), self.normal(P), state, p, *tail, 5),
                    )
                )
            if info.twice_differentiable:
                along = (self.normal(*state.shape), C, self.normal(P, len(p)))
                found += [
                    ("law_update_double_backward", (*along, self.normal(P, D, D), state, C, p, *tail, 7)),
                    ("law_energy_double_backward", (along[0], along[2], self.normal(P), state, p, *tail, 5)),
                ]
        return found

    def implicit(self) -> list[tuple[str, tuple[Any, ...]]]:
        P, D, N, top, x = PARTICLES, self.dim, self.N, self.topology, self.x
        tangent, along = 0.1 * self.uniform(P, tangent_entries(D)), self.normal(N, D)
        inverse = torch.zeros(N, D * (D + 1) // 2, dtype=self.dtype)
        inverse[:, 0] = inverse[:, -1] = 1.0
        images = torch.arange(3 << D, dtype=torch.int32).reshape(3, -1)
        solve = (
            x,
            along,
            self.uniform(N),
            inverse,
            inverse,
            0.1 * along,
            images,
            tangent,
            0.1 * self.uniform(2),
            20,
            0,
        )
        moduli = [self.uniform(P), self.uniform(2)]
        return [
            ("law_tangent", (self.F, self.F, self.uniform(P), moduli, [], self.scene, "neo_hookean", D, True)),
            ("implicit_apply", (x, along, tangent, 0, *top)),
            ("implicit_node_blocks", (x, tangent, 1, *top)),
            ("implicit_cg", (*solve, *top)),
        ]

    def rollouts(self) -> list[tuple[str, tuple[Any, ...]]]:
        """Calls with three laws: one with a history, one that reads J and C."""
        P, D, ones = PARTICLES, self.dim, torch.ones((), dtype=self.dtype)
        material, ids = torch.arange(P, dtype=torch.int32) % 3, torch.arange(P)
        fields = (self.x, self.normal(P, D), 1 + self.uniform(P), self.uniform(P), self.normal(P, D, D), self.F)
        who = (self.scene, ids, material, self.blocks.status)
        laws = ("neo_hookean,von_mises,weakly_compressible", [0, 0, 0])
        counts = [len(LAWS[name].parameters) for name in laws[0].split(",")]
        how = ([ones] * sum(counts), [0, 1, 0], 3, 1e-3, True, [0.0, 1.0], True, 0, self.normal(2, D), *self.walls)
        impulse = self.normal(2, 6 + 2 * D, D + (1 if D == 2 else 3)).double()
        clocks = self.dt, self.uniform(2).double()
        nothing = ([], [], [], [], [], [], [], [])
        end = (*self.obstacles, 0.1, 2, 40, True, False, False, impulse, *clocks, *nothing)
        heat = [self.uniform(P), ones, ones, self.uniform(P), ones, 1 + self.uniform(2), self.normal(P, D)]
        bounds = [self.normal(2, 2), self.uniform(3, 2, 2), self.uniform(P)]
        table = torch.stack([torch.arange(3, dtype=self.dtype), 1 + self.uniform(3)])
        conducts = (heat, [0, 9, 1], [1e-3, 273.0, 0.5, 1e-6], [1, 0], [0, 1, 2], bounds)
        hot = (*self.obstacles, 0.1, 2, 40, True, True, False, None, *clocks, *conducts, [0, 1, 0], [table])
        warm = (*self.obstacles, 0.1, 2, 40, True, False, False, None, *clocks, *conducts, [0, 1, 0], [table])
        look = (*fields[:5], self.F, *self.uniform(4, P), self.scene, 50.0, 2.0, True, 0.1, self.lattice.upper, 2)
        start = (*fields, 0.5 + self.uniform(P), None, [self.uniform(P)], *who, *laws, *how)
        resident = (*self.obstacles, 0.1, 2, 40, True, True, False, impulse, *clocks, *nothing)
        call, with_heat, with_adjoint, with_bodies = (
            (*start, *parts, *self.lattice.packed) for parts in (end, hot, warm, resident)
        )
        facts = (False, True, D, PARTICLES, 2, 5, 27, 27, True, *[False] * 10, 1, *[False] * 8, 0, 0, False, False)
        figures = (self.x, *call[4:7], call[8], self.scene, material, *laws, how[0], how[1], True)
        grads = [self.normal(*t.shape) for t in torch.ops.torch_mpm.substeps(*call)[:6]]
        of_heat = self.normal(*torch.ops.torch_mpm.substeps(*with_adjoint)[10].shape)
        return [
            ("substeps", call),
            ("substeps", with_heat),
            ("substeps_with_bodies", (*self.bodies(), *with_bodies)),
            ("substeps_backward", ([*grads, torch.ones_like(impulse), None], 15, None, *call)),
            ("substeps_backward", ([*grads, None, of_heat], 239, None, *with_adjoint)),
            ("law_figures", figures),
            ("plan_substeps", (-1, *facts)),
            ("latest_schedule", (self.x,)),
            ("segment_clock", (self.uniform(2, 8).double(), self.uniform(2).double(), 0.5, 1.0, 100, True, 4)),
            ("survey", (*look, *self.obstacles, self.uniform(2).double(), 0.1, *self.lattice.packed)),
        ]

    def sand(self) -> list[tuple[str, tuple[Any, ...]]]:
        moduli = (0.5 + self.uniform(2), 0.5 + self.uniform(PARTICLES))
        options = ("full", "exact", "zero", True)
        return [
            (
                "quartic_return_map",
                (self.F, *moduli, self.uniform(), self.uniform(1), self.uniform(PARTICLES), self.scene, *options),
            ),
            ("svd3", (self.F,)),
            ("polar", (self.F,)),
        ]
