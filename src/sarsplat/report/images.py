"""SAR images as panels: decibels in grey, axes in metres, a scale bar, and the radar above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Real

from sarsplat.colours import DIFFERENCE, POWER, ramp
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import DYNAMIC_RANGE_DB, shade
from sarsplat.report.figure import ColourBar, Panel, axis, colour_bar, scale_bar
from sarsplat.report.raster import block_means, data_uri, indexed, png
from sarsplat.report.residual import Difference

Image = Real[np.ndarray, "rows columns"]


def view_name(view: View) -> str:
    """E.g. azimuth 30°, grazing 17.4°."""
    return f"azimuth {round(view.azimuth_deg, 1):g}°, grazing {round(view.grazing_deg, 1):g}°"


@dataclass(frozen=True)
class Part:
    """The part of images that is shown, and how many pixels of a side become one."""

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
        """The part of images of any quantity that may be averaged."""
        return block_means(images[:, self.rows, self.columns], self.factor)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of what is shown."""
        rows, columns = ((part.stop - part.start) // self.factor for part in (self.rows, self.columns))
        return rows, columns

    def panel(
        self, title: str, alt: str, image: str = "", drawing: str = "", canvas: str = "", black: bool = True
    ) -> Panel:
        """A panel with the axes of this part."""
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
            image=image,
            scale=scale_bar(right - left),
            radar=True,
            drawing=drawing,
            canvas=canvas,
            black=black,
        )

    def power(self, title: str, alt: str, image: Image, peak: float, drawing: str = "") -> Panel:
        """An image in decibels below the peak."""
        grey = indexed(shade(self.of_images(image[None])[0], peak), 0, 1)
        return self.panel(title, alt, data_uri(png(grey)), drawing=drawing)

    def difference(self, title: str, alt: str, difference: Image, largest: float) -> Panel:
        """A signed error."""
        shown = indexed(self.of_images(difference[None])[0], -largest, largest)
        return self.panel(title, alt, data_uri(png(shown, ramp(DIFFERENCE))), black=False)


def power_bar() -> ColourBar:
    """What the greys of `Part.power` mean."""
    return colour_bar("power, dB relative to the brightest training pixel", POWER, -DYNAMIC_RANGE_DB, 0)


def difference_bar(difference: Difference) -> ColourBar:
    """What the colours of `Part.difference` mean."""
    return colour_bar(difference.label, DIFFERENCE, -difference.largest, difference.largest)
