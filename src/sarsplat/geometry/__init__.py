"""Views, frames and grids. Knows nothing of Gaussians, and nothing of torch."""

from sarsplat.geometry.grids import ImageGrid, RayGrid
from sarsplat.geometry.view import View, radar_frame

__all__ = ["ImageGrid", "RayGrid", "View", "radar_frame"]
