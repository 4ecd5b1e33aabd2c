"""Gaussians that lie apart from a scene, or are far larger than it: they must not decide how large its images are.

What is connected belongs together: Gaussians are linked where no gap between them is several times as wide as between
most. What remains apart in a handful is a stray if images that show it as well would show the scene a few times as
coarse; a body of many is one only if they would show next to nothing of either. A mast, a second vehicle and a house
outside of the village are none.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

SIGMAS = 2.5
"""Standard deviations of a Gaussian that count as its extent."""

_FEWEST = 10  # Gaussians of which something can be said
_HANDFUL = 8  # that are no body by themselves
_MOST, _MOST_OF_BODIES = 0.25, 0.1  # of all that may be strays: in all, and in bodies or by their size
_COARSER, _INVISIBLE = 3.0, 50.0  # times: by a handful, and by a body
_GAPS, _EXTENTS = 10.0, 2.0  # of the usual distance of neighbours, and of the usual extent
_SAMPLE = 5_000  # Gaussians of which the usual distance is taken
_LONGEST = 8  # links along an axis of a Gaussian: beyond, its size is what is odd


def strays(
    means: Float[np.ndarray, "n 3"],
    scales: Float[np.ndarray, "n 3"] | None = None,
    quaternions: Float[np.ndarray, "n 4"] | None = None,
) -> Bool[np.ndarray, " n"]:
    """Which Gaussians, or places without an extent, are strays, seen from the origin."""
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
    apart = _apart(distance, body)
    if apart.mean() > _MOST:
        return none
    usual = np.quantile(largest[~apart], 1 - _MOST_OF_BODIES)
    whole = (distance + np.minimum(largest, usual))[~apart].max()
    huge = ~apart & (distance + largest > _COARSER * whole)
    return apart if huge.mean() > _MOST_OF_BODIES else apart | huge


def _bodies(
    means: Float64[np.ndarray, "n 3"],
    extents: Float64[np.ndarray, "n 3"],
    axes: Float64[np.ndarray, "n 3 3"],
    largest: Float64[np.ndarray, " n"],
) -> Int[np.ndarray, " n"]:
    """The number of the connected body that each Gaussian is part of."""
    some = means[:: max(len(means) // _SAMPLE, 1)]
    gaps = cKDTree(means).query(some, k=2)[0][:, 1]
    step = max(_GAPS * float(np.median(gaps)), _EXTENTS * float(np.median(largest)), float(np.finfo(np.float32).tiny))
    places = [means]
    for axis in range(3):
        for k in range(1, _LONGEST + 1):
            long = extents[:, axis] >= (k - 1) * step
            long &= extents[:, axis] > step / 2
            if not long.any():
                break
            along = np.minimum(extents[long, axis], k * step)[:, None] * axes[long, axis]
            places += [means[long] + along, means[long] - along]
    low = means.min(axis=0)
    cells, cell_of = np.unique(np.floor((np.concatenate(places) - low) / step), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.0, p=np.inf, output_type="ndarray")
    linked = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (len(cells), len(cells)))
    body: Int[np.ndarray, " n"] = connected_components(linked, directed=False)[1][cell_of.reshape(-1)[: len(means)]]
    return body


def _apart(distance: Float64[np.ndarray, " n"], body: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Which ones are part of a body that images around the origin had better leave out."""
    members = np.bincount(body)
    reach = np.zeros(len(members))
    np.maximum.at(reach, body, distance)
    main = reach[members.argmax()]
    bodies = (members >= _HANDFUL) & (reach <= _INVISIBLE * main)
    bodies[members.argmax()] = True
    far = np.full(len(distance), _COARSER * reach[bodies].max())
    many = (members >= _HANDFUL)[body]
    if (many & ~bodies[body]).mean() > _MOST_OF_BODIES:
        return np.zeros(len(distance), bool)
    far[many] = 0.0
    return ~bodies[body] & (distance > far)
