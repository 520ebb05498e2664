"""Input and output tensors of PhysGaussian's simulator."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ...ops.svd import polar
from ...state.state import State


class Exchange:
    """Imports and exports of the particles of a simulator, after its pending substeps."""

    _state: State | None
    _covariance: Tensor | None

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

    def _import(self, name: str, value: Tensor | None, rows: tuple[int, ...]) -> None:
        if value is None:
            return
        state = self._flushed()
        self._state = state.replace(**{name: value.to(state.x).reshape(len(state), *rows)})

    def import_particle_x_from_torch(self, tensor_x: Tensor | None, clone: bool = True, device: Any = None) -> None:
        """Positions [P, 3] [m]. Gradients pass; given tensors are not written to."""
        self._import("x", tensor_x, (3,))

    def import_particle_v_from_torch(self, tensor_v: Tensor | None, clone: bool = True, device: Any = None) -> None:
        """Velocities [P, 3] [m/s]."""
        self._import("v", tensor_v, (3,))

    def import_particle_F_from_torch(self, tensor_F: Tensor | None, clone: bool = True, device: Any = None) -> None:
        """Deformation gradients, [P, 3, 3] or rows of nine."""
        self._import("F", tensor_F, (3, 3))

    def import_particle_C_from_torch(self, tensor_C: Tensor | None, clone: bool = True, device: Any = None) -> None:
        """Affine velocity fields [1/s], [P, 3, 3] or rows of nine."""
        self._import("C", tensor_C, (3, 3))

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
        state = self._flushed()
        assert state.F is not None
        return self._rows(polar(state.F).R.mT)

    def export_particle_cov_to_torch(self, device: Any = None) -> Tensor:
        """Covariances F Σ Fᵀ of the Gaussians, six numbers xx xy xz yy yz zz per particle in one row [6 P]."""
        state = self._flushed()
        assert state.F is not None
        given = torch.zeros_like(state.x).repeat(1, 2) if self._covariance is None else self._covariance
        full = given[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(1, (3, 3))
        moved = state.F @ full @ state.F.mT
        return moved.flatten(1)[:, [0, 1, 2, 4, 5, 8]].reshape(-1)

    def _rows(self, matrices: Tensor | None) -> Tensor:
        assert matrices is not None
        return matrices.reshape(-1, 9)
