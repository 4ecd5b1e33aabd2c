"""Geocoded pictures of a folder: where they lie in the scene, and what is assumed of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sarsplat.data.geotiff import Georeference
from sarsplat.data.image import power_of
from sarsplat.errors import SarsplatError
from sarsplat.geometry import Place, Terrain, View
from sarsplat.importers.geocoded import MapPicture, on_ground, resampled
from sarsplat.importers.measured_image import MeasuredImage
from sarsplat.importers.own_lengths import check_spacing, lengths, spacing_beside
from sarsplat.importers.table import ListedPicture
from sarsplat.importers.values import Values
from sarsplat.names import Projection

EAST_DEG = -90.0
"""Offset of compass bearings by which x points east, and y north, as heights of terrain lie."""


@dataclass(frozen=True)
class Seen:
    """A picture with everything that is said of it, and its view."""

    picture: ListedPicture
    """With what is said of all pictures."""
    values: Values
    view: View
    ground_range: bool
    """Whether lengths in range are along the ground."""

    @property
    def slant(self) -> float:
        """Length in the slant plane for each metre in range that is stated."""
        return self.view.look.slant_range(1.0) if self.ground_range else 1.0

    @property
    def resolved(self) -> bool:
        """Whether something is said of the resolution."""
        return any(self.picture.resolution_m)


def producers_ground(geocoded: Projection, height_m: float, terrain: Terrain | None) -> float | Terrain:
    """What the producer of geocoded pictures took for the ground: level at a height, m, or terrain."""
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
    table: Path, seen: Sequence[Seen], ground: float | Terrain, azimuth_offset_deg: float, told: list[str]
) -> tuple[list[MeasuredImage], Place | None]:
    """Images in azimuth and slant range of geocoded pictures, and where on earth their scene's origin is, if known.

    To `told`, what was assumed is added.

    Refused if some pictures have tags and others have none, these contradict the spacing that is given, or nothing is
    said of the resolution, which the pixels of a map do not tell.
    """
    for one in seen:
        if not one.resolved:
            raise SarsplatError(
                f"{table} does not say what the resolution of {one.picture.name} is, which the pixels of a map do not "
                "tell; give its 3 dB widths with --resolution AZIMUTH RANGE, of multilooked pictures those after it, "
                "and --ground-range if it is along the ground in range"
            )
    names = [str(one.picture.path) for one in seen]
    tags = [_on_map(one) for one in seen]
    placed = [one for one in tags if one is not None]
    if placed and len(placed) < len(seen):
        raise SarsplatError(
            f"{names[tags.index(None)]} has no GeoTIFF tags, and others say where they lie; give all or none of them"
        )
    shapes = [(one.values.image.shape[0], one.values.image.shape[1]) for one in seen]
    if placed:
        affines, place = on_ground(shapes, placed, -azimuth_offset_deg, names)
        told.append(_told_of_map(placed[0]))
        for one, affine in zip(seen, affines, strict=True):
            pitch = np.hypot(*affine[:, :2])
            check_spacing(one.picture.name, (float(pitch[0]), float(pitch[1])), one.picture.spacing_m, "east × north")
    else:
        place = None
        affines = [
            _around_middle(table, one, shape, azimuth_offset_deg) for one, shape in zip(seen, shapes, strict=True)
        ]
        told.append("north is at the top of the geocoded pictures, and their middles are one place")
    if any(one.values.image.dtype.kind == "c" for one in seen):
        told.append("of complex pictures the power is taken, for geocoding leaves no phase that is of use")
    pictures = [
        MapPicture(
            one.picture.name,
            power_of(one.values.image) if one.values.image.dtype.kind == "c" else one.values.image,
            one.values.unknown,
            one.view,
            affine,
            lengths(table, one.picture, "resolution", one.picture.resolution_m, one.slant),
            one.picture.azimuth_std_deg or 0.0,
            one.picture.split,
        )
        for one, affine in zip(seen, affines, strict=True)
    ]
    around = False
    if place is not None and isinstance(ground, Terrain) and ground.place is not None:
        ground, around = ground.around(place, 2 * max(picture.half_m for picture in pictures)).centred(), True
    told.append(_told_of_ground(ground, around))
    return resampled(pictures, ground), place


def _on_map(one: Seen) -> Georeference | None:
    georeference = one.values.tags.georeference
    return georeference if georeference is not None and georeference.crs is not None else None


def _around_middle(
    table: Path, one: Seen, shape: tuple[int, int], azimuth_offset_deg: float
) -> Float64[np.ndarray, "2 3"]:
    """Where a picture without tags lies in the scene, its middle at the origin and north at its top."""
    stated = one.picture.spacing_m
    if (tags := one.values.tags.georeference) is not None:  # of no map, but with the distance of pixels
        stated = spacing_beside(str(one.picture.path), tags, "top", stated)
    east, north = lengths(table, one.picture, "spacing", stated, 1.0)
    columns, rows = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    system = Georeference(np.array([[east, 0, -east * columns], [0, -north, north * rows]]))
    return on_ground([shape], [system], -azimuth_offset_deg, [str(one.picture.path)])[0][0]


def _told_of_map(system: Georeference) -> str:
    known = system.epsg is not None or system.geographic
    north = "true north" if known else "the north of the map, whose lengths are taken for true ones"
    taken = ", taken for WGS 84" if system.geographic and system.epsg is None else ""
    return (
        f"the pictures lie on a map in {system.system}{taken}; the scene's origin is the middle of what all of them "
        f"show, and azimuths are counted from {north}"
    )


def _told_of_ground(ground: float | Terrain, around: bool) -> str:
    """What was taken for the producer's ground; `around`: terrain is where the map says."""
    if isinstance(ground, Terrain):
        middle = "which lies where the map says" if around else "whose middle is the scene's origin"
        return (
            f"their producer projected them from the terrain, {middle}, and so they are brought back to azimuth and "
            "slant range"
        )
    level = "level ground" if not ground else f"a level plane {ground:g} m above the ground"
    return f"their producer projected them from {level}, and so they are brought back to azimuth and slant range"
