"""Clusters of points: separate objects from speckle and ground."""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sarsplat.errors import counted
from sarsplat.extras import needed
from sarsplat.geometry import ImageGrid, View
from sarsplat.surface.cells import numbered

_CUBES = 4  # cubes per DBSCAN radius
_TOUCHING = 1.8  # maximum distance of adjacent cubes (a corner is √3), in sides

_BRIGHT_VIEWS = 0.25
"""Share of views beyond which a cluster must reach the threshold: many are bright from one side only."""

_NAMED = 3  # maximum number of clusters whose places a note names


def largest(points: Float64[np.ndarray, "p 3"], radius: float, size: int) -> Bool[np.ndarray, " p"]:
    """Return the mask of the largest DBSCAN cluster; all False without clusters."""
    with needed("evaluate", "cleaning the point cloud"):
        from sklearn.cluster import DBSCAN
    if len(points) == 0:
        return np.zeros(0, bool)
    # DBSCAN on weighted centroids of cubes: a dense cloud has hundreds of neighbours per point
    cubes, owner = _cubes(points, radius / _CUBES)
    count = np.bincount(owner)
    centres = np.stack([np.bincount(owner, axis, len(cubes)) for axis in points.T], axis=1) / count[:, None]
    labels = DBSCAN(eps=radius, min_samples=size).fit(centres, sample_weight=count).labels_[owner]
    return labels == np.bincount(labels + 1, minlength=2)[1:].argmax()


def brightest_speckle_m2(gamma0: float, views: Sequence[View], grid: ImageGrid) -> Float64[np.ndarray, " v"]:
    """Return the expected cross-section of the brightest cell of ground in a single-look image of each view, m²."""
    sides_m = np.maximum(grid.resolution_m, grid.spacing_m)
    mean_m2 = np.array([view.look.beta0_of_gamma0(gamma0) for view in views]) * sides_m.prod()
    return mean_m2 * (math.log(max(grid.independent_samples, 1.0)) + np.euler_gamma)  # of exponential samples


def bright(
    points: Float64[np.ndarray, "p 3"],
    high: Bool[np.ndarray, " p"],
    radius: float,
    threshold_m2: Float64[np.ndarray, " v"],
    means: Float64[np.ndarray, "n 3"],
    cross_sections: Iterable[Float32[np.ndarray, "_ n"]],
    say: Callable[[str], object],
) -> Bool[np.ndarray, " p"]:
    """Return the mask of clusters that are objects, and report the others.

    Objects have `high` points (more than a cell above the ground: lower relief and texture look alike) and return at
    least `threshold_m2` (by view) in more than a quarter of the views. Clusters are connected cubes with sides of
    `radius`, m. Gaussians of `means`, m, belong to the nearest cluster, within two cubes; `cross_sections`, m², come
    in batches of views.
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
    cluster_of = cluster[nearest[near]]
    by_view, total_m2 = [], 0.0
    for batch in cross_sections:
        by_view += [np.bincount(cluster_of, view[near], count) for view in batch]
        total_m2 += float(batch.sum(dtype=float))
    power_m2 = np.array(by_view)
    enough = (power_m2 >= threshold_m2[:, None]).mean(axis=0) > _BRIGHT_VIEWS
    is_object = enough & (np.bincount(cluster[owner], high, count) > 0)
    if not is_object.all():
        omitted = np.flatnonzero(~is_object)
        omitted = omitted[np.argsort(-power_m2[:, omitted].sum(axis=0), kind="stable")]
        share = power_m2[:, omitted].sum() / max(total_m2, np.finfo(float).tiny)
        first = [points[cluster[owner] == k].mean(axis=0) for k in omitted[:_NAMED]]
        where = "; ".join(", ".join(f"{value:.2f}" for value in place) for place in first)
        more = ", …" if len(omitted) > _NAMED else ""
        left_out = counted(len(omitted), "cluster")
        say(f"points: left out {left_out} like speckle or ground, {share:.2g} of the power, at ({where}{more}) m")
    return is_object[cluster[owner]]


def _cubes(points: Float64[np.ndarray, "p 3"], side: float) -> tuple[Int[np.ndarray, "c 3"], Int[np.ndarray, " p"]]:
    """Return cubes that hold points, in units of their side, and the index of each point's cube."""
    places = np.floor(points / side).astype(np.int64)
    numbers = numbered(torch.from_numpy(places)).numpy()
    _, first, owner = np.unique(numbers, return_index=True, return_inverse=True)
    return places[first], owner
