"""Find the stiffness of a jelly cube, and the velocity of its throw, from noisy pictures of one camera.

The particles are splatted on the picture: each is a Gaussian spot of its size, and spots add up to opacity. This is
plain torch and differentiable, so that the gradient of the difference between pictures passes through the camera and
through the simulation, to Young's modulus, Poisson's ratio and the three components of the initial velocity. Motion of
the cube away from the camera shows only in its size.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch
from torch import Tensor, nn

import torch_mpm as mpm

DX, DT = 1 / 16, 2e-3  # [m], [s]
STEPS, EVERY = 240, 20  # steps between two pictures
HEIGHT, WIDTH = 64, 96  # of the pictures [pixels]
NOISE = 0.05  # deviation of the noise of each pixel, between 0 and 1
TRUE = {"E": 3e4, "nu": 0.35, "vx": 2.0, "vy": -0.5, "vz": 0.6}  # [Pa], –, [m/s]
BOUNDS = {"E": 1e5, "nu": 0.5}  # above; 0 below
GUESS = {"E": 1e4, "nu": 0.2, "vx": 1.0, "vy": 0.0, "vz": 0.0}


# ---- the camera


def project(x: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel coordinates (column, row) [..., 2] of positions [..., 3] [m], and pixels per metre there [...].

    A pinhole camera in front of the scene, which looks along −z and 12° down.
    """
    tilt, focal_length = math.radians(12), 150.0  # [pixels]
    cos, sin = math.cos(tilt), math.sin(tilt)
    to_right, up, ahead = (x - x.new_tensor([0.75, 0.85, 2.7])).unbind(-1)
    distance = -cos * ahead - sin * up
    scale = focal_length / distance
    column = WIDTH / 2 + scale * to_right
    row = HEIGHT / 2 - scale * (cos * up - sin * ahead)
    return torch.stack([column, row], -1), scale


def splat(x: Tensor) -> Tensor:
    """Pictures [T, HEIGHT, WIDTH] with opacities between 0 and 1 of particles at positions [T, P, 3]."""
    center, scale = project(x)
    radius = 0.3 * DX * scale

    def spots(coordinate: Tensor, pixels: int) -> Tensor:  # [T, P, pixels]
        middle = torch.arange(pixels, device=x.device, dtype=x.dtype) + 0.5
        return torch.exp(-((middle - coordinate[..., None]) / radius[..., None]).square() / 2)

    rows, columns = spots(center[..., 1], HEIGHT), spots(center[..., 0], WIDTH)
    return 1 - torch.exp(-(rows.mT @ columns))  # a Gaussian spot is a product of rows and columns


def difference(a: Tensor, b: Tensor) -> Tensor:
    """Mean square of the difference of pictures, added up over five resolutions.

    In coarse pictures, distant spots overlap.
    """
    total = (a - b).square().mean()
    for _ in range(4):
        a, b = (nn.functional.avg_pool2d(pictures, 2, ceil_mode=True) for pictures in (a, b))
        total = total + (a - b).square().mean()
    return total


# ---- the fit


def pictures(start: mpm.State, E: Tensor, nu: Tensor, *velocity: Tensor) -> Tensor:
    """Pictures [STEPS / EVERY + 1, HEIGHT, WIDTH] of a cube that is thrown on the floor."""
    grid = mpm.Grid(DX, lower=(0, 0, 0), upper=(1.6, 1, 1))
    step = mpm.Step(grid, mpm.NeoHookean(E=E, nu=nu), (0, -9.8, 0), mpm.Walls("separate", friction=0.3))
    thrown = start.replace(v=start.v + torch.stack(velocity))
    return splat(mpm.frames(step, thrown, STEPS, DT, EVERY, fields=["x"]).fields["x"])


def fit(start: mpm.State, data: Tensor, iterations: int) -> list[dict[str, float]]:
    """Unknowns after each iteration, including the guess."""
    guess, bounds = (start.x.new_tensor(list(values.values())) for values in (GUESS, BOUNDS))
    change = torch.zeros_like(guess).requires_grad_()  # of the logits of E and nu, and of the velocity
    optimizer = torch.optim.LBFGS([change], max_iter=1, max_eval=10, line_search_fn="strong_wolfe")
    found = [GUESS]

    def values() -> Tensor:
        return torch.cat([bounds * ((guess[:2] / bounds).logit() + change[:2]).sigmoid(), guess[2:] + change[2:]])

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = difference(pictures(start, *values()), data)
        loss.backward()
        return loss

    for k in range(iterations):
        loss = optimizer.step(closure).item()
        found.append(dict(zip(GUESS, values().tolist(), strict=True)))
        print(f"{k:3d}  {loss:.5f}  " + "  ".join(f"{name} {v:.4g}" for name, v in found[-1].items()), flush=True)
    return found


def draw(data: Tensor, seen: dict[str, Tensor], found: list[dict[str, float]], path: Path) -> None:
    """Some pictures of the camera and of the simulation, and the errors of the unknowns."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.4), dpi=100)
    shown, errors = figure.subplots(1, 2, width_ratios=(2.4, 1))
    strips = [torch.cat(list(frames[4::2]), 1) for frames in (data, *seen.values())]
    shown.imshow(torch.cat(strips).cpu().numpy(), cmap="gray", vmin=0, vmax=1)
    shown.set(title="pictures in the course of time", xticks=[], yticks=[(k + 0.5) * HEIGHT for k in range(3)])
    shown.set_yticklabels(["camera", *seen])
    for name, true in TRUE.items():
        errors.semilogy([abs(now[name] - true) / abs(true) for now in found], label=name)
    errors.set(title="relative errors", xlabel="iteration")
    errors.legend()
    figure.tight_layout()
    figure.savefig(path)


def main(out: Path, device: str = "cpu", iterations: int = 25) -> dict[str, float]:
    """Returns the relative error of each unknown."""
    torch.manual_seed(0)
    cube = mpm.seed.box((0.15, 0.4, 0.35), (0.45, 0.7, 0.65), DX, per_cell=8)
    start = mpm.State.at_rest(cube, density=1000.0, device=device)

    def of(unknowns: dict[str, float]) -> Tensor:
        with torch.no_grad():
            return pictures(start, *start.x.new_tensor(list(unknowns.values())))

    data = of(TRUE)
    data = data + NOISE * torch.randn_like(data)
    found = fit(start, data, iterations)
    out.mkdir(parents=True, exist_ok=True)
    draw(data, {"guess": of(GUESS), "found": of(found[-1])}, found, out / "fit_images.png")
    return {name: abs(found[-1][name] - true) / abs(true) for name, true in TRUE.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/fit_images"), help="folder of the picture")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--iterations", type=int, default=25)
    torch.set_num_threads(1)  # A thousand particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    found = main(options.out, options.device, options.iterations)
    print("relative errors: " + ", ".join(f"{name} {error:.2%}" for name, error in found.items()))
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'fit_images.png'}")
