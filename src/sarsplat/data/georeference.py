"""Where the pixels of a GeoTIFF lie on a map: its tags, of which none is trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from sarsplat.data.foreign_tiff import KEYS, PIXEL_SCALE, TIEPOINT, TRANSFORMATION, PageTags
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import Place

MODEL, RASTER, LENGTH = 1024, 1025, 3076
_GEOGRAPHIC_CODE, _PROJECTED_CODE = 2048, 3072
_PROJECTED, GEOGRAPHIC, AREA, POINT, DEFINED_ELSEWHERE, METRE = 1, 2, 1, 2, 32767, 9001
"""Keys, and what they may be."""
_METRES: dict[int | None, float] = {METRE: 1.0, 9002: 0.3048, 9003: 1200 / 3937}
"""Of EPSG's units of length: metre, foot, US survey foot."""
_ANGLE = 2054
_DEGREE = math.pi / 180
_RADIANS: dict[int | None, float] = {
    9101: 1.0,
    9102: _DEGREE,
    9103: _DEGREE / 60,
    9104: _DEGREE / 3600,
    9105: 0.9 * _DEGREE,
    9122: _DEGREE,
}
"""Of its units of angle: radian, degree, minute, second, grad."""

_SMALLEST, _LARGEST, _FLATTEST = 1e-12, 1e12, 1e-3
"""In a map's units; the last is a sine."""

MapKind = Literal["projected", "geographic"]


@dataclass(frozen=True)
class Georeference:
    """How pixels become places on a map.

    Parameters
    ----------
    affine : numpy.ndarray, float64 [2, 3]
        (x, y) of the middle of the pixel in a column and a row: `affine @ (column, row, 1)`, in the map's unit.
    kind : {"projected", "geographic"} or None
        The map's system: lengths, or degrees of longitude and latitude; None if the file names none, so that its
        pixels need not lie on a map at all.
    epsg : int or None
        Its number in EPSG's list, if it has one.
    unit_m : float or None
        Length of the map's unit, m, by the file alone, of degrees meaningless; None if it is none of the usual
        ones.
    stated : float or None
        What the file itself says of the unit: length, m, or angle, rad; None if it says nothing, as files with a number
        need not, or nothing that is known.
    """

    affine: Float64[np.ndarray, "2 3"]
    kind: MapKind | None
    epsg: int | None
    unit_m: float | None
    stated: float | None = None

    @property
    def on_map(self) -> bool:
        """Whether the file says that its pixels lie on a map: what is in the geometry of a radar does not."""
        return self.kind is not None

    @property
    def pitch(self) -> tuple[float, float]:
        """Distance of columns and of rows, in the map's unit."""
        (a, b, _), (d, e, _) = self.affine
        return math.hypot(a, d), math.hypot(b, e)

    @property
    def pixel(self) -> str:
        """Size of a pixel, columns × rows, with its unit; of degrees also in metres, at the latitude of the first."""
        across, along = self.pitch
        if self.kind != "geographic":
            unit = "" if self.kind is None else " m" if self.unit_m == 1 else " of the map's unit"
            return f"{across:.5g}{unit} × {along:.5g}{unit}"
        degrees = math.degrees(_DEGREE if self.stated is None else self.stated)
        said = f"{across * degrees:.5g}° × {along * degrees:.5g}°"
        longitude, latitude = degrees * self.affine[:, 2]
        if not (abs(latitude) < 90 and abs(longitude) <= 360):
            return said
        corner = Place(latitude, longitude, 0.0)
        steps = np.array([[latitude + degrees * d, longitude + degrees * a, 0.0] for a, d in self.affine[:, :2].T])
        x_m, y_m = np.linalg.norm(corner.from_geodetic(steps), axis=1)
        return f"{said}, {x_m:.4g} m × {y_m:.4g} m at latitude {latitude:.4g}°"

    @property
    def system(self) -> str:
        """What to call the map's system."""
        if self.epsg is not None:
            return f"EPSG:{self.epsg}"
        return "no system" if self.kind is None else f"a {self.kind} system without a number"


def georeference_of(tags: PageTags, name: str) -> Georeference | None:
    """Where pixels lie by the tags of a TIFF's page (code → value); None if they do not say it.

    Tie points alone, as of images in the geometry of a radar, are no map. Refused if the tags make no sense; `name` is
    what to call the file.
    """
    try:
        affine = _affine(tags)
        keys = keys_of(tags)
    except (TypeError, ValueError, OverflowError, IndexError) as error:
        raise SarsplatError(
            f"{name} has GeoTIFF tags that cannot be read ({shown(str(error))}); write them again"
        ) from error
    if affine is None:
        return None
    if not _sizes_pixels(affine):
        raise SarsplatError(f"{name} has GeoTIFF tags by which its pixels have no size; write them again")
    kinds: dict[int | None, MapKind] = {_PROJECTED: "projected", GEOGRAPHIC: "geographic"}
    kind = kinds.get(keys.get(MODEL))
    code = keys.get(_PROJECTED_CODE if kind == "projected" else _GEOGRAPHIC_CODE)
    number = code if kind and code is not None and 1024 <= code < DEFINED_ELSEWHERE else None
    if keys.get(RASTER) != POINT:  # places are those of corners
        affine[:, 2] += affine[:, :2] @ (0.5, 0.5)
    stated = _RADIANS.get(keys.get(_ANGLE)) if kind == "geographic" else _METRES.get(keys.get(LENGTH))
    return Georeference(affine, kind, number, _METRES.get(keys.get(LENGTH, METRE)), stated)


def _sizes_pixels(affine: Float64[np.ndarray, "2 3"]) -> bool:
    """Whether pixels have a size that numbers can be made of, and columns do not run as rows do."""
    if not np.isfinite(affine).all() or not np.abs(affine[:, :2]).max() < _LARGEST:
        return False
    (a, b, _), (d, e, _) = affine
    pitches = math.hypot(a, d), math.hypot(b, e)
    return min(pitches) > _SMALLEST and abs(a * e - b * d) > _FLATTEST * pitches[0] * pitches[1]


def _affine(tags: PageTags) -> Float64[np.ndarray, "2 3"] | None:
    """(x, y) of raster coordinates (column, row)."""
    if TRANSFORMATION in tags:
        matrix = np.asarray(tags[TRANSFORMATION], np.float64).reshape(4, 4)
        return matrix[np.ix_([0, 1], [0, 1, 3])]
    if PIXEL_SCALE not in tags:
        return None
    scale = np.asarray(tags[PIXEL_SCALE], np.float64)
    column, row, _, x, y, _ = np.asarray(tags.get(TIEPOINT, (0.0,) * 6), np.float64)[:6]
    return np.array([[scale[0], 0.0, x - column * scale[0]], [0.0, -scale[1], y + row * scale[1]]])


def keys_of(tags: PageTags, place: int = 0) -> dict[int, int]:
    """GeoKeys whose values are in the directory itself, or in another tag: then their places there."""
    numbers = [int(number) for number in tags.get(KEYS, ())]
    return {key: value for key, where, _, value in zip(*(numbers[4 + k :: 4] for k in range(4))) if where == place}
