"""torch_mpm: differentiable Material Point Method operators for PyTorch."""

from . import _library as _library
