"""The catalogue of laws: complete, and what selections take from it."""

import pytest

import torch_mpm as mpm
from benchmarks.catalogue.laws import FORMS, LAWS, having, named
from torch_mpm import laws


def public() -> set[type]:
    classes = {value for name in laws.__all__ if isinstance(value := getattr(laws, name), type)}
    return {c for c in classes if issubclass(c, mpm.Material)} - {mpm.Material}


def test_every_public_law_is_in_the_catalogue_once():
    made = [type(law()) for law in LAWS.values()]
    assert set(made) == public() and len(made) == len(public())


def test_forms_are_other_options_of_public_laws():
    assert {type(law()) for law in FORMS.values()} <= public()
    assert not LAWS.keys() & FORMS.keys()


def test_selections():
    assert set(having("fluid")) == {"fluid"} and set(having("fluid", of=FORMS)) == {"water"}
    assert {type(law()) for law in having("compiled").values()} == {
        c for c in public() if issubclass(c, laws.CompiledLaw)
    }
    assert having("plastic", without="history") == named("herschel_bulkley")
    assert "viscoelastic" in having("rate", "history") and "von_mises" not in having("rate")
    with pytest.raises(KeyError):
        having("springy")
