"""Data sets in the formats of other projects; every export is a folder that appears when it is whole."""

from .gns import export_gns
from .lagrangebench import export_lagrangebench
from .neuralmpm import export_neuralmpm
from .scenes import export_scenes_ply, export_scenes_vtk
from .tfrecord import export_tfrecord
from .well import export_well

__all__ = [
    "export_gns",
    "export_lagrangebench",
    "export_neuralmpm",
    "export_scenes_ply",
    "export_scenes_vtk",
    "export_tfrecord",
    "export_well",
]
