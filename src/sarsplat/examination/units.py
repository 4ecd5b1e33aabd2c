"""Checks of unit, looks and resolution by the statistics of clutter and by sharpness."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Real, Shaped
from scipy.ndimage import binary_dilation

from sarsplat.data import Dataset
from sarsplat.examination.outcome import Examination
from sarsplat.examination.significance import Evidence
from sarsplat.examination.single_values import MAX_RANGE_DB, UNIT_RANK, ranges_db
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import width_of
from sarsplat.radiometry import brighter
from sarsplat.regions.outlines import Outline, levels_db, outline

_SPECKLED = 0.4  # minimum contrast of speckled ground: about that of six looks

_MIN_SKEWNESS = 0.2
"""Minimum negative skewness of the amplitude that is evidence of decibels. Measured: up to 0.13 for amplitude read as
power; 0.25 for decibels of 16 looks, more of fewer."""

_SMOOTH = 0.1  # maximum contrast of ground without speckle and coarse quantisation
_MIN_VALUES = 8  # minimum number of different values in a block of ground for statistics of speckle
_MAX_LOOKS = 1e6  # maximum number of looks; more mean no speckle

_WIDTH_RATIOS = {"speckle": (0.5, 1.7), "structure": (0.8, 2.0)}
"""Range of measured over stated resolution, by correlation of speckle and by the sharpest structure, which may be
smoother than a point but not sharper."""

_MIN_RESOLUTION = 0.5  # minimum resolution, pixels

_DECIBELS = "quantity='db', with `scale` and `offset` for decibels in 8 bits"

_ALL_OPTIONS = ("quantity", "looks")
_OPTIONS = {"sicd": ("looks",), "rslc": ("looks",), "mstar": (), "sample": (), "phase-history": (), "stack": ("looks",)}
"""Options of the import by the kind of the dataset's `source`; `_ALL_OPTIONS` for other kinds."""

_SQUARED = {
    "amplitude": "square the numbers in the files if they are roots of amplitudes",
    "complex": "square the magnitudes in the files if they are roots of amplitudes",
    "db": "double the decibels (`scale=2`) if they are 10·log10 of amplitudes",
}
"""Quantity of a dataset's files → remedy if speckle has too little contrast, and the looks are right."""
_ROOTS = {
    "amplitude": "take the root of the values (quantity='power') if they were squared twice",
    "power": "take the root of the numbers in the files if these are squares of power",
    "complex": "take the root of the magnitudes in the files if these are power",
    "db": "halve the decibels (`scale=0.5`) if they are 20·log10 of power",
}
"""Quantity → remedy if speckle has too much contrast."""

_CELLS_PER_BLOCK, _SMALLEST_BLOCK = 6, 8
"""Side of the blocks of clutter in resolution widths, and minimum in pixels: ground hardly changes within one."""

_BLOCKS_PER_SIDE = 4
"""Minimum number of blocks along each side of an image, should the stated resolution be far too coarse."""

_MIN_BLOCKS = 20
_MIN_CORRELATION = 0.1  # correlation below which neighbouring pixels of speckle count as independent

_MAX_CORRELATION = 0.75
"""Maximum mean correlation of a block's pixels: above, a block holds hardly more than one resolution cell."""

_ROUNDS = 10  # fixed-point iterations for widths and the variance of block means, which depend on each other
_BRIGHT_DB = 25.0  # dynamic range of the sharpness test, dB below the image's maximum
_SHARPEST = 0.9999  # quantile of curvatures that represents the sharpest structure, but not a single pixel


def examine_units(dataset: Dataset, examined: Examination) -> bool:
    """Add contradictions in unit, looks and resolution, given a dataset with near range on top.

    Return True if the ground has speckle of the stated looks.
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
    """Return whether the range is plausible for power; add a contradiction if not."""
    range_db = float(np.median(ranges_db(dataset, UNIT_RANK)))
    if range_db <= MAX_RANGE_DB:
        return True
    examined.checks["unit"] = f"brightest pixels are {range_db:.0f} dB above the ground"
    examined.contradictions.append(
        f"brightest pixels are {range_db:.0f} dB above the ground, more than any radar image has, so the values are no "
        "decibels, or scaled ones; "
        + _remedy(
            dataset, quantity="import with quantity='amplitude', or with the `scale` and `offset` of the decibels"
        )
    )
    return False


def _options(dataset: Dataset) -> tuple[str, ...]:
    return _OPTIONS.get(str(dataset.source.get("kind")), _ALL_OPTIONS)


def _remedy(dataset: Dataset, **by_option: str) -> str:
    """Join the remedies whose options the dataset's import has."""
    named = [text for option, text in by_option.items() if option in _options(dataset)]
    return ", or ".join(named) or "correct the files, since their import has no such option"


