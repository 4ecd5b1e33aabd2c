"""2D baselines for measured images: nearest chip and rotated average."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64, Real
from scipy.ndimage import map_coordinates

from sarsplat.data import Dataset
from sarsplat.evaluation.images import smoothed
from sarsplat.evaluation.metrics import IMAGE_METRICS, ImagePair, compute_all, image_parameters
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import LEAST_POWER

_KERNEL = 0.4
"""Width σ of the azimuth kernel of `rotated_average`, in mean spacings 360°/K of the training chips.

This width and the 5×5 mean were chosen on the scored chips of the T72 (K = 8 and 36), which favours the baseline. The
likelihood is flat around it: within 0.003 nats from 0.36 to 0.44 (K = 8) and from 0.4 to 0.6 (K = 36).
"""


def nearest_chip(
    train: Real[np.ndarray, "k rows columns"], train_views: Sequence[View], views: Sequence[View]
) -> Float[np.ndarray, "v rows columns"]:
    """Predict each view by the training chip nearest in azimuth, of the same side and tilt, smoothed by a 5×5 mean.

    Parameters
    ----------
    train : numpy.ndarray, float [K, rows, columns]
        β⁰ power of the training chips.
    train_views, views : sequence of View
        Views of the training chips, and views to predict.

    Returns
    -------
    numpy.ndarray, float [V, rows, columns]
        Predicted mean power.
    """
    other = [[(a.side != b.side) * 360 + abs(a.tilt_deg - b.tilt_deg) for a in train_views] for b in views]
    return smoothed(train, 5, 5)[(np.abs(_turn_deg(train_views, views)) + other).argmin(axis=1)]


def rotated_average(
    train: Real[np.ndarray, "k rows columns"], train_views: Sequence[View], views: Sequence[View], grid: ImageGrid
) -> Float64[np.ndarray, "v rows columns"]:
    """Predict each view by averaging training chips, smoothed by a 5×5 mean and rotated in the ground plane.

    The weights are a Gaussian of the azimuth difference with σ = 0.4·360°/K. Targets and shadows are treated as flat.

    Parameters
    ----------
    train, train_views, views :
        As in `nearest_chip`.
    grid : ImageGrid
        Pixels of all chips.

    Returns
    -------
    numpy.ndarray, float64 [V, rows, columns]
        Predicted mean power.
    """
    smooth, turns = smoothed(train, 5, 5), _turn_deg(train_views, views)
    weights = np.exp(-0.5 * (turns / (_KERNEL * 360 / len(train))) ** 2)
    weights[np.arange(len(views)), np.abs(turns).argmin(axis=1)] += 1e-9  # far from every chip: take the nearest
    predicted = np.zeros((len(views), *train.shape[1:]))
    for image, view, turn, weight in zip(predicted, views, turns, weights):
        near = [int(k) for k in np.flatnonzero(weight > 1e-3 * weight.max())]
        for k in near:
            image += weight[k] / weight[near].sum() * _turned(smooth[k], train_views[k], view, turn[k], grid)
    return predicted


def levelled_average(train: Dataset, views: Sequence[View]) -> Float64[np.ndarray, "v rows columns"]:
    """Predict each view by the rotated average of images over their medians, as scales of chips may differ."""
    median, mean = (of(train.power, axis=(1, 2), keepdims=True).astype(np.float64) for of in (np.median, np.mean))
    levels = np.where(median > 0, median, np.maximum(mean, LEAST_POWER))  # of images that are black in part
    return rotated_average(train.power / levels, train.views, views, train.grid)


def baseline_scores(dataset: Dataset, reasons: dict[str, str]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Scores `[set][baseline][metric]` of `nearest_chip` and `rotated_average` on every test set of measured images.

    Metrics are those of speckled images; for each undefined score, `reasons` gets `baselines.<set>.<baseline>.<score>`
    and why.
    """
    train, train_views = dataset.images("train").astype(np.float64), dataset.select("train").views
    applicable = [metric for metric in IMAGE_METRICS if metric.requires.met(dataset)]
    parameters = image_parameters(dataset)
    scores: dict[str, dict[str, dict[str, float | None]]] = {}
    for split in dataset.splits():
        if split == "train":
            continue
        views = dataset.select(split).views
        predictions = {
            "nearest_chip": nearest_chip(train, train_views, views),
            "rotated_average": rotated_average(train, train_views, views, dataset.grid),
        }
        scores[split] = {}
        for name, predicted in predictions.items():
            pair = ImagePair(dataset.images(split), predicted, **parameters)
            prefix = f"baselines.{split}.{name}."
            scores[split][name] = compute_all(applicable, dataset, pair, prefix, reasons)
    return scores


def _turn_deg(train_views: Sequence[View], views: Sequence[View]) -> Float64[np.ndarray, "v k"]:
    """Azimuth of each training view minus that of each predicted view, degrees in [−180, 180), [V, K]."""
    train, predicted = (np.array([view.azimuth_deg for view in sequence]) for sequence in (train_views, views))
    turns = (train[None] - predicted[:, None] + 180) % 360 - 180
    return turns.round(6)  # equal distances must tie exactly, so that the first chip wins


def _turned(
    power: Real[np.ndarray, "{grid.rows} {grid.columns}"], source: View, target: View, turn_deg: float, grid: ImageGrid
) -> Float64[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Resample a chip seen from `source` as if flat on the ground and seen from `target`."""
    slant, across = np.meshgrid(grid.range_m, grid.azimuth_m, indexing="ij")
    across, ground = target.look.to_ground(across, slant)
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    across_source, slant_source = source.look.to_image(cosine * across + sine * ground, cosine * ground - sine * across)
    row = (slant_source - grid.range_m[0]) / grid.spacing_m[1]
    column = (across_source - grid.azimuth_m[0]) / grid.spacing_m[0]
    return map_coordinates(power, [row, column], order=1, mode="nearest")
