"""Memory of the fused op with gradients: of a stored state, of a recorded step, and of a call.

Upper bounds, by the tensors of csrc/rollout: `recorded.h`, `substeps_backward.op.cpp`, `heat_backward.h`,
`thermal_laws_backward.op.h`, `heat_steps.h` and `schedules/sorted_cpu.op.h`. Memory that an allocator keeps after its
tensors is not included.
"""

from __future__ import annotations

import re

import torch
from torch import Tensor

from ..boundaries import Obstacle
from ..boundaries.damping import split_damping
from ..heat.boundaries import Fixed, FixedSurface, Term
from ..heat.heat import GRADIENT
from ..laws import CompiledLaw, Mixture
from ..laws.calls import LawCalls, law_calls, laws_of, passive
from ..laws.parameters import PerMaterial
from ..laws.thermal import LIQUID
from ..laws.thermal_calls import laws_in
from ..ops.obstacle_tables import numbers_of_a_step
from ..ops.registry import LAWS
from ..state.state import State
from ..step.clocks import requires_grad
from ..step.step import Step
from .checkpoints import Needs
from .facts import path_bytes
from .memory import rows_bytes
from .steps import Steps

STEPS_OF_A_CALL = {"cpu": 8.0, "cuda": 64.0}
"""Time of a call of the op beside its steps, in steps."""
_CLEARED = 1 << 26
"""Bytes of nodes that the backward pass clears at once, `kCleared` in csrc/rollout/heat_backward.h."""
_SIMPLE_STEPS = 3
"""`kMostSimpleSteps` in csrc/heat/solve.h."""
_COPY_LINE = 1024 + 16
"""`kCopyLine` in csrc/rollout/laws_p2g.h."""


def needs_of_op(step: Step, state: State, dt: float | Tensor) -> Needs:
    """Memory of steps of the fused op from a state as `Step.prepare` returns it.

    Where the grid has no pool yet, the number of its blocks is measured.
    """
    blocks = step.grid.max_blocks
    sizes = _Sizes(step, state, step.grid.measured_pool(state.x, state.scene) if blocks is None else blocks)
    of_state, of_step = sizes.stored_state(), sizes.recorded_step()
    states = 4 if state.x.is_cuda else 2  # Arguments and result of a call; on CUDA those of the rollout in order, too.
    of_call = max(sizes.backward(dt), sizes.forward(dt) - of_step) + states * of_state
    of_path = path_bytes(step, Steps(step, 1, dt), state)
    return Needs(of_state, of_step, of_call, of_path, STEPS_OF_A_CALL[state.x.device.type], True)


def recorded_bytes(step: Step, state: State) -> int:
    """Upper bound of the record of a step of the fused op; see `Recorded::lay_out` [bytes]."""
    return _Sizes(step, state, step.grid.max_blocks).recorded_step()


def stored_bytes(step: Step, state: State) -> int:
    """Upper bound of a state that autograd stores for a call of the fused op [bytes]."""
    return _Sizes(step, state, step.grid.max_blocks).stored_state()