def _speckle(dataset: Dataset, examined: Examination) -> bool:
    """Compare the contrast of the ground with the stated looks; return True if it is speckle of these."""
    levels = levels_db(dataset.power, dataset.grid, dataset.ground)
    ground = clutter(dataset.power, levels, [outline(level) for level in levels], dataset.grid)
    if ground is None:
        examined.checks["unit"] = "cannot be determined: too little ground around the target"
        return False
    if ground.coarse and ground.contrast > _SMOOTH:
        few = f"the ground has only {ground.values:g} different values in a block of pixels"
        examined.checks["unit"] = f"cannot be determined: so coarsely are pixels quantised that {few}"
        return False
    measured = f"standard deviation over mean of the ground is {ground.contrast:.2f}"
    if dataset.looks is None or dataset.looks > _MAX_LOOKS:
        examined.checks["unit"] = f"{measured}; without speckle, this does not tell power from amplitude"
        if ground.contrast > _SPECKLED:
            examined.contradictions.append(
                f"the {measured}, as of speckle with {1 / ground.contrast**2:.1f} looks, but the dataset states no "
                f"speckle; {_remedy(dataset, looks='give the number of `looks`')}"
            )
            examined.checks["resolution"] = "cannot be determined from speckle of unknown looks"
        return False
    if ground.correlation > _MAX_CORRELATION:
        examined.checks["unit"] = "cannot be determined: resolution cells are about as large as a quarter of the images"
        return False
    contrast = ground.contrast_of_many
    measured = f"standard deviation over mean of the ground is {contrast:.2f}"
    of_power, of_amplitude = contrast_of(dataset.looks)
    stated = f"{dataset.looks:g} look{'' if dataset.looks == 1 else 's'}"
    examined.checks["unit"] = f"{measured}; power of {stated} has {of_power:.2f}, amplitude {of_amplitude:.2f}"
    wrong, quantity = "", str(dataset.source.get("quantity", ""))
    decibels = {"quantity": f"import with {_DECIBELS}"} if quantity != "complex" else {}
    decibels |= {"quantity": "give `scale` and `offset` of decibels in 8 bits"} if quantity == "db" else {}
    if Evidence(ground.skewness).against(_MIN_SKEWNESS):
        wrong = (
            f"more of the ground is dark than bright (skewness {ground.skewness.mean():.2f}), as in decibels, not in "
            f"power or amplitude; {_remedy(dataset, **decibels)}"
        )
    elif contrast < of_amplitude**1.5 / of_power**0.5:
        wrong = (
            f"the {measured}, but speckle of {stated} has {of_power:.2f}, so the images are smoother than stated; "
            + _remedy(
                dataset,
                looks="give their number of `looks`, or looks=None if there is no speckle",
                **{name: f"{text}, if they hold these" for name, text in decibels.items()},
            )
        )
    elif contrast < (of_power * of_amplitude) ** 0.5:
        looks, squared = "give another number of `looks`", "square the values (quantity='amplitude')"
        remedies = {"quantity": squared, "looks": f"{looks} if they are power"}
        if dataset.source.get("geocoded"):  # amplitude is less likely
            left = f"`looks={1 / contrast**2:.2g}`"
            looks = f"give the looks that are left after pixels were interpolated to the map ({left})"
            remedies = {"looks": looks, "quantity": f"{squared} if they are amplitude"}
        if quantity in _SQUARED:  # squares are less likely
            remedies = {"looks": looks, "quantity": _SQUARED[quantity]}
        wrong = (
            f"the {measured}, as of amplitude with {stated} ({of_amplitude:.2f}), not of power ({of_power:.2f}); "
            + _remedy(dataset, **remedies)
        )
    elif contrast > of_power**1.5 / of_amplitude**0.5:
        wrong = (
            f"the {measured}, but power of {stated} has {of_power:.2f}; "
            + _remedy(
                dataset, quantity=_ROOTS.get(quantity, _ROOTS["amplitude"]), looks="give another number of `looks`"
            )
            + f", or import with {_DECIBELS}" * (bool(decibels) and "quantity" in _options(dataset))
        )
    if wrong:
        examined.contradictions.append(wrong)
    else:  # the width holds for power only
        _resolution(dataset, ground.width_m, "speckle", examined)
    return not wrong


