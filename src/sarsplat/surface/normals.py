"""Normals of a point cloud from Gaussians and neighbouring points, oriented towards the radar.

A learned Gaussian of a surface is flat, and its shortest axis is about the surface's normal. Those around a point vote,
weighted by nearness and flatness, against directions in which the neighbouring points spread; then votes that differ
from the majority lose weight, so that two sides of an edge do not mix.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, Real
from torch import Tensor
from torch.nn.functional import normalize

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.gaussians import rotation_matrix
from sarsplat.progress import stage
from sarsplat.surface.cells import Surfels, by_cubes
from sarsplat.surface.neighbours import neighbours_of, spacing_m

_SURFEL, _SEARCH = (0.15, 0.4), (0.15, 0.6)
"""Limits of the sides of cubes that make a surfel, and that share one search of neighbours, resolution cells."""
_SURFEL_SPACINGS, _SEARCH_SPACINGS = 2, 3  # sides of these cubes within the limits, spacings of the points
_VOTERS, _NEIGHBOURS = 32, 32  # Gaussians and surfels that count for a surfel
_BLUR, _NEAR = 0.2, 0.5  # standard deviations of the weights of Gaussians and surfels, resolution cells
_ROUNDS = 2
_DISSENT = 0.3  # sine of the angle to the majority at which a vote's weight is 1/e
_SPREAD = (1.0, 0.5)  # weight of the points' spread against the votes, in the first round and the others
_TOWARDS = 1e-7  # vote of the radar, which decides only without others
_TINY = torch.finfo(torch.float32).tiny
_FLAT = 1e-18  # squared width, relative to the spread, below which points are on a line


def surface_normals(
    points: Real[np.ndarray, "p 3"],
    towards: Real[np.ndarray, "p 3"],
    gaussians: Gaussians,
    cell_m: float,
    apart_m: float | None = None,
) -> Float64[np.ndarray, "p 3"]:
    """Unit normals of the surface at its points [P, 3], world frame, m; float64.

    Normals are on the side of `towards`, directions of any length to the radar that sees each point; zero means up. If
    `gaussians`, on the device that calculates, are empty, normals come from the points alone. The resolution cell
    `cell_m` is the unit of the neighbourhoods; `apart_m` is the spacing of the whole cloud (`spacing_m`), of which
    these points may be a part, by default that of these.

    Points without neighbours and Gaussians around get `towards`. Normals in one cube of 0.15 to 0.4 resolution cells
    are equal up to their sign.
    """
    if len(points) == 0:
        return np.empty((0, 3))
    means = gaussians.means.detach().double()
    cloud, radar = (torch.from_numpy(np.asarray(array)).to(means) for array in (points, towards))
    above = torch.eye(3, dtype=radar.dtype, device=radar.device)[2]
    radar = normalize(radar.where((radar != 0).any(1, keepdim=True), above), dim=1)
    apart_m = spacing_m(points) if apart_m is None else apart_m
    surfel_m, search_m = (
        float(np.clip(spacings * apart_m, least * cell_m, most * cell_m))
        for spacings, (least, most) in ((_SURFEL_SPACINGS, _SURFEL), (_SEARCH_SPACINGS, _SEARCH))
    )
    surfels = Surfels.of(cloud, radar, surfel_m)
    voters, cloud_around = _Voters(gaussians, _BLUR * cell_m), _Neighbourhood(surfels, _NEAR * cell_m)
    normals = torch.empty_like(surfels.places)
    with stage("surface: normals of the points", len(normals)) as shown:
        for rows, middles, cube in by_cubes(surfels.places, search_m):
            places, directions = surfels.places[rows], surfels.normals[rows]
            spread = cloud_around.spread(places, middles, cube)
            normals[rows] = voters.normals(places, directions, spread, middles, cube)
            shown.advance(len(rows))
    normals = normals[surfels.owner]
    normals = normals * torch.where((normals * radar).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return normals.cpu().numpy()


class _Neighbourhood:
    """Surfels, and their spread around places."""

    def __init__(self, surfels: Surfels, near_m: float) -> None:
        self._places, self._counts, self._near_m = surfels.places, surfels.counts.float(), near_m
        self._near = neighbours_of(surfels.places)

    def spread(
        self, places: Float64[Tensor, "q 3"], middles: Float64[Tensor, "c 3"], cube: Int64[Tensor, " q"]
    ) -> Float64[Tensor, "q 6"]:
        """Covariances of the surfels near each place's cube, divided by their trace; zero where they coincide."""
        index = self._near.nearest(middles, min(_NEIGHBOURS, len(self._places)))[1][cube]
        x, y, z = _offsets(self._places, index, places, self._near_m)
        weight = self._counts[index] * torch.exp(-0.5 * (x * x + y * y + z * z))
        weight = weight / weight.sum(1, keepdim=True).clamp(min=_TINY)
        x, y, z = (offset - (weight * offset).sum(1, keepdim=True) for offset in (x, y, z))
        products = torch.stack([(weight * product).sum(1) for product in _products(x, y, z)], dim=1).double()
        trace = products[:, 0] + products[:, 3] + products[:, 5]
        return products / trace.clamp(min=_TINY)[:, None]


