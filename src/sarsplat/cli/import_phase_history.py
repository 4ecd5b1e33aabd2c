"""`sarsplat import phase-history`: pulses in, a dataset of focused images out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sarsplat.cli.arguments import (
    Folder,
    Metres,
    OptionalCount,
    OptionalFile,
    OptionalNumber,
    TargetBox,
    corners,
    heights,
    metres,
    numbers,
)
from sarsplat.cli.imported import carry_out
from sarsplat.cli.importers import Contents, Recognised, by_ending


def command(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILES", help_behavior_hint="")],
    *,
    out: Folder,
    size: Annotated[str, tyro.conf.arg(metavar="METRES")],
    around: Annotated[str, tyro.conf.arg(metavar="X,Y[,Z]")] = "0,0",
    aperture: OptionalNumber = None,
    spacing: Metres = None,
    weighting: Literal["uniform", "taylor"] = "taylor",
    target: Annotated[str, tyro.conf.arg(metavar="NAME")] = "unnamed",
    train_views: OptionalCount = None,
    terrain: OptionalFile = None,
    target_box: TargetBox = None,
    overwrite: bool = False,
) -> int:
    """Import phase history, in the layout of AFRL's GOTCHA: one focused image for every few degrees of flight.

    Parameters
    ----------
    files
        MATLAB files (.mat, not v7.3), in any order.
    out
        Dataset folder to write.
    size
        Side of the images in azimuth and slant range, e.g. 64m.
    around
        What the images show the surroundings of: x, y and height (0 if left out), m from the scene centre.
    aperture
        Azimuths that make one image, degrees. Without it, about as many as resolve azimuth as finely as slant range.
    spacing
        Pixel spacing, m. Without it, two thirds of the narrower resolution.
    weighting
        The narrowest response, or side lobes 35 dB down.
    target
        What the images show.
    train_views
        Number of training images, nearest to azimuths k·360°/K; the others are test images. Without it, all are for
        training.
    terrain
        Heights of the ground (GeoTIFF, metres), its middle at the scene's origin; level without it.
    target_box
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Without it, it is
        derived from the images.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.importers import import_phase_history

    x, y, *height = numbers(around, "around", (2, 3), "12,-7.5")
    return carry_out(
        import_phase_history,
        files,
        out,
        size_m=metres(size, "size"),
        around_m=(x, y, height[0] if height else 0.0),
        aperture_deg=aperture,
        spacing_m=spacing,
        weighting=weighting,
        target=target,
        train_views=train_views,
        terrain=heights(terrain),
        target_box_m=corners(target_box),
        overwrite=overwrite,
        quiet=False,
    )


def recognise(contents: Contents) -> Recognised | None:
    """A file that begins or ends as those of a known format do; of a folder, the first with such an ending."""
    from sarsplat.importers.histories import FORMATS, format_of

    endings = [ending for one in FORMATS.loaded().values() for ending in one.endings]
    files = [contents.path] if contents.path.is_file() else contents.ending_in(*endings)
    known = format_of(files[0]) if files else None
    if known is None:
        return None
    found = by_ending(contents, (files[0].suffix.lower(),), "phase-history", "phase history")
    return replace(found, kind=known.what, certainty=1.0) if found and known.begins else found
