"""Per-Gaussian visibility summed over views: lit area, mean γ⁰ and mean direction to the radar."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Real
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.geometry.view import unstretched
from sarsplat.progress import stage
from sarsplat.renderer import Rendering, render
from sarsplat.surface.bricks import Scene, ray_count
from sarsplat.surface.cells import by_cubes
from sarsplat.surface.first_returns import view_batches
from sarsplat.surface.neighbours import Neighbours, Tree, neighbours_of
from sarsplat.tiles.plan import memory_bytes

_RAYS_PER_PIXEL = 4.0
_MOST_BYTES = 1 << 29  # memory of a view beyond which it is rendered in bricks
_RADIUS = 0.25  # standard deviation of the weights around a place, resolution cells
_NEIGHBOURS = 24  # Gaussians that count around a place
_SEARCH = 2.0  # side of cubes that share one search of neighbours, in these standard deviations


def _rendered(
    gaussians: Gaussians, views: Sequence[View], pixel: ImageGrid, rays: RayGrid
) -> Iterator[tuple[list[View], Rendering, tuple[Int64[Tensor, " k"], Bool[Tensor, " k"]] | None]]:
    """Batches of views with their renderings: of all Gaussians, or of each brick's where memory is too small.

    For a brick also the indices of its Gaussians, and a mask of those that are rendered completely; each Gaussian is in
    one brick.
    """
    scene, count = Scene(gaussians, rays), ray_count(gaussians, views, rays)
    needed = memory_bytes(len(gaussians), gaussians.scattering.parameters.shape[1], count / len(views), 1)
    fits = needed <= _MOST_BYTES
    bricks = [] if fits else list(scene.bricks(views, rays, max(rays.spacing_m), count * _MOST_BYTES / needed))
    with stage("surface: what each view sees", len(views) * max(1, len(bricks))) as shown, torch.no_grad():
        for batch in view_batches(gaussians, views, pixel, rays) if fits else ():
            yield batch, render(gaussians, batch, pixel, rays=rays), None
            shown.advance(len(batch))
        for brick in bricks:
            own = brick.holds(gaussians.means.double())
            beyond_m = scene.widest_m(own.nonzero()[:, 0])
            for view in views:
                rows, met = scene.met_by(brick.window(view, rays, beyond_m), view, rays)
                yield [view], render(met, [view], pixel, rays=rays), (rows, own[rows])
                shown.advance(1)


@dataclass(frozen=True)
class Seen:
    """Visibility of each of N Gaussians, summed over views."""

    means: Float64[Tensor, "n 3"]
    """Centres, world frame, m."""
    cross_section: Float64[Tensor, " n"]
    """Radar cross-sections σ, m²."""
    lit_area: Float64[Tensor, " n"]
    """Areas across the line of sight over which a Gaussian is seen, m²."""
    towards: Float64[Tensor, "n 3"]
    """Directions to the radar, each weighted with that area, m²."""
    radius_m: float
    """Standard deviation of a Gaussian's weight in the space around it, m."""

    @classmethod
    def of(cls, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid) -> "Seen":
        views = unstretched(views)
        gaussians, rays = gaussians.detach(), RayGrid.for_image(grid, _RAYS_PER_PIXEL)
        means, channel = gaussians.means.double(), gaussians.scattering.power_channel
        sums = means.new_zeros(len(means), 5)  # cross-section, lit area, towards
        pixel = replace(grid, rows=1, columns=1)  # images would take their time
        for batch, rendering, of_brick in _rendered(gaussians, views, pixel, rays):
            directions = torch.from_numpy(np.stack([view.look.facing for view in batch])).to(means.device)
            of_views = zip(rendering.lit_area.double(), rendering.cross_sections, directions, strict=True)
            for area, section, direction in of_views:
                terms = torch.cat([section[:, channel, None].double(), area[:, None], area[:, None] * direction], dim=1)
                if of_brick is None:
                    sums += terms
                else:
                    rows, complete = of_brick
                    sums[rows[complete]] += terms[complete]
        cross_section, lit_area, towards = sums.split([1, 1, 3], dim=1)
        return cls(means, cross_section[:, 0], lit_area[:, 0], towards, _RADIUS * grid.cell_m)

    def around(self, points: Real[np.ndarray, "p 3"]) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p 3"]]:
        """Mean γ⁰ (linear) around points (m), 0 if nothing was seen, and mean direction to the radars, of any length.

        γ⁰ is the sum of the Gaussians' cross-sections over the sum of their lit areas, all views together.
        """
        places = torch.from_numpy(np.asarray(points)).to(self.means)
        means = self.means.new_zeros(len(places), 4)
        count = min(_NEIGHBOURS, len(self.means))
        for rows, middles, cube in by_cubes(places, _SEARCH * self.radius_m) if count else ():
            index = self._near.nearest(middles, count)[1][cube]
            offsets = ((a[index] - b[:, None]) for a, b in zip(self.means.T, places[rows].T, strict=True))
            square = sum(offset.square() for offset in offsets)
            # relative to the nearest Gaussian, so that weights never vanish
            weight = torch.exp((square.amin(1, keepdim=True) - square) / (2 * self.radius_m**2))
            area, section, *towards = (
                (weight * value[index]).sum(1) for value in (self.lit_area, self.cross_section, *self.towards.T)
            )
            means[rows] = torch.stack([(section / area).where(area > 0, 0.0), *towards], dim=1)
        both = means.cpu().numpy()
        return both[:, 0], both[:, 1:]

    @cached_property
    def _near(self) -> Tree | Neighbours:
        return neighbours_of(self.means)
