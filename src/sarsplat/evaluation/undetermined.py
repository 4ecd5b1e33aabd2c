"""Share of a surface whose height the images do not determine, by Fisher information.

If a surface moved along its normals, images would change at its edges and texture, but not inside a uniform roof. The
information on a place's height is the change of the images by its surroundings, relative to their residual. In the sum
over the surroundings, changes by the grain of the Gaussians nearly cancel; fainter texture counts as none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from scipy.spatial import cKDTree
from torch import Tensor

from sarsplat.evaluation.images import UndefinedScore
from sarsplat.geometry import RayGrid
from sarsplat.learning.batching import in_groups
from sarsplat.renderer import channel_of

if TYPE_CHECKING:
    from sarsplat.learning.model import SceneModel
    from sarsplat.runs import Run

_RADIUS = 4.0
"""Radius of a place's surroundings, resolution cells."""

_SURE = 1.0
"""Standard errors subtracted from the information, for changes that cancel only on average."""

_MOVED = 0.1
"""Movement of the surface in either direction, resolution cells."""

_PLACES = 4000
"""Maximum number of random points tested; the share is then accurate to 0.01."""

_FAINT = 1e-3
"""Minimum power of the pixels that measure the residual, relative to the image's brightest."""

_RAYS_PER_PIXEL, _MAX_BATCH = 2.0, 4


def undetermined(run: Run) -> float:
    """Share of the points whose height along the normal is uncertain by more than a resolution cell.

    Raises `UndefinedScore` if the run has no Gaussians, points or training images, or was learned from phases.
    """
    return float(places(run)[1].mean())


def places(run: Run) -> tuple[Float32[np.ndarray, "p 3"], Bool[np.ndarray, " p"]]:
    """Random points, and a mask of those whose height is not determined."""
    model = run.model
    if model is None:
        raise UndefinedScore("the dependence of images on the surface is known for Gaussians only")
    points = run.points
    if len(points) == 0 or "train" not in run.dataset.splits():
        raise UndefinedScore("there are no points, or no training images")
    train = run.dataset.select("train")
    if train.interferometric or len(model.frame.views) != len(train.views):
        raise UndefinedScore("heights come from phases, or from other images than the dataset's")
    cell_m = model.frame.grid.cell_m
    tested = points[np.random.default_rng(0).permutation(len(points))[:_PLACES]]
    distance, nearest = cKDTree(points).query(model.parameters["means"].detach().cpu().numpy())
    outwards = np.where((distance < 2 * cell_m)[:, None], run.normals[nearest], 0).astype(np.float32)
    information = _information(model, run.iteration, torch.from_numpy(outwards).to(model.device), train.power)
    means = model.parameters["means"].detach().cpu().double().numpy()
    return tested, _known(means, information, tested, cell_m) < 1


def _information(
    model: SceneModel, iteration: int, outwards: Float[Tensor, "n 3"], power: Float[np.ndarray, "v rows columns"]
) -> Float64[np.ndarray, " n"]:
    """Contribution of each Gaussian to the information on a common height, per squared resolution cell."""
    model, grid, degree = model.copy(), model.frame.grid, model.degree(iteration)
    means, rays = model.parameters["means"], RayGrid.for_image(model.frame.grid, _RAYS_PER_PIXEL)
    start, step = means.detach().clone(), _MOVED * grid.cell_m * outwards
    total = torch.zeros(len(start), dtype=torch.float64, device=start.device)

    def amplitudes(batch: slice, centres: Tensor) -> Tensor:
        means.data.copy_(centres)
        numbers = torch.arange(len(power))[batch].to(model.device)
        images, _ = model.render(model.frame.views[batch], grid, degree, rays=rays, numbers=numbers)
        return channel_of(images, model.power_channel).clamp(min=1e-12 * float(power.max())).sqrt()

    for batch in in_groups(len(power), _MAX_BATCH, model.parameters, grid, rays):
        true = torch.from_numpy(np.sqrt(power[batch])).to(start)
        with torch.no_grad():
            change = (amplitudes(batch, start + step) - amplitudes(batch, start - step)) / (2 * _MOVED)
        rendered = amplitudes(batch, start)
        bright = true**2 > _FAINT * (true**2).amax((1, 2), keepdim=True)
        error = ((rendered.detach() - true) ** 2 * bright).sum((1, 2)) / bright.sum((1, 2)).clamp(min=1)
        (slope,) = torch.autograd.grad((change / error[:, None, None].clamp(min=1e-30) * rendered).sum(), [means])
        total += (slope * outwards).sum(1).double() * grid.cell_m
    return total.cpu().numpy()


def _known(
    means: Float64[np.ndarray, "n 3"],
    information: Float64[np.ndarray, " n"],
    places: Float[np.ndarray, "p 3"],
    cell_m: float,
) -> Float64[np.ndarray, " p"]:
    """Information of each place's surroundings, minus `_SURE` standard errors."""
    cubes = np.floor(means / cell_m).astype(np.int64)
    cubes -= cubes.min(axis=0)
    _, owner, count = np.unique(
        np.ravel_multi_index(tuple(cubes.T), cubes.max(axis=0) + 1), return_inverse=True, return_counts=True
    )
    sums = np.bincount(owner, information)
    middles = np.stack([np.bincount(owner, axis) for axis in means.T], axis=1) / count[:, None]
    radius_m = _RADIUS * cell_m
    near = cKDTree(places).sparse_distance_matrix(cKDTree(middles), radius_m, output_type="ndarray")
    parts = (1 - (near["v"] / radius_m) ** 2) * sums[near["j"]]
    known, by_chance = (np.bincount(near["i"], of, len(places)) for of in (parts, parts**2))
    return known - _SURE * np.sqrt(by_chance)
