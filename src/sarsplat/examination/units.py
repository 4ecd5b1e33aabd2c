"""Whether the statistics of clutter, and sharpness, contradict the unit, looks and resolution that are stated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Real, Shaped
from scipy.ndimage import binary_dilation

from sarsplat.data import Dataset
from sarsplat.examination.outcome import Examination
from sarsplat.examination.significance import Evidence
from sarsplat.examination.single_values import A_FEW, WIDEST_RANGE_DB, ranges_db
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import width_of
from sarsplat.radiometry import brighter
from sarsplat.regions.outlines import Outline, levels_db, outline

_SPECKLED = 0.4
"""Contrast from which on ground is speckled: about that of six looks."""

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

_KNOWN: dict[str, dict[str, str]] = {
    "db": {"quantity": "double the decibels (--scale 2) if they are 10·log10 of amplitudes"},
    "complex": {},
}
"""What else may be wrong of images whose power is known by their kind of numbers."""

_CELLS_PER_BLOCK, _SMALLEST_BLOCK = 6, 8
"""Side of the blocks of clutter, in resolution widths and in pixels: ground hardly changes within one."""

_BLOCKS_PER_SIDE = 4
"""Of an image at least, if that is large enough: the resolution stated may be far too coarse."""

_FEWEST_BLOCKS = 20
_WHITE = 0.1
"""Neighbouring pixels of speckle that correlate less are taken as drawn independently of each other."""

_MOST_ALIKE = 0.75
"""Mean correlation of a block's pixels above which it holds hardly more than one cell, and tells nothing of speckle."""

_ROUNDS = 10
"""Of widths that follow from how much of the variance a block's mean takes, which follows from the widths."""

_BRIGHT_DB = 25.0
"""Below the brightest of an image: what is darker is not looked at for its sharpness."""

_SHARPEST = 0.9999
"""Quantile of curvatures: that of the sharpest structure, but not of a single pixel."""


def examine_units(dataset: Dataset, examined: Examination) -> bool:
    """Add contradictions in unit, looks and resolution, given a dataset with near range on top.

    Returns whether there is ground with speckle as it is stated.
    """
    if dataset.ground and not _plausible_range(dataset, examined):
        return False
    speckled = False
    smooth = np.array([dataset.looks is None or (dataset.clean_tests and e.split != "train") for e in dataset.entries])
    if dataset.ground:
        speckled = _speckle(dataset.take(np.flatnonzero(smooth if smooth.all() else ~smooth).tolist()), examined)
    else:
        examined.checks["unit"] = "cannot be determined: there is no ground whose speckle could be measured"
    if smooth.any() and "resolution" not in examined.checks:
        resampled = bool(dataset.source.get("geocoded"))  # from a map: splines may be sharper than any response
        widths = None if resampled else sharpest_widths_m(dataset.power[smooth], dataset.grid)
        _resolution(dataset, widths or (None, None), "structure", examined)
    if "resolution" not in examined.checks:
        _resolution(dataset, (None, None), "speckle", examined)
    return speckled


def _plausible_range(dataset: Dataset, examined: Examination) -> bool:
    """Whether the brightest pixels are as far above the ground as can be; if not, nothing else needs be said."""
    range_db = float(np.median(ranges_db(dataset, A_FEW)))
    if range_db <= WIDEST_RANGE_DB:
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


