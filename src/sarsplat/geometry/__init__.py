"""Views, frames, grids, places on earth, terrain and the labels of masks; independent of Gaussians and of torch."""

from sarsplat.geometry.grids import CLUTTER, SHADOW, TARGET, ImageGrid, RayGrid
from sarsplat.geometry.look import Look
from sarsplat.geometry.place import Place
from sarsplat.geometry.stack import Stack
from sarsplat.geometry.terrain import Terrain
from sarsplat.geometry.view import View, radar_frame

__all__ = [
    "CLUTTER",
    "SHADOW",
    "TARGET",
    "ImageGrid",
    "Look",
    "Place",
    "RayGrid",
    "Stack",
    "Terrain",
    "View",
    "radar_frame",
]
