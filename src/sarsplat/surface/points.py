"""Point cloud of Gaussians: first returns of the training views' rays, thinned and cleaned.

At most 96 views are used, evenly chosen. In large scenes, rays and voxels are coarser, up to a limit; beyond it, time
and points grow with the scene, but rays are traced brick by brick, so that memory grows with the points alone.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.spatial import cKDTree
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, counted
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.terrain import heights_of
from sarsplat.geometry.view import unstretched
from sarsplat.memory import required
from sarsplat.progress import stage
from sarsplat.radiometry import usual_peak
from sarsplat.renderer import render
from sarsplat.settings.sections import PointExtraction
from sarsplat.surface import cells
from sarsplat.surface.bricks import Scene, ray_count
from sarsplat.surface.cells import MOST_POINTS, MOST_WAITING, Voxels
from sarsplat.surface.clusters import bright, brightest_speckle_m2, largest
from sarsplat.surface.first_returns import FirstReturns, FirstReturnsOnCpu, traced, view_batches
from sarsplat.tiles.plan import memory_bytes

_MOST_RAYS = 2e7  # maximum number of rays of a brick, in all views together
_COARSEST = 2 / 3  # maximum spacing of rays in large scenes, resolution cells
_SAMPLES = 3.0  # minimum mean number of returns per voxel, if about a third of the views see a surface

_RETURN, _POINT, _KEPT = 130, 650, 72
"""Upper bounds of memory, bytes: of a return while thinning, of a point while its normal is found, and afterwards."""

_FEWER = "give `points.rays_per_pixel=1`; resuming a finished training with it extracts the points"


@checks_arguments
def extract_points(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    how: PointExtraction,
    terrain: Terrain | None = None,
    ground_gamma0: float | None = None,
) -> Float64[np.ndarray, "p 3"]:
    """Extract points of the surface of Gaussians.

    Parameters
    ----------
    gaussians : Gaussians
        The target alone, on any device.
    views : sequence of View
        The training views.
    grid : ImageGrid
        Grid whose pixels set the spacing of rays, and whose resolution cell is the unit of `how`.
    how : PointExtraction
        Method, thinning and clean-up. Beyond 20 million rays in all, rays and voxels are coarser than set, but rays at
        most two thirds of a cell apart.
    terrain : Terrain, optional
        Ground from which heights count; by default z = 0.
    ground_gamma0 : float, optional
        γ⁰ of the ground, in the unit of the Gaussians' scattering, whose speckle "bright" clusters must exceed; without
        it all clusters are kept.

    Returns
    -------
    numpy.ndarray, float64 [P, 3]
        World frame, m; possibly empty.

    Raises
    ------
    SarsplatError
        If there are no views, or too little free memory.
    """
    if not views:
        raise SarsplatError("there are no views that could see a surface; give at least one View")
    gaussians, cell = gaussians.detach(), grid.cell_m
    if how.method == "centres":
        keep = gaussians.optical_depth >= how.optical_depth
        if how.power_share < 1:
            keep &= _strongest(gaussians, views, grid, how.power_share)
        points = gaussians.means[keep].double().cpu().numpy()
        voxels = Voxels(how.voxel * cell)
        voxels.add(torch.from_numpy(points[heights_of(points, terrain) >= how.min_height * cell]))
        points = voxels.means().numpy()
    else:
        points = _seen_points(gaussians, [*unstretched(views), *between(views)], grid, how, terrain)
    if how.cluster_radius is None:
        return points
    if how.clusters == "largest":
        main = largest(points, how.cluster_radius * cell, how.cluster_size)
        with stage("points: largest cluster", 1) as shown:
            if not main.all():
                others = f"{(~main).sum():,} of {counted(len(points), 'point')} are not in the largest cluster"
                shown.note(f'points: left out, as {others}; points.clusters "bright" keeps all that outshine speckle')
        return points[main]
    if ground_gamma0 is None:
        return points
    chosen = spread(views)
    with stage("points: power of clusters", len(chosen)) as shown:
        sections = (found.cpu().numpy() for _, found in _cross_sections(gaussians, chosen, grid, shown.advance))
        threshold_m2 = brightest_speckle_m2(ground_gamma0, chosen, grid)
        means = gaussians.means.double().cpu().numpy()
        high = heights_of(points, terrain) > cell
        return points[bright(points, high, how.cluster_radius * cell, threshold_m2, means, sections, shown.note)]


def _strongest(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, share: float) -> Bool[Tensor, " n"]:
    """Mask of the fewest Gaussians that return this share of the power in images.

    Each counts with its strongest view that images it, clipped at the `usual_peak` of all.
    """
    strongest, means = gaussians.means.new_zeros(len(gaussians)), gaussians.means.double().cpu().numpy()
    for batch, sections in _cross_sections(gaussians, spread(views), grid):
        inside = torch.from_numpy(np.stack([imaged(means, view, grid) for view in batch])).to(sections.device)
        strongest = torch.maximum(strongest, (sections * inside).amax(0))
    strongest = strongest.clamp(max=usual_peak(strongest.cpu().numpy()))
    order = strongest.argsort(descending=True, stable=True)
    before = strongest[order].double().cumsum(0) - strongest[order]
    return torch.zeros_like(strongest, dtype=torch.bool).index_put((order,), before < share * strongest.double().sum())


def _cross_sections(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, advance: Callable[[int], object] = lambda count: None
) -> Iterator[tuple[Sequence[View], Float[Tensor, "v n"]]]:
    """Cross-sections of Gaussians, m², in batches of views."""
    rays, channel = RayGrid.for_image(grid), gaussians.scattering.power_channel
    for batch in view_batches(gaussians, views, grid, rays):
        with torch.no_grad():
            yield batch, render(gaussians, batch, grid, rays=rays).cross_sections[..., channel]
        advance(len(batch))


def imaged(points: Float64[np.ndarray, "p 3"], view: View, grid: ImageGrid) -> Bool[np.ndarray, " p"]:
    """Mask of the points within the edges of an image."""
    azimuth, slant_range = view.look.gradients @ points.T
    left, right, far, near = grid.extent_m
    return (left <= azimuth) & (azimuth <= right) & (near <= slant_range) & (slant_range <= far)


def _seen_points(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, how: PointExtraction, terrain: Terrain | None
) -> Float64[np.ndarray, "p 3"]:
    """Means of first returns in voxels, without those that too many views look through or too few see."""
    cell, rays, chosen = grid.cell_m, RayGrid.for_image(grid, how.rays_per_pixel), spread(views)
    described = "the views" if len(chosen) == len(views) else f"{len(chosen)} of {len(views)} views"
    views, count = chosen, ray_count(gaussians, chosen, rays)
    coarser = math.sqrt(max(1.0, min(count / _MOST_RAYS, (_COARSEST * cell / max(rays.spacing_m)) ** 2)))
    rays = RayGrid((coarser * rays.spacing_m[0], coarser * rays.spacing_m[1]))
    needed_m = max(rays.spacing_m) * math.sqrt(3 * _SAMPLES / len(views)) if count > _MOST_RAYS else 0.0
    side_m = max(how.voxel * cell, needed_m)
    enough = min(how.seen_by, len(views) // 5)  # a fifth, so that few views yield points, too
    rarer = f" {coarser:.2g} times as far apart as set" if coarser > 1 else ""
    scene, count = Scene(gaussians, rays), count / coarser**2
    bricks = [None] if count <= _MOST_RAYS else list(scene.bricks(views, rays, side_m, _MOST_RAYS))
    warning = required("extracting the surface", _bytes(gaussians, count, len(views)), _FEWER)
    found, kind = [], FirstReturnsOnCpu if cells.on_cpu(gaussians.means) else FirstReturns
    with stage(f"surface: rays{rarer} from {described}", 2 * len(views) * len(bricks)) as shown:
        if warning is not None:
            shown.note(warning)
        for brick in bricks:
            returns = kind.of(traced(scene, brick, views, grid, rays, how.optical_depth, shown.advance), rays)
            voxels = Voxels(side_m, gaussians.means.device)
            for batch in returns.points(terrain, how.min_height * cell):
                voxels.add(batch if brick is None else batch[brick.holds(batch)])
            means = voxels.means()
            confirmed = returns.confirmed(means, how.behind * cell, how.seen_through, enough, shown.advance)
            found.append(means[confirmed].cpu())
    return torch.cat(found).numpy()


def _bytes(gaussians: Gaussians, rays: float, views: int) -> float:
    """Upper bound of the memory for points, normals and mesh, bytes."""
    at_once, points = min(rays, _MOST_RAYS), rays / _SAMPLES  # rays of a brick, and all points
    met = len(gaussians) * min(1.0, 2 * at_once / rays) if rays else 0.0  # twice its share, for those in front of it
    of_a_view = memory_bytes(math.ceil(met), gaussians.scattering.parameters.shape[1], at_once / views, 1)
    ranges = np.dtype(np.float32).itemsize * at_once
    thinned = min(at_once, MOST_WAITING + at_once / views) + at_once / _SAMPLES  # waiting returns, and voxels
    return ranges + max(of_a_view + _RETURN * thinned, _POINT * min(points, MOST_POINTS)) + _KEPT * points


def spread(views: Sequence[View], most: int = 96) -> list[View]:
    """Choose at most `most` views by farthest-point sampling, starting with the first; their order is kept."""
    if len(views) <= most:
        return list(views)
    directions = np.array([view.direction for view in views])
    chosen, nearest = [0], directions @ directions[0]
    while len(chosen) < most:
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return [views[k] for k in sorted(set(chosen))]


def between(views: Sequence[View]) -> list[View]:
    """Views halfway between neighbouring ones, which look through gaps that no measured view sees through.

    Two views are neighbours if no other is as near to the direction halfway between them (K. R. Gabriel and R. R.
    Sokal, "A new statistical approach to geographic variation analysis", 1969).
    """
    directions = np.unique(np.round([view.direction for view in views], 9), axis=0)
    first, second = np.triu_indices(len(directions), 1)
    middle = directions[first] + directions[second]
    length = np.linalg.norm(middle, axis=1)
    valid = length > 1e-6  # opposite views have no middle
    first, middle = first[valid], middle[valid] / length[valid, None]
    radius = np.linalg.norm(directions[first] - middle, axis=1)
    nearer = cKDTree(directions).query_ball_point(middle, radius * (1 + 1e-6), return_length=True)
    return [View.towards(direction, aloft=views[0].aloft) for direction in middle[nearer == 2]]
