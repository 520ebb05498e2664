"""The batched simulator of kywind's warp-mpm: as many scenes as a batch has, with dx in place of n_grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ...errors import check_count, check_number, check_vector, shape_of
from ...grid.grid import Grid
from .condition_list import Nodes
from .simulator import MPM_Simulator_WARP, sampled

Extent = float | Sequence[float]


class BatchedSimulator(MPM_Simulator_WARP):
    """`MPM_Simulator_WARP` of kywind's warp-mpm: B scenes of P particles in the box [0, grid_lim], with the forces of
    MLS-MPM times 3/4, as there.

    Imports and exports are [B, P, ...]; conditions act in all scenes, on particles by their own positions.

    Args:
        n_particles: not used before data are loaded.
        batch_size: B.
        dx: node distance [m].
        grid_lim: edges of the domain [m].
        device: None for that of the data.
        strict: as for `MPM_Simulator_WARP`.
    """

    def __init__(
        self, n_particles: int = 10, batch_size: int = 2, dx: float = 0.01, grid_lim: Extent = (1.0, 1.0, 1.0),
        device: torch.device | str | None = None, *, strict: bool = False,
    ) -> None:  # fmt: skip
        check_count("n_particles", n_particles)
        self._prepare("kywind", strict)
        self.initialize(n_particles, batch_size, dx, grid_lim, device)

    def initialize(  # type: ignore[override]
        self,
        n_particles: int = 10,
        batch_size: int = 2,
        dx: float = 0.01,
        grid_lim: Extent = (1.0, 1.0, 1.0),
        device: torch.device | str | None = None,
    ) -> None:
        """Discard everything except the size of the grid and the dialect."""
        super().initialize(n_particles)
        self.batch_size = check_count("batch_size", batch_size, 1)
        self._set_size(dx, grid_lim)

    def _set_size(self, dx: float, grid_lim: Extent) -> None:
        edges = (grid_lim,) * 3 if isinstance(grid_lim, (int, float)) else grid_lim
        self._edges = check_vector("grid_lim", list(edges), 3)
        self._spacing = float(check_number("dx", dx, "positive", lambda v: v > 0))
        self._cells = tuple(int(edge / self._spacing) for edge in self._edges)
        if min(self._cells) < 1:
            raise ValueError(f"grid_lim must be at least dx = {dx} on every axis, got {grid_lim}")
        self._step = self._created = None

    def load_initial_data_from_torch(  # type: ignore[override]
        self,
        tensor_x: Tensor,
        tensor_volume: Tensor,
        tensor_cov: Tensor | None = None,
        batch_size: int = 2,
        dx: float = 0.01,
        grid_lim: Extent = (1.0, 1.0, 1.0),
        device: torch.device | str | None = None,
    ) -> None:
        """Particles at rest, and a new simulation.

        Args:
            tensor_x: positions [B, P, 3] [m].
            tensor_volume: [B, P] [m³].
            tensor_cov: covariances [B, P, 6] or [B, 6 P].
            batch_size, dx, grid_lim, device: as for the class.
        """
        if not isinstance(tensor_x, Tensor) or tensor_x.dim() != 3 or len(tensor_x) != batch_size:
            raise ValueError(f"tensor_x must have shape [B, P, 3] with B = {batch_size}, got {shape_of(tensor_x)}")
        self.initialize(tensor_x.shape[1], batch_size, dx, grid_lim)
        self._place(tensor_x.reshape(-1, 3).to(device=device), tensor_volume.reshape(-1), tensor_cov)
        state = self._loaded()
        scene = torch.arange(batch_size, dtype=torch.int32, device=state.x.device).repeat_interleave(self.n_particles)
        self._state = state.replace(scene=scene)

    def load_from_sampling(  # type: ignore[override]
        self,
        sampling_h5: str,
        batch_size: int = 2,
        dx: float = 0.01,
        grid_lim: Extent = (1.0, 1.0, 1.0),
        fps: int = -1,
        device: torch.device | str | None = None,
    ) -> None:
        """The same particles in all scenes, from an HDF5 file with x [3, P] and particle_volume [1, P] (needs h5py).

        Args:
            sampling_h5: the file.
            batch_size, dx, grid_lim, device: as for the class.
            fps: number of particles that are chosen by farthest point sampling; all if not positive.
        """
        x, volume = sampled(sampling_h5)
        if 0 < fps < len(x):
            chosen = farthest_points(x, fps)
            x, volume = x[chosen], volume[chosen]
        self.load_initial_data_from_torch(
            x.expand(batch_size, -1, -1), volume.expand(batch_size, -1), None, batch_size, dx, grid_lim, device
        )

    def set_parameters_dict(self, kwargs: Mapping[str, Any] | None = None, device: Any = None) -> None:
        """As for `MPM_Simulator_WARP`, with dx in place of n_grid, and parameters [B, P] too."""
        given = dict(kwargs or {})
        dx, edges = given.pop("dx", self._spacing), given.pop("grid_lim", self._edges)
        if "n_grid" in given:
            raise ValueError("n_grid must not be given: kywind's warp-mpm has dx in its place")
        flat = {k: v.reshape(-1) if isinstance(v, Tensor) and v.dim() == 2 else v for k, v in given.items()}
        super().set_parameters_dict(flat)
        self._set_size(dx, edges)

    def shaped(self, rows: Any) -> Any:
        """A tensor [B P, ...] as [B, P, ...]."""
        return rows.unflatten(0, (self.batch_size, -1)) if isinstance(rows, Tensor) else rows

    def sizes(self) -> dict[str, Any]:
        """Sizes of the grid and of the batch."""
        sizes: dict[str, Any] = {"dx": self._spacing, "inv_dx": 1 / self._spacing, "batch_size": self.batch_size}
        for axis, cells, edge in zip("xyz", self._cells, self._edges, strict=True):
            sizes |= {f"n_grid_{axis}": cells, f"grid_lim_{axis}": edge}
        return sizes | {"n_particles": self.n_particles}

    def export_particle_x_to_torch(self) -> Tensor:
        """Positions [B, P, 3] [m]."""
        return self.shaped(super().export_particle_x_to_torch())

    def export_particle_v_to_torch(self) -> Tensor:
        """Velocities [B, P, 3] [m/s]."""
        return self.shaped(super().export_particle_v_to_torch())

    def _rows(self, matrices: Tensor | None) -> Tensor:
        return self.shaped(super()._rows(matrices))

    def export_particle_cov_to_torch(self, device: Any = None) -> Tensor:
        """Covariances F Σ Fᵀ [B, 6 P]."""
        return super().export_particle_cov_to_torch(device).reshape(self.batch_size, -1)

    @property
    def _dx(self) -> float:
        return self._spacing

    def _grid(self) -> Grid:
        upper = [n * self._spacing for n in self._cells]
        return Grid(self._spacing, (0.0,) * 3, upper, self.batch_size)

    @property
    def _nodes(self) -> Nodes:
        return Nodes(self._spacing, self._cells, self._loaded().x[:0], self.strict)  # type: ignore[arg-type]


def farthest_points(x: Tensor, count: int) -> Tensor:
    """Indices of points [count], each the farthest one from those before; the first is drawn at random."""
    nearest = torch.full_like(x[:, 0], torch.inf)
    found = [int(torch.randint(len(x), ()))]
    for _ in range(count - 1):
        nearest = torch.minimum(nearest, (x - x[found[-1]]).square().sum(1))
        found.append(int(nearest.argmax()))
    return torch.tensor(found, device=x.device)