class _Voters:
    """Gaussians, and the normals that their shortest axes vote for."""

    def __init__(self, gaussians: Gaussians, blur_m: float) -> None:
        gaussians = gaussians.detach()
        self._means, scales, self._blur_m = gaussians.means.double(), gaussians.scales.double(), blur_m
        axes = rotation_matrix(gaussians.quaternions.double()).mT  # rows are axes
        short, middle, _ = scales.sort(dim=1).values.unbind(1)
        self._flat = (1 - short / middle).float()
        axis = axes.gather(1, scales.argmin(1)[:, None, None].expand(-1, 1, 3))[:, 0]
        root = axes / (scales / blur_m).square().add(1).sqrt()[..., None]
        precision = torch.stack(_products(*root.unbind(2)), dim=2).sum(1)
        self._precision = [entry.contiguous() for entry in precision.float().unbind(1)]
        self._votes = [product.float() for product in _products(*axis.unbind(1))]
        self._near = neighbours_of(self._means) if len(gaussians) else None

    def normals(
        self,
        places: Float64[Tensor, "q 3"],
        towards: Float64[Tensor, "q 3"],
        spread: Float64[Tensor, "q 6"],
        middles: Float64[Tensor, "c 3"],
        cube: Int64[Tensor, " q"],
    ) -> Float64[Tensor, "q 3"]:
        """Normals, of any sign, by majority of the Gaussians near each place's cube, given the points' spread there."""
        against = spread.new_tensor([1, 0, 0, 1, 0, 1]) - _TOWARDS * torch.stack(_products(*towards.unbind(1)), dim=1)
        if self._near is None:
            return normalize(_across(against + _SPREAD[0] * spread, towards), dim=1, eps=_TINY)
        index = self._near.nearest(middles, min(_VOTERS, len(self._means)))[1][cube]
        offsets = _products(*_offsets(self._means, index, places, self._blur_m))
        square = _form([entry[index] for entry in self._precision], offsets)
        weight = torch.exp(-0.5 * (square - square.amin(1, keepdim=True))) * self._flat[index]
        votes = [product[index] for product in self._votes]

        def elected(weight: Float[Tensor, "q k"], share: float) -> Float64[Tensor, "q 3"]:
            weight = weight / weight.sum(1, keepdim=True).clamp(min=_TINY)
            agreed = torch.stack([(weight * vote).sum(1) for vote in votes], dim=1)
            return normalize(_across(against - agreed + share * spread, towards), dim=1, eps=_TINY)

        normal = elected(weight, _SPREAD[0])
        for _ in range(_ROUNDS):
            cosine_square = _form(votes, _products(*normal.float().T[..., None]))
            normal = elected(weight * torch.exp((cosine_square - 1) / _DISSENT**2), _SPREAD[1])
        return normal


def _offsets(
    of: Float64[Tensor, "n 3"], index: Int64[Tensor, "q k"], places: Float64[Tensor, "q 3"], unit_m: float
) -> list[Float[Tensor, "q k"]]:
    """Offsets x, y, z of rows `index` of `of` from places, in units of `unit_m`; float32, enough for weights."""
    return [((a[index] - b[:, None]) / unit_m).float() for a, b in zip(of.T, places.T, strict=True)]


def _products(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Products xx, xy, xz, yy, yz, zz."""
    return [x * x, x * y, x * z, y * y, y * z, z * z]


def _form(matrix: Sequence[Tensor], products: Sequence[Tensor]) -> Tensor:
    """Quadratic forms, given the six entries of symmetric matrices and the products of coordinates."""
    xx, xy, xz, yy, yz, zz = (one * other for one, other in zip(matrix, products, strict=True))
    return xx + yy + zz + 2 * (xy + xz + yz)


def _across(spread: Float64[Tensor, "p 6"], towards: Float64[Tensor, "p 3"]) -> Float64[Tensor, "p 3"]:
    """Eigenvectors of the smallest eigenvalue of covariances xx, xy, xz, yy, yz, zz; if ambiguous, nearest `towards`.

    In closed form: torch's batched `eigh` synchronises with the CPU, and is limited to some ten thousand matrices on
    some GPUs. The eigenvalue is O. K. Smith's ("Eigenvalues of a symmetric 3 × 3 matrix", 1961); its vector is
    orthogonal to all rows of the matrix less the eigenvalue, so along the rows of the adjugate.
    """
    xx, xy, xz, yy, yz, zz = spread.unbind(1)
    mean = (xx + yy + zz) / 3
    tiny = torch.finfo(spread.dtype).tiny
    deviator = [entry / mean.clamp(min=tiny) for entry in (xx - mean, xy, xz, yy - mean, yz, zz - mean)]
    size = (_form(deviator, deviator) / 6).sqrt()
    xx, xy, xz, yy, yz, zz = (entry / size.clamp(min=tiny) for entry in deviator)
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    least = 2 * (determinant.div(2).clamp(-1, 1).acos() / 3 + 2 * math.pi / 3).cos()
    xx, yy, zz = xx - least, yy - least, zz - least
    best = _longest_row(
        yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    )
    # rows along one line: the points are on that line
    along = normalize(_longest_row(xx, xy, xz, yy, yz, zz), dim=1) * (size > 0)[:, None]
    upright = towards - (towards * along).sum(1, keepdim=True) * along
    upright = upright.where(upright.square().sum(1, keepdim=True) > 0, towards)
    return best.where((best.square().sum(1) > _FLAT)[:, None] & (size > 0)[:, None], upright)


def _longest_row(xx: Tensor, xy: Tensor, xz: Tensor, yy: Tensor, yz: Tensor, zz: Tensor) -> Float64[Tensor, "p 3"]:
    """Longest row of symmetric matrices whose rows are parallel."""
    x, y, z = xx.abs(), yy.abs(), zz.abs()
    first, second = (x >= y) & (x >= z), y >= z
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    return torch.stack([a.where(first, b.where(second, c)) for a, b, c in zip(*rows, strict=True)], dim=1)
