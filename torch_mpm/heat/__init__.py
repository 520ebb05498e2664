"""Heat in particles: the implicit step on the nodes, and boundary terms."""

from .heat import Heat, HeatBoundary, present_volume

__all__ = ["Heat", "HeatBoundary", "present_volume"]