def _resolution(dataset: Dataset, widths: tuple[float | None, float | None], by: str, examined: Examination) -> None:
    """Compare measured 3 dB widths in azimuth and range with the stated ones."""
    measured, low_high = [], _WIDTH_RATIOS[by]
    evidence = "pixels of speckle correlate as" if by == "speckle" else "the sharpest structure is as"
    for name, width, spacing, stated in zip(
        ("azimuth", "range"), widths, dataset.grid.spacing_m, dataset.grid.resolution_m, strict=True
    ):
        if stated < _MIN_RESOLUTION * spacing:
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
            pictures = "quantity" in _options(dataset) or dataset.source.get("kind") == "stack"
            options = " (`resolution_m`, `spacing_m`)" * pictures
            examined.contradictions.append(
                f"{evidence} of a resolution of {width:.2g} m in {name}, but {stated:.3g} m is stated, with pixels of "
                f"{spacing:.3g} m; correct the resolution or the pixel spacing in {name}{options}"
            )
    if measured:
        examined.checks["resolution"] = f"{evidence} of {' and '.join(measured)}"
    else:
        examined.checks["resolution"] = (
            "cannot be determined: neighbouring pixels do not correlate, or too little is seen"
        )


@dataclass(frozen=True)
class Clutter:
    """Statistics of blocks of ground away from target and shadow."""

    contrast: float
    """Standard deviation over mean, median over blocks."""
    skewness: Float64[np.ndarray, " blocks"]
    """Skewness of each block's amplitude: positive for speckle, negative for decibels read as power or amplitude."""
    values: float
    """Number of different values in a block, median over blocks: few with coarse quantisation."""
    width_m: tuple[float | None, float | None]
    """3 dB width in azimuth and slant range by the correlation of speckle; None if pixels are independent."""
    correlation: float
    """Mean correlation of a block's pixels by that width: the share of the variance in the block's mean."""

    @property
    def contrast_of_many(self) -> float:
        """Contrast corrected to speckle in blocks of many resolution cells."""
        return self.contrast / math.sqrt(1 - self.correlation)

    @property
    def coarse(self) -> bool:
        """True if pixels have too few values for statistics of speckle."""
        return self.values < _MIN_VALUES


