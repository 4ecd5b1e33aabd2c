"""Views, frames, grids, and what pixels may show. Knows nothing of Gaussians, and nothing of torch."""

from sarsplat.geometry.grids import ImageGrid, RayGrid
from sarsplat.geometry.masks import CLUTTER, SHADOW, TARGET
from sarsplat.geometry.view import View, radar_frame

__all__ = ["CLUTTER", "SHADOW", "TARGET", "ImageGrid", "RayGrid", "View", "radar_frame"]
