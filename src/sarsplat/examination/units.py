"""Whether the statistics of images contradict the unit, the looks and the resolution that are stated."""

from __future__ import annotations

import numpy as np

from sarsplat.data import Dataset
from sarsplat.examination.clutter import clutter, contrast_of, sharpest_widths_m
from sarsplat.examination.outcome import Examination
from sarsplat.examination.significance import Evidence
from sarsplat.radiometry import to_db
from sarsplat.regions.outlines import levels_db, outline

_SPECKLED = 0.4
"""Contrast from which on ground is speckled: about that of six looks."""

_WIDEST_RANGE_DB = 100.0
"""From the ground to the brightest pixel of an image: more than any radar, and any echo, has."""

_LEAST_SKEWNESS = 0.2
"""Of the amplitude, to the dark side: less is no evidence of decibels. Amplitude read as power has up to 0.13, decibels
of 16 looks have 0.25 and those of fewer more."""

_SMOOTH = 0.1
"""Contrast of ground that has neither speckle nor coarse steps."""

_FEWEST_VALUES = 8
"""In a block of ground: of fewer, neither speckle nor its correlation can be measured."""

_MOST_LOOKS = 1e6
"""Of speckle that can be seen: more mean that there is none."""

_WIDTH_RATIOS = {"speckle": (0.5, 1.7), "structure": (0.8, 2.0)}
"""Measured over stated resolution, within which they agree: by how far pixels of speckle correlate, and by the sharpest
structure, which may be smoother than a point but not sharper."""

_LEAST_PIXEL = 0.5
"""Least resolution, in pixels: finer ones are those of other images."""

_DECIBELS = "--quantity db, with --scale and --offset for decibels in 8 bits"

_EVERY = ("quantity", "looks")
_OPTIONS = {"sicd": ("looks",), "rslc": ("looks",), "mstar": (), "sample": (), "phase-history": ()}
"""Which of them an import has that lacks some, by the kind of the dataset's `source`."""


def examine_units(dataset: Dataset, examined: Examination) -> None:
    """Add contradictions in unit, looks and resolution, given a dataset with near range on top."""
    if dataset.ground and not _plausible_range(dataset, examined):
        return
    smooth = np.array([dataset.looks is None or (dataset.clean_tests and e.split != "train") for e in dataset.entries])
    if dataset.ground:
        _speckle(dataset.take(np.flatnonzero(smooth if smooth.all() else ~smooth).tolist()), examined)
    else:
        examined.checks["unit"] = "cannot be determined: there is no ground whose speckle could be measured"
    if smooth.any() and "resolution" not in examined.checks:
        widths = sharpest_widths_m(dataset.power[smooth], dataset.grid)
        _resolution(dataset, widths or (None, None), "structure", examined)
    if "resolution" not in examined.checks:
        _resolution(dataset, (None, None), "speckle", examined)


def _plausible_range(dataset: Dataset, examined: Examination) -> bool:
    """Whether the brightest pixels are as far above the ground as can be; if not, nothing else needs be said."""
    ground = np.maximum(np.median(dataset.power, axis=(1, 2)), np.finfo(np.float32).tiny)
    range_db = float(np.median(to_db(dataset.power.max(axis=(1, 2)), ground)))
    if range_db <= _WIDEST_RANGE_DB:
        return True
    examined.checks["unit"] = f"brightest pixels are {range_db:.0f} dB above the ground"
    examined.contradictions.append(
        f"brightest pixels are {range_db:.0f} dB above the ground, more than any radar image has, so the values are no "
        "decibels, or scaled ones; "
        + _remedy(
            dataset, quantity="import with --quantity amplitude, or with the --scale and --offset of the decibels"
        )
    )
    return False


def _options(dataset: Dataset) -> tuple[str, ...]:
    return _OPTIONS.get(str(dataset.source.get("kind")), _EVERY)


def _remedy(dataset: Dataset, **by_option: str) -> str:
    """What to do, as far as the import of the dataset has the options that this takes."""
    named = [text for option, text in by_option.items() if option in _options(dataset)]
    return ", or ".join(named) or "mend the files, for their import has no option that does"


