"""Box-shaped buildings on flat ground: their meshes, and their images, in closed form and measured.

Ground range g counts from the foot of the near wall, away from the radar: g = slant range / cosθ. The radar stands at
azimuth 0, square to that wall. A point at height z and horizontal distance x behind the foot appears at
g = x − z·tanθ; where several surfaces share a ground range (layover), their β⁰ add up.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float64, Real
from scipy.special import ndtr

from sarsplat.arguments import checks_arguments
from sarsplat.extras import Trimesh
from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.responses import variance_of

_CLEAR = 2.0  # distance from edges at which levels are measured, 3 dB widths: the response has settled to 10⁻⁶ there


@dataclass(frozen=True)
class Gamma0:
    """γ⁰ (linear) of a building's walls, of its roof and of the ground around it, the same at every angle."""

    wall: float = 1.0
    roof: float = 1.0
    ground: float = 1.0


@dataclass(frozen=True)
class Region:
    """A stretch of ground range (m), the surfaces superimposed there (none in the shadow), and their β⁰, linear."""

    start: float
    stop: float
    surfaces: tuple[str, ...]
    beta0: float


@dataclass(frozen=True)
class Building:
    """A box with its near wall facing azimuth 0 and the middle of the foot of that wall at the scene centre, in metres.

    The depth points away from the radar. SAR-GS, section III-A, states heights and depths only.
    """

    height: float
    depth: float
    length: float = 16.0

    def mesh(self) -> Trimesh:
        """Make four walls, then the roof, two triangles each, without a floor."""
        import trimesh

        left, right, back = -self.length / 2, self.length / 2, -self.depth
        outline = [(0.0, left), (0.0, right), (back, right), (back, left)]
        corners = [(x, y, z) for z in (0.0, self.height) for x, y in outline]
        quads = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7)]
        faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
        return trimesh.Trimesh(corners, faces, process=False)

    def reflectivity(self, gamma0: Gamma0) -> Float64[np.ndarray, " faces"]:
        """Return γ⁰ of the mesh's faces, float64 [10]: factors on a law that is 1 at every angle."""
        return np.array([gamma0.wall] * 8 + [gamma0.roof] * 2)

    def regions(self, grazing_deg: float, gamma0: Gamma0) -> list[Region]:
        """Return all regions from near to far, including the free ground on both sides."""
        look = View(0.0, grazing_deg).look
        tan = look.slope
        top = -self.height * tan
        lit = [
            ("roof", top, top + self.depth, gamma0.roof * tan),
            ("wall", top, 0.0, gamma0.wall / tan),
            ("ground", -math.inf, 0.0, gamma0.ground * tan),
            ("ground", self.depth + look.shadow_m(self.height), math.inf, gamma0.ground * tan),
        ]
        edges = sorted({edge for _, start, stop, _ in lit for edge in (start, stop)})
        edges = [b for a, b in pairwise([-math.nan, *edges]) if not b - a < 1e-9]  # at 45° some differ by rounding
        regions = []
        for start, stop in pairwise(edges):
            inside = np.clip((start + stop) / 2, -1e6, 1e6)
            seen = [(name, level) for name, near, far, level in lit if near < inside < far]
            regions.append(Region(start, stop, tuple(name for name, _ in seen), sum(level for _, level in seen)))
        return regions

    def profile(
        self, slant_range: Float[np.ndarray, " n"], grazing_deg: float, gamma0: Gamma0, resolution: float
    ) -> Float64[np.ndarray, " n"]:
        """Return β⁰ across the building at slant ranges from the scene centre (m), through a Gaussian response.

        `resolution` is the 3 dB width of that response in range, m.
        """
        slant = View(0.0, grazing_deg).look.slant_range
        std_m = math.sqrt(variance_of(resolution))
        profile = np.zeros(len(slant_range))
        for region in self.regions(grazing_deg, gamma0):
            start, stop = (ndtr((slant_range - slant(edge)) / std_m) for edge in (region.start, region.stop))
            profile += region.beta0 * (start - stop)
        return profile


BUILDINGS = {
    "building-a": Building(height=10.0, depth=4.0),
    "building-b": Building(height=8.0, depth=8.0),
    "building-c": Building(height=6.0, depth=10.0),
}
"""Buildings of the paper; at 45° the image of the roof ends before, at and behind the foot of the near wall."""


@dataclass(frozen=True)
class MeasuredRegion:
    """A region and its mean level in an image; None if all pixels are close to its edges."""

    region: Region
    beta0: float | None


@dataclass(frozen=True)
class MeasuredEdge:
    """An edge at a ground range (m), and its error in the image, m of slant range, positive away from the radar."""

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
        Pixels, target and view of `image`.

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
    """Return the position nearest to `near` at which the profile crosses the level; NaN if it never does."""
    above = profile - level
    k = np.flatnonzero(np.sign(above[:-1]) != np.sign(above[1:]))
    if len(k) == 0:
        return math.nan
    crossings = position[k] + (position[k + 1] - position[k]) * above[k] / (above[k] - above[k + 1])
    return float(crossings[np.abs(crossings - near).argmin()])
