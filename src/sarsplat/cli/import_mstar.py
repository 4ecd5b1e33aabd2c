"""`sarsplat import mstar`: measured chips in, a dataset out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli.arguments import (
    Angles,
    Folder,
    OptionalFile,
    OptionalName,
    TargetBox,
    angles,
    corners,
    heights,
)
from sarsplat.cli.imported import carry_out
from sarsplat.cli.importers import Contents, Recognised, training_half, typed_import
from sarsplat.errors import SarsplatError

_USUAL_DEPRESSION = 17
_MOST_READ = 500
"""Number of Phoenix files whose headers are read; the others are assumed to be of the same classes."""


def command(
    chips: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CHIPS")],
    *,
    out: Folder,
    target_class: Annotated[str, tyro.conf.arg(name="class", metavar="NAME")],
    train_views: Annotated[int, tyro.conf.arg(metavar="K")],
    labels: OptionalFile = None,
    train_depression: Angles = ("17",),
    serial: OptionalName = None,
    terrain: OptionalFile = None,
    target_box: TargetBox = None,
    azimuth_std: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 0.0,
    mirrored: bool = False,
    no_test: bool = False,
    overwrite: bool = False,
) -> int:
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
    terrain
        Heights of the ground (GeoTIFF, metres), its middle at the scene's origin; level without it.
    target_box
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Without it, it is
        derived from the images.
    azimuth_std
        Standard deviation of the azimuths, degrees, of chips for which the table has none; uncertain ones are refined
        in training.
    mirrored
        Treat the published chips as mirror images.
    no_test
        Leave out all other chips: nothing to score with, but the import takes less time.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.importers import import_mstar

    return carry_out(
        import_mstar,
        chips,
        out,
        doing=f"reading chips from {chips}",
        labels=labels,
        target_class=target_class,
        train_views=train_views,
        train_depression=[_whole(angle) for angle in angles(train_depression, "train-depression")],
        serial=serial,
        terrain=heights(terrain),
        target_box_m=corners(target_box),
        azimuth_std_deg=azimuth_std,
        mirrored=mirrored,
        test=not no_test,
        overwrite=overwrite,
    )


def _whole(angle: float) -> int:
    """Depressions are named by whole degrees."""
    if not angle.is_integer():  # nor NaN or infinite
        raise SarsplatError(f"--train-depression {angle:g} is not a whole number of degrees; chips are named by these")
    return round(angle)


def recognise(contents: Contents) -> Recognised | None:
    """JPEGs that a table of labels describes, which may lie up to two folders above; or Phoenix files."""
    from sarsplat.importers.mstar_chips import has_label_columns
    from sarsplat.importers.phoenix import is_phoenix
    from sarsplat.importers.pictures import PICTURE_ENDINGS

    if contents.path.is_dir() and contents.ending_in(".jpg", ".jpeg"):
        above = (path for parent in contents.path.absolute().parents[:2] for path in sorted(parent.glob("*.csv")))
        for table in (*contents.ending_in(".csv"), *above):
            if has_label_columns(table) and (labelled := _labelled(contents.path, table)) is not None:
                return labelled
    phoenix = [path for path in contents.files if path.suffix.lower() not in PICTURE_ENDINGS and is_phoenix(path)]
    if contents.path.is_file() and phoenix:
        return _one_phoenix(contents.path)
    return _phoenix(contents.path, phoenix) if phoenix else None


def _labelled(folder: Path, table: Path) -> Recognised | None:
    """The chips in a folder that a table describes; None if it describes none of them."""
    from sarsplat.data.csv_table import parsed
    from sarsplat.importers.mstar_chips import read_labels

    rows = [row for _, row in read_labels(table).rows]
    for root in dict.fromkeys((folder, table.parent)):
        inside = [row for row in rows if (root / row["path"]).absolute().is_relative_to(folder.absolute())]
        if present := [row for row in inside if (root / row["path"]).is_file()]:
            break
    else:
        return None
    missing = f" ({len(inside) - len(present)} more in the table are not there)" if len(present) < len(inside) else ""
    return _chips(
        "MSTAR chips as JPEGs, with a table of labels",
        {"chips": f"{len(present)}{missing}", "labels": str(table)},
        [(row["class"], parsed(row["desired_depression_deg"])) for row in present],
        [str(root), "--labels", str(table)],
    )


def _phoenix(folder: Path, files: list[Path]) -> Recognised:
    from sarsplat.importers import read_phoenix

    chips = [read_phoenix(path) for path in files[:_MOST_READ]]
    (rows, columns), spacing = chips[0].magnitude.shape, chips[0].spacing_m
    pixels = f"{rows} × {columns} pixels of {spacing[1]:g} m in range, {spacing[0]:g} m across"
    return _chips(
        "original MSTAR chips (Phoenix files)",
        {"chips": str(len(files)), "the first": pixels},
        [(chip.target_type, chip.desired_depression_deg) for chip in chips],
        [str(folder)],
    )


def _one_phoenix(path: Path) -> Recognised:
    from sarsplat.importers import read_phoenix

    chip = read_phoenix(path)
    rows = {
        "vehicle": f"{chip.target_type}, serial {chip.serial}",
        "depression": f"{chip.measured_depression_deg:g}° (planned {chip.desired_depression_deg:g}°)",
        "TargetAz": f"{chip.target_az_deg:g}°; azimuth here {-chip.target_az_deg % 360:g}°",
        "pixels": f"{chip.magnitude.shape[0]} × {chip.magnitude.shape[1]}, linear magnitude and phase",
        "spacing": f"{chip.spacing_m[0]:g} m in cross-range, {chip.spacing_m[1]:g} m in slant range",
        "resolution": f"{chip.resolution_m[0]:g} m, {chip.resolution_m[1]:g} m (3 dB)",
        "radar at the": chip.radar_position,
    }
    return Recognised("a Phoenix chip (MSTAR)", rows)


def _chips(kind: str, facts: dict[str, str], planned: Sequence[tuple[str, float]], where: list[str]) -> Recognised:
    """Classes and their planned depressions, degrees, NaN if unknown; and the command for the largest class."""
    by_class: dict[str, Counter[int | None]] = {name: Counter() for name in sorted({name for name, _ in planned})}
    for name, angle in planned:
        by_class[name][round(angle) if math.isfinite(angle) else None] += 1
    for name, depressions in by_class.items():
        facts[f"class {name}"] = ", ".join(
            f"{number} at {'an unknown depression' if angle is None else f'{angle}°'}"
            for angle, number in sorted(depressions.items(), key=lambda item: -(item[0] or 0))
        )
    name = max(by_class, key=lambda its: by_class[its].total())
    usable = {angle: number for angle, number in by_class[name].items() if angle is not None}
    if not usable:
        return Recognised(kind, facts)
    angle = _USUAL_DEPRESSION if _USUAL_DEPRESSION in usable else max(usable, key=lambda its: usable[its])
    words = [*where, "--class", name, "--train-views", training_half(usable[angle])]
    if angle != _USUAL_DEPRESSION:
        words += ["--train-depression", str(angle)]
    plain = "".join(c for c in name.lower().split("_")[0] if c.isalnum()) or "chips"
    return Recognised(kind, facts, typed_import("mstar", *words, out=f"mstar-{plain}"))
