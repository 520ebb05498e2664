"""Valid calls of every op in `torch.ops.torch_mpm`, with few particles in two scenes."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.ops.heat_patches import Patches
from torch_mpm.reference.principal import LAWS

PARTICLES = 37
MATERIALS = {"neo_hookean": (2, True), "viscous_fluid": (3, False)}
"""Laws of `material_stress`: parameters, and whether the state is F (or J)."""


def operators() -> list[str]:
    """Names of all ops."""
    schemas = torch._C._jit_get_all_schemas()
    return sorted({s.name.removeprefix("torch_mpm::") for s in schemas if s.name.startswith("torch_mpm::")})


def calls(dim: int, dtype: torch.dtype = torch.float64) -> list[tuple[str, dict[str, Any]]]:
    """(op, arguments by name) of at least one valid call of every op."""
    make = _Calls(dim, dtype)
    found = [*make.transfers(), *make.grid(), *make.heat(), *make.principal(), *make.materials(), *make.sand()]
    return [(op, _named(op, values)) for op, values in found]


def _named(op: str, values: tuple[Any, ...]) -> dict[str, Any]:
    names = [a.name for a in getattr(torch.ops.torch_mpm, op).default._schema.arguments]
    return dict(zip(names, values, strict=False))  # those left out have defaults


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
        self.topology = self.blocks.topology
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
        grid = self.lattice
        activation = (x, self.scene, self.blocks.status, 2, grid.dx, grid.lower, grid.blocks, grid.order, 40, True)
        return [
            ("activate", activation),
            ("cell_order", (x, *top)),
            ("p2g", (*given, *top)),
            ("p2g_backward", (rows, *given, 127, *top)),
            ("scatter", (x, v, C, stress, 2.0, *top)),
            ("gather", (x, rows, 2.0, True, True, *top)),
            ("g2p", (x, velocity, True, True, *top)),
            ("g2p_advance", (x, velocity, self.F, J, self.dt, 0.1, True, 1, *top)),
            ("position_gradient", (x, v, C, stress, velocity, 2.0, *top)),
            ("advance", moving),
            ("advance_backward", (v, C, mass, *moving, 31)),
        ]

    def grid(self) -> list[tuple[str, tuple[Any, ...]]]:
        D, blocks, grid = self.dim, self.blocks, self.lattice
        lattice = (grid.dx, grid.lower, grid.blocks)
        walls = ([2, 4] + [1, 3] * (D - 1), [0.0, 1.0] * D, [0.1] * 2 * D)
        rows, velocity = self.uniform(self.N, 1 + D), self.normal(self.N, D)
        update = (rows, self.normal(2, D), self.dt, 0.1, *walls, blocks.table, blocks.block, *lattice)
        table, outline = self.uniform(2, 5, 10 if D == 2 else 17), self.uniform(4, 2)
        kinds = ([0, 1, 2, 3, 4], [0, 0, 0, 0, 4], [1, 2, 3, 2, 3], [-1, -1, 0, 1, -1], [0.0] * 5, [float("inf")] * 5)
        obstacles = (velocity, table, outline, *kinds, self.uniform(2), 0.1, blocks.block, *lattice)
        return [
            ("grid_update", update),
            ("grid_update_backward", (self.uniform(self.N, 1 + D), True, *update)),
            ("contact", obstacles),
            ("contact_backward", (self.normal(self.N, D), True, *obstacles)),
        ]

    def heat(self) -> list[tuple[str, tuple[Any, ...]]]:
        x, N, blocks, top = self.x, self.N, self.blocks, self.topology
        conductance = self.uniform(PARTICLES)
        capacity = mpm.scatter(blocks, x, self.uniform(PARTICLES, 1))[:, 0].contiguous()
        nodes = (capacity, self.normal(N), self.normal(N), self.uniform(N), self.uniform(N) < 0.1)
        limits = (0.1 * self.uniform(2), 1e-6, 0.0, torch.tensor([20, 30], dtype=torch.int32), 40)
        patches = Patches(blocks, x, conductance, capacity, capacity > 0)
        return [
            ("heat_cg", (x, conductance, *nodes, self.dt, 0.5, *limits, 0, 1e-6, *top)),
            ("heat_cg", (x, conductance, *nodes, self.dt, 0.5, *limits, 1, 1e-6, *top)),
            ("heat_multigrid", (x, conductance, *nodes, self.dt, 0.5, *limits, 2, 1e-6, *top)),
            ("heat_operator", (x, conductance, nodes[1], *top)),
            ("heat_stencil", (x, conductance, *top)),
            ("heat_patches", (patches.inverse, patches.rows, patches.patches, self.normal(N))),
        ]

    def principal(self) -> list[tuple[str, tuple[Any, ...]]]:
        P, D, found = PARTICLES, self.dim, []
        for law, description in LAWS.items():
            shapes = itertools.islice(itertools.cycle(((2,), (P,), (), (1,))), len(description.parameters))
            p = [0.5 + self.uniform(*shape) for shape in shapes]
            q = [0.5 + self.uniform(P) for _ in description.history]
            given = (self.F, p, q, self.scene, law)
            grads = (self.normal(P, D, D), self.normal(P, D, D), self.normal(P, len(q)), self.normal(P))
            found += [
                ("principal_update", (*given, True)),
                ("principal_update_backward", (*grads, *given, 7)),
                ("principal_energy", given),
                ("principal_energy_backward", (self.normal(P), *given, 7)),
                ("principal_stiffness", given),
                ("principal_wave_modulus", given),
            ]
        return found

    def materials(self) -> list[tuple[str, tuple[Any, ...]]]:
        P, D, found = PARTICLES, self.dim, []
        for law, (count, shear) in MATERIALS.items():
            parameters = [0.5 + self.uniform(*shape) for shape in ((2,), (P,), ())[:count]]
            state, C = (self.F, None) if shear else (0.5 + self.uniform(P), self.normal(P, D, D))
            tail = (self.scene, parameters, law, D)
            found += [
                ("material_stress", (state, C, *tail)),
                ("material_stress_backward", (self.normal(P, D, D), state, C, *tail, 7)),
                ("material_energy", (state, *tail)),
                ("material_energy_backward", (self.normal(P), state, *tail, 7)),
                ("material_stiffness", (state, *tail)),
                ("material_wave_modulus", (state, *tail)),
            ]
        return found

    def sand(self) -> list[tuple[str, tuple[Any, ...]]]:
        P, D = PARTICLES, self.dim
        moduli = (0.5 + self.uniform(2), 0.5 + self.uniform(P))
        options = ("full", "exact", "zero")
        given = (self.F, *moduli, self.uniform(), self.uniform(1), self.uniform(P), self.scene, *options)
        grads = (self.normal(P, D, D), self.normal(P, D, D), *(self.normal(P) for _ in range(3)))
        return [
            ("quartic_return_map", (*given, True)),
            ("quartic_return_map_backward", (*grads, *given, True, True)),
            ("quartic_energy", (self.F, *moduli, self.scene, "full")),
            ("quartic_stiffness", (self.F, *moduli, self.scene, "full", 0.1)),
            ("svd3", (self.F,)),
            ("polar", (self.F,)),
        ]
