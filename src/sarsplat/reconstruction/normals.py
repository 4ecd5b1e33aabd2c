"""Normals of a point cloud: planes through the neighbours, turned to the radar."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Real
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from sarsplat.progress import stage
from sarsplat.unbroken import unbroken

_AT_ONCE = 4096  # points
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
    _, owner = np.unique(cubes, axis=0, return_inverse=True)
    table = np.column_stack([np.bincount(owner.ravel(), column) for column in table.T])  # sums over each cube
    tree, normals = cKDTree(table[:, 1:4] / table[:, :1]), np.empty((len(points), 3))
    with stage("surface: normals of the points", len(points)) as shown:
        for first in range(0, len(points), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            near = unbroken(tree.query_ball_point, centred[part], radius, workers=-1)
            ends = np.cumsum([0, *map(len, near)])
            neighbours = csr_array(
                (np.ones(ends[-1]), np.concatenate(near).astype(np.int64), ends), (len(near), len(table))
            )
            sums = neighbours @ table
            count, mean = sums[:, :1], sums[:, 1:4] / sums[:, :1]
            spread = sums[:, 4:].reshape(-1, 3, 3) / count[:, :, None] - mean[:, :, None] * mean[:, None, :]
            planes = np.linalg.eigh(spread)[1][:, :, 0]
            normals[part] = np.where(count < 3, towards[part], planes)
            shown.advance(len(normals[part]))
    normals *= np.where(np.einsum("pc,pc->p", normals, towards) < 0, -1.0, 1.0)[:, None]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
