"""`.geojson`: the outline of the points on the ground, for maps (RFC 7946)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sarsplat.data import write_bytes
from sarsplat.data.files import encode_json
from sarsplat.errors import SarsplatError
from sarsplat.exports.format import Format, Points
from sarsplat.geometry.place import DATUM
from sarsplat.names import Colour

_DIGITS = 8  # decimals of degrees: a millimetre
_BEGINS = b'{\n  "type": "FeatureCollection"'
_MIN_M2 = 1e-6  # minimum area of the outline, m²


def _write(points: Points, path: Path, _: Colour) -> None:
    place = points.place
    assert place is not None  # `export` rejects others
    outline, area_m2 = _hull(points.positions[:, :2].astype(np.float64), path)
    level = float(np.median(points.positions[:, 2]))
    corners = place.to_geodetic(np.column_stack([outline, np.full(len(outline), level)]))
    heights = place.to_geodetic(points.positions)[:, 2]
    rings = rings_of(corners[:, 1::-1], path)
    shape = ("Polygon", [rings[0]]) if len(rings) == 1 else ("MultiPolygon", [[ring] for ring in rings])
    about = {
        "what": "convex outline of the reconstructed points",
        "points": len(points.positions),
        "area_m2": round(area_m2, 2),
        "lowest_m": round(float(heights.min()), 3),
        "highest_m": round(float(heights.max()), 3),
        "heights_above": place.height_above,
        "datum": DATUM,
    }
    feature = {"type": "Feature", "properties": about, "geometry": dict(zip(("type", "coordinates"), shape))}
    write_bytes(path, encode_json({"type": "FeatureCollection", "features": [feature]}, path))


def _hull(places: Float64[np.ndarray, "p 2"], path: Path) -> tuple[Float64[np.ndarray, "n 2"], float]:
    """Return the corners of the convex outline, counter-clockwise, and its area, m²."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(places)
    except (QhullError, ValueError):
        hull = None
    if hull is None or hull.volume < _MIN_M2:
        raise SarsplatError(f"the {len(places)} points for {path} cover no area; train the run longer")
    return hull.points[hull.vertices], float(hull.volume)


def rings_of(corners_deg: Float64[np.ndarray, "n 2"], path: Path) -> list[list[list[float]]]:
    """Return closed rings of longitude and latitude, counter-clockwise; two for an outline across 180°.

    Raises if the outline goes around a pole, which no ring in these coordinates does.
    """
    steps = np.remainder(np.diff(corners_deg[:, 0], append=corners_deg[:1, 0]) + 180.0, 360.0) - 180.0
    if abs(steps.sum()) > 180:
        raise SarsplatError(f"the outline for {path} goes around a pole, which GeoJSON cannot show; export a .las file")
    longitudes = corners_deg[0, 0] + np.concatenate([[0.0], np.cumsum(steps)[:-1]])  # without a jump
    unrolled = np.column_stack([longitudes, corners_deg[:, 1]])
    turns = np.unique(np.floor((unrolled[:, 0] + 180.0) / 360.0))
    rings = []
    for turn in turns:
        west = 360.0 * turn - 180.0
        ring = unrolled if len(turns) == 1 else _cut(_cut(unrolled, west, 1.0), west + 360.0, -1.0)
        if len(ring) >= 3:
            closed = np.vstack([ring, ring[:1]]) - [360.0 * turn, 0.0]
            rings.append(np.round(closed, _DIGITS).tolist())
    return rings


def _cut(ring: Float64[np.ndarray, "n 2"], meridian_deg: float, side: float) -> Float64[np.ndarray, "m 2"]:
    """Return the part of a convex ring east (side 1) or west (−1) of a meridian."""
    part = []
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        first, second = (side * (corner[0] - meridian_deg) for corner in (start, end))
        if first >= 0:
            part.append(start)
        if first * second < 0:
            crossing = start + first / (first - second) * (end - start)
            part.append(np.array([meridian_deg, crossing[1]]))
    return np.array(part).reshape(-1, 2)


FORMAT = Format(
    writers={"points": _write},
    opened_with={"points": "QGIS, geojson.io or any web map"},
    recognises=lambda head, _: head.startswith(_BEGINS),
    coordinates="degrees",
)
