"""Smoothing: visible Gaussians are moved towards the surface of their neighbours, and scatter like them.

Inside a uniform surface gradients are noise, and Adam, whose steps do not depend on their size, lets Gaussians drift
along the normal. Smoothing undoes this; at edges, where images determine positions, the next steps restore them.
Where neighbours scatter alike, differences of brightness are slopes; otherwise a vault may rise to any height.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from sarsplat.data import Dataset
from sarsplat.gaussians.gaussians import product, rotated
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State, at_round
from sarsplat.settings.config import Config

_MIN_LIT_SHARE = 0.05  # minimum lit area of a cell, relative to the mean over cells; cells below are ignored
_DARK = 0.05  # lit area of a Gaussian, relative to its largest among a step's views, below which one does not light it
_KEPT = 0.97  # share of the sums over views that a step keeps: those of 33 steps count
_RIDGE = 0.01  # relative to the trace of the directions' products, for cells that few views light
_NORMALS_POWER = 8  # exponent of the cosine between normals in a neighbour's weight: walls hardly count for roofs

_WIDE = (0.1, 0.4)
"""Ratios of a plane's two mean squared widths between which the movement rises from none to full: narrow parts are all
edges. The ratio is 1 inside a roof, 0.4 at its edge, and at most 0.15 for parts two cells wide."""

_MIN_WIDTH = 1e-4  # minimum of the larger mean squared width, square cells: below are rounding errors of isolated cells
_BATCH = 1 << 13  # number of planes fitted at once: a few megabytes of pairs
_ROWS, _COLUMNS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]  # of xx, xy, xz, yy, yz and zz in a symmetric matrix
_FITS = 2  # number of fits of each plane; outliers of one weigh less in the next


class Smoothed(Configured):
    """Moves and turns visible Gaussians towards the surface of their neighbours, at intervals."""

    order = 25
    name = "smoothing"
    section = "smoothing"

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return config.smoothing.rounds > 0 and config.coarsest > 1

    def due(self, step: int) -> bool:
        return step > 0 and at_round(step, 0, self.config.iterations, self.settings.rounds)

    def initial_state(self, params: Params) -> State:
        light = params["means"].detach().new_zeros(len(params["means"]), 9)  # sums that `towards_planes` describes
        return State(rows={"light": light}, added=("light",))

    @torch.no_grad()
    def step_post_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        if info.model.levels.coarsest == 1:  # vehicles have no large flat surfaces
            return
        areas, light = info.rendering.lit_area, state.rows["light"].mul_(_KEPT)
        towards = np.array([info.images.views[number].look.facing for number in info.chosen])
        columns = areas.new_tensor(np.hstack([towards, towards[:, _ROWS] * towards[:, _COLUMNS]]))
        for column, area, is_lit in zip(columns, areas, areas > _DARK * areas.amax(0), strict=True):
            light[:, :3] += area[:, None] * column[:3]
            light[:, 3:] += is_lit[:, None] * column[3:]
        super().step_post_backward(params, optimizers, state, step, info)

    @torch.no_grad()
    def act(self, params: Params, optimizers: Optimiser, state: State, info: Info) -> None:
        cell_m, means = info.images.grid.cell_m, params["means"].detach()
        quaternions, scales = params["quaternions"].detach(), params["scales"].detach()
        shortest = scales.argmin(1, keepdim=True)
        axes = rotated(quaternions, torch.zeros_like(scales).scatter_(1, shortest, 1.0))
        lit, scattering = info.rendering.lit_area.sum(0), params["scattering"].detach()
        tensors = (means, axes, lit, state.rows["light"], scattering)
        where, facing, area, light, values = (tensor.double().cpu().numpy() for tensor in tensors)
        planes = towards_planes(where, facing, area, light, values, cell_m, self.settings.radius * cell_m)
        moves, normals, wide, usual = (torch.from_numpy(values).to(means) for values in planes)
        share = self.settings.share * wide[:, None]
        means += share * moves
        if cell_m > info.model.frame.cell_m:  # materials that differ show in the finest images
            scattering += self.settings.alike * wide[:, None] * (usual - scattering)
        quaternions.copy_(turned(quaternions, axes, normals, share))
        thinner = 1 - self.settings.thinner * wide[:, None]
        scales.scatter_(1, shortest, scales.gather(1, shortest) * thinner)
        optimizers.constrain()


def turned(
    quaternions: Float[Tensor, "n 4"],
    axes: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    share: Float[Tensor, "n 1"],
) -> Float[Tensor, "n 4"]:
    """Turn orientations so that an axis approaches a normal or its opposite; those with a normal of 0 stay.

    The axis turns by a share of the way, times the cosine: at 90° both directions are equally near.
    """
    cosine = (axes * normals).sum(1, keepdim=True)
    new_axes = normalize(axes + share * cosine.abs() * (normals * cosine.sign() - axes), dim=1)
    arc = torch.cat([1 + (axes * new_axes).sum(1, keepdim=True), torch.linalg.cross(axes, new_axes)], dim=1)
    return product(normalize(arc, dim=1), quaternions)


def towards_planes(
    means: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    lit: Float64[np.ndarray, " n"],
    light: Float64[np.ndarray, "n 9"],
    values: Float64[np.ndarray, "n k"],
    cell_m: float,
    radius_m: float,
) -> tuple[
    Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, "n k"]
]:
    """Vector from each Gaussian to its neighbours' surface (m), normal and width of their plane, and mean values.

    The width is from 0, for a mast or a rail, to 1, inside a surface; all are 0 in cubes that are hardly lit. The
    surface's height is the mean of those by the fitted plane, inside a round surface, and by the neighbours' own
    planes, as far outside: exact for spheres with neighbours on all sides.

    Gaussians in a cube of `cell_m` move together, so that layers keep their thickness. Weights are lit areas, m², and
    fall with distance, with the angle between `normals`, whose signs do not matter, and with distance from the plane.
    A cube's first normal is the main axis of its Gaussians' normals, which are random in a fog, and, with the same
    weight, of the normal n by which its lit areas in directions u are proportional to n·u. `light` has sums over
    views: of lit area × u, and of the products xx, xy, xz, yy, yz and zz of those u that light a Gaussian.
    """
    cubes = np.floor(means / cell_m).astype(np.int64)
    cubes -= cubes.min(axis=0)
    _, owner = np.unique(np.ravel_multi_index(tuple(cubes.T), cubes.max(axis=0) + 1), return_inverse=True)
    area = np.bincount(owner, lit)
    (lit_cubes,) = np.nonzero(area > _MIN_LIT_SHARE * area.mean())
    lit_area, rows = area[lit_cubes], np.zeros((len(area), 7 + values.shape[1]))

    def sums(columns: Float[np.ndarray, "n k"]) -> Float64[np.ndarray, "m k"]:
        """Sum over the Gaussians of each lit cube."""
        return np.stack([np.bincount(owner, column) for column in columns.T], axis=1)[lit_cubes]

    mean = sums(lit[:, None] * means) / lit_area[:, None]
    tree, (x, y, z) = cKDTree(mean), mean.T
    products = _symmetric(sums(np.linalg.norm(light[:, :3], axis=1, keepdims=True) * light[:, 3:]))
    products /= np.trace(products, axis1=1, axis2=2)[:, None, None].clip(min=np.finfo(float).tiny)
    normal = np.linalg.solve(products + _RIDGE * np.eye(3), sums(light[:, :3])[:, :, None])[:, :, 0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(min=np.finfo(float).tiny)
    squares = sums(lit[:, None] * normals[:, _ROWS] * normals[:, _COLUMNS])
    squares += lit_area[:, None] * normal[:, _ROWS] * normal[:, _COLUMNS]
    axis = np.linalg.eigh(_symmetric(squares))[1][:, :, 2]
    moments = np.column_stack([np.ones(len(mean)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    moments = np.hstack([moments, sums(lit[:, None] * values) / lit_area[:, None]])

    def fit(first: int) -> None:
        """Fit the planes of a batch of cubes; results do not depend on the size of the batch."""
        batch = slice(first, first + _BATCH)
        places, plane, height = mean[batch], axis[batch], np.zeros(len(mean[batch]))
        pairs = cKDTree(places).sparse_distance_matrix(tree, radius_m, output_type="ndarray")
        weights = csr_matrix((np.ones(len(pairs)), (pairs["i"], pairs["j"])), (len(places), tree.n))
        i, j = np.repeat(np.arange(len(places)), np.diff(weights.indptr)), weights.indices  # pairs of neighbours
        distance = mean[j] - places[i]
        cosine = np.einsum("pi,pi->p", plane[i], axis[j])
        own_height = np.einsum("pi,pi->p", distance, axis[j]) * np.sign(cosine)  # of each neighbour's own plane
        squared = np.einsum("pi,pi->p", distance, distance)
        nearness = lit_area[j] * cosine**_NORMALS_POWER * np.exp(-2 / radius_m**2 * squared)
        for _ in range(_FITS):
            offset = np.einsum("pi,pi->p", distance, plane[i]) - height[i]
            weights.data = nearness * (1 - (offset / cell_m) ** 2).clip(min=0) ** 2  # Tukey's
            total = weights @ moments
            centre = total[:, 1:4] / total[:, :1]
            spread = _symmetric(total[:, 4:10] / total[:, :1]) - centre[:, :, None] * centre[:, None, :]
            spreads, axes = np.linalg.eigh(spread)
            plane = axes[:, :, 0] * np.sign((axes[:, :, 0] * axis[batch]).sum(1, keepdims=True))
            own_mean = np.bincount(i, weights.data * own_height, len(places)) / total[:, 0]
            height = (((centre - places) * plane).sum(1) + own_mean) / 2
            height = height.clip(-cell_m / 2, cell_m / 2)  # so that the cube itself counts in the next fit
        wide = np.interp(spreads[:, 1] / spreads[:, 2].clip(min=_MIN_WIDTH * cell_m**2), _WIDE, (0, 1))
        rows[lit_cubes[batch]] = np.column_stack([height[:, None] * plane, plane, wide, total[:, 10:] / total[:, :1]])

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        for _ in threads.map(fit, range(0, len(mean), _BATCH)):
            pass
    moves, planes, wide, usual = np.split(rows[owner], (3, 6, 7), axis=1)
    return moves, planes, wide[:, 0], usual


def _symmetric(six: Float64[np.ndarray, "m 6"]) -> Float64[np.ndarray, "m 3 3"]:
    """Symmetric matrices from xx, xy, xz, yy, yz and zz."""
    return six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
