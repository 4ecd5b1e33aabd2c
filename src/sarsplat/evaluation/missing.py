"""Objects that the training images show and the points lack.

The images are compared with a rendering that omits Gaussians farther than 1.5 cells from every point. A place shows a
missing object if the excess, averaged over the views in dB, exceeds 3 dB and 6 standard deviations of its noise.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy.ndimage import center_of_mass, label, maximum
from scipy.spatial import cKDTree

from sarsplat.evaluation.images import UndefinedScore
from sarsplat.geometry import ImageGrid, RayGrid
from sarsplat.radiometry import to_db, usual_peak
from sarsplat.regions.image_levels import seen_by_all, smoothed, typical, values_at
from sarsplat.renderer import channel_of

if TYPE_CHECKING:
    from sarsplat.learning.model import SceneModel
    from sarsplat.runs import Run

_REACH = 1.5
"""Maximum distance of a Gaussian from the nearest point that represents it, resolution cells."""

_EXCESS_DB = 3.0
"""Minimum mean excess of the images, dB."""

_SURE = 6.0
"""Minimum mean excess of the images, standard deviations of its noise over all places."""

_FAINT = 1e-3
"""Minimum power added to both images before their ratio, relative to the usual peak."""

_PLACES = 128
"""Maximum number of places along a side of the scene."""

_VIEWS = 24
"""Maximum number of views compared."""

_RAYS_PER_PIXEL = 2.0
"""Rays per pixel of the renderings, along each axis."""


def missing(run: Run) -> Float64[np.ndarray, "k 3"]:
    """Places of objects that images show and points lack, m, brightest first.

    Raises
    ------
    UndefinedScore
        If the run has no Gaussians; if its training images are stacks, have changed, or do not show the origin.
    """
    model = run.model
    if model is None:
        raise UndefinedScore("missing objects can be found for scenes of Gaussians only")
    if "train" not in run.dataset.splits():
        raise UndefinedScore("there are no training images")
    train = run.dataset.select("train")
    if train.interferometric or len(model.frame.views) != len(train.views):
        raise UndefinedScore(
            "the training images are interferometric stacks, or the dataset has changed since the training"
        )
    grid = model.frame.grid
    half = seen_by_all(model.frame.views, grid)
    if half <= 0:
        raise UndefinedScore("not all training images show the world's origin")
    region, terrain = model.frame.region, model.frame.terrain
    side = np.linspace(-half, half, min(_PLACES, 2 * int(half / grid.cell_m) + 1))
    heights = np.arange(region.low[2], region.high[2], max(grid.cell_m, np.ptp(side) / _PLACES))
    places = np.stack(np.meshgrid(heights, side, side, indexing="ij"), axis=-1)[..., ::-1].copy()
    if terrain is not None:
        places[..., 2] += terrain.height_m(places[..., 0], places[..., 1])
    degree, rays, without = model.degree(run.iteration), RayGrid.for_image(grid, _RAYS_PER_PIXEL), _without_far(run)
    faint, mean_db = _FAINT * usual_peak(train.power), np.zeros(places.shape[:-1])
    chosen = np.unique(np.linspace(0, len(train.views) - 1, min(len(train.views), _VIEWS)).round().astype(int))
    for k in chosen:  # one at a time: memory stays small
        view, number = model.frame.views[k], torch.tensor([k], device=model.device)
        with torch.no_grad():
            image, _ = without.render([view], grid, degree, rays=rays, numbers=number)
        rendered = channel_of(image, model.power_channel).cpu().numpy()
        shift = model.shot([view], grid, number).shift
        dx, dy = (0.0, 0.0) if shift is None else shift[0].tolist()
        displaced = replace(grid, center_m=(grid.center_m[0] - dx, grid.center_m[1] - dy))
        excess_db = _excess_db(train.power[[k]], rendered, grid, faint)[0]
        mean_db += np.nan_to_num(values_at(excess_db, view, displaced, places)) / len(chosen)
    least_db = max(_EXCESS_DB, _SURE * typical(mean_db)[1])
    parts, count = label(mean_db > least_db)
    numbers = np.arange(1, count + 1)
    brightest = np.argsort(-np.asarray(maximum(mean_db, parts, numbers)), kind="stable")
    middles = np.array(center_of_mass(mean_db, parts, numbers[brightest])).reshape(-1, 3).round().astype(int)
    return places[tuple(middles.T)]


def _without_far(run: Run) -> SceneModel:
    """Copy the run's model without the Gaussians that are far from all points."""
    assert run.model is not None
    model = run.model.copy()
    means = model.target(0).means.detach().double().cpu().numpy()
    far = np.ones(len(means), bool)
    if len(run.points):
        far = np.isinf(cKDTree(run.points).query(means, distance_upper_bound=_REACH * model.frame.grid.cell_m)[0])
    model.parameters["optical_depth"].data[torch.from_numpy(far).to(model.device)] = 0.0
    return model


def _excess_db(
    power: Float32[np.ndarray, "v rows columns"],
    expected: Float32[np.ndarray, "v rows columns"],
    grid: ImageGrid,
    faint: float,
) -> Float64[np.ndarray, "v rows columns"]:
    """Ratio of smoothed images to smoothed renderings, dB; near 0 where both are dark."""
    smooth, rendered = smoothed(power, grid), smoothed(expected, grid)
    dark = np.maximum(np.median(smooth, axis=(1, 2), keepdims=True), faint)
    return to_db(smooth + dark, rendered + dark)
