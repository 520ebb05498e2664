"""Random states of plastic laws."""

import torch
from torch import Tensor

import torch_mpm as mpm
from cases.matrices import deformation


def data(law: str, count: int) -> tuple[list[Tensor], list[Tensor]]:
    """Random parameters and history, [P] each, such that strains of a few percent yield or do not."""

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, dtype=torch.float64)

    elastic = [uniform(1, 2), uniform(0.5, 3)]
    extra = {
        "von_mises": [uniform(0.02, 0.3), uniform(0, 1)],
        "herschel_bulkley": [uniform(0, 0.2), uniform(0.05, 2), uniform(0.3, 2), uniform(0.01, 1)],
        "snow": [uniform(0.02, 0.08), uniform(0.01, 0.08), uniform(2, 10)],
        "cam_clay": [uniform(0.5, 1.6), uniform(0.05, 0.4), uniform(3, 20), uniform(0, 1)],
    }
    history = {"von_mises": [uniform(0, 0.3)], "snow": [uniform(-0.2, 0.1)], "cam_clay": [uniform(-0.05, 0.05)]}
    return elastic + extra.get(law, []), history.get(law, [])


def random_states(count: int, dim: int) -> Tensor:
    size = 10 ** (-2 + 1.5 * torch.rand(count, 1, dtype=torch.float64))
    return deformation(size * (torch.randn(count, dim, dtype=torch.float64) - 0.3))


def to(values: list[Tensor], *target: object) -> list[Tensor]:
    return [v.to(*target) for v in values]


def error(value: Tensor, expected: Tensor) -> float:
    return float((value.cpu().double() - expected).abs().max() / expected.abs().max().clamp_min(1e-300))


def state_of(F: Tensor, **fields: object) -> mpm.State:
    P, D = F.shape[:2]
    x = torch.full((P, D), 0.5, dtype=F.dtype, device=F.device)
    one = torch.ones(P, dtype=F.dtype, device=F.device)
    return mpm.State(x, torch.zeros_like(x), one, one, F=F, **fields)
