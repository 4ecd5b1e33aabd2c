"""Whether the images of a dataset contradict what it says of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from sarsplat.data import Dataset
from sarsplat.data.plausible import suspicious_angles, suspicious_images
from sarsplat.errors import counted
from sarsplat.reconstruction.clutter import clutter, contrast_of, sharpest_widths_m
from sarsplat.reconstruction.orientation import NOTHING, Evidence, Match, neighbours_match, shadow_beyond
from sarsplat.reconstruction.outlines import Outline, levels_db, outline

_MOST_IMAGES = 120
"""Evenly chosen of more: they say the same."""

_LEAST_DARKER_DB = 0.5
_LEAST_MATCH, _LEAST_UPRIGHT = 0.02, 0.01
"""Differences of decibels and correlations below these are no evidence, however many images show them."""

_SPECKLED = 0.4
"""Contrast from which on ground is speckled: about that of six looks."""

_WIDTH_RATIOS = {"speckle": (0.5, 1.7), "structure": (0.8, 2.0)}
"""Measured over stated resolution, within which they agree: by how far pixels of speckle correlate, and by the sharpest
structure, which may be smoother than a point but not sharper."""

_LEAST_PIXEL = 0.5
"""Least resolution, in pixels: finer ones are those of other images."""


@dataclass(frozen=True)
class Examination:
    """What was found in a dataset.

    Attributes
    ----------
    contradictions : list of str
        What contradicts the dataset's own statements: one sentence each, with the remedy. Empty if nothing does.
    checks : dict of str to str
        What was looked at, and what there was to see, or why nothing can be said.
    """

    contradictions: list[str] = field(default_factory=list)
    checks: dict[str, str] = field(default_factory=dict)


def examine(dataset: Dataset) -> Examination:
    """Hold the images of a dataset against what it says of them.

    Parameters
    ----------
    dataset : Dataset
        At most 120 images, evenly chosen, are looked at; for images that are the same or constant, all.

    Returns
    -------
    Examination
        Contradictions: angles that look like radians; images that are constant or the same; near range that is not row
        0; azimuths in the opposite sense, or mirrored images; values that are not power; speckle of another number of
        looks; a resolution that the images do not have. The zero of the azimuth cannot be determined from images.
    """
    found = Examination()
    found.contradictions.extend(suspicious_angles(dataset.select("train").views))
    wrong = suspicious_images(dataset)
    found.contradictions.extend(wrong)
    found.checks["images"] = "see below" if wrong else _all_differ(len(dataset))
    some = _evenly(dataset)
    if not np.ptp(some.power, axis=(1, 2)).any():
        return found
    levels = levels_db(some.power, some.grid, some.ground)
    outlines = [outline(level) for level in levels]
    _orientation(some, levels, outlines, found)
    _statistics(some, levels, outlines, found)
    return found


def _all_differ(images: int) -> str:
    return "the only one is not constant" if images == 1 else f"all {images} differ, none is constant"


def _evenly(dataset: Dataset) -> Dataset:
    count = min(len(dataset), _MOST_IMAGES)
    chosen = [k * len(dataset) // count for k in range(count)]
    return dataset.take(chosen)


def _orientation(
    some: Dataset, levels: Float64[np.ndarray, "v rows columns"], outlines: list[Outline], found: Examination
) -> None:
    shadow = shadow_beyond(levels, outlines) if some.ground else NOTHING
    match = neighbours_match(levels, some.views, some.grid)
    found.checks["near range"] = _told_range(shadow, match, some.ground)
    found.checks["azimuths"] = _told_sense(match)
    upright = NOTHING if match is None or some.ground else match.upright
    wrong_way_up = shadow.against(_LEAST_DARKER_DB) or upright.against(_LEAST_UPRIGHT)
    opposite = match is not None and match.sense.against(_LEAST_MATCH)
    if wrong_way_up:
        if shadow.count:
            seen = f"shadows lie on the near side of the target ({-shadow.mean:.1f} dB darker there than beyond it)"
        else:
            seen = "what is bright leans away from the radar, as if it lay below the ground"
        turned = match is not None and match.sense.supports(_LEAST_MATCH)
        remedy = "turn the images by 180° (power[:, ::-1, ::-1])" if turned else "flip the rows (power[:, ::-1])"
        found.contradictions.append(f"{seen}, so row 0 does not seem to be near range; {remedy}")
    elif opposite and match is not None:
        found.contradictions.append(
            f"images of neighbouring azimuths match better if azimuths run the other way (correlation higher by "
            f"{-match.sense.mean:.2f}), so azimuths are counted counter-clockwise or the images are mirrored; negate "
            "the azimuths, or flip the columns (power[:, :, ::-1])"
        )


def _told_range(shadow: Evidence, match: Match | None, ground: bool) -> str:
    if shadow.count:
        side = "beyond" if shadow.mean >= 0 else "before"
        return f"{abs(shadow.mean):.1f} dB darker {side} the target than on its other side, in {_images(shadow)}"
    if not ground and match is not None and match.upright.count:
        where = "above" if match.upright.mean >= 0 else "below"
        return f"no ground, so no shadow; what is bright lies {where} the ground, by {_pairs(match.upright)}"
    return "cannot be determined: too few images show shadow, or suit each other"


def _told_sense(match: Match | None) -> str:
    if match is None or not match.sense.count:
        return "cannot be determined: too few images of neighbouring azimuths (2° to 60° apart)"
    side = "as given" if match.sense.mean >= 0 else "in the opposite sense"
    return f"{_pairs(match.sense)} match better with azimuths {side} (correlation {abs(match.sense.mean):.2f} higher)"


def _images(evidence: Evidence) -> str:
    return counted(evidence.count, "image")


def _pairs(evidence: Evidence) -> str:
    return f"{counted(evidence.count, 'pair')} of neighbouring views"


def _statistics(
    some: Dataset, levels: Float64[np.ndarray, "v rows columns"], outlines: list[Outline], found: Examination
) -> None:
    smooth = np.array([some.looks is None or (some.clean_tests and entry.split != "train") for entry in some.entries])
    if some.ground:
        which = np.flatnonzero(smooth if smooth.all() else ~smooth)
        _speckle(some, levels[which], [outlines[k] for k in which], some.power[which], found)
    else:
        found.checks["unit"] = "cannot be determined: there is no ground whose speckle could be measured"
    if smooth.any() and "resolution" not in found.checks:
        widths = sharpest_widths_m(some.power[smooth], some.grid)
        _resolution(some, widths or (None, None), "structure", found)
    if "resolution" not in found.checks:
        _resolution(some, (None, None), "speckle", found)


def _speckle(
    some: Dataset,
    levels: Float64[np.ndarray, "v rows columns"],
    outlines: list[Outline],
    power: np.ndarray,
    found: Examination,
) -> None:
    ground = clutter(power, levels, outlines, some.grid)
    if ground is None:
        found.checks["unit"] = "cannot be determined: too little ground around the target"
        return
    measured = f"standard deviation over mean of the ground is {ground.contrast:.2f}"
    if some.looks is None:
        found.checks["unit"] = f"{measured}; without speckle, this does not tell power from amplitude"
        if ground.contrast > _SPECKLED:
            found.contradictions.append(
                f"the {measured}, as of speckle with {1 / ground.contrast**2:.1f} looks, but the dataset states no "
                "speckle; give the number of looks"
            )
            found.checks["resolution"] = "cannot be determined from speckle of unknown looks"
        return
    of_power, of_amplitude = contrast_of(some.looks)
    stated = f"{some.looks:g} look{'' if some.looks == 1 else 's'}"
    found.checks["unit"] = f"{measured}; power of {stated} has {of_power:.2f}, amplitude {of_amplitude:.2f}"
    if ground.contrast < of_amplitude**1.5 / of_power**0.5:
        found.contradictions.append(
            f"the {measured}, but speckle of {stated} has {of_power:.2f}, so the images are smoother than stated; "
            "give their number of looks, or none"
        )
    elif ground.contrast < (of_power * of_amplitude) ** 0.5:
        found.contradictions.append(
            f"the {measured}, as of amplitude with {stated} ({of_amplitude:.2f}), not of power ({of_power:.2f}); "
            "square the values, or give another number of looks if they are power"
        )
    elif ground.contrast > of_power**1.5 / of_amplitude**0.5:
        found.contradictions.append(
            f"the {measured}, but power of {stated} has {of_power:.2f}; take the root of the values if they were "
            "squared twice, or give another number of looks"
        )
    else:  # what it says of the width holds for power only
        _resolution(some, ground.width_m, "speckle", found)


def _resolution(some: Dataset, widths: tuple[float | None, float | None], by: str, found: Examination) -> None:
    """Hold measured 3 dB widths in azimuth and range against those stated."""
    told, low_high = [], _WIDTH_RATIOS[by]
    how = "pixels of speckle correlate as" if by == "speckle" else "the sharpest structure is as"
    for name, width, spacing, stated in zip(
        ("azimuth", "range"), widths, some.grid.spacing_m, some.grid.resolution_m, strict=True
    ):
        if stated < _LEAST_PIXEL * spacing:
            found.contradictions.append(
                f"the resolution of {stated:.3g} m in {name} is less than half a pixel of {spacing:.3g} m, which such "
                f"pixels cannot show; correct the resolution or the pixel spacing in {name}"
            )
            continue
        if width is None:
            continue
        told.append(f"{width:.2g} m in {name}")
        blurred = by == "structure" and width > stated  # by the pixels, as speckle is not
        ratio = width / (max(stated, spacing) if blurred else stated)
        if not low_high[0] <= ratio <= low_high[1]:
            found.contradictions.append(
                f"{how} of a resolution of {width:.2g} m in {name}, but {stated:.3g} m is stated, with pixels of "
                f"{spacing:.3g} m; correct the resolution or the pixel spacing in {name}"
            )
    if told:
        found.checks["resolution"] = f"{how} of {' and '.join(told)}"
    else:
        found.checks["resolution"] = "cannot be determined: neighbouring pixels do not correlate, or too little is seen"
