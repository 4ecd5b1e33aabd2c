"""Whether images are on one scale, and hold all that was brighter: pixels cut off at the largest value, pictures that
were stretched one by one, and single images of another scale.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int, Real

from sarsplat.data import Dataset
from sarsplat.errors import counted
from sarsplat.examination.outcome import Examination
from sarsplat.radiometry import LEAST_POWER, to_db

_CUT_OFF = 0.01
"""Share of an image at its largest value from which on what is cut off is as large as a target: one or two per cent."""

MUCH = 0.1
"""Share from which on ground is cut off, too, and its statistics say nothing."""

CUT_OFF_SAID = 1e-3
"""Share of all pixels from which on it is said that some are cut off."""

_FEW = 4
"""Pixels at the largest value of an image that say nothing."""

_FEWEST = 5
"""Images: of fewer, nothing is said of what they have in common."""

_UNLIKELY = 0.01
"""Probability by chance: pictures of a common scale that is cut off at all are few already."""

_SAME_MEAN = 1e-4
"""Relative difference of mean power, to which it is the same: it is rounded to 8 bits after that."""

_OTHER_DB = 8.0
_OTHER_DEVIATIONS = 8.0
"""By how much the ground of one image may differ from that of the others: gains of measured chips differ by 3 dB."""

_CONTRASTS = (0.72, 1.39)
"""Standard deviation over mean of the ground, of one image over that of the others, within which they agree. Of a root
or of a square it is 0.5 or 1.8 times as large; honest images of one set have 0.93 to 1.2."""

_QUANTILES = (0.5, 0.75, 0.9)
"""Levels of an image that another scale moves by the same: shadow, or a large target, moves some of them."""

_OWN_SCALES = ("mstar", "sample")
"""Kinds of datasets whose images are known to have scales of their own, which are learned with `--preset measured`."""

_ONE_SCALE = (
    "give them on one scale, or the factor of each in a column of the table (--columns scale=NAME); if neither is "
    "known, reconstruct with --preset measured, which learns a gain for each"
)


def examine_scaling(dataset: Dataset, examined: Examination, speckled: bool, cut_off: float) -> None:
    """Add contradictions of images that are stretched one by one, or of another scale than the others.

    `speckled` says whether their ground has speckle: two images of it never have the same mean. `cut_off` is the share
    of pixels that hold the largest value: where they are a whole target, their number says nothing.
    """
    if dataset.source.get("kind") in _OWN_SCALES:
        return
    wrong = [
        *(_stretched(dataset, speckled) if cut_off < _CUT_OFF else ()),
        *_other_level(dataset),
        *(_other_contrast(dataset) if speckled else ()),
    ]
    examined.conclude("scale", wrong, "no image seems to have another scale than the others")


def examine_cut_off(dataset: Dataset, examined: Examination) -> float:
    """Add a contradiction if much is cut off at the largest value; returns the largest share of an image that is."""
    shares = np.array([share_at_top(image) for image in _parts(dataset)])
    some = f"{shares.mean():.2%} of the pixels, which hold the largest value of their image, were cut off"
    examined.conclude(
        "largest values", _cut_off(dataset, shares), some if shares.mean() >= CUT_OFF_SAID else "not cut off"
    )
    return float(shares.max())


def _parts(dataset: Dataset) -> Real[np.ndarray, "v rows columns"]:
    """What would be cut off: power, or of complex amplitudes the larger of both parts."""
    if dataset.signal is None:
        return dataset.power
    larger = np.maximum(np.abs(dataset.signal.real), np.abs(dataset.signal.imag))
    return larger[:, 0] if dataset.passes else larger


def share_at_top(image: Real[np.ndarray, "rows columns"]) -> float:
    """Share of the pixels that hold the largest value, if more do than hold values just below it; 0 otherwise."""
    largest = image.max()
    count = int((image == largest).sum())
    if count <= _FEW or count == image.size:
        return 0.0
    below = np.unique(image[image < largest], return_counts=True)[1][-_FEW:]
    return count / image.size if count > 2 * below.mean() else 0.0


def _cut_off(dataset: Dataset, shares: Float64[np.ndarray, " v"]) -> list[str]:
    cut = shares >= _CUT_OFF
    if not cut.any():
        return []
    worst = int(shares.argmax())
    return [
        f"{shares[worst]:.1%} of the pixels of {dataset.entries[worst].name} hold its largest value, and at least "
        f"{_CUT_OFF:.0%} in {cut.sum()} of {counted(len(dataset), 'image')}: what is brighter was cut off, as large an "
        "area as a target; save the images again with a smaller factor, or in more bits"
    ]


def _stretched(dataset: Dataset, speckled: bool) -> list[str]:
    """Whether each image was scaled by its own brightest pixel, by a share of its pixels, or by its mean."""
    if len(dataset) < _FEWEST or dataset.calibration != "relative":
        return []
    peaks = dataset.power.max(axis=(1, 2))
    tops = np.array([(image == peak).sum() for image, peak in zip(dataset.power, peaks, strict=True)])
    same_peak = float(np.ptp(peaks)) <= 1e-6 * float(peaks.max())
    means = dataset.power.mean(axis=(1, 2), dtype=np.float64)
    by = ""
    if same_peak and _too_alike(tops, dataset.power[0].size) and tops.max() < dataset.power[0].size:
        by = f"as many pixels of each, {np.median(tops):g} of {dataset.power[0].size}, have the same largest value"
    elif speckled and np.ptp(means) <= _SAME_MEAN * means.mean():
        by = "all have the same mean power"
    if not by:
        return []
    return [f"the images seem to be stretched one by one, for {by}; {_ONE_SCALE}"]


def _too_alike(counts: Int[np.ndarray, " v"], pixels: int) -> bool:
    """Whether numbers of pixels that exceed one level differ less than they would by chance."""
    from scipy.special import bdtr  # here: see `with_data`

    share = float(counts.mean()) / pixels
    within = bdtr(counts.max(), pixels, share) - bdtr(counts.min() - 1, pixels, share)
    return bool(within ** len(counts) < _UNLIKELY)


def _other_level(dataset: Dataset) -> list[str]:
    """Single images whose ground is far brighter or darker than that of all others."""
    if len(dataset) < _FEWEST or not dataset.ground:
        return []
    levels = to_db(np.quantile(dataset.power, _QUANTILES, axis=(1, 2)), least=LEAST_POWER)
    each = levels - np.median(levels, axis=1, keepdims=True)
    alike = (np.sign(each) == np.sign(each[0])).all(axis=0)
    away = np.where(alike, np.sign(each[0]) * np.abs(each).min(axis=0), 0.0)
    usual = 1.4826 * float(np.median(np.abs(away)))
    other = np.abs(away) > max(_OTHER_DB, _OTHER_DEVIATIONS * usual)
    if not other.any() or 4 * other.sum() > len(dataset):
        return []
    worst = int(np.where(other, np.abs(away), 0).argmax())
    many = f" ({counted(int(other.sum()), 'image')} of {len(dataset)} are that far off)" if other.sum() > 1 else ""
    return [
        f"the ground of {dataset.entries[worst].name} is {abs(away[worst]):.1f} dB "
        f"{'brighter' if away[worst] > 0 else 'darker'} than that of the others{many}, so it seems to be of another "
        f"scale or unit; {_ONE_SCALE}"
    ]


def _other_contrast(dataset: Dataset) -> list[str]:
    """Single images whose speckle is weaker or stronger than that of all others, as of amplitude among power."""
    from sarsplat.examination.units import clutter  # here: these need SciPy; see `with_data`
    from sarsplat.regions.outlines import levels_db, outline

    if dataset.clean_tests:
        dataset = dataset.select("train")
    views = range(len(dataset))
    if len(dataset) < _FEWEST:
        return []
    grounds = []
    for image in (dataset.power[k : k + 1] for k in views):
        levels = levels_db(image, dataset.grid, ground=True)
        grounds.append(clutter(image, levels, [outline(levels[0])], dataset.grid))
    fine = {k: ground.contrast for k, ground in zip(views, grounds, strict=True) if ground and not ground.coarse}
    if len(fine) < _FEWEST:
        return []
    usual = float(np.median(list(fine.values())))
    other = {
        k: contrast / usual for k, contrast in fine.items() if not _CONTRASTS[0] < contrast / usual < _CONTRASTS[1]
    }
    if not other or 2 * len(other) > len(fine):
        return []
    worst = max(other, key=lambda k: abs(math.log(max(other[k], np.finfo(float).tiny))))
    many = f" ({counted(len(other), 'image')} of {len(dataset)} differ as much)" if len(other) > 1 else ""
    as_if = "amplitude or smoothed" if other[worst] < 1 else "squared, or all others amplitude or smoothed"
    return [
        f"the standard deviation over mean of the ground of {dataset.entries[worst].name} is {fine[worst]:.2f}, and "
        f"that of the others {usual:.2f}{many}, as if it were {as_if}; give all images in one unit"
    ]
