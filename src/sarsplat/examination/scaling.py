"""Checks of scale: pixels clipped at the largest value, images stretched one by one, single images of another scale."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int, Real

from sarsplat.data import Dataset
from sarsplat.data.dataset import DatasetEntry
from sarsplat.errors import SarsplatError, counted
from sarsplat.examination.outcome import Examination
from sarsplat.radiometry import LEAST_POWER, beta0_of_gamma0, from_db, to_db

_MIN_CLIPPED = 0.01  # clipped share of an image that is as large as a target

MUCH_CLIPPED = 0.1
"""Clipped share of an image that includes ground, which makes statistics of the ground meaningless."""

MIN_CLIPPED_REPORTED = 1e-3
"""Minimum clipped share of all pixels that is reported."""

_MAX_UNCLIPPED = 4  # maximum number of pixels at the largest value of an image without clipping
_MIN_IMAGES = 5  # minimum number of images for comparisons between them
_CHANCE = 0.01  # significance level: images clipped on a common scale are rare already
_SAME_MEAN = 1e-4  # relative tolerance of equal mean powers: rounding to 8 bits follows the normalisation

_OTHER_DB = 8.0
_OTHER_DEVIATIONS = 8.0
"""Maximum deviation of an image's ground from the others', dB and robust standard deviations: gains of measured chips
differ by 3 dB."""

_MAX_SPREAD_DB = 5.0  # maximum robust standard deviation of the ground in images of one scale, dB

_CONTRASTS = (0.72, 1.39)
"""Range of an image's ground contrast (standard deviation over mean) relative to that of the others. Measured: 0.93 to
1.2 within one set; 0.5 and 1.8 for square roots and squares."""

_REAL_SLOPES = (-2.0, 5.0)
"""Range of n in γ⁰ ~ sinⁿ θ of real ground: −1 of the same σ⁰ at all angles, 4 of a calm sea or a road."""

_LAW_STEP_DB = 0.5  # step of 10·log10(sin θ) within which grazing angles count as the same

_QUANTILES = (0.5, 0.75, 0.9)
"""Quantiles of an image that another scale moves alike; shadow or a large target moves only some."""

_OWN_SCALES = ("mstar", "sample")  # kinds of datasets with a known scale per image, which the preset "measured" learns

_ONE_SCALE = (
    "give them on one scale, or the factor of each in a column of the table (`columns={'scale': 'NAME'}`); if neither "
    "is known, `sarsplat check DATASET --levelled OUT` writes a copy whose ground has one level, or reconstruct with "
    "preset='measured', which learns a gain for each"
)


def examine_scaling(dataset: Dataset, examined: Examination, speckled: bool, cut_off: float) -> None:
    """Add contradictions of images that are stretched one by one, or of another scale than the others.

    With `speckled` ground, no two images have the same mean. `cut_off` is the largest clipped share of an image: where
    a whole target is clipped, the number of pixels proves nothing.
    """
    if dataset.source.get("kind") in _OWN_SCALES:
        return
    wrong = [
        *(_stretched(dataset, speckled) if cut_off < _MIN_CLIPPED else ()),
        *_other_level(dataset),
        *(_other_contrast(dataset) if speckled else ()),
    ]
    examined.conclude("scale", wrong, "no image seems to have another scale than the others")


def examine_cut_off(dataset: Dataset, examined: Examination) -> float:
    """Add a contradiction if many pixels are clipped; return the largest clipped share of an image."""
    shares = np.array([share_at_top(image) for image in _parts(dataset)])
    cut, worst, wrong = shares >= _MIN_CLIPPED, int(shares.argmax()), []
    if cut.any():
        wrong.append(
            f"{shares[worst]:.1%} of the pixels of {dataset.entries[worst].name} hold its largest value, and at least "
            f"{_MIN_CLIPPED:.0%} in {cut.sum()} of {counted(len(dataset), 'image')}: brighter pixels were clipped, an "
            "area as large as a target; save the images again with a smaller factor, or in more bits"
        )
    clipped = f"{shares.mean():.2%} of the pixels, which hold the largest value of their image, were cut off"
    examined.conclude("largest values", wrong, clipped if shares.mean() >= MIN_CLIPPED_REPORTED else "not cut off")
    return float(shares[worst])


def _parts(dataset: Dataset) -> Real[np.ndarray, "v rows columns"]:
    """Return the values that clipping limits: power, or the larger part of complex amplitudes."""
    if dataset.signal is None:
        return dataset.power
    larger = np.maximum(np.abs(dataset.signal.real), np.abs(dataset.signal.imag))
    return larger[:, 0] if dataset.passes else larger


def share_at_top(image: Real[np.ndarray, "rows columns"]) -> float:
    """Return the clipped share: pixels at the largest value if these outnumber those at values just below; else 0."""
    largest = image.max()
    count = int((image == largest).sum())
    if count <= _MAX_UNCLIPPED or count == image.size:
        return 0.0
    below = np.unique(image[image < largest], return_counts=True)[1][-_MAX_UNCLIPPED:]
    return count / image.size if count > 2 * below.mean() else 0.0


def _stretched(dataset: Dataset, speckled: bool) -> list[str]:
    """Describe images that were each scaled by their maximum, a quantile or their mean; empty if none."""
    if len(dataset) < _MIN_IMAGES or dataset.calibration != "relative":
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
    """Return whether the numbers of pixels above one level differ less than by chance."""
    from scipy.special import bdtr  # here: see `with_data`

    share = float(counts.mean()) / pixels
    within = bdtr(counts.max(), pixels, share) - bdtr(counts.min() - 1, pixels, share)
    return bool(within ** len(counts) < _CHANCE)


def ground_levels_db(dataset: Dataset) -> tuple[Float64[np.ndarray, "3 v"], float]:
    """Return the deviations of each image's ground from a common law of the grazing angle θ, dB, by three quantiles.

    The law is γ⁰ ~ sinⁿ θ, n by the median of slopes between grazing angles, weighted by their images, at most that of
    real ground; also return by how many dB that makes it flatter between the lowest and the highest angle.
    """
    flat = np.array([beta0_of_gamma0(1.0, view.grazing_deg) for view in dataset.views])
    levels = to_db(np.quantile(dataset.power, _QUANTILES, axis=(1, 2)) / flat, least=LEAST_POWER)
    law = to_db(flat / np.hypot(1, flat), least=LEAST_POWER)  # sin θ, for flat is tan θ
    steps, group, counts = np.unique(np.round(law / _LAW_STEP_DB), return_inverse=True, return_counts=True)
    at = np.array([(law[group == k].mean(), np.median(levels[:, group == k])) for k in range(len(steps))])
    (run, rise), pairs = at.T[:, :, None] - at.T[:, None, :], np.triu_indices(len(at), 1)
    weights = np.minimum(counts[:, None], counts)[pairs]
    slope = float(np.median(np.repeat(rise[pairs] / run[pairs], weights))) if len(at) > 1 else 0.0
    real = float(np.clip(slope, *_REAL_SLOPES))
    levels = levels - real * law
    return levels - np.median(levels, axis=1, keepdims=True), (slope - real) * float(np.ptp(law))


def levelled(dataset: Dataset) -> Dataset:
    """Return a dataset whose images have one scale by the level of their ground, which its `source` says.

    The law by which ground depends on the grazing angle is kept as far as real ground may have it. Raises without
    ground.
    """
    if not dataset.ground:
        raise SarsplatError("the images show no ground whose level could be compared; give the factor of each image")
    gains_db = -np.median(ground_levels_db(dataset)[0], axis=0)
    factors = from_db(gains_db).astype(np.float32)

    def scaled(entry: DatasetEntry, factor: float) -> DatasetEntry:
        if entry.stack is None or entry.stack.noise is None:
            return entry
        return replace(entry, stack=replace(entry.stack, noise=tuple(noise * factor for noise in entry.stack.noise)))

    told = f"each image was multiplied by {gains_db.min():+.1f} to {gains_db.max():+.1f} dB, to one ground level"
    source = {**dataset.source, "assumptions": [*dataset.source.get("assumptions", ()), told]}
    if "contradictions" in source:
        source["contradictions"] = [text for text in source["contradictions"] if _ONE_SCALE.split(",")[0] not in text]
    signal = dataset.signal
    return replace(
        dataset,
        power=dataset.power * factors[:, None, None],
        signal=None if signal is None else signal * np.sqrt(factors).reshape(-1, *[1] * (signal.ndim - 1)),
        entries=tuple(scaled(entry, float(factor)) for entry, factor in zip(dataset.entries, factors, strict=True)),
        calibration="relative",
        source=source,
    )


def _other_level(dataset: Dataset) -> list[str]:
    """Describe images whose ground is far brighter or darker than in most, or than the median where all differ."""
    if len(dataset) < _MIN_IMAGES or not dataset.ground:
        return []
    deviations_db, excess_db = ground_levels_db(dataset)
    same_sign = (np.sign(deviations_db) == np.sign(deviations_db[0])).all(axis=0)
    deviation_db = np.where(same_sign, np.sign(deviations_db[0]) * np.abs(deviations_db).min(axis=0), 0.0)
    typical = 1.4826 * float(np.median(np.abs(deviation_db)))
    limit = max(_OTHER_DB, _OTHER_DEVIATIONS * typical) if typical < _MAX_SPREAD_DB else typical / 2
    outliers = np.abs(deviation_db) > limit
    if abs(excess_db) > _OTHER_DB and outliers.sum() != 1:
        return [
            f"the ground gets {excess_db:+.0f} dB brighter from the lowest to the highest grazing angle than any real "
            f"ground does, as of another scale at each angle; {_ONE_SCALE}"
        ]
    if not outliers.any():
        return []
    worst = int(np.where(outliers, np.abs(deviation_db), 0).argmax())
    more = f" ({counted(int(outliers.sum()), 'image')} of {len(dataset)} deviate as much)" if outliers.sum() > 1 else ""
    return [
        f"the ground of {dataset.entries[worst].name} is {abs(deviation_db[worst]):.1f} dB "
        f"{'brighter' if deviation_db[worst] > 0 else 'darker'} than the median of all images{more}, as of another "
        f"scale or unit; {_ONE_SCALE}"
    ]


def _other_contrast(dataset: Dataset) -> list[str]:
    """Describe single images with weaker or stronger speckle than all others, such as amplitude among power."""
    from sarsplat.examination.units import clutter  # here: these need SciPy; see `with_data`
    from sarsplat.regions.outlines import levels_db, outline

    if dataset.clean_tests:
        dataset = dataset.select("train")
    fine: dict[int, float] = {}
    for k, image in enumerate(dataset.power):
        levels = levels_db(image[None], dataset.grid, ground=True)
        ground = clutter(image[None], levels, [outline(levels[0])], dataset.grid)
        if ground and not ground.coarse:
            fine[k] = ground.contrast
    if len(fine) < _MIN_IMAGES:
        return []
    typical = float(np.median(list(fine.values())))
    outliers = {
        k: contrast / typical for k, contrast in fine.items() if not _CONTRASTS[0] < contrast / typical < _CONTRASTS[1]
    }
    if not outliers or 2 * len(outliers) > len(fine):
        return []
    worst = max(outliers, key=lambda k: abs(math.log(max(outliers[k], np.finfo(float).tiny))))
    more = f" ({counted(len(outliers), 'image')} of {len(dataset)} differ as much)" if len(outliers) > 1 else ""
    as_if = "amplitude or smoothed" if outliers[worst] < 1 else "squared, or all others amplitude or smoothed"
    return [
        f"the standard deviation over mean of the ground of {dataset.entries[worst].name} is {fine[worst]:.2f}, and "
        f"that of the others {typical:.2f}{more}, as if it were {as_if}; give all images in one unit"
    ]
