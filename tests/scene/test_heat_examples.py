"""The examples that fit a conductivity by gradient run, and approach what they look for."""

import importlib.util
from pathlib import Path
from types import ModuleType

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_conductivity_of_a_plate(capsys):
    module = example("heat_conductivity")
    module.CELLS, module.STEPS = 8, 3
    assert module.main(iterations=2) < 0.02


def test_network_as_conductivity(capsys):
    module = example("heat_network")
    module.CELLS, module.STEPS = 16, 10
    first = module.main(iterations=1)
    assert module.main(iterations=3) < min(0.06, first)
