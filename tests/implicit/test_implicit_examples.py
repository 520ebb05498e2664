"""The example of the static equilibrium, and the code of its documentation, as they stand."""

import re
import runpy
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent


def test_the_stiffness_of_a_beam_is_found():
    main = runpy.run_path(str(ROOT / "examples/beam_stiffness.py"))["main"]
    assert main(iterations=3) < 1e-3


def test_the_code_of_the_documentation_runs(capsys):
    parts = re.findall(r"```python\n(.*?)```", (ROOT / "docs/implicit.md").read_text(), re.DOTALL)
    assert len(parts) == 2
    exec(compile("".join(parts), "docs/implicit.md", "exec"), {})
    assert "converged=tensor([True])" in capsys.readouterr().out
