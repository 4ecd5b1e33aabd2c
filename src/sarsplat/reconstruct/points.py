"""From Gaussians to a point cloud: where the rays of the training views return, thinned and cleaned."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.reconstruct.config import PointExtraction
from sarsplat.render import render

_RAYS_PER_PIXEL = 4.0


def extract_points(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, how: PointExtraction) -> np.ndarray:
    """Points of the surface that Gaussians stand for.

    Parameters
    ----------
    gaussians : Gaussians
        The target alone.
    views : sequence of View
        Views whose rays look for the surface ("rays").
    grid : ImageGrid
        Sets the spacing of the rays: a quarter of the pixel's.
    how : PointExtraction
        Method, thinning and clean-up.

    Returns
    -------
    numpy.ndarray, float64 [P, 3]
        World frame, m; possibly empty.
    """
    gaussians = gaussians.detach()
    if how.method == "centres":
        points = gaussians.means[gaussians.optical_depth >= how.optical_depth].double().numpy()
    else:
        points = _first_returns(gaussians, views, grid, how.optical_depth)
    points = _thin(points, how.voxel)
    return points if how.cluster_radius is None else _cluster(points, how.cluster_radius, how.cluster_size)


def _first_returns(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, optical_depth: float) -> np.ndarray:
    rays = RayGrid.for_image(grid, _RAYS_PER_PIXEL)
    found = []
    for view in views:  # one at a time: only the points are kept
        (ray_map,) = render(gaussians, [view], grid, rays=rays, first_return_depth=optical_depth).ray_maps or ()
        depth = ray_map.first_return.double().numpy()
        row, column = np.nonzero(~np.isnan(depth))
        x = ray_map.origin[0] + column * rays.spacing[0]
        y = ray_map.origin[1] + row * rays.spacing[1]
        found.append(np.column_stack([x, y, depth[row, column]]) @ radar_frame(view))
    return np.concatenate(found)


def _thin(points: np.ndarray, voxel: float) -> np.ndarray:
    """The mean of the points in each voxel."""
    if len(points) == 0:
        return points
    cells = np.floor(points / voxel).astype(np.int64)
    _, owner, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(owner.ravel(), points[:, k], len(count)) for k in range(3)], axis=1)
    return sums / count[:, None]


def _cluster(points: np.ndarray, radius: float, size: int) -> np.ndarray:
    """Without the points that DBSCAN calls noise."""
    try:
        from sklearn.cluster import DBSCAN
    except ImportError as error:
        raise SarsplatError(
            "cleaning the point cloud needs scikit-learn; install it with: pip install 'sarsplat[evaluate]'"
        ) from error
    if len(points) == 0:
        return points
    return points[DBSCAN(eps=radius, min_samples=size).fit(points).labels_ >= 0]
