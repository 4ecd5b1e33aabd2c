"""Import pictures of any origin: a folder of PNG, JPEG, TIFF, NPY or MATLAB files, and a table of their angles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Unpack

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import Dataset
from sarsplat.data.header import Calibration
from sarsplat.data.orientation import Layout, oriented
from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.importers.images import AboutImages, MeasuredImage, dataset_of, view_of, write_imported
from sarsplat.importers.passes import Recording, lists_stacks, stacks_of
from sarsplat.importers.pictures import likely_quantity, power_or_signal, read_pixels
from sarsplat.importers.table import ListedPicture, read_picture_table
from sarsplat.names import Quantity, Side, Transmit

Pair = tuple[float, float]

_HALFWAY_DEG = 0.1
"""Angles of one radar that are said beside those of two may be rounded."""


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
    near: Side = "top",
    mirrored: bool = False,
    azimuth_offset_deg: float = 0.0,
    counter_clockwise: bool = False,
    azimuth_std_deg: float = 0.0,
    train_views: int | None = None,
    target: str | None = None,
    calibration: Calibration = "relative",
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
        What the table calls its columns, e.g. az=aspect,graz=elev; meanings are file, azimuth, grazing or incidence,
        spacing, resolution (or azimuth-spacing, range-spacing …), split, azimuth-std, class, look (left or right),
        tilt, scale and offset, of bistatic images transmit-azimuth, transmit-grazing, receive-azimuth and
        receive-grazing, and of stacks view, baseline and polarisation. Usual names are recognised without it.
        What the table says of a picture precedes what is said of all.
    target_class : str, optional
        Take only the pictures of this class, if the table has a column of classes.
    quantity : {"amplitude", "power", "db", "complex"}, optional
        What scale · pixel + offset is; without it, complex numbers are complex amplitude, whole numbers amplitude.
    scale : float
        Factor on the pixels, e.g. 60/255 of decibels in 8 bits.
    offset : float
        Added to the pixels after that.
    spacing_m : (float, float), optional
        Pixel spacing in the slant plane (azimuth, range), m.
    resolution_m : (float, float), optional
        3 dB width (azimuth, range), m; without it, the pixel spacing.
    ground_range : bool
        Lengths in range are along the ground; those in the slant plane are cos(grazing) times as long.
    grazing_deg : float, optional
        Grazing angle of all pictures, degrees, if the table has none.
    near : {"top", "bottom", "left", "right"}
        Side of the pictures that is near the radar.
    mirrored : bool
        The pictures, turned with the near side up, are mirror images; so are columns in the order of time of a radar
        that looks to the left, which a column look says picture by picture.
    azimuth_offset_deg : float
        What the azimuth 0 of the table is here, degrees clockwise from the target's nose.
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
        spacing=spacing_m is None,
    )
    if recording is None and lists_stacks(listed):
        raise SarsplatError(
            f"{listed.path} has several rows for one view, channels of a stack; give its wavelength with --wavelength "
            "METRES, or a name of its own to each view"
        )
    guessed = quantity
    images = []
    for picture in listed.pictures:
        pixels = read_pixels(picture.path)
        guessed = guessed or likely_quantity(pixels, str(picture.path))
        image = power_or_signal(
            pixels, guessed, str(picture.path), _either(picture.scale, scale), _either(picture.offset, offset)
        )
        left = mirrored if picture.looks_left is None else picture.looks_left
        view = _view(listed.path, picture, (azimuth_offset_deg, counter_clockwise), grazing_deg, left)
        slant = view.look.slant_range(1.0) if ground_range else 1.0
        spacing = _lengths(listed.path, picture, "spacing", spacing_m, slant)
        stated = resolution_m is not None or any(picture.resolution_m)
        resolution = _lengths(listed.path, picture, "resolution", resolution_m, slant) if stated else spacing
        images.append(
            MeasuredImage(
                picture.name,
                oriented(image, near, mirrored != bool(picture.looks_left)),
                view,
                spacing,
                resolution,
                azimuth_std_deg=_either(picture.azimuth_std_deg, azimuth_std_deg),
                split=picture.split,
            )
        )
    if recording is not None:
        images = stacks_of(listed, images, recording)
    apart = any(image.view.apart_deg for image in images)
    looks = {bool(picture.looks_left) for picture in listed.pictures}
    layout = {"layout": asdict(Layout(near, mirrored, counter_clockwise, looks.pop()))} if len(looks) == 1 else {}
    resolution_known = resolution_m is not None or any("resolution" in meaning for meaning in listed.columns)
    source: dict[str, Any] = {
        "kind": "folder",
        "table": listed.path.name,
        "columns": listed.columns,
        "quantity": guessed,
        "scale": scale,
        "offset": offset,
        "ground_range": ground_range,
        **layout,  # if it is that of all
        "assumptions": [
            "columns of the table: " + ", ".join(f"{meaning} = {name}" for meaning, name in listed.columns.items()),
            *([f"the numbers are {guessed}"] if quantity is None else []),
            f"the radar is at the {near} of the pictures, which are {'' if mirrored else 'not '}mirrored",
            f"azimuths are directions to the radar, {'counter-' if counter_clockwise else ''}clockwise; 0 is "
            f"{azimuth_offset_deg:g}° from the target's nose",
            *(["slant ranges are half of the way from the transmitter to the receiver"] if apart else []),
            *([] if resolution_known else ["the resolution is the pixel spacing"]),
            *([] if recording is None else _said_of_phases(recording)),
        ],
    }
    dataset = dataset_of(
        images,
        target=(listed.target or folder.resolve().name) if target is None else target,
        source=source,
        train_views=train_views,
        calibration=calibration,
        **about,
    )
    return write_imported(out, dataset, overwrite=overwrite)


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


def _said_of_phases(recording: Recording) -> list[str]:
    return [
        f"what is farther away has {'more' if recording.conjugate else 'less'} phase in the files",
        "the phases of the level plane z = 0 were taken out of the files"
        if recording.flattened
        else "no phases were taken out of the files, and the scene's origin has the same in every pass",
    ]


def _either(own: float | None, common: float) -> float:
    return common if own is None else own


def _view(
    table: Path, picture: ListedPicture, azimuths: tuple[float, bool], grazing_deg: float | None, left: bool
) -> View:
    """The view of a picture, which is mirrored if the radar looks to the left: then it is one that looks right.

    `azimuths` are the offset of the table's azimuths, degrees, and whether they run counter-clockwise.
    """
    name, (offset, counter_clockwise) = f"{table}: {picture.name}", azimuths

    def clockwise(azimuth_deg: float) -> float:
        return offset + (-azimuth_deg if counter_clockwise else azimuth_deg)

    tilt = picture.tilt_deg or 0.0
    tilt = -tilt if left else tilt
    if picture.ways_deg is not None:
        return _of_two_ways(name, picture, picture.ways_deg, clockwise, tilt)
    grazing = grazing_deg if picture.grazing_deg is None else picture.grazing_deg
    if grazing is None:
        raise SarsplatError(
            f"{table} does not say from what grazing angle {picture.name} is; name the column with "
            "--columns grazing=NAME (or incidence=NAME), or give one angle for all with --grazing"
        )
    assert picture.azimuth_deg is not None  # the table was refused
    return view_of(name, clockwise(picture.azimuth_deg), grazing, tilt)


def _of_two_ways(
    name: str,
    picture: ListedPicture,
    ways_deg: tuple[float, float, float, float],
    clockwise: Callable[[float], float],
    tilt_deg: float,
) -> View:
    """The view of a picture whose transmitter and receiver the table names; that of one radar if they are the same.

    Refused if the row also says where one radar would be, and that is not halfway between them.
    """
    ends = [
        view_of(f"{name}, {whose}", clockwise(azimuth), grazing)
        for whose, azimuth, grazing in zip(("transmitter", "receiver"), ways_deg[::2], ways_deg[1::2], strict=True)
    ]
    if ends[0] == ends[1]:
        view = replace(ends[0], tilt_deg=tilt_deg)
    else:
        try:
            view = View.bistatic(ends[0].direction, ends[1].direction, tilt_deg=tilt_deg)
        except SarsplatError as error:
            raise SarsplatError(f"{name}: {error}") from error
    stated = None if picture.azimuth_deg is None else clockwise(picture.azimuth_deg)
    for what, said, halfway in (
        ("azimuth", stated, view.azimuth_deg),
        ("grazing angle", picture.grazing_deg, view.grazing_deg),
    ):
        if said is not None and abs((said - halfway + 180) % 360 - 180) > _HALFWAY_DEG:
            raise SarsplatError(
                f"{name} has the {what} {said:g}°, but halfway between its transmitter and its receiver is "
                f"{halfway:.5g}°; leave its cell empty, or correct one of them"
            )
    return view


def _lengths(table: Path, picture: ListedPicture, what: str, common: Pair | None, slant: float) -> Pair:
    """Spacing or resolution in the slant plane, m; those of the picture first."""
    own: tuple[float | None, float | None] = getattr(picture, f"{what}_m")
    azimuth, slant_range = (a if b is None else b for a, b in zip(common or (None, None), own, strict=True))
    if azimuth is None or slant_range is None:
        raise SarsplatError(
            f"{table} does not say what the pixel {what} of {picture.name} is; give it with --{what}, or name its "
            f"column with --columns {what}=NAME"
        )
    return azimuth, slant_range * slant
