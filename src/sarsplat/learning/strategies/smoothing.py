"""Smoothing: neighbours are drawn into common planes, where images say nothing of their heights.

Inside of a uniform surface the images' gradients are noise, and Adam, whose steps do not depend on their size, lets
each Gaussian wander along the normal. It is drawn back here; where images do say where it is, at edges, the next steps
of Adam bring it back to there.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from sarsplat.data import Dataset
from sarsplat.gaussians.covariance import product, rotated
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Configured, Info, State, at_round
from sarsplat.settings.config import Config
from sarsplat.settings.sections import Smoothing

_LEAST = 0.05
"""Of the mean lit area of a cell: cells with less are not seen, and neither moved nor anyone's neighbours."""

_ALIKE = 8
"""Power of the cosine between normals that a neighbour's weight has: a wall is none of a roof's."""

_WIDE = (0.1, 0.4)
"""Ratio of a plane's two mean squared widths from which on what lies in it moves, and moves all of the share: narrow
parts are all edges. It is 1 inside of a roof, 0.4 at its edge, and at most 0.15 for what is two cells wide."""

_NARROWEST = 1e-4
"""Of the larger of these, square cells: less is how numbers are rounded, around a cell that has no neighbours."""

_AT_ONCE = 1 << 13
"""Places whose planes are fitted at once: a few megabytes of pairs."""

_FITS = 2
"""How often planes are fitted; each time, what lay far from the last one weighs less."""


class Smoothed(Configured):
    """At intervals, moves and turns what is lit in each resolution cell towards a plane through its neighbours."""

    order = 25
    name = "smoothing"

    def __init__(self, config: Smoothing, iterations: int) -> None:
        self._config, self._iterations = config, iterations

    @classmethod
    def of(cls, config: Config, train: Dataset) -> Self | None:
        wanted = config.smoothing.rounds > 0 and config.coarsest > 1
        return cls(config.smoothing, config.iterations) if wanted else None

    def due(self, step: int) -> bool:
        return step > 0 and at_round(step, 0, self._iterations, self._config.rounds)

    @torch.no_grad()
    def step_post_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        if not self.due(step) or info.model.levels.coarsest == 1:  # vehicles have no flat surface of many cells
            return
        info.check()
        cell_m, means = info.images.grid.cell_m, params["means"].detach()
        quaternions, scales = params["quaternions"].detach(), params["scales"].detach()
        shortest = scales.argmin(1, keepdim=True)
        axes = rotated(quaternions, torch.zeros_like(scales).scatter_(1, shortest, 1.0))
        lit = info.rendering.lit_area.sum(0)
        where, facing, area = (tensor.double().cpu().numpy() for tensor in (means, axes, lit))
        planes = towards_planes(where, facing, area, cell_m, self._config.radius * cell_m)
        moves, normals, wide = (torch.from_numpy(each).to(means) for each in planes)
        share = self._config.share * wide[:, None]
        means += share * moves
        quaternions.copy_(turned(quaternions, axes, normals, share))
        thinner = 1 - self._config.thinner * wide[:, None]
        scales.scatter_(1, shortest, scales.gather(1, shortest) * thinner)
        optimizers.constrain()


def turned(
    quaternions: Float[Tensor, "n 4"],
    axes: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    share: Float[Tensor, "n 1"],
) -> Float[Tensor, "n 4"]:
    """Orientations whose axis is turned towards a normal, on whichever side; as they are where that is 0.

    By a share of the way, and less the farther the axis is from it: at 90 degrees it is as near to either side.
    """
    cosine = (axes * normals).sum(1, keepdim=True)
    there = normalize(axes + share * cosine.abs() * (normals * cosine.sign() - axes), dim=1)
    arc = torch.cat([1 + (axes * there).sum(1, keepdim=True), torch.linalg.cross(axes, there)], dim=1)
    return product(normalize(arc, dim=1), quaternions)


