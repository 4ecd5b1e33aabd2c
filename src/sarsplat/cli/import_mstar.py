"""`sarsplat import mstar`: measured chips in, a dataset out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli.arguments import Angles, Folder, OptionalFile, OptionalName, angles
from sarsplat.cli.imported import carry_out
from sarsplat.errors import SarsplatError


def command(
    chips: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CHIPS")],
    *,
    out: Folder,
    target_class: Annotated[str, tyro.conf.arg(name="class", metavar="NAME")],
    train_views: Annotated[int, tyro.conf.arg(metavar="K")],
    labels: OptionalFile = None,
    train_depression: Angles = ("17",),
    serial: OptionalName = None,
    target_box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1"),
    ] = None,
    azimuth_std: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 0.0,
    mirrored: bool = False,
    overwrite: bool = False,
) -> None:
    """Import MSTAR chips: JPEGs with a table of labels, or original Phoenix files.

    Parameters
    ----------
    chips
        Folder of the chips.
    out
        Dataset folder to write.
    target_class
        Vehicle class, e.g. T72.
    train_views
        Number of training chips, nearest to azimuths k·360°/K; the others are test chips, one set per depression angle.
    labels
        Table (CSV) that labels JPEG chips; without it, Phoenix files are read.
    train_depression
        Depression angles of the training chips, degrees; of several, each gets the next azimuth in turn.
    serial
        Import only the vehicle with this serial number.
    target_box
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Without it, it is
        derived from the images.
    azimuth_std
        Standard deviation of the azimuths, degrees, of chips for which the table has none; uncertain ones are refined
        in training.
    mirrored
        Treat the published chips as mirror images.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.importers import import_mstar

    carry_out(
        import_mstar,
        chips,
        out,
        doing=f"reading chips from {chips}",
        labels=labels,
        target_class=target_class,
        train_views=train_views,
        train_depression=[_whole(angle) for angle in angles(train_depression, "train-depression")],
        serial=serial,
        target_box_m=None if target_box is None else (target_box[:3], target_box[3:]),
        azimuth_std_deg=azimuth_std,
        mirrored=mirrored,
        overwrite=overwrite,
    )


def _whole(angle: float) -> int:
    """Depressions are named by whole degrees."""
    if not angle.is_integer():  # nor NaN or infinite
        raise SarsplatError(f"--train-depression {angle:g} is not a whole number of degrees; chips are named by these")
    return round(angle)
