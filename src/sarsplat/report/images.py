"""SAR images as pictures, pixel for pixel, and with their errors as panels of a page with axes in metres."""

import base64
import io
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Real, UInt8

from sarsplat.colours import DIFFERENCE, DIFFERENCE_IN_WORDS, POWER, Palette, ramp
from sarsplat.data.image import in_blocks
from sarsplat.errors import SarsplatError
from sarsplat.evaluation import UndefinedScore, register
from sarsplat.evaluation.images import smoothed
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import DYNAMIC_RANGE_DB, brighter, difference_db, from_db, shade
from sarsplat.report.figure import ColourBar, Panel, axis, colour_bar, scale_bar

Image = Real[np.ndarray, "rows columns"]
Images = Real[np.ndarray, "v rows columns"]

_MARGIN = 5  # pixels around the target
_LARGEST_DB, _LARGEST_SIGMA = 6.0, 4.0  # ends of the colour scale; larger differences are clipped

_LEAST_WINDOW = 3
_DARKEST_DB = -60.0  # floor of rendered power below the peak: σ is never 0

_ROWS = 512  # of an image whose decibels are calculated at once


def indexed(values: Real[np.ndarray, "*shape"], low: float, high: float) -> UInt8[np.ndarray, "*shape"]:
    """Map values from `low` to `high` to indices 0 to 255; values beyond are clipped."""
    return np.round(255 * np.clip((np.asarray(values) - low) / (high - low), 0, 1)).astype(np.uint8)


def png(picture: UInt8[np.ndarray, "rows columns *rgb"], colours: Palette | None = None) -> bytes:
    """Encode palette indices (grey levels without `colours`) or RGB as PNG."""
    from PIL import Image

    buffer, options = io.BytesIO(), {}
    image = Image.fromarray(picture)
    if colours is not None:
        image.putpalette(colours[:, :3].tobytes())
        options = {"transparency": colours[:, 3].tobytes()}
    image.save(buffer, "PNG", optimize=True, **options)
    return buffer.getvalue()


def address(picture: UInt8[np.ndarray, "rows columns *rgb"], colours: Palette | None = None) -> str:
    """Encode a picture as the data URL of a PNG."""
    return f"data:image/png;base64,{base64.b64encode(png(picture, colours)).decode()}"


def block_means(images: Images, factor: int) -> Real[np.ndarray, "v fewer_rows fewer_columns"]:
    """Means over blocks of `factor` × `factor` pixels; incomplete blocks at the far edges are cut off."""
    return images if factor == 1 else in_blocks(images, factor).mean(axis=(2, 4))


