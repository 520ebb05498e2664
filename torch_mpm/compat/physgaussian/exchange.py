"""Input and output tensors of PhysGaussian's simulator."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ...errors import check_like
from ...ops.svd import polar
from ...state.state import State

ARRAYS = {
    **{"particle_x": "x", "particle_v": "v", "particle_C": "C", "particle_F": "F", "particle_F_trial": "F"},
    **{"particle_vol": "volume", "particle_mass": "mass"},
}
"""Arrays of particles, by fields of the state."""


class Exchange:
    """Imports and exports of the particles of a simulator, after its pending substeps."""

    _state: State | None
    _covariance: Tensor | None
    _exports: dict[str, Any]

    def _stress(self) -> Tensor:
        """Kirchhoff stress of the present particles [P, 3, 3] [Pa]."""
        raise NotImplementedError

    def _flush(self) -> None:
        """Compute the pending substeps."""
        raise NotImplementedError

    def _loaded(self) -> State:
        if self._state is None:
            raise ValueError("there are no particles: call load_initial_data_from_torch first")
        return self._state

    def _flushed(self) -> State:
        self._flush()
        return self._loaded()

    @property
    def state(self) -> State:
        """Particles as a state of torch_mpm; may be assigned."""
        return self._flushed()

    @state.setter
    def state(self, state: State) -> None:
        self._flush()
        self._state = state

    def initial_covariance(self) -> Tensor:
        """Covariances of the Gaussians at the start, [P, 6]."""
        state = self._loaded()
        return torch.zeros_like(state.x).repeat(1, 2) if self._covariance is None else self._covariance

    def assign_covariance(self, cov: Tensor) -> None:
        """Set the covariances of the Gaussians at the start, [P, 6] or [6 P]: xx xy xz yy yz zz."""
        x = self._loaded().x
        self._covariance = cov.to(x).reshape(-1, 6)
        check_like("tensor_cov", self._covariance, x, (len(x), 6), "[P, 6]")

    def exported(self, name: str) -> Tensor:
        """particle_cov, particle_R or particle_stress; the same tensor until the particles change."""
        state, grad = self._flushed(), torch.is_grad_enabled()
        if self._exports.get("of") is not state or self._exports["grad"] != grad:
            self._exports = {"of": state, "grad": grad}
        if name not in self._exports:
            self._exports[name] = {
                "particle_cov": self._moved_covariance,
                "particle_R": self._transposed_rotation,
                "particle_stress": self._stress,
            }[name]()
        result: Tensor = self._exports[name]
        return result

    def _import(self, name: str, value: Tensor | None, rows: tuple[int, ...], clone: bool) -> None:
        if value is None:
            return
        state = self._flushed()
        values = value.to(state.x).reshape(len(state), *rows)
        shared = clone and values.data_ptr() == value.data_ptr()
        self._state = state.replace(**{name: values.clone() if shared else values})

    def import_particle_x_from_torch(self, tensor_x: Tensor | None, clone: bool = True, device: Any = None) -> None:
        """Positions [P, 3] [m], copied unless `clone` is False. Gradients pass; given tensors are not written to."""
        self._import("x", tensor_x, (3,), clone)

    def import_particle_v_from_torch(self, tensor_v: Tensor | None, clone: bool = True, device: Any = None) -> None:
        """Velocities [P, 3] [m/s]."""
        self._import("v", tensor_v, (3,), clone)

    def import_particle_F_from_torch(self, tensor_F: Tensor | None, clone: bool = True, device: Any = None) -> None:
        """Deformation gradients, [P, 3, 3] or rows of nine."""
        self._import("F", tensor_F, (3, 3), clone)

    def import_particle_C_from_torch(self, tensor_C: Tensor | None, clone: bool = True, device: Any = None) -> None:
        """Affine velocity fields [1/s], [P, 3, 3] or rows of nine."""
        self._import("C", tensor_C, (3, 3), clone)

    def export_particle_x_to_torch(self) -> Tensor:
        """Positions [P, 3] [m]."""
        return self._flushed().x

    def export_particle_v_to_torch(self) -> Tensor:
        """Velocities [P, 3] [m/s]."""
        return self._flushed().v

    def export_particle_F_to_torch(self) -> Tensor:
        """Deformation gradients of the current positions, rows of nine [P, 9]."""
        return self._rows(self._flushed().F)

    def export_particle_C_to_torch(self) -> Tensor:
        """Affine velocity fields, rows of nine [P, 9] [1/s]."""
        return self._rows(self._flushed().C)

    def export_particle_R_to_torch(self, device: Any = None) -> Tensor:
        """The transposed rotations Rᵀ of the polar decomposition F = R S, rows of nine [P, 9]."""
        return self._rows(self.exported("particle_R"))

    def export_particle_cov_to_torch(self, device: Any = None) -> Tensor:
        """Covariances F Σ Fᵀ of the Gaussians, six numbers xx xy xz yy yz zz per particle in one row [6 P]."""
        return self.exported("particle_cov")

    def export_particle_stress_to_torch(self) -> Tensor:
        """Kirchhoff stress of the present particles [P, 3, 3] [Pa], of F after the return map."""
        return self.exported("particle_stress")

    def _transposed_rotation(self) -> Tensor:
        F = self._loaded().F
        assert F is not None
        return polar(F).R.mT

    def _moved_covariance(self) -> Tensor:
        F = self._loaded().F
        assert F is not None
        return moved_covariance(F, self.initial_covariance())

    def _rows(self, matrices: Tensor | None) -> Tensor:
        assert matrices is not None
        return matrices.reshape(-1, 9)


def moved_covariance(F: Tensor, given: Tensor) -> Tensor:
    """F Σ Fᵀ as one row [6 P] of xx xy xz yy yz zz, for F [P, 3, 3] and Σ [P, 6] in this form."""
    full = given[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(1, (3, 3))
    moved = F @ full @ F.mT
    return moved.flatten(1)[:, [0, 1, 2, 4, 5, 8]].reshape(-1)
