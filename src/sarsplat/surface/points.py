"""From Gaussians to a point cloud: where the rays of the training views return, thinned and cleaned.

Views are at most so many, chosen evenly. In large scenes rays lie farther apart and voxels are larger, up to a limit;
beyond it, time and points grow with the scene, and memory with the points alone: rays are traced brick by brick, and
held are the ranges and the voxels of one brick.
"""

from __future__ import annotations

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
from sarsplat.surface.clusters import bright, brightest_speckle_m2, largest
from sarsplat.surface.first_returns import FirstReturns, some_at_once
from sarsplat.surface.parts import MOST_POINTS
from sarsplat.surface.returns_on_cpu import FirstReturnsOnCpu
from sarsplat.surface.voxels import AT_ONCE, Voxels
from sarsplat.tiles.plan import memory_bytes

_MOST_VIEWS = 96
_MOST_RAYS = 2e7
"""Of a brick, in all views together."""

_COARSEST = 2 / 3
"""Distance of rays at most, resolution cells, however large the scene."""

_SAMPLES = 3.0
"""Returns that a voxel has at least, on average; a surface is seen by about a third of the views."""

_RETURN, _POINT, _KEPT = 130, 650, 72
"""Bytes at most: of a return while it is thinned, of a point while normals are made of it, and of one that waits."""

_FEWER = (
    "set fewer rays, such as --points.rays-per-pixel 1; `--resume` with it extracts the points of a finished training"
)


@checks_arguments
def extract_points(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    how: PointExtraction,
    terrain: Terrain | None = None,
    ground_gamma0: float | None = None,
) -> Float64[np.ndarray, "p 3"]:
    """Points of the surface that Gaussians stand for.

    Parameters
    ----------
    gaussians : Gaussians
        The target alone, on any device.
    views : sequence of View
        The training views.
    grid : ImageGrid
        Sets the spacing of the rays and the unit of `how`, its resolution cell.
    how : PointExtraction
        Method, thinning and clean-up. Rays are traced from at most 96 views. Where they would be more than 20 million
        in all, rays and voxels are coarser than it says, but rays no farther apart than two thirds of a cell.
    terrain : Terrain, optional
        What the lowest points lie on; z = 0 unless given.
    ground_gamma0 : float, optional
        γ⁰ of the ground, in the unit of the Gaussians' scattering, whose speckle "bright" clusters must exceed; without
        it all are kept.

    Returns
    -------
    numpy.ndarray, float64 [P, 3]
        World frame, m; possibly empty.

    Raises
    ------
    SarsplatError
        If there are no views, or the memory that is free does not do.
    """
    if not views:
        raise SarsplatError("there are no views that could see a surface; give at least one View")
    gaussians, cell = gaussians.detach(), grid.cell_m
    if how.method == "centres":
        kept = gaussians.optical_depth >= how.optical_depth
        if how.power_share < 1:
            kept &= _strongest(gaussians, views, grid, how.power_share)
        points = gaussians.means[kept].double().cpu().numpy()
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
    chosen = spread(views, _MOST_VIEWS)
    with stage("points: power of clusters", len(chosen)) as shown:
        sections = (found.cpu().numpy() for _, found in _cross_sections(gaussians, chosen, grid, shown.advance))
        threshold_m2 = brightest_speckle_m2(ground_gamma0, chosen, grid)
        means = gaussians.means.double().cpu().numpy()
        high = heights_of(points, terrain) > cell
        return points[bright(points, high, how.cluster_radius * cell, threshold_m2, means, sections, shown.note)]


def _strongest(gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, share: float) -> Bool[Tensor, " n"]:
    """The fewest Gaussians that return this share of the power in images; those outside of all images do not count.

    What outshines all others counts as no more than their `usual_peak`.
    """
    strongest, means = gaussians.means.new_zeros(len(gaussians)), gaussians.means.double().cpu().numpy()
    for some, sections in _cross_sections(gaussians, spread(views, _MOST_VIEWS), grid):
        inside = torch.from_numpy(np.stack([imaged(means, view, grid) for view in some])).to(sections.device)
        strongest = torch.maximum(strongest, (sections * inside).amax(0))
    strongest = strongest.clamp(max=usual_peak(strongest.cpu().numpy()))
    order = strongest.argsort(descending=True, stable=True)
    before = strongest[order].double().cumsum(0) - strongest[order]
    return torch.zeros_like(strongest, dtype=torch.bool).index_put((order,), before < share * strongest.double().sum())


def _cross_sections(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, advance: Callable[[int], object] = lambda count: None
) -> Iterator[tuple[Sequence[View], Float[Tensor, "v n"]]]:
    """Cross-sections of Gaussians, m², some views at a time."""
    rays = RayGrid.for_image(grid)
    for some in some_at_once(gaussians, views, grid, rays):
        with torch.no_grad():
            yield some, render(gaussians, some, grid, rays=rays).cross_sections[..., gaussians.scattering.power_channel]
        advance(len(some))


