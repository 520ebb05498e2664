"""The examples that fit a conductivity by gradient run, and approach what they look for."""

from helpers import example


def test_conductivity_of_a_plate(capsys):
    module = example("heat_conductivity")
    module.CELLS, module.STEPS = 8, 3
    assert module.main(iterations=2) < 0.02


def test_network_as_conductivity(capsys):
    module = example("heat_network")
    module.CELLS, module.STEPS = 16, 10
    first = module.main(iterations=1)
    assert module.main(iterations=3) < min(0.06, first)
