"""Resampling of geocoded pictures, which lie on a map, to azimuth and slant range.

Geocoding takes, for each point of the map, the value of the image at the azimuth and slant range of the ground there.
That is undone point by point: with the same heights, layover and shadow are again where the radar had them.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import distance_transform_edt, map_coordinates, minimum_filter, spline_filter

from sarsplat.data.geotiff import INEXACT_M, NOT_RELATED, Georeference, exactness_m, far_outside
from sarsplat.data.terrain_file import holes_of
from sarsplat.errors import SarsplatError, SarsplatWarning, counted
from sarsplat.geometry import ImageGrid, Place, Terrain
from sarsplat.importers.measured_image import MeasuredImage

_FEWEST = 8  # minimum number of pixels on a side of the result
_BENT = 0.1  # maximum curvature of a map between the middle and the corners of the pictures, share of a pixel

_SPLINE = 3

_WGS_84 = 4326  # EPSG number of longitude and latitude

Lattice = Float64[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class MapPicture:
    """One geocoded picture."""

    image: MeasuredImage
    """Power on the map, with the spacing of columns and rows there, and the resolution before geocoding."""
    unknown: Bool[np.ndarray, "rows columns"]
    """Pixels that were not measured."""
    to_ground: Float64[np.ndarray, "2 3"]
    """(x, y) in the scene of the pixel in a column and a row, m: `to_ground @ (column, row, 1)`."""

    @property
    def half_m(self) -> float:
        """Minimum distance from the origin to its edges along rows and columns, m."""
        inverse = np.linalg.inv(self.to_ground[:, :2])
        column, row = -inverse @ self.to_ground[:, 2]  # of the origin
        wide, high = np.hypot(*self.to_ground[:, :2])
        rows, columns = self.image.pixels.shape
        return float(min(column * wide, (columns - 1 - column) * wide, row * high, (rows - 1 - row) * high))

    def measured_m(self, directions: Float64[np.ndarray, "2 2"]) -> float:
        """Return the half side, m, of the square along both directions that no unmeasured edge reaches.

        Holes within the picture do not count.
        """
        down, along = np.nonzero(self.unknown & ~holes_of(self.unknown))
        places = directions @ self.to_ground @ np.stack([along, down, np.ones(len(down))])
        pixel = float(np.hypot(*np.hypot(*self.to_ground[:, :2])))  # as far as it is interpolated to
        return float(abs(places).max(axis=0).min(initial=math.inf)) - pixel


def on_ground(
    shapes: Sequence[tuple[int, int]], georeferences: Sequence[Georeference], x_towards_deg: float, names: Sequence[str]
) -> tuple[list[Float64[np.ndarray, "2 3"]], Place | None]:
    """Return `MapPicture.to_ground` of pictures around the middle of their common part, and the place of that origin.

    `shapes` are their rows and columns; the scene's x axis points to a compass bearing. The place is None if their
    system has no EPSG number. Raises if they lie in several systems, or have no common part.
    """
    first = georeferences[0]
    for other, name in zip(georeferences, names, strict=True):
        if other.crs != first.crs:
            raise SarsplatError(
                f"{names[0]} lies in {first.system} and {name} in {other.system}; bring all into one, as by "
                "gdalwarp -t_srs"
            )
    if first.geographic:  # the same longitudes may be 360° apart, as beside the date line
        turns = [round((first.affine[0, 2] - one.affine[0, 2]) / 360.0) for one in georeferences]
        georeferences = [
            replace(one, affine=one.affine + np.array([[0.0, 0.0, 360.0 * turn], [0.0, 0.0, 0.0]]))
            for one, turn in zip(georeferences, turns, strict=True)
        ]
    corners = [_corners(shape, one) for shape, one in zip(shapes, georeferences, strict=True)]
    low = np.max([place.min(axis=1) for place in corners], axis=0)
    high = np.min([place.max(axis=1) for place in corners], axis=0)
    if (low >= high).any():
        raise SarsplatError("the pictures have no place on the map in common; give pictures of one spot")
    middle = (low + high) / 2
    if first.epsg is None and not first.geographic:  # neither scale nor convergence are known
        bearing, place = math.radians(x_towards_deg), None
        turn = np.array([[math.sin(bearing), math.cos(bearing)], [-math.cos(bearing), math.sin(bearing)]])
        axes = turn if first.crs is None else first.crs.axis_info[0].unit_conversion_factor * turn
    else:
        finest = min(min(one.pitch) for one in georeferences)
        axes, place = _axes_on_earth(first, middle, (high - low) / 2, finest, x_towards_deg, names[0])
    centred = [one.affine - np.array([[0.0, 0.0, middle[0]], [0.0, 0.0, middle[1]]]) for one in georeferences]
    return [axes @ one for one in centred], place


def _axes_on_earth(
    georeference: Georeference,
    middle: Float64[np.ndarray, " 2"],
    half: Float64[np.ndarray, " 2"],
    pitch: float,
    x_towards_deg: float,
    name: str,
) -> tuple[Float64[np.ndarray, "2 2"], Place]:
    """Return (x, y) of the scene, m, for each unit of a map around its `middle`, and the place of that.

    Raises if the map is bent by `_BENT` of its `pitch` within `half`, or a grid of its datum is missing.
    """
    steps = np.array([[0, 1, -1, 0, 0, 1, 1, -1, -1], [0, 0, 0, 1, -1, 1, -1, 1, -1]]) * half[:, None]
    degrees = _geodetic(georeference, middle[:, None] + steps, name)
    if not np.isfinite(degrees).all() or np.abs(degrees[1]).max() > 90 or np.abs(degrees[0]).max() > 360:
        raise SarsplatError(
            f"{name} lies at {middle[0]:g}, {middle[1]:g} in {georeference.system}, which is nowhere; correct its tags"
        )
    place = Place(float(degrees[1, 0]), float(degrees[0, 0]), 0.0, x_towards_deg, "unknown")
    if georeference.epsg not in (None, _WGS_84) and (outside := far_outside(georeference.crs, place)) is not None:
        warnings.warn(f"{name} lies in {georeference.system}, {outside}", SarsplatWarning, stacklevel=4)
    x, y, _ = place.from_geodetic(np.stack([degrees[1], degrees[0], np.zeros(degrees.shape[1])], axis=-1)).T
    places = np.stack([x, y])
    pole = place.from_geodetic(np.array([math.copysign(90.0, place.latitude_deg), 0.0, 0.0]))
    if math.hypot(*pole[:2]) < np.hypot(*places).max():
        raise SarsplatError(
            f"{name} lies around a pole, where there is no north from which azimuths are counted; cut the pictures so "
            "that they do not show it"
        )
    axes = np.stack([places[:, 1] - places[:, 2], places[:, 3] - places[:, 4]], axis=1) / (2 * half)
    bent = float(np.abs(places - axes @ steps).max())
    if bent > _BENT * pitch * float(np.hypot(*axes).min()):
        raise SarsplatError(
            f"{name} lies in {georeference.system}, which is bent by {bent:.2g} m within the pictures; cut them, or "
            "bring them into metres, as by gdalwarp -t_srs EPSG:326xx (the UTM zone)"
        )
    return axes, place


def _geodetic(georeference: Georeference, places: Float64[np.ndarray, "2 n"], name: str) -> Float64[np.ndarray, "2 n"]:
    """Convert points of a map to longitude and latitude, degrees, WGS 84."""
    if georeference.epsg in (None, _WGS_84):
        if not math.isclose(georeference.crs.axis_info[0].unit_conversion_factor, math.pi / 180):
            raise SarsplatError(f"{name} lies in {georeference.system}, not in degrees; use gdalwarp -t_srs EPSG:4326")
        return places
    from pyproj import Transformer

    across = Transformer.from_crs(georeference.crs, _WGS_84, always_xy=True)
    found = np.stack(across.transform(*places))
    if (exact_m := exactness_m(across)) is None:
        raise SarsplatError(f"{name} lies in {georeference.system}; {NOT_RELATED}")
    if exact_m > INEXACT_M:
        text = f"{name} lies in {georeference.system}, from where WGS 84 is reached to {exact_m:g} m"
        warnings.warn(text, SarsplatWarning, stacklevel=4)
    return found


def _corners(shape: tuple[int, int], georeference: Georeference) -> Float64[np.ndarray, "2 4"]:
    """Return the middles of a picture's corner pixels on the map."""
    rows, columns = shape
    places = np.array([[0, columns - 1, 0, columns - 1], [0, 0, rows - 1, rows - 1], [1, 1, 1, 1]], np.float64)
    return np.asarray(georeference.affine @ places)


