"""NCLaw (Ma et al. 2023, arXiv 2304.14369) on torch_mpm: its simulator in `sim`, its laws and networks in `material`,
its decomposition in `warp`.
"""

from . import material, sim, warp

__all__ = ["material", "sim", "warp"]
