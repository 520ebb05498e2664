"""The Python faces of the ops: checks, fake kernels, autograd."""

from . import activation as activation
from .transfer import g2p, gather, p2g, scatter

__all__ = ["g2p", "gather", "p2g", "scatter"]
