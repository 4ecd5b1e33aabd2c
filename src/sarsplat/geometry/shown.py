"""Extent of the ground that images show."""

from __future__ import annotations

from collections.abc import Sequence

from sarsplat.geometry.grids import ImageGrid
from sarsplat.geometry.view import View


def ground_radius_m(views: Sequence[View], grid: ImageGrid) -> float:
    """Radius of the ground that images from these views show, m, with a margin for footprints and responses."""
    across = grid.columns * grid.spacing_m[0] + 2 * abs(grid.center_m[0])
    away = grid.rows * grid.spacing_m[1] + 2 * abs(grid.center_m[1])
    return max(view.look.corner_m(across / 2, away / 2) for view in views) + 2 * max(grid.resolution_m)
