"""Old import paths of modules, which work for one release."""

import importlib
import sys

import pytest

import torch_mpm as mpm
from torch_mpm._moved import MOVED


@pytest.mark.parametrize("old", MOVED)
def test_old_import_paths(old, monkeypatch):
    name = f"torch_mpm.{old}"
    monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.delitem(vars(mpm), old, raising=False)
    new = importlib.import_module(f"torch_mpm.{MOVED[old]}")
    with pytest.warns(DeprecationWarning, match=f"{name} has moved to {new.__name__}"):
        module = importlib.import_module(name)
    public = next(n for n, value in vars(new).items() if getattr(value, "__module__", "") == new.__name__)
    assert getattr(module, public) is getattr(new, public) and module.__doc__ == new.__doc__
    with pytest.raises(AttributeError):
        module.no_such_thing  # noqa: B018


def test_an_attribute_of_the_package(monkeypatch):
    monkeypatch.delitem(sys.modules, "torch_mpm.checkpoints", raising=False)
    monkeypatch.delitem(vars(mpm), "checkpoints", raising=False)
    with pytest.warns(DeprecationWarning, match="has moved to torch_mpm.rollouts.checkpoints"):
        assert mpm.checkpoints.contexts is mpm.rollouts.checkpoints.contexts