def _speckle(dataset: Dataset, examined: Examination) -> None:
    levels = levels_db(dataset.power, dataset.grid, dataset.ground)
    ground = clutter(dataset.power, levels, [outline(level) for level in levels], dataset.grid)
    if ground is None:
        examined.checks["unit"] = "cannot be determined: too little ground around the target"
        return
    if ground.values < _FEWEST_VALUES and ground.contrast > _SMOOTH:
        few = f"the ground has only {ground.values:g} different values in a block of pixels"
        examined.checks["unit"] = f"cannot be determined: so coarsely are pixels quantised that {few}"
        return
    measured = f"standard deviation over mean of the ground is {ground.contrast:.2f}"
    if dataset.looks is None or dataset.looks > _MOST_LOOKS:
        examined.checks["unit"] = f"{measured}; without speckle, this does not tell power from amplitude"
        if ground.contrast > _SPECKLED:
            examined.contradictions.append(
                f"the {measured}, as of speckle with {1 / ground.contrast**2:.1f} looks, but the dataset states no "
                f"speckle; {_remedy(dataset, looks='give the number of looks (--looks)')}"
            )
            examined.checks["resolution"] = "cannot be determined from speckle of unknown looks"
        return
    of_power, of_amplitude = contrast_of(dataset.looks)
    stated = f"{dataset.looks:g} look{'' if dataset.looks == 1 else 's'}"
    examined.checks["unit"] = f"{measured}; power of {stated} has {of_power:.2f}, amplitude {of_amplitude:.2f}"
    wrong = ""
    if Evidence(ground.skewness).against(_LEAST_SKEWNESS):
        wrong = (
            f"more of the ground is dark than bright (skewness {ground.skewness.mean():.2f}), as in decibels, not in "
            f"power or amplitude; {_remedy(dataset, quantity=f'import with {_DECIBELS}')}"
        )
    elif ground.contrast < of_amplitude**1.5 / of_power**0.5:
        wrong = (
            f"the {measured}, but speckle of {stated} has {of_power:.2f}, so the images are smoother than stated; "
            + _remedy(
                dataset,
                looks="give their number of looks (--looks), or 0 if there is no speckle",
                quantity=f"{_DECIBELS}, if they hold these",
            )
        )
    elif ground.contrast < (of_power * of_amplitude) ** 0.5:
        wrong = (
            f"the {measured}, as of amplitude with {stated} ({of_amplitude:.2f}), not of power ({of_power:.2f}); "
            + _remedy(
                dataset,
                quantity="square the values (--quantity amplitude)",
                looks="give another number of looks (--looks) if they are power",
            )
        )
    elif ground.contrast > of_power**1.5 / of_amplitude**0.5:
        wrong = (
            f"the {measured}, but power of {stated} has {of_power:.2f}; "
            + _remedy(
                dataset,
                quantity="take the root of the values (--quantity power) if they were squared twice",
                looks="give another number of looks (--looks)",
            )
            + f", or {_DECIBELS}" * ("quantity" in _options(dataset))
        )
    if wrong:
        examined.contradictions.append(wrong)
    else:  # what it says of the width holds for power only
        _resolution(dataset, ground.width_m, "speckle", examined)


def _resolution(dataset: Dataset, widths: tuple[float | None, float | None], by: str, examined: Examination) -> None:
    """Hold measured 3 dB widths in azimuth and range against those stated."""
    measured, low_high = [], _WIDTH_RATIOS[by]
    how = "pixels of speckle correlate as" if by == "speckle" else "the sharpest structure is as"
    for name, width, spacing, stated in zip(
        ("azimuth", "range"), widths, dataset.grid.spacing_m, dataset.grid.resolution_m, strict=True
    ):
        if stated < _LEAST_PIXEL * spacing:
            examined.contradictions.append(
                f"the resolution of {stated:.3g} m in {name} is less than half a pixel of {spacing:.3g} m, which such "
                f"pixels cannot show; correct the resolution or the pixel spacing in {name}"
            )
            continue
        if width is None:
            continue
        measured.append(f"{width:.2g} m in {name}")
        blurred = by == "structure" and width > stated  # by the pixels, as speckle is not
        ratio = width / (max(stated, spacing) if blurred else stated)
        if not low_high[0] <= ratio <= low_high[1]:
            options = " (--resolution, --spacing)" * ("quantity" in _options(dataset))  # which go together
            examined.contradictions.append(
                f"{how} of a resolution of {width:.2g} m in {name}, but {stated:.3g} m is stated, with pixels of "
                f"{spacing:.3g} m; correct the resolution or the pixel spacing in {name}{options}"
            )
    if measured:
        examined.checks["resolution"] = f"{how} of {' and '.join(measured)}"
    else:
        examined.checks["resolution"] = (
            "cannot be determined: neighbouring pixels do not correlate, or too little is seen"
        )
