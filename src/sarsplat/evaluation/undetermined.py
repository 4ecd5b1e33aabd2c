"""What images leave open: the share of a surface whose height no edge and no texture fixes.

If all of a surface lay a little farther out along its normals, images would change at its edges, and where it does not
return the same everywhere; inside of a uniform roof, what one place no longer shows, the next one does. How much they
change by a place's surroundings, against how much they differ from the images anyway, says how well its height is
known: Fisher's information. In a sum over surroundings, changes that are no more than the grain of a cloud of Gaussians
cancel, but for chance; faint texture, which is no more than that, counts as none.
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

_AROUND = 4.0
"""How far a place's surroundings reach, resolution cells."""

_SURE = 1.0
"""Standard errors by which information must exceed what chance leaves of sums that should cancel."""

_MOVED = 0.1
"""By how much the surface is moved, both ways, resolution cells."""

_PLACES = 4000
"""Of the points, drawn by chance: the share is then known to a hundredth."""

_FAINT = 1e-3
"""Of an image's brightest pixel: pixels with less do not say how large errors on the target are."""

_RAYS_PER_PIXEL, _AT_ONCE = 2.0, 4


def undetermined(run: Run) -> float:
    """Share of the points whose height along the normal the training images leave open by more than a resolution cell.

    Raises `UndefinedScore` of runs that have no Gaussians, points or training images, or were learned from phases.
    """
    return float(places(run)[1].mean())


def places(run: Run) -> tuple[Float32[np.ndarray, "p 3"], Bool[np.ndarray, " p"]]:
    """Some of the points, drawn by chance, and whether each is left open."""
    model = run.model
    if model is None:
        raise UndefinedScore("only of Gaussians it is known how images depend on the surface")
    points = run.points
    if len(points) == 0 or "train" not in run.dataset.splits():
        raise UndefinedScore("there are no points, or no training images")
    train = run.dataset.select("train")
    if train.interferometric or len(model.frame.views) != len(train.views):
        raise UndefinedScore("heights come from phases, or from other images than the dataset's")
    cell_m = model.frame.grid.cell_m
    some = points[np.random.default_rng(0).permutation(len(points))[:_PLACES]]
    distance, nearest = cKDTree(points).query(model.parameters["means"].detach().cpu().numpy())
    outwards = np.where((distance < 2 * cell_m)[:, None], run.normals[nearest], 0).astype(np.float32)
    information = _information(model, run.iteration, torch.from_numpy(outwards).to(model.device), train.power)
    means = model.parameters["means"].detach().cpu().double().numpy()
    return some, _known(means, information, some, cell_m) < 1


def _information(
    model: SceneModel, iteration: int, outwards: Float[Tensor, "n 3"], power: Float[np.ndarray, "v rows columns"]
) -> Float64[np.ndarray, " n"]:
    """What each Gaussian adds to the information on a height that all have in common, per squared resolution cell."""
    model, grid, degree = model.copy(), model.frame.grid, model.degree(iteration)
    means, rays = model.parameters["means"], RayGrid.for_image(model.frame.grid, _RAYS_PER_PIXEL)
    here, step = means.detach().clone(), _MOVED * grid.cell_m * outwards
    total = torch.zeros(len(here), dtype=torch.float64, device=here.device)

    def amplitudes(few: slice, centres: Tensor) -> Tensor:
        means.data.copy_(centres)
        numbers = torch.arange(len(power))[few].to(model.device)
        images, _ = model.render(model.frame.views[few], grid, degree, rays=rays, numbers=numbers)
        return channel_of(images, model.power_channel).clamp(min=1e-12 * float(power.max())).sqrt()

    for few in in_groups(len(power), _AT_ONCE, model.parameters, grid, rays):
        true = torch.from_numpy(np.sqrt(power[few])).to(here)
        with torch.no_grad():
            change = (amplitudes(few, here + step) - amplitudes(few, here - step)) / (2 * _MOVED)
        ours = amplitudes(few, here)
        shown = true**2 > _FAINT * (true**2).amax((1, 2), keepdim=True)
        error = ((ours.detach() - true) ** 2 * shown).sum((1, 2)) / shown.sum((1, 2)).clamp(min=1)
        (slope,) = torch.autograd.grad((change / error[:, None, None].clamp(min=1e-30) * ours).sum(), [means])
        total += (slope * outwards).sum(1).double() * grid.cell_m
    return total.cpu().numpy()


def _known(
    means: Float64[np.ndarray, "n 3"],
    information: Float64[np.ndarray, " n"],
    places: Float[np.ndarray, "p 3"],
    cell_m: float,
) -> Float64[np.ndarray, " p"]:
    """The information of each place's surroundings, less what may be chance."""
    cubes = np.floor(means / cell_m).astype(np.int64)
    cubes -= cubes.min(axis=0)
    _, owner, count = np.unique(
        np.ravel_multi_index(tuple(cubes.T), cubes.max(axis=0) + 1), return_inverse=True, return_counts=True
    )
    each = np.bincount(owner, information)
    middles = np.stack([np.bincount(owner, axis) for axis in means.T], axis=1) / count[:, None]
    reach = _AROUND * cell_m
    near = cKDTree(places).sparse_distance_matrix(cKDTree(middles), reach, output_type="ndarray")
    parts = (1 - (near["v"] / reach) ** 2) * each[near["j"]]
    known, by_chance = (np.bincount(near["i"], of, len(places)) for of in (parts, parts**2))
    return known - _SURE * np.sqrt(by_chance)
