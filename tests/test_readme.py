"""The README as a newcomer reads it: its program prints what stands below it, and its files and scenes exist."""

import contextlib
import io
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
NUMBER = re.compile(r"-?\d+\.\d+")


def test_the_program_prints_what_is_written_below_it() -> None:
    """Word for word; numbers to one unit of their last digit, since rounding differs between machines."""
    ((program, written),) = re.findall(r"```python\n(.*?)```\n\n```\n(.*?)```", README, re.DOTALL)
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(compile(program, "README.md", "exec"), {"__name__": "__main__"})
    printed = output.getvalue()
    assert NUMBER.sub("#", printed) == NUMBER.sub("#", written)
    for found, expected in zip(NUMBER.findall(printed), NUMBER.findall(written), strict=True):
        unit = 10.0 ** -len(expected.partition(".")[2])
        assert float(found) == pytest.approx(float(expected), rel=0, abs=1.001 * unit), printed


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_to_files(document: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", document.read_text())
    missing = [link for link in links if "://" not in link and not (document.parent / link).exists()]
    assert missing == []


def test_every_scene_and_script_is_in_the_gallery() -> None:
    gallery = (ROOT / "docs" / "gallery.md").read_text()
    scenes = {path.stem for path in (ROOT / "examples").glob("*.toml")}
    assert {name for name in scenes if f"`{name}`" not in gallery} == set()
    scripts = {path.name for path in (ROOT / "examples").glob("*.py")}
    assert {name for name in scripts if f"(../examples/{name})" not in gallery} == set()
    pictures = set(re.findall(r"docs/pictures/(\w+)\.png", README))
    assert pictures <= scenes and all(f"`{name}`" in README for name in pictures - {"demo"})
