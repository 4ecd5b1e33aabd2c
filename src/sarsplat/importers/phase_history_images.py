"""From phase history to a dataset: flights are cut into apertures, and each becomes an image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import Dataset
from sarsplat.data.folders import refuse_existing
from sarsplat.errors import SarsplatError, counted
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import TAYLOR, UNIFORM, Taylor
from sarsplat.importers.apertures import Aperture, apertures
from sarsplat.importers.files import each_once
from sarsplat.importers.focus import focus
from sarsplat.importers.histories import read_phase_history
from sarsplat.importers.images import AboutScene, MeasuredImage, assume, check_sides, dataset_of, write_imported
from sarsplat.importers.phase_history import FARTHEST_M, flights
from sarsplat.progress import progress

_WEIGHTINGS = {"uniform": UNIFORM, "taylor": TAYLOR}
_SPACING = 2 / 3
"""Default pixel spacing, as a share of the narrower 3 dB width: power has twice the band of the signal."""
_TILT_DEG = 3.0
"""Slant planes turned by more than this are reported: what is 2 m high moves across by a decimetre."""


@checks_arguments
def import_phase_history(
    files: Sequence[str | Path],
    out: str | Path,
    *,
    size_m: float,
    around_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    aperture_deg: float | None = None,
    spacing_m: float | None = None,
    weighting: Literal["uniform", "taylor"] = "taylor",
    target: str = "unnamed",
    train_views: int | None = None,
    overwrite: bool = False,
    quiet: bool = True,
    **about: Unpack[AboutScene],
) -> Dataset:
    """Import phase history, in the layout of AFRL's GOTCHA: one focused image for every few degrees of flight.

    Parameters
    ----------
    files : sequence of Path
        MATLAB files (.mat, not v7.3), in any order; those that continue each other are one flight.
    out : Path
        Dataset folder to write.
    size_m : float
        Side of the images in azimuth and slant range, e.g. 64m.
    around_m : (x, y, z)
        What the images show the surroundings of: x, y and height (0 if left out), m from the scene centre. It becomes
        the origin, and pixels are focused on the ground at its height.
    aperture_deg : float, optional
        Azimuths that make one image, degrees. Without it, equal parts of each flight, about as wide as resolve azimuth
        as finely as slant range.
    spacing_m : float, optional
        Pixel spacing, m. Without it, two thirds of the narrower resolution.
    weighting : {"uniform", "taylor"}
        The narrowest response, or side lobes 35 dB down.
    target : str
        What the images show.
    train_views : int, optional
        Number of training images, nearest to azimuths k·360°/K; the others are test images. Without it, all are for
        training.
    overwrite : bool
        Replace an existing dataset.
    quiet : bool
        Whether to show no progress.
    **about
        Terrain and the target's box: see `AboutScene`.

    Returns
    -------
    Dataset
        Complex, of relative calibration, single look, with ground.

    Raises
    ------
    SarsplatError
        If finufft is not installed, a file cannot be used, an option does not suit the files, or the output exists.

    Warns
    -----
    SarsplatWarning
        If the slant plane is tilted, or the images contradict what is said of them, or look odd (`sarsplat.examine`).
    """
    refuse_existing(Path(out), overwrite, marker="dataset.json")
    if weighting not in _WEIGHTINGS:
        raise SarsplatError(f"the weighting {weighting!r} is unknown; choose {' or '.join(_WEIGHTINGS)}")
    taper, around = _WEIGHTINGS[weighting], np.array(around_m, np.float64)
    if not (np.abs(around) <= FARTHEST_M).all():  # also catches NaN
        raise SarsplatError(
            f"--around {around_m} must be metres from the scene centre, at most {FARTHEST_M:g}; give x, y and height"
        )
    parts = [
        aperture
        for flight in flights([read_phase_history(path) for path in each_once(files)])
        for aperture in apertures(flight, around, aperture_deg)
    ]
    if train_views is not None and not 1 <= train_views <= len(parts):  # said before minutes of work
        raise SarsplatError(
            f"{counted(train_views, 'training view')} asked for, but the flight makes {counted(len(parts), 'image')}; "
            f"ask for 1 to {len(parts)}, or for a narrower --aperture"
        )
    spacing = _spacing(parts, taper) if spacing_m is None else spacing_m
    images = []
    with progress("focusing", len(parts), quiet) as reporter:
        for index, aperture in enumerate(parts):
            images.append(_image(index, aperture, size_m, spacing, taper))
            reporter.advance(1)
    dataset = dataset_of(
        images,
        target=target,
        source=_source(files, parts, around_m, taper),
        train_views=train_views,
        **about,
    )
    return write_imported(out, dataset, overwrite=overwrite)


def _spacing(parts: list[Aperture], weighting: Taylor) -> float:
    return _SPACING * min(min(aperture.resolution_m(weighting)) for aperture in parts)


def _image(index: int, aperture: Aperture, size_m: float, spacing_m: float, weighting: Taylor) -> MeasuredImage:
    resolution = aperture.resolution_m(weighting)
    pixels = size_m / spacing_m if size_m > 0 and spacing_m > 0 else 0.0  # also of NaN
    check_sides(size_m, pixels, pixels, f"{spacing_m:.3g} m")
    grid = ImageGrid(round(pixels), round(pixels), (spacing_m, spacing_m), resolution)
    signal = focus(aperture, grid, weighting)
    return MeasuredImage(f"{index:03d}", signal, aperture.view, grid.spacing_m, resolution, response=weighting)


def _source(
    files: Sequence[str | Path], parts: list[Aperture], around_m: tuple[float, float, float], weighting: Taylor
) -> dict[str, Any]:
    """Description of the images and the assumptions made."""
    assumptions = ["the ground is flat, at the height of the place that the images are around"]
    left = sum(aperture.looks_left for aperture in parts)
    if left:
        whose = "the radar" if left == len(parts) else f"in {counted(left, 'image')} the radar"
        assumptions.append(
            f"{whose} looked to its left; columns run against its flight, as they would for one that looks right"
        )
    steepest = max(abs(aperture.tilt_deg) for aperture in parts)
    if steepest > _TILT_DEG:
        assume(
            assumptions,
            f"the flight is inclined, so that the slant plane is turned by up to {steepest:.1f}° about the line of "
            "sight; what stands up is displaced across by the tangent of it",
        )
    taper = "uniform" if weighting == UNIFORM else f"Taylor, {weighting.level_db:g} dB, nbar {weighting.sidelobes}"
    return {
        "kind": "phase-history",
        "files": [Path(path).name for path in files],
        "carrier_hz": parts[0].history.carrier_hz,
        "bandwidth_hz": parts[0].history.bandwidth_hz,
        "around_m": [*around_m],
        "image_formation": "back-projection to the ground, in the slant plane; the carrier's phase is taken out",
        "weighting": taper,
        "apertures": [
            {
                "name": f"{index:03d}",
                "width_deg": aperture.width_deg,
                "pulses": len(aperture.history),
                "looks": "left" if aperture.looks_left else "right",
                "tilt_deg": aperture.tilt_deg,
                "resolution_m": [*aperture.resolution_m(weighting)],
            }
            for index, aperture in enumerate(parts)
        ],
        "assumptions": assumptions,
    }
