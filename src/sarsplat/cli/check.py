"""`sarsplat check`: find contradictions between the images of a dataset and its header."""

import shlex
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from sarsplat.cli import console
from sarsplat.cli.arguments import OptionalFile, OptionalFolder, refuse_existing, require_ending
from sarsplat.cli.from_signature import CONTRADICTED
from sarsplat.errors import counted


def check(
    dataset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")],
    *,
    out: OptionalFile = None,
    images: int = 12,
    levelled: OptionalFolder = None,
    verbose: bool = False,
    overwrite: bool = False,
) -> int:
    """Compare a dataset's images with its header; the exit code is 1 if they contradict each other.

    Checked are near range (shadow lies beyond the target), the sense of the azimuths (neighbouring images match),
    grazing angles (lengths in range fit), the unit (speckle of power has another contrast than that of amplitude or
    decibels), the resolution, whether images are constant, the same or of one scale, and single values that are too
    bright or were cut off. Azimuths of single images are checked by `sarsplat locate`, against a run.

    Parameters
    ----------
    dataset
        Folder written by `sarsplat simulate` or `sarsplat import`.
    out
        Also draw a contact sheet (PNG) with target and shadow outlined, and the directions to the radar and of
        +x: of a vehicle its nose, of a place on earth a compass bearing.
    images
        Number of images on the sheet, evenly chosen.
    levelled
        Also write a copy of the dataset (a folder) whose images have one scale, by the level of their ground.
    verbose
        Also list the evidence for each of the eight orientations of the images.
    overwrite
        Replace an existing sheet or copy.
    """
    from sarsplat.data import read_dataset, write_bytes, write_dataset
    from sarsplat.examination import scaling
    from sarsplat.examination.contradictions import TWINS, examine
    from sarsplat.examination.plausible import left_open, suspicious_angles

    if out is not None:
        require_ending("out", out, ".png")
        refuse_existing(out, overwrite)
    if levelled is not None:
        refuse_existing(levelled, overwrite)
    read = read_dataset(dataset)
    with console.busy(f"looking at {counted(len(read), 'image')} of {dataset}"):
        examined = examine(read)
        if out is not None:
            from sarsplat.report.sheet import check_sheet

            write_bytes(out, check_sheet(read, images, examined.orientations))
    console.facts(f"{dataset}: {counted(len(read), 'image')}", examined.checks)
    if verbose and examined.orientations:
        head, *rows = examined.orientations
        table = Table(*head, box=None, pad_edge=False, padding=(0, 2, 0, 2), header_style="bold")
        for row in rows:
            table.add_row(*row)
        console.show(table)
        console.say(f"  {TWINS}")
    train = read.select("train")
    for text in () if suspicious_angles(train.views) else left_open(train):
        console.warn(text)
    for text in examined.contradictions:
        console.complain(text)
    if out is not None:
        console.say(f"wrote {out}")
    if levelled is not None:
        copy = write_dataset(levelled, scaling.levelled(read), overwrite=overwrite)
        console.say(f"wrote {levelled}: {copy.source['assumptions'][-1]}; next: sarsplat check {levelled}")
    if examined.contradictions:
        console.say(f"{counted(len(examined.contradictions), 'contradiction')} found")
        return CONTRADICTED
    words = ["sarsplat", "reconstruct", str(dataset), "--out", f"{dataset}-run"]
    console.say(f"no contradictions; next: {shlex.join(words)}")
    return 0
