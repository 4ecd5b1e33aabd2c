"""Pixels of the imaging plane with their labels, and rays of the computation plane."""

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from jaxtyping import Float64

from sarsplat.arguments import checks_arguments, described, expect, is_number
from sarsplat.errors import SarsplatError
from sarsplat.geometry.responses import GAUSSIAN, Response, response_of, variance_of, width_of

CLUTTER = 0
"""Label of a pixel (as in SARBake's masks) that shows neither target nor shadow."""

TARGET = 1
"""Label of a pixel that shows a surface of the target."""

SHADOW = 2
"""Label of a pixel that shows ground hidden by the target."""

_MIN_LENGTH, _MAX_LENGTH = 1e-6, 1e6  # m: beyond these, float32 squares go wrong long before physics does
_MAX_PIXELS = 1 << 17


def _check_pair(name: str, values: tuple[float, ...], least: float = _MIN_LENGTH) -> None:
    pair = isinstance(values, tuple | list) and len(values) == 2
    if not pair or not all(is_number(value) and least <= value <= _MAX_LENGTH for value in values):
        raise SarsplatError(f"{name} {described(values)} must be a pair of metres, {least:g} to {_MAX_LENGTH:g}")


@dataclass(frozen=True)
class ImageGrid:
    """Pixels of the imaging plane (azimuth × slant range).

    `image[row = range, column = azimuth]`; row 0 is near range, columns grow with +x_r. Pairs are (azimuth, range).

    Parameters
    ----------
    rows, columns : int
        Number of range rows and of azimuth columns.
    spacing_m : (float, float)
        Pixel spacing (Δa, Δr), m.
    resolution_m : (float, float)
        3 dB width of the power response (ρa, ρr), m. Not the same thing as the spacing.
    center_m : (float, float)
        Position (a0, r0) of the image centre in the radar frame, m; (0, 0) is the scene centre.
    response : Response
        Shape of the power response, the same along both axes; its 3 dB widths are `resolution_m`.
    """

    rows: int
    columns: int
    spacing_m: tuple[float, float]
    resolution_m: tuple[float, float]
    center_m: tuple[float, float] = (0.0, 0.0)
    response: Response = GAUSSIAN

    def __post_init__(self) -> None:
        expect(int, rows=self.rows, columns=self.columns)
        if min(self.rows, self.columns) < 1 or max(self.rows, self.columns) > _MAX_PIXELS:
            raise SarsplatError(
                f"an image of {self.rows} × {self.columns} pixels is empty or too large; give 1 to {_MAX_PIXELS} a side"
            )
        _check_pair("image centre", self.center_m, -_MAX_LENGTH)
        _check_pair("pixel spacing", self.spacing_m)
        _check_pair("resolution", self.resolution_m)
        for name in ("rows", "columns"):  # JSON cannot hold numpy's numbers
            object.__setattr__(self, name, int(getattr(self, name)))
        for name in ("spacing_m", "resolution_m", "center_m"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        expect(Response, response=self.response)

    @classmethod
    def of(cls, *, response: Any = None, **fields: Any) -> Self:
        """Make the grid that `as_dict` describes."""
        return cls(**fields, response=response_of(response))

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON, without a Gaussian response."""
        settings = {} if self.response == GAUSSIAN else {"response": self.response.as_dict()}
        return {name: value for name, value in vars(self).items() if name != "response"} | settings

    @property
    def response_variance_m2(self) -> tuple[float, float]:
        """Variance of the Gaussian of the response's 3 dB width along azimuth and range, m²."""
        azimuth, slant_range = self.resolution_m
        return variance_of(azimuth), variance_of(slant_range)

    def widened(self, azimuth_m2: float, range_m2: float) -> Self:
        """Return a grid whose response has variances larger by these amounts, m²."""
        azimuth, slant_range = self.resolution_m
        return replace(self, resolution_m=(width_of(azimuth_m2, azimuth), width_of(range_m2, slant_range)))

    @checks_arguments
    def multilooked(self, factor: int) -> "ImageGrid":
        """Return the grid of images whose pixels are means of power over blocks of these.

        The response is as much wider as a block is wide. Rows and columns that fill no block, at the far and the right
        end, are left out.

        Parameters
        ----------
        factor : int
            Pixels along each side of a block, at least 1.

        Raises
        ------
        SarsplatError
            If the image has no such block.
        """
        if not 1 <= factor <= min(self.rows, self.columns):
            raise SarsplatError(
                f"an image of {self.rows} × {self.columns} pixels has no blocks of {factor} × {factor}; give a factor "
                f"from 1 to {min(self.rows, self.columns)}"
            )
        rows, columns = self.rows // factor, self.columns // factor
        mean = [(factor**2 - 1) / 12 * spacing**2 for spacing in self.spacing_m]  # variance of places in a block
        blocks = self.part(slice(rows * factor), slice(columns * factor)).widened(*mean)
        azimuth, slant_range = (factor * spacing for spacing in self.spacing_m)
        return replace(blocks, rows=rows, columns=columns, spacing_m=(azimuth, slant_range))

    @property
    def independent_samples(self) -> float:
        """Samples of independent speckle in an image: its resolution cells, or its pixels where those are larger."""
        shares = (min(1.0, spacing / width) for spacing, width in zip(self.spacing_m, self.resolution_m, strict=True))
        return self.rows * self.columns * math.prod(shares)

    @property
    def cell_m(self) -> float:
        """Side of a resolution cell, m: the unit of a reconstruction's lengths and scores.

        The geometric mean over azimuth and range of the resolution, or of the pixel spacing where that is larger.
        """
        return math.sqrt(math.prod(map(max, self.resolution_m, self.spacing_m)))

    @property
    def azimuth_m(self) -> Float64[np.ndarray, " {self.columns}"]:
        """Azimuth x_m of the pixel columns' centres, m, float64 [columns]."""
        return (np.arange(self.columns) - (self.columns - 1) / 2) * self.spacing_m[0] + self.center_m[0]

    @property
    def range_m(self) -> Float64[np.ndarray, " {self.rows}"]:
        """Slant range r_n of the pixel rows' centres from the scene centre, m, float64 [rows]."""
        return (np.arange(self.rows) - (self.rows - 1) / 2) * self.spacing_m[1] + self.center_m[1]

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Edges of the image, m: azimuth on the left and right, slant range at the bottom (far) and top (near)."""
        half_azimuth, half_range = (count * step / 2 for count, step in zip((self.columns, self.rows), self.spacing_m))
        azimuth, slant_range = self.center_m
        return azimuth - half_azimuth, azimuth + half_azimuth, slant_range + half_range, slant_range - half_range

    def part(self, rows: slice, columns: slice) -> "ImageGrid":
        """Return the grid of a part of the image, at least one pixel."""
        azimuth, slant_range = self.azimuth_m[columns], self.range_m[rows]
        centre = ((azimuth[0] + azimuth[-1]) / 2, (slant_range[0] + slant_range[-1]) / 2)
        return replace(self, rows=len(slant_range), columns=len(azimuth), center_m=centre)


@dataclass(frozen=True)
class RayGrid:
    """Lattice of parallel rays on the computation plane, anchored at the radar frame's origin.

    Rays are at ((k + ½)·δx, (l + ½)·δy). The spacing is an accuracy setting: half the pixel spacing gives whole
    images good to 49–54 dB; truth images and evaluation use a quarter or less.

    Parameters
    ----------
    spacing_m : (float, float)
        Ray spacing (δx, δy), m.
    """

    spacing_m: tuple[float, float]

    def __post_init__(self) -> None:
        _check_pair("ray spacing", self.spacing_m)

    @classmethod
    @checks_arguments
    def for_image(cls, grid: ImageGrid, per_pixel: float = 2.0) -> "RayGrid":
        """Make a square lattice with `per_pixel` rays in the smaller pixel spacing."""
        spacing = min(grid.spacing_m) / per_pixel
        return cls((spacing, spacing))

    @property
    def cell_area(self) -> float:
        """Area A_c = δx·δy that one ray represents, m²."""
        return self.spacing_m[0] * self.spacing_m[1]
