"""Import single-look complex images in NISAR's layout (RSLC): one view, of several polarisations a stack.

Rows of a file are azimuth times and columns slant ranges, at zero Doppler; they become columns and rows. Phases are
exp(−jkR) in both file and `Stack`. The file names polarisations transmitted-received, a `Stack` received-transmitted.
With one antenna, HV and VH of a scene are equal but for noise, and their mean is one channel, HV, unless both are
asked for.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from jaxtyping import Complex64

from sarsplat.arguments import checks_arguments
from sarsplat.data import folders
from sarsplat.data.dataset import Dataset
from sarsplat.data.dataset_folder import HEADER
from sarsplat.data.header import Calibration
from sarsplat.errors import SarsplatError
from sarsplat.geometry import Place, Stack, View
from sarsplat.importers.about import AboutImages
from sarsplat.importers.files import check_pixel, raise_damaged
from sarsplat.importers.images import dataset_of, said_of_heading, sides_of, write_imported
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.phase_history import SPEED_OF_LIGHT
from sarsplat.importers.rslc_file import Rslc, read_rslc
from sarsplat.names import CrossPolarised
from sarsplat.radiometry import to_db

_HIGHER_M = 10.0  # height step of the derivative of a place by its height, m
_UNWEIGHTED = 0.886  # width of a response at half power, for a band of 1 without weights


@checks_arguments
def import_rslc(
    file: str | Path,
    out: str | Path,
    *,
    size_m: float,
    images: str | None = None,
    pixel: tuple[float, float] | None = None,
    height_m: float = 0.0,
    heading_deg: float = 90.0,
    cross: CrossPolarised = "mean",
    target: str = "unnamed",
    calibration: Calibration = "relative",
    overwrite: bool = False,
    **about: Unpack[AboutImages],
) -> Dataset:
    """Import an RSLC file in NISAR's layout (HDF5): the surroundings of one spot, in the polarisations it has.

    Parameters
    ----------
    file : Path
        RSLC file (HDF5).
    out : Path
        Dataset folder to write.
    size_m : float
        Side of the image in azimuth and slant range, e.g. 200m.
    images : str, optional
        Sensor and frequency of the images, such as LSAR/frequencyB; the first of the file unless given.
    pixel : (row, column), optional
        The spot, which becomes the origin: azimuth time and slant range, counted from 0. Without it, the middle.
    height_m : float
        Height of the spot above the ellipsoid, m; the view's direction depends on it a little.
    heading_deg : float
        Compass heading of the scene's x axis, degrees clockwise from north; 90 is east.
    cross : {"mean", "both"}
        HV and VH become one channel, their mean, or stay both.
    target : str
        Name of the target.
    calibration : {"absolute", "relative"}
        Calibration of the power: β⁰ itself, or up to one factor, the same for all polarisations.
    overwrite : bool
        Replace an existing dataset.
    **about
        Looks, ground, terrain and the target's box: see `AboutImages`.

    Returns
    -------
    Dataset
        One view, whose channels are the file's polarisations; of one polarisation, a complex image.

    Raises
    ------
    SarsplatError
        If h5py is not installed, the file is not a valid RSLC or does not contain the image, or the output exists.
    """
    folders.refuse_existing(Path(out), overwrite, marker=HEADER)
    rslc = read_rslc(Path(file), images)
    spot = (rslc.shape[0] // 2, rslc.shape[1] // 2) if pixel is None else pixel
    check_pixel(rslc.path, spot, rslc.shape)
    view, spacing, widths, wider = _seen(rslc, spot, height_m, heading_deg)
    place, told = _place(rslc, spot, height_m, heading_deg)
    lines, samples = _cut(rslc, spot, size_m, spacing)
    signals = {
        name[::-1]: np.ascontiguousarray(rslc.read(name, lines, samples).T[:, :: 1 if rslc.look == "right" else -1])
        for name in rslc.polarisations
    }  # received, transmitted; columns run along the flight of a right-looking radar
    assumptions = [_cross(signals)] if cross == "mean" and {"HV", "VH"} <= signals.keys() else []
    names = tuple(sorted(signals))  # HH, HV, VH, VV
    middle = [(low + high - 1) / 2 - at for (low, high), at in zip((lines, samples), spot, strict=True)]
    several = len(names) > 1
    image = MeasuredImage(
        rslc.path.stem,
        np.stack([signals[name] for name in names]) if several else signals[names[0]],
        view,
        spacing,
        widths,
        center_m=(middle[0] * spacing[0] * (1 if rslc.look == "right" else -1), middle[1] * spacing[1]),
        stack=Stack(SPEED_OF_LIGHT / rslc.frequency_hz, (0.0,) * len(names), polarisations=names) if several else None,
    )
    source: dict[str, Any] = {
        "kind": "rslc",
        "file": rslc.path.name,
        "mission": rslc.mission,
        "look": rslc.look,
        "pixel": list(spot),
        "heading_deg": heading_deg,
        "assumptions": [
            f"the origin of the scene is pixel {spot[0]:g}, {spot[1]:g}, {height_m:g} m above the ellipsoid, and the "
            "ground there is level at z = 0",
            *told,
            said_of_heading(heading_deg),
            "what is farther away has less phase in the file, whose polarisations are named by what is transmitted and "
            "what is received" + f"; it has one, {rslc.polarisations[0]}" * (not several),
            *assumptions,
            *(
                f"the file also has {name} ({', '.join(names)}), which is left out; `images='{name}'` imports it"
                for name, names in rslc.others.items()
            ),
            "the resolution is that of the processed bandwidths, without weights"
            + ", as far as the pixels hold them: the file states wider ones" * wider,
        ],
    }
    dataset = dataset_of([image], target=target, source=source, calibration=calibration, place=place, **about)
    return write_imported(out, dataset, overwrite=overwrite)


def _seen(
    rslc: Rslc, spot: tuple[float, float], height_m: float, heading_deg: float
) -> tuple[View, tuple[float, float], tuple[float, float], bool]:
    """Return view, pixel spacing and 3 dB widths (azimuth, range) of the spot, m, and whether the stated band exceeds
    the sampled one.
    """
    east, north, speed = rslc.geolocation.at(height_m, *rslc.time_and_range(spot))
    up = math.sqrt(max(1 - east * east - north * north, 0.0))
    if not 0 < up < 1 or not 1 < speed < 1e5:
        raise_damaged(rslc.path, f"has an impossible radar direction {east:g}, {north:g} or speed {speed:g} m/s")
    heading = math.radians(heading_deg)
    ahead = math.sin(heading) * east + math.cos(heading) * north
    left = math.sin(heading) * north - math.cos(heading) * east
    spacing = rslc.times_s[1] * speed, rslc.ranges_m[1]
    stated = speed / rslc.bandwidths_hz[0], SPEED_OF_LIGHT / (2 * rslc.bandwidths_hz[1])
    widest = np.maximum(stated, spacing)
    widths = _UNWEIGHTED * float(widest[0]), _UNWEIGHTED * float(widest[1])
    return View.towards((ahead, left, up)), spacing, widths, tuple(widest) != stated


def _place(
    rslc: Rslc, spot: tuple[float, float], height_m: float, heading_deg: float
) -> tuple[Place | None, list[str]]:
    """Return the place of the spot by the geolocation grid, or None, and sentences on its dependence on height."""
    found, higher = (rslc.geolocation.place(h, *rslc.time_and_range(spot)) for h in (height_m, height_m + _HIGHER_M))
    if found is None:
        why = "does not determine it there" if rslc.geolocation.places is not None else "is not in WGS 84 (EPSG:4326)"
        return None, [f"where on earth that is stays unknown, for the geolocation grid {why}"]
    place = replace(Place.of_ecef(found, heading_deg), height_m=height_m)
    if higher is None:
        return place, []
    aside = math.hypot(*place.from_ecef(higher)[:2]) / _HIGHER_M
    return place, [
        f"where on earth that is comes from the geolocation grid and moves by {aside:.2g} m sideways for each metre by "
        "which the spot is higher"
    ]


def _cut(
    rslc: Rslc, spot: tuple[float, float], size_m: float, spacing: tuple[float, float]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return first and past the last index of azimuth times, and of slant ranges."""
    rows, columns = sides_of(size_m, spacing)
    ends = [(round(at - count / 2), round(at - count / 2) + count) for at, count in zip(spot, (columns, rows))]
    if any(low < 0 or high > size for (low, high), size in zip(ends, rslc.shape, strict=True)):
        whole = " × ".join(f"{count * step:.4g} m" for count, step in zip(rslc.shape, spacing, strict=True))
        raise SarsplatError(
            f"{rslc.path} has {rslc.shape[0]} rows and {rslc.shape[1]} columns ({whole}), but rows {ends[0][0]} to "
            f"{ends[0][1] - 1} and columns {ends[1][0]} to {ends[1][1] - 1} are asked for; give a smaller `size_m` or "
            "another `pixel`"
        )
    return ends[0], ends[1]


def _cross(signals: dict[str, Complex64[np.ndarray, "rows columns"]]) -> str:
    """Replace HV and VH by their mean, and return a sentence on their similarity."""
    one, other = signals["HV"], signals.pop("VH")
    signals["HV"] = (one + other) / 2
    powers = [float(np.mean(np.square(np.abs(part), dtype=np.float64))) for part in (one, other)]
    product = np.sum(one * other.conj(), dtype=np.complex128) / one.size
    coherence = abs(product) / max(math.sqrt(powers[0] * powers[1]), 1e-30)
    decibels = float(to_db(powers[0], least=1e-30) - to_db(powers[1], least=1e-30))
    degrees = math.degrees(np.angle(product))
    return (
        f"HV and VH are one channel, HV, their mean: coherence {coherence:.2f}, phase {degrees:.0f}° and "
        f"{decibels:.1f} dB between them, which after calibration are 1, 0° and 0 dB but for noise"
    )
