"""`sarsplat import arrays stack.npz …` and `sarsplat export RUN points.csv`, in a package of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

from sarsplat import Dataset, View
from sarsplat.cli.from_signature import command_of
from sarsplat.cli.importers import Contents, Recognised
from sarsplat.exports import Format, Points
from sarsplat.importers import AboutImages


def read_arrays(
    file: str | Path, out: str | Path, *, spacing_m: float, overwrite: bool = False, **about: Unpack[AboutImages]
) -> Dataset:
    """Import images from the arrays `power`, `azimuth_deg` and `grazing_deg` of one .npz file.

    Parameters
    ----------
    file : Path
        File of the arrays.
    out : Path
        Dataset folder to write.
    spacing_m : float
        Pixel spacing, m.
    overwrite : bool
        Replace an existing dataset.
    **about
        Looks, ground, terrain and the target's box: see `AboutImages`.
    """
    import numpy as np

    from sarsplat.importers import MeasuredImage, dataset_of, write_imported

    arrays, cell = np.load(file), (spacing_m, spacing_m)
    angles = zip(arrays["azimuth_deg"].tolist(), arrays["grazing_deg"].tolist(), strict=True)
    views = [View(azimuth, grazing) for azimuth, grazing in angles]
    images = [MeasuredImage(f"{k:03d}", arrays["power"][k], view, cell, cell) for k, view in enumerate(views)]
    source = {"kind": "arrays", "assumptions": ["row 0 is near range", "the resolution is the pixel spacing"]}
    dataset = dataset_of(images, target=Path(file).stem, source=source, **about)
    return write_imported(out, dataset, overwrite=overwrite)


import_arrays = command_of(__name__, f"{__name__}:read_arrays")
"""The command: its options are those of the function."""


def recognise(contents: Contents) -> Recognised | None:
    """Recognise an .npz file, or a folder of them, for `sarsplat info`."""
    return Recognised("stacks of images", certainty=0.5) if contents.ending_in(".npz") else None


def write_csv(points: Points, path: Path, colour: str) -> None:
    """The points of a run, m, as text."""
    lines = ["x,y,z", *(",".join(f"{number:.4f}" for number in point) for point in points.positions)]
    path.write_text("\n".join(lines) + "\n")


CSV = Format({"points": write_csv}, {"points": "any spreadsheet"}, recognises=lambda head, _: head.startswith(b"x,y,z"))
