"""Normals of a point cloud: planes through the neighbours, turned to the radar."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Real
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from sarsplat.progress import stage
from sarsplat.uninterruptible import uninterruptible

_AT_ONCE = 4096  # cubes
_CUBES = 4  # to a radius: a dense cloud has hundreds of neighbours for each point, which count by the cube


def surface_normals(
    points: Real[np.ndarray, "p 3"], towards: Real[np.ndarray, "p 3"], radius: float
) -> Float64[np.ndarray, "p 3"]:
    """Unit normals of the planes that fit the neighbours (within a radius, m) of surface points best.

    They are on the side of `towards`, from where each point is seen: of any length; zero stands for above. Points with
    fewer than three neighbours, themselves included, have that direction.
    """
    if len(points) == 0:
        return np.empty((0, 3))
    towards = np.where(np.any(towards, axis=1, keepdims=True), towards, [[0.0, 0.0, 1.0]])
    centred = np.asarray(points, np.float64) - np.mean(points, axis=0, dtype=np.float64)
    products = (centred[:, :, None] * centred[:, None, :]).reshape(-1, 9)
    table = np.column_stack([np.ones(len(points)), centred, products])
    cubes = np.floor(centred * (_CUBES / radius)).astype(np.int64)
    owner = np.unique(cubes, axis=0, return_inverse=True)[1].ravel()
    table = np.column_stack([np.bincount(owner, column) for column in table.T])  # sums over each cube
    means, count, planes = table[:, 1:4] / table[:, :1], np.zeros(len(table)), np.zeros((len(table), 3))
    tree = cKDTree(means)
    with stage("surface: normals of the points", len(table)) as shown:
        for first in range(
            0, len(table), _AT_ONCE
        ):  # points of a cube share their plane: a cube is small to the radius
            part = slice(first, first + _AT_ONCE)
            near = uninterruptible(tree.query_ball_point, means[part], radius, workers=-1)
            ends = np.cumsum([0, *map(len, near)])
            neighbours = csr_array(
                (np.ones(ends[-1]), np.concatenate(near).astype(np.int64), ends), (len(near), len(table))
            )
            sums = neighbours @ table
            count[part], mean = sums[:, 0], sums[:, 1:4] / sums[:, :1]
            spread = sums[:, 4:].reshape(-1, 3, 3) / sums[:, :1, None] - mean[:, :, None] * mean[:, None, :]
            planes[part] = np.linalg.eigh(spread)[1][:, :, 0]
            shown.advance(len(near))
    normals = np.where(count[owner, None] < 3, towards, planes[owner])
    normals *= np.where(np.einsum("pc,pc->p", normals, towards) < 0, -1.0, 1.0)[:, None]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
