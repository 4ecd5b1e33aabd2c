"""`sarsplat import sample`: the SAMPLE set's MATLAB files in, a dataset out."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sarsplat.cli.arguments import (
    Folder,
    OptionalCount,
    OptionalFile,
    TargetBox,
    corners,
    heights,
)
from sarsplat.cli.imported import carry_out
from sarsplat.cli.importers import Contents, Recognised, training_half, typed_import
from sarsplat.names import SampleKind


def command(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")],
    *,
    out: Folder,
    target_class: Annotated[str, tyro.conf.arg(name="class", metavar="NAME")],
    kind: SampleKind = "real",
    train_views: OptionalCount = None,
    near: Literal["top", "bottom"] = "bottom",
    mirrored: bool = False,
    terrain: OptionalFile = None,
    target_box: TargetBox = None,
    overwrite: bool = False,
) -> int:
    """Import images of AFRL's SAMPLE set: measured MSTAR chips and simulated ones (.mat), complex.

    Parameters
    ----------
    folder
        Folder of the set.
    out
        Dataset folder to write.
    target_class
        Vehicle, e.g. t72.
    kind
        Measured or simulated images.
    train_views
        Number of training images, evenly chosen; the others are test images. Without it, all are for training.
    near
        Rows that are near the radar; MSTAR's chips have them at the bottom.
    mirrored
        Treat the images as mirror images.
    terrain
        Heights of the ground (GeoTIFF, metres), its middle at the scene's origin; level without it.
    target_box
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Without it, it is
        derived from the images.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.importers import import_sample

    return carry_out(
        import_sample,
        folder,
        out,
        doing=f"reading images from {folder}",
        target=target_class,
        kind=kind,
        train_views=train_views,
        near=near,
        mirrored=mirrored,
        terrain=heights(terrain),
        target_box_m=corners(target_box),
        overwrite=overwrite,
    )


def recognise(contents: Contents) -> Recognised | None:
    """Files named like those of the set."""
    from sarsplat.importers.sample import named_as_sample

    names = [name for name in map(named_as_sample, contents.ending_in(".mat")) if name is not None]
    if not names:
        return None
    by_kind = Counter((name.target, name.kind) for name in names)
    target, kind = max(by_kind, key=lambda its: (by_kind[its], its[1] == "real"))
    facts = {f"class {target}": f"{number} {kind}" for (target, kind), number in sorted(by_kind.items())}
    words = ("--class", target, "--kind", kind, "--train-views", training_half(by_kind[target, kind]))
    folder = contents.path if contents.path.is_dir() else contents.path.parent
    command = typed_import("sample", str(folder), *words, out=f"sample-{target}")
    return Recognised("images of the SAMPLE set (complex, MATLAB files)", facts, command)
