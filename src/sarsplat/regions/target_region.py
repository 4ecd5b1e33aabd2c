"""The region in which Gaussians may lie, and warnings of what it cuts off."""

from __future__ import annotations

import math

import numpy as np

from sarsplat.data import Dataset
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError
from sarsplat.gaussians.initialise import Region, bounded_region
from sarsplat.geometry.terrain import heights_of
from sarsplat.regions.flattened import levelled
from sarsplat.regions.target_box import stands_out_db, target_box
from sarsplat.scenes.meshes import read_mesh

_MUCH = 0.2
"""Share of what stands out from the ground that may lie beyond the box: side lobes, and what is there by chance."""


def target_region(dataset: Dataset, *, ground: bool, box: Box | None = None) -> Region:
    """The given box (m), or the dataset's, or what its training images tell; z is above the terrain, if any.

    `ground` is whether the target stands on ground that images show; without, all that is bright is the target.
    """
    train, box = levelled(dataset.select("train")), box or dataset.target_box_m
    if box is not None:
        return Region.box(*box)
    if ground:
        low, high = target_box(train.power, train.views, train.grid)
        return Region.box(low.tolist(), high.tolist())
    return bounded_region(train.power, train.views, train.grid)


def cut_off(region: Region, margin_m: float, dataset: Dataset) -> list[str]:
    """What of the target lies outside, by the true shape or else by the images; a list of one sentence, or empty."""
    box = f"the box it is looked for in ({spans(region.low, region.high)} m)"
    remedy = "give another with --target-box, in Python Config(target_box=...)"
    low, high = region.low - margin_m, region.high + margin_m
    if dataset.truth_mesh is not None:
        try:
            vertices = np.asarray(read_mesh(dataset.truth_mesh).vertices)
        except (ImportError, SarsplatError):  # training does not need it; evaluation, which does, says what is wrong
            return []
        vertices = np.column_stack([vertices[:, :2], heights_of(vertices, dataset.terrain)])
        least, most = vertices.min(axis=0), vertices.max(axis=0)
        if (least >= low).all() and (most <= high).all():
            return []
        return [f"the target ({spans(least, most)} m) is not all inside of {box} and will be cut off; {remedy}"]
    if not dataset.ground:
        return []
    train = levelled(dataset.select("train"))
    above_db, axis = stands_out_db(train.power, train.views, train.grid)
    inside = np.outer(*((low[i] <= axis) & (axis <= high[i]) for i in (1, 0)))
    share = float(above_db[~inside].sum() / above_db.sum()) if above_db.any() else 0.0
    if not share > _MUCH:
        return []
    return [f"{math.floor(100 * share)} % of what stands out from the ground lies outside of {box}; {remedy}"]


def box_misses(dataset: Dataset) -> list[str]:
    """What of the target lies outside of the box that the dataset names; a list of one sentence, or empty."""
    if dataset.target_box_m is None:
        return []
    return cut_off(Region.box(*dataset.target_box_m), 0.0, dataset)


def spans(low: np.ndarray, high: np.ndarray) -> str:
    """A box, m: "x -3.2 … 9.7, y 0.3 … 7.8, z 0 … 5"."""
    return ", ".join(f"{name} {a:.3g} … {b:.3g}" for name, a, b in zip("xyz", low, high, strict=True))
