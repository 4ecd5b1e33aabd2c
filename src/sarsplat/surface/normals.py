"""Normals of a point cloud: what the Gaussians around and the points beside it have in common, turned to the radar.

A learned Gaussian of a surface is flat, and its shortest axis is about the surface's normal. Those around a point vote,
the more the nearer and the flatter they are, against directions in which the neighbouring points spread; votes that
differ from the majority are then given less and less weight, so that two sides of an edge do not mix.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, Real
from torch import Tensor
from torch.nn.functional import normalize

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.progress import stage
from sarsplat.surface.cells import by_cubes
from sarsplat.surface.neighbours import neighbours_of, spacing_m
from sarsplat.surface.surfels import Surfels

_CUBE, _ASKED = (0.15, 0.4), (0.15, 0.6)
"""Sides of the cubes of pieces of surface, and of those whose neighbours are looked for: at least and most, cells."""
_CUBE_SPACINGS, _ASKED_SPACINGS = 2, 3  # in between, of the points
_VOTERS, _BESIDE = 32, 32  # Gaussians, and pieces of surface, that count for one
_BLUR, _NEAR = 0.2, 0.5  # standard deviations of what Gaussians and pieces count by distance, resolution cells
_ROUNDS = 2
_DISSENT = 0.3  # sine of the angle at which a vote counts e⁻¹ of one for the majority
_SPREAD = (1.0, 0.5)  # weight of the points' spread against the votes, in the first round and the others
_TOWARDS = 1e-7  # vote of the radar, which decides where nothing else does
_TINY = torch.finfo(torch.float32).tiny
_FLAT = 1e-18  # squared, of a spread of one: narrower is a line


def surface_normals(
    points: Real[np.ndarray, "p 3"],
    towards: Real[np.ndarray, "p 3"],
    gaussians: Gaussians,
    cell_m: float,
    apart_m: float | None = None,
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
    apart_m : float, optional
        How far apart the points of the cloud are, m, of which these are a part (`spacing_m`): where it is wide, less
        is asked for. That of these points unless given.

    Returns
    -------
    numpy.ndarray, float64 [P, 3]
        Points without neighbours and Gaussians around have the direction `towards`. Those in the same cube of
        0.15 to 0.4 resolution cells differ in their side alone.
    """
    if len(points) == 0:
        return np.empty((0, 3))
    means = gaussians.means.detach().double()
    there, seen = (torch.from_numpy(np.asarray(each)).to(means) for each in (points, towards))
    above = torch.eye(3, dtype=seen.dtype, device=seen.device)[2]
    seen = normalize(seen.where((seen != 0).any(1, keepdim=True), above), dim=1)
    apart_m = spacing_m(points) if apart_m is None else apart_m
    cube_m, asked_m = (
        float(np.clip(spacings * apart_m, least * cell_m, most * cell_m))
        for spacings, (least, most) in ((_CUBE_SPACINGS, _CUBE), (_ASKED_SPACINGS, _ASKED))
    )
    pieces = Surfels.of(there, seen, cube_m)
    voters, beside = _Voters(gaussians, _BLUR * cell_m), _Beside(pieces, _NEAR * cell_m)
    normals = torch.empty_like(pieces.places)
    with stage("surface: normals of the points", len(normals)) as shown:
        for some, middles, cube in by_cubes(pieces.places, asked_m):
            places, ways = pieces.places[some], pieces.normals[some]
            spread = beside.spread(places, middles, cube)
            normals[some] = voters.normals(places, ways, spread, middles, cube)
            shown.advance(len(some))
    normals = normals[pieces.owner]
    normals = normals * torch.where((normals * seen).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return normals.cpu().numpy()


class _Beside:
    """Pieces of surface that are asked how they spread around places."""

    def __init__(self, pieces: Surfels, near_m: float) -> None:
        self._places, self._counts, self._near_m = pieces.places, pieces.counts.float(), near_m
        self._near = neighbours_of(pieces.places)

    def spread(
        self, places: Float64[Tensor, "q 3"], middles: Float64[Tensor, "c 3"], cube: Int64[Tensor, " q"]
    ) -> Float64[Tensor, "q 6"]:
        """Covariances of those near the cube of each place, as a share of their trace; zero where they coincide."""
        index = self._near.nearest(middles, min(_BESIDE, len(self._places)))[1][cube]
        x, y, z = _offsets(self._places, index, places, self._near_m)
        weight = self._counts[index] * torch.exp(-0.5 * (x * x + y * y + z * z))
        weight = weight / weight.sum(1, keepdim=True).clamp(min=_TINY)
        x, y, z = (each - (weight * each).sum(1, keepdim=True) for each in (x, y, z))
        products = torch.stack([(weight * each).sum(1) for each in _products(x, y, z)], dim=1).double()
        trace = products[:, 0] + products[:, 3] + products[:, 5]
        return products / trace.clamp(min=_TINY)[:, None]


class _Voters:
    """Shortest axes of Gaussians that are asked for normals."""

    def __init__(self, gaussians: Gaussians, blur_m: float) -> None:
        gaussians = gaussians.detach()
        self._means, scales, self._blur_m = gaussians.means.double(), gaussians.scales.double(), blur_m
        axes = rotation_matrix(gaussians.quaternions.double()).mT  # in rows
        short, middle, _ = scales.sort(dim=1).values.unbind(1)
        self._flat = (1 - short / middle).float()
        axis = axes.gather(1, scales.argmin(1)[:, None, None].expand(-1, 1, 3))[:, 0]
        root = axes / (scales / blur_m).square().add(1).sqrt()[..., None]
        precision = torch.stack(_products(*root.unbind(2)), dim=2).sum(1)
        self._precision = [each.contiguous() for each in precision.float().unbind(1)]
        self._votes = [each.float() for each in _products(*axis.unbind(1))]
        self._near = neighbours_of(self._means) if len(gaussians) else None

    def normals(
        self,
        places: Float64[Tensor, "q 3"],
        towards: Float64[Tensor, "q 3"],
        spread: Float64[Tensor, "q 6"],
        middles: Float64[Tensor, "c 3"],
        cube: Int64[Tensor, " q"],
    ) -> Float64[Tensor, "q 3"]:
        """What most near the cube of each place agree on, given the spread of the points around; on any side."""
        against = spread.new_tensor([1, 0, 0, 1, 0, 1]) - _TOWARDS * torch.stack(_products(*towards.unbind(1)), dim=1)
        if self._near is None:
            return normalize(_across(against + _SPREAD[0] * spread, towards), dim=1, eps=_TINY)
        index = self._near.nearest(middles, min(_VOTERS, len(self._means)))[1][cube]
        offsets = _products(*_offsets(self._means, index, places, self._blur_m))
        square = _form([each[index] for each in self._precision], offsets)
        weight = torch.exp(-0.5 * (square - square.amin(1, keepdim=True))) * self._flat[index]
        votes = [each[index] for each in self._votes]

        def elected(weight: Float[Tensor, "q k"], share: float) -> Float64[Tensor, "q 3"]:
            weight = weight / weight.sum(1, keepdim=True).clamp(min=_TINY)
            agreed = torch.stack([(weight * each).sum(1) for each in votes], dim=1)
            return normalize(_across(against - agreed + share * spread, towards), dim=1, eps=_TINY)

        normal = elected(weight, _SPREAD[0])
        for _ in range(_ROUNDS):
            cosine_square = _form(votes, _products(*normal.float().T[..., None]))
            normal = elected(weight * torch.exp((cosine_square - 1) / _DISSENT**2), _SPREAD[1])
        return normal


def _offsets(
    of: Float64[Tensor, "n 3"], index: Int64[Tensor, "q k"], places: Float64[Tensor, "q 3"], unit_m: float
) -> list[Float[Tensor, "q k"]]:
    """Coordinates x, y, z of some places as seen from others, in a unit, m; in float32, which does for weights."""
    return [((there[index] - here[:, None]) / unit_m).float() for there, here in zip(of.T, places.T, strict=True)]


def _products(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """xx, xy, xz, yy, yz, zz."""
    return [x * x, x * y, x * z, y * y, y * z, z * z]


def _form(matrix: Sequence[Tensor], products: Sequence[Tensor]) -> Tensor:
    """Quadratic forms, given the six entries of symmetric matrices and the products of coordinates."""
    xx, xy, xz, yy, yz, zz = (one * other for one, other in zip(matrix, products, strict=True))
    return xx + yy + zz + 2 * (xy + xz + yz)


def _across(spread: Float64[Tensor, "p 6"], towards: Float64[Tensor, "p 3"]) -> Float64[Tensor, "p 3"]:
    """Vectors along which points spread least, given xx, xy, xz, yy, yz, zz; of those, where many do, near `towards`.

    In closed form: torch's batched `eigh` looks at each result, for which the CPU waits, and takes no more than some
    ten thousand matrices at a time on some GPUs. The eigenvalue by O. K. Smith, "Eigenvalues of a symmetric 3 × 3
    matrix", 1961; its vector is orthogonal to all rows of the matrix less the eigenvalue,
    so along those of its adjugate.
    """
    xx, xy, xz, yy, yz, zz = spread.unbind(1)
    mean = (xx + yy + zz) / 3
    tiny = torch.finfo(spread.dtype).tiny
    off = [each / mean.clamp(min=tiny) for each in (xx - mean, xy, xz, yy - mean, yz, zz - mean)]
    size = (_form(off, off) / 6).sqrt()
    xx, xy, xz, yy, yz, zz = (each / size.clamp(min=tiny) for each in off)
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    least = 2 * (determinant.div(2).clamp(-1, 1).acos() / 3 + 2 * math.pi / 3).cos()
    xx, yy, zz = xx - least, yy - least, zz - least
    best = _longest_row(
        yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    )
    # all rows along one line: the points are on it
    along = normalize(_longest_row(xx, xy, xz, yy, yz, zz), dim=1) * (size > 0)[:, None]
    upright = towards - (towards * along).sum(1, keepdim=True) * along
    upright = upright.where(upright.square().sum(1, keepdim=True) > 0, towards)
    return best.where((best.square().sum(1) > _FLAT)[:, None] & (size > 0)[:, None], upright)


def _longest_row(xx: Tensor, xy: Tensor, xz: Tensor, yy: Tensor, yz: Tensor, zz: Tensor) -> Float64[Tensor, "p 3"]:
    """Of symmetric matrices whose rows lie along one line."""
    x, y, z = xx.abs(), yy.abs(), zz.abs()
    first, second = (x >= y) & (x >= z), y >= z
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    return torch.stack([a.where(first, b.where(second, c)) for a, b, c in zip(*rows, strict=True)], dim=1)
