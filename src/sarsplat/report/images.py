"""Arrays as pictures inside a page, and SAR images as its panels: axes in metres, a scale bar, and the radar above."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Real, UInt8

from sarsplat.colours import DIFFERENCE, POWER, Palette, ramp
from sarsplat.data.image import in_blocks
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import DYNAMIC_RANGE_DB, brighter, shade
from sarsplat.report.figure import ColourBar, Panel, axis, colour_bar, scale_bar
from sarsplat.report.residual import Difference

Image = Real[np.ndarray, "rows columns"]

_MARGIN = 5  # pixels around the target


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


def block_means(
    images: Real[np.ndarray, "v rows columns"], factor: int
) -> Real[np.ndarray, "v fewer_rows fewer_columns"]:
    """Means over blocks of `factor` × `factor` pixels; incomplete blocks at the far edges are cut off."""
    return images if factor == 1 else in_blocks(images, factor).mean(axis=(2, 4))


def target_window(images: Real[np.ndarray, "v rows columns"], peak: float, margin: int = 0) -> tuple[slice, slice]:
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
    def of(cls, grid: ImageGrid, window: tuple[slice, slice], largest: int) -> Part:
        """A window, averaged over blocks of pixels until neither side has more than `largest` pixels."""
        rows, columns = (
            slice(*part.indices(size)) for part, size in zip(window, (grid.rows, grid.columns), strict=True)
        )
        side = max(rows.stop - rows.start, columns.stop - columns.start)
        return cls(grid, rows, columns, -(-side // largest))

    def of_images(self, images: Real[np.ndarray, "v rows columns"]) -> Real[np.ndarray, "v fewer_rows fewer_columns"]:
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


def difference_bar(difference: Difference) -> ColourBar:
    """Colour bar of `Part.difference`."""
    return colour_bar(difference.label, DIFFERENCE, -difference.largest, difference.largest)
