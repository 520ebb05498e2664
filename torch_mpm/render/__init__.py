"""Pictures and videos of particle scenes, made without a screen (`pip install torch-mpm[render]`)."""

from . import shapes
from .images import contact_sheet, read_png, write_png
from .renderer import Renderer
from .requires import RenderError
from .shapes import Obstacle
from .video import VideoWriter, assemble_video

__all__ = [
    "Obstacle",
    "RenderError",
    "Renderer",
    "VideoWriter",
    "assemble_video",
    "contact_sheet",
    "read_png",
    "shapes",
    "write_png",
]
