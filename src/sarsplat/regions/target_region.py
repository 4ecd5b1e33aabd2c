"""Region of Gaussians' centres, also on terrain, whose images are levelled for it; warnings of objects cut off."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float32
from scipy.ndimage import map_coordinates

from sarsplat.data import Dataset
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.initialise import Region, bounded_region
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.terrain import heights_of
from sarsplat.regions.image_levels import seen_by_all
from sarsplat.regions.target_box import StandingOut, standing_out, target_box
from sarsplat.renderer.echoes.echo import RayEnds
from sarsplat.renderer.echoes.lit_terrain import lit_terrain
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.scenes.meshes import read_mesh

_MUCH = 0.2  # maximum share of the brightness (dB) above the ground outside of the box, for side lobes and chance
_DIMMEST = 0.1  # power of terrain, relative to flat ground, below which pixels are replaced by median ground
_NAMED = 3  # maximum number of objects outside of the box that a warning locates


def target_region(dataset: Dataset, *, ground: bool, box: Box | None = None) -> Region:
    """Region of the given box (m), the dataset's, or one from the training images; z is above the terrain, if any.

    `ground`: images show ground around the target; otherwise all bright pixels are the target.
    """
    train, box = levelled(dataset.select("train")), box or dataset.target_box_m
    if box is not None:
        return Region.box(*box)
    if ground:
        low, high = target_box(train.power, train.views, train.grid)
        return Region.box(low.tolist(), high.tolist())
    return bounded_region(train.power, train.views, train.grid)


def cut_off(region: Region, margin_m: float, dataset: Dataset) -> list[str]:
    """Warnings (at most one) of parts of the target outside of a region, by the true shape or else by the images."""
    box = f"the box it is looked for in ({spans(region.low, region.high)} m)"
    remedy = "give another `target_box`"
    low, high = region.low - margin_m, region.high + margin_m
    if dataset.truth_mesh is not None:
        try:
            vertices = np.asarray(read_mesh(dataset.truth_mesh).vertices)
        except (ImportError, SarsplatError):  # training does not need it; evaluation raises
            return []
        vertices = np.column_stack([vertices[:, :2], heights_of(vertices, dataset.terrain)])
        least, most = vertices.min(axis=0), vertices.max(axis=0)
        if (least >= low).all() and (most <= high).all():
            return []
        return [f"the target ({spans(least, most)} m) is not all inside of {box} and will be cut off; {remedy}"]
    train = dataset.select("train")
    if not dataset.ground or seen_by_all(train.views, train.grid) <= 0:
        return []
    train = levelled(train)
    found = standing_out(train.power, train.views, train.grid)
    inside = np.outer(*((low[i] <= found.axis) & (found.axis <= high[i]) for i in (1, 0)))
    share = float(found.above_db[~inside].sum() / found.above_db.sum()) if found.above_db.any() else 0.0
    warning = _objects_beside(found, inside, region, box)
    if share > _MUCH and not warning:
        return [f"{math.floor(100 * share)} % of the brightness above the ground lies outside of {box}; {remedy}"]
    return warning


def _objects_beside(found: StandingOut, inside: Bool[np.ndarray, "side side"], region: Region, box: str) -> list[str]:
    """Warnings (at most one) of objects outside of the box, with a box around all, as high as before."""
    beside = [mask for mask in found.objects if not (mask & inside).any()]
    if not beside:
        return []
    ends = [[found.axis[np.flatnonzero(mask.any(axis=i))[[0, -1]]] for i in (0, 1)] for mask in beside]
    corners = np.array(ends).transpose(2, 0, 1)  # lowest x and y of each object, and highest
    low = [*np.minimum(region.low[:2], corners[0].min(axis=0)), region.low[2]]
    high = [*np.maximum(region.high[:2], corners[1].max(axis=0)), region.high[2]]
    where = "; ".join(
        f"x {a[0]:.3g} … {b[0]:.3g}, y {a[1]:.3g} … {b[1]:.3g} m" for a, b in zip(*corners[:, :_NAMED], strict=True)
    )
    more = f" and {len(beside) - _NAMED} more" if len(beside) > _NAMED else ""
    return [
        f"what stands at {where}{more} is outside of {box} and will be left out; "
        f"`target_box=({', '.join(f'{value:.3g}' for value in [*low, *high])})` goes around it, as high as the box is"
    ]


def box_misses(dataset: Dataset) -> list[str]:
    """Warnings (at most one) of parts of the target outside of the dataset's own box."""
    if dataset.target_box_m is None:
        return []
    return cut_off(Region.box(*dataset.target_box_m), 0.0, dataset)


def spans(low: np.ndarray, high: np.ndarray) -> str:
    """Text of a box, m: "x -3.2 … 9.7, y 0.3 … 7.8, z 0 … 5"."""
    return ", ".join(f"{name} {a:.3g} … {b:.3g}" for name, a, b in zip("xyz", low, high, strict=True))


# ---- images of terrain, warped to level ground ----
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
    """Divide by the power of bare terrain, relative to flat ground, then undo the terrain's layover in range."""
    look = view.look
    bare = RayEnds(torch.empty(0, dtype=torch.float32), [(0, 0)], [(0.0, 0.0)])  # no ray meets a Gaussian
    rays, new_pass = RayGrid.for_image(grid), passes_for("auto", {"transmittance": bare.transmittance})
    gamma0 = torch.ones(1, 1, 1, dtype=torch.float32)
    beta0 = lit_terrain(bare, [view], grid, rays, terrain, gamma0, 1.0, None, new_pass)[0].numpy()
    share = look.gamma0_of_beta0(beta0)
    known = share > _DIMMEST
    flat = np.where(known, power / np.where(known, share, 1.0), np.median(power[known]) if known.any() else 0.0)
    x, r = grid.azimuth_m[None, :], grid.range_m[:, None]
    across, away = look.onto_ground
    place = x[..., None] * across + r[..., None] * away
    shift_m = terrain.height_m(place[..., 0], place[..., 1]) * look.sine  # towards the radar
    row = (r - shift_m - grid.range_m[0]) / grid.spacing_m[1]
    column = np.broadcast_to(np.arange(grid.columns), row.shape)
    return map_coordinates(flat, [row, column], order=1, mode="nearest").astype(np.float32)