def _speckle(dataset: Dataset, examined: Examination) -> bool:
    """Whether the ground has speckle, and as much as is stated."""
    levels = levels_db(dataset.power, dataset.grid, dataset.ground)
    ground = clutter(dataset.power, levels, [outline(level) for level in levels], dataset.grid)
    if ground is None:
        examined.checks["unit"] = "cannot be determined: too little ground around the target"
        return False
    if ground.values < _FEWEST_VALUES and ground.contrast > _SMOOTH:
        few = f"the ground has only {ground.values:g} different values in a block of pixels"
        examined.checks["unit"] = f"cannot be determined: so coarsely are pixels quantised that {few}"
        return False
    measured = f"standard deviation over mean of the ground is {ground.contrast:.2f}"
    if dataset.looks is None or dataset.looks > _MOST_LOOKS:
        examined.checks["unit"] = f"{measured}; without speckle, this does not tell power from amplitude"
        if ground.contrast > _SPECKLED:
            examined.contradictions.append(
                f"the {measured}, as of speckle with {1 / ground.contrast**2:.1f} looks, but the dataset states no "
                f"speckle; {_remedy(dataset, looks='give the number of looks (--looks)')}"
            )
            examined.checks["resolution"] = "cannot be determined from speckle of unknown looks"
        return False
    if ground.alike > _MOST_ALIKE:
        examined.checks["unit"] = "cannot be determined: resolution cells are about as large as a quarter of the images"
        return False
    contrast = ground.contrast_of_many
    measured = f"standard deviation over mean of the ground is {contrast:.2f}"
    of_power, of_amplitude = contrast_of(dataset.looks)
    stated = f"{dataset.looks:g} look{'' if dataset.looks == 1 else 's'}"
    examined.checks["unit"] = f"{measured}; power of {stated} has {of_power:.2f}, amplitude {of_amplitude:.2f}"
    wrong = ""
    if Evidence(ground.skewness).against(_LEAST_SKEWNESS):
        wrong = (
            f"more of the ground is dark than bright (skewness {ground.skewness.mean():.2f}), as in decibels, not in "
            f"power or amplitude; {_remedy(dataset, quantity=f'import with {_DECIBELS}')}"
        )
    elif contrast < of_amplitude**1.5 / of_power**0.5:
        wrong = (
            f"the {measured}, but speckle of {stated} has {of_power:.2f}, so the images are smoother than stated; "
            + _remedy(
                dataset,
                looks="give their number of looks (--looks), or 0 if there is no speckle",
                quantity=f"{_DECIBELS}, if they hold these",
            )
        )
    elif contrast < (of_power * of_amplitude) ** 0.5:
        known = _KNOWN.get(str(dataset.source.get("quantity")))
        remedies = {
            "quantity": "square the values (--quantity amplitude)",
            "looks": "give another number of looks (--looks) if they are power",
        }
        if known is not None:  # no numbers that could be squared: the looks are wrong sooner
            remedies = {"looks": "give another number of looks (--looks)"} | known
        elif dataset.source.get("geocoded"):  # so that amplitude is what they are less likely to be
            looks = f"--looks {1 / contrast**2:.2g}"
            remedies = {
                "looks": f"give the looks that are left after pixels were interpolated to the map ({looks})",
                "quantity": f"{remedies['quantity']} if they are amplitude",
            }
        wrong = (
            f"the {measured}, as of amplitude with {stated} ({of_amplitude:.2f}), not of power ({of_power:.2f}); "
            + _remedy(dataset, **remedies)
        )
    elif contrast > of_power**1.5 / of_amplitude**0.5:
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
    return not wrong


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


@dataclass(frozen=True)
class Clutter:
    """What blocks of ground look like, away from target and shadow."""

    contrast: float
    """Standard deviation over mean, the median of all blocks."""
    skewness: Float64[np.ndarray, " blocks"]
    """Of each block's amplitude: positive for speckle, negative if decibels were read as power or amplitude."""
    values: float
    """Number of different values in a block, the median of all: few if pixels are quantised coarsely."""
    width_m: tuple[float | None, float | None]
    """3 dB width in azimuth and slant range of the response that correlates neighbouring pixels of speckle so much;
    None if they hardly do."""

    alike: float
    """Mean correlation of the speckle in all pixels of a block, by that width: what its mean takes of the variance."""

    @property
    def contrast_of_many(self) -> float:
        """That of speckle in blocks of many resolution cells, if it is speckle."""
        return self.contrast / math.sqrt(1 - self.alike)

    @property
    def coarse(self) -> bool:
        """Whether pixels have too few values to measure speckle by."""
        return self.values < _FEWEST_VALUES


