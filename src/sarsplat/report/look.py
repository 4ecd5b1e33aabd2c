"""Display of power: black and white levels, colour map, and images pixel for pixel."""

import io
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Real, UInt8

from sarsplat.colours import POWER, ramp
from sarsplat.errors import SarsplatError
from sarsplat.radiometry import DYNAMIC_RANGE_DB, shade

_ROWS = 512  # of an image whose decibels are calculated at once


@dataclass(frozen=True)
class Look:
    """Black and white levels and colour map of displayed power.

    Parameters
    ----------
    peak : float
        The power that is white, or at the upper end of the colours; linear.
    range_db : float
        How far below it black, or the lower end of the colours, is, dB.
    cmap : str
        Name of a ramp (colours.py) or of a colour map of matplotlib, which all but grey need.

    Raises
    ------
    SarsplatError
        If the range is not positive.
    """

    peak: float
    range_db: float = DYNAMIC_RANGE_DB
    cmap: str = POWER

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
