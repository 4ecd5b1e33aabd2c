"""Chips around a spot, cut out of a SICD and resampled to the slant range × azimuth of its view.

The complex pixels are interpolated within their band, which is moved to zero and back (`DeltaKCOAPoly`). So the phase
stays that of the file: a scatterer has, at its own pixel, ±4π/λ times its range from the scene centre point, with the
stated sign.

Coregistered SICDs of one scene, passes or polarisations, become the channels of one view, that of the first file. The
phase of a scatterer in another file is that of its range from the file's antenna, referred to the range of the scene
centre point. On level ground through the spot it is replaced by that of parallel rays (`Stack.plane_phases`), which
removes wavefront curvature; higher scatterers keep their difference, and the spot has the same phase in all passes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.polynomial.polynomial as polynomials
from jaxtyping import Complex64, Float64

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid, Place, Stack
from sarsplat.geometry.responses import GAUSSIAN, Response
from sarsplat.geometry.stack import POLARISATIONS
from sarsplat.importers.band_limited import interpolate, taps
from sarsplat.importers.files import raise_damaged
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.phase_history import SPEED_OF_LIGHT
from sarsplat.importers.sicd_file import Axis, Sicd
from sarsplat.importers.sicd_geometry import Layout, antenna_at, middle_of, on_ground
from sarsplat.radiometry import to_db

_ASKEW = 0.05  # maximum slope between axes of image and view at which side lobes run along the latter
_APART = 0.1  # maximum distance between the corners of equal grids, pixels
_SAME_FREQUENCY = 1e-4  # relative tolerance of equal centre frequencies
_SAME_DB = 0.3  # maximum difference of calibrations by the angles of the scene centre point and those of the spot, dB

_UNSTACKED = "leave out `stack`"
_DIGITS = 8  # significant decimals of offsets, rad: the rest is rounding, millimetres of the antenna's position


def spacing_of(sicd: Sicd, layout: Layout) -> tuple[float, float]:
    """Return the coarsest spacing (azimuth, range), m, that keeps the image's band."""
    samples = np.abs(layout.slopes) / [[sicd.row.spacing_m], [sicd.column.spacing_m]]
    azimuth, away = 1 / samples.sum(axis=0)
    return float(azimuth), float(away)


def resolution_of(sicd: Sicd, layout: Layout) -> tuple[float, float]:
    """Return 3 dB widths along (azimuth, range), m, of a response that is Gaussian along rows and columns."""
    falls = layout.slopes / [[sicd.row.resolution_m], [sicd.column.resolution_m]]
    azimuth, away = 1 / np.linalg.norm(falls, axis=0)
    return float(azimuth), float(away)


def response_along(sicd: Sicd, layout: Layout) -> Response:
    """Return the response along azimuth and range: that of rows and columns, Gaussian if they differ or are askew."""
    one, other = np.sort(np.abs(layout.slopes), axis=0).max(axis=1)
    same = sicd.row.response == sicd.column.response and one < _ASKEW * other
    return sicd.row.response if same else GAUSSIAN


