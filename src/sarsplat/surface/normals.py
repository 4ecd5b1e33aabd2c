"""Normals of a point cloud: planes through the neighbours, turned to the radar."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float64, Real
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from sarsplat.progress import stage
from sarsplat.surface import cells
from sarsplat.surface.cells import Groups, numbered
from sarsplat.surface.neighbours import sums_within
from sarsplat.uninterruptible import uninterruptible

_AT_ONCE = 4096  # cubes
_CUBES = 4  # to a radius: a dense cloud has hundreds of neighbours for each point, which count by the cube
_FIRST, _SECOND = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]  # coordinates of the products
_FLAT = 1e-18  # squared, to the fourth power of the spread: narrower is a line


def surface_normals(
    points: Real[np.ndarray, "p 3"],
    towards: Real[np.ndarray, "p 3"],
    radius: float,
    device: torch.device | str = "cpu",
) -> Float64[np.ndarray, "p 3"]:
    """Unit normals of the planes that fit the neighbours (within a radius, m) of surface points best.

    They are on the side of `towards`, from where each point is seen: of any length; zero stands for above. Points with
    fewer than three neighbours, themselves included, have that direction. They are calculated on a device.
    """
    if len(points) == 0:
        return np.empty((0, 3))
    places = torch.from_numpy(points).to(device)
    if not cells.on_cpu(places):
        return _normals(places.double(), torch.from_numpy(towards).to(places.device).double(), radius).cpu().numpy()
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


def _normals(points: Float64[Tensor, "p 3"], towards: Float64[Tensor, "p 3"], radius: float) -> Float64[Tensor, "p 3"]:
    """The same where the points are."""
    above = torch.eye(3, dtype=towards.dtype, device=towards.device)[2]
    towards = towards.where((towards != 0).any(1, keepdim=True), above)
    centred = points - points.mean(0)
    products = centred[:, _FIRST] * centred[:, _SECOND]
    cubes = Groups.of(numbered((centred * (_CUBES / radius)).floor().long()))
    table = cubes.sums(torch.cat([torch.ones_like(centred[:, :1]), centred, products], dim=1))
    sums = sums_within(table[:, 1:4] / table[:, :1], table, radius)
    count, mean = sums[:, :1], sums[:, 1:4] / sums[:, :1]
    spread = sums[:, 4:] / count - mean[:, _FIRST] * mean[:, _SECOND]
    owner = cubes.owner
    normals = _across(spread[owner], towards).where(count[owner] >= 3, towards)
    normals = normals * torch.where((normals * towards).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return normals / normals.norm(dim=1, keepdim=True)


def _across(spread: Float64[Tensor, "p 6"], towards: Float64[Tensor, "p 3"]) -> Float64[Tensor, "p 3"]:
    """Vectors along which points spread least, given xx, xy, xz, yy, yz, zz; of those, where many do, near `towards`.

    In closed form: torch's batched `eigh` looks at each result, for which the CPU waits, and takes no more than some
    ten thousand matrices at a time on some GPUs. The eigenvalue by O. K. Smith, "Eigenvalues of a symmetric 3 × 3
    matrix", 1961; its vector is orthogonal to all rows of the matrix less the eigenvalue.
    """
    matrix = spread[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    one = torch.eye(3, dtype=spread.dtype, device=spread.device)
    mean = (spread[:, 0] + spread[:, 3] + spread[:, 5])[:, None, None] / 3
    tiny = torch.finfo(spread.dtype).tiny
    off = (matrix - mean * one) / mean.clamp(min=tiny)
    size = (off.square().sum((1, 2), keepdim=True) / 6).sqrt()
    x, y, z = (off / size.clamp(min=tiny)).unbind(1)
    turn = (torch.linalg.cross(x, y) * z).sum(1).div(2).clamp(-1, 1).acos() / 3
    rows = off - 2 * size * (turn + 2 * math.pi / 3).cos()[:, None, None] * one
    crossed = torch.linalg.cross(rows[:, [0, 0, 1]], rows[:, [1, 2, 2]])
    square = crossed.square().sum(2)
    best = crossed.gather(1, square.argmax(1)[:, None, None].expand(-1, 1, 3))[:, 0]
    # all rows along one line: the points are on it
    along = rows.gather(1, rows.square().sum(2).argmax(1)[:, None, None].expand(-1, 1, 3))[:, 0]
    along = along / along.norm(dim=1, keepdim=True).clamp(min=tiny)
    upright = towards - (towards * along).sum(1, keepdim=True) * along
    upright = upright.where(upright.square().sum(1, keepdim=True) > 0, towards)
    return best.where(square.amax(1, keepdim=True) > _FLAT * size[:, 0] ** 4, upright)
