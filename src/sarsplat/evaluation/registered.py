"""Registered scores of measured chips: they ignore a chip's position and gain, which cannot be predicted.

Chips are centred and scaled one by one, to within a pixel and a few tenths of their power. These errors say nothing
about a model but dominate its scores, so each prediction is shifted by whole pixels and multiplied by one factor to fit
its chip best; all methods are treated the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from sarsplat.evaluation.images import (
    Stack,
    UndefinedScore,
    check_positive,
    check_stacks,
    inside,
    smoothed,
    standardised,
)

REACH = 3
"""Largest shift of a prediction along each axis, pixels."""


@dataclass(frozen=True)
class Registration:
    """Shift and gain with which predictions fit their chips best."""

    nats: Float64[np.ndarray, " v"]
    """Negative log-likelihood of single-look speckle, nats per pixel."""
    shift: Int64[np.ndarray, "v 2"]
    """How far each prediction was moved, pixels in range and in azimuth."""
    gain: Float64[np.ndarray, " v"]
    """Factor applied to each prediction."""


def register(truth: Stack, rendered: Stack, margin: int = 0) -> Registration:
    """Move and scale predictions so that their chips become most likely.

    Moved by up to three pixels each way (rolled on the full chip, then the margin is cut off), and multiplied by
    g = mean(I / S), which is best for speckle: then log gS + I / (gS) has the mean log g + mean(log S) + 1.

    Parameters
    ----------
    truth : numpy.ndarray, float [V, rows, columns]
        Measured power I, speckle and all.
    rendered : numpy.ndarray, float [V, rows, columns]
        Predicted mean power S > 0, in any unit.
    margin : int
        Pixels excluded on each side.

    Raises
    ------
    UndefinedScore
        If S is zero where it may be moved to, a chip is black, or nothing is left inside the margin.
    """
    check_stacks(truth, rendered)
    measured = inside(truth.astype(np.float64), margin)
    predicted = _reachable(rendered.astype(np.float64), margin)
    if not measured.any(axis=(1, 2)).all():
        raise UndefinedScore("a true image is black inside the margin, so no gain suits it; remove it")
    shifts, nats, gains = [], [], []
    for (shift, log), (_, weight) in zip(_moved(np.log(predicted), margin), _moved(1 / predicted, margin), strict=True):
        gain = np.einsum("vrc,vrc->v", measured, weight) / measured[0].size
        shifts.append(shift)
        gains.append(gain)
        nats.append(np.log(gain) + log.mean(axis=(1, 2)) + 1)
    best, chip = np.argmin(nats, axis=0), np.arange(len(truth))
    return Registration(np.array(nats)[best, chip], np.array(shifts)[best], np.array(gains)[best, chip])


def registered_log_correlation(truth: Stack, rendered: Stack, margin: int = 0) -> float:
    """`log_correlation` with each prediction shifted to its best fit; it does not depend on the gain.

    Raises
    ------
    UndefinedScore
        If a 3×3 mean is zero where it may be moved to, or nothing is left inside the margin.
    """
    check_stacks(truth, rendered)
    measured, predicted = inside(smoothed(truth), margin), _reachable(smoothed(rendered), margin)
    check_positive(measured, "true")
    log = standardised(np.log(measured))
    correlations = [(log * standardised(moved)).mean(axis=(1, 2)) for _, moved in _moved(np.log(predicted), margin)]
    return float(np.mean(np.max(correlations, axis=0)))


def _reachable(predicted: Float64[np.ndarray, "v rows columns"], margin: int) -> Float64[np.ndarray, "v wide high"]:
    """The pixels that a shift can bring inside the margin; refused if any is zero."""
    reachable = inside(predicted, max(margin - REACH, 0))
    check_positive(reachable, "predicted")
    return reachable


def _moved(
    images: Float[np.ndarray, "v rows columns"], margin: int
) -> Iterator[tuple[tuple[int, int], Float[np.ndarray, "v fewer_rows fewer_columns"]]]:
    """Every shift, and the images rolled by it, cut to the margin."""
    margin = min(margin, REACH)
    rows, columns = images.shape[1:]
    wrapped = np.pad(images, ((0, 0), (REACH, REACH), (REACH, REACH)), mode="wrap")
    first = REACH + margin
    for down in range(-REACH, REACH + 1):
        for right in range(-REACH, REACH + 1):
            top, left = first - down, first - right
            yield (down, right), wrapped[:, top : top + rows - 2 * margin, left : left + columns - 2 * margin]