def chip(
    sicd: Sicd, layout: Layout, shape: tuple[int, int], spacing_m: tuple[float, float], absolute: bool
) -> Complex64[np.ndarray, "rows columns"]:
    """Resample complex amplitudes around the spot, range (near first) × azimuth; read nothing else of the image.

    `spacing_m` of (azimuth, range) is at most `spacing_of`; the squared amplitude is β⁰ if `absolute`, for which the
    file must state the factor. Raises if the image is too small, a pixel is not finite, or the factor not positive.
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
            f"{asked} are asked for; give a smaller `size_m`{'' if inside else ' or another spot'}: {middle_of(sicd)}"
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
    if absolute:
        name, polynomial = next(iter(sicd.calibration.items()))
        power = _polynomial(polynomial, place)
        if not (power > 0).all():
            raise_damaged(sicd.path, f"has a {name}SFPoly that is {power.min():.4g}, not positive, around the spot")
        factor = factor * np.sqrt(power * _to_beta0(sicd, layout)[name])
    return (values * factor).astype(np.complex64).reshape(shape)


def _to_beta0(sicd: Sicd, layout: Layout) -> dict[str, float]:
    """Return factors from each calibrated quantity of a file to β⁰ of the view.

    Pixels with a level azimuth axis are larger than in a tilted slant plane. With the slope s of the view's image plane
    and the grazing angle θ, β⁰ = σ⁰ / cos s and σ⁰ = γ⁰ sin θ; RCS belongs to a peak, whose response has an area.
    """
    cos_slope, sin_grazing = float(layout.view.look.frame[1, 2]), -float(layout.view.look.frame[2, 2])
    area = math.prod(axis.area_per_width / axis.bandwidth for axis in sicd.axes)
    return {
        "BetaZero": math.cos(math.radians(layout.tilt_deg - layout.view.tilt_deg)),
        "SigmaZero": 1 / cos_slope,
        "GammaZero": sin_grazing / cos_slope,
        "RCS": abs(float(np.linalg.det(layout.slopes))) / area,
    }


def contradictory_calibration(sicd: Sicd, layout: Layout) -> str | None:
    """Return a sentence if the polynomials of a file differ about β⁰ at the spot; None if not."""
    spot = layout.place_of(np.zeros(1), np.zeros(1))
    factors = {
        name: by * float(_polynomial(sicd.calibration[name], spot)[0])
        for name, by in _to_beta0(sicd, layout).items()
        if name in sicd.calibration
    }
    used, *others = factors
    apart = {name: abs(float(to_db(factors[name] / factors[used]))) for name in others if factors[used] > 0}
    wrong = [f"{name}SFPoly by {decibels:.1f} dB" for name, decibels in apart.items() if decibels > _SAME_DB]
    return f"β⁰ by {used}SFPoly of {sicd.path.name}, which is used, differs from {', '.join(wrong)}" if wrong else None


def _carrier(
    sicd: Sicd, middle: Float64[np.ndarray, " 2"], place: Float64[np.ndarray, "*n 2"]
) -> Float64[np.ndarray, "*n"]:
    """Return signed cycles that bring the centre of the band to zero, at places (xrow, ycol)."""
    in_middle = np.stack([place[..., 0], np.full_like(place[..., 1], middle[1])], axis=-1)
    return _cycles(sicd.row, 0, in_middle) + _cycles(sicd.column, 1, place)


def _cycles(axis: Axis, number: int, place: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n"]:
    return axis.sign * _polynomial(polynomials.polyint(axis.carrier, axis=number), place)


def _polynomial(
    coefficients: Float64[np.ndarray, "m n"], place: Float64[np.ndarray, "*n 2"]
) -> Float64[np.ndarray, "*n"]:
    return np.asarray(polynomials.polyval2d(place[..., 0], place[..., 1], coefficients), np.float64)


def stack_image(
    name: str,
    sicds: Sequence[Sicd],
    spot: Place,
    layout: Layout,
    shape: tuple[int, int],
    spacing_m: tuple[float, float],
    absolute: bool,
) -> MeasuredImage:
    """Make one view around a spot of files on one grid, its channels; the view is that of the first.

    `layout` is the first's; see `chip` for the rest. Raises if there are fewer than two files, their grids or
    frequencies differ, polarisations are not stated, two are equal, or one is too small.
    """
    if len(sicds) < 2:
        raise SarsplatError(f"{sicds[0].path} is one file; a stack needs several, so add the others, or {_UNSTACKED}")
    first = sicds[0]
    for sicd in sicds[1:]:
        apart = float(np.linalg.norm(_corners(first) - _corners(sicd), axis=1).max())
        if first.shape != sicd.shape or not apart <= _APART * min(axis.spacing_m for axis in first.axes):
            raise SarsplatError(
                f"{sicd.path} has another grid than {first.path}: {shown(sicd.shape)} and {shown(first.shape)} pixels, "
                f"corners up to {apart:.3g} m apart; coregister them to one grid, or {_UNSTACKED}"
            )
    origin = layout.place_of(np.zeros(1), np.zeros(1))
    lines = [spot.axes @ (antenna_at(sicd, origin)[0][0] - spot.ecef) for sicd in sicds]
    seen = np.array(lines) @ layout.view.look.frame.T
    offsets = np.round(seen[:, 1] / -seen[:, 2], _DIGITS) + 0.0  # of elevation alone; no negative zero
    names = ", ".join(sicd.path.name for sicd in sicds)
    try:
        stack = Stack(_wavelength(sicds), tuple(map(float, offsets)), polarisations=_polarisations(sicds))
    except SarsplatError as error:
        raise SarsplatError(f"{names} are no stack: {error}") from error
    grid = ImageGrid(*shape, spacing_m, resolution_of(first, layout), response=response_along(first, layout))
    plane = stack.plane_phases(layout.view, grid)
    azimuth, away = (part.ravel() for part in np.meshgrid(grid.azimuth_m, grid.range_m))
    reference = _ranges(first, spot, layout, azimuth, away) - np.linalg.norm(lines[0])
    signals = []
    for sicd, level in zip(sicds, plane, strict=True):
        pixels = chip(sicd, layout, shape, spacing_m, absolute)
        if sicd.row.sign > 0:  # phase rises with distance
            pixels = pixels.conj()
        to_centre = np.linalg.norm(antenna_at(sicd, np.zeros((1, 2)))[0] - sicd.projection.SCP)
        farther = _ranges(sicd, spot, layout, azimuth, away) - to_centre - reference
        phase = stack.wavenumber * farther.reshape(shape) + level - plane[0]
        signals.append((pixels * np.exp(1j * phase)).astype(np.complex64))
    pixels = np.stack(signals)
    return MeasuredImage(name, pixels, layout.view, spacing_m, grid.resolution_m, response=grid.response, stack=stack)


def _ranges(
    sicd: Sicd, spot: Place, layout: Layout, azimuth_m: Float64[np.ndarray, " n"], range_m: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Return the range from the antenna to level ground in each pixel, m."""
    ground = spot.to_ecef(on_ground(layout.view, azimuth_m, range_m))
    antennas, _ = antenna_at(sicd, layout.place_of(azimuth_m, range_m))
    distances: Float64[np.ndarray, " n"] = np.linalg.norm(antennas - ground, axis=1)
    return distances


