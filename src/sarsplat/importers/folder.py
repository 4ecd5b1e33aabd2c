"""Import pictures of any origin: a folder of PNG, JPEG, TIFF, NPY or MATLAB files, and a table of their angles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from jaxtyping import Shaped

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import Dataset
from sarsplat.data.header import Calibration
from sarsplat.data.orientation import Layout, oriented
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry import View
from sarsplat.importers.columns import PER_UNIT
from sarsplat.importers.from_map import EAST_DEG, Seen, from_map, producers_ground
from sarsplat.importers.images import AboutImages, assume, dataset_of, write_imported
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.own_lengths import lengths, refuse_map, spacing_beside, warn_of_world_files
from sarsplat.importers.passes import Recording, lists_stacks, stacks_of
from sarsplat.importers.picture_views import Angles, view_of_picture
from sarsplat.importers.rasters import first_georeference
from sarsplat.importers.table import ListedPicture, PictureTable, read_picture_table
from sarsplat.importers.values import read_values
from sarsplat.names import Backscatter, Projection, Quantity, RadarSide, Side, Transmit
from sarsplat.radiometry import beta0_of_gamma0, beta0_of_sigma0

Pair = tuple[float, float]


@checks_arguments
def import_folder(
    folder: str | Path,
    out: str | Path,
    *,
    table: str | Path | None = None,
    columns: Mapping[str, str] | None = None,
    target_class: str | None = None,
    quantity: Quantity | None = None,
    scale: float = 1.0,
    offset: float = 0.0,
    spacing_m: Pair | None = None,
    resolution_m: Pair | None = None,
    ground_range: bool = False,
    grazing_deg: float | None = None,
    near: Side | None = None,
    mirrored: bool = False,
    azimuth_offset_deg: float | None = None,
    counter_clockwise: bool = False,
    azimuth_std_deg: float = 0.0,
    train_views: int | None = None,
    target: str | None = None,
    calibration: Calibration = "relative",
    backscatter: Backscatter = "beta0",
    look: RadarSide | None = None,
    geocoded: Projection | None = None,
    geocoded_height_m: float = 0.0,
    wavelength_m: float | None = None,
    transmit: Transmit = "each",
    noise: float | None = None,
    conjugate: bool = False,
    flattened: bool = False,
    overwrite: bool = False,
    **about: Unpack[AboutImages],
) -> Dataset:
    """Import pictures (PNG, JPEG, TIFF, GeoTIFF, NPY, MATLAB) with a table (CSV) of angles, or stacks of complex ones.

    Parameters
    ----------
    folder : Path
        Folder of the pictures.
    out : Path
        Dataset folder to write.
    table : Path, optional
        Table (CSV) with a row for each picture, of stacks for each channel; without it, the only one in the folder.
    columns : mapping of str to str, optional
        What the table calls its columns, e.g. az=aspect,graz=elev; meanings are file, azimuth or heading (of the
        flight, degrees clockwise from north), grazing or incidence,
        spacing, resolution (or azimuth-spacing, range-spacing …), split, azimuth-std, class, look (left or right),
        near-side, tilt, scale and offset, and of stacks view, baseline and polarisation. Usual names are recognised
        without it.
        What the table says of a picture precedes what is said of all.
    target_class : str, optional
        Take only the pictures of this class, if the table has a column of classes.
    quantity : {"amplitude", "power", "db", "complex"}, optional
        What scale · pixel + offset is; without it, complex numbers are complex amplitude, whole numbers amplitude, and
        others what a column dn-per-magnitude or dn-per-power says.
    scale : float
        Factor on the pixels, e.g. 60/255 of decibels in 8 bits.
    offset : float
        Added to the pixels after that.
    spacing_m : (float, float), optional
        Pixel spacing in the slant plane (azimuth, range), m; of GeoTIFFs it is that of their tags unless given. Of
        geocoded pictures, that of columns and rows on the map.
    resolution_m : (float, float), optional
        3 dB width (azimuth, range), m; without it, the pixel spacing.
    ground_range : bool
        Lengths in range are along the ground; those in the slant plane are cos(grazing) times as long.
    grazing_deg : float, optional
        Grazing angle of all pictures, degrees, if the table has none.
    near : {"top", "bottom", "left", "right"}, optional
        Side of the pictures that is near the radar: the top, unless a column near-side says otherwise.
    mirrored : bool
        The pictures, turned with the near side up, are mirror images; so are columns in the order of time of a radar
        that looks to the left, which a column look says picture by picture.
    azimuth_offset_deg : float
        What the azimuth 0 of the table is here, degrees clockwise from the target's nose: 0 unless given; of geocoded
        pictures −90, so that x points east.
    counter_clockwise : bool
        Azimuths of the table grow counter-clockwise, seen from above.
    azimuth_std_deg : float
        Standard deviation of the azimuths, degrees.
    train_views : int, optional
        Number of training views, evenly chosen; the others are test views. Without it, the column split decides, or all
        are training views.
    target : str, optional
        What is shown; without it, the pictures' class, or else the folder's name.
    calibration : {"absolute", "relative"}
        Whether the power is β⁰ itself, or only up to a factor.
    backscatter : {"beta0", "sigma0", "gamma0"}
        What the power is: σ⁰ and γ⁰ become β⁰ by the factor of level ground.
    look : {"right", "left"}, optional
        Side of its flight to which the radar looks, if no column says it: azimuths follow from it where the table has
        headings, and to the left, columns are mirrored.
    geocoded : {"level", "terrain"}, optional
        The pictures lie on a map (geocoded, north up), onto which their producer projected them from level ground, or
        from the terrain that is given. They are resampled to azimuth and slant range; azimuths of the table are then
        compass bearings of the radar, and the origin is the middle of what all pictures show.
    geocoded_height_m : float
        Height of that level ground, m above the ground of the scene.
    wavelength_m : float, optional
        Of stacks, m. Rows with the same view are then its channels, coregistered and complex: passes, with b/R in
        radians in the column baseline, or polarisations, received and transmitted, in the column polarisation (see
        docs/concepts/stacks.md).
    transmit : {"each", "one"}
        Of stacks: each pass transmits itself, or one transmits for all.
    noise : float, optional
        Of stacks: power of each channel's noise, in the unit of the images; learned unless given.
    conjugate : bool
        Of stacks: what is farther away has more phase.
    flattened : bool
        Of stacks: phases of the level plane z = 0 were taken out. Unless they were, a scatterer at the scene's origin
        must have the same phase in every pass.
    overwrite : bool
        Replace an existing dataset.
    **about
        Looks, ground, terrain and the target's box: see `AboutImages`.

    Raises
    ------
    SarsplatError
        If the table or a picture is missing, damaged or says too little, several classes are shown, a path leads out of
        the folder, a number is out of range, channels do not make a stack, or the output exists.

    Warns
    -----
    SarsplatWarning
        Once each, for rows without a picture, pictures without a row, and what `dataset_of` warns of.
    """
    folder = Path(folder)
    recording = _recording(wavelength_m, transmit, noise, conjugate, flattened)
    listed = read_picture_table(
        folder,
        None if table is None else Path(table),
        columns or {},
        target_class=target_class,
        grazing=grazing_deg is None,
        spacing=spacing_m is None and first_georeference(sorted(folder.rglob("*"))) is None,
        looking=look is not None,
        compass=azimuth_offset_deg is not None or geocoded is not None,
    )
    if recording is None and lists_stacks(listed):
        raise SarsplatError(
            f"{listed.path} has several rows for one view, channels of a stack; give its wavelength with --wavelength "
            "METRES, or a name of its own to each view"
        )
    if azimuth_offset_deg is None:
        azimuth_offset_deg = EAST_DEG if geocoded else 0.0
    angles = Angles(azimuth_offset_deg, counter_clockwise, grazing_deg)
    seen: list[Seen] = []
    for row in listed.pictures:
        picture = _stated(row, look, spacing_m, resolution_m, azimuth_std_deg)
        taken_for = seen[-1].values.quantity if seen else quantity
        factors = _either(picture.scale, scale), _either(picture.offset, offset)
        values = read_values(picture.path, taken_for, *factors, listed.real)
        _refuse_other_unit(listed, values.quantity)
        view = view_of_picture(listed, picture, angles, mirrored if picture.looks_left is None else picture.looks_left)
        values = replace(values, image=_beta0(values.image, view, backscatter))
        seen.append(Seen(picture, values, view, ground_range))
    found = seen[-1].values.quantity
    told = [f"the numbers are {found}"] if quantity is None else []
    told += dict.fromkeys(text for one in seen for text in one.values.assumptions)
    if without := sum(int(one.values.unknown.sum()) for one in seen):
        assume(told, f"{counted(without, 'pixel')} hold what their files call no data, and are taken for zero")
    place = None
    side: Side | None = None  # if it is that of all
    if geocoded:
        _refuse_layout(near or next((one.picture.near for one in seen), None), mirrored, recording)
        ground = producers_ground(geocoded, geocoded_height_m, about.get("terrain"))
        images, place = from_map(listed.path, seen, ground, azimuth_offset_deg, told)
    else:
        if geocoded_height_m:
            raise SarsplatError(
                "--geocoded-height is for geocoded pictures; give --geocoded level too, or leave it out"
            )
        sides = [_near(listed, one.picture, near) for one in seen]
        images = [_in_range(listed.path, one, side, mirrored) for one, side in zip(seen, sides, strict=True)]
        side = sides[0] if len(set(sides)) == 1 else None
        warn_of_world_files(one.picture.path for one in seen if one.values.tags.georeference is None)
        at = side or "side that the table says"
        told.append(f"the radar is at the {at} of the pictures, which are {'' if mirrored else 'not '}mirrored")
    if recording is not None:
        images = stacks_of(listed, images, recording)
    told += _said_of_angles(listed, angles)
    if backscatter != "beta0":
        told.append(f"the power is {backscatter}, and became β⁰ as on level ground")
    if resolution_m is None and not any("resolution" in meaning for meaning in listed.columns):
        told.append("the resolution is the pixel spacing")
    if recording is not None:
        told += _said_of_phases(recording)
    columns_said = ", ".join(f"{meaning} = {name}" for meaning, name in listed.columns.items())
    source: dict[str, Any] = {
        "kind": "folder",
        "table": listed.path.name,
        "columns": listed.columns,
        "quantity": found,
        "scale": scale,
        "offset": offset,
        "ground_range": ground_range,
        **_layout(seen, geocoded, side, mirrored, counter_clockwise),
        "assumptions": [f"columns of the table: {columns_said}", *told],
    }
    dataset = dataset_of(
        images,
        target=(listed.target or folder.resolve().name) if target is None else target,
        source=source,
        train_views=train_views,
        calibration=calibration,
        place=place,
        **about,
    )
    return write_imported(out, dataset, overwrite=overwrite)


def _refuse_other_unit(listed: PictureTable, quantity: Quantity) -> None:
    """Refuse pictures that are taken for something else than the table's column of their scales says they hold."""
    for meaning, held in PER_UNIT.items():
        if meaning in listed.columns and "scale" not in listed.columns and quantity not in held:
            raise SarsplatError(
                f"{listed.path} scales pictures by {shown(listed.columns[meaning])}, which is for "
                f"{' or '.join(held)}, but they are taken for {quantity}; give --quantity {held[0]}"
            )


