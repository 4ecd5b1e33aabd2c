"""One image as a reader of some format returns it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Num

from sarsplat.arguments import expect_fields
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.geometry.responses import GAUSSIAN, Response


@dataclass(frozen=True)
class MeasuredImage:
    """One image as a reader returns it.

    Parameters
    ----------
    name : str
        Name in messages, e.g. its file.
    pixels : numpy.ndarray, complex64 or float32 [rows, columns], or complex64 [P, rows, columns]
        Complex amplitude if phase is available, otherwise linear power; row 0 near range, columns rising along the
        flight of a right-looking radar. Of a stack, those of each channel, coregistered, not deramped.
    view : View
        Direction of the radar.
    spacing_m, resolution_m : (float, float)
        Pixel spacing and 3 dB width of the power response (azimuth, slant range), m.
    center_m : (float, float)
        Centre of the image (azimuth, slant range), m from the scene centre.
    azimuth_std_deg : float
        Standard deviation of the azimuth, degrees; infinite if that is unknown.
    split : str or None
        Its set, if stated.
    response : Response
        Shape of the power response; Gaussian if unknown.
    stack : Stack or None
        The channels, if there are several.

    Raises
    ------
    SarsplatError
        If a field is of another type, or the pixels are no image.
    """

    name: str
    pixels: Num[np.ndarray, "*channels rows columns"]
    view: View
    spacing_m: tuple[float, float]
    resolution_m: tuple[float, float]
    center_m: tuple[float, float] = (0.0, 0.0)
    azimuth_std_deg: float = 0.0
    split: str | None = None
    response: Response = GAUSSIAN
    stack: Stack | None = None

    def __post_init__(self) -> None:
        expect_fields(self)
        kinds, sides = ("fc", 2) if self.stack is None else ("c", 3)
        if self.pixels.dtype.kind not in kinds or self.pixels.ndim != sides:
            single = "complex amplitudes, or power as float32, in rows and columns"
            raise SarsplatError(
                f"{self.name} holds {self.pixels.dtype} of shape {self.pixels.shape}; give "
                f"{single if self.stack is None else 'complex amplitudes of the channels of a stack'}"
            )

    @property
    def placed(self) -> bool:
        """True if the azimuth is known."""
        return self.azimuth_std_deg < math.inf

    @property
    def grid(self) -> ImageGrid:
        """Grid of its pixels."""
        rows, columns = self.pixels.shape[-2:]
        return ImageGrid(rows, columns, self.spacing_m, self.resolution_m, self.center_m, self.response)


def view_of(name: str, azimuth_deg: float, grazing_deg: float, tilt_deg: float = 0.0) -> View:
    """Return the view of the image with this name; errors begin with it."""
    try:
        return replace(View(azimuth_deg, grazing_deg, tilt_deg), azimuth_deg=azimuth_deg % 360)
    except SarsplatError as error:
        raise SarsplatError(f"{name}: {error}") from error
