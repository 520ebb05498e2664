"""Ctrl-C while a command imports torch: one line and the status of an interrupt, no traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import torch_mpm

TORCH = "import signal; signal.raise_signal(signal.SIGINT)"
"""In place of torch: a module that is interrupted during its import."""
SCRIPT = "from torch_mpm.cli import main; raise SystemExit(main())"


@pytest.mark.parametrize("start", ["torch-mpm", "-m", "program.py"])
def test_an_interrupt_of_the_import_of_torch(tmp_path, start):
    """Another program that imports torch_mpm has the handler of Python."""
    (tmp_path / "torch.py").write_text(TORCH)
    script = tmp_path / start
    script.write_text(SCRIPT)
    words = ["-m", "torch_mpm"] if start == "-m" else [str(script)]
    places = [str(tmp_path), str(Path(torch_mpm.__file__).parent.parent), *sys.path]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
    done = subprocess.run(
        [sys.executable, *words, "info"], capture_output=True, text=True, env=environment, cwd=tmp_path
    )
    if start == "program.py":
        assert done.stderr.endswith("KeyboardInterrupt\n") and "Traceback" in done.stderr
    else:
        assert (done.returncode, done.stderr) == (130, "torch-mpm: interrupted\n")
