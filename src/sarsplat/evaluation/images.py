"""Scores of rendered images against the truth: protocols R (rendered sets) and M (measured chips).

Every function takes two stacks of β⁰ power images, truth and rendered, [V, rows, columns], and returns one number: the
score of each image, averaged over the V images. Where a score does not exist they raise `UndefinedScore`; they never
return NaN or infinity.

The scores of protocol R compare *amplitudes*, √β⁰ divided by the largest amplitude of the training set, without
clipping; the peak of PSNR and the data range of SSIM are 1. The scores of protocol M compare *powers*.

Registered scores ignore position and gain of measured chips, which were centred and scaled one by one, to within a
pixel and a few tenths of their power. These errors would dominate the scores, so each prediction is shifted by whole
pixels and multiplied by one factor to fit its chip best.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, Real
from scipy.ndimage import correlate
from scipy.ndimage import shift as displaced

from sarsplat.arguments import check_number
from sarsplat.data import Dataset, Masks
from sarsplat.errors import SarsplatError
from sarsplat.learning.losses import SSIM_WINDOW, structural_similarity
from sarsplat.radiometry import brighter, to_db
from sarsplat.runs import Run

Stack = Real[np.ndarray, "v rows columns"]
"""Images of V views; equal sizes within one call."""

TARGET_DYNAMIC_DB = 30.0
"""Dynamic range of the target's mask: true β⁰, dB below the test set's maximum."""

REACH = 3
"""Largest shift of a prediction along each axis, pixels."""

_REMEDIES = {
    "true": "raise zeros to the smallest power, or simulate with `ground_gamma0`",
    "predicted": "reconstruct with a noise floor (preset measured)",
}
"""Remedies where true or predicted power is zero."""

_SMALLEST_MSE = float(np.finfo(np.float32).eps) ** 2  # 138 dB: float32 images cannot be distinguished any better


class UndefinedScore(SarsplatError):
    """Error: the images are valid, but this score does not exist for them."""


def normalised_amplitude(power: Stack, reference_amplitude: float) -> Stack:
    """√power / reference_amplitude, float32, not clipped, for the scores of protocol R."""
    check_number("the reference amplitude", reference_amplitude, 0, above=True)
    return (np.sqrt(power, dtype=np.float32) / np.float32(reference_amplitude)).astype(np.float32, copy=False)


def psnr_db(truth: Stack, rendered: Stack, reference_amplitude: float) -> float:
    """Peak signal-to-noise ratio of the whole image, dB: −10·log10 of each image's mean square error, averaged.

    Parameters
    ----------
    truth, rendered : numpy.ndarray, float [V, rows, columns]
        β⁰, linear power.
    reference_amplitude : float
        The largest amplitude √β⁰ of the *training* set: the peak.

    Returns
    -------
    float
        dB. An image reproduced to within float32 rounding counts as 138 dB instead of infinity.
    """
    _check_stacks(truth, rendered)
    squares = [one.mean(axis=(1, 2)) for one in _squares(truth, rendered, reference_amplitude)]
    return _mean_psnr(np.concatenate(squares))


def _squares(
    truth: Stack, rendered: Stack, reference_amplitude: float
) -> Iterator[Float64[np.ndarray, "1 rows columns"]]:
    """Yield squared differences of amplitudes image by image, to save memory."""
    for k in range(len(truth)):
        pair = (normalised_amplitude(power[k : k + 1], reference_amplitude) for power in (truth, rendered))
        yield np.square(np.subtract(*pair), dtype=np.float64)


def psnr_target_db(truth: Stack, rendered: Stack, reference_amplitude: float) -> float:
    """PSNR over the target alone, dB: pixels whose true β⁰ lies above −30 dB of the maximum of `truth`.

    The target fills 1–2 % of an image, which raises the PSNR of whole images by 17–20 dB. Parameters and returns as in
    `psnr_db`; images without target pixels are excluded.
    """
    _check_stacks(truth, rendered)
    if not truth.max() > 0:
        raise UndefinedScore("the true images are black everywhere, so there is no target to score; check the dataset")
    mask = brighter(truth, -TARGET_DYNAMIC_DB)
    pixels = mask.sum(axis=(1, 2))
    masked = zip(_squares(truth, rendered, reference_amplitude), mask, strict=True)
    squares = np.concatenate([np.sum(one, axis=(1, 2), where=on[None]) for one, on in masked])
    return _mean_psnr(squares[pixels > 0] / pixels[pixels > 0])


def ssim(truth: Stack, rendered: Stack, reference_amplitude: float) -> float:
    """Structural similarity of the amplitudes: Gaussian window 11×11, σ = 1.5, data range 1, borders reflected.

    Parameters as in `psnr_db`; returns the mean over the images, at most 1.
    """
    _check_stacks(truth, rendered)
    if min(truth.shape[1:]) < SSIM_WINDOW:
        raise UndefinedScore(
            f"SSIM's 11×11 window does not fit images of {truth.shape[1]} × {truth.shape[2]} pixels; use larger ones"
        )
    scores = []
    for pair in zip(truth, rendered, strict=True):  # one at a time, to save memory
        amplitudes = (normalised_amplitude(power[None], reference_amplitude)[0] for power in pair)
        padded = (np.pad(one, SSIM_WINDOW // 2, "reflect") for one in amplitudes)
        first, second = (torch.from_numpy(one).double()[None] for one in padded)
        scores.append(float(structural_similarity(second, first)))
    return float(np.mean(scores))


def nats_per_pixel(truth: Stack, rendered: Stack, margin: int = 0) -> float:
    """Single-look speckle likelihood: mean of log S + I/S; lower is better.

    Parameters
    ----------
    truth : numpy.ndarray, float [V, rows, columns]
        Measured power I, speckle and all, divided by the mean power of the training set.
    rendered : numpy.ndarray, float [V, rows, columns]
        Predicted mean power S > 0 in the same unit.
    margin : int
        Pixels excluded on each side.

    Returns
    -------
    float
        Nats per pixel: the negative log-likelihood of I exponentially distributed with mean S, inside the margin.

    Raises
    ------
    UndefinedScore
        If S is zero inside the margin (the likelihood of any return is then zero), or nothing is left inside it.
    """
    _check_stacks(truth, rendered)
    measured = _inside(truth.astype(np.float64), margin)
    predicted = _positive(rendered.astype(np.float64), margin, "predicted")
    return float(np.mean(np.log(predicted) + measured / predicted))


def log_correlation(truth: Stack, rendered: Stack, margin: int = 0) -> float:
    """Pearson correlation of the logarithms of 3×3 means of truth and rendered power, per chip, averaged.

    The means are taken on the full chip, then the margin is cut off. A constant image explains nothing and counts as 0.
    Parameters as in `nats_per_pixel` (the unit does not matter here).

    Raises
    ------
    UndefinedScore
        If a 3×3 mean is zero inside the margin, or nothing is left inside it.
    """
    _check_stacks(truth, rendered)
    logs = []
    for power, kind in ((truth, "true"), (rendered, "predicted")):
        logs.append(_standardised(np.log(_positive(smoothed(power), margin, kind))))
    return float(np.mean(logs[0] * logs[1]))


@dataclass(frozen=True)
class Registration:
    """Shift and gain with which predictions fit their chips best."""

    nats: Float64[np.ndarray, " v"]
    """Negative log-likelihood of single-look speckle, nats per pixel."""
    shift: Int64[np.ndarray, "v 2"]
    """Shift of each prediction, pixels in range and in azimuth."""
    gain: Float64[np.ndarray, " v"]
    """Factor applied to each prediction."""


def register(truth: Stack, rendered: Stack, margin: int = 0) -> Registration:
    """Shift and scale predictions to the maximum likelihood of their chips.

    Shifts are up to three pixels each way (rolled on the full chip, then the margin is cut off); the best gain is
    g = mean(I / S), with which log gS + I / (gS) has the mean log g + mean(log S) + 1.

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
    _check_stacks(truth, rendered)
    measured = _inside(truth.astype(np.float64), margin)
    predicted = _positive(rendered.astype(np.float64), max(margin - REACH, 0), "predicted")
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
    """`log_correlation`, as which it raises, with each prediction shifted to its best fit, of any gain."""
    _check_stacks(truth, rendered)
    predicted = _positive(smoothed(rendered), max(margin - REACH, 0), "predicted")
    log = _standardised(np.log(_positive(smoothed(truth), margin, "true")))
    correlations = [(log * _standardised(moved)).mean(axis=(1, 2)) for _, moved in _moved(np.log(predicted), margin)]
    return float(np.mean(np.max(correlations, axis=0)))


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


