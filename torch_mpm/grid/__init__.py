"""The lattice, its blocks, and the weights of its B-splines."""

from .._moved import attributes_of

__getattr__ = attributes_of(__name__, "grid")
