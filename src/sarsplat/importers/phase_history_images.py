"""Import phase history: each aperture of a flight becomes an image by back-projection.

The echo of one pulse at all distances, Σ_f s(f)·exp(4πj f/c·d), is a Fourier sum at uneven places; `finufft` evaluates
it to the accuracy asked for, as a direct sum would, without a range profile to interpolate in. Nothing is approximated
in the geometry: the wavefronts are spheres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np
from jaxtyping import Complex64, Float64

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import Dataset
from sarsplat.data.dataset_folder import HEADER
from sarsplat.data.folders import refuse_existing
from sarsplat.errors import SarsplatError, counted
from sarsplat.extras import needed
from sarsplat.geometry import ImageGrid, Place
from sarsplat.geometry.responses import TAYLOR, UNIFORM, Taylor
from sarsplat.importers.about import AboutScene
from sarsplat.importers.files import each_once
from sarsplat.importers.histories import read_phase_history
from sarsplat.importers.images import (
    assume,
    check_size,
    check_train_views,
    dataset_of,
    place_of,
    sides_of,
    write_imported,
)
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.phase_apertures import Aperture, apertures
from sarsplat.importers.phase_history import FARTHEST_M, SPEED_OF_LIGHT, PhaseHistory, flights
from sarsplat.progress import progress

_WEIGHTINGS = {"uniform": UNIFORM, "taylor": TAYLOR}
_SPACING = 2 / 3  # default pixel spacing, as a share of the narrower 3 dB width: power has twice the band of the signal
_TILT_DEG = 3.0  # minimum tilt of slant planes that is reported: at a height of 2 m it displaces by a decimetre
_MISSING = 0.01  # minimum share of an aperture without pulses that is reported
_ACCURACY = 1e-7


@checks_arguments
def import_phase_history(
    files: Sequence[str | Path],
    out: str | Path,
    *,
    size_m: float,
    around_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    place: tuple[float, ...] | None = None,
    channel: str | None = None,
    aperture_deg: float | None = None,
    spacing_m: float | None = None,
    weighting: Literal["uniform", "taylor"] = "taylor",
    tilted: bool = False,
    target: str = "unnamed",
    train_views: int | None = None,
    overwrite: bool = False,
    quiet: bool = True,
    **about: Unpack[AboutScene],
) -> Dataset:
    """Import phase history, CPHD or in the layout of AFRL's GOTCHA: one focused image for every few degrees of flight.

    Parameters
    ----------
    files : sequence of Path
        CPHD files, or MATLAB files (.mat, not v7.3), in any order; those of GOTCHA that continue each other are one
        flight.
    out : Path
        Dataset folder to write.
    size_m : float
        Side of the images in azimuth and slant range, e.g. 64m.
    around_m : (x, y, z)
        Middle of the images: x, y and height (0 if left out), m from the scene centre, of CPHD east, north and up. It
        becomes the origin, and pixels are focused on the ground at its height.
    place : (latitude, longitude) or (latitude, longitude, height), optional
        The scene centre, of files that say where on earth they are: degrees, and height above the ellipsoid, m (WGS 84;
        that of the first file's reference point if it is left out). Without it, this point.
    channel : str, optional
        Channel of each file, if they have several.
    aperture_deg : float, optional
        Azimuths of one image, degrees. Without it, equal parts of each flight that make azimuth resolution about that
        of slant range.
    spacing_m : float, optional
        Pixel spacing, m. Without it, two thirds of the narrower resolution.
    weighting : {"uniform", "taylor"}
        The narrowest response, or side lobes 35 dB down.
    tilted : bool
        Tilt the azimuth axis of each image as its slant plane. Without it, axes are level, and heights are displaced in
        azimuth where the flight is inclined.
    target : str
        Name of the target.
    train_views : int, optional
        Number of training images, nearest to azimuths k·360°/K; the others are test images. Without it, all are for
        training.
    overwrite : bool
        Replace an existing dataset.
    quiet : bool
        Show no progress.
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
        If the slant plane is tilted, or the images contradict their metadata, or look odd (`sarsplat.examine`).
    """
    refuse_existing(Path(out), overwrite, marker=HEADER)
    check_size(size_m)
    taper, around = _WEIGHTINGS[weighting], np.array(around_m, np.float64)
    if not (np.abs(around) <= FARTHEST_M).all():  # also catches NaN
        raise SarsplatError(
            f"`around_m` {around_m} must be metres from the scene centre, at most {FARTHEST_M:g}; give x, y and height"
        )
    histories = [read_phase_history(path, channel) for path in each_once(files)]
    histories, origin = _in_one_world(histories, place, around)
    if origin is not None:
        around = np.zeros(3)
    sides = np.array([(x, y, 0.0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * size_m
    parts = [
        aperture
        for flight in flights([history.seeing(around + sides) for history in histories])
        for aperture in apertures(flight, around, aperture_deg)
    ]
    if tilted:
        parts = [aperture.tilted() for aperture in parts]
    check_train_views(train_views, len(parts))  # before minutes of work
    narrowest = min(min(aperture.resolution_m(taper)) for aperture in parts)
    spacing = _SPACING * narrowest if spacing_m is None else spacing_m
    shape = sides_of(size_m, (spacing, spacing))
    images = []
    with progress("focusing pulses", sum(len(aperture.history) for aperture in parts), quiet) as reporter:
        for index, aperture in enumerate(parts):
            finest = aperture.resolution_m(taper)
            grid = ImageGrid(*shape, (spacing, spacing), finest)
            signal = focus(aperture, grid, taper, reporter.advance)
            images.append(MeasuredImage(f"{index:03d}", signal, aperture.view, grid.spacing_m, finest, response=taper))
    source = _source(files, parts, around_m, taper)
    dataset = dataset_of(images, target=target, source=source, train_views=train_views, **about)
    return write_imported(out, replace(dataset, place=origin), overwrite=overwrite)


def _in_one_world(
    histories: list[PhaseHistory], place: tuple[float, ...] | None, around_m: Float64[np.ndarray, " 3"]
) -> tuple[list[PhaseHistory], Place | None]:
    """Move histories that have a place to one world frame, whose origin is `around_m` from `place` or the first's."""
    lacking = [history.name for history in histories if history.place is None]
    if place is None and len(lacking) == len(histories):
        return histories, None
    first = histories[0].place
    if lacking or first is None:
        remedy = "leave out `place`" if place else "import files that have one by themselves"
        raise SarsplatError(f"{lacking[0]} has no place on earth; {remedy}")
    if place is not None:
        first = place_of(place, first.height_m)
    origin = Place.of_ecef(first.to_ecef(around_m))
    return [history.seen_from(origin) for history in histories], origin


def _source(
    files: Sequence[str | Path], parts: list[Aperture], around_m: tuple[float, float, float], weighting: Taylor
) -> dict[str, Any]:
    """Description of the images and the assumptions made."""
    assumptions = ["the ground is flat, at the height of the place that the images are around"]
    if parts[0].history.place is not None:
        assumptions.append(
            f"the origin of the scene is {parts[0].history.place}, the ground there is level, and an antenna and what "
            "it sees stand still while an echo is received"
        )
    left = sum(aperture.looks_left for aperture in parts)
    if left:
        whose = "the radar" if left == len(parts) else f"in {counted(left, 'image')} the radar"
        assumptions.append(
            f"{whose} looked to its left; columns run against its flight, as they would for one that looks right"
        )
    steepest = max(abs(aperture.tilt_deg) for aperture in parts)
    if steepest > _TILT_DEG and not any(aperture.view.tilt_deg for aperture in parts):
        assume(
            assumptions,
            f"the flight is inclined, so that the slant plane is turned by up to {steepest:.1f}° about the line of "
            "sight; what stands up is displaced across by the tangent of it; with `tilted=True`, planes stay as they "
            "are",
        )
    missing = max(aperture.missing for aperture in parts)
    if missing > _MISSING:
        assume(
            assumptions,
            f"pulses are missing in up to {missing:.0%} of an image's azimuths, which raises side lobes in azimuth",
        )
    collections = [dict(aperture.history.collection) for aperture in parts if aperture.history.collection]
    collections = [one for index, one in enumerate(collections) if one not in collections[:index]]
    taper = "uniform" if weighting == UNIFORM else f"Taylor, {weighting.level_db:g} dB, nbar {weighting.sidelobes}"
    return {
        "kind": "phase-history",
        "files": [Path(path).name for path in files],
        "carrier_hz": parts[0].history.carrier_hz,
        "bandwidth_hz": parts[0].history.bandwidth_hz,
        "around_m": [*around_m],
        **({"collections": collections} if collections else {}),
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


def focus(
    aperture: Aperture, grid: ImageGrid, weighting: Taylor, advance: Callable[[int], object] = lambda pulses: None
) -> Complex64[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Focus the complex image of an aperture, row 0 near range, columns along the view's x_r.

    A scatterer of amplitude A on the ground has A as its peak. Pixels are focused on the ground points, at the height
    of the aperture's place, that `View.look` maps to them, so that wavefront curvature is removed. The carrier's phase,
    4π f/c times slant range, is taken out: the spectrum is centred at zero. `advance` counts pulses. Raises if the grid
    exceeds the unambiguous extent of frequencies or pulses, or finufft is not installed.
    """
    with needed("phase-history", "phase history"):
        import finufft

    from sarsplat.importers.phase_combining import Combined  # here: whoever asks for a file's facts need not load SciPy

    _check_extent(aperture, grid)
    history = aperture.history
    places = (np.arange(history.frequencies) + 0.5) / history.frequencies - 0.5
    cross = aperture.cross
    middle = float(cross.min() + cross.max()) / 2
    shares = np.abs(np.gradient(cross)) * weighting.window((cross - middle) / aperture.extent)
    across = weighting.window(places)
    weights = across / across.sum(), shares / shares.sum()
    wave = 4 * math.pi / SPEED_OF_LIGHT
    centre = history.first_hz + history.frequencies // 2 * history.step_hz
    pixels = ground_points(aperture, grid)
    combined = Combined.around(history, aperture.around_m, _edge(aperture, grid), cross)
    total = np.zeros(len(pixels), np.complex128)
    counted_pulses = 0
    for pulse, echo in combined.echoes(weights[1]):
        one = slice(pulse, pulse + 1)
        beyond = (history.beyond_m(one, pixels) - history.beyond_m(one, aperture.around_m[None]))[0]
        profile = finufft.nufft1d2(
            wave * history.step_hz[pulse] * beyond, echo * weights[0], eps=_ACCURACY, isign=1, nthreads=1
        )
        total += profile * np.exp(1j * wave * centre[pulse] * beyond)
        advance(pulse + 1 - counted_pulses)
        counted_pulses = pulse + 1
    carrier = np.exp(-1j * wave * history.carrier_hz * grid.range_m)
    return (total.reshape(grid.rows, grid.columns) * carrier[:, None]).astype(np.complex64)


def ground_points(aperture: Aperture, grid: ImageGrid) -> Float64[np.ndarray, "pixels 3"]:
    """Return the ground point of each pixel, row by row, world frame, m."""
    across, away = np.pad(aperture.view.look.onto_ground, ((0, 0), (0, 1)))
    rows = grid.range_m[:, None, None] * away
    return (aperture.around_m + rows + grid.azimuth_m[None, :, None] * across).reshape(-1, 3)


def _edge(aperture: Aperture, grid: ImageGrid) -> Float64[np.ndarray, "8 3"]:
    """Return the corners of an image on the ground, and the points midway between them."""
    places = ground_points(aperture, grid).reshape(grid.rows, grid.columns, 3)
    rows, columns = [0, grid.rows // 2, -1], [0, grid.columns // 2, -1]
    return np.delete(places[rows][:, columns].reshape(9, 3), 4, axis=0)


def _check_extent(aperture: Aperture, grid: ImageGrid) -> None:
    history = aperture.history
    distance = history.beyond_m(slice(None), _edge(aperture, grid))
    nearest, farthest = history.limits_m.T
    if (distance.min(axis=1) < nearest).any() or (distance.max(axis=1) > farthest).any():
        raise SarsplatError(
            f"{history.name}: the image reaches from {distance.min():.1f} m to {distance.max():.1f} m in range beyond "
            f"the points that its pulses are referred to, but the file shows {nearest.max():.1f} m to "
            f"{farthest.min():.1f} m; give a smaller `size_m`, or an `around_m` or `place` nearer to these"
        )
    across = grid.columns * grid.spacing_m[0]
    if across > aperture.unambiguous_m:
        raise SarsplatError(
            f"{history.name}: the image is {across:.1f} m wide, but pulses so far apart show "
            f"{aperture.unambiguous_m:.1f} m; give a smaller `size_m`"
        )