def _mean_psnr(mse: Float[np.ndarray, " v"]) -> float:
    return float(np.mean(-to_db(np.maximum(mse, _SMALLEST_MSE))))


def smoothed(power: Stack, rows: int = 3, columns: int = 3) -> Float64[np.ndarray, "v rows columns"]:
    """Means over windows of `rows` × `columns` pixels."""
    # not uniform_filter: its running sums leave rounding residues, even negative ones, where the mean is zero
    return correlate(power.astype(np.float64), np.full((1, rows, columns), 1 / (rows * columns)))


def _standardised(images: Float[np.ndarray, "v rows columns"]) -> Float[np.ndarray, "v rows columns"]:
    """Each image scaled to mean 0 and variance 1; a constant image becomes 0."""
    centred = images - images.mean(axis=(1, 2), keepdims=True)
    spread = centred.std(axis=(1, 2), keepdims=True)
    return np.divide(centred, spread, out=np.zeros_like(centred), where=spread > 0)


def _inside(power: Stack, margin: int) -> Real[np.ndarray, "v fewer_rows fewer_columns"]:
    """Images without `margin` pixels on each side."""
    rows, columns = power.shape[1:]
    if min(rows, columns) <= 2 * margin:
        raise UndefinedScore(
            f"a chip of {rows} × {columns} pixels has nothing left inside the margin of {margin} pixels; "
            f"use chips larger than {2 * margin} pixels"
        )
    return power[:, margin : rows - margin, margin : columns - margin]


