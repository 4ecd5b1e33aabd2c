"""Heights that the images do not determine, and objects that the images show and the points lack.

By Fisher information: if a surface moved along its normals, images would change at its edges and texture, but not
inside a uniform roof. The information on a place's height is the change of the images by its surroundings, relative to
their residual. In the sum over the surroundings, changes by the grain of the Gaussians nearly cancel; fainter texture
counts as none.

For missing objects, the images are compared with a rendering that omits Gaussians farther than 1.5 cells from every
point. A place shows a missing object if the excess, averaged over the views in dB, exceeds 3 dB and 6 standard
deviations of its noise. Patches connected at half of that are one object.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.ndimage import center_of_mass, label, maximum
from scipy.spatial import cKDTree
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.evaluation.images import UndefinedScore
from sarsplat.geometry import RayGrid
from sarsplat.learning.batching import in_groups
from sarsplat.learning.model import SceneModel
from sarsplat.radiometry import to_db, usual_peak
from sarsplat.regions.image_levels import seen_by_all, smoothed, typical, values_at
from sarsplat.renderer import channel_of
from sarsplat.runs import Run

_RADIUS = 4.0  # radius of a place's surroundings, resolution cells
_SURE = 1.0  # standard errors subtracted from the information, for changes that cancel only on average
_MOVED = 0.1  # movement of the surface in either direction, resolution cells
_PLACES = 4000  # maximum number of random points tested; the share is then accurate to 0.01
_FAINT = 1e-3  # minimum power of the pixels that measure the residual, relative to the image's brightest

_RAYS_PER_PIXEL, _MAX_BATCH = 2.0, 4

_REACH = 1.5  # maximum distance of a Gaussian from the nearest point that represents it, resolution cells
_EXCESS_DB = 3.0  # minimum mean excess of the images, dB
_SURE_EXCESS = 6.0  # minimum mean excess of the images, standard deviations of its noise over all places
_FAINT_ADDED = 1e-3  # minimum power added to both images before their ratio, relative to the usual peak
_SIDE = 128  # maximum number of places along a side of the scene
_VIEWS = 24  # maximum number of views compared


def undetermined(run: Run) -> float:
    """Share of the points whose height along the normal is uncertain by more than a resolution cell.

    Raises `UndefinedScore` if the run has no Gaussians, points or training images, or was learned from phases.
    """
    return float(places(run)[1].mean())


def places(run: Run) -> tuple[Float32[np.ndarray, "p 3"], Bool[np.ndarray, " p"]]:
    """Random points, and a mask of those whose height is not determined."""
    model, train = _learned(run)
    points, cell_m = run.points, model.frame.grid.cell_m
    if len(points) == 0:
        raise UndefinedScore("there are no points")
    tested = points[np.random.default_rng(0).permutation(len(points))[:_PLACES]]
    distance, nearest = cKDTree(points).query(model.parameters["means"].detach().cpu().numpy())
    outwards = np.where((distance < 2 * cell_m)[:, None], run.normals[nearest], 0).astype(np.float32)
    information = _information(model, run.iteration, torch.from_numpy(outwards).to(model.device), train.power)
    means = model.parameters["means"].detach().cpu().double().numpy()
    return tested, _known(means, information, tested, cell_m) < 1


def _learned(run: Run) -> tuple[SceneModel, Dataset]:
    """Model of a run and its training images; raise `UndefinedScore` if power of these images did not make it."""
    if run.model is None:
        raise UndefinedScore("the dependence of images on the surface is known for Gaussians only")
    if "train" not in run.dataset.splits():
        raise UndefinedScore("there are no training images")
    train = run.dataset.select("train")
    if train.interferometric or len(run.model.frame.views) != len(train.views):
        raise UndefinedScore(
            "the training images are interferometric stacks, or the dataset has changed since the training"
        )
    return run.model, train


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


# ---- missing objects ----
def missing(run: Run) -> Float64[np.ndarray, "k 3"]:
    """Places of objects that images show and points lack, m, brightest first.

    Raises `UndefinedScore` if the run has no Gaussians; if its training images are stacks, have changed, or do not show
    the origin.
    """
    model, train = _learned(run)
    grid = model.frame.grid
    half = seen_by_all(model.frame.views, grid)
    if half <= 0:
        raise UndefinedScore("not all training images show the world's origin")
    region, terrain = model.frame.region, model.frame.terrain
    side = np.linspace(-half, half, min(_SIDE, 2 * int(half / grid.cell_m) + 1))
    heights = np.arange(region.low[2], region.high[2], max(grid.cell_m, np.ptp(side) / _SIDE))
    places = np.stack(np.meshgrid(heights, side, side, indexing="ij"), axis=-1)[..., ::-1].copy()
    if terrain is not None:
        places[..., 2] += terrain.height_m(places[..., 0], places[..., 1])
    degree, rays, without = model.degree(run.iteration), RayGrid.for_image(grid, _RAYS_PER_PIXEL), _without_far(run)
    faint, mean_db = _FAINT_ADDED * usual_peak(train.power), np.zeros(places.shape[:-1])
    chosen = np.unique(np.linspace(0, len(train.views) - 1, min(len(train.views), _VIEWS)).round().astype(int))
    for k in chosen:  # one at a time: memory stays small
        view, number = model.frame.views[k], torch.tensor([k], device=model.device)
        with torch.no_grad():
            image, _ = without.render([view], grid, degree, rays=rays, numbers=number)
        true = smoothed(train.power[[k]], grid)
        rendered = smoothed(channel_of(image, model.power_channel).cpu().numpy(), grid)
        dark = max(np.median(true), faint)  # added to both, so that the ratio is near 0 dB where both are dark
        excess_db = to_db(true + dark, rendered + dark)[0]
        shift = model.shot([view], grid, number).shift
        dx, dy = (0.0, 0.0) if shift is None else shift[0].tolist()
        displaced = replace(grid, center_m=(grid.center_m[0] - dx, grid.center_m[1] - dy))
        mean_db += np.nan_to_num(values_at(excess_db, view, displaced, places)) / len(chosen)
    least_db = max(_EXCESS_DB, _SURE_EXCESS * typical(mean_db)[1])
    return places[tuple(_middles(mean_db, least_db).T)]


def _middles(mean_db: Float64[np.ndarray, "z y x"], least_db: float) -> Int64[np.ndarray, "k 3"]:
    """Indices of the middles of parts above a level, brightest first; parts connected at half of it are one."""
    parts, count = label(mean_db > least_db / 2)
    peaks_db = np.asarray(maximum(mean_db, parts, np.arange(1, count + 1)))
    brightest = 1 + np.argsort(-peaks_db, kind="stable")[: np.count_nonzero(peaks_db > least_db)]
    return np.array(center_of_mass(mean_db, parts, brightest)).reshape(-1, 3).round().astype(np.int64)


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
