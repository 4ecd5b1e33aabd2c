"""Rasters for a GIS: a GeoTIFF of one band of numbers or classes over a map."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import tifffile
from jaxtyping import Float64, Shaped

from sarsplat.data.files import write_bytes
from sarsplat.data.foreign_tiff import DOUBLES, GDAL_METADATA, KEYS, NO_DATA, PIXEL_SCALE, TEXTS, TIEPOINT
from sarsplat.data.georeference import AREA
from sarsplat.geometry.place import HeightAbove

_TILE = (256, 256)

HEIGHTS_ABOVE = "HEIGHTS_ABOVE"
"""Item of GDAL's metadata that says what heights are measured from. A vertical system among the GeoKeys would say it,
too, but with one GDAL no longer finds the number of the horizontal system, by which maps are laid over each other."""
LEVELS: dict[HeightAbove, str] = {
    "ellipsoid": "the WGS 84 ellipsoid",
    "sea level": "sea level",
    "unknown": "an unknown level",
}
"""What it says."""


@dataclass(frozen=True)
class RasterSystem:
    """What a GeoTIFF says of its coordinates: values of its tags of keys, doubles and texts, and what heights mean."""

    keys: tuple[int, ...]
    doubles: tuple[float, ...] = ()
    texts: str = ""
    height_above: HeightAbove | None = None
    """None: the file says nothing, or heights are z of the scene."""

    @classmethod
    def epsg(cls, code: int, height_above: HeightAbove | None = None) -> RasterSystem:
        """A projected system in metres of the EPSG registry."""
        return cls((1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, code), height_above=height_above)

    @classmethod
    def local(cls, pixels: int = AREA) -> RasterSystem:
        """The scene's own axes, x to the right and y upwards, in metres; pixels are areas or points."""
        return cls((1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, pixels, 3072, 0, 1, 32767, 3076, 0, 1, 9001))


@dataclass(frozen=True, eq=False)
class Raster:
    """Numbers or classes over a map.

    Parameters
    ----------
    values : numpy.ndarray, float or uint8 [rows, columns]
        Row 0 has the largest y (north); NaN of floats means unknown.
    corner_m : (float, float)
        Least x and largest y of the map: the outer corner of its first pixel.
    pitch_m : (float, float)
        Size of a pixel along x and y.
    system : RasterSystem
        What x and y are.
    """

    values: Shaped[np.ndarray, "rows columns"]
    corner_m: tuple[float, float]
    pitch_m: tuple[float, float]
    system: RasterSystem

    @property
    def centres(self) -> tuple[Float64[np.ndarray, "rows columns"], Float64[np.ndarray, "rows columns"]]:
        """X and y of the middle of each pixel, m."""
        (rows, columns), (left, top), (dx, dy) = self.values.shape, self.corner_m, self.pitch_m
        x, y = np.meshgrid(left + (np.arange(columns) + 0.5) * dx, top - (np.arange(rows) + 0.5) * dy)
        return x, y


def write_raster(
    path: Path,
    raster: Raster,
    description: str,
    *,
    unit: str = "",
    colours: Mapping[int, tuple[int, int, int]] | None = None,
) -> None:
    """Write a raster as a tiled, compressed GeoTIFF, whole or not at all.

    Parameters
    ----------
    path : Path
        File to write.
    raster : Raster
        What is in it. Floats become float32, with NaN as "no data"; of classes "no data" is 255.
    description : str
        What the numbers are, with their unit (ASCII; the ImageDescription tag, and the name of the band).
    unit : str, optional
        Of the band, for programs; none unless given.
    colours : mapping of int to (red, green, blue), optional
        Colours of classes, 0 to 255, in which programs show them.
    """
    values, system = raster.values, raster.system
    tags: list[Any] = [
        (PIXEL_SCALE, "d", 3, (*raster.pitch_m, 0.0), True),
        (TIEPOINT, "d", 6, (0.0, 0.0, 0.0, *raster.corner_m, 0.0), True),
        (KEYS, "H", len(system.keys), system.keys, True),
    ]
    if system.doubles:
        tags.append((DOUBLES, "d", len(system.doubles), system.doubles, True))
    if system.texts:
        tags.append((TEXTS, "s", 0, system.texts, True))
    tags.append((GDAL_METADATA, "s", 0, _metadata(description, unit, system.height_above), True))
    shown: dict[str, Any] = {"photometric": "minisblack"}
    if colours is None:
        values = values.astype(np.float32)
        tags.append((NO_DATA, "s", 0, "nan", True))
    else:
        table = np.zeros((3, 256), np.uint16)
        for value, colour in colours.items():
            table[:, value] = np.array(colour) * 257
        shown = {"photometric": "palette", "colormap": table}
        tags.append((NO_DATA, "s", 0, "255", True))
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        values,
        metadata=None,
        description=description,
        software="sarsplat",
        tile=_TILE,
        compression="zlib",
        extratags=tags,
        **shown,
    )
    write_bytes(path, buffer.getbuffer())


def _metadata(description: str, unit: str, height_above: HeightAbove | None) -> str:
    """What GDAL, and with it a GIS, shows of a band and of a file."""
    items = [f'<Item name="DESCRIPTION" sample="0" role="description">{escape(description)}</Item>']
    if unit:
        items.append(f'<Item name="UNITTYPE" sample="0" role="unittype">{escape(unit)}</Item>')
    if height_above is not None:
        items.append(f'<Item name="{HEIGHTS_ABOVE}">{LEVELS[height_above]}</Item>')
    return f"<GDALMetadata>{''.join(items)}</GDALMetadata>"
