"""Import SICD files (complex SAR images with their geometry): the surroundings of one spot.

Each image is resampled to slant range and level azimuth of its view, by band-limited interpolation of the complex
pixels (`sicd_chip`) at positions found by `sicd_geometry`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from sarsplat.arguments import checks_arguments
from sarsplat.data import folders
from sarsplat.data.dataset import Dataset
from sarsplat.data.dataset_folder import HEADER
from sarsplat.errors import SarsplatError, counted
from sarsplat.geometry import Place
from sarsplat.importers.about import AboutImages
from sarsplat.importers.files import each_once, warn_caller
from sarsplat.importers.images import (
    assume,
    check_size,
    dataset_of,
    place_of,
    said_of_heading,
    sides_of,
    write_imported,
)
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.sicd_chip import (
    chip,
    contradictory_calibration,
    resolution_of,
    response_along,
    spacing_of,
    stack_image,
)
from sarsplat.importers.sicd_file import Sicd, read_sicd
from sarsplat.importers.sicd_geometry import Layout, layout_around, said_of_place, spot_of_pixel

_LEANS = 0.05  # minimum displacement that is reported, m for each metre of height


@checks_arguments
def import_sicd(
    files: Sequence[str | Path],
    out: str | Path,
    *,
    size_m: float,
    around: tuple[float, ...] | None = None,
    pixel: tuple[float, float] | None = None,
    heading_deg: float = 90.0,
    target: str = "unnamed",
    train_views: int | None = None,
    stack: bool = False,
    tilted: bool = False,
    overwrite: bool = False,
    **about: Unpack[AboutImages],
) -> Dataset:
    """Import SICD files: the surroundings of one spot in one or several complex SAR images.

    Parameters
    ----------
    files : sequence of Path
        SICD files (NITF), one for each view, or the channels of one.
    out : Path
        Dataset folder to write.
    size_m : float
        Side of the images in azimuth and slant range, e.g. 64m.
    around : (latitude, longitude) or (latitude, longitude, height), optional
        The spot, which becomes the origin: latitude and longitude, degrees, and height above the ellipsoid, m (that of
        the first image's scene centre point if it is left out), WGS 84.
    pixel : (row, column), optional
        The spot as a pixel of the first file, counted from 0, at the height of its scene centre point. With neither,
        the spot is this point.
    heading_deg : float
        Compass heading of the scene's x axis, degrees clockwise from north; 90 is east.
    target : str
        Name of the target.
    train_views : int, optional
        Number of training views, evenly around; the others are test views. Without it, all are for training.
    stack : bool
        The files, coregistered to one grid, are passes or polarisations of one view, that of the first; their phases,
        offsets and names are made those of a `Stack`.
    tilted : bool
        Keep the azimuth axis of each image: tilted where the radar squints, climbs or dives. Without it, images are
        resampled to level axes, and heights are displaced in azimuth.
    overwrite : bool
        Replace an existing dataset.
    **about
        Looks, ground, terrain and the target's box: see `AboutImages`.

    Returns
    -------
    Dataset
        Complex images; β⁰ (calibration "absolute") if every file states the factor to it, to σ⁰, γ⁰ or RCS.
        `source["assumptions"]` lists assumptions.

    Raises
    ------
    SarsplatError
        If sarkit is not installed, a file is not a valid SICD or does not contain the image, files of a stack differ in
        their grids or frequencies, or the output exists.

    Warns
    -----
    SarsplatWarning
        If the projection of a file contradicts its scene centre point.
    """
    folders.refuse_existing(Path(out), overwrite, marker=HEADER)
    paths = each_once(files)
    check_size(size_m)
    sicds = [read_sicd(path) for path in paths]
    for text in filter(None, map(said_of_place, sicds)):
        warn_caller(text)
    spot = _spot(sicds[0], around, pixel, heading_deg)
    layouts = [layout_around(sicd, spot, size_m / 2, tilted=tilted) for sicd in (sicds[:1] if stack else sicds)]
    layouts *= len(sicds) // len(layouts)  # all channels of a stack have the first one's
    finest = np.min([spacing_of(sicd, layout) for sicd, layout in zip(sicds, layouts, strict=True)], axis=0)
    spacing = float(finest[0]), float(finest[1])
    shape = sides_of(size_m, spacing)
    absolute = all(sicd.calibration for sicd in sicds)
    stems = [path.stem for path in paths]
    same = Counter(stems)
    names = [stem if same[stem] == 1 else f"{stem}-{number}" for number, stem in enumerate(stems, 1)]
    images = (
        [stack_image(names[0], sicds, spot, layouts[0], shape, spacing, absolute)]
        if stack
        else [
            MeasuredImage(
                name,
                chip(sicd, layout, shape, spacing, absolute),
                layout.view,
                spacing,
                resolution_of(sicd, layout),
                response=response_along(sicd, layout),
            )
            for name, sicd, layout in zip(names, sicds, layouts, strict=True)
        ]
    )
    source: dict[str, Any] = {
        "kind": "sicd",
        "spot": {"latitude_deg": spot.latitude_deg, "longitude_deg": spot.longitude_deg, "height_m": spot.height_m},
        "heading_deg": spot.x_towards_deg,
        "assumptions": _assumptions(sicds, layouts, spot, (around, pixel), absolute, stack),
        "images": [
            {"name": name, **_facts(sicd, layout)} for name, sicd, layout in zip(names, sicds, layouts, strict=True)
        ],
    }
    dataset = dataset_of(
        images,
        target=target,
        source=source,
        train_views=train_views,
        calibration="absolute" if absolute else "relative",
        place=spot,
        **about,
    )
    return write_imported(out, dataset, overwrite=overwrite)


def _spot(
    first: Sicd, around: tuple[float, ...] | None, pixel: tuple[float, float] | None, heading_deg: float
) -> Place:
    if around is not None and pixel is not None:
        raise SarsplatError("`around` and `pixel` were both given; give one of them")
    if pixel is not None:
        return spot_of_pixel(first, pixel, heading_deg)
    centre = first.projection
    return place_of((centre.SCP_Lat, centre.SCP_Lon) if around is None else around, centre.SCP_HAE, heading_deg)


def _facts(sicd: Sicd, layout: Layout) -> dict[str, Any]:
    """Describe one image."""
    metadata = sicd.projection
    return {
        "file": sicd.path.name,
        **sicd.collection,
        "look": layout.look,
        "distance_m": round(layout.distance_m, 1),
        "tilt_deg": round(layout.tilt_deg, 4),
        "leaning_m_per_m": [round(value, 5) for value in layout.leaning],
        "grid": metadata.Grid_Type,
        "pixel_type": sicd.pixel_type,
        "weighting": [sicd.column.window or "not stated", sicd.row.window or "not stated"],
        "resolution_m": list(resolution_of(sicd, layout)),
        "spacing_m": list(spacing_of(sicd, layout)),
    }


def _assumptions(
    sicds: Sequence[Sicd],
    layouts: Sequence[Layout],
    spot: Place,
    given: tuple[object, object],
    absolute: bool,
    stack: bool,
) -> list[str]:
    around, pixel = given
    how = "as given" if around else f"what pixel {pixel} shows" if pixel else "the first image's scene centre point"
    if around and len(around) == 2:  # type: ignore[arg-type]
        how += ", as high as the first image's scene centre point"
    looks = Counter(layout.look for layout in layouts)
    windows = sorted({axis.window or "not stated" for sicd in sicds for axis in (sicd.column, sicd.row)})
    sentences = [
        f"the origin of the scene is {spot.latitude_deg:.6f}°, {spot.longitude_deg:.6f}°, {spot.height_m:.1f} m above "
        f"the ellipsoid ({how}), and the ground there is level at z = 0",
        said_of_heading(spot.x_towards_deg),
        f"radars look to the {' and '.join(f'{look} ({count})' for look, count in sorted(looks.items()))}; images of "
        "left-looking ones are laid out as a right-looking radar at the same place would record them: columns run "
        "against the flight, and nothing is mirrored",
        f"the weighting is {', '.join(windows)}; widths of the response are those that the files state",
        f"power is β⁰ by the files' own polynomials ({', '.join({next(iter(sicd.calibration)): 0 for sicd in sicds})})"
        if absolute
        else f"{sum(not sicd.calibration for sicd in sicds)} of {counted(len(sicds), 'file')} do not say how to get "
        "β⁰, so power is known up to one factor, which is taken to be the same for all",
    ]
    if stack:
        sentences.append(
            "the files are coregistered to the grid of the first, and the phases of each are referred to the range of "
            "its scene centre point; those of the spot are made equal, and those of level ground are kept"
        )
    contradictions = map(contradictory_calibration, sicds, layouts) if absolute else ()
    for text in filter(None, contradictions):
        assume(sentences, text)
    polarizations = sorted({sicd.collection.get("polarization", "not stated") for sicd in sicds})
    if len(polarizations) > 1 and not stack:
        differ = f"polarisations differ ({', '.join(polarizations)}), but are taken to show the same power"
        assume(sentences, f"{differ}; give files of one if they do not")
    leaning = [(math.hypot(*layout.leaning), sicd, layout) for sicd, layout in zip(sicds, layouts, strict=True)]
    worst, sicd, layout = max(leaning, key=lambda item: item[0])
    if worst > _LEANS:
        several = sum(value > _LEANS for value, _, _ in leaning)
        sentences.append(
            f"in {counted(several, 'image')} the slant plane is tilted about the line of sight; level ground is laid "
            f"out right, but what stands 1 m high appears up to {worst:.2f} m beside its place (tilt "
            f"{layout.tilt_deg:.1f}° in {sicd.path.name}); with `tilted=True`, planes stay as they are"
        )
    return sentences
