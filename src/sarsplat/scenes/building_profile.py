"""Edges and levels of a building measured in an image and in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Real

from sarsplat.arguments import checks_arguments
from sarsplat.geometry import ImageGrid, View
from sarsplat.scenes.buildings import Building, Gamma0, Region

_CLEAR = 2.0  # 3 dB widths from every edge to where levels are measured: there the response has settled to 10⁻⁶


@dataclass(frozen=True)
class MeasuredRegion:
    """A region and its mean level in an image, None if no pixel is clear of the edges."""

    region: Region
    beta0: float | None


@dataclass(frozen=True)
class MeasuredEdge:
    """An edge at a ground range, and how much farther from the radar it is in the image, m of slant range."""

    ground_range: float
    error: float


@dataclass(frozen=True)
class BuildingProfile:
    """A building's image averaged along the wall, and its closed form: β⁰, linear power.

    Slant range is from the foot of the near wall, m. Edges and regions are listed from near to far.
    """

    slant_range: Float64[np.ndarray, " rows"]
    measured: Float64[np.ndarray, " rows"]
    analytic: Float64[np.ndarray, " rows"]
    edges: list[MeasuredEdge]
    regions: list[MeasuredRegion]


@checks_arguments
def building_profile(
    image: Real[np.ndarray, "{grid.rows} {grid.columns}"],
    grid: ImageGrid,
    building: Building,
    grazing_deg: float,
    gamma0: Gamma0,
) -> BuildingProfile:
    """Measure the image of a building, seen from azimuth 0.

    An edge lies where the profile crosses the level that the analytic profile has there (half way between the levels
    of long regions on either side); both crossings are interpolated between the same pixels, so that its errors cancel.

    Parameters
    ----------
    image : numpy.ndarray [rows, columns]
        β⁰, linear power.
    grid, building, grazing_deg, gamma0
        What `image` shows, and from where.

    Returns
    -------
    BuildingProfile
    """
    slant = View(0.0, grazing_deg).look.slant_range
    regions = building.regions(grazing_deg, gamma0)
    inner = np.abs(grid.azimuth_m) <= building.length / 2 - _CLEAR * grid.resolution_m[0]
    along, resolution = grid.range_m, grid.resolution_m[1]
    measured = np.asarray(image[:, inner], dtype=np.float64).mean(axis=1)
    analytic = building.profile(along, grazing_deg, gamma0, resolution)
    edges = []
    for region in regions[1:]:
        edge = slant(region.start)
        level = float(building.profile(np.array([edge]), grazing_deg, gamma0, resolution)[0])
        crossing, expected = (_crossing(along, profile, level, edge) for profile in (measured, analytic))
        edges.append(MeasuredEdge(region.start, crossing - expected))
    levels = []
    for region in regions:
        near, far = slant(region.start) + _CLEAR * resolution, slant(region.stop) - _CLEAR * resolution
        clear = measured[(along >= near) & (along <= far)]
        levels.append(MeasuredRegion(region, float(clear.mean()) if len(clear) else None))
    return BuildingProfile(along, measured, analytic, edges, levels)


def _crossing(
    position: Float64[np.ndarray, " rows"], profile: Float64[np.ndarray, " rows"], level: float, near: float
) -> float:
    """Position nearest to `near` at which the profile crosses the level; NaN if it never does."""
    above = profile - level
    k = np.flatnonzero(np.sign(above[:-1]) != np.sign(above[1:]))
    if len(k) == 0:
        return math.nan
    crossings = position[k] + (position[k + 1] - position[k]) * above[k] / (above[k] - above[k + 1])
    return float(crossings[np.abs(crossings - near).argmin()])
