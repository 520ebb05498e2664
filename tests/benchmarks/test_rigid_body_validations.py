"""Contact between material and rigid bodies against theory, as `benchmarks.accuracy` measures it, in short forms."""

import math
from collections.abc import Iterator

import pytest

from benchmarks import common
from benchmarks.accuracy import obstacle_surfaces, rigid_bodies


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    with common.one_thread():
        yield


@pytest.mark.parametrize("share", [0.5, 0.8, 1.2])
@pytest.mark.parametrize("angle", [10, 30])
def test_a_block_slides_or_sticks_on_an_incline(angle, share):
    """At g (sin a − μ cos a) below μ = tan a, and not at all above."""
    found = rigid_bodies.incline(angle, share * math.tan(math.radians(angle)))
    assert found["acceleration"] == pytest.approx(found["rigid"], rel=0.02, abs=0.01)
    assert (abs(found["speed"]) < 1e-3) == (share > 1)


def test_a_disc_rolls_down_an_elastic_bed():
    """Without slipping; slower than on a rigid plane, by a resistance that is smaller on finer lattices."""
    found = rigid_bodies.roll(6, 20, rigid_bodies.jelly(), duration=0.6)
    assert found["ratio"] == pytest.approx(1.0, abs=0.05)
    assert 0.8 < found["acceleration"] / found["rigid"] < 1.0


@pytest.mark.parametrize("kind", ["separate", "sticky"])
@pytest.mark.parametrize("material", rigid_bodies.LAWS)
def test_momentum_of_a_material_and_a_body_that_hits_it(material, kind):
    found = rigid_bodies.momentum(material, kind, intervals=40)
    assert found["linear"] < 1e-12 and found["angular"] < 1e-12
    assert found["exchanged"] > 0.2


@pytest.mark.parametrize("density", [0.5, 0.8])
def test_a_segment_of_a_disc_floats(density):
    """Its area is the share of the disc that is below the level."""
    y = rigid_bodies.sunk(density) / rigid_bodies.FLOAT
    angle = 2 * math.acos(-y)  # of the segment below
    assert (angle - math.sin(angle)) / (2 * math.pi) == pytest.approx(density, abs=1e-9)


@pytest.mark.parametrize(("margin", "least", "most"), [(0.0, 0.5, 2.0), (0.75, -0.5, 0.5)])
def test_a_disc_floats_as_deep_as_archimedes_has_it(margin, least, most):
    """Within half a cell where its obstacle is larger by 3/4 dx, and deeper where it is not."""
    found = rigid_bodies.floating(6, margin, 0.5, start=1.0, duration=0.8)
    assert least < found["error"] < most


@pytest.mark.parametrize(("margin", "expected", "within"), [(0.0, 0.83, 0.07), (0.75, 1.0, 0.02)])
def test_the_lift_of_a_disc_that_has_moved_in_water(margin, expected, within):
    found = obstacle_surfaces.lift(6, (0.3, 0.4), margin, "disc moved", 1.6, 0.4)
    assert found == pytest.approx(expected, abs=within)


@pytest.mark.parametrize(("margin", "least", "most"), [(0.0, 0.0, 1.1), (0.75, 0.8, 1.9)])
@pytest.mark.parametrize("place", [0.1, 0.7])
def test_a_block_lands_within_a_cell_above_a_plane(place, margin, least, most):
    """A larger obstacle stops it too high."""
    assert least < obstacle_surfaces.landing("elastic block, E = 1e5 Pa", place, margin) < most
