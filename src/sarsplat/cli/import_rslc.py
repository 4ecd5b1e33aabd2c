"""`sarsplat import rslc`: an image in several polarisations in, a dataset of one stack out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli.arguments import Folder, OptionalFile, TargetBox, corners, heights, metres, numbers
from sarsplat.cli.imported import carry_out
from sarsplat.cli.importers import Contents, Recognised, dataset_name, typed_import
from sarsplat.errors import SarsplatError
from sarsplat.names import CrossPolarised


def command(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")],
    *,
    out: Folder,
    size: Annotated[str, tyro.conf.arg(metavar="METRES")],
    pixel: Annotated[str | None, tyro.conf.arg(metavar="ROW,COL", help_behavior_hint="(optional)")] = None,
    height: Annotated[float, tyro.conf.arg(metavar="METRES")] = 0.0,
    heading: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 90.0,
    cross: CrossPolarised = "mean",
    target: Annotated[str, tyro.conf.arg(metavar="NAME")] = "unnamed",
    calibrated: bool = False,
    no_ground: bool = False,
    terrain: OptionalFile = None,
    target_box: TargetBox = None,
    overwrite: bool = False,
) -> int:
    """Import an RSLC file in NISAR's layout (HDF5): what one image shows of a spot in several polarisations.

    Parameters
    ----------
    file
        RSLC file (HDF5).
    out
        Dataset folder to write.
    size
        Side of the image in azimuth and slant range, e.g. 200m.
    pixel
        The spot, which becomes the origin: azimuth time and slant range, counted from 0. Without it, the middle.
    height
        Height of the spot above the ellipsoid, m.
    heading
        Compass heading of the scene's x axis, degrees; 90 is east.
    cross
        HV and VH become one channel, their mean, or stay both.
    target
        What the image shows.
    calibrated
        The power in the file is β⁰ itself, not only up to a factor.
    no_ground
        The image shows nothing but the target.
    terrain
        Heights of the ground (GeoTIFF, metres), its middle at the scene's origin; level without it.
    target_box
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Without it, it is
        derived from the image.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.importers import import_rslc

    spot = None if pixel is None else numbers(pixel, "pixel", (2,), "1200,800")
    return carry_out(
        import_rslc,
        file,
        out,
        doing=f"reading {file}",
        size_m=metres(size, "size"),
        pixel=None if spot is None else (spot[0], spot[1]),
        height_m=height,
        heading_deg=heading,
        cross=cross,
        target=target,
        calibration="absolute" if calibrated else "relative",
        ground=not no_ground,
        terrain=heights(terrain),
        target_box_m=corners(target_box),
        overwrite=overwrite,
    )


def recognise(contents: Contents) -> Recognised | None:
    """An HDF5 file; of a folder the first, if it is such a one: HDF5 may hold anything."""
    from sarsplat.importers.rslc_file import is_hdf5, read_rslc, require_h5py

    files = contents.ending_in(".h5", ".hdf5")
    if not files or not is_hdf5(files[0]):
        return None
    try:
        require_h5py()
        rslc = read_rslc(files[0])
    except SarsplatError:
        if contents.path.is_file():
            raise
        return None
    middle = f"{rslc.shape[0] // 2},{rslc.shape[1] // 2}"
    facts = {
        "mission": rslc.mission,
        "polarisations": f"{', '.join(rslc.polarisations)} (transmitted, received)",
        "size": f"{rslc.shape[0]} rows (azimuth) × {rslc.shape[1]} columns (slant range)",
        "radar": f"looks {rslc.look}, {rslc.frequency_hz / 1e9:.4g} GHz",
    }
    words = ("rslc", str(files[0]), "--pixel", middle, "--size", "METRES")
    command = typed_import(*words, out=dataset_name(files[0].with_suffix("")))
    return Recognised("an RSLC in NISAR's layout", facts, command)
