"""Gradients of bodies and material over many steps, by all that a body is made of and by the weights of a policy."""

import pytest

from benchmarks.accuracy import body_gradients


@pytest.mark.thorough(name="free ball, 3-D")
@pytest.mark.thorough(device="cuda")
@pytest.mark.parametrize("name", body_gradients.CASES)
def test_gradients_of_200_steps_equal_differences(name, device):
    found = list(body_gradients.compared(name, device))
    assert all(abs(row["derivative"]) > 0 for row in found)
    assert {row["of"]: row["by"] for row in found if row["deviation"] > 1e-6} == {}
