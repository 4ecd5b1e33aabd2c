"""A chip around a spot, cut out of a SICD and resampled to slant range × level azimuth of its own view.

The complex pixels are interpolated within their band, wherever in the spectrum that lies (`DeltaKCOAPoly`): it is moved
to zero, and back afterwards. So the phase stays what the file has: SICDs are at baseband, and a scatterer shows, at its
own pixel, the phase ±4π/λ times its range from the scene centre point, with the sign that the file states.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.polynomial.polynomial as polynomials
from jaxtyping import Complex64, Float64

from sarsplat.errors import SarsplatError
from sarsplat.geometry.responses import GAUSSIAN, Response
from sarsplat.importers.band_limited import interpolate, taps
from sarsplat.importers.sicd_file import Axis, Sicd
from sarsplat.importers.sicd_geometry import Layout, middle_of

_ASKEW = 0.05
"""Slope of an image's axes against ours from which on its side lobes run beside these."""


def spacing_of(sicd: Sicd, layout: Layout) -> tuple[float, float]:
    """Spacing (azimuth, range), m, that keeps all that the image holds; its own where the axes are parallel."""
    samples = np.abs(layout.slopes) / [[sicd.row.spacing_m], [sicd.column.spacing_m]]
    azimuth, away = 1 / samples.sum(axis=0)
    return float(azimuth), float(away)


def resolution_of(sicd: Sicd, layout: Layout) -> tuple[float, float]:
    """3 dB widths along (azimuth, range), m, of a response that falls off along rows and columns as a Gaussian does."""
    falls = layout.slopes / [[sicd.row.resolution_m], [sicd.column.resolution_m]]
    azimuth, away = 1 / np.linalg.norm(falls, axis=0)
    return float(azimuth), float(away)


def response_along(sicd: Sicd, layout: Layout) -> Response:
    """Shape of the response along azimuth and range: that of rows and columns, unless they differ or are askew."""
    one, other = np.sort(np.abs(layout.slopes), axis=0).max(axis=1)
    same = sicd.row.response == sicd.column.response and one < _ASKEW * other
    return sicd.row.response if same else GAUSSIAN


def chip(
    sicd: Sicd, layout: Layout, shape: tuple[int, int], spacing_m: tuple[float, float], absolute: bool
) -> Complex64[np.ndarray, "rows columns"]:
    """Complex amplitudes around the spot; nothing else of the image is read.

    Parameters
    ----------
    sicd, layout : Sicd, Layout
        The file, and where the ground lies in its image.
    shape : (int, int)
        Rows (range, near first) and columns (azimuth).
    spacing_m : (float, float)
        Of (azimuth, range), m, at most `spacing_of`.
    absolute : bool
        Whether the squared amplitude is to be β⁰, which the file must then say how to get.

    Raises
    ------
    SarsplatError
        If the image does not reach as far, a pixel is not finite, or what is said of β⁰ is not positive.
    """
    rows, columns = shape
    azimuth = (np.arange(columns) - (columns - 1) / 2) * spacing_m[0]
    away = (np.arange(rows) - (rows - 1) / 2) * spacing_m[1]
    place = layout.place_of(*(part.ravel() for part in np.meshgrid(azimuth, away)))
    pixel = sicd.pixel_of(place)
    least, most = pixel.min(axis=0), pixel.max(axis=0)
    if least.min() < -0.5 or (most > np.array(sicd.shape) - 0.5).any():
        asked = f"rows {least[0]:.0f} to {most[0]:.0f} and columns {least[1]:.0f} to {most[1]:.0f}"
        inside = np.all((pixel.mean(axis=0) >= 0) & (pixel.mean(axis=0) <= np.array(sicd.shape) - 1))
        size = " × ".join(f"{axis.spacing_m * count:.4g} m" for axis, count in zip(sicd.axes, sicd.shape, strict=True))
        raise SarsplatError(
            f"{sicd.path} shows rows 0 to {sicd.shape[0] - 1} and columns 0 to {sicd.shape[1] - 1} ({size}), but "
            f"{asked} are asked for; give a smaller --size{'' if inside else ' or another spot'}: {middle_of(sicd)}"
        )
    occupied = sicd.row.occupied, sicd.column.occupied
    margin = np.array([taps(share) for share in occupied])
    first = np.maximum(np.floor(least).astype(int) - margin, 0)
    last = np.minimum(np.ceil(most).astype(int) + margin + 1, sicd.shape)
    part = sicd.read((int(first[0]), int(last[0])), (int(first[1]), int(last[1])))
    middle = sicd.place_of((least + most) / 2)
    lattice = np.stack(np.meshgrid(*map(np.arange, first, last), indexing="ij"), axis=-1).astype(np.float64)
    centred = part * np.exp(2j * np.pi * _carrier(sicd, middle, sicd.place_of(lattice)))
    values = interpolate(centred.astype(np.complex64), pixel[:, 0] - first[0], pixel[:, 1] - first[1], occupied)
    factor = np.exp(-2j * np.pi * _carrier(sicd, middle, place))
    if absolute and sicd.beta_zero is not None:
        power = _polynomial(sicd.beta_zero, place)
        if not (power > 0).all():
            raise SarsplatError(
                f"{sicd.path} has a BetaZeroSFPoly that is {power.min():.4g} around the spot; it must be positive"
            )
        # what is laid out on a level azimuth axis takes more of the plane than it does in the tilted slant plane
        factor = factor * np.sqrt(power * math.cos(math.radians(layout.tilt_deg)))
    return (values * factor).astype(np.complex64).reshape(shape)


def _carrier(
    sicd: Sicd, middle: Float64[np.ndarray, " 2"], place: Float64[np.ndarray, "*n 2"]
) -> Float64[np.ndarray, "*n"]:
    """Cycles, with their sign, that bring the centre of the band to zero, at places (xrow, ycol)."""
    in_middle = np.stack([place[..., 0], np.full_like(place[..., 1], middle[1])], axis=-1)
    return _cycles(sicd.row, 0, in_middle) + _cycles(sicd.column, 1, place)


def _cycles(axis: Axis, number: int, place: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n"]:
    return axis.sign * _polynomial(polynomials.polyint(axis.carrier, axis=number), place)


def _polynomial(
    coefficients: Float64[np.ndarray, "m n"], place: Float64[np.ndarray, "*n 2"]
) -> Float64[np.ndarray, "*n"]:
    return np.asarray(polynomials.polyval2d(place[..., 0], place[..., 1], coefficients), np.float64)
