"""Discs float as deep as Archimedes' law says, and are drawn."""

import pytest
import torch
from helpers import example

pytestmark = pytest.mark.usefixtures("one_thread")  # as the script runs


def test_the_height_of_the_water_line():
    """Half of a disc of half the density is below the water; exact values of other shares."""
    floating = example("floating_bodies")
    assert floating.height_of_water_line(0.5) == pytest.approx(0, abs=1e-12)
    assert floating.height_of_water_line(1 / 2 + 3**0.5 / (4 * torch.pi) + 1 / 6) == pytest.approx(0.5, abs=1e-9)
    assert floating.height_of_water_line(0.2) == pytest.approx(-floating.height_of_water_line(0.8), abs=1e-12)


@pytest.mark.thorough
def test_discs_float_within_half_a_cell(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    floating, dx = example("floating_bodies"), 0.03
    with torch.no_grad():
        measured = floating.main(tmp_path, dx=dx, seconds=4.5)
    for density, height in zip(floating.DENSITIES, measured, strict=True):
        exact = floating.height_of_water_line(density)
        assert abs(height - exact) * floating.RADIUS < 0.5 * dx, density
    assert {path.name for path in tmp_path.iterdir()} == {"floating_bodies.mp4", "floating_bodies.png"}
