"""Azimuths of test images, found by comparing each with predictions from all around."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.evaluation.images import Stack, UndefinedScore
from sarsplat.evaluation.matching import Matcher
from sarsplat.evaluation.templates import extents_m, floored, predicted, require_memory, window_around
from sarsplat.geometry import View
from sarsplat.runs import Run

STEP_DEG = 2.0
"""Step between the azimuths of predictions, degrees."""

CLOSE_DEG, REVERSED_DEG = 5.0, 135.0
"""Error up to which an azimuth counts as found, and beyond which as reversed, degrees."""

FEWEST = 100
"""Minimum number of images of a set: predictions from all around take as long as theirs, and shares need many."""


def around(view: View, count: int) -> list[View]:
    """Return views that differ in azimuth alone, evenly spaced from 0."""
    return [replace(view, azimuth_deg=360.0 * k / count) for k in range(count)]


def without_azimuth(view: View, grazing_deg: float | None = None) -> View:
    """Return a view at azimuth 0, its other angles in whole degrees so that images share predictions."""
    lowest = -89 if view.aloft else 1
    grazing = float(min(max(round(view.grazing_deg), lowest), 89)) if grazing_deg is None else grazing_deg
    return replace(view, azimuth_deg=0.0, grazing_deg=grazing, tilt_deg=float(round(view.tilt_deg)))


def signed(angles_deg: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Return angles in [−180, 180), degrees."""
    return (angles_deg + 180) % 360 - 180


def azimuth_errors(
    run: Run, tested: Dataset, predictors: Sequence[Callable[[Sequence[View]], Stack]]
) -> list[Float64[np.ndarray, " v"]]:
    """Find the azimuths of test images by predicted images, as `sarsplat.locate` does by those of one run.

    Masks of the run say where target and shadow may be; predictors return linear power of any views on the images'
    grid. Return the errors [V] by each predictor, degrees in [−180, 180). Raise `UndefinedScore` if there are few
    images, or these are too small, too large for the memory, or black around the origin.
    """
    if len(tested) < FEWEST:
        raise UndefinedScore(f"azimuths are found in sets of at least {FEWEST} images; these are {len(tested)}")
    found, views = np.empty((len(predictors), len(tested))), [without_azimuth(view) for view in tested.views]
    steps = round(360 / STEP_DEG)
    for view in dict.fromkeys(views):
        try:
            window = window_around(extents_m([run], view), [tested.grid, run.grid])
            require_memory(window, steps, "give smaller images")
        except SarsplatError as error:
            raise UndefinedScore(str(error)) from error
        if not (window.cut(tested.power, tested.grid).max(axis=(1, 2)) > 0).all():
            raise UndefinedScore("an image is black around the origin, where its target would be; remove it")
        cut = window.cut(tested.power, tested.grid, window.margins)
        members = [k for k, one in enumerate(views) if one == view]
        for azimuths, predict in zip(found, predictors, strict=True):
            images = predicted(predict, around(view, steps), window, tested.grid)
            if not images.any(axis=(1, 2)).all():
                raise UndefinedScore("the prediction is black around the origin; reconstruct with a noise floor")
            matcher = Matcher([floored(images)], window)
            azimuths[members] = [matcher(cut[k]).azimuth_deg[0] for k in members]
    return [*signed(found - np.array([view.azimuth_deg for view in tested.views]))]