def _check_stacks(truth: Stack, rendered: Stack) -> None:
    """Refuse stacks that differ in shape, are empty or hold negative or non-finite power."""
    if truth.shape != rendered.shape or truth.ndim != 3 or len(truth) == 0:
        raise SarsplatError(
            f"true images {truth.shape} and rendered images {rendered.shape} must be equal, "
            "non-empty stacks [views, rows, columns]"
        )
    for power, name in ((truth, "true"), (rendered, "rendered")):
        if not (np.isfinite(power) & (power >= 0)).all():
            raise SarsplatError(f"the {name} images hold negative or non-finite power; give β⁰ ≥ 0, linear")


def _positive(power: Stack, margin: int, kind: str) -> Real[np.ndarray, "v fewer_rows fewer_columns"]:
    """True or predicted images without `margin` pixels on each side; raise if any pixel left has no logarithm."""
    inside = _inside(power, margin)
    if zeros := int(np.count_nonzero(inside <= 0)):
        raise UndefinedScore(
            f"the {kind} power is zero at {zeros} of {inside.size} scored pixels, where its logarithm does not exist; "
            f"{_REMEDIES[kind]}"
        )
    return inside


@dataclass(frozen=True)
class MaskPair:
    """True and predicted masks of some images of one test set."""

    truth: Masks
    predicted: Masks
    """0 clutter, 1 target, 2 shadow; predicted masks are shifted like their registered images."""

    def iou(self, kind: int) -> float:
        """Intersection over union of one kind of pixels, mean over the images that have any (else `UndefinedScore`)."""
        truth, predicted = self.truth == kind, self.predicted == kind
        both, either = ((one.sum(axis=(1, 2))) for one in (truth & predicted, truth | predicted))
        if not either.any():
            raise UndefinedScore("neither the true nor the predicted masks have such pixels")
        return float(np.mean(both[either > 0] / either[either > 0]))


def predicted_masks(run: Run, images: Dataset, rendered: Stack) -> Masks:
    """Masks of a run for the images of one set, moved as `register` moves the rendered images if they are speckled.

    The position of a chip in its frame is thus estimated from its likelihood, never from true masks. Clutter moves in
    at the edges. Raises as in `register`.
    """
    masks = run.masks(images.views)
    if images.looks is None:
        return masks
    shifts = register(images.power, rendered, images.score_margin).shift
    return np.stack([displaced(mask, moved, order=0) for mask, moved in zip(masks, shifts, strict=True)])
