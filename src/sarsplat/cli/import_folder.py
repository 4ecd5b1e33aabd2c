"""`sarsplat import folder`: pictures and a table in, a dataset out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sarsplat.cli.arguments import (
    Folder,
    Lengths,
    Metres,
    OptionalCount,
    OptionalFile,
    OptionalName,
    OptionalNumber,
    TargetBox,
    corners,
    heights,
    one_of,
    pair,
)
from sarsplat.cli.imported import carry_out
from sarsplat.cli.importers import Contents, Recognised, dataset_name, typed_import
from sarsplat.errors import SarsplatError, counted
from sarsplat.names import Quantity, Side, Transmit

if TYPE_CHECKING:
    from sarsplat.importers.columns import Columns


_LEAST_CERTAIN = 0.1
"""Pictures may be anything's."""

_LISTED = 5
"""Tables that are named."""


def command(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")],
    *,
    out: Folder,
    table: OptionalFile = None,
    columns: Annotated[tuple[str, ...], tyro.conf.arg(metavar="MEANING=NAME …", help_behavior_hint="(optional)")] = (),
    target_class: Annotated[
        str | None, tyro.conf.arg(name="class", metavar="NAME", help_behavior_hint="(optional)")
    ] = None,
    quantity: Annotated[Quantity | None, one_of(Quantity)] = None,
    scale: float = 1.0,
    offset: float = 0.0,
    spacing: Lengths = (),
    resolution: Lengths = (),
    ground_range: bool = False,
    grazing: OptionalNumber = None,
    near: Side = "top",
    mirrored: bool = False,
    azimuth_offset: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 0.0,
    counter_clockwise: bool = False,
    azimuth_std: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 0.0,
    train_views: OptionalCount = None,
    target: OptionalName = None,
    calibrated: bool = False,
    looks: Annotated[float, tyro.conf.arg(metavar="NUMBER")] = 1.0,
    no_ground: bool = False,
    terrain: OptionalFile = None,
    target_box: TargetBox = None,
    wavelength: Metres = None,
    transmit: Transmit = "each",
    noise: OptionalNumber = None,
    conjugate: bool = False,
    flattened: bool = False,
    overwrite: bool = False,
) -> int:
    """Import pictures (PNG, JPEG, TIFF, GeoTIFF, NPY, MATLAB) with a table (CSV) of angles, or stacks of complex ones.

    Parameters
    ----------
    folder
        Folder of the pictures.
    out
        Dataset folder to write.
    table
        Table (CSV) with a row for each picture; without it, the only one in the folder.
    columns
        What the table calls its columns, e.g. az=aspect,graz=elev; meanings are file, azimuth, grazing or incidence,
        spacing, resolution (or azimuth-spacing, range-spacing …), split, azimuth-std, class, look (left or right),
        scale and offset, and of stacks view, baseline and polarisation. The usual names are recognised without it.
    target_class
        Take only the pictures of this class, if the table has a column of classes.
    quantity
        What scale · pixel + offset is; without it, complex numbers are complex amplitude, whole numbers amplitude.
    scale
        Factor on the pixels.
    offset
        Added to the pixels after that.
    spacing
        Pixel spacing in the slant plane, m: one number, or azimuth and range.
    resolution
        3 dB width, m: one number, or azimuth and range; without it, the pixel spacing.
    ground_range
        Lengths in range are along the ground.
    grazing
        Grazing angle of all pictures, degrees, if the table has none.
    near
        Side of the pictures that is near the radar.
    mirrored
        The pictures, turned with the near side up, are mirror images; so are columns in the order of time of a radar
        that looks to the left.
    azimuth_offset
        What the azimuth 0 of the table is here, degrees clockwise from the target's nose.
    counter_clockwise
        Azimuths of the table grow counter-clockwise, seen from above.
    azimuth_std
        Standard deviation of the azimuths, degrees.
    train_views
        Number of training views, evenly chosen; the others are test views. Without it, the column split decides, or all
        are training views.
    target
        What is shown; without it, the pictures' class, or else the folder's name.
    calibrated
        The power is β⁰ itself, not only up to a factor.
    looks
        Looks of the speckle; 0 if there is no speckle.
    no_ground
        The pictures show nothing but the target.
    terrain
        Heights of the ground (GeoTIFF, metres), its middle at the scene's origin; level without it.
    target_box
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Without it, it is
        derived from the images.
    wavelength
        Of stacks, m. Rows with the same view are then its channels, coregistered and complex: passes, with b/R in
        radians in the column baseline, or polarisations, received and transmitted, in the column polarisation.
    transmit
        Of stacks: each pass transmits itself, or one transmits for all.
    noise
        Of stacks: power of each channel's noise, in the unit of the images; learned unless given.
    conjugate
        Of stacks: what is farther away has more phase.
    flattened
        Of stacks: phases of the level plane z = 0 were taken out. Unless they were, a scatterer at the scene's origin
        must have the same phase in every pass.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.importers import import_folder

    return carry_out(
        import_folder,
        folder,
        out,
        doing=f"reading pictures from {folder}",
        table=table,
        columns=_named(columns),
        target_class=target_class,
        quantity=quantity,
        scale=scale,
        offset=offset,
        spacing_m=pair(spacing, "spacing"),
        resolution_m=pair(resolution, "resolution"),
        ground_range=ground_range,
        grazing_deg=grazing,
        near=near,
        mirrored=mirrored,
        azimuth_offset_deg=azimuth_offset,
        counter_clockwise=counter_clockwise,
        azimuth_std_deg=azimuth_std,
        train_views=train_views,
        target=target,
        calibration="absolute" if calibrated else "relative",
        looks=looks or None,
        ground=not no_ground,
        terrain=heights(terrain),
        target_box_m=corners(target_box),
        wavelength_m=wavelength,
        transmit=transmit,
        noise=noise,
        conjugate=conjugate,
        flattened=flattened,
        overwrite=overwrite,
    )


def _named(words: tuple[str, ...]) -> dict[str, str]:
    """`az=aspect,graz=elev` as a mapping; names may contain spaces, but no commas."""
    named = {}
    for word in filter(None, ",".join(words).split(",")):
        meaning, equals, name = word.partition("=")
        if not equals or not name:
            raise SarsplatError(f"--columns {word!r} is not of the form MEANING=NAME, such as azimuth=heading")
        named[meaning.strip()] = name.strip()
    return named


def recognise(contents: Contents) -> Recognised | None:
    """Pictures, with or without a table of their angles."""
    from sarsplat.importers.pictures import PICTURE_ENDINGS

    pictures = len(contents.ending_in(*PICTURE_ENDINGS))
    if not pictures or not contents.path.is_dir():
        return None
    tables = contents.ending_in(".csv")
    with_table = _with_table(contents, pictures, tables[0]) if len(tables) == 1 else None
    return with_table or _without_table(contents, pictures, PICTURE_ENDINGS, tables)


def _with_table(contents: Contents, pictures: int, path: Path) -> Recognised:
    """Pictures and a table, which may lack columns or not be readable."""
    from sarsplat.data.csv_table import read_table
    from sarsplat.importers.columns import chosen_columns

    facts = {"pictures": str(pictures)}
    try:
        table = read_table(path, "a table with a row for each picture")
        columns = chosen_columns(table, {})
    except SarsplatError as error:
        facts["table"] = str(error)
        return Recognised("pictures with a table that cannot be used as it is", facts, certainty=_LEAST_CERTAIN)
    facts["table"] = f"{table.path} ({counted(len(table.rows), 'row')})"
    if columns:
        facts["columns"] = ", ".join(f"{meaning} = {name}" for meaning, name in columns.items())
    lacking = [meaning for meaning in ("file", "azimuth") if meaning not in columns]
    if lacking:
        facts["missing"] = f"which column is the {' and which the '.join(lacking)}; it has {', '.join(table.columns)}"
    classes = dict.fromkeys(row[columns["class"]] for _, row in table.rows) if "class" in columns else {}
    if len(classes) > 1:
        facts["classes"] = ", ".join(classes)
    views = [row[columns["view"]] for _, row in table.rows] if "view" in columns else []
    stacks = bool(columns.keys() & {"baseline", "polarisation"}) and len(set(views)) < len(views)
    if stacks:
        facts["stacks"] = f"{counted(len(set(views)), 'view')} of several channels"
    command = _command(contents.path, columns, lacking, next(iter(classes)) if len(classes) > 1 else None, stacks)
    certainty = 1.0 if not lacking else 0.2 if columns else _LEAST_CERTAIN
    return Recognised(f"pictures with a table{'' if lacking else ' of their angles'}", facts, command, certainty)


def _command(folder: Path, columns: Columns, lacking: list[str], target_class: str | None, stacks: bool) -> str:
    words = ["folder", str(folder)]
    if target_class is not None:
        words += ["--class", target_class]
    if lacking:
        words += ["--columns", ",".join(f"{meaning}=NAME" for meaning in lacking)]
    if "grazing" not in columns and "incidence" not in columns:
        words += ["--grazing", "DEGREES"]
    if not any("spacing" in meaning for meaning in columns):
        words += ["--spacing", "METRES"]
    if stacks:
        words += ["--wavelength", "METRES"]
    return typed_import(*words, out=dataset_name(folder))


def _without_table(contents: Contents, pictures: int, endings: tuple[str, ...], tables: list[Path]) -> Recognised:
    numbers = {ending: len(contents.ending_in(ending)) for ending in endings}
    kinds = ", ".join(f"{number} {ending}" for ending, number in numbers.items() if number)
    columns = "the columns file, azimuth, grazing, spacing (docs/reference/formats/folder.md)"
    needed = f"a table (CSV) with a row for each, with {columns}"
    if tables:
        needed = f"which of {len(tables)} tables is theirs: {', '.join(map(str, tables[:_LISTED]))}"
        needed += ", …" * (len(tables) > _LISTED)
    words = ("folder", str(contents.path), "--table", "TABLE.csv", "--spacing", "METRES")
    return Recognised(
        f"{counted(pictures, 'picture')} ({kinds}) without a table of their angles",
        {"missing": needed},
        typed_import(*words, out=dataset_name(contents.path)),
        certainty=_LEAST_CERTAIN,
    )
