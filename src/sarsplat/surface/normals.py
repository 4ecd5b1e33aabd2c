"""Normals of a point cloud: what the Gaussians around and the points beside it have in common, turned to the radar.

A learned Gaussian of a surface is flat, and its shortest axis is about the surface's normal. Those around a point vote,
the more the nearer and the flatter they are, against directions in which the neighbouring points spread; votes that
differ from the majority are then given less and less weight, so that two sides of an edge do not mix.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float64, Real
from torch import Tensor
from torch.nn.functional import normalize

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.progress import stage
from sarsplat.surface import cells
from sarsplat.surface.neighbours import neighbours_of
from sarsplat.surface.surfels import CUBE, Surfels, dot

_AT_ONCE, _AT_ONCE_ELSEWHERE = 4096, 1 << 16  # pieces of surface: on the CPU, in its caches
_VOTERS, _BESIDE = 32, 32  # Gaussians, and pieces of surface, that count for one
_BLUR, _NEAR = 0.2, 0.5  # standard deviations of what Gaussians and pieces count by distance, resolution cells
_ROUNDS = 3
_DISSENT = 0.3  # sine of the angle at which a vote counts e⁻¹ of one for the majority
_SPREAD = (1.0, 0.5)  # weight of the points' spread against the votes, in the first round and the others
_TOWARDS = 1e-7  # vote of the radar, which decides where nothing else does
_FIRST, _SECOND = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]  # coordinates of the products
_TINY = torch.finfo(torch.float64).tiny
_FLAT = 1e-18  # squared, to the fourth power of the spread: narrower is a line


def surface_normals(
    points: Real[np.ndarray, "p 3"], towards: Real[np.ndarray, "p 3"], gaussians: Gaussians, cell_m: float
) -> Float64[np.ndarray, "p 3"]:
    """Unit normals of the surface at its points.

    Parameters
    ----------
    points : numpy.ndarray [P, 3]
        World frame, m.
    towards : numpy.ndarray [P, 3]
        Directions from where each point is seen, of any length; zero stands for above. Normals are on this side.
    gaussians : Gaussians
        Of the surface, on the device that calculates; possibly none, and normals are then those of the points alone.
    cell_m : float
        Resolution cell of the images, m: the unit of the lengths within which neighbours count.

    Returns
    -------
    numpy.ndarray, float64 [P, 3]
        Points without neighbours and Gaussians around have the direction `towards`. Those in the same cube of 0.15
        resolution cells differ in their side alone.
    """
    if len(points) == 0:
        return np.empty((0, 3))
    means = gaussians.means.detach().double()
    there, seen = (torch.from_numpy(np.asarray(each)).to(means) for each in (points, towards))
    above = torch.eye(3, dtype=seen.dtype, device=seen.device)[2]
    seen = normalize(seen.where((seen != 0).any(1, keepdim=True), above), dim=1)
    pieces = Surfels.of(there, seen, CUBE * cell_m)
    voters, beside = _Voters(gaussians, _BLUR * cell_m), neighbours_of(pieces.places)
    found, count = [], len(pieces.places)
    with stage("surface: normals of the points", count) as shown:
        at_once = _AT_ONCE if cells.on_cpu(there) else _AT_ONCE_ELSEWHERE
        for first in range(0, count, at_once):
            some = slice(first, first + at_once)
            places, ways = pieces.places[some], pieces.normals[some]
            square, index = beside.nearest(places, min(_BESIDE, count))
            weight = pieces.counts[index] * torch.exp(-0.5 * square / (_NEAR * cell_m) ** 2)
            found.append(voters.normals(places, ways, _spread(pieces.places[index], weight)))
            shown.advance(len(places))
    normals = torch.cat(found)[pieces.owner]
    normals = normals * torch.where((normals * seen).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return normals.cpu().numpy()


def _spread(places: Float64[Tensor, "q k 3"], weight: Float64[Tensor, "q k"]) -> Float64[Tensor, "q 6"]:
    """Covariances of weighted places as a share of their trace; zero where they coincide."""
    weight = (weight / weight.sum(1, keepdim=True))[:, None]
    products = (weight @ _squares(places - weight @ places))[:, 0]
    trace = products[:, 0] + products[:, 3] + products[:, 5]
    return products / trace.clamp(min=torch.finfo(trace.dtype).tiny)[:, None]


class _Voters:
    """Shortest axes of Gaussians that are asked for normals."""

    def __init__(self, gaussians: Gaussians, blur_m: float) -> None:
        gaussians = gaussians.detach()
        self._means, scales = gaussians.means.double(), gaussians.scales.double()
        axes = rotation_matrix(gaussians.quaternions.double()).mT  # in rows
        short, middle, _ = scales.sort(dim=1).values.unbind(1)
        self._flat = 1 - short / middle
        self._axis = axes.gather(1, scales.argmin(1)[:, None, None].expand(-1, 1, 3))[:, 0]
        root = axes / (scales.square() + blur_m**2).sqrt()[..., None]
        self._precision = _squares(root).sum(1) * torch.tensor([1, 2, 2, 1, 2, 1]).to(root)  # times products of offsets
        self._near = neighbours_of(self._means) if len(gaussians) else None

    def normals(
        self, places: Float64[Tensor, "q 3"], towards: Float64[Tensor, "q 3"], spread: Float64[Tensor, "q 6"]
    ) -> Float64[Tensor, "q 3"]:
        """What most agree on, given the spread of the points around; on any side."""
        against = _squares(torch.eye(3).to(places)).sum(0) - _TOWARDS * _squares(towards)
        if self._near is None:
            return normalize(_across(against + _SPREAD[0] * spread, towards), dim=1, eps=_TINY)
        _, index = self._near.nearest(places, min(_VOTERS, len(self._means)))
        square = dot(self._precision[index], _squares(places[:, None] - self._means[index]))
        weight = torch.exp(-0.5 * (square - square.amin(1, keepdim=True))) * self._flat[index]
        axes = self._axis[index]
        products = _squares(axes)

        def elected(vote: Float64[Tensor, "q k"], share: float) -> Float64[Tensor, "q 3"]:
            vote = vote / vote.sum(1, keepdim=True).clamp(min=_TINY)
            agreed = (vote[:, None] @ products)[:, 0]
            return normalize(_across(against - agreed + share * spread, towards), dim=1, eps=_TINY)

        normal = elected(weight, _SPREAD[0])
        for _ in range(_ROUNDS):
            sine_square = 1 - dot(axes, normal[:, None]).square()
            normal = elected(weight * torch.exp(-sine_square / _DISSENT**2), _SPREAD[1])
        return normal


def _squares(vectors: Float64[Tensor, "*q 3"]) -> Float64[Tensor, "*q 6"]:
    """Products xx, xy, xz, yy, yz, zz of coordinates."""
    return vectors[..., _FIRST] * vectors[..., _SECOND]


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
