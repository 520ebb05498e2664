"""Programs of the documents that are marked as complete, one after another."""

import re
import sys
import types
from pathlib import Path

import pytest

DOCS = Path(__file__).parent.parent / "docs"
PACKAGES = {"bodies.md": ["mujoco"], "tutorial.md": ["mujoco"], "envs.md": ["gymnasium", "stable_baselines3"]}


@pytest.mark.thorough(name="tutorial.md")
@pytest.mark.thorough(name="training.md")
@pytest.mark.filterwarnings("ignore:Anomaly Detection")
@pytest.mark.parametrize("name", ["training.md", "recipes.md", "splats.md", "bodies.md", "envs.md", "tutorial.md"])
def test_programs_of_a_document(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for package in PACKAGES.get(name, []):
        pytest.importorskip(package)
    text = (DOCS / name).read_text()
    module = types.ModuleType("document")  # which compilers look for
    monkeypatch.setitem(sys.modules, "document", module)
    monkeypatch.chdir(tmp_path)  # for the files that they write
    programs = list(re.finditer(r"```python\n(.*?)```", text, re.DOTALL))
    assert programs
    for found in programs:
        line = text.count("\n", 0, found.start(1))  # so that errors name the line of the document
        exec(compile("\n" * line + found[1], name, "exec"), vars(module))
