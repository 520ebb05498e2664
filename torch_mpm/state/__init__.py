"""The particles of a simulation."""

from .._moved import attributes_of

__getattr__ = attributes_of(__name__, "state")
