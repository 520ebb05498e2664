"""Energy of runs whose time step is chosen by the limit of the moment."""

import numpy as np
import pytest
import torch

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

from torch_mpm.scene import Scene
from torch_mpm.scene import run as module


def growth(strain, seed, tmp_path):
    """Energy of a free particle with a strain at the end of a run, over that at its start."""
    np.savez(tmp_path / "one.npz", x=np.array([[0.53, 0.53]]), volume=np.array([1e-6]))
    scene = Scene.from_words(
        {
            "duration": 60.0,
            "fps": 1 / 60,
            "precision": "float64",
            "grid": {"lower": [0, 0], "upper": [1, 1], "dx": 0.1},
            "material": {"a": {"law": "neo_hookean", "E": 1e4, "nu": 0.3}},
            "body": [{"shape": "points", "file": "one.npz", "material": "a"}],
        },
        folder=tmp_path,
    )
    simulation = module.Simulation(scene, scene.build("cpu"))
    law, grid = simulation.step.law, simulation.step.grid
    g = torch.Generator().manual_seed(seed)
    F = torch.eye(2).double() + strain * torch.randn(1, 2, 2, generator=g, dtype=torch.float64)
    simulation.state = simulation.step.prepare(simulation.state.replace(F=F, C=torch.zeros_like(F)))

    def energy():
        state = simulation.state
        motion = state.v.square().sum() + state.C.square().sum() / grid.inverse_inertia
        return float(0.5 * state.mass * motion + law.energy(state).sum())

    first = energy()
    with torch.no_grad():
        simulation._advance(0.0, 60.0)
    return energy() / first


@pytest.mark.parametrize("strain", [0.2, 0.3])
def test_lone_particles_keep_their_energy(strain, tmp_path):
    """A dt that followed the limit of the moment would feed it to 9 times and more."""
    assert all(0.5 < growth(strain, seed, tmp_path) < 3 for seed in (1, 2))