def _recording(
    wavelength_m: float | None, transmit: Transmit, noise: float | None, conjugate: bool, flattened: bool
) -> Recording | None:
    """How channels of stacks were recorded; None for single images."""
    if wavelength_m is not None:
        return Recording(wavelength_m, transmit, noise, conjugate, flattened)
    given = {"transmit": transmit != "each", "noise": noise is not None, "conjugate": conjugate, "flattened": flattened}
    if named := [name for name, value in given.items() if value]:
        raise SarsplatError(f"--{named[0]} is for stacks; give --wavelength METRES too, or leave it out")
    return None


def _layout(
    seen: Sequence[Seen], geocoded: Projection | None, side: Side | None, mirrored: bool, counter_clockwise: bool
) -> dict[str, Any]:
    """How pictures lay in their files, for remedies that name other options: if it is that of all."""
    if geocoded:
        return {"geocoded": geocoded}
    looks = {bool(one.picture.looks_left) for one in seen}
    if len(looks) > 1 or side is None:
        return {}
    return {"layout": asdict(Layout(side, mirrored, counter_clockwise, looks.pop()))}


def _said_of_angles(listed: PictureTable, angles: Angles) -> list[str]:
    said = []
    if "heading" in listed.columns and "azimuth" not in listed.columns:
        said.append("azimuths are 90° to the left of headings, or to the right where the radar looks left")
    said.append(
        f"azimuths are directions to the radar, {'counter-' if angles.counter_clockwise else ''}clockwise; 0 is "
        f"{angles.offset_deg:g}° from the target's nose"
    )
    return said


