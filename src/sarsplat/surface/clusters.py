"""Clusters of points: objects are kept, remains of speckle are dropped."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sarsplat.errors import SarsplatError, counted
from sarsplat.extras import install_command
from sarsplat.geometry import ImageGrid
from sarsplat.surface.cells import numbered

_CUBES = 4
"""Cubes per radius of a cluster (DBSCAN)."""

_TOUCHING = 1.8
"""Maximum distance of cubes that touch at a side, an edge or a corner, in sides."""

_QUARTILE = 0.75
"""Quantile over the views at which a cluster's power is tested: many objects are lit from one side only."""

_NAMED = 3
"""Maximum number of clusters whose places a note names."""


def largest(points: Float64[np.ndarray, "p 3"], radius: float, size: int) -> Bool[np.ndarray, " p"]:
    """Mask of the largest DBSCAN cluster, which drops points that float apart from the target."""
    try:
        from sklearn.cluster import DBSCAN
    except ImportError as error:
        raise SarsplatError(f"cleaning the point cloud needs scikit-learn; {install_command('evaluate')}") from error
    if len(points) == 0:
        return np.zeros(0, bool)
    # one weighted point per cube: points of a dense cloud have hundreds of neighbours
    cubes, owner = _cubes(points, radius / _CUBES)
    count = np.bincount(owner)
    centres = np.stack([np.bincount(owner, axis, len(cubes)) for axis in points.T], axis=1) / count[:, None]
    labels = DBSCAN(eps=radius, min_samples=size).fit(centres, sample_weight=count).labels_[owner]
    return labels == np.bincount(labels + 1, minlength=2)[1:].argmax()


def brightest_speckle_m2(gamma0: float, grid: ImageGrid) -> float:
    """Expected cross-section of the brightest resolution cell of ground in a single-look image, m²."""
    return gamma0 * math.prod(grid.resolution_m) * math.log(max(grid.independent_samples, math.e))


def bright(
    points: Float64[np.ndarray, "p 3"],
    high: Bool[np.ndarray, " p"],
    radius: float,
    least_m2: float,
    means: Float64[np.ndarray, "n 3"],
    cross_sections: Iterable[Float32[np.ndarray, "v n"]],
    say: Callable[[str], object],
) -> Bool[np.ndarray, " p"]:
    """Mask of the clusters whose Gaussians return at least `least_m2` in a quarter of the views; reports the others.

    A cluster without `high` points is ground: heights of less than a cell and differences of its brightness look alike.
    Clusters are connected cubes with sides of the radius, m. `means` (m) and `cross_sections` (m², batches of views)
    are those of all Gaussians; each belongs to the nearest cluster within two cubes.
    """
    if len(points) == 0:
        return np.zeros(0, bool)
    cubes, owner = _cubes(points, radius)
    tree = cKDTree(cubes)
    pairs = tree.query_pairs(_TOUCHING, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), bool), pairs.T), (len(cubes), len(cubes)))
    count, cluster = connected_components(links, directed=False)
    distance, nearest = tree.query(np.floor(means / radius), distance_upper_bound=2.0)
    near = np.isfinite(distance)
    of_gaussian = cluster[nearest[near]]
    power = np.array([np.bincount(of_gaussian, section[near], count) for batch in cross_sections for section in batch])
    keep = (np.quantile(power, _QUARTILE, axis=0) >= least_m2) & (np.bincount(cluster[owner], high, count) > 0)
    if not keep.all():
        share = power[:, ~keep].sum() / max(power.sum(), np.finfo(float).tiny)
        first = [points[cluster[owner] == k].mean(axis=0) for k in np.flatnonzero(~keep)[:_NAMED]]
        where = "; ".join(", ".join(f"{value:.2f}" for value in place) for place in first)
        more = ", …" if (~keep).sum() > _NAMED else ""
        left_out = counted(int((~keep).sum()), "cluster")
        say(f"points: left out {left_out} like speckle or ground, {share:.2g} of the power, at ({where}{more}) m")
    return keep[cluster[owner]]


def _cubes(points: Float64[np.ndarray, "p 3"], side: float) -> tuple[Int[np.ndarray, "c 3"], Int[np.ndarray, " p"]]:
    """Cubes that hold points, in units of their side, and the index of each point's cube."""
    places = np.floor(points / side).astype(np.int64)
    numbers = numbered(torch.from_numpy(places)).numpy()
    _, first, owner = np.unique(numbers, return_index=True, return_inverse=True)
    return places[first], owner
