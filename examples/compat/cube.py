"""A cube of jelly or sand falls on a floor: a script for MPM-PyTorch with a changed import."""

import argparse

import torch

from torch_mpm.compat.mpm_pytorch import MPMSolver, get_constitutive, set_boundary_conditions

FLOOR = {
    **{"type": "surface_collider", "point": [1.0, 1.0, 0.02], "normal": [0.0, 0.0, 1.0], "surface": "sticky"},
    **{"friction": 0.0, "start_time": 0.0, "end_time": 1e3},
}
MODELS = {
    "jelly": ("CorotatedElasticity", "IdentityPlasticity"),
    "sand": ("StVKElasticity", "DruckerPragerPlasticity"),
}


def main(name: str = "jelly", frames: int = 10, steps_per_frame: int = 100) -> torch.Tensor:
    """Returns the positions at the end [P, 3]."""
    axis = torch.linspace(0.25, 0.75, 20)
    x = torch.cartesian_prod(axis, axis, axis - 0.1)
    solver = MPMSolver(x)
    set_boundary_conditions(solver, [FLOOR])
    elasticity, plasticity = (get_constitutive(model) for model in MODELS[name])

    v = torch.tensor([0.0, 0.0, -0.5]).repeat(len(x), 1)
    C = torch.zeros(len(x), 3, 3)
    F = torch.eye(3).repeat(len(x), 1, 1)
    for _ in range(frames):
        for _ in range(steps_per_frame):
            stress = elasticity(F)
            x, v, C, F = solver(x, v, C, F, stress)
            F = plasticity(F)
        height = x[:, 2]
        print(f"{solver.time:.3f} s: heights from {height.min():.3f} to {height.max():.3f} m", flush=True)
    return x


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=MODELS, nargs="?", default="jelly")
    parser.add_argument("--frames", type=int, default=10)
    arguments = parser.parse_args()
    with torch.inference_mode():
        main(arguments.name, arguments.frames)
