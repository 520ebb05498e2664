"""Old import paths of modules and old names, which work for one release."""

import importlib
import subprocess
import sys

import pytest
import torch

import torch_mpm as mpm
from torch_mpm._moved import MOVED, RENAMED


@pytest.mark.parametrize("old", MOVED)
def test_old_import_paths(old, monkeypatch):
    name = f"torch_mpm.{old}"
    monkeypatch.delitem(sys.modules, name, raising=False)
    package, _, module = name.rpartition(".")
    monkeypatch.delitem(vars(importlib.import_module(package)), module, raising=False)
    new = importlib.import_module(f"torch_mpm.{MOVED[old]}")
    with pytest.warns(DeprecationWarning, match=f"{name} has moved to {new.__name__}"):
        module = importlib.import_module(name)
    public = next(n for n, value in vars(new).items() if getattr(value, "__module__", "").startswith(new.__name__))
    assert getattr(module, public) is getattr(new, public) and module.__doc__ == new.__doc__
    with pytest.raises(AttributeError):
        module.no_such_thing  # noqa: B018


def test_removed_modules():
    message = r"torch_mpm.reference is not part of the package: .* `oracle` in tests/"
    with pytest.raises(ModuleNotFoundError, match=message):
        importlib.import_module("torch_mpm.reference.transfer")


@pytest.mark.parametrize("old", RENAMED)
def test_old_names(old):
    with pytest.warns(DeprecationWarning, match=f"torch_mpm.{old} is now torch_mpm.{RENAMED[old]}"):
        assert getattr(mpm, old) is getattr(mpm, RENAMED[old])


@pytest.mark.parametrize("old,new", [("survey", "stability_report"), ("figures", "diagnostics")])
def test_old_names_of_methods(old, new):
    step = mpm.Step(mpm.Grid(0.25, (0.0, 0.0), (1.0, 1.0)), mpm.NeoHookean(E=1e4, nu=0.3))
    state = mpm.State(x=torch.full((1, 2), 0.5), v=torch.ones(1, 2), mass=torch.ones(1), volume=torch.ones(1))
    with pytest.warns(DeprecationWarning, match=f"Step.{old} is now Step.{new}"):
        found = getattr(step, old)(state)
    for a, b in zip(found, getattr(step, new)(state), strict=True):
        assert torch.equal(a, b)


def test_an_attribute_of_the_package(monkeypatch):
    monkeypatch.delitem(sys.modules, "torch_mpm.checkpoints", raising=False)
    monkeypatch.delitem(vars(mpm), "checkpoints", raising=False)
    with pytest.warns(DeprecationWarning, match="has moved to torch_mpm.rollouts.checkpoints"):
        assert mpm.checkpoints.contexts is mpm.rollouts.checkpoints.contexts


@pytest.mark.parametrize("package,name", [("grid", "Grid"), ("state", "State"), ("step", "Step")])
def test_packages_that_were_modules(package, name):
    module = importlib.import_module(f"torch_mpm.{package}")
    with pytest.warns(DeprecationWarning, match=rf"torch_mpm.{package}.{name} has moved to torch_mpm.{package}\.\w+"):
        assert getattr(module, name) is getattr(mpm, name)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        module.nothing  # noqa: B018


@pytest.mark.thorough
def test_torch_mpm_itself_uses_the_new_paths():
    program = (
        "import importlib, pkgutil, torch_mpm\n"
        "for module in pkgutil.walk_packages(torch_mpm.__path__, 'torch_mpm.'):\n"
        "    if not module.name.endswith(('__main__', '_math')):\n"
        "        importlib.import_module(module.name)\n"
    )
    words = [sys.executable, "-W", "error:torch_mpm:DeprecationWarning", "-c", program]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