def _said_of_phases(recording: Recording) -> list[str]:
    return [
        f"what is farther away has {'more' if recording.conjugate else 'less'} phase in the files",
        "the phases of the level plane z = 0 were taken out of the files"
        if recording.flattened
        else "no phases were taken out of the files, and the scene's origin has the same in every pass",
    ]


def _either(own: float | None, common: float) -> float:
    return common if own is None else own


def _near(listed: PictureTable, picture: ListedPicture, near: Side | None) -> Side:
    """The side of a picture that is near; refused if the table says another than what is said of all."""
    if near is not None and picture.near not in (None, near):
        raise SarsplatError(
            f"{listed.path}: near range of {picture.name} is at the {picture.near} ({listed.columns['near-side']}), "
            f"but --near is {near}; leave it out, or mend the table"
        )
    return picture.near or near or "top"


def _refuse_layout(near: Side | None, mirrored: bool, recording: Recording | None) -> None:
    """Refuse what is said of pictures in range and azimuth if they are geocoded."""
    given = {"near": near is not None, "mirrored": mirrored, "wavelength": recording is not None}
    if named := [name for name, value in given.items() if value]:
        raise SarsplatError(f"--{named[0]} is for pictures in range and azimuth; leave it out, or --geocoded")


def _stated(
    picture: ListedPicture,
    look: RadarSide | None,
    spacing_m: Pair | None,
    resolution_m: Pair | None,
    azimuth_std_deg: float,
) -> ListedPicture:
    """The picture with what is said of all where its row says nothing."""

    def filled(own: tuple[float | None, float | None], common: Pair | None) -> tuple[float | None, float | None]:
        azimuth, slant = (b if a is None else a for a, b in zip(own, common or (None, None), strict=True))
        return azimuth, slant

    return replace(
        picture,
        looks_left=look == "left" if look and picture.looks_left is None else picture.looks_left,
        spacing_m=filled(picture.spacing_m, spacing_m),
        resolution_m=filled(picture.resolution_m, resolution_m),
        azimuth_std_deg=_either(picture.azimuth_std_deg, azimuth_std_deg),
    )


