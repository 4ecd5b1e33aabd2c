"""From Gaussians to a point cloud: where the rays of the training views return, thinned and cleaned.

However many views and pixels there are, at most so many rays are traced, views compared and points kept: beyond that,
views are chosen evenly, rays lie farther apart and voxels are larger. Memory holds the rays' ranges and the voxels, not
every return.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Real
from scipy.spatial import cKDTree
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.extras import install_command
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.terrain import heights_of
from sarsplat.memory import required
from sarsplat.progress import stage
from sarsplat.renderer import render
from sarsplat.settings.sections import PointExtraction
from sarsplat.surface import cells
from sarsplat.surface.first_returns import FirstReturns, some_at_once
from sarsplat.surface.voxels import AT_ONCE, MOST_POINTS, Voxels
from sarsplat.tiles.plan import memory_bytes

_MOST_VIEWS = 96
_MOST_RAYS = 2e7
"""In all views together."""

_SAMPLES = 3.0
"""Returns that a voxel has at least, on average; a surface is seen by about a third of the views."""

_RETURN, _POINT = 130, 650
"""Bytes at most: of a return while it is thinned, and of a point while normals and mesh are made of it."""

_CUBES = 4
"""To the radius of a cluster."""

_FEWER = (
    "set fewer rays, such as --points.rays-per-pixel 2; `--resume` with it extracts the points of a finished training"
)


@checks_arguments
def extract_points(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    how: PointExtraction,
    terrain: Terrain | None = None,
) -> Float64[np.ndarray, "p 3"]:
    """Points of the surface that Gaussians stand for.

    Parameters
    ----------
    gaussians : Gaussians
        The target alone, on any device.
    views : sequence of View
        The training views.
    grid : ImageGrid
        Sets the spacing of the rays and the unit of `how`, its resolution cell.
    how : PointExtraction
        Method, thinning and clean-up. In large scenes rays and voxels are coarser than it says: at most 20 million rays
        are traced, from at most 96 views, and at most a million points kept.
    terrain : Terrain, optional
        What the lowest points lie on; z = 0 unless given.

    Returns
    -------
    numpy.ndarray, float64 [P, 3]
        World frame, m; possibly empty.

    Raises
    ------
    SarsplatError
        If there are no views, or the memory that is free does not do.
    """
    if not views:
        raise SarsplatError("there are no views that could see a surface; give at least one View")
    gaussians, cell = gaussians.detach(), grid.cell_m
    if how.method == "centres":
        kept = gaussians.optical_depth >= how.optical_depth
        if how.power_share < 1:
            kept &= _strongest(gaussians, views, grid, how.power_share)
        points = gaussians.means[kept].double().cpu().numpy()
        voxels = Voxels(how.voxel * cell)
        voxels.add(torch.from_numpy(points[heights_of(points, terrain) >= how.min_height * cell]))
        points = voxels.means().numpy()
    else:
        points = _seen_points(gaussians, [*views, *between(views)], grid, how, terrain)
    return points if how.cluster_radius is None else _cluster(points, how.cluster_radius * cell, how.cluster_size)


def _strongest(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, share: float) -> Bool[Tensor, " n"]:
    """The fewest Gaussians that return this share of the power in images; those outside of all images do not count."""
    rays, strongest = RayGrid.for_image(grid), gaussians.means.new_zeros(len(gaussians))
    channel, means = gaussians.scattering.power_channel, gaussians.means.double().cpu().numpy()
    for some in some_at_once(gaussians, spread(views, _MOST_VIEWS), grid, rays):
        with torch.no_grad():
            sections = render(gaussians, some, grid, rays=rays).cross_sections[..., channel]
        inside = torch.from_numpy(np.stack([imaged(means, view, grid) for view in some])).to(sections.device)
        strongest = torch.maximum(strongest, (sections * inside).amax(0))
    order = strongest.argsort(descending=True, stable=True)
    before = strongest[order].double().cumsum(0) - strongest[order]
    return torch.zeros_like(strongest, dtype=torch.bool).index_put((order,), before < share * strongest.double().sum())


def imaged(points: Float64[np.ndarray, "p 3"], view: View, grid: ImageGrid) -> Bool[np.ndarray, " p"]:
    """Which points lie within the edges of an image."""
    azimuth, slant_range = view.look.gradients @ points.T
    left, right, far, near = grid.extent_m
    return (left <= azimuth) & (azimuth <= right) & (near <= slant_range) & (slant_range <= far)


def _seen_points(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    how: PointExtraction,
    terrain: Terrain | None,
) -> Float64[np.ndarray, "p 3"]:
    """Mean first return in each voxel, without those that too many views look through or too few see."""
    cell, rays, chosen = grid.cell_m, RayGrid.for_image(grid, how.rays_per_pixel), spread(views, _MOST_VIEWS)
    said = "the views" if len(chosen) == len(views) else f"{len(chosen)} of {len(views)} views"
    views, count = chosen, _rays(gaussians, chosen, rays)
    coarser = math.sqrt(max(1.0, count / _MOST_RAYS))
    much = required("extracting the surface", _bytes(gaussians, grid, min(count, _MOST_RAYS), len(views)), _FEWER)
    rays = RayGrid((coarser * rays.spacing_m[0], coarser * rays.spacing_m[1]))
    needed_m = max(rays.spacing_m) * math.sqrt(3 * _SAMPLES / len(views)) if coarser > 1 else 0.0
    voxels, returns = Voxels(max(how.voxel * cell, needed_m), gaussians.means.device), []
    enough = min(how.seen_by, len(views) // 5)  # a fifth, so that of few views there are points, too
    rarer = f" {coarser:.2g} times as far apart as set" if coarser > 1 else ""
    with stage(f"surface: rays{rarer} from {said}", len(views)) as shown:
        if much is not None:
            shown.note(much)
        if not cells.on_cpu(gaussians.means):
            traced = FirstReturns.of(gaussians, views, grid, rays, how.optical_depth)
            for found in traced.points(terrain, how.min_height * cell):
                voxels.add(found)
            means = voxels.means()
            kept = traced.confirmed(means, how.behind * cell, how.seen_through, enough)
            return means[kept].cpu().numpy()
        for view in views:
            returns.append(_FirstReturns.of(gaussians, view, grid, rays, how.optical_depth))
            points = returns[-1].points()
            voxels.add(torch.from_numpy(points[heights_of(points, terrain) >= how.min_height * cell]))
            shown.advance(1)
    # haze that one view takes for a surface is looked through by others, or seen by no other
    points = voxels.means().numpy()
    through, seen, left = np.zeros(len(points), int), np.zeros(len(points), int), np.arange(len(points))
    with stage("surface: points compared with the views", len(views)) as shown:
        for number in _mixed(len(views)):  # so that haze is soon looked through
            beyond = returns[number].beyond(points[left])
            through[left] += beyond > how.behind * cell
            seen[left] += abs(beyond) <= how.behind * cell
            left = left[through[left] <= how.seen_through * len(views)]
            shown.advance(1)
    return points[left[seen[left] >= enough]]


def _bytes(gaussians: Gaussians, grid: ImageGrid, rays: float, views: int) -> float:
    """Upper bound of the memory that points, normals and mesh need for so many rays, bytes."""
    of_a_view = memory_bytes(
        len(gaussians), gaussians.scattering.parameters.shape[1], rays / views, grid.rows * grid.columns
    )
    ranges = np.dtype(np.float32).itemsize * rays
    thinned, kept = min(rays, AT_ONCE + rays / views), min(rays / _SAMPLES, MOST_POINTS)
    return ranges + max(of_a_view + _RETURN * (thinned + kept), _POINT * kept)


def _rays(gaussians: Gaussians, views: Sequence[View], rays: RayGrid) -> float:
    """About how many rays the views have, as far as there are Gaussians."""
    means, reach = gaussians.means.double().cpu().numpy(), 3 * float(gaussians.scales.max()) if len(gaussians) else 0
    total = 0.0
    for view in views if len(means) else ():
        sides = np.ptp(view.look.frame[:2] @ means.T, axis=1) + 2 * reach
        total += math.prod(sides / rays.spacing_m)
    return total


def _mixed(count: int) -> Int64[np.ndarray, " n"]:
    """Indices 0 … count − 1 in an order in which consecutive ones are far apart."""
    return np.argsort(np.arange(count) * (5**0.5 - 1) / 2 % 1, kind="stable")


def spread(views: Sequence[View], most: int) -> list[View]:
    """At most so many views by farthest-point sampling, in their order, the first one included."""
    if len(views) <= most:
        return list(views)
    directions = np.array([view.direction for view in views])
    chosen, nearest = [0], directions @ directions[0]
    while len(chosen) < most:
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return [views[k] for k in sorted(set(chosen))]


def between(views: Sequence[View]) -> list[View]:
    """Views halfway between neighbouring ones, from where nothing was measured: they look into the same corners.

    Two views are neighbours if no other is as near to the direction halfway between them as they are (K. R. Gabriel and
    R. R. Sokal, "A new statistical approach to geographic variation analysis", 1969).
    """
    directions = np.unique(np.round([view.direction for view in views], 9), axis=0)
    first, second = np.triu_indices(len(directions), 1)
    middle = directions[first] + directions[second]
    length = np.linalg.norm(middle, axis=1)
    apart = length > 1e-6  # opposite ones have no middle
    first, middle = first[apart], middle[apart] / length[apart, None]
    radius = np.linalg.norm(directions[first] - middle, axis=1)
    nearer = cKDTree(directions).query_ball_point(middle, radius * (1 + 1e-6), return_length=True)
    return [View.towards(direction, aloft=views[0].aloft) for direction in middle[nearer == 2]]


@dataclass(frozen=True)
class _FirstReturns:
    """First returns of the rays of one view."""

    frame: Float64[np.ndarray, "3 3"]
    """R_r."""
    range_m: Real[np.ndarray, "rows columns"]
    """Ranges on the rays' lattice, with one more ray on each side; infinite where a ray meets nothing."""
    origin: Float64[np.ndarray, " 2"]
    """(x_r, y_r) of row 0, column 0."""
    spacing_m: Float64[np.ndarray, " 2"]

    @classmethod
    def of(
        cls, gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid, optical_depth: float
    ) -> _FirstReturns:
        black = gaussians.means.new_zeros(1, len(gaussians), 1)  # images would take their time
        traced = render(gaussians, [view], grid, rays=rays, first_return_depth=optical_depth, amplitudes=black)
        (ray_map,) = traced.ray_maps or ()
        ranges = np.nan_to_num(ray_map.first_return.cpu().numpy(), nan=np.inf)
        origin, spacing_m = np.array(ray_map.origin), np.array(rays.spacing_m)
        return cls(view.look.frame, np.pad(ranges, 1, constant_values=np.inf), origin - spacing_m, spacing_m)

    def points(self) -> Float64[np.ndarray, "p 3"]:
        row, column = np.nonzero(np.isfinite(self.range_m))
        plane = self.origin + np.column_stack([column, row]) * self.spacing_m
        return np.column_stack([plane, self.range_m[row, column]]) @ self.frame

    def beyond(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " p"]:
        """How far behind each point the ray through it returns, m; infinite where it never does, [P]."""
        local = points @ self.frame.T
        last = np.array(self.range_m.shape[::-1]) - 1
        column, row = np.rint((local[:, :2] - self.origin) / self.spacing_m).clip(0, last).astype(np.int32).T
        return self.range_m[row, column] - local[:, 2]


def _cluster(points: Float64[np.ndarray, "p 3"], radius: float, size: int) -> Float64[np.ndarray, "fewer 3"]:
    """Keep the largest DBSCAN cluster: what floats apart from the target is left out."""
    try:
        from sklearn.cluster import DBSCAN
    except ImportError as error:
        raise SarsplatError(f"cleaning the point cloud needs scikit-learn; {install_command('evaluate')}") from error
    if len(points) == 0:
        return points
    # by the cube, as far as clusters are concerned one heavy point: a dense cloud has hundreds of neighbours for each
    cubes, owner, count = np.unique(
        np.floor(points * (_CUBES / radius)).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    owner = owner.ravel()
    centres = np.stack([np.bincount(owner, axis, len(cubes)) for axis in points.T], axis=1) / count[:, None]
    labels = DBSCAN(eps=radius, min_samples=size).fit(centres, sample_weight=count).labels_[owner]
    return points[labels == np.bincount(labels + 1, minlength=2)[1:].argmax()]
