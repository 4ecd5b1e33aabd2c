"""One SAR image with everything needed to compare it with another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Real

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View


@dataclass(frozen=True)
class SarImage:
    """A SAR intensity image: β⁰, linear power, cross-section per unit slant-plane area.

    Parameters
    ----------
    power : numpy.ndarray, float32 [rows, columns]
        β⁰ (or calibrated up to one common factor), linear power, ≥ 0; row 0 is near range. Amplitude is its root.
    view : View
        From where it was taken.
    grid : ImageGrid
        Where its pixels lie.

    Raises
    ------
    SarsplatError
        If it is no array of real numbers, its shape does not fit the grid, or a pixel is negative or not finite.
    """

    power: Real[np.ndarray, "rows columns"]
    view: View
    grid: ImageGrid

    def __post_init__(self) -> None:
        if not isinstance(self.power, np.ndarray) or self.power.dtype.kind not in "fiu":
            kind = self.power.dtype if isinstance(self.power, np.ndarray) else type(self.power).__name__
            raise SarsplatError(
                f"the image is of {kind}; give power as an array of real numbers (of complex ones, |x|²)"
            )
        expected = (self.grid.rows, self.grid.columns)
        if self.power.shape != expected:
            raise SarsplatError(f"the image has shape {self.power.shape} but its grid has {expected} (range × azimuth)")
        bad = ~(np.isfinite(self.power) & (self.power >= 0))
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise SarsplatError(
                f"the image holds {self.power[row, column]} at row {row}, column {column}; power must be finite and ≥ 0"
            )

    @property
    def amplitude(self) -> Float[np.ndarray, "rows columns"]:
        """√β⁰."""
        return np.sqrt(self.power)

    @property
    def decibels(self) -> Float[np.ndarray, "rows columns"]:
        """10·log10 β⁰; −inf where the power is zero."""
        with np.errstate(divide="ignore"):
            return 10 * np.log10(self.power)
