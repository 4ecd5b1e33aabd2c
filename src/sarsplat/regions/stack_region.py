"""Region of a stack's scatterers: imaged places within one ambiguity of elevation."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64

from sarsplat.data import Dataset
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.initialise import Region
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.regions.target_region import target_region
from sarsplat.surface.points import imaged, spread

_BELOW = 0.1  # share of the region's height below z = 0
_PER_CELL = 3.0  # Gaussians per cell of azimuth, range and elevation
_FEWEST_CELLS = 4  # minimum number of cells along elevation, which a single pair of passes does not resolve
_TRIED, _VIEWS = 1 << 16, 96  # random places, and views that are tested
_SAME = 1.0 - 1e-4  # minimum cosine between equal directions: 0.8°


def stack_region(train: Dataset, box: Box | None = None) -> Region:
    """Region of the given box, the dataset's, or one from the images; for one direction, cut to the imaged places.

    Without a box, heights span one ambiguity, or as much as an image is long enough to show. Polarisations alone tell
    no heights: these are then those of single images (`target_region`), as is all of the region without ground.
    """
    box, grid = box or train.target_box_m, train.grid
    blind = box is None and not any(np.ptp(stack.offsets_rad) for stack in train.stacks)  # polarisations alone
    if blind and not train.ground:
        return target_region(train, ground=False)
    half_azimuth, half_range = grid.columns * grid.spacing_m[0] / 2, grid.rows * grid.spacing_m[1] / 2
    if box is None:
        heights = [
            min(stack.ambiguous_elevation_m * view.look.height_per_elevation, 2 * half_range / view.look.sine)
            for stack, view in zip(train.stacks, train.views, strict=True)
        ]
        tallest = float(target_region(train, ground=True).high[2]) / (1 - _BELOW) if blind else min(heights)
        low, high = -_BELOW * tallest, (1 - _BELOW) * tallest
        reach = max(_reach_m(view, grid, high) for view in train.views)
        box = (-reach, -reach, low), (reach, reach, high)
    region = Region.box(*box)
    if not _in_any(_tried(region), train.views, grid).any():
        raise SarsplatError(f"no training image shows the box {box[0]} to {box[1]} m; give another `target_box`")
    if not of_one_direction(train.views):
        return region
    azimuth, slant = train.views[0].look.gradients
    normals, middle = np.array([azimuth, -azimuth, slant, -slant]), np.array(grid.center_m)
    offsets = np.array([half_azimuth, half_azimuth, half_range, half_range])
    offsets += np.array([middle[0], -middle[0], middle[1], -middle[1]])
    return Region(
        np.concatenate([region.normals, normals]), np.concatenate([region.offsets, offsets]), region.low, region.high
    )


def of_one_direction(views: Sequence[View]) -> bool:
    """True if all views have the same direction, within 0.8°."""
    directions = np.array([view.direction for view in views])
    return bool((directions @ directions[0]).min() > _SAME)


def imaged_sample(
    region: Region, views: Sequence[View], grid: ImageGrid, count: int, generator: torch.Generator
) -> Float64[np.ndarray, "{count} 3"]:
    """Random places, uniform in the part of a region that at least one image shows."""
    accepted: list[np.ndarray] = []
    while sum(map(len, accepted)) < count:
        points = region.sample(count, generator)
        accepted.append(points[_in_any(points, views, grid)])
    return np.concatenate(accepted)[:count]


def enough_gaussians(region: Region, views: Sequence[View], grid: ImageGrid, stacks: Sequence[Stack]) -> int:
    """Number of Gaussians for stacks: a fixed number per imaged cell of azimuth, range and elevation."""
    size, points = region.high - region.low, _tried(region)
    inside = (points @ region.normals.T <= region.offsets).all(axis=1) & _in_any(points, views, grid)
    volume, span = float(np.prod(size)) * float(inside.mean()), size[2] / views[0].look.height_per_elevation
    elevation = min(min(stack.resolution_m for stack in stacks), float(span) / _FEWEST_CELLS)
    return max(1, round(_PER_CELL * volume / (grid.cell_m**2 * elevation)))


def _tried(region: Region) -> Float64[np.ndarray, "k 3"]:
    return region.low + (region.high - region.low) * np.random.default_rng(0).random((_TRIED, 3))


def _in_any(points: Float64[np.ndarray, "p 3"], views: Sequence[View], grid: ImageGrid) -> Bool[np.ndarray, " p"]:
    return np.any([imaged(points, view, grid) for view in spread(views, _VIEWS)], axis=0)


def _reach_m(view: View, grid: ImageGrid, height: float) -> float:
    """Largest distance from the origin of an imaged place at this height, along the ground, m."""
    azimuth, slant = (np.abs(edges).max() for edges in (grid.extent_m[:2], grid.extent_m[2:]))
    return math.hypot(azimuth, view.look.ground_range(slant, height))
