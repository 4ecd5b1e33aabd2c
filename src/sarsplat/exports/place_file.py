"""Sidecar file `FILE.place.json`: georeference of a file in the scene's coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from sarsplat.data import write_json
from sarsplat.data.files import open_file, plain_os_errors, read_versioned_json
from sarsplat.data.header import PlaceHeader
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    from sarsplat.exports.format import Coordinates
    from sarsplat.geometry import Place

_SCHEMA = "sarsplat-place"
_SCHEMA_VERSION = 1
_HEAD = 100  # bytes within which the schema is named
_ABOUT = (
    "Coordinates of the file are metres from the place, x towards the compass bearing x_towards_deg, y to the left of "
    "x, z up (a .glb file's root node turns z to y); (x, y, z, 1), multiplied by ecef_from_scene from the left, is the "
    "geocentric position, m, if height_m is above the ellipsoid."
)
_MAKE_ONE = (
    "import SICDs or CPHD, or a terrain with a coordinate system (--terrain), or tell the dataset in Python with "
    "replace(dataset, place=sarsplat.Place(LATITUDE, LONGITUDE, HEIGHT)), and reconstruct that; of a file of Gaussians "
    "that was exported, keep FILE.place.json beside it"
)


class _PlaceFile(msgspec.Struct, frozen=True):
    """Content of the file."""

    place: PlaceHeader


def refuse_elsewhere(path: Path, coordinates: Coordinates, name: str, place: Place | None, crs: str | None) -> None:
    """Raise for a map's system if the file has other coordinates, and for map coordinates without georeference."""
    if crs is not None and coordinates != "map":
        what = "longitudes and latitudes" if coordinates == "degrees" else "the scene's own coordinates"
        raise SarsplatError(f"{path} will hold {what}; leave out --crs, or export points to a .las or .laz file")
    if place is None and (crs is not None or coordinates == "degrees"):
        raise SarsplatError(f"{name} has no georeference; {_MAKE_ONE}")


def remove_place(path: Path) -> None:
    """Remove the sidecar of an earlier export; raise if another program wrote it."""
    beside = _beside(path)
    if not beside.exists():
        return
    with open_file(beside) as file:
        if _SCHEMA.encode() not in file.read(_HEAD):
            raise SarsplatError(f"{beside} exists and was not written by an export; choose another name")
    with plain_os_errors("remove", beside):
        beside.unlink()


def write_place(path: Path, place: Place) -> str:
    """Write the sidecar of a file, and return a description of it."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = place.axes.T, place.ecef
    beside = _beside(path)
    header = {"schema": _SCHEMA, "schema_version": _SCHEMA_VERSION, "file": path.name, "about": _ABOUT}
    write_json(beside, {**header, "place": place.as_dict(), "ecef_from_scene": matrix.tolist()})
    return f"{beside}: its georeference"


def read_place(path: Path) -> Place | None:
    """Return the georeference of a file from its sidecar, or None.

    Raises if that cannot be read, or was not written by an export.
    """
    beside = _beside(path)
    if not beside.exists():
        return None
    remedy = "export the file again, or take this one away"
    return read_versioned_json(beside, _PlaceFile, schema=_SCHEMA, version=_SCHEMA_VERSION, remedy=remedy).place.place


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.place.json")