def target_window(images: Images, peak: float, margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns to show: the target with a margin if its surroundings are dark, else the scored pixels.

    Pixels `DYNAMIC_RANGE_DB` below `peak` are dark; `margin` pixels on each side are not scored.
    """
    size = images.shape[1:]
    bright = brighter(images.max(axis=0), -DYNAMIC_RANGE_DB, peak)
    if not bright.any() or bright.mean() > 0.5:
        return slice(margin, size[0] - margin), slice(margin, size[1] - margin)
    spans = [np.flatnonzero(bright.any(axis=1 - axis))[[0, -1]] for axis in (0, 1)]
    side = max(int(span[1] - span[0]) for span in spans) + 1 + 2 * _MARGIN
    first = [(int(span.sum()) + 1 - side) // 2 for span in spans]
    rows, columns = (slice(max(start, 0), start + side) for start in first)  # cut where it leaves the image
    return rows, columns


def view_name(view: View) -> str:
    """E.g. azimuth 30°, grazing 17.4°."""
    return f"azimuth {round(view.azimuth_deg, 1):g}°, grazing {round(view.grazing_deg, 1):g}°{view.unusual}"


@dataclass(frozen=True)
class Part:
    """Window of an image grid that is shown; blocks of `factor` × `factor` pixels are averaged."""

    grid: ImageGrid
    rows: slice
    columns: slice
    factor: int = 1

    @classmethod
    def of(cls, grid: ImageGrid, window: tuple[slice, slice], largest: int) -> "Part":
        """A window, averaged over blocks of pixels until neither side has more than `largest` pixels."""
        rows, columns = (
            slice(*part.indices(size)) for part, size in zip(window, (grid.rows, grid.columns), strict=True)
        )
        side = max(rows.stop - rows.start, columns.stop - columns.start)
        return cls(grid, rows, columns, -(-side // largest))

    def of_images(self, images: Images) -> Real[np.ndarray, "v fewer_rows fewer_columns"]:
        """Crop and average images of a quantity that may be averaged."""
        return block_means(images[:, self.rows, self.columns], self.factor)

    @property
    def size(self) -> tuple[int, int]:
        """Shown rows and columns, after averaging."""
        rows, columns = ((part.stop - part.start) // self.factor for part in (self.rows, self.columns))
        return rows, columns

    def panel(self, title: str, alt: str, *, black: bool = True, **shown: str) -> Panel:
        """Panel with the axes of this part; `shown` names its image, drawing or canvas."""
        rows, columns = (
            slice(part.start, part.start + count * self.factor)
            for part, count in zip((self.rows, self.columns), self.size, strict=True)
        )
        left, right, bottom, top = self.grid.part(rows, columns).extent_m
        return Panel(
            title,
            alt,
            axis("azimuth, m", left, right),
            axis("slant range, m", top, bottom),
            aspect=(right - left) / (bottom - top),
            scale=scale_bar(right - left),
            radar=True,
            black=black,
            **shown,
        )

    def power(self, title: str, alt: str, image: Image, peak: float, drawing: str = "") -> Panel:
        """Panel of an image in decibels below the peak."""
        grey = indexed(shade(self.of_images(image[None])[0], peak), 0, 1)
        return self.panel(title, alt, image=address(grey), drawing=drawing)

    def difference(self, title: str, alt: str, difference: Image, largest: float) -> Panel:
        """Panel of a signed error."""
        shown = indexed(self.of_images(difference[None])[0], -largest, largest)
        return self.panel(title, alt, image=address(shown, ramp(DIFFERENCE)), black=False)


def power_bar() -> ColourBar:
    """Colour bar of `Part.power`."""
    return colour_bar("power, dB relative to the brightest training pixels", POWER, -DYNAMIC_RANGE_DB, 0)


# ---- errors ----------------------------------------------------------------------------------------------------------
def window(grid: ImageGrid) -> tuple[int, int, float]:
    """Rows and columns of the averaging window of residuals, and its number of independent samples.

    The smallest window of odd sides, at least 3 × 3 pixels, that holds a resolution cell; see
    `ImageGrid.independent_samples`.
    """
    columns, rows = (
        max(_LEAST_WINDOW, 2 * math.ceil((width / spacing - 1) / 2) + 1)
        for width, spacing in zip(grid.resolution_m, grid.spacing_m, strict=True)
    )
    share = grid.independent_samples / (grid.rows * grid.columns)
    return rows, columns, max(1.0, share * rows * columns)


@dataclass(frozen=True)
class Difference:
    """Error shown in figures: its label, range and explanation.

    `looks` is that of the true images (None without speckle), `peak` the power shown white.
    """

    looks: float | None
    grid: ImageGrid
    peak: float

    @property
    def largest(self) -> float:
        """End of the colour scale; larger values are clipped."""
        return _LARGEST_DB if self.looks is None else _LARGEST_SIGMA

    @property
    def label(self) -> str:
        """Label of the colour bar."""
        return "reconstruction over truth, dB" if self.looks is None else "residual ÷ σ of the speckle"

    @property
    def bar(self) -> ColourBar:
        """Colour bar of `Part.difference`."""
        return colour_bar(self.label, DIFFERENCE, -self.largest, self.largest)

    @property
    def explained(self) -> str:
        """Caption."""
        colours = f"{DIFFERENCE_IN_WORDS.capitalize()}."
        if self.looks is None:
            return (
                f"{colours} Values more than {DYNAMIC_RANGE_DB:g} dB below what is white in the images count as equal."
            )
        rows, columns, independent = window(self.grid)
        return (
            "Each reconstruction is shifted by up to 3 pixels and scaled to fit its image best, as in scoring. "
            f"{colours} The residual, reconstruction minus measured power averaged over {rows} × "
            f"{columns} pixels (the smallest odd window that holds a resolution cell), is divided by σ, the "
            f"standard deviation that speckle of {self.looks:g} look{'' if self.looks == 1 else 's'} leaves in that "
            f"average of {independent:.1f} independent samples: speckle alone gives values within about ±2."
        )

    def of(self, truth: Images, rendered: Images) -> Float64[np.ndarray, "v rows columns"]:
        """Error of rendered against true images, β⁰ in linear power [V, rows, columns].

        Without speckle 10·log10(rendered / truth), both at least −40 dB of the peak. With speckle of L looks (mean(S) −
        mean(I)) / √(mean(S²) / (L·n)), means over a window with n independent samples: I scatters around S by S/√L.
        """
        truth, rendered = truth.astype(np.float64), rendered.astype(np.float64)
        if self.looks is None:
            return difference_db(rendered, truth, self.peak, -DYNAMIC_RANGE_DB)
        rendered = np.maximum(rendered, self.peak * from_db(_DARKEST_DB))
        *size, independent = window(self.grid)
        sigma = np.sqrt(smoothed(rendered**2, *size) / (self.looks * independent))
        return smoothed(rendered - truth, *size) / sigma


def fitted(truth: Images, rendered: Images, looks: float | None, margin: int) -> Images:
    """Align rendered images as in scoring: under speckle, shift and scale them to fit the true images best."""
    if looks is None:
        return rendered
    try:
        best = register(truth, rendered, margin)
    except UndefinedScore:  # the evaluation gives the reason
        return rendered
    moved = [np.roll(image, tuple(shift), (0, 1)) for image, shift in zip(rendered, best.shift, strict=True)]
    return np.stack(moved) * best.gain[:, None, None]


# ---- pixel for pixel ------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Look:
    """Black and white levels and colour map of displayed power; raises if the range is not positive."""

    peak: float
    """Linear power that is white, or at the upper end of the colours."""
    range_db: float = DYNAMIC_RANGE_DB
    """Difference to black, or to the lower end of the colours, dB."""
    cmap: str = POWER
    """Name of a ramp (colours.py) or of a colour map of matplotlib, which all but grey need."""

    def __post_init__(self) -> None:
        if not 0 < self.range_db < math.inf:
            raise SarsplatError(f"a range of {self.range_db} dB cannot be shown; give a positive one, such as 40")

    def shade(self, power: Real[np.ndarray, "*pixels"]) -> Float[np.ndarray, "*pixels"]:
        """0 where it is black or darker, 1 where it is as bright as the peak or brighter."""
        return shade(power, self.peak, self.range_db)

    def palette(self) -> UInt8[np.ndarray, "256 3"]:
        """RGB of shades from 0 to 1; raises `SarsplatError` if the colour map does not exist."""
        return ramp(self.cmap)[:, :3]


def decibel_png(power: Real[np.ndarray, "rows columns"], look: Look) -> bytes:
    """One image as an 8-bit PNG, pixel for pixel, grey or with a palette.

    Parameters
    ----------
    power : numpy.ndarray, float [rows, columns]
        β⁰, linear power.
    look : Look
        Which power is white, and which is black.
    """
    from PIL import Image, PngImagePlugin

    low, high = ("black", "white") if look.cmap == POWER else ("lower end", "upper end")
    text = PngImagePlugin.PngInfo()
    text.add_text(
        "Description", f"beta0 in dB: {low} = -{look.range_db:g} dB, {high} = 0 dB of beta0 = {look.peak:.6g}"
    )
    shades = np.empty(power.shape, np.uint8)
    for first in range(0, len(power), _ROWS):
        shades[first : first + _ROWS] = np.round(255 * look.shade(power[first : first + _ROWS]))
    picture = Image.fromarray(shades)
    if look.cmap != POWER:
        picture.putpalette(look.palette().tobytes())
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", pnginfo=text)
    return buffer.getvalue()
