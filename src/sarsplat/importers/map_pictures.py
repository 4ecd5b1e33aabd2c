"""Geocoded pictures of a folder, placed in the scene and resampled, and the assumptions made on them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sarsplat.data.geotiff import Georeference
from sarsplat.data.image import power_of
from sarsplat.errors import SarsplatError
from sarsplat.geometry import Place, Terrain
from sarsplat.importers.geocoded import MapPicture, on_ground, resampled
from sarsplat.importers.listed_images import Picture, check_spacing, spacing_of_tags
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.names import Projection

EAST_DEG = -90.0
"""Azimuth offset of compass bearings with which x points east and y north, as in rasters of heights."""


def producers_ground(geocoded: Projection, height_m: float, terrain: Terrain | None) -> float | Terrain:
    """Return the ground that the producer of geocoded pictures projected from: a level height, m, or terrain."""
    if geocoded == "level":
        return height_m
    if height_m:
        raise SarsplatError("--geocoded-height is for level ground, and terrain has its own heights; leave it out")
    if terrain is None:
        raise SarsplatError(
            "--geocoded terrain needs the heights that its producer took; give them with --terrain FILE"
        )
    return terrain


def from_map(
    table: Path, pictures: Sequence[Picture], ground: float | Terrain, azimuth_offset_deg: float, told: list[str]
) -> tuple[list[MeasuredImage], Place | None]:
    """Resample geocoded pictures to azimuth and slant range; also return the place of the origin, if known.

    Assumptions are added to `told`. Raises if only some pictures have tags, tags contradict the stated spacing, or no
    resolution is stated, which the pixels of a map do not determine.
    """
    for picture in pictures:
        if not picture.resolved:
            raise SarsplatError(
                f"{table} does not state the resolution of {picture.row.name}, which the pixels of a map do not "
                "tell; give its 3 dB widths, after multilooking, with --resolution AZIMUTH RANGE, and --ground-range "
                "if it is along the ground in range"
            )
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
            pitch = np.hypot(*affine[:, :2])
            check_spacing(picture.row.name, (float(pitch[0]), float(pitch[1])), picture.row.spacing_m, "east × north")
    else:
        place = None
        affines = [
            _around_middle(table, picture, shape, azimuth_offset_deg)
            for picture, shape in zip(pictures, shapes, strict=True)
        ]
        told.append("north is at the top of the geocoded pictures, and their middles are one place")
    if any(picture.values.image.dtype.kind == "c" for picture in pictures):
        told.append("of complex pictures the power is taken, for geocoding leaves no phase that is of use")
    on_map = [
        MapPicture(
            picture.row.name,
            power_of(picture.values.image) if picture.values.image.dtype.kind == "c" else picture.values.image,
            picture.values.unknown,
            picture.view,
            affine,
            picture.lengths(table, "resolution", picture.row.resolution_m, picture.slant),
            picture.row.azimuth_std_deg or 0.0,
            picture.row.split,
        )
        for picture, affine in zip(pictures, affines, strict=True)
    ]
    around = False
    if place is not None and isinstance(ground, Terrain) and ground.place is not None:
        ground, around = ground.around(place, 2 * max(picture.half_m for picture in on_map)).centred(), True
    told.append(_told_of_ground(ground, around))
    return resampled(on_map, ground), place


def _on_map(picture: Picture) -> Georeference | None:
    georeference = picture.values.tags.georeference
    return georeference if georeference is not None and georeference.crs is not None else None


def _around_middle(
    table: Path, picture: Picture, shape: tuple[int, int], azimuth_offset_deg: float
) -> Float64[np.ndarray, "2 3"]:
    """Return `MapPicture.to_ground` of a picture without tags: its middle is at the origin, its top north."""
    stated = picture.row.spacing_m
    if (tags := picture.values.tags.georeference) is not None:  # of no map, but with the distance of pixels
        stated = spacing_of_tags(str(picture.row.path), tags, "top", stated)
    east, north = picture.lengths(table, "spacing", stated, 1.0)
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
