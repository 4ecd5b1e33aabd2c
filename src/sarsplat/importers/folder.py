"""Import pictures of any origin: a folder of PNG, JPEG, TIFF, NPY or MATLAB files, and a table of their angles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from jaxtyping import Float64

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import Dataset
from sarsplat.data.geotiff import Georeference
from sarsplat.data.image import power_of
from sarsplat.errors import SarsplatError
from sarsplat.geometry import Place, Terrain
from sarsplat.importers.about import AboutPictures, Pair
from sarsplat.importers.geocoded import MapPicture, on_ground, resampled
from sarsplat.importers.listed_images import (
    Picture,
    assumptions_of_table,
    check_spacing,
    in_range,
    read_pictures,
    spacing_of_tags,
    write_pictures,
)
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.table import PictureTable, read_picture_table
from sarsplat.names import Backscatter, Projection, Quantity

_EAST_DEG = -90.0  # azimuth offset of compass bearings with which x points east and y north, as in rasters of heights


@checks_arguments
def import_folder(
    folder: str | Path,
    out: str | Path,
    *,
    quantity: Quantity | None = None,
    scale: float | None = None,
    offset: float | None = None,
    backscatter: Backscatter = "beta0",
    geocoded: Projection | None = None,
    geocoded_height_m: float = 0.0,
    overwrite: bool = False,
    **about: Unpack[AboutPictures],
) -> Dataset:
    """Import pictures (PNG, JPEG, TIFF, GeoTIFF, NPY, MATLAB) with a table (CSV) of angles.

    Pictures with an empty azimuth are kept aside, for `sarsplat locate`; on maps and in stacks they are left out.

    Parameters
    ----------
    folder : Path
        Folder of the pictures.
    out : Path
        Dataset folder to write.
    quantity : {"amplitude", "power", "db", "complex"}, optional
        Quantity that scale · pixel + offset is; without it, complex numbers are complex amplitude, whole numbers
        amplitude, and others as a column dn-per-magnitude or dn-per-power says.
    scale : float, optional
        Factor on the pixels, e.g. 60/255 of decibels in 8 bits: 1, or the file's own. If given, scale, offset
        and factors of the files do not count.
    offset : float, optional
        Added to the pixels after that; likewise.
    backscatter : {"beta0", "sigma0", "gamma0"}
        Normalisation of the power: σ⁰ and γ⁰ become β⁰ by the factor of level ground.
    geocoded : {"level", "terrain"}, optional
        The pictures lie on a map (geocoded, north up), onto which their producer projected them from level ground, or
        from the terrain that is given. They are resampled to azimuth and slant range; azimuths of the table are then
        compass bearings of the radar, and the origin is the middle of the part that all pictures show.
    geocoded_height_m : float
        Height of that level ground, m above the ground of the scene.
    overwrite : bool
        Replace an existing dataset.
    **about
        Table, lengths, angles, orientation, looks, ground, terrain and the target's box: see `AboutPictures`.

    Raises
    ------
    SarsplatError
        If the table or a picture is missing, damaged or incomplete, several classes are shown, a path leads out of the
        folder, a number is out of range, or the output exists.

    Warns
    -----
    SarsplatWarning
        Once each, for rows without a picture, pictures without a row, and as `dataset_of` does.
    """
    folder = Path(folder)
    listed = read_picture_table(folder, about, compass=geocoded is not None)
    seen = [picture.view for picture in listed.pictures if picture.view is not None]
    if listed.columns.keys() & {"baseline", "polarisation"} and len(set(seen)) < len(seen):
        raise SarsplatError(
            f"{listed.path} has several rows for one view, channels of a stack; import them with `sarsplat import "
            "stack`, or give each view another name"
        )
    if geocoded and about.get("azimuth_offset_deg") is None:
        about["azimuth_offset_deg"] = _EAST_DEG
    pictures, assumptions = read_pictures(listed, about, quantity, scale, offset, backscatter)
    if geocoded_height_m and geocoded != "level":
        raise SarsplatError("`geocoded_height_m` is for `geocoded='level'`; give that too, or leave it out")
    place, layout = None, {"geocoded": geocoded}
    if geocoded:
        near = about.get("near") or next((picture.row.near for picture in pictures), None)
        for name, given in (("near", near is not None), ("mirrored", about.get("mirrored"))):
            if given:
                raise SarsplatError(f"`{name}` is for pictures in range and azimuth; leave it out, or `geocoded`")
        ground = geocoded_height_m if geocoded == "level" else about.get("terrain")
        if ground is None:
            raise SarsplatError("`geocoded='terrain'` needs the heights that its producer took; give them as `terrain`")
        images, place = _from_map(listed, pictures, ground, about.get("azimuth_offset_deg") or 0.0, assumptions)
    else:
        images, layout = in_range(listed, pictures, about, assumptions)
    source: dict[str, Any] = {
        "quantity": pictures[-1].values.quantity,
        "scale": scale,
        "offset": offset,
        **layout,
        "assumptions": [*assumptions, *assumptions_of_table(listed, about, backscatter)],
    }
    return write_pictures(out, folder, listed, images, about, source, kind="folder", place=place, overwrite=overwrite)


def _from_map(
    listed: PictureTable,
    pictures: Sequence[Picture],
    ground: float | Terrain,
    azimuth_offset_deg: float,
    told: list[str],
) -> tuple[list[MeasuredImage], Place | None]:
    """Resample geocoded pictures to azimuth and slant range; also return the place of the origin, if known.

    Assumptions are added to `told`. Raises if only some pictures have tags, tags contradict the stated spacing, or no
    resolution is stated.
    """
    for picture in pictures:
        if not picture.resolved:
            remedy = (
                "which a map's pixels do not tell: give 3 dB widths, after multilooking, as `resolution_m`, with "
                "`ground_range=True` if it is along the ground"
            )
            listed.refuse_unstated("resolution", picture.row, remedy)
    names = [str(picture.row.path) for picture in pictures]
    tags = [_on_map(picture) for picture in pictures]
    placed = [georeference for georeference in tags if georeference is not None]
    if placed and len(placed) < len(pictures):
        raise SarsplatError(
            f"{names[tags.index(None)]} has no GeoTIFF tags, and others say where they lie; give all or none of them"
        )
    shapes = [(picture.values.image.shape[0], picture.values.image.shape[1]) for picture in pictures]
    if placed:
        affines, place = on_ground(shapes, placed, -azimuth_offset_deg, names)
        told.append(_told_of_map(placed[0]))
        for picture, affine in zip(pictures, affines, strict=True):
            check_spacing(picture.row.name, _pitch(affine), picture.row.spacing_m, "east × north")
    else:
        place = None
        affines = [
            _around_middle(listed, picture, shape, azimuth_offset_deg)
            for picture, shape in zip(pictures, shapes, strict=True)
        ]
        told.append("north is at the top of the geocoded pictures, and their middles are one place")
    if any(picture.values.image.dtype.kind == "c" for picture in pictures):
        told.append("of complex pictures the power is taken, for geocoding leaves no phase that is of use")
    on_map = [
        MapPicture(
            MeasuredImage(
                picture.row.name,
                power_of(picture.values.image),
                picture.view,
                _pitch(affine),
                picture.lengths(listed, "resolution", picture.row.resolution_m, picture.slant),
                azimuth_std_deg=picture.row.azimuth_std_deg or 0.0,
                split=picture.row.split,
            ),
            picture.values.unknown,
            affine,
        )
        for picture, affine in zip(pictures, affines, strict=True)
    ]
    around = False
    if place is not None and isinstance(ground, Terrain) and ground.place is not None:
        ground, around = ground.around(place, 2 * max(picture.half_m for picture in on_map)).centred(), True
    told.append(_told_of_ground(ground, around))
    return resampled(on_map, ground), place


def _pitch(to_ground: Float64[np.ndarray, "2 3"]) -> Pair:
    """Return the spacing of columns and of rows on the map, m."""
    columns, rows = np.hypot(*to_ground[:, :2])
    return float(columns), float(rows)


def _on_map(picture: Picture) -> Georeference | None:
    georeference = picture.values.tags.georeference
    return georeference if georeference is not None and georeference.crs is not None else None


def _around_middle(
    listed: PictureTable, picture: Picture, shape: tuple[int, int], azimuth_offset_deg: float
) -> Float64[np.ndarray, "2 3"]:
    """Return `MapPicture.to_ground` of a picture without tags: its middle is at the origin, its top north."""
    stated = picture.row.spacing_m
    if (tags := picture.values.tags.georeference) is not None:  # of no map, but with the distance of pixels
        stated = spacing_of_tags(str(picture.row.path), tags, "top", stated)
    east, north = picture.lengths(listed, "spacing", stated, 1.0)
    columns, rows = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    system = Georeference(np.array([[east, 0, -east * columns], [0, -north, north * rows]]))
    return on_ground([shape], [system], -azimuth_offset_deg, [str(picture.row.path)])[0][0]


def _told_of_map(system: Georeference) -> str:
    known = system.epsg is not None or system.geographic
    north = "true north" if known else "the north of the map, whose lengths are taken for true ones"
    taken = ", taken for WGS 84" if system.geographic and system.epsg is None else ""
    return (
        f"the pictures lie on a map in {system.system}{taken}; the scene's origin is the middle of their common "
        f"part, and azimuths are counted from {north}"
    )


def _told_of_ground(ground: float | Terrain, around: bool) -> str:
    """Return a sentence on the producer's ground; `around` if the map places the terrain."""
    if isinstance(ground, Terrain):
        middle = "which lies where the map says" if around else "whose middle is the scene's origin"
        return (
            f"their producer projected them from the terrain, {middle}, and so they are brought back to azimuth and "
            "slant range"
        )
    level = "level ground" if not ground else f"a level plane {ground:g} m above the ground"
    return f"their producer projected them from {level}, and so they are brought back to azimuth and slant range"
