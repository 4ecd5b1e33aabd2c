"""Warping of images of terrain to level ground, to find a target and the brightness of its ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32
from scipy.ndimage import map_coordinates

from sarsplat.data import Dataset
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.echoes.lit_terrain import lit_terrain
from sarsplat.renderer.engines.choice import passes_for

_DIMMEST = 0.1
"""Power of terrain, relative to flat ground, below which pixels are replaced by median ground."""


def levelled(dataset: Dataset) -> Dataset:
    """Warp images to level ground, with its brightness; unchanged without terrain.

    Layover and shadow of objects on the terrain are nearly as on level ground.
    """
    if dataset.terrain is None:
        return dataset
    power = np.stack(
        [_levelled(image, view, dataset.grid, dataset.terrain) for image, view in zip(dataset.power, dataset.views)]
    )
    return replace(dataset, power=power, signal=None, terrain=None, path=None)


def _levelled(
    power: Float32[np.ndarray, "rows columns"], view: View, grid: ImageGrid, terrain: Terrain
) -> Float32[np.ndarray, "rows columns"]:
    look = view.look
    bare = RayEnds(torch.empty(0, dtype=torch.float32), [(0, 0)], [(0.0, 0.0)])
    rays, new_pass = RayGrid.for_image(grid), passes_for("auto", {"transmittance": bare.transmittance})
    free = lit_terrain(
        bare, [view], grid, rays, terrain, torch.ones(1, 1, 1, dtype=torch.float32), 1.0, None, new_pass
    )[0].numpy()
    share = look.gamma0_of_beta0(free)
    known = share > _DIMMEST
    flat = np.where(known, power / np.where(known, share, 1.0), np.median(power[known]) if known.any() else 0.0)
    x, r = grid.azimuth_m[None, :], grid.range_m[:, None]
    across, away = look.onto_ground
    place = x[..., None] * across + r[..., None] * away
    shift_m = terrain.height_m(place[..., 0], place[..., 1]) * look.sine  # towards the radar
    row = (r - shift_m - grid.range_m[0]) / grid.spacing_m[1]
    column = np.broadcast_to(np.arange(grid.columns), row.shape)
    return map_coordinates(flat, [row, column], order=1, mode="nearest").astype(np.float32)