def _corners(sicd: Sicd) -> Float64[np.ndarray, "4 3"]:
    """Return the corners of an image, ECEF, m."""
    rows, columns = sicd.shape
    places = sicd.place_of(np.array([[0, 0], [0, columns - 1], [rows - 1, 0], [rows - 1, columns - 1]], np.float64))
    metadata = sicd.projection
    corners: Float64[np.ndarray, "4 3"] = metadata.SCP + places @ np.array([metadata.uRow, metadata.uCol])
    return corners


def _wavelength(sicds: Sequence[Sicd]) -> float:
    """Return the wavelength of the centre frequency, m."""
    frequencies = []
    for sicd in sicds:
        if sicd.frequency_hz is None:
            raise_damaged(sicd.path, "does not state its frequencies (TxFrequencyProc)")
        frequencies.append(sicd.frequency_hz)
    if np.ptp(frequencies) > _SAME_FREQUENCY * frequencies[0]:
        raise SarsplatError(
            f"centre frequencies are {min(frequencies) / 1e9:.6g} to {max(frequencies) / 1e9:.6g} GHz; give files of "
            f"one, or {_UNSTACKED}"
        )
    return SPEED_OF_LIGHT / frequencies[0]


def _polarisations(sicds: Sequence[Sicd]) -> tuple[str, ...] | None:
    """Return received-transmitted polarisations, reversed in the files; None if all state the same unknown one."""
    stated = [sicd.collection.get("polarization", "") for sicd in sicds]
    names = tuple("".join(part[:1] for part in reversed(text.split(":"))) for text in stated)
    if set(names) <= set(POLARISATIONS):
        return names
    if len(set(stated)) == 1:
        return None
    other = next(text for text, name in zip(stated, names, strict=True) if name not in POLARISATIONS)
    raise SarsplatError(f"a polarisation is {shown(other)} (transmitted, received); give files of H, V, RHC or LHC")
