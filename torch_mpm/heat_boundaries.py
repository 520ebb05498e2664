"""The old name of `torch_mpm.heat.boundaries`, the same module."""

import sys

from .heat import boundaries

sys.modules[__name__] = boundaries