def clutter(
    power: Real[np.ndarray, "v rows columns"],
    levels: Float64[np.ndarray, "v rows columns"],
    outlines: Sequence[Outline],
    grid: ImageGrid,
) -> Clutter | None:
    """Statistics of the ground around the target, given decibels above it; None if too little of it is seen."""
    across, along = (
        max(_SMALLEST_BLOCK, min(math.ceil(_CELLS_PER_BLOCK * width / spacing), pixels // _BLOCKS_PER_SIDE))
        for width, spacing, pixels in zip(grid.resolution_m, grid.spacing_m, (grid.columns, grid.rows), strict=True)
    )
    parts = []
    for image, level, seen in zip(power, levels, outlines, strict=True):
        other = binary_dilation(seen.target | seen.shadow | (np.abs(level) > 6.0))
        blocks = _blocks(image, along, across)
        parts.append(blocks[(blocks.mean(axis=(1, 2)) > 0) & ~_blocks(other, along, across).any(axis=(1, 2))])
    blocks = np.concatenate(parts).astype(np.float64)
    if len(blocks) < _FEWEST_BLOCKS:
        return None
    rest = _standardised(blocks)
    pixels = np.sort(blocks.reshape(len(blocks), -1), axis=1)
    steps = [float((np.diff(rest, axis=axis) ** 2).mean()) / 2 for axis in (2, 1)]  # the mean plays no part in them
    widths, alike = _widths(steps, (across, along), grid.spacing_m)
    one, other = (
        None if width and stated > width > side * spacing / 2 else width  # no block shows how wide it really is
        for width, stated, side, spacing in zip(widths, grid.resolution_m, (across, along), grid.spacing_m, strict=True)
    )
    return Clutter(
        float(np.median(blocks.std(axis=(1, 2), ddof=1) / blocks.mean(axis=(1, 2)))),
        (_standardised(np.sqrt(blocks)) ** 3).mean(axis=(1, 2)),
        float(np.median(1 + (np.diff(pixels, axis=1) > 0).sum(axis=1))),
        (one, other),
        alike,
    )


def _widths(
    steps: Sequence[float], side: tuple[int, int], spacing_m: tuple[float, float]
) -> tuple[tuple[float | None, float | None], float]:
    """3 dB widths along both axes, and the mean correlation of all pixels of a block: its mean takes that much of them.

    `steps` are half the squared differences of neighbouring pixels of blocks whose variance is 1.
    """
    widths: tuple[float | None, float | None] = (None, None)
    alike = 0.0
    for _ in range(_ROUNDS):
        one, other = (
            _response_width(1 - step * (1 - alike), spacing) for step, spacing in zip(steps, spacing_m, strict=True)
        )
        widths = one, other
        lines = zip(widths, side, spacing_m, strict=True)
        alike = math.prod(_alike(width, pixels, spacing) for width, pixels, spacing in lines)
    return widths, alike


def _alike(width_m: float | None, pixels: int, spacing_m: float) -> float:
    """Mean correlation of the speckle in all pixels of a line with one another."""
    if width_m is None:
        return 1 / pixels
    apart = np.arange(1, pixels) * spacing_m / width_m
    return float(1 + 2 * ((1 - np.arange(1, pixels) / pixels) * np.exp(-2 * math.log(2) * apart**2)).sum()) / pixels


def _standardised(blocks: Float64[np.ndarray, "n along across"]) -> Float64[np.ndarray, "n along across"]:
    """Each block with mean 0 and standard deviation 1; 0 if it is constant."""
    rest = blocks - blocks.mean(axis=(1, 2), keepdims=True)
    return rest / np.maximum(blocks.std(axis=(1, 2), keepdims=True), np.finfo(float).tiny)


def _blocks(image: Shaped[np.ndarray, "rows columns"], along: int, across: int) -> Shaped[np.ndarray, "n along across"]:
    """An image cut into blocks; what is left over at its ends is left out."""
    rows, columns = (pixels // side for pixels, side in zip(image.shape, (along, across), strict=True))
    cut = image[: rows * along, : columns * across].reshape(rows, along, columns, across)
    return cut.swapaxes(1, 2).reshape(-1, along, across)


def _response_width(correlation: float, spacing_m: float) -> float | None:
    """3 dB width of a Gaussian response, from the correlation of speckle power, which is √2 times as wide."""
    if not _WHITE < correlation < 1:
        return None
    return spacing_m * math.sqrt(2 * math.log(2) / -math.log(correlation))


def contrast_of(looks: float) -> tuple[float, float]:
    """Standard deviation over mean of speckle of so many looks: of power, and of amplitude."""
    ratio = math.exp(math.lgamma(looks) + math.lgamma(looks + 1) - 2 * math.lgamma(looks + 0.5))
    return 1 / math.sqrt(looks), math.sqrt(ratio - 1)


def sharpest_widths_m(power: Real[np.ndarray, "v rows columns"], grid: ImageGrid) -> tuple[float, float] | None:
    """3 dB widths in azimuth and slant range of the sharpest structure in images without speckle, m.

    However scatterers lie, the logarithm of a sum of Gaussian responses is nowhere curved more than that of one. None
    if there is nothing to look at.
    """
    peak = power.max(axis=(1, 2), keepdims=True)
    bright = brighter(power, -_BRIGHT_DB, peak) & (power > 0)
    logarithm = np.log(np.where(bright, power, 1.0), dtype=np.float64)
    widths = []
    for axis, spacing in zip((2, 1), grid.spacing_m, strict=True):
        values, shown = np.moveaxis(logarithm, axis, 2), np.moveaxis(bright, axis, 2)
        curvature = (2 * values[..., 1:-1] - values[..., 2:] - values[..., :-2]) / spacing**2
        curvature = curvature[shown[..., 1:-1] & shown[..., 2:] & shown[..., :-2]]
        most = float(np.quantile(curvature, _SHARPEST)) if len(curvature) else 0.0
        if not most > 0:
            return None
        widths.append(width_of(1 / most))
    return widths[0], widths[1]
