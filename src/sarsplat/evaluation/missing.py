"""Objects that the training images show and the points lack.

The scene is rendered without the Gaussians that are far from all points. Images that are twice as bright as that, in
the mean over the views at a place in space, show an object there that no point stands for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy.ndimage import label, map_coordinates, maximum_position
from scipy.spatial import cKDTree

from sarsplat.evaluation.images import UndefinedScore
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.geometry.terrain import heights_of
from sarsplat.radiometry import to_db, usual_peak
from sarsplat.regions.target_box import seen_by_all, smoothed, typical
from sarsplat.renderer import channel_of

if TYPE_CHECKING:
    from sarsplat.runs import Run

_REACH = 1.5
"""Distance up to which a point stands for a Gaussian, resolution cells."""

_EXCESS_DB = 3.0
"""Minimum mean excess of the images, dB."""

_SURE = 6.0
"""Minimum mean excess of the images, standard deviations of its noise over all places."""

_FAINT = 1e-3
"""Power below which pixels are dark, relative to the usual peak of the images."""

_PLACES = 96
"""Maximum number of places along a side of the scene."""

_VIEWS = 24
"""Maximum number of views compared."""

_RAYS_PER_PIXEL = 2.0


def missing(run: Run) -> Float64[np.ndarray, "k 3"]:
    """Places of objects that images show and points lack, m, brightest first.

    Raises
    ------
    UndefinedScore
        If the run has no Gaussians, or its training images are not the dataset's.
    """
    model = run.model
    if model is None:
        raise UndefinedScore("only scenes of Gaussians can be rendered without what has no points")
    if "train" not in run.dataset.splits():
        raise UndefinedScore("there are no training images")
    train = run.dataset.select("train")
    if train.interferometric or len(model.frame.views) != len(train.views):
        raise UndefinedScore("images are stacks, or others than the dataset's")
    grid = model.frame.grid
    half = seen_by_all(model.frame.views, grid)
    some = np.unique(np.linspace(0, len(train.views) - 1, min(len(train.views), _VIEWS)).round().astype(int))
    views = [model.frame.views[k] for k in some]
    excess_db = _excess_db(train.power[some], _without_far(run, some), grid)
    region, terrain = model.frame.region, model.frame.terrain
    side = np.linspace(-half, half, min(_PLACES, 2 * int(half / grid.cell_m) + 1))
    heights = np.arange(region.low[2], region.high[2], max(2 * grid.cell_m, np.ptp(side) / _PLACES))
    places = np.stack(np.meshgrid(heights, side, side, indexing="ij"), axis=-1)[..., ::-1].copy()
    places[..., 2] -= heights_of(places.reshape(-1, 3) * (1, 1, 0), terrain).reshape(places.shape[:-1])
    mean_db = np.mean([_at(image, view, grid, places) for image, view in zip(excess_db, views, strict=True)], axis=0)
    least_db = max(_EXCESS_DB, _SURE * typical(mean_db)[1])
    parts, count = label(mean_db > least_db)
    found = [places[index] for index in maximum_position(mean_db, parts, range(1, count + 1))]
    brightest = np.argsort([-mean_db[parts == k].max() for k in range(1, count + 1)])
    return np.array(found).reshape(-1, 3)[brightest]


def _without_far(run: Run, numbers: np.ndarray) -> Float32[np.ndarray, "v rows columns"]:
    """Training images as rendered without the Gaussians that are far from all points, β⁰."""
    assert run.model is not None
    model = run.model.copy()
    grid, views = model.frame.grid, model.frame.views
    means = model.target(0).means.detach().double().cpu().numpy()
    reach_m = _REACH * grid.cell_m
    far = (
        np.isinf(cKDTree(run.points).query(means, distance_upper_bound=reach_m)[0]) if len(run.points) else slice(None)
    )
    degree, rays = model.degree(run.iteration), RayGrid.for_image(grid, _RAYS_PER_PIXEL)
    images = []
    with torch.no_grad():
        model.parameters["optical_depth"].data[far] = 0.0
        for k in numbers:
            number = torch.tensor([k], device=model.device)
            image, _ = model.render([views[k]], grid, degree, rays=rays, numbers=number)
            images.append(channel_of(image, model.power_channel)[0].cpu().numpy())
    return np.stack(images)


def _excess_db(
    power: Float32[np.ndarray, "v rows columns"], expected: Float32[np.ndarray, "v rows columns"], grid: ImageGrid
) -> Float64[np.ndarray, "v rows columns"]:
    """Images above expected ones, smoothed over a resolution cell, dB; 0 where both are dark."""
    shown, ours = smoothed(power, grid), smoothed(expected, grid)
    dark = np.maximum(np.median(shown, axis=(1, 2), keepdims=True), _FAINT * usual_peak(power))
    return to_db(shown + dark, ours + dark)


def _at(
    image: Float64[np.ndarray, "rows columns"], view: View, grid: ImageGrid, places: Float64[np.ndarray, "h n n 3"]
) -> Float64[np.ndarray, "h n n"]:
    """Values of an image at the pixels of places in space."""
    first, spacing = np.array([grid.range_m[0], grid.azimuth_m[0]]), np.array(grid.spacing_m[::-1])
    pixels = (places @ view.look.gradients[[1, 0]].T - first) / spacing
    return map_coordinates(image, np.moveaxis(pixels, -1, 0), order=1, mode="constant", cval=0.0)
