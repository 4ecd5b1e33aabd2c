"""One SAR image with everything needed to compare it with another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Real
from torch import Tensor

from sarsplat.data.files import write_bytes
from sarsplat.data.picture import open_window, picture_png
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View

_DYNAMIC_RANGE_DB = 40.0

_LARGEST_POWER = 1e18  # 180 dB: beyond any calibration, and its square still fits into float32


@dataclass(frozen=True)
class SarImage:
    """A SAR intensity image: β⁰, linear power, cross-section per unit slant-plane area.

    Parameters
    ----------
    power : numpy.ndarray, float32 [rows, columns]
        β⁰ (or calibrated up to one common factor), linear power, ≥ 0; row 0 is near range. Amplitude is its root.
        A torch.Tensor, such as an image of `render`, is copied to an array.
    view : View
        From where it was taken.
    grid : ImageGrid
        Where its pixels lie.

    Raises
    ------
    SarsplatError
        If it is no array of real numbers, its shape does not fit the grid, or a pixel is negative, above 10¹⁸ or
        not finite.
    """

    power: Real[np.ndarray, "rows columns"]
    view: View
    grid: ImageGrid

    def __post_init__(self) -> None:
        if isinstance(self.power, Tensor):
            object.__setattr__(self, "power", self.power.detach().cpu().numpy())
        if not isinstance(self.power, np.ndarray) or self.power.dtype.kind not in "fiu":
            kind = self.power.dtype if isinstance(self.power, np.ndarray) else type(self.power).__name__
            raise SarsplatError(
                f"the image is of type {kind}; give power as an array of real numbers (for complex data, |x|²)"
            )
        expected = (self.grid.rows, self.grid.columns)
        if self.power.shape != expected:
            raise SarsplatError(f"the image has shape {self.power.shape} but its grid has {expected} (range × azimuth)")
        check_power(self.power, "the image")

    @property
    def amplitude(self) -> Float[np.ndarray, "rows columns"]:
        """√β⁰."""
        return np.sqrt(self.power)

    def db(self) -> Float[np.ndarray, "rows columns"]:
        """10·log10 β⁰, dB; −inf where the power is zero."""
        with np.errstate(divide="ignore"):
            return 10 * np.log10(self.power)

    def save(self, path: str | Path, *, dynamic_range_db: float = _DYNAMIC_RANGE_DB) -> None:
        """Write a picture of it as PNG, whole or not at all: decibels in grey, axes in metres, a colour bar.

        Parameters
        ----------
        path : str or Path
            File to write; it must end in `.png`, and is replaced if it exists. For numbers there are
            `sarsplat.data.write_power_tiff` and datasets.
        dynamic_range_db : float
            What is this far below the brightest pixel is black, dB.

        Raises
        ------
        SarsplatError
            If matplotlib is not installed, the name does not end in `.png`, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".png":
            raise SarsplatError(
                f"{path} does not end in .png, the only supported picture format; choose a name that does"
            )
        write_bytes(path, picture_png(self, dynamic_range_db))

    def show(self, *, dynamic_range_db: float = _DYNAMIC_RANGE_DB) -> None:
        """Open a window with the picture, or show it in a notebook.

        Raises
        ------
        SarsplatError
            If matplotlib is not installed.
        """
        open_window(self, dynamic_range_db)

    def _repr_png_(self) -> bytes | None:
        """What a notebook shows; nothing without matplotlib."""
        try:
            return picture_png(self, _DYNAMIC_RANGE_DB)
        except SarsplatError:
            return None


def check_power(power: Real[np.ndarray, "*shape"], name: str) -> None:
    """Raise SarsplatError if a pixel is negative, absurdly large or not finite; `name` is what to call the image."""
    if power.size == 0 or (power.min() >= 0 and power.max() <= _LARGEST_POWER):  # false if there is any NaN
        return
    place = tuple(int(i) for i in np.argwhere(~((power >= 0) & (power <= _LARGEST_POWER)))[0])
    raise SarsplatError(
        f"{name} holds {power[place]:.6g} at {place}; power must be finite and ≥ 0, at most {_LARGEST_POWER:g}"
    )
