"""Rendering of one tile.

Rays are those of the whole scene's one lattice, and a Gaussian has the same footprints at the same places in every
tile: so neighbours show the same of it, to the order of sums.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import Footprints, attenuate, project, splat
from sarsplat.renderer.echoes.echo import Echo, Sighting, ends_of, with_echoes
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.tiles.plan import LARGEST, Tile
from sarsplat.tiles.reach import rows_of

_STEPS = (1 << 23) // LARGEST  # of places in a pixel: float32 holds them up to a tile's width beside the tile
_ANY_DEPTH = 1.0  # of first returns, which nobody reads: they come with the ends of rays


def tile_image(
    gaussians: Gaussians,
    view: View,
    grid: ImageGrid,
    tile: Tile,
    rays: RayGrid,
    shift: Float[Tensor, "1 2"] | None,
    echoes: Sequence[Echo],
) -> Float[Tensor, "c rows columns"]:
    some, pixels = rows_of(gaussians, tile.gaussians), grid.part(tile.rows, tile.columns)
    p = project(some, [view], grid, rays=rays, shift=shift)
    attenuation = attenuate(p, rays, first_return_depth=_ANY_DEPTH if echoes else None)
    images = _splatted(p.pixels, p.amplitudes * attenuation.lit_area[..., None], grid, tile)
    if not echoes:
        return images[0]
    assert attenuation.ray_maps is not None  # asked for
    ends = ends_of(attenuation.ray_maps)
    new_pass = passes_for("auto", {"transmittance": ends.transmittance})
    sighting = Sighting(some, [view], pixels, rays, shift, attenuation.lit_area, ends, new_pass)
    return with_echoes(images, echoes, sighting)[0][0]


def _splatted(
    footprints: Footprints, cross_sections: Float[Tensor, "1 n c"], grid: ImageGrid, tile: Tile
) -> Float[Tensor, "1 c rows columns"]:
    """`splat` in pixels from the tile's first one, at places that are rounded alike in every tile.

    Metres from the scene's centre have too few digits, and one that differs may cut off a footprint's last pixel.
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