def resampled(pictures: Sequence[MapPicture], ground: float | Terrain) -> list[MeasuredImage]:
    """Resample pictures to azimuth and slant range, all on the largest grid that all of them cover.

    `ground` is the one that their producer projected from: level at a height, m above the scene's z = 0, or terrain.
    Raises if too little is left, a pixel that is used was not measured, or terrain is under a tilted look.
    """
    grid = _grid(pictures, ground)
    return [_image(picture, grid, ground) for picture in pictures]


def _grid(pictures: Sequence[MapPicture], ground: float | Terrain) -> ImageGrid:
    """Return the grid that all pictures cover, with the finest spacing of their maps."""
    half_azimuth, half_range, slants = [], [], []
    for picture in pictures:
        frame = picture.image.view.look.gradients
        if isinstance(ground, Terrain) and not picture.image.view.look.level:
            raise SarsplatError(
                f"{picture.image.name} is tilted and geocoded on terrain, which is not supported; give the original"
            )
        x_axis = picture.to_ground[:, 0] / np.hypot(*picture.to_ground[:, 0])
        turned = abs(float(x_axis @ frame[0, :2])) / float(np.hypot(*frame[0, :2]))
        reach = picture.half_m / (turned + math.sqrt(max(1 - turned**2, 0.0)))  # half a square that is turned
        slant = float(np.hypot(*frame[1, :2]))
        if picture.unknown.any():
            reach = min(reach, picture.measured_m(frame[:, :2] / np.hypot(*frame[:, :2].T)[:, None]))
        half_azimuth.append(reach)
        half_range.append(reach * slant - _highest(ground, picture.half_m) * abs(float(frame[1, 2])))
        slants.append(slant)
    pitch = min(min(picture.image.spacing_m) for picture in pictures)
    spacing = (pitch, pitch * min(slants))
    columns, rows = (
        2 * math.floor(min(half) / step) + 1 for half, step in zip((half_azimuth, half_range), spacing, strict=True)
    )
    if min(columns, rows) < _FEWEST:
        raise SarsplatError(
            f"{max(columns, 0)} × {max(rows, 0)} pixels (azimuth × range) remain that all geocoded pictures show "
            "around their common middle, turned as the radar looks; give larger ones"
        )
    return ImageGrid(rows, columns, spacing, pictures[0].image.resolution_m)


