"""Several laws in one state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ..cuda_graphs.capture import Remembered, without_transforms
from ..errors import shape_of
from ..ops.arguments import soa_empty
from ..ops.implicit import tangent_entries
from ..state.state import _take
from .custom import as_law
from .material import Material

if TYPE_CHECKING:
    from ..state.state import State

__all__ = ["Mixture"]


class Mixture(Material):
    """Several laws in one state: law k for the particles with state.material = k.

    The particles of each law are found once per `state.material` tensor, which synchronises with the device, and again
    when it has been written to (on CUDA as far as its version counter shows). Per-particle parameters of the laws have
    shape [P] for the whole state.

    Args:
        laws: at least one; functions and modules F -> τ as by `CustomLaw`.

    Attributes:
        indices: the particles of each law, int64, for the latest `state.material`.

    Raises:
        TypeError: unless every entry is a law.
        ValueError: without laws, or in use without state.material or with an id outside 0 .. len(laws) − 1.
    """

    def __init__(self, laws: Sequence[Material | Callable[[Tensor], Any]]) -> None:
        super().__init__()
        if not isinstance(laws, (list, tuple, nn.ModuleList)):
            raise TypeError(f"laws must be a list of materials, got {shape_of(laws)}")
        if len(laws) == 0:
            raise ValueError("Mixture needs at least one law")
        parts = [as_law(f"laws[{k}]", law) for k, law in enumerate(laws)]
        self.laws = nn.ModuleList(parts)
        self.state_fields = tuple(sorted({field for law in parts for field in law.state_fields}))
        self.extra_fields = tuple(sorted({field for law in parts for field in law.extra_fields}))
        self.viscous = any(law.viscous for law in parts)
        self._material: Remembered | None = None
        self._checked: Remembered | None = None
        self.indices: list[Tensor] = []

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        changes: dict[str, Tensor] = {}
        P, D = state.x.shape
        stress = soa_empty(state.x, (P, D, D))
        for part, law in self._parts(state):
            fields, part_stress = law(part)
            stress = stress.index_copy(0, part.index, part_stress)
            for name, value in fields.items():
                if name not in changes:
                    new = name == "dissipated" or name in self.extra_fields
                    zero = value.new_zeros(P, *value.shape[1:])
                    changes[name] = state.extra.get(name, zero) if new else getattr(state, name)
                changes[name] = changes[name].index_copy(0, part.index, value)
        return changes, stress

    def stress(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.stress(part), (state.x.shape[1],) * 2)

    def out_of_plane_stress(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.out_of_plane_stress(part))

    def volume_ratio(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.volume_ratio(part))

    def check_parameters(self, particles: int, scenes: int | None) -> None:
        for law in self.laws:
            law.check_parameters(particles, scenes)  # type: ignore[operator]

    def initial(self, name: str, state: State) -> Tensor:
        return next(law.initial(name, state) for law in self.laws if name in law.extra_fields)  # type: ignore[operator]

    def energy_density(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.energy_density(part))

    def trial_energy(self, state: Any, before: Any) -> Tensor:
        return self._collect_trial(state, before, (), lambda law, part, old: law.trial_energy(part, old))

    def trial_stress(self, state: Any, before: Any, flows: bool = False) -> Tensor:
        shape = (state.x.shape[1],) * 2
        return self._collect_trial(state, before, shape, lambda law, part, old: law.trial_stress(part, old, flows))

    def trial_tangent(self, state: Any, before: Any, weight: Tensor, projected: bool, flows: bool = False) -> Tensor:
        def tangent(law: Any, part: Any, old: Any) -> Tensor:
            return law.trial_tangent(part, old, weight.index_select(0, part.index), projected, flows)

        return self._collect_trial(state, before, (tangent_entries(state.x.shape[1]),), tangent)

    def trial_skew(self, state: Any, weight: Tensor) -> Tensor:
        def skew(law: Any, part: Any, old: Any) -> Tensor:
            return law.trial_skew(part, weight.index_select(0, part.index))

        return self._collect_trial(state, state, (state.x.shape[1],) * 2, skew)

    def _collect_trial(
        self, state: Any, before: Any, shape: tuple[int, ...], function: Callable[[Any, Any, Any], Tensor]
    ) -> Tensor:
        """As `_collect`, for each law with its particles in a trial state and before."""
        result = soa_empty(state.x, (len(state.x), *shape)).zero_()
        for part, law in self._parts(state):
            result = result.index_copy(0, part.index, function(law, part, _Part(before, part.index)))
        return result

    def stiffness(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.stiffness(part))

    def wave_modulus(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.wave_modulus(part))

    def invalid(self, state: State) -> Tensor:
        return self._collect(state, lambda law, part: law.invalid(part).to(state.x.dtype)) > 0

    def viscosity(self, state: State) -> Tensor | None:
        if not self.viscous:
            return None

        def viscosity(law: Material, part: Any) -> Tensor:
            value = law.viscosity(part)
            return torch.zeros_like(part.mass) if value is None else value

        return self._collect(state, viscosity)

    def _collect(self, state: State, function: Callable[[Any, Any], Tensor], shape: tuple[int, ...] = ()) -> Tensor:
        """Result of a function of each law and its particles, [P, *shape]."""
        material = self.check_material(state)
        # On a GPU each law is evaluated for all particles, which takes less time than a selection of its own. This is
        # not done where there may be gradients: values of a law for other particles may be NaN.
        whole = state.x.is_cuda and not torch.is_grad_enabled()
        parts = [(state, law) for law in self.laws] if whole else self._parts(state)
        result = state.x.new_zeros(len(state.x), *shape)
        for k, (part, law) in enumerate(parts):
            value = function(law, part)
            if whole:
                result = torch.where((material == k).reshape(-1, *(1,) * len(shape)), value, result)
            else:
                result = result.index_copy(0, part.index, value)
        return result

    def only(self, state: Any, laws: Sequence[int]) -> tuple[Material, Any]:
        """Some of the laws as one, and their particles as a separate state, whose fields are gathered on access;
        differentiable.
        """
        part = _Part(state, self.particles_of(state, laws))
        return (self.laws[laws[0]] if len(laws) == 1 else self), part  # type: ignore[return-value]

    def particles_of(self, state: Any, laws: Sequence[int]) -> Tensor:
        """Particles of some of the laws, int64 [Q], in the order of the state."""
        indices = self._particles(state)
        found = [indices[k] for k in laws]
        return found[0] if len(found) == 1 else torch.cat(found).sort().values

    def check_material(self, state: State) -> Tensor:
        """Law of each particle; synchronises with the device once per tensor.

        Raises:
            ValueError: without state.material, or with an id outside 0 .. len(laws) − 1.
        """
        material = state.material
        if material is None:
            raise ValueError("a Mixture needs state.material, int32 [P]")
        if not (_is_still(self._material, material) or _is_still(self._checked, material)):
            if material.numel() and not bool(((material >= 0) & (material < len(self.laws))).all()):
                raise ValueError(
                    f"state.material must be in 0 .. {len(self.laws) - 1}, got {material.unique().tolist()}"
                )
            self._checked = Remembered(material, material.numel())
        return material

    def reordered(self, before: Tensor | None, after: Tensor | None) -> None:
        """Mark a state.material as checked that has the entries of a checked one, in any order."""
        if after is not None and (_is_still(self._material, before) or _is_still(self._checked, before)):
            self._checked = Remembered(after, after.numel())

    def _particles(self, state: Any) -> list[Tensor]:
        """Particles of each law, int64."""
        material = self.check_material(state)
        if not _is_still(self._material, material):
            indices = ((material == k).nonzero().squeeze(1) for k in range(len(self.laws)))
            self.indices = [without_transforms(index) for index in indices]
            self._material = Remembered(material, material.numel())
        return self.indices

    def _parts(self, state: State) -> list[tuple[Any, Any]]:
        indices = self._particles(state)
        return [(_Part(state, index), law) for index, law in zip(indices, self.laws, strict=True) if len(index)]


def _is_still(known: Remembered | None, material: Tensor | None) -> bool:
    return known is not None and known.is_now(material)


OF_SCENES = ("dt", "time", "impulse")
"""Fields without a row per particle."""


class _Part:
    """Some particles of a state; fields are gathered on access."""

    def __init__(self, state: State, index: Tensor) -> None:
        self.index = index
        self.particles = getattr(state, "particles", state.x.shape[0])  # Of the whole state, also in a part of a part.
        self.ids = index if state.ids is None else state.ids.index_select(0, index)
        self._state = state

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._state, name)
        if isinstance(value, Tensor) and name not in OF_SCENES:
            value = _take(value, self.index)
            setattr(self, name, value)
        elif name == "extra":
            value = {key: _take(t, self.index) for key, t in value.items()}
            setattr(self, name, value)
        return value