def towards_planes(
    means: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    lit: Float64[np.ndarray, " n"],
    cell_m: float,
    radius_m: float,
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """How far each Gaussian is from a plane through its neighbours (m), that plane's normal, and how wide it is.

    That is from 0, for a mast or a rail, to 1, for what goes on to all sides; all are 0 where nothing is lit.

    What lies in a cube of `cell_m` moves as one, so that layers stay as they are. Weights are areas that are lit, m²,
    and fall with distance, with angles between `normals`, whose signs do not matter, and with distance from the plane.
    """
    cubes = np.floor(means / cell_m).astype(np.int64)
    cubes -= cubes.min(axis=0)
    _, owner = np.unique(np.ravel_multi_index(tuple(cubes.T), cubes.max(axis=0) + 1), return_inverse=True)
    area = np.bincount(owner, lit)
    (seen,) = np.nonzero(area > _LEAST * area.mean())
    if not len(seen):
        return np.zeros_like(means), np.zeros_like(means), np.zeros_like(lit)
    mean = _sums(owner, lit[:, None] * means)[seen] / area[seen, None]
    squares = np.stack([lit * normals[:, i] * normals[:, j] for i in range(3) for j in range(i, 3)], axis=1)
    own = np.linalg.eigh(_symmetric(_sums(owner, squares)[seen]))[1][:, :, 2]  # of all normals in a cube
    everywhere, around = cKDTree(mean), area[seen]
    x, y, z = mean.T
    moments = np.column_stack([np.ones(len(mean)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    plane, above, spreads = own.copy(), np.zeros(len(mean)), np.zeros((len(mean), 3))

    def fit(first: int) -> None:
        """The planes of some places, whose neighbours a cache holds: the same however many are fitted at once."""
        some = slice(first, first + _AT_ONCE)
        places = mean[some]
        weights = _neighbours(places, everywhere, radius_m)
        here, there = np.repeat(np.arange(len(places)), np.diff(weights.indptr)), weights.indices
        apart = mean[there] - places[here]
        alike = np.einsum("pi,pi->p", own[some][here], own[there]) ** _ALIKE
        nearness = around[there] * alike * np.exp(-2 / radius_m**2 * np.einsum("pi,pi->p", apart, apart))
        for _ in range(_FITS):
            offset = np.einsum("pi,pi->p", apart, plane[some][here]) - above[some][here]
            weights.data = nearness * (1 - (offset / cell_m) ** 2).clip(min=0) ** 2  # Tukey's
            sums = weights @ moments
            centre = sums[:, 1:4] / sums[:, :1]
            spread = _symmetric(sums[:, 4:] / sums[:, :1]) - centre[:, :, None] * centre[:, None, :]
            spreads[some], axes = np.linalg.eigh(spread)
            plane[some] = axes[:, :, 0]
            above[some] = ((centre - places) * plane[some]).sum(1)

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        for _ in threads.map(fit, range(0, len(mean), _AT_ONCE)):
            pass
    moves, normals, wide = np.zeros((len(area), 3)), np.zeros((len(area), 3)), np.zeros(len(area))
    moves[seen], normals[seen] = above[:, None] * plane, plane
    wide[seen] = np.interp(spreads[:, 1] / spreads[:, 2].clip(min=_NARROWEST * cell_m**2), _WIDE, (0, 1))
    return moves[owner], normals[owner], wide[owner]


def _neighbours(places: Float64[np.ndarray, "k 3"], everywhere: cKDTree, radius_m: float) -> csr_matrix:
    """A row for each of some places, with an entry for each of all that is no farther away, itself included."""
    pairs = cKDTree(places).sparse_distance_matrix(everywhere, radius_m, output_type="ndarray")
    return csr_matrix((np.ones(len(pairs)), (pairs["i"], pairs["j"])), (len(places), everywhere.n))


def _sums(owner: np.ndarray, rows: Float[np.ndarray, "n k"]) -> Float64[np.ndarray, "m k"]:
    return np.stack([np.bincount(owner, column) for column in rows.T], axis=1)


def _symmetric(six: Float64[np.ndarray, "m 6"]) -> Float64[np.ndarray, "m 3 3"]:
    """Of xx, xy, xz, yy, yz and zz."""
    return six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