def clutter(
    power: Real[np.ndarray, "v rows columns"],
    levels: Float64[np.ndarray, "v rows columns"],
    outlines: Sequence[Outline],
    grid: ImageGrid,
) -> Clutter | None:
    """Measure the ground around the target, given levels above it, dB; None if too little ground is visible."""
    across, along = (
        max(_SMALLEST_BLOCK, min(math.ceil(_CELLS_PER_BLOCK * width / spacing), pixels // _BLOCKS_PER_SIDE))
        for width, spacing, pixels in zip(grid.resolution_m, grid.spacing_m, (grid.columns, grid.rows), strict=True)
    )
    parts = []
    for image, level, regions in zip(power, levels, outlines, strict=True):
        excluded = binary_dilation(regions.target | regions.shadow | (np.abs(level) > 6.0))
        blocks = _blocks(image, along, across)
        parts.append(blocks[(blocks.mean(axis=(1, 2)) > 0) & ~_blocks(excluded, along, across).any(axis=(1, 2))])
    blocks = np.concatenate(parts).astype(np.float64)
    if len(blocks) < _MIN_BLOCKS:
        return None
    standardised = _standardised(blocks)
    pixels = np.sort(blocks.reshape(len(blocks), -1), axis=1)
    steps = [float((np.diff(standardised, axis=axis) ** 2).mean()) / 2 for axis in (2, 1)]  # independent of the mean
    widths, correlation = _widths(steps, (across, along), grid.spacing_m)
    azimuth_m, range_m = (
        None if width and stated > width > side * spacing / 2 else width  # wider than a block can show
        for width, stated, side, spacing in zip(widths, grid.resolution_m, (across, along), grid.spacing_m, strict=True)
    )
    return Clutter(
        float(np.median(blocks.std(axis=(1, 2), ddof=1) / blocks.mean(axis=(1, 2)))),
        (_standardised(np.sqrt(blocks)) ** 3).mean(axis=(1, 2)),
        float(np.median(1 + (np.diff(pixels, axis=1) > 0).sum(axis=1))),
        (azimuth_m, range_m),
        correlation,
    )


def _widths(
    steps: Sequence[float], side: tuple[int, int], spacing_m: tuple[float, float]
) -> tuple[tuple[float | None, float | None], float]:
    """Return the 3 dB widths along both axes and the mean correlation of a block's pixels.

    `steps` are half the mean squared differences of neighbouring pixels along both axes in blocks of variance 1.
    """
    widths: tuple[float | None, float | None] = (None, None)
    correlation = 0.0
    for _ in range(_ROUNDS):
        azimuth_m, range_m = (
            _response_width(1 - step * (1 - correlation), pitch) for step, pitch in zip(steps, spacing_m, strict=True)
        )
        widths = azimuth_m, range_m
        lines = zip(widths, side, spacing_m, strict=True)
        correlation = math.prod(_mean_correlation(width, pixels, spacing) for width, pixels, spacing in lines)
    return widths, correlation


def _mean_correlation(width_m: float | None, pixels: int, spacing_m: float) -> float:
    """Return the mean correlation of the speckle between all pairs of pixels of a line."""
    if width_m is None:
        return 1 / pixels
    lags = np.arange(1, pixels) * spacing_m / width_m
    return float(1 + 2 * ((1 - np.arange(1, pixels) / pixels) * np.exp(-2 * math.log(2) * lags**2)).sum()) / pixels


def _standardised(blocks: Float64[np.ndarray, "n along across"]) -> Float64[np.ndarray, "n along across"]:
    """Scale each block to mean 0 and standard deviation 1; 0 if constant."""
    standardised = blocks - blocks.mean(axis=(1, 2), keepdims=True)
    return standardised / np.maximum(blocks.std(axis=(1, 2), keepdims=True), np.finfo(float).tiny)


def _blocks(image: Shaped[np.ndarray, "rows columns"], along: int, across: int) -> Shaped[np.ndarray, "n along across"]:
    """Cut an image into blocks; incomplete blocks at the ends are dropped."""
    rows, columns = (pixels // side for pixels, side in zip(image.shape, (along, across), strict=True))
    cut = image[: rows * along, : columns * across].reshape(rows, along, columns, across)
    return cut.swapaxes(1, 2).reshape(-1, along, across)


def _response_width(correlation: float, spacing_m: float) -> float | None:
    """Return the 3 dB width of a Gaussian response from the correlation of speckle power, which is √2 times as wide."""
    if not _MIN_CORRELATION < correlation < 1:
        return None
    return spacing_m * math.sqrt(2 * math.log(2) / -math.log(correlation))


def contrast_of(looks: float) -> tuple[float, float]:
    """Return standard deviation over mean of speckle of `looks` looks in power and in amplitude."""
    ratio = math.exp(math.lgamma(looks) + math.lgamma(looks + 1) - 2 * math.lgamma(looks + 0.5))
    return 1 / math.sqrt(looks), math.sqrt(ratio - 1)


def sharpest_widths_m(power: Real[np.ndarray, "v rows columns"], grid: ImageGrid) -> tuple[float, float] | None:
    """Measure the 3 dB widths in azimuth and slant range of the sharpest structure in images without speckle, m.

    The logarithm of any sum of Gaussian responses is nowhere curved more than that of one. None without structure.
    """
    peak = power.max(axis=(1, 2), keepdims=True)
    bright = brighter(power, -_BRIGHT_DB, peak) & (power > 0)
    logarithm = np.log(np.where(bright, power, 1.0), dtype=np.float64)
    widths = []
    for axis, spacing in zip((2, 1), grid.spacing_m, strict=True):
        values, valid = np.moveaxis(logarithm, axis, 2), np.moveaxis(bright, axis, 2)
        curvature = (2 * values[..., 1:-1] - values[..., 2:] - values[..., :-2]) / spacing**2
        curvature = curvature[valid[..., 1:-1] & valid[..., 2:] & valid[..., :-2]]
        sharpest = float(np.quantile(curvature, _SHARPEST)) if len(curvature) else 0.0
        if not sharpest > 0:
            return None
        widths.append(width_of(1 / sharpest))
    return widths[0], widths[1]
