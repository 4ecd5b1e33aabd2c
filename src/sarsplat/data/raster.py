"""Rasters for a GIS: a GeoTIFF of one band of numbers or classes over a map."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Float64, Shaped

from sarsplat.data.files import write_bytes

_PIXEL_SCALE, _TIEPOINT, _NO_DATA = 33550, 33922, 42113
_KEYS, _DOUBLES, _TEXTS = 34735, 34736, 34737
_TILE = (256, 256)


@dataclass(frozen=True)
class RasterSystem:
    """What a GeoTIFF says of its coordinates: values of its tags of keys, doubles and texts."""

    keys: tuple[int, ...]
    doubles: tuple[float, ...] = ()
    texts: str = ""

    @classmethod
    def epsg(cls, code: int) -> RasterSystem:
        """A projected system in metres of the EPSG registry."""
        return cls((1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, code))

    @classmethod
    def local(cls) -> RasterSystem:
        """The scene's own axes, x to the right and y upwards, in metres."""
        return cls((1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32767, 3076, 0, 1, 9001))


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
    level : str
        What heights are above, in words; empty if the values are none, or it is the scene's z = 0.
    """

    values: Shaped[np.ndarray, "rows columns"]
    corner_m: tuple[float, float]
    pitch_m: tuple[float, float]
    system: RasterSystem
    level: str = ""

    @property
    def centres(self) -> tuple[Float64[np.ndarray, "rows columns"], Float64[np.ndarray, "rows columns"]]:
        """X and y of the middle of each pixel, m."""
        (rows, columns), (left, top), (dx, dy) = self.values.shape, self.corner_m, self.pitch_m
        x, y = np.meshgrid(left + (np.arange(columns) + 0.5) * dx, top - (np.arange(rows) + 0.5) * dy)
        return x, y


def write_raster(
    path: Path, raster: Raster, description: str, *, colours: Mapping[int, tuple[int, int, int]] | None = None
) -> None:
    """Write a raster as a tiled, compressed GeoTIFF, whole or not at all.

    Parameters
    ----------
    path : Path
        File to write.
    raster : Raster
        What is in it. Floats become float32, with NaN as "no data"; of classes "no data" is 255.
    description : str
        What the numbers are, with their unit (ASCII; the ImageDescription tag).
    colours : mapping of int to (red, green, blue), optional
        Colours of classes, 0 to 255, in which programs show them.
    """
    values, system = raster.values, raster.system
    tags: list[Any] = [
        (_PIXEL_SCALE, "d", 3, (*raster.pitch_m, 0.0), True),
        (_TIEPOINT, "d", 6, (0.0, 0.0, 0.0, *raster.corner_m, 0.0), True),
        (_KEYS, "H", len(system.keys), system.keys, True),
    ]
    if system.doubles:
        tags.append((_DOUBLES, "d", len(system.doubles), system.doubles, True))
    if system.texts:
        tags.append((_TEXTS, "s", 0, system.texts, True))
    shown: dict[str, Any] = {"photometric": "minisblack"}
    if colours is None:
        values = values.astype(np.float32)
        tags.append((_NO_DATA, "s", 0, "nan", True))
    else:
        table = np.zeros((3, 256), np.uint16)
        for value, colour in colours.items():
            table[:, value] = np.array(colour) * 257
        shown = {"photometric": "palette", "colormap": table}
        tags.append((_NO_DATA, "s", 0, "255", True))
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
