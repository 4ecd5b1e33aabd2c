"""Random points of a mesh's surface: the bits of `trimesh.sample.sample_surface` in a fraction of time and memory."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64, Int64, Real

from sarsplat.extras import Trimesh

_BATCH = 1 << 14  # points at once: intermediate results stay in the processor's cache
_MAX_STARTS = 1 << 20  # maximum length of the lookup table


def surface_samples(
    mesh: Trimesh, count: int, rng: np.random.Generator, weight: Real[np.ndarray, " faces"] | None = None
) -> Float64[np.ndarray, "{count} 3"]:
    """Draw points uniformly by area, or by the weight of each face; same bits as trimesh's with this generator."""
    points = np.empty((count, 3))
    for first, batch, _ in blocks_of_samples(mesh, count, rng, weight):
        points[first : first + batch.shape[1]] = batch.T
    return points


def blocks_of_samples(
    mesh: Trimesh, count: int, rng: np.random.Generator, weight: Real[np.ndarray, " faces"] | None = None
) -> Iterator[tuple[int, Float64[np.ndarray, "3 s"], Int64[np.ndarray, " s"]]]:
    """Yield these points in batches: index of the first one, coordinates and faces."""
    ends = np.cumsum(mesh.area_faces if weight is None else weight)
    shares = rng.random(count)
    entries = min(1 << (4 * len(ends)).bit_length(), _MAX_STARTS)  # faces at equally spaced shares of the area
    starts = np.searchsorted(ends, np.arange(entries) / entries * ends[-1])
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    origin = vertices[faces[:, 0]].T.copy()
    one, other = (vertices[faces[:, k]].T - origin for k in (1, 2))
    for first in range(0, count, _BATCH):
        share = shares[first : first + _BATCH]
        sought, face = share * ends[-1], starts[(share * entries).astype(np.int64)]
        left = np.flatnonzero(ends[face] < sought)
        face[left] = np.searchsorted(ends, sought[left])  # which is slow, so only where the table is too low
        along = rng.random((len(face), 2)).T.copy()
        beyond = along[0] + along[1] > 1.0  # in the other half of a parallelogram
        np.subtract(1.0, along, out=along, where=beyond)
        points = np.empty((3, len(face)))
        for axis in range(3):
            points[axis] = one[axis][face] * along[0] + other[axis][face] * along[1] + origin[axis][face]
        yield first, points, face
