"""Rendering of one tile.

Rays are those of the whole scene's one lattice, and a Gaussian has the same footprints at the same places in every
tile: so neighbours show the same of it, to the order of sums.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import Footprints, attenuate, project, splat
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.ground import gamma0_by_view, lit, returned, with_ground
from sarsplat.renderer.lit_ground import RayEnds
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
    ground: Ground | None,
) -> Float[Tensor, "c rows columns"]:
    """What `render` shows of a scene on this grid in the tile's pixels."""
    some, pixels = rows_of(gaussians, tile.gaussians), grid.part(tile.rows, tile.columns)
    p = project(some, [view], grid, rays=rays, shift=shift)
    attenuation = attenuate(p, rays, first_return_depth=None if ground is None else _ANY_DEPTH)
    images = _splatted(p.pixels, p.amplitudes * attenuation.lit_area[..., None], grid, tile)
    if ground is None:
        return images[0]
    assert attenuation.ray_maps is not None
    left = attenuation.ray_maps[0]
    rows, columns = left.transmittance.shape
    ends = RayEnds(left.transmittance.reshape(-1), [(rows, columns)], [left.origin])
    new_pass = passes_for("auto", {"transmittance": ends.transmittance})
    of_rays = lit(ends, ground, gamma0_by_view(ground, 1), [view], pixels, rays, shift, new_pass)
    of_ground = returned(ground, of_rays, [view], pixels, shift)
    return with_ground(images, of_ground, gaussians.scattering.power_channel)[0]


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
