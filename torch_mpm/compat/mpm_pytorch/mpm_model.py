"""`MPMModel` of OmniPhysGS, the solver of MPM-PyTorch with configurations."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..settings import setting
from .mpm_solver import MPMSolver


class MPMModel(MPMSolver):
    """`MPMSolver` of two configurations: mappings, or objects with attributes.

    Args:
        sim_params: num_grids, dt [s], gravity [m/s²], and, where they are not the defaults of `MPMSolver`, clip_bound,
            damping and boundary_condition, which is stored.
        material_params: rho [kg/m³] and size [m].
        init_pos, enable_train, device: as for `MPMSolver`.

    Raises:
        ValueError: for a missing value.
    """

    def __init__(
        self,
        sim_params: Any,
        material_params: Any,
        init_pos: Tensor,
        enable_train: bool = False,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(
            init_pos,
            rho=setting(material_params, "rho"),
            num_grids=setting(sim_params, "num_grids"),
            dt=setting(sim_params, "dt"),
            gravity=list(setting(sim_params, "gravity")),
            clip_bound=setting(sim_params, "clip_bound", 0.5),
            damping=setting(sim_params, "damping", 1.0),
            size=list(setting(material_params, "size")),
            enable_train=enable_train,
            device=device,
        )
        self.boundary_condition = setting(sim_params, "boundary_condition", None)
