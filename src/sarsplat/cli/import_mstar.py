"""`sarsplat import mstar`: measured chips in, a dataset out."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import Folder, OptionalFile, OptionalName, refuse_existing


def import_mstar(
    chips: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CHIPS")],
    *,
    out: Folder,
    target_class: Annotated[str, tyro.conf.arg(name="class", metavar="NAME")],
    train_views: Annotated[int, tyro.conf.arg(metavar="K")],
    labels: OptionalFile = None,
    train_depression: Annotated[int, tyro.conf.arg(metavar="DEG")] = 17,
    serial: OptionalName = None,
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
        Depression angle of the training chips, degrees.
    serial
        Import only the vehicle with this serial number.
    mirrored
        Treat the published chips as mirror images.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.data import import_mstar as read_chips
    from sarsplat.data.dataset_folder import HEADER
    from sarsplat.errors import counted

    refuse_existing(out, overwrite, marker=HEADER)
    with console.busy(f"reading chips from {chips}"):
        dataset = read_chips(
            chips,
            out,
            labels=labels,
            target_class=target_class,
            train_views=train_views,
            train_depression=train_depression,
            serial=serial,
            mirrored=mirrored,
            overwrite=overwrite,
        )
    counts = ", ".join(f"{len(dataset.select(split))} {split}" for split in dataset.splits())
    console.finish(
        f"{out}: {counted(len(dataset), 'chip')} of {target_class} ({counts}); relative power, mean 1 over the "
        "training set",
        f"sarsplat reconstruct {shlex.quote(str(out))} --out {shlex.quote(f'{out}-run')}",
    )