def _beta0(
    image: Shaped[np.ndarray, "rows columns"], view: View, backscatter: Backscatter
) -> Shaped[np.ndarray, "rows columns"]:
    """Power, or complex amplitude, as that of β⁰."""
    if backscatter == "beta0":
        return image
    factor = {"sigma0": beta0_of_sigma0, "gamma0": beta0_of_gamma0}[backscatter](1.0, view.grazing_deg)
    made: Shaped[np.ndarray, "rows columns"] = image * image.real.dtype.type(
        math.sqrt(factor) if image.dtype.kind == "c" else factor
    )
    return made


def _in_range(table: Path, one: Seen, near: Side, mirrored: bool) -> MeasuredImage:
    """A picture in range and azimuth."""
    picture, georeference = one.picture, one.values.tags.georeference
    stated = picture.spacing_m
    if georeference is not None:
        if georeference.crs is not None:
            refuse_map(str(picture.path), georeference)
        stated = spacing_beside(str(picture.path), georeference, near, stated)
    spacing = lengths(table, picture, "spacing", stated, one.slant)
    resolution = lengths(table, picture, "resolution", picture.resolution_m, one.slant) if one.resolved else spacing
    return MeasuredImage(
        picture.name,
        oriented(one.values.image, near, mirrored != bool(picture.looks_left)),
        one.view,
        spacing,
        resolution,
        azimuth_std_deg=picture.azimuth_std_deg or 0.0,
        split=picture.split,
    )
