"""Heat in particles: the implicit step on the nodes, and what acts at surfaces."""

from .heat import Heat, HeatBoundary, present_volume

__all__ = ["Heat", "HeatBoundary", "present_volume"]
