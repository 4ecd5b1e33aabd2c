"""From Gaussians to a point cloud: where the rays of the training views return, thinned and cleaned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.reconstruction.config import PointExtraction
from sarsplat.renderer import render


def extract_points(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, how: PointExtraction
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
        Method, thinning and clean-up.

    Returns
    -------
    numpy.ndarray, float64 [P, 3]
        World frame, m; possibly empty.
    """
    gaussians, cell = gaussians.detach(), grid.cell_m
    if how.method == "centres":
        points = gaussians.means[gaussians.optical_depth >= how.optical_depth].double().cpu().numpy()
        points = _thin(points[points[:, 2] >= how.min_height * cell], how.voxel * cell)
    else:
        rays = RayGrid.for_image(grid, how.rays_per_pixel)
        returns = [
            _FirstReturns.of(gaussians, view, grid, rays, how.optical_depth) for view in [*views, *between(views)]
        ]
        points = np.concatenate([each.points() for each in returns])
        points = _thin(points[points[:, 2] >= how.min_height * cell], how.voxel * cell)
        # haze that one view takes for a surface is looked through by others, or seen by no other
        through, seen = np.zeros((2, len(points)), int)
        for each in returns:
            beyond = each.beyond(points)
            through += beyond > how.behind * cell
            seen += abs(beyond) <= how.behind * cell
        enough = min(how.seen_by, len(returns) // 5)  # a fifth, so that of few views there are points, too
        points = points[(through <= how.seen_through * len(returns)) & (seen >= enough)]
    return points if how.cluster_radius is None else _cluster(points, how.cluster_radius * cell, how.cluster_size)


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
    return [View.towards(direction) for direction in middle[nearer == 2]]


@dataclass(frozen=True)
class _FirstReturns:
    """Where the rays of one view return: ranges on its lattice, NaN where a ray meets nothing."""

    frame: Float64[np.ndarray, "3 3"]  # R_r
    range_m: Float64[np.ndarray, "rows columns"]
    origin: Float64[np.ndarray, " 2"]  # (x_r, y_r) of row 0, column 0
    spacing_m: Float64[np.ndarray, " 2"]

    @classmethod
    def of(
        cls, gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid, optical_depth: float
    ) -> _FirstReturns:
        (ray_map,) = render(gaussians, [view], grid, rays=rays, first_return_depth=optical_depth).ray_maps or ()
        ranges = ray_map.first_return.double().cpu().numpy()
        return cls(radar_frame(view), ranges, np.array(ray_map.origin), np.array(rays.spacing_m))

    def points(self) -> Float64[np.ndarray, "p 3"]:
        """The returns in the world frame, [P, 3]."""
        row, column = np.nonzero(~np.isnan(self.range_m))
        plane = self.origin + np.column_stack([column, row]) * self.spacing_m
        return np.column_stack([plane, self.range_m[row, column]]) @ self.frame

    def beyond(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " p"]:
        """How far behind each point the ray through it returns, m; infinite where it never does, [P]."""
        local = points @ self.frame.T
        column, row = np.rint((local[:, :2] - self.origin) / self.spacing_m).astype(int).T
        rows, columns = self.range_m.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        returned = np.full(len(points), np.inf)
        returned[inside] = np.nan_to_num(self.range_m[row[inside], column[inside]], nan=np.inf)
        return returned - local[:, 2]


def _thin(points: Float64[np.ndarray, "p 3"], voxel: float) -> Float64[np.ndarray, "fewer 3"]:
    """The mean of the points in each voxel."""
    if len(points) == 0:
        return points
    cells = np.floor(points / voxel).astype(np.int64)
    _, owner, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(owner.ravel(), points[:, k], len(count)) for k in range(3)], axis=1)
    return sums / count[:, None]


def _cluster(points: Float64[np.ndarray, "p 3"], radius: float, size: int) -> Float64[np.ndarray, "fewer 3"]:
    """The largest of DBSCAN's clusters: what floats apart from the target is left out."""
    try:
        from sklearn.cluster import DBSCAN
    except ImportError as error:
        raise SarsplatError(
            "cleaning the point cloud needs scikit-learn; install it with: pip install 'sarsplat[evaluate]'"
        ) from error
    if len(points) == 0:
        return points
    labels = DBSCAN(eps=radius, min_samples=size).fit(points).labels_
    return points[labels == np.bincount(labels + 1, minlength=2)[1:].argmax()]
