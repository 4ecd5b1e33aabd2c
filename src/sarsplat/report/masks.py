"""Unseen images with the outlines of target and shadow, true and predicted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from sarsplat.data import read_masks
from sarsplat.evaluation import UndefinedScore, predicted_masks
from sarsplat.report.figure import Block, Figure, polyline
from sarsplat.report.images import Part, power_bar, view_name
from sarsplat.report.views import evenly
from sarsplat.runs import Run

_VIEWS = 8
_LARGEST = 256
_MARGIN = 5  # pixels around everything that a mask shows
_KINDS = {1: "target", 2: "shadow"}

Mask = UInt8[np.ndarray, "rows columns"]


def masks_figure(run: Run, folder: Path) -> Figure | None:
    """Test images with the outlines of the true masks in a folder and of the predicted ones; None if there are none."""
    dataset = run.dataset
    masks = read_masks(folder, dataset)
    given = list(masks)
    chosen = [given[index] for index in evenly(len(given), _VIEWS)]
    looks = dataset.select(dataset.entries[chosen[0]].split).looks
    images = replace(dataset.take(chosen), looks=looks, clean_tests=False)
    try:
        predicted = predicted_masks(run, images, run.render(images.views))
    except UndefinedScore:  # the evaluation gives the reason
        return None
    truth = np.stack([masks[index] for index in chosen])
    anything = np.maximum(truth, predicted).max(axis=0)
    rows, columns = (_window(anything.max(axis=1 - axis)) for axis in (0, 1))
    part = Part.of(dataset.grid, (rows, columns), _LARGEST)
    peak = float(dataset.images("train").max())
    panels = []
    for image, view, true, own in zip(images.power, images.views, truth, predicted, strict=True):
        drawing = _outlines(true[rows, columns], "true") + _outlines(own[rows, columns], "own")
        alt = f"{view_name(view)}, with the outlines of the true and the predicted target and shadow"
        panels.append(part.power(view_name(view), alt, image, peak, drawing))
    text = (
        f"{len(chosen)} of {len(given)} test views with true masks, evenly chosen. The predicted outlines are those of "
        "the learned geometry"
    )
    if looks is not None:
        text += ", shifted by whole pixels to where the rendered image fits the measured one best"
    return Figure("Target and shadow", f"{text}.", (Block("", tuple(panels)),), (power_bar(),), legend="outlines")


def _outlines(mask: Mask, whose: str) -> str:
    """The outlines of target and shadow as SVG, in a square that the mask fills."""
    from skimage.measure import find_contours

    drawn = ""
    rows, columns = mask.shape
    for value, name in _KINDS.items():
        present = np.pad((mask == value).astype(float), 1)
        for line in find_contours(present, 0.5):
            places = line - 0.5  # pixel k of the padded mask has its centre at k − 0.5 pixels of the mask
            drawn += polyline(places[:, 1] / columns, 1 - places[:, 0] / rows, f"outline {whose} {name}")
    return drawn


def _window(present: UInt8[np.ndarray, " n"]) -> slice:
    """Bounding rows and columns of the set pixels, with a margin; the whole image if none is set."""
    covered = np.flatnonzero(present)
    if len(covered) == 0:
        return slice(0, len(present))
    return slice(max(int(covered[0]) - _MARGIN, 0), min(int(covered[-1]) + 1 + _MARGIN, len(present)))
