"""Water in containers made of obstacles, for two seconds: it stays inside, and its weight and pressure are right."""

import pytest

from benchmarks import common
from benchmarks.accuracy import containers


@pytest.mark.filterwarnings("ignore::torch_mpm.ThinWallWarning")
@pytest.mark.parametrize("case", [c for c in containers.containers(bowl=False) if c.dim == 2], ids=lambda c: c.name)
def test_water_stays_in_a_container_under_its_own_pressure(case):
    with common.one_thread():
        found = containers.run(case, 0.02, 2.0)
    assert found["outside"] == 0 and found["depth"] <= 0.5
    assert found["force"] == pytest.approx(1.0, rel=0.003)
    assert found["pressure"] == pytest.approx(1.0, rel=0.03)


@pytest.mark.filterwarnings("ignore::torch_mpm.ThinWallWarning")
def test_a_block_slides_over_ten_seams():
    with common.one_thread():
        found = containers.slide(10, 0.02, 0.5)
    assert found["kept"] == pytest.approx(1.0, rel=1e-2)
