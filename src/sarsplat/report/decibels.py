"""Power as decibels, and decibels as grey or colours."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Real, UInt8

from sarsplat.errors import SarsplatError, shown

DYNAMIC_DB = 40.0
"""Pictures show this range below the brightest training pixel, dB; what is darker is black."""


OF_THE_BRIGHTEST = "power, dB of the brightest 0.1 %"
"""What 0 dB is on sheets, in words; see `bright_level`."""


def bright_level(power: Real[np.ndarray, "*pixels"]) -> float:
    """What the brightest 0.1 % of pixels exceed: a corner reflector does not darken all the rest; never 0."""
    return float(np.quantile(power, 0.999)) or float(power.max()) or 1.0


def to_decibels(power: np.ndarray | float, peak: float = 1.0) -> np.ndarray:
    """10·log10(power / peak), dB; powers below float32's smallest count as that, so that nothing is −inf."""
    smallest = float(np.finfo(np.float32).tiny)
    return 10 * np.log10(np.maximum(np.asarray(power, dtype=np.float64) / peak, smallest))


def difference_db(
    rendered: Real[np.ndarray, "*pixels"], truth: Real[np.ndarray, "*pixels"], peak: float, darkest_db: float
) -> Float64[np.ndarray, "*pixels"]:
    """Rendered over true power, dB; whatever is darker than `darkest_db` of the peak counts as equally dark."""
    floor = peak * 10 ** (darkest_db / 10)
    return to_decibels(np.maximum(rendered, floor)) - to_decibels(np.maximum(truth, floor))


@dataclass(frozen=True)
class Look:
    """How power is shown.

    Parameters
    ----------
    peak : float
        The power that is white, or at the upper end of the colours; linear.
    range_db : float
        How far below it black, or the lower end of the colours, is, dB.
    cmap : str
        Name of a colour map of matplotlib; "gray" needs no matplotlib.

    Raises
    ------
    SarsplatError
        If the range is not positive.
    """

    peak: float
    range_db: float = DYNAMIC_DB
    cmap: str = "gray"

    def __post_init__(self) -> None:
        if not 0 < self.range_db < math.inf:
            raise SarsplatError(f"a range of {self.range_db} dB cannot be shown; give a positive one, such as 40")

    def shade(self, power: Real[np.ndarray, "*pixels"]) -> Float[np.ndarray, "*pixels"]:
        """0 where it is black or darker, 1 where it is as bright as the peak or brighter."""
        return np.clip(1 + to_decibels(power, self.peak) / self.range_db, 0, 1)

    def palette(self) -> UInt8[np.ndarray, "256 3"]:
        """RGB of shades from 0 to 1.

        Raises
        ------
        SarsplatError
            If there is no such colour map, or matplotlib is missing.
        """
        if self.cmap == "gray":
            return np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
        try:
            from matplotlib import colormaps
        except ImportError as error:
            raise SarsplatError(
                "colours need matplotlib, which is not installed; install it with: pip install 'sarsplat[report]'"
            ) from error
        if self.cmap not in colormaps:
            raise SarsplatError(
                f"there is no colour map {shown(self.cmap)}; choose gray, viridis, magma, cividis, turbo or another of "
                "matplotlib's"
            )
        return np.round(255 * colormaps[self.cmap](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)


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

    low, high = ("black", "white") if look.cmap == "gray" else ("lower end", "upper end")
    text = PngImagePlugin.PngInfo()
    text.add_text(
        "Description", f"beta0 in dB: {low} = -{look.range_db:g} dB, {high} = 0 dB of beta0 = {look.peak:.6g}"
    )
    picture = Image.fromarray(np.round(255 * look.shade(power)).astype(np.uint8))
    if look.cmap != "gray":
        picture.putpalette(look.palette().tobytes())
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", pnginfo=text)
    return buffer.getvalue()
