"""Rendering of a view by tiles, for scenes that are too large to be rendered at once."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Ground
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.progress import stage
from sarsplat.renderer import Footprints, attenuate, project, splat
from sarsplat.renderer.echoes import Echo, GroundEcho
from sarsplat.renderer.echoes.echo import Sighting, all_visible, ends_of, left_in_sight, with_echoes
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.tiles.halo import Halos, rows_of
from sarsplat.tiles.plan import LARGEST, Plan, Tile
from sarsplat.tiles.tile_cache import TileCache

_STRIP = 128  # image columns whose rays are traced to the terrain at once
_STEPS = (1 << 23) // LARGEST  # positions per pixel that float32 resolves up to a tile's width outside of the tile
_ANY_DEPTH = 1.0  # optical depth of unused first returns, without which there are no ray maps

USUAL_GIB = 2.0
"""Default memory of a tile; more is not faster."""


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
    tiles share one lattice of rays and one set of footprints, so that there are no seams.

    Parameters
    ----------
    gaussians, grid, rays, ground
        As at `sarsplat.render`.
    view : View
        View of the radar.
    shift : Tensor [2], optional
        Displacement (azimuth, range) of the image, m.
    memory_gib : float
        Memory of a tile, GiB; in addition, rendering takes some fifty bytes per Gaussian, and the image.

    Returns
    -------
    Tensor [C, rows, columns]
        Image on the CPU; β⁰, linear power, for channels of power. Its bits do not depend on the number of threads, or
        on resuming (`tiles_kept_in`).

    Raises
    ------
    SarsplatError
        If `render` would raise for the scene, 16 × 16 pixels do not fit into the memory, or a tile cannot be written.
    """
    if not 0 < memory_gib < float("inf"):
        raise SarsplatError(f"memory_gib {memory_gib} must be positive and finite, such as {USUAL_GIB}")
    check_unstretched([view])
    rays = rays or RayGrid.for_image(grid)
    cache = TileCache(gaussians, view, grid.as_dict(), rays, shift, memory_gib, *_identity(ground))
    with torch.no_grad():
        displaced = None if shift is None else shift[None]
        echoes = [] if ground is None else [GroundEcho(ground)]
        scene = all_visible(echoes, _in_sight(gaussians, view, grid, rays, displaced, echoes))
        halos = Halos.of(scene, view, grid, rays, displaced)
        plan = Plan(halos, view, grid, rays, ground, scene.scattering.parameters.shape[1], memory_gib * 2**30)
        size = (len(scene.scattering.channels), grid.rows, grid.columns)
        image, done = torch.empty(size, dtype=scene.means.dtype), 0
        with stage("tiles, in pixels", grid.rows * grid.columns) as reporter:
            for tile in plan.tiles():
                part, done = cache.find(tile), done + tile.grid.rows * tile.grid.columns
                if part is None:
                    part = tile_image(scene, view, grid, tile, rays, displaced, echoes).cpu()
                    cache.add(tile, part)
                    reporter.update(done)
                else:
                    reporter.start_at(done)
                image[:, tile.rows, tile.columns] = part
        return image


def _in_sight(
    gaussians: Gaussians,
    view: View,
    grid: ImageGrid,
    rays: RayGrid,
    shift: Float[Tensor, "1 2"] | None,
    echoes: Sequence[Echo],
) -> Gaussians:
    """Set the optical depth of Gaussians hidden by terrain to zero.

    This is done for the whole image: a hidden Gaussian may reach into a tile that does not show the hill.
    """
    depth = gaussians.optical_depth
    for first in range(0, grid.columns, _STRIP):
        strip = grid.part(slice(0, grid.rows), slice(first, min(first + _STRIP, grid.columns)))
        visible = left_in_sight(echoes, gaussians.means, [view], strip, rays, shift)
        depth = depth if visible is None else depth * visible[0]
    return replace(gaussians, optical_depth=depth)


def _identity(ground: Ground | None) -> Iterator[object]:
    """Fields of a ground as tensors and values with a complete `repr`."""
    for value in () if ground is None else vars(ground).values():
        if isinstance(value, Terrain):
            yield from (torch.from_numpy(value.heights_m), value.pitch_m)
        else:
            yield value


# ---- one tile --------------------------------------------------------------------------------------------------------
def tile_image(
    gaussians: Gaussians,
    view: View,
    grid: ImageGrid,
    tile: Tile,
    rays: RayGrid,
    shift: Float[Tensor, "1 2"] | None,
    echoes: Sequence[Echo],
) -> Float[Tensor, "c rows columns"]:
    """Render one tile, whose neighbours agree up to the order of sums."""
    members, pixels = rows_of(gaussians, tile.gaussians), grid.part(tile.rows, tile.columns)
    p = project(members, [view], grid, rays=rays, shift=shift)
    attenuation = attenuate(p, rays, first_return_depth=_ANY_DEPTH if echoes else None)
    images = _splatted(p.pixels, p.amplitudes * attenuation.lit_area[..., None], grid, tile)
    if not echoes:
        return images[0]
    assert attenuation.ray_maps is not None  # by first_return_depth
    ends = ends_of(attenuation.ray_maps)
    new_pass = passes_for("auto", {"transmittance": ends.transmittance})
    sighting = Sighting(members, [view], pixels, rays, shift, attenuation.lit_area, ends, new_pass)
    return with_echoes(images, echoes, sighting)[0][0]


def _splatted(
    footprints: Footprints, cross_sections: Float[Tensor, "1 n c"], grid: ImageGrid, tile: Tile
) -> Float[Tensor, "1 c rows columns"]:
    """`splat` in pixels from the tile's first one, at positions whose rounding does not depend on the tile.

    In metres from the scene's centre, different last digits could cut off a footprint's last pixel.
    """
    centers, (a, b, c) = footprints.centers, footprints.roots.unbind(-1)
    azimuth, slant_range = grid.spacing_m
    first = centers.new_tensor([grid.azimuth_m[0], grid.range_m[0]], dtype=torch.float64)
    steps = centers.new_tensor([_STEPS / azimuth, _STEPS / slant_range], dtype=torch.float64)
    corner = centers.new_tensor([tile.columns.start, tile.rows.start])
    places = ((centers - first) * steps).round() / _STEPS - corner
    roots = torch.stack([a * azimuth, b * slant_range, c * slant_range], dim=-1)
    rows, columns = tile.rows.stop - tile.rows.start, tile.columns.stop - tile.columns.start
    pixels = ImageGrid(rows, columns, (1.0, 1.0), (1.0, 1.0), ((columns - 1) / 2, (rows - 1) / 2))
    in_pixels = Footprints(places.to(centers.dtype), roots)
    return splat(in_pixels, cross_sections / (azimuth * slant_range), pixels)
