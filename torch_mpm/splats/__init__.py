"""3-D Gaussian splats: reading, simulating, drawing and writing them. See docs/splats.md.

from torch_mpm import splats

mug = splats.placed(splats.read("mug.ply"), up="-y", extent=0.4, center=(0.5, 0.4, 0.5))
mug = mug[splats.visible(mug)]
state = mpm.State.at_rest(splats.particles(mug, grid))
end = mpm.rollout(step, state, n=100, dt=1e-4)
splats.write("end.ply", splats.moved(mug, end))
"""

from .frame_writer import FrameWriter
from .gaussians import Gaussians, concatenate
from .harmonics import basis, colors, rotated
from .interior import Interior, Lattice, enclosed, opacity_field
from .motion import deformed, moved
from .particles import particles, visible
from .picture import Picture, render
from .placement import placed
from .ply import read, write

__all__ = [
    "FrameWriter",
    "Gaussians",
    "Interior",
    "Lattice",
    "Picture",
    "basis",
    "colors",
    "concatenate",
    "deformed",
    "enclosed",
    "moved",
    "opacity_field",
    "particles",
    "placed",
    "read",
    "render",
    "rotated",
    "visible",
    "write",
]