def imaged(points: Float64[np.ndarray, "p 3"], view: View, grid: ImageGrid) -> Bool[np.ndarray, " p"]:
    """Which points lie within the edges of an image."""
    azimuth, slant_range = view.look.gradients @ points.T
    left, right, far, near = grid.extent_m
    return (left <= azimuth) & (azimuth <= right) & (near <= slant_range) & (slant_range <= far)


def _seen_points(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    how: PointExtraction,
    terrain: Terrain | None,
) -> Float64[np.ndarray, "p 3"]:
    """Mean first return in each voxel, without those that too many views look through or too few see."""
    cell, rays, chosen = grid.cell_m, RayGrid.for_image(grid, how.rays_per_pixel), spread(views, _MOST_VIEWS)
    said = "the views" if len(chosen) == len(views) else f"{len(chosen)} of {len(views)} views"
    views, count = chosen, ray_count(gaussians, chosen, rays)
    coarser = math.sqrt(max(1.0, min(count / _MOST_RAYS, (_COARSEST * cell / max(rays.spacing_m)) ** 2)))
    rays = RayGrid((coarser * rays.spacing_m[0], coarser * rays.spacing_m[1]))
    needed_m = max(rays.spacing_m) * math.sqrt(3 * _SAMPLES / len(views)) if count > _MOST_RAYS else 0.0
    side_m = max(how.voxel * cell, needed_m)
    enough = min(how.seen_by, len(views) // 5)  # a fifth, so that of few views there are points, too
    rarer = f" {coarser:.2g} times as far apart as set" if coarser > 1 else ""
    scene, count = Scene(gaussians, rays), count / coarser**2
    bricks = [None] if count <= _MOST_RAYS else list(scene.bricks(views, rays, side_m, _MOST_RAYS))
    much = required("extracting the surface", _bytes(gaussians, count, len(views)), _FEWER)
    found, kind = [], FirstReturnsOnCpu if cells.on_cpu(gaussians.means) else FirstReturns
    with stage(f"surface: rays{rarer} from {said}", 2 * len(views) * len(bricks)) as shown:
        if much is not None:
            shown.note(much)
        for brick in bricks:
            returns = kind.of(scene, brick, views, grid, rays, how.optical_depth, shown.advance)
            voxels = Voxels(side_m, gaussians.means.device)
            for some in returns.points(terrain, how.min_height * cell):
                voxels.add(some if brick is None else some[brick.holds(some)])
            means = voxels.means()
            kept = returns.confirmed(means, how.behind * cell, how.seen_through, enough, shown.advance)
            found.append(means[kept].cpu())
    return torch.cat(found).numpy()


def _bytes(gaussians: Gaussians, rays: float, views: int) -> float:
    """Upper bound of the memory that points, normals and mesh need for so many rays, bytes."""
    at_once, points = min(rays, _MOST_RAYS), rays / _SAMPLES
    met = len(gaussians) * min(1.0, 2 * at_once / rays) if rays else 0.0
    of_a_view = memory_bytes(math.ceil(met), gaussians.scattering.parameters.shape[1], at_once / views, 1)
    ranges = np.dtype(np.float32).itemsize * at_once
    thinned = min(at_once, AT_ONCE + at_once / views) + at_once / _SAMPLES
    return ranges + max(of_a_view + _RETURN * thinned, _POINT * min(points, MOST_POINTS)) + _KEPT * points


def spread(views: Sequence[View], most: int) -> list[View]:
    """At most so many views by farthest-point sampling, in their order, the first one included."""
    if len(views) <= most:
        return list(views)
    directions = np.array([view.direction for view in views])
    chosen, nearest = [0], directions @ directions[0]
    while len(chosen) < most:
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return [views[k] for k in sorted(set(chosen))]


def between(views: Sequence[View]) -> list[View]:
    """Views halfway between neighbouring ones, from where nothing was measured: they look into the same corners.

    Two views are neighbours if no other is as near to the direction halfway between them as they are (K. R. Gabriel and
    R. R. Sokal, "A new statistical approach to geographic variation analysis", 1969).
    """
    directions = np.unique(np.round([view.direction for view in views], 9), axis=0)
    first, second = np.triu_indices(len(directions), 1)
    middle = directions[first] + directions[second]
    length = np.linalg.norm(middle, axis=1)
    apart = length > 1e-6  # opposite ones have no middle
    first, middle = first[apart], middle[apart] / length[apart, None]
    radius = np.linalg.norm(directions[first] - middle, axis=1)
    nearer = cKDTree(directions).query_ball_point(middle, radius * (1 + 1e-6), return_length=True)
    return [View.towards(direction, aloft=views[0].aloft) for direction in middle[nearer == 2]]
