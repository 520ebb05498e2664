"""A column of Gaussians bends under a push: a script for PhysGaussian's simulator with a changed import."""

import argparse
from pathlib import Path

import torch

from torch_mpm.compat.physgaussian import MPM_Simulator_WARP, decode_param_json, set_boundary_conditions


def column(n_grid: int, grid_lim: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Centres [P, 3], volumes [P] and covariances [P, 6] of eight Gaussians per cell, long in x and thin in z."""
    spacing = grid_lim / n_grid / 2
    axes = [torch.arange(low, high, spacing) + spacing / 2 for low, high in ((0.85, 1.15), (0.85, 1.15), (0.6, 1.4))]
    centres = torch.cartesian_prod(*axes)
    radii = spacing * torch.tensor([1.0, 0.5, 0.25])
    covariance = torch.tensor([radii[0] ** 2, 0.0, 0.0, radii[1] ** 2, 0.0, radii[2] ** 2])
    return centres, torch.full((len(centres),), spacing**3), covariance.repeat(len(centres), 1)


def main(config: Path, frames: int | None = None) -> torch.Tensor:
    """Returns the positions at the end [P, 3]."""
    material, boundary_conditions, time, _, _ = decode_param_json(config)
    centres, volumes, covariances = column(material["n_grid"], material["grid_lim"])

    solver = MPM_Simulator_WARP(10)
    solver.load_initial_data_from_torch(
        centres, volumes, covariances, n_grid=material["n_grid"], grid_lim=material["grid_lim"]
    )
    solver.set_parameters_dict(material)
    set_boundary_conditions(solver, boundary_conditions, time)
    solver.finalize_mu_lam()

    substeps = round(time["frame_dt"] / time["substep_dt"])
    for frame in range(time["frame_num"] if frames is None else frames):
        for _ in range(substeps):
            solver.p2g2p(frame, time["substep_dt"])
        position = solver.export_particle_x_to_torch()
        covariance = solver.export_particle_cov_to_torch().view(-1, 6)
        rotation = solver.export_particle_R_to_torch().view(-1, 3, 3)
        top = position[:, 2] > 1.3
        tilt = torch.rad2deg(torch.acos(rotation[top, 2, 2].clamp(-1, 1))).mean()
        print(
            f"{solver.time:.3f} s: top at x = {position[top, 0].mean():.3f} m, tilted by {tilt:.1f} degrees, "
            f"Gaussians {covariance[:, 0].sqrt().mean() * 1e3:.1f} mm long",
            flush=True,
        )
    return position


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", type=Path, default=Path(__file__).with_name("gaussians.json"))
    parser.add_argument("--frames", type=int)
    arguments = parser.parse_args()
    main(arguments.config, arguments.frames)
