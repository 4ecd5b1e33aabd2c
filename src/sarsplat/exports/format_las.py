"""`.las`: points as LAS 1.4, for programs that know laser scans."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from sarsplat.data import new_file
from sarsplat.data.geotiff import LEVELS
from sarsplat.errors import SarsplatError
from sarsplat.exports.format import Format, Points
from sarsplat.extras import install_command
from sarsplat.radiometry import LEAST_POWER, shade

_DARKEST_DB = -30.0  # relative to the brightest point: intensity 0, as black in a mesh
_FINEST_M = 1e-4  # minimum step of coordinates, which are integers
_LARGEST = 2**31 - 1
_TEXT_AREA = 3  # record identifier of LAS for text
_AT_A_TIME = 1 << 18
_FRAME = (
    'LOCAL_CS["target frame: x nose, y left, z up",LOCAL_DATUM["target",0],UNIT["metre",1],'
    'AXIS["x",OTHER],AXIS["y",OTHER],AXIS["z",UP]]'
)
_DESCRIBED = {"nx": "unit normal", "ny": "unit normal", "nz": "unit normal", "gamma0": "gamma0, linear"}


def write_las(points: Points, path: Path, *, compressed: bool = False) -> None:
    """Write a LAS or LAZ file of points: coordinates, intensity by γ⁰ in decibels, normals and γ⁰ as extra dimensions.

    Coordinates and normals are those of the points' map, if they have one. Points are written in chunks.
    """
    try:
        import laspy

        if compressed:
            import lazrs  # noqa: F401 (laspy's means of compression)
    except ImportError as error:
        raise SarsplatError(
            f"{'.laz' if compressed else '.las'} files need {error.name}, which is not installed; "
            f"{install_command('las')}"
        ) from error
    header = laspy.LasHeader(point_format=6, version="1.4")
    places, origin, frame = points.positions, np.zeros(3), _FRAME
    if (system := points.system) is not None:  # large numbers: steps count from the corner of the points
        places, frame = system.to_map(points.positions), system.wkt
        origin = np.floor(places.min(axis=0))
        points = replace(points, normals=system.turned(points.normals).astype(np.float32))
    reach = max(float((places - origin).max()), float((origin - places).max()), _FINEST_M)
    step = max(_FINEST_M, 10.0 ** math.ceil(math.log10(reach / _LARGEST)))
    header.scales, header.offsets = np.full(3, step), origin
    header.generating_software = header.system_identifier = "sarsplat"
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(frame))
    if system is not None:  # the system names the height datum only if it has one
        level = f"heights above {LEVELS[system.place.height_above]}"
        header.vlrs.append(laspy.VLR("LASF_Spec", _TEXT_AREA, "what heights are above", level.encode() + b"\0"))
    columns = points.columns()
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name=name, type=np.float32, description=_DESCRIBED[name]) for name in columns]
    )
    brightest = None if points.gamma0 is None else max(float(points.gamma0.max()), LEAST_POWER)
    with (
        new_file(path) as file,
        laspy.open(file, mode="w", header=header, do_compress=compressed, closefd=False) as writer,
    ):
        for first in range(0, len(points.positions), _AT_A_TIME):
            part = slice(first, first + _AT_A_TIME)
            chunk = places[part].astype(np.float64)
            record = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
            record.x, record.y, record.z = chunk.T
            for name, column in columns.items():
                record[name] = column[part]
            if points.gamma0 is not None and brightest is not None:
                grey = shade(points.gamma0[part], brightest, -_DARKEST_DB)
                record.intensity = np.round(65535 * grey).astype(np.uint16)
            writer.write_points(record)


FORMAT = Format(
    writers={"points": lambda points, path, _: write_las(points, path)},
    opened_with={"points": "CloudCompare, QGIS or any viewer of laser scans"},
    recognises=lambda head, _: head.startswith(b"LASF"),
    coordinates="map",
)
