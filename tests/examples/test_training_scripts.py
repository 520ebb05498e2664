"""The scripts that train and fit, in short: each gets most of the way to its result, and draws its picture."""

import math
from pathlib import Path

import pytest
import torch
from helpers import example

pytest.importorskip("matplotlib")
pytestmark = pytest.mark.usefixtures("one_thread")  # as the scripts run


def drawn(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


def test_throw(device, tmp_path, capsys):
    assert example("throw").main(tmp_path, device, iterations=4) < 0.01
    assert drawn(tmp_path / "throw.png")


def test_network_on_the_grid_learns(capsys):
    first, last = example("grid_network").main(iterations=3)
    assert last < 0.75 * first


@pytest.mark.thorough
def test_parameters_are_recovered(device, tmp_path, capsys):
    errors = example("recover_parameters").main(tmp_path, device, iterations=9)
    assert errors.keys() == {"E", "nu", "friction_angle"} and max(errors.values()) < 0.01
    assert drawn(tmp_path / "recover_parameters.png")


@pytest.mark.thorough
def test_stiffness_field_is_recovered(device, tmp_path, capsys):
    """The guess is off by 29%."""
    assert example("recover_stiffness_field").main(tmp_path, device, cells=12, iterations=25) < 0.03
    assert drawn(tmp_path / "recover_stiffness_field.png")


@pytest.mark.thorough
def test_law_is_learnt(device, tmp_path, capsys):
    """Before training, the ring is off by 10% of its diameter in so short a time."""
    assert example("learn_law").main(tmp_path, device, iterations=12, steps=60) < 0.05
    assert drawn(tmp_path / "learn_law.png")


def test_learnt_law_has_an_energy():
    """The stress of the network is that of its energy: τ = ∂ψ/∂F Fᵀ."""
    network = example("learn_law").Energy().double()
    F = (torch.eye(2) + 0.2 * torch.randn(5, 2, 2)).double().requires_grad_()
    J = torch.linalg.det(F)
    (by_F,) = torch.autograd.grad(network.energy(F.square().sum((1, 2)) / J - 2, J.log()).sum(), F)
    torch.testing.assert_close(network(F), by_F @ F.mT)


@pytest.mark.thorough
def test_walker_learns(device, tmp_path, capsys):
    """Before training it comes 5 mm far in a second."""
    pytest.importorskip("imageio_ffmpeg")
    assert example("walker").main(tmp_path, device, iterations=20, shown=1.0) > 0.03
    assert drawn(tmp_path / "walker.png") and (tmp_path / "walker.mp4").stat().st_size > 1000


@pytest.mark.thorough
def test_friction_is_learnt(device, tmp_path, capsys):
    """No constant coefficient comes nearer than 27%."""
    assert example("learn_friction").main(tmp_path, device, iterations=6, steps=150) < 0.1
    assert drawn(tmp_path / "learn_friction.png")


@pytest.mark.thorough
def test_pictures_are_fitted(device, tmp_path, capsys):
    script = example("fit_images")
    script.STEPS = 200
    errors = script.main(tmp_path, device, iterations=9)
    assert max(errors[name] for name in ("E", "vx", "vy", "vz")) < 0.1
    assert drawn(tmp_path / "fit_images.png")


def test_camera_sees_particles_where_they_are():
    """A spot is at the intersection of its ray with the picture, and grows as it comes nearer."""
    script = example("fit_images")
    x = torch.tensor([[0.6, 0.3, 0.9], [0.9, 0.5, -1.0]], dtype=torch.float64)
    tilt = math.radians(12)
    ahead = torch.tensor([0, -math.sin(tilt), -math.cos(tilt)], dtype=torch.float64)
    right = torch.tensor([1, 0, 0], dtype=torch.float64)
    down = torch.linalg.cross(ahead, right)
    axes = torch.stack([150 * right, 150 * down, ahead])
    across, along, distance = (axes @ (x - torch.tensor([0.75, 0.85, 2.7])).T).unbind()
    expected = torch.stack([48 + across / distance, 32 + along / distance], 1)
    rows, columns = torch.arange(script.HEIGHT) + 0.5, torch.arange(script.WIDTH) + 0.5
    for place, picture in zip(expected, script.splat(x[:, None]), strict=True):
        seen = torch.stack([(picture.sum(0) * columns).sum(), (picture.sum(1) * rows).sum()]) / picture.sum()
        assert seen.tolist() == pytest.approx(place.tolist(), abs=0.01)
    sizes = script.splat(x[:, None]).sum((1, 2)).sqrt()
    assert float(sizes[0] / sizes[1]) == pytest.approx(float(distance[1] / distance[0]), rel=0.02)
