"""`render_tiled`: one view of a scene that is too large to be rendered at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.progress import stage
from sarsplat.renderer.echoes import Echo, GroundEcho
from sarsplat.renderer.echoes.echo import all_visible, left_in_sight
from sarsplat.tiles.image import tile_image
from sarsplat.tiles.kept import KeptTiles
from sarsplat.tiles.plan import Plan
from sarsplat.tiles.reach import Reach

_STRIP = 128  # columns of the image, whose rays are followed to the terrain at once

USUAL_GIB = 2.0
"""What a tile takes unless told otherwise: beyond, it is no faster."""


@checks_arguments
def render_tiled(
    gaussians: Gaussians,
    view: View,
    grid: ImageGrid,
    *,
    rays: RayGrid | None = None,
    shift: Float[Tensor, " 2"] | None = None,
    ground: Ground | None = None,
    memory_gib: float = USUAL_GIB,
) -> Float[Tensor, "c {grid.rows} {grid.columns}"]:
    """Render one view by tiles, in memory that does not grow with the image; no gradients.

    The image is halved until each part fits, together with the Gaussians that reach it and those that shade these. All
    tiles have the rays of one lattice and the footprints of one projection, so that there are no seams.

    Parameters
    ----------
    gaussians, grid, rays, ground
        As at `sarsplat.render`.
    view : View
        From where.
    shift : Tensor [2], optional
        Displacement (azimuth, range) of the image, m.
    memory_gib : float
        What a tile may take, GiB. Beyond it, rendering takes some fifty bytes for each Gaussian, and the image.

    Returns
    -------
    Tensor [C, rows, columns]
        The image on the CPU, β⁰, linear power, where a channel is power; the same bits for any number of threads, and
        where it goes on from tiles that were kept (`tiles_kept_in`).

    Raises
    ------
    SarsplatError
        If `render` would refuse the scene, a few pixels alone do not fit into the memory, or a tile cannot be kept.
    """
    if not 0 < memory_gib < float("inf"):
        raise SarsplatError(f"memory_gib {memory_gib} must be positive and finite, such as {USUAL_GIB}")
    check_unstretched([view])
    rays = rays or RayGrid.for_image(grid)
    kept = KeptTiles(gaussians, view, grid.as_dict(), rays, shift, memory_gib, *_said_of(ground))
    with torch.no_grad():
        displaced = None if shift is None else shift[None]
        echoes = [] if ground is None else [GroundEcho(ground)]
        scene = all_visible(echoes, _in_sight(gaussians, view, grid, rays, displaced, echoes))
        reach = Reach.of(scene, view, grid, rays, displaced)
        plan = Plan(reach, view, grid, rays, ground, scene.scattering.parameters.shape[1], memory_gib * 2**30)
        size = (len(scene.scattering.channels), grid.rows, grid.columns)
        image, done = torch.empty(size, dtype=scene.means.dtype), 0
        with stage("tiles, in pixels", grid.rows * grid.columns) as reporter:
            for tile in plan.tiles():
                found, done = kept.find(tile), done + tile.grid.rows * tile.grid.columns
                if found is None:
                    found = tile_image(scene, view, grid, tile, rays, displaced, echoes).cpu()
                    kept.add(tile, found)
                    reporter.update(done)
                else:
                    reporter.start_at(done)
                image[:, tile.rows, tile.columns] = found
        return image


def _in_sight(
    gaussians: Gaussians,
    view: View,
    grid: ImageGrid,
    rays: RayGrid,
    shift: Float[Tensor, "1 2"] | None,
    echoes: Sequence[Echo],
) -> Gaussians:
    """Set the optical depth of Gaussians that an echo, as terrain, hides from the view to zero.

    Of the whole image: what a hill hides may reach into a tile that does not show the hill.
    """
    depth = gaussians.optical_depth
    for first in range(0, grid.columns, _STRIP):
        strip = grid.part(slice(0, grid.rows), slice(first, min(first + _STRIP, grid.columns)))
        seen = left_in_sight(echoes, gaussians.means, [view], strip, rays, shift)
        depth = depth if seen is None else depth * seen[0]
    return replace(gaussians, optical_depth=depth)


def _said_of(ground: Ground | None) -> Iterator[object]:
    """Everything that identifies a ground, as tensors and values with a complete `repr`."""
    for value in () if ground is None else vars(ground).values():
        if isinstance(value, Terrain):
            yield from (torch.from_numpy(value.heights_m), value.pitch_m)
        else:
            yield value
