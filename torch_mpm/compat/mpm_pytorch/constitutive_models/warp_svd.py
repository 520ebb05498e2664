"""The singular value decomposition under the name of MPM-PyTorch."""

from ...nclaw.warp import SVD

__all__ = ["SVD"]
