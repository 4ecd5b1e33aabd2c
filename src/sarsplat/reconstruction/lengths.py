"""What the lengths in a configuration, which are in resolution cells, are in metres on a dataset."""

from __future__ import annotations

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MIN_SCALE
from sarsplat.geometry import ImageGrid, RayGrid
from sarsplat.reconstruction.config import Config
from sarsplat.renderer.checks import MAX_SCALE


def scales_m(config: Config, cell_m: float) -> tuple[float, float, float]:
    """Smallest, first and largest standard deviation of a Gaussian, m; the smallest at least `MIN_SCALE`.

    Raises
    ------
    SarsplatError
        If the first or the largest is none that can be rendered.
    """
    smallest, first, largest = (
        cells * cell_m for cells in (config.scale_bounds[0], config.initial_scale, config.scale_bounds[1])
    )
    for name, scale in (("initial_scale", first), ("scale_bounds", largest)):
        if not MIN_SCALE <= scale <= MAX_SCALE:
            raise SarsplatError(
                f"{name} makes Gaussians of {scale:.3g} m from resolution cells of {cell_m:.3g} m, and only "
                f"{MIN_SCALE:g} m to {MAX_SCALE:g} m can be rendered; choose another, or check the grid's metres"
            )
    return max(smallest, MIN_SCALE), first, largest


def lengths(config: Config, grid: ImageGrid) -> str:
    """One line: the lengths that a reconstruction of images on this grid works with, in metres."""
    cell_m = grid.cell_m
    scales, rates = scales_m(config, cell_m), config.rates
    rays = [
        RayGrid.for_image(grid, count).spacing_m[0] for count in (config.rays_per_pixel, config.fine_rays_per_pixel)
    ]
    ray = f"{rays[0]:.2g} m" if config.fine_from == 1 else f"{rays[0]:.2g}, then {rays[1]:.2g} m"
    return (
        f"lengths from {cell_m:.3g} m resolution cells: start {scales[1]:.2g} m, sizes {scales[0]:.2g} … "
        f"{scales[2]:.2g} m, steps {rates.means * cell_m:.2g} → {rates.means_end * cell_m:.2g} m, rays {ray}, "
        f"voxels {config.points.voxel * cell_m:.2g} m"
    )
