"""A network that acts on the nodes."""

import torch

from cases.rollouts import F64


def network(dim: int, device: str) -> torch.nn.Module:
    torch.manual_seed(5)
    layers = torch.nn.Sequential(torch.nn.Linear(dim * dim, 16), torch.nn.Tanh(), torch.nn.Linear(16, dim * dim))

    class Law(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layers = layers

        def forward(self, F):
            eye = torch.eye(dim, dtype=F.dtype, device=F.device)
            tau = 1e3 * (F @ F.mT - eye) + 1e2 * self.layers((F - eye).flatten(1)).view_as(F)
            return 0.5 * (tau + tau.mT)

    return Law().to(device, F64)
