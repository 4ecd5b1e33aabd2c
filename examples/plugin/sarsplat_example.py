"""`sarsplat import arrays stack.npz …` and `sarsplat export RUN points.csv`, in a package of its own."""

from pathlib import Path
from typing import Annotated

import tyro

from sarsplat import Dataset, View
from sarsplat.cli.arguments import Folder
from sarsplat.cli.importers import Contents, Recognised
from sarsplat.exports import Format, Points


def import_arrays(
    file: Annotated[Path, tyro.conf.Positional], *, out: Folder, spacing: float, overwrite: bool = False
) -> int:
    """Import images from the arrays `power`, `azimuth_deg` and `grazing_deg` of one .npz file."""
    from sarsplat.cli.imported import carry_out

    return carry_out(read_arrays, file, out, overwrite=overwrite, spacing=spacing)


def read_arrays(file: Path, out: Path, *, spacing: float, overwrite: bool) -> Dataset:
    """The same in Python: the dataset, written to `out`."""
    import numpy as np

    from sarsplat.importers import MeasuredImage, dataset_of, write_imported

    arrays, cell = np.load(file), (spacing, spacing)
    angles = zip(arrays["azimuth_deg"].tolist(), arrays["grazing_deg"].tolist(), strict=True)
    views = [View(azimuth, grazing) for azimuth, grazing in angles]
    images = [MeasuredImage(f"{k:03d}", arrays["power"][k], view, cell, cell) for k, view in enumerate(views)]
    source = {"kind": "arrays", "assumptions": ["row 0 is near range", "the resolution is the pixel spacing"]}
    return write_imported(out, dataset_of(images, target=file.stem, source=source), overwrite=overwrite)


def recognise(contents: Contents) -> Recognised | None:
    """What `sarsplat info` says of an .npz file, or of a folder of them."""
    stacks = contents.ending_in(".npz")
    command = "sarsplat import arrays {} --spacing METRES --out DIR"
    return Recognised("stacks of images", {}, command.format(stacks[0]), certainty=0.5) if stacks else None


def write_csv(points: Points, path: Path, colour: str) -> None:
    """The points of a run, m, as text."""
    lines = ["x,y,z", *(",".join(f"{number:.4f}" for number in point) for point in points.positions)]
    path.write_text("\n".join(lines) + "\n")


CSV = Format({"points": write_csv}, {"points": "any spreadsheet"}, recognises=lambda head, _: head.startswith(b"x,y,z"))