def _highest(ground: float | Terrain, half_m: float) -> float:
    """Return the largest |z| of the ground within `half_m` of the origin, m."""
    if not isinstance(ground, Terrain):
        return abs(ground)
    reach = np.linspace(-half_m, half_m, 257)
    return float(np.abs(ground.height_m(*np.meshgrid(reach, reach))).max())


def _image(picture: MapPicture, grid: ImageGrid, ground: float | Terrain) -> MeasuredImage:
    places = _places(picture, grid, ground)
    inverse = np.linalg.inv(picture.to_ground[:, :2])
    column, row = np.tensordot(inverse, places - picture.to_ground[:, 2][:, None, None], 1)
    missing = map_coordinates(picture.unknown.astype(np.float32), [row, column], order=1, mode="nearest") > 0
    if missing.any():
        (first, last), (left, right) = (
            (int(at.min()) + 1, int(at.max()) + 1) for at in (row[missing], column[missing])
        )
        raise SarsplatError(
            f"{picture.image.name} has {counted(int(missing.sum()), 'pixel')} of {missing.size} in azimuth and range "
            f"that were not measured, near rows {first} to {last} and columns {left} to {right}; cut the pictures to "
            "their common part, or fill them in, as by gdal_fillnodata"
        )
    known = picture.image.pixels.astype(np.float64)
    if picture.unknown.any():  # a spline rings beside a sudden end
        known = known[tuple(distance_transform_edt(picture.unknown, return_distances=False, return_indices=True))]
    smooth = map_coordinates(
        spline_filter(known, _SPLINE, mode="mirror"), [row, column], order=_SPLINE, mode="mirror", prefilter=False
    )
    least = map_coordinates(minimum_filter(known, 3), [row, column], order=0, mode="nearest")
    # a spline undershoots beside what is bright
    power = np.maximum(smooth, least).astype(np.float32)
    return replace(picture.image, pixels=power, spacing_m=grid.spacing_m)


def _places(picture: MapPicture, grid: ImageGrid, ground: float | Terrain) -> Float64[np.ndarray, "2 m n"]:
    """Return (x, y) of the ground in each pixel; where it lays over, of the nearest point."""
    frame = picture.image.view.look.gradients
    azimuth, slant = np.meshgrid(grid.azimuth_m, grid.range_m)
    if not isinstance(ground, Terrain):
        shown = np.stack([azimuth, slant]) - frame[:, 2][:, None, None] * ground
        return np.tensordot(np.linalg.inv(frame[:, :2]), shown, 1)
    across, away = np.linalg.inv(frame[:, :2]).T  # for each metre of azimuth, and of slant range on level ground
    reach = grid.range_m[-1] + _highest(ground, picture.half_m) * abs(float(frame[1, 2]))
    ahead = np.arange(-reach, reach + grid.spacing_m[1], grid.spacing_m[1] / 2)
    x, y = across[:, None, None] * grid.azimuth_m + away[:, None, None] * ahead[:, None]
    seen = ahead[:, None] + frame[1, 2] * ground.height_m(x, y)  # slant range, which falls where the ground lays over
    seen = np.maximum.accumulate(seen, axis=0)
    found = np.stack([np.interp(grid.range_m, seen[:, k], ahead) for k in range(grid.columns)], axis=1)
    return across[:, None, None] * azimuth + away[:, None, None] * found
