"""An image as a frame of an animation: its picture, and below it where it was taken from and its scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Real, UInt8

from sarsplat.geometry import ImageGrid, View
from sarsplat.report.figure import nice
from sarsplat.report.look import Look

if TYPE_CHECKING:
    from PIL import ImageDraw, ImageFont

# Pixels.
_SIDE, _LARGEST = 480, 1920  # of the picture's longer side: small images grow to the one, large ones shrink
_NARROWEST = 440  # what is written below needs that much
_FOOT, _TEXT, _MARGIN = 30, 14, 10
_BAR = (64, 6)  # of the decibels

_INK = 190  # shade of what is written: it is not to outshine the picture


@dataclass(frozen=True)
class Framing:
    """Conversion of images on a grid to frames of an animation."""

    grid: ImageGrid
    look: Look

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the picture, pixels, even; a metre is as long in azimuth as in slant range."""
        grid = self.grid
        extent = (grid.columns * grid.spacing_m[0], grid.rows * grid.spacing_m[1])
        per_metre = min(max(1 / min(grid.spacing_m), _SIDE / max(extent)), _LARGEST / max(extent))
        width, height = (max(2, 2 * round(length * per_metre / 2)) for length in extent)
        return width, height

    def shades(self, power: Real[np.ndarray, "rows columns"], view: View) -> UInt8[np.ndarray, "height width"]:
        """The frame of β⁰ (linear power) from a view, as indices into the palette of its look; near range is on top."""
        from PIL import Image, ImageDraw

        width, height = self.picture_size
        shade = Image.fromarray(self.look.shade(power).astype(np.float32))
        picture = np.asarray(shade.resize((width, height), Image.Resampling.BICUBIC))
        frame = Image.new("L", (max(width, _NARROWEST), height + _FOOT))
        frame.paste(Image.fromarray(np.uint8(np.round(255 * np.clip(picture, 0, 1)))), ((frame.width - width) // 2, 0))
        self._write_below(ImageDraw.Draw(frame), frame.width, height + _FOOT // 2, view)
        return np.asarray(frame)

    def _write_below(self, draw: ImageDraw.ImageDraw, width: int, middle: int, view: View) -> None:
        def write(x: float, text: str, anchor: str) -> None:
            draw.text((x, middle), text, fill=_INK, font=_font(), anchor=anchor)

        write(_MARGIN, f"azimuth {view.azimuth_deg % 360:.0f}°", "lm")
        write(_MARGIN + 100, f"grazing {view.grazing_deg:.0f}°", "lm")
        length_m = nice(self.grid.columns * self.grid.spacing_m[0] / 5)
        pixels = round(length_m * self.picture_size[0] / (self.grid.columns * self.grid.spacing_m[0]))
        right = width - _MARGIN
        draw.line([(right - pixels, middle), (right, middle)], fill=_INK)
        for x in (right - pixels, right):
            draw.line([(x, middle - 3), (x, middle + 3)], fill=_INK)
        write(right - pixels - 6, f"{length_m:g} m", "rm")
        left = (width - _BAR[0]) // 2 + 24
        for x in range(_BAR[0]):
            top, bottom = middle - _BAR[1] // 2, middle + _BAR[1] // 2
            draw.line([(left + x, top), (left + x, bottom)], fill=round(255 * x / (_BAR[0] - 1)))
        write(left - 4, f"-{self.look.range_db:g}", "rm")
        write(left + _BAR[0] + 4, "0 dB", "lm")


@lru_cache(maxsize=1)
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(_TEXT)
