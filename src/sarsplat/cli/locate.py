"""`sarsplat locate`: find class and azimuth of images by rendering runs."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import Metres, OptionalFolder, OptionalName, OptionalNumber, refuse_existing, require_ending
from sarsplat.errors import counted
from sarsplat.names import Quantity, Side


def locate(
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN … IMAGES")],
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="CSV")],
    calibrate: Annotated[
        tuple[Path, ...], tyro.conf.arg(metavar="LABELLED …|JSON", help_behavior_hint="(optional)")
    ] = (),
    split: OptionalName = None,
    grazing: OptionalNumber = None,
    step: float = 3.0,
    window: Metres = None,
    ground: Literal["learned", "flat"] = "learned",
    near: Side = "top",
    quantity: Quantity | None = None,
    write_back: OptionalFolder = None,
    overwrite: bool = False,
) -> None:
    """Find class and azimuth of images: each is compared with every run, rendered from all azimuths.

    Parameters
    ----------
    paths
        Runs of one class or several, and images: datasets, folders of datasets, or folders of pictures with the runs'
        pixels. Classes and azimuths of datasets count as labels only. The class is always one of the runs'.
    out
        Table to write. Beside it are written a page of the same name, .html, that shows images beside the renderings
        that explain them, and of --calibrate LABELLED the calibration, .json.
    calibrate
        Labelled datasets of all classes by which odds are made true; images to be located are left out. Or the
        .json of an earlier call.
    split
        Set of the datasets to locate, such as test-15 (default: all but the training set).
    grazing
        Grazing angle of all images, degrees (default: that of each image, to a degree). Pictures need it.
    step
        Step between azimuths, degrees; it divides 360.
    window
        Side of the compared square around the origin (default: targets and shadows of all runs), as far as they reach.
    ground
        Ground of the renderings: learned knows the field where the training images were recorded, flat does not.
    near
        Side of pictures that is near the radar; MSTAR's is the bottom.
    quantity
        Quantity of the numbers in pictures (default: as in import folder).
    write_back
        Copy of the dataset to write, with the azimuths found for images that had none; training refines those it uses.
    overwrite
        Replace existing files.
    """
    from sarsplat import recognition

    require_ending("out", out, ".csv")
    files = recognition.files_of(out, calibrate)
    for path in filter(None, (*files, write_back)):
        refuse_existing(path, overwrite)
    runs, images = recognition.runs_and_images(paths, one_dataset=write_back is not None)
    located = recognition.locate(
        runs,
        images,
        calibrate=calibrate,
        split=split,
        grazing_deg=grazing,
        step_deg=step,
        window_m=window,
        ground=ground,
        near=near,
        quantity=quantity,
        quiet=False,
    )
    recognition.write_files(located, files)
    if write_back is not None:
        console.say(f"wrote {recognition.write_back(located, images[0], write_back, overwrite=overwrite)}")
    if scores := located.scores_in_words():
        console.facts("where labels are known", scores)
    if not located.calibration.images and len(located.classes) > 1:
        console.warn("the odds are uncalibrated; give --calibrate labelled images of all classes to make them true")
    console.finish(f"{out}: {counted(len(located), 'image')}", f"open {files[1]} in a browser")
