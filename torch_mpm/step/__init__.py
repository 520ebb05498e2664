"""One step, its stability limit and its status."""

from .._moved import attributes_of

__getattr__ = attributes_of(__name__, "step")
