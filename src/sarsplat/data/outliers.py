"""Outliers: Gaussians far from a scene, or far larger than it, which must not decide the size of its images.

Gaussians are linked to bodies across gaps up to several times the usual one. A body of a few Gaussians is an outlier if
images that include it would show the scene a few times as coarse; a body of many only if they would show next to
nothing of either. Masts, a second vehicle and a house outside of the village are part of the scene.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

SIGMAS = 2.5
"""Extent of a Gaussian, in standard deviations."""

_FEWEST = 10  # minimum number of Gaussians in which outliers are looked for
_HANDFUL = 8  # minimum number of Gaussians of a large body
_MAX_SHARE, _MAX_SHARE_OF_BODIES = 0.25, 0.1
"""Maximum share of outliers by distance, and of outliers in large bodies or by size."""
_COARSER, _INVISIBLE = 3.0, 50.0
"""Factor by which an outlier enlarges the images: a few Gaussians, and a large body."""
_GAPS, _EXTENTS = 10.0, 2.0
"""Longest link, in medians of the distance of neighbours and of the extents."""
_SAMPLE = 5_000  # Gaussians from which the median distance of neighbours is estimated
_MAX_LINKS = 8  # maximum number of links along an axis of a Gaussian; longer ones are outliers by size


def outliers(
    means: Float[np.ndarray, "n 3"],
    scales: Float[np.ndarray, "n 3"] | None = None,
    quaternions: Float[np.ndarray, "n 4"] | None = None,
) -> Bool[np.ndarray, " n"]:
    """Mark outliers among Gaussians, or among points without `scales`, of a scene around the origin."""
    count = len(means)
    none = np.zeros(count, bool)
    if count < _FEWEST:
        return none
    means = means.astype(np.float64)
    extents: Float64[np.ndarray, "n 3"] = np.zeros((count, 3))
    if scales is not None:
        extents = SIGMAS * scales.astype(np.float64)
    axes = np.broadcast_to(np.eye(3), (count, 3, 3))
    if quaternions is not None:
        axes = Rotation.from_quat(quaternions.astype(np.float64)[:, [1, 2, 3, 0]]).as_matrix().transpose(0, 2, 1)
    largest: Float64[np.ndarray, " n"] = extents.max(axis=1)
    body = _bodies(means, extents, axes, largest)
    distance: Float64[np.ndarray, " n"] = np.linalg.norm(means, axis=1)
    far = _in_far_bodies(distance, body)
    if far.mean() > _MAX_SHARE:
        return none
    usual = np.quantile(largest[~far], 1 - _MAX_SHARE_OF_BODIES)
    radius = (distance + np.minimum(largest, usual))[~far].max()
    huge = ~far & (distance + largest > _COARSER * radius)
    return far if huge.mean() > _MAX_SHARE_OF_BODIES else far | huge


def _bodies(
    means: Float64[np.ndarray, "n 3"],
    extents: Float64[np.ndarray, "n 3"],
    axes: Float64[np.ndarray, "n 3 3"],
    largest: Float64[np.ndarray, " n"],
) -> Int[np.ndarray, " n"]:
    """Return the number of the connected body of each Gaussian."""
    gaps = cKDTree(means).query(means[:: max(len(means) // _SAMPLE, 1)], k=2)[0][:, 1]
    step = max(_GAPS * float(np.median(gaps)), _EXTENTS * float(np.median(largest)), float(np.finfo(np.float32).tiny))
    points = [means]
    for axis in range(3):
        for k in range(1, _MAX_LINKS + 1):
            long = extents[:, axis] >= (k - 1) * step
            long &= extents[:, axis] > step / 2
            if not long.any():
                break
            along = np.minimum(extents[long, axis], k * step)[:, None] * axes[long, axis]
            points += [means[long] + along, means[long] - along]
    low = means.min(axis=0)
    cells, cell_of = np.unique(np.floor((np.concatenate(points) - low) / step), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.0, p=np.inf, output_type="ndarray")
    linked = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (len(cells), len(cells)))
    body: Int[np.ndarray, " n"] = connected_components(linked, directed=False)[1][cell_of.reshape(-1)[: len(means)]]
    return body


def _in_far_bodies(distance: Float64[np.ndarray, " n"], body: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Mark the Gaussians of bodies that are too far from the origin for images of the scene."""
    members = np.bincount(body)
    reach = np.zeros(len(members))
    np.maximum.at(reach, body, distance)
    main = reach[members.argmax()]
    bodies = (members >= _HANDFUL) & (reach <= _INVISIBLE * main)
    bodies[members.argmax()] = True
    limit = np.full(len(distance), _COARSER * reach[bodies].max())
    many = (members >= _HANDFUL)[body]
    if (many & ~bodies[body]).mean() > _MAX_SHARE_OF_BODIES:
        return np.zeros(len(distance), bool)
    limit[many] = 0.0
    return ~bodies[body] & (distance > limit)
