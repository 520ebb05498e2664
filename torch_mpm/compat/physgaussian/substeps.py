"""Substeps of PhysGaussian's simulator: requested one by one, computed together."""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...boundaries import Damping
from ...cuda_graphs.capture import version
from ...errors import check_number
from ...grid.grid import Grid
from ...laws import Material
from ...state.state import State
from ...step.clocks import time_after
from ...step.particle_operations import Timed
from ...step.step import Step
from ..clipping import ClippedRollout
from ..pending import Versions, check_versions, versions
from .condition_list import Nodes, acts, changes
from .descendants import DescendantMethods
from .exchange import ARRAYS
from .law_choice import chosen_law, kinds_of, law_indices, needs_moduli
from .particles import Anchored, affine_operations, enabled_operations, is_pic
from .weighted_force import WeightedForceStep

DEFAULT_FLIP = 0.8
"""Share of FLIP of GaussianFluent."""


class Pending(NamedTuple):
    """Substeps that are not computed yet."""

    steps: int = 0
    dt: float = 0.0
    grad: bool = True
    """Whether gradients are needed."""
    flip: float | None = None
    """Share of FLIP; None for APIC."""


class Substeps(DescendantMethods):
    """The clock of a simulator, and the steps up to it."""

    strict: bool
    time_profile: dict[str, list[float]]
    _codes: Tensor | None
    _moduli: dict[str, Any] | None
    _law: Material | None
    _step: ClippedRollout | None
    _damping: Damping | None
    _affine: list[Timed]
    _enabled: tuple[int | None, list[Timed]]
    _selections: dict[str, Tensor]
    _pending: Pending

    @property
    def time(self) -> float:
        """[s]"""
        return float(time_after(self._start_time, self._pending.dt, self._pending.steps))

    @property
    def _start_time(self) -> float:
        return 0.0 if self._state is None else float(self._state.time)

    def p2g2p(
        self,
        step: Any = None,
        dt: float | None = None,
        device: Any = None,
        flip_pic_ratio: float | None = None,
        flip_pic: bool | None = None,
    ) -> None:
        """A substep of dt [s]; `step` is not used.

        In the dialect of MotionPhysics the first argument is dt. In that of GaussianFluent the substep blends PIC with
        a share `flip_pic_ratio` of FLIP, with its forces, unless `flip_pic` is False.
        """
        if self.dialect.name == "motionphysics" and not isinstance(dt, (int, float)):
            dt = step
        if dt is None:
            raise TypeError("p2g2p needs step and dt; with dt alone, the simulator must have dialect='motionphysics'")
        check_number("dt", dt, "positive", lambda v: v > 0)
        flip = self._share_of_flip(flip_pic_ratio, flip_pic)
        wanted = Pending(1, dt, torch.is_grad_enabled(), flip)
        if self._pending[1:] != wanted[1:]:
            self._flush()
            self._check_ready()
            self._pending, self._versions = wanted, self._tensor_versions()
        else:
            self._pending = self._pending._replace(steps=self._pending.steps + 1)

    def _share_of_flip(self, ratio: float | None, flip_pic: bool | None) -> float | None:
        if self.dialect.name != "gaussianfluent":
            if ratio is not None or flip_pic is not None:
                raise ValueError("flip_pic_ratio and flip_pic need dialect='gaussianfluent'")
            return None
        if flip_pic is False:
            return None
        given = self.parameters.get("flip_pic_ratio", DEFAULT_FLIP) if ratio is None else ratio
        return float(check_number("flip_pic_ratio", float(given), "between 0 and 1", lambda v: 0 <= v <= 1))

    def print_time_profile(self) -> None:
        """Print the time of the substeps so far [ms]; on CUDA that of their launch, except where results were read."""
        print("MPM Time profile:")
        for name, times in self.time_profile.items():
            print(name, sum(times))

    # ---- the material

    def _check_ready(self) -> None:
        state = self._loaded()
        kinds = kinds_of(self.dialect, self.parameters.get("material", "jelly"), self._codes)
        if self._moduli is None and needs_moduli(kinds):
            raise ValueError("the material is not known: call set_parameters_dict and finalize_mu_lam before p2g2p")
        if "density" not in self.parameters and not bool((state.mass > 0).all()):
            raise ValueError("the particles have no mass: give density in set_parameters_dict")
        if self._law is None or self._codes_have_changed():
            self._law = chosen_law(self.dialect, self.parameters | (self._moduli or {}), self._codes)
            self._law_codes = self._codes, None if self._codes is None else version(self._codes)
            self._state = state = state.replace(material=None)
            held = [kind == "stationary" for _, kind in kinds]
            self._anchored = self._anchor(state, held) if any(held) else None
            self._step = None
        if state.J is None and "J" in self._law.state_fields:
            assert state.F is not None
            self._state = state.replace(J=torch.linalg.det(state.F))
        if len(kinds) > 1 and self._codes is not None and state.material is None:
            self._state = self._loaded().replace(material=law_indices(self._codes))

    _anchored: Anchored | None = None
    _law_codes: tuple[Tensor | None, int | None] = (None, None)
    _versions: Versions

    def _tensor_versions(self) -> Versions:
        """Versions of the tensors that substeps read."""
        state = self._loaded()
        of_particles = {name: getattr(state, field) for name, field in ARRAYS.items()} | self._selections
        of_particles |= {"particle_material": self._codes, **state.extra}
        return versions(self.parameters | {f"mpm_state.{name}": value for name, value in of_particles.items()})

    def _codes_have_changed(self) -> bool:
        """Whether materials of particles were written to in place since the law was chosen."""
        codes, before = self._law_codes
        return self._codes is not None and (codes is not self._codes or before != version(self._codes))

    def _anchor(self, state: State, held: list[bool]) -> Anchored:
        """Operation that keeps the particles of stationary materials where they are."""
        still = state.replace(v=torch.zeros_like(state.v))
        if self._codes is None:
            return Anchored(still, torch.ones_like(state.mass, dtype=torch.bool))
        indices = law_indices(self._codes).long()
        return Anchored(still, torch.tensor(held, device=indices.device)[indices])

    def _stress(self) -> Tensor:
        self._check_ready()
        assert self._law is not None
        return self._law.stress(self._loaded())

    # ---- the steps

    def _before_change(self) -> None:
        self._flush()

    def _flush(self) -> None:
        """Compute the pending substeps: in parts that begin where conditions by torch operations begin or end."""
        (steps, dt, grad, flip), self._pending = self._pending, Pending()
        if steps == 0:
            return
        check_versions(self._versions, self._tensor_versions(), steps)
        began = time.perf_counter()
        with torch.set_grad_enabled(grad):
            self._check_ready()
            conditions = [*self._boundaries(self._nodes), *self._pushes, *self._holds]
            first, done = self._start_time, 0
            for end in changes(conditions, first, steps, dt):
                self._advance(first + done * dt, end - done, dt, flip)
                done = end
        self.time_profile.setdefault("substeps", []).append(1e3 * (time.perf_counter() - began))

    def _advance(self, first: float, count: int, dt: float, flip: float | None) -> None:
        """The substeps between two changes of conditions."""
        before, last = self._loaded(), first + (count - 1) * dt
        if flip is not None:
            self._state = self._rolled(before, count, first, last, dt, flip, weighted=True).replace(C=before.C)
        elif self._is_pic and count > 1:  # PIC needs no C, which the last substep alone computes.
            state = self._rolled(before, count - 1, first, last, dt, 0.0).replace(C=before.C)
            self._state = self._rolled(state, 1, first, last, dt)
        else:
            self._state = self._rolled(before, count, first, last, dt)
        if self._anchored is not None:
            self._state = self._anchored(self._loaded(), dt)

    def _rolled(
        self, state: State, n: int, first: float, last: float, dt: float, flip: float | None = None,
        weighted: bool = False,
    ) -> State:  # fmt: skip
        """State after n substeps; `weighted` with the forces of GaussianFluent's FLIP."""
        active = self._active(first, last, dt, flip)
        if weighted and self._flip_step is None:
            self._flip_step = self._new_rollout(WeightedForceStep)
        roll = self._flip_step if weighted else self._step
        assert roll is not None
        return roll.run(state, n, dt, *active)

    def _new_rollout(self, make: type[Step] = Step) -> ClippedRollout:
        assert self._law is not None
        gravity, form = self.parameters.get("g"), self.dialect.stress_form
        return ClippedRollout(self._law, gravity, self._grid(), self._bounds, form, make)

    _flip_step: ClippedRollout | None = None

    @property
    def _is_pic(self) -> bool:
        return is_pic(self.parameters.get("rpic_damping", 0.0))

    @property
    def _bounds(self) -> tuple[float, float] | None:
        """Bounds of positions after each substep [m]; None without."""
        cells, dx = self.dialect.clipped, self._dx
        return None if cells is None else (cells * dx, float(self.parameters["grid_lim"]) - cells * dx)

    @property
    def step(self) -> Step:
        """Step of torch_mpm of the substeps; `simulator.step.check()` reports errors."""
        self._flushed()
        self._check_ready()
        active = self._active(self._start_time, math.inf, 0.0)
        assert self._step is not None
        return self._step.whole.with_conditions(*active)

    def _active(
        self, first: float, last: float, dt: float, flip: float | None = None
    ) -> tuple[list[Any], list[Any], str, float]:
        """Active conditions at times from `first` to `last` on nodes and particles, transfer and share of FLIP.

        Args:
            flip: share of FLIP over PIC; None for APIC.
        """
        if self._step is None:
            self._step, self._flip_step = self._new_rollout(), None
            self._affine = affine_operations(self.parameters.get("rpic_damping", 0.0))
            self._enabled = -1, []
        selection = self._selections.get("particle_selection")
        if selection is not None and version(selection) != self._enabled[0]:
            self._enabled = version(selection), enabled_operations(selection)
        affine, enabled = self._affine, self._enabled[1]
        nodes = [b for b in self._boundaries(self._nodes) if acts(b, first, last, dt)]
        nodes = nodes if self._damping is None else [self._damping, *nodes]
        anchored = [] if self._anchored is None else [self._anchored]
        timed = [o for o in (*self._pushes, *self._holds) if acts(o, first, last, dt)]
        operations = [*anchored, *timed, *(affine if flip is None else []), *enabled]
        return nodes, operations, *(("apic", 0.0) if flip is None else ("pic", flip))

    def _grid(self) -> Grid:
        return Grid(self._dx, (0.0,) * 3, (float(self.parameters["grid_lim"]),) * 3)

    @property
    def _nodes(self) -> Nodes:
        n = int(self.parameters["n_grid"])
        return Nodes(self._dx, (n, n, n), self._loaded().x[:0], self.strict)

    @property
    def _dx(self) -> float:
        return float(self.parameters["grid_lim"]) / int(self.parameters["n_grid"])