class _Sizes:
    """Sizes of the tensors of the op for the particles of a state and a pool of `blocks` blocks; None where the grid
    has no pool yet."""

    def __init__(self, step: Step, state: State, blocks: int | None) -> None:
        self._step, self._state, self._heat = step, state, step.heat
        self._dim, self._size = step.grid.dim, state.x.element_size()
        self._matrix, self._cuda = self._dim**2, state.x.is_cuda
        _, entries = split_damping(step.boundaries.entries)
        self._obstacles = [o for o in entries if isinstance(o, Obstacle)]
        self._slots = self._most_slots() if blocks is None else blocks

    # ---- particles

    def _rows(self, columns: int) -> int:
        return rows_bytes(self._state.x, len(self._state), columns)

    def _extra(self) -> int:
        """Numbers per particle of the history, and of the gradient and the liquid fraction of heat."""
        P = max(len(self._state), 1)
        return sum(t.numel() // P for t in self._state.extra.values())

    def _of_heat(self) -> int:
        """Numbers per particle of the result of heat: temperature, gradient, liquid fraction."""
        if self._heat is None:
            return 0
        return 1 + sum(n for name, n in ((GRADIENT, self._dim), (LIQUID, 1)) if name in self._state.extra)

    def _columns(self) -> int:
        """Numbers per particle that steps change."""
        s, D = self._state, self._dim
        moved = self._step.law.state_fields
        matrices = int(self._step._keeps_C) + (s.F is not None or "F" in moved)
        scalars = int(s.J is not None or "J" in moved) + (s.temperature is not None) + self._extra()
        return 2 * D + matrices * self._matrix + scalars + (D if s.x_residual is not None else 0)

    def stored_state(self) -> int:
        """A state that autograd stores, with arguments that exist for its call alone [bytes]."""
        gathered = [] if self._heat is None else [isinstance(v, PerMaterial) for v in self._heat.parameter_values]
        of_mixture = self._rows(self._extra()) if isinstance(self._step.law, Mixture) else 0
        return self._rows(self._columns() + sum(gathered)) + of_mixture

    def recorded_step(self) -> int:
        """The record of a step, and the adjoints of its nodes [bytes]."""
        grid = 0 if self._grid_is_shared() else self._grid_bytes()
        of_scenes = (1 + self._step.grid.scenes) * 48
        return self._rows(self._recorded_columns()) + grid + of_scenes + self._cleared_nodes()

    def _cleared_nodes(self) -> int:
        """Adjoints of the nodes of a step that are cleared with those of other steps: of the motion, and of heat on
        CUDA [bytes]."""
        motion = min(self._node_rows(), _CLEARED)
        if self._heat is None or not self._cuda:
            return motion
        return motion + min(self._nodes() * (4 + 1 + _SIMPLE_STEPS) * self._size, _CLEARED)

    def _recorded_columns(self) -> int:
        step, heat = self._step, self._heat
        materials = [laws_in(passive(material)) for material in laws_of(step.law)]
        laws = [passive(law) for each in materials for law in each]
        plastic = any(isinstance(law, CompiledLaw) and LAWS[law.name].plastic for law in laws)
        melts = any(len(laws) > 1 for laws in materials)
        affine = (step.stress_form == "mls" or heat is not None) and not step._keeps_C
        between_laws = plastic * self._matrix + melts * (1 + self._matrix)
        return self._columns() + affine * self._matrix + self._matrix + between_laws + self._recorded_of_heat()

    def _recorded_of_heat(self) -> int:
        """Recorded numbers of heat per particle beside its result: present volume, dissipated energy, and
        `HeatSteps::transfer_columns`."""
        if self._heat is None:
            return 0
        melts, of_transfer = LIQUID in self._state.extra, 2
        return 1 + (self._heat.plastic_heating > 0) + of_transfer + melts + self._holds(FixedSurface)

    def _holds(self, kind: type) -> bool:
        return self._heat is not None and any(isinstance(term, kind) for term in self._heat.boundaries.entries)

    # ---- nodes

    def _most_slots(self) -> int:
        """Largest pool with which a record has the grid of each step."""
        return self._grid_limit() // (2 * (1 + self._dim) * self._size * 4**self._dim)

    def _nodes(self, slots: int | None = None) -> int:
        return (self._slots if slots is None else slots) * 4**self._dim

    def _node_rows(self, slots: int | None = None) -> int:
        """Mass and momentum of all nodes [bytes]."""
        return self._nodes(slots) * (1 + self._dim) * self._size

    def _grid_limit(self) -> int:
        """Largest size of the grid of a step in a record, see the constructor of `Recorded` [bytes]."""
        return len(self._state) * (self._dim + 2 * self._matrix) * self._size

    def _grid_is_shared(self) -> bool:
        """Whether the steps of a record have one grid, which each of them activates again."""
        return self._grid_bytes() > self._grid_limit()

    def _grid_bytes(self, slots: int | None = None) -> int:
        """Tables of blocks, and rows of the nodes, of one step [bytes]."""
        slots = self._slots if slots is None else slots
        P, table = len(self._state), self._step.grid.block_count
        schedule = 16 + (8 + 4**self._dim // 2) * (slots + P // 128) + P
        rows = 2 + bool(self._obstacles)
        of_blocks = 4 * (table + 2 * slots + 1 + P + schedule) + 9 * 256
        return of_blocks + rows * self._node_rows(slots) + self._heat_grid_bytes(slots)

    def _heat_grid_bytes(self, slots: int) -> int:
        """Nodes of a step of heat, `HeatSteps::lay_out` [bytes]."""
        if self._heat is None:
            return 0
        surface, entries = self._holds(FixedSurface), self._heat.boundaries.entries
        terms = self._heat.plastic_heating > 0 or any(not isinstance(term, (Fixed, FixedSurface)) for term in entries)
        sums = 4 + 2 * (surface or terms) + 4 * terms
        averages, increments, held = 2, 1, self._holds(Fixed)
        numbers = sums + _SIMPLE_STEPS + averages + increments + held
        return self._nodes(slots) * (numbers * self._size + held) + slots + 8 * self._step.grid.scenes + 12 * 256

    def _heat_nodes(self) -> int:
        """Numbers per node of a step of heat: averages, increments, what is held, sums, and vectors of the solve."""
        products = _SIMPLE_STEPS if self._cuda else 0
        return 5 + (2 if self._cuda else 1) * (4 + 2 + 4 + products) + 6

    def _tiles(self, resident: bool) -> int:
        """Numbers per block for sums of heat with an order on CUDA: tiles of the products of a solve
        (`PackedItems::kTile` in csrc/heat/operator.cuh), and of the transfers to the nodes (csrc/transfer/tiles.h)
        where steps are not differentiated."""
        if self._heat is None or not (self._cuda and self._step.grid.deterministic):
            return 0
        width = 4 + (3 if self._step.grid.kernel == "cubic" else 2)
        of_products = 7 * 8 if self._dim == 2 else 7 * (7 * 8 + 4)
        return of_products + (4 * width**self._dim if resident else 0)

    # ---- calls

    def backward(self, dt: float | Tensor) -> int:
        """Adjoints and working memory of the backward pass of a call, beside what it records [bytes]."""
        D, matrix, heat = self._dim, self._matrix, self._heat
        calls = law_calls(self._step.law, self._state, dt, heat is not None)
        thermal = len(calls.thermal) > 0 or any("~" in name for name in calls.names)
        with_gradient = thermal or any(t.requires_grad for t in calls.parameters)
        columns = 2 * (self._columns() + matrix)  # Adjoints of the result and of the arguments.
        columns += 2 + 3 * requires_grad(dt)  # Of mass, volume and dt.
        terms = [True, self._step.stress_form != "mls", any(self._writes_terms(name) for name in calls.names)]
        columns += sum(terms) * matrix  # Of stress, velocity gradient and F.
        columns += self._extra() + self._of_heat()  # Packed copies.
        columns += 2 * len(calls.parameters) if with_gradient else 0
        columns += 2 * D + matrix if self._step._flip_share > 0 else 0
        if thermal:
            columns += 5 * matrix + 2 + len(calls.parameters)
            if any(table.requires_grad for table in calls.tables):  # Each particle has the adjoints of all values.
                columns += sum(table.shape[1] for table in calls.tables)
        if heat is not None:
            forms = 8  # `kHeatForms` in csrc/heat/backward.h.
            columns += 2 * (self._of_heat() + 2) + 9 + matrix + D + 3 + forms * (1 + D)
            columns += 2 * (1 + D) + 2 * D + matrix if heat.boundaries.entries or heat.plastic_heating else 0
        return self._rows(columns) + self._backward_nodes() + self._activation()

    @staticmethod
    def _writes_terms(names: str) -> bool:
        """Whether a law among those of a material writes the adjoint of F, and does not add to it."""
        laws = [LAWS[name] for name in re.split(r"[+~]", names)]
        return any(len(law.history) > 0 and not law.plastic for law in laws)

    def _backward_nodes(self) -> int:
        rows = 1 + 2 * bool(self._obstacles) + 3 * (self._step._flip_share > 0)
        numbers = self._dim
        if self._obstacles:
            numbers += numbers_of_a_step(self._obstacles, self._state.x, 1)
        if self._heat is not None:
            products = _SIMPLE_STEPS if self._cuda else 0
            of_terms = sum(isinstance(term, Term) for term in self._heat.boundaries.entries)
            numbers += self._nodes(1) * (self._heat_nodes() + 6 + 4 + 4 + 8 + 8 + products) + 2 * of_terms + 20
            numbers += 2 * self._tiles(resident=False)  # Of the steps and of the adjoint solves.
        return rows * self._node_rows() + self._slots * numbers * self._size + self._grid_bytes()

    def forward(self, dt: float | Tensor) -> int:
        """Working memory of the forward pass of a call: particles and their sorted copies, blocks and nodes
        [bytes]."""
        calls = law_calls(self._step.law, self._state, dt, self._heat is not None)
        columns = self._columns() + self._matrix + 2 + len(calls.parameters) + self._extra()
        columns += self._of_heat() + 2 + 5 if self._heat is not None else 0
        thermal = 3 * self._matrix + 2 + len(calls.parameters) if calls.thermal else 0
        margin = self._slots // 2 + 64 if self._cuda else 2 * self._slots + 64
        slots = min(self._slots + margin, self._step.grid.block_count)
        nodes = 3 * self._node_rows(slots) + self._grid_bytes(slots)
        if self._heat is not None:
            nodes += self._nodes(slots) * self._heat_nodes() * self._size
            nodes += slots * self._tiles(resident=True) * self._size
        of_particles = self._rows(2 * columns + self._matrix + thermal) + self._copies(calls)
        return of_particles + self._activation() + nodes

    def _copies(self, calls: LawCalls) -> int:
        """Particles that threads of a CPU copy for their laws, `ChunkRows` in csrc/rollout/laws_p2g.h [bytes]."""
        if self._cuda:
            return 0
        rows = 1 + 3 * self._matrix + self._extra() + len(calls.parameters)
        rows += 4 + 2 * self._matrix + len(calls.parameters) if calls.thermal else 0
        return torch.get_num_threads() * rows * _COPY_LINE * self._size

    def _activation(self) -> int:
        """Working memory of an activation, and numbers of the particles [bytes]."""
        packed = self._rows(2 * (self._dim + 4)) if self._cuda and self._heat is not None else 0
        numbers = (10 + 8 * 4) * len(self._state) + 64 * self._slots + self._step.grid.block_count // 32 + 4096
        return numbers + packed + self._known_nodes()

    def _known_nodes(self) -> int:
        """What nodes near obstacles meet, of many steps on CUDA, `make_known_nodes` in step_kernels.h [bytes]."""
        if not self._cuda or not self._obstacles:
            return 0
        count = 2**14
        while count < min(2**18, 2**10 * self._step.grid.scenes):
            count *= 2
        return count * (8 + 64 * self._size)
