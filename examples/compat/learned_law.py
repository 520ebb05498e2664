"""Train the networks of NCLaw as elasticity and plasticity on the motion of a von Mises solid, with changed imports.

The networks are those of the paper, R sym M(σ, FᵀF, det F) Fᵀ and F + α R sym M(...), called between steps. As in
NCLaw, loss and gradients restart from the data every few steps.
"""

import argparse
from types import SimpleNamespace

import torch

from torch_mpm.compat.nclaw import material
from torch_mpm.compat.nclaw.sim import (
    MPMDiffSim,
    MPMInitData,
    MPMModelBuilder,
    MPMStateInitializer,
    MPMStaticsInitializer,
)

SIM = SimpleNamespace(num_grids=20, dt=5e-4, bound=3, gravity=[0.0, -9.8, 0.0], bc="freeslip", eps=1e-7)
CUBE = SimpleNamespace(type="cube", center=[0.5, 0.3, 0.5], size=[0.2, 0.2, 0.2], resolution=6, mode="uniform")
BODY = SimpleNamespace(shape=CUBE, rho=1e3, clip_bound=0.5, span=[0, 1000])
NETWORK = SimpleNamespace(
    layer_widths=[64, 64], no_bias=True, norm=None, nonlinearity="gelu", normalize_input=True, alpha=1e-3
)
SEGMENT = 10  # steps between two data points


def main(epochs: int = 20, steps: int = 40) -> tuple[float, float]:
    """Returns the mean error of positions before and after training [m]."""
    torch.manual_seed(0)
    model = MPMModelBuilder().parse_cfg(SIM).finalize(requires_grad=True)
    simulate = MPMDiffSim(model)
    statics_initializer, state_initializer = MPMStaticsInitializer(model), MPMStateInitializer(model)
    group = MPMInitData.get(BODY)
    group.set_lin_vel([1.0, -3.0, 0.5])
    group.set_ang_vel([4.0, 0.0, 4.0])
    statics_initializer.add_group(group)
    state_initializer.add_group(group)
    statics = statics_initializer.finalize()
    state, _ = state_initializer.finalize()
    start = state.to_torch()[:4]

    truth = SimpleNamespace(E=1e5, nu=0.3, sigma_y=3e3, random=False)
    with torch.no_grad():
        elasticity, plasticity = material.SigmaElasticity(truth), material.VonMisesPlasticity(truth)
        data = [start]
        for _ in range(steps):
            x, v, C, F = data[-1]
            x, v, C, F = simulate(statics, x, v, C, F, elasticity(F))
            data.append((x, v, C, plasticity(F)))

    elasticity = material.InvariantFullMetaElasticity(NETWORK)
    plasticity = material.InvariantFullMetaPlasticity(NETWORK)
    scale = 1e5  # [Pa], scale of the network's output
    optimizer = torch.optim.Adam([*elasticity.parameters(), *plasticity.parameters()], lr=1e-2)
    errors = []
    for epoch in range(epochs):
        loss, miss = torch.zeros(()), 0.0
        for k in range(steps):
            if k % SEGMENT == 0:
                x, v, C, F = data[k]
            x, v, C, F = simulate(statics, x, v, C, F, scale * elasticity(F))
            F = plasticity(F)
            loss = loss + (v - data[k + 1][1]).square().mean()
            miss += float((x - data[k + 1][0]).detach().norm(dim=1).mean()) / steps
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(miss)
        print(f"{epoch:3d}  positions are off by {1e3 * miss:.4f} mm", flush=True)
    return errors[0], errors[-1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--epochs", type=int, default=20)
    main(parser.parse_args().epochs)
