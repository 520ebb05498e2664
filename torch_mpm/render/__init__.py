"""Pictures and videos of particle scenes, made without a screen (`pip install torch-mpm[render]`).

    from torch_mpm import render

    bar = render.shapes.box((0.5, 0.2, 0.5), (0.6, 0.05, 0.1))
    with render.Renderer(((0, 0, 0), (1, 1, 1)), color_by="speed", range=(0, 3)) as renderer:
        image = renderer.frame(state.x, state.v, obstacles=[bar.posed((0.5, 0.2, 0.5), rotation)], time=0.25)
    render.write_png("frame_0000.png", image)
    render.assemble_video(sorted(folder.glob("frame_*.png")), "scene.mp4", fps=30)

Three-dimensional scenes are drawn by VTK, which needs an OpenGL of the system (`apt-get install libosmesa6`, or libegl1
and libgl1-mesa-dri); without one a warning is logged and a plainer software picture is made.
"""

from . import shapes
from .boundaries import obstacle_shapes
from .images import contact_sheet, read_png, write_png
from .renderer import Renderer
from .requires import RenderError
from .shapes import Shape
from .video import VideoWriter, assemble_video

__all__ = [
    "RenderError",
    "Renderer",
    "Shape",
    "VideoWriter",
    "assemble_video",
    "contact_sheet",
    "obstacle_shapes",
    "read_png",
    "shapes",
    "write_png",
]
