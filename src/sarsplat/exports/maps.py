"""Maps of a run: the height and the γ⁰ of its surface from above, and where a view has layover and shadow."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Bool, Float64

from sarsplat.data.geotiff import Raster
from sarsplat.data.terrain_file import read_heights
from sarsplat.errors import SarsplatError
from sarsplat.exports.format import name_of
from sarsplat.exports.georeference import MapSystem
from sarsplat.geometry import Terrain, View
from sarsplat.memory import free_bytes, required
from sarsplat.names import Map
from sarsplat.radar.layover_shadow import LAYOVER, SHADOW, UNKNOWN, layover_shadow
from sarsplat.runs import Run
from sarsplat.surface.from_above import ground_seen, uppermost, without_holes
from sarsplat.surface.neighbours import spacing_m

_PIXEL, _POINT = 60, 200
"""Peak memory per pixel of heights or γ⁰, and per point, bytes."""
_ON_GROUND = 200  # peak memory per pixel of possible ground, bytes
_CLASSED, _CLASSING = 80, 600e6
"""Peak memory per pixel of layover and shadow, and at any size, bytes."""
_CHUNK = 1 << 20  # pixels per chunk
_LARGER = 1.2  # factor on the suggested pixel above the smallest that fits

_APART = 5.0
"""Maximum distance of points across a hole that is filled, in median distances: one random point in ten million is
farther from all others."""


@dataclass(frozen=True)
class Coordinates:
    """Transformation between scene and map: by a georeferenced system, or, without one, the scene's axes."""

    system: MapSystem | None = None

    def of(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return map coordinates x, y and height, m, of points of the scene."""
        return points if self.system is None else self.system.to_map(points)

    def back(self, places: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Return x and y in the scene, m, of places near its ground on the map."""
        if self.system is None:
            return places
        level = np.full(len(places), self.system.place.height_m)
        return self.system.to_scene(np.column_stack([places, level]))[:, :2]

    @cached_property
    def metres(self) -> tuple[float, float]:
        """Metres on the ground per metre of the map along its x and y."""
        if self.system is None:
            return 1.0, 1.0
        x, y = np.linalg.norm(np.linalg.inv(self.system.gradients[:2, :2]), axis=0)
        return float(x), float(y)

    def view(self, view: View) -> View:
        """Return the view with its azimuth in the axes of the map."""
        ahead = self.of(np.array([[0.0, 0.0, 0.0], [*view.look.ahead, 0.0]]))
        x, y = (ahead[1] - ahead[0])[:2] * self.metres
        return replace(view, azimuth_deg=math.degrees(math.atan2(y, -x)))

    def bearing_deg(self, view: View) -> float:
        """Return the direction of the radar on the map, degrees clockwise from its top."""
        return (self.view(view).azimuth_deg + 90) % 360


def require_fit(path: Path, holds: str, pixel_m: float | None, view: View | None) -> None:
    """Raise for a pixel size without a map, and for a view that is missing or has no effect."""
    if holds not in get_args(Map):
        if pixel_m is not None or view is not None:
            raise SarsplatError(f"{path} will hold {holds}, which has no pixels and no direction; export a .tif map")
        return
    if pixel_m is not None and not 0 < pixel_m < math.inf:
        raise SarsplatError(f"a pixel of {pixel_m:g} m is not possible; give a positive number of metres")
    if holds == "layover-shadow" and view is None:
        raise SarsplatError(
            f"{path} will hold layover and shadow, which depend on where the radar is; give one direction, such as "
            "--azimuth 30 --grazing 35"
        )
    if holds != "layover-shadow" and view is not None:
        raise SarsplatError(f"{path} will hold {holds}, which does not depend on the direction; remove the angles")


def map_of(
    run: Run, what: str, coordinates: Coordinates, pixel_m: float | None, view: View | None
) -> tuple[Raster, str]:
    """Return a map of a run ("dsm", "gamma0" or "layover-shadow"), and its description.

    Heights and γ⁰ are those of its points and of learned ground: means over the uppermost surface in a pixel, float32,
    NaN where no view saw anything. Raises if the run has no points or no γ⁰, pixels are too many, or finer than the
    spacing of points, and for layover and shadow of a target aloft.
    """
    if what == "layover-shadow":
        assert view is not None  # `require_fit`
        raster, seen = _layover_shadow(run, view, coordinates, pixel_m)
        pixel_m2 = math.prod(raster.pitch_m) * math.prod(coordinates.metres)
        said = _classes_in_words(raster, seen, "what views saw", pixel_m2, coordinates.bearing_deg(view))
        said += f"; {_unseen_ground(run)}"
    else:
        raster = _uppermost(run, coordinates, pixel_m, brightness=what == "gamma0")
        named = "γ⁰, linear" if what == "gamma0" else "heights"
        said = f"{named}; {np.isfinite(raster.values).mean():.0%} of the map were seen, the rest has no data"
    where = "metres, in the target's own frame" if coordinates.system is None else str(coordinates.system)
    rows, columns = raster.values.shape
    return raster, f"{rows} × {columns} pixels of {raster.pitch_m[0]:g} m: {said}; {where}"


def of_terrain(path: Path, view: View) -> tuple[Raster, str]:
    """Return a map of layover and shadow on a GeoTIFF's terrain, in its coordinates, and its description.

    +x of the view is the direction of the file's columns. Raises if the file cannot be read.
    """
    found = read_heights(path)
    heights, (x_m, y_m) = found.raster, found.metres
    pitch = heights.pitch_m[0] * x_m, heights.pitch_m[1] * y_m
    raster = replace(heights, values=layover_shadow(heights.values, pitch, view))
    rows, columns = raster.values.shape
    pixel_m2 = pitch[0] * pitch[1]
    said = _classes_in_words(
        raster, raster.values != UNKNOWN, "known heights", pixel_m2, Coordinates().bearing_deg(view)
    )
    return raster, f"{rows} × {columns} pixels: {said}; coordinates as in {path}"


def _classes_in_words(
    raster: Raster, measured: Bool[np.ndarray, "rows columns"], named: str, pixel_m2: float, bearing_deg: float
) -> str:
    """Return a sentence about shares and areas of layover and shadow, and the direction of the radar.

    Shares are relative to the measured pixels, not to the map, whose margin is arbitrary.
    """
    if not measured.any():
        return "no height is known"
    shares, areas = [], []
    for bit, name in ((LAYOVER, "layover"), (SHADOW, "shadow")):
        found = (raster.values & bit > 0) & (raster.values != UNKNOWN)
        shares.append(f"{name} on {found[measured].mean():.1%}")
        areas.append(f"{np.count_nonzero(found) * pixel_m2:.4g} m²")
    return (
        f"{' and '.join(shares)} of {named} ({' and '.join(areas)} of the whole map), seen by a radar in the direction "
        f"{bearing_deg:.0f}° (clockwise from the top of the map)"
    )


def _uppermost(run: Run, coordinates: Coordinates, pixel_m: float | None, *, brightness: bool = False) -> Raster:
    """Return heights or γ⁰ of the run's surface, and of learned ground, from above."""
    points, cell, system = np.asarray(run.points, np.float64), run.grid.cell_m, coordinates.system
    if not len(points):
        raise SarsplatError(f"{name_of(run)} has no points of a surface yet; train it longer, or look at its report")
    pixel, apart = cell if pixel_m is None else pixel_m, spacing_m(points)
    least = min(coordinates.metres)
    if not pixel * least >= apart:
        raise SarsplatError(
            f"pixels of {pixel:g} m are finer than the points of the surface are apart ({apart / least:.2g} m); give "
            f"`pixel_m={float(f'{max(cell, 2 * apart) / least:.2g}'):g}` or more"
        )
    gamma0 = run.points_gamma0 if brightness else np.zeros(len(points))
    if gamma0 is None:
        raise SarsplatError(f"{name_of(run)} was made by {run.method}, which learns no γ⁰; export its heights (dsm)")
    parts = [(coordinates.of(points), run.normals[:, 2], gamma0), *_ground(run, pixel, coordinates)]
    places, upward, gamma0 = (np.concatenate(column) for column in zip(*parts, strict=True))
    first, last = np.floor(places[:, :2].min(axis=0) / pixel), np.floor(places[:, :2].max(axis=0) / pixel)
    columns, rows = _counted(last - first + 1, pixel, _PIXEL, _POINT * len(places))
    at = np.stack([last[1] - np.floor(places[:, 1] / pixel), np.floor(places[:, 0] / pixel) - first[0]], axis=1)
    shown = uppermost(at.astype(np.int64), (rows, columns), places[:, 2], upward, gamma0 if brightness else None, cell)
    values = without_holes(shown, max(cell, _APART * apart) / (pixel * least)).astype(np.float32)
    corner = float(first[0] * pixel), float((last[1] + 1) * pixel)
    crs, above = (None, None) if system is None else (system.crs, system.place.height_above)
    return Raster(values, corner, (pixel, pixel), crs, above)


def _layover_shadow(
    run: Run, view: View, coordinates: Coordinates, pixel_m: float | None
) -> tuple[Raster, Bool[np.ndarray, "rows columns"]]:
    """Return classes on the surface and its ground (the run's terrain, or z = 0), and a mask of seen pixels."""
    if view.aloft or any(one.aloft for one in run.snapshot.views):
        raise SarsplatError(
            f"{name_of(run)} shows a target aloft, without ground: no map shows its layover and shadow; export its mesh"
        )
    seen = _uppermost(run, coordinates, pixel_m)
    lift = seen.values - _ground_heights(run, seen, coordinates)
    # as far as shadows fall, or slopes lie over what is before them
    reach_m = max(0.0, float(np.nanmax(lift))) * max(view.look.slope, 1 / view.look.slope)
    pitch = seen.pitch_m[0] * coordinates.metres[0], seen.pitch_m[1] * coordinates.metres[1]
    margin = reach_m / min(pitch) + 2
    _counted(np.array(seen.values.shape) + 2 * margin, seen.pitch_m[0], _CLASSED, _CLASSING)
    wide = _padded(seen, int(margin))
    unseen = np.isnan(wide.values)
    heights = np.where(unseen, _ground_heights(run, wide, coordinates), wide.values)
    return replace(wide, values=layover_shadow(heights, pitch, coordinates.view(view))), ~unseen


def _ground(
    run: Run, pixel: float, coordinates: Coordinates
) -> Iterator[tuple[Float64[np.ndarray, "g 3"], Float64[np.ndarray, " g"], Float64[np.ndarray, " g"]]]:
    """Yield learned ground that a view saw: places on the map, one a pixel, upward parts of normals, and γ⁰."""
    model, grid, views = run.model, run.grid, run.snapshot.views
    if model is None or (ground := model.ground()) is None:
        return
    half = grid.columns * grid.spacing_m[0] / 2, grid.rows * grid.spacing_m[1] / 2
    reach = max(view.look.corner_m(*half) for view in views)
    corners = coordinates.of(np.array([[x * reach, y * reach, 0.0] for x in (-1, 1) for y in (-1, 1)]))
    first, last = np.floor(corners[:, :2].min(axis=0) / pixel), np.floor(corners[:, :2].max(axis=0) / pixel)
    counts = _counted(last - first + 1, pixel, _ON_GROUND)
    x, y = ((low + np.arange(count) + 0.5) * pixel for low, count in zip(first, counts, strict=True))
    around = coordinates.back(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    around = np.column_stack([around, _ground_z(run, around)])
    target = model.target(model.degree(run.iteration)).detach()
    around = around[ground_seen(target, around, views, grid)]
    table = ground.gamma0.detach().double().cpu().numpy() * model.unit
    if table.ndim:
        table = Terrain(table, (ground.pitch_m, ground.pitch_m)).height_m(around[:, 0], around[:, 1])
    if ground.exponent is not None:
        table = table * np.mean([view.look.sine ** float(ground.exponent.detach()) for view in views])
    yield coordinates.of(around), np.ones(len(around)), np.broadcast_to(table, len(around))


def _ground_z(run: Run, places: Float64[np.ndarray, "p 2"]) -> Float64[np.ndarray, " p"]:
    """Return heights z of the ground at places (x, y) of the scene, m."""
    terrain = None if run.model is None else run.model.frame.terrain
    return np.zeros(len(places)) if terrain is None else terrain.height_m(places[:, 0], places[:, 1])


def _ground_heights(run: Run, raster: Raster, coordinates: Coordinates) -> Float64[np.ndarray, "rows columns"]:
    """Return heights of the ground in the pixels of a map, in the map's coordinates, m."""
    x, y = raster.centres
    heights, count = np.empty(raster.values.shape), max(1, _CHUNK // raster.values.shape[1])
    for first in range(0, len(heights), count):
        rows = slice(first, first + count)
        places = coordinates.back(np.stack([x[rows], y[rows]], axis=-1).reshape(-1, 2))
        above = coordinates.of(np.column_stack([places, _ground_z(run, places)]))[:, 2]
        heights[rows] = above.reshape(x[rows].shape)
    return heights


def _padded(raster: Raster, margin: int) -> Raster:
    """Return the map with a margin of pixels without data."""
    values = np.pad(raster.values, margin, constant_values=np.nan)
    (left, top), (dx, dy) = raster.corner_m, raster.pitch_m
    return replace(raster, values=values, corner_m=(left - margin * dx, top + margin * dy))


def _counted(
    counts: Float64[np.ndarray, " 2"], pixel: float, each_bytes: float, more_bytes: float = 0.0
) -> tuple[int, int]:
    """Return the numbers of pixels along two sides; raise if they exceed the memory."""
    one, other = map(int, counts)
    needed = each_bytes * one * other + more_bytes
    larger = _LARGER * pixel * math.sqrt(max(1.0, needed / max(free_bytes(), 1.0)))
    work = f"a map of {one} × {other} pixels of {pixel:g} m"
    required(work, needed, f"give a larger `pixel_m`, such as {larger:.2g}")
    return one, other


def _unseen_ground(run: Run) -> str:
    """Return a sentence about the ground assumed where nothing was seen."""
    if run.model is not None and run.model.frame.terrain is not None:
        return "pixels that no view saw count as its terrain"
    lowest = float(run.points[:, 2].min())
    return (
        f"pixels that no view saw count as level ground at z = 0 (the lowest point of the surface is at {lowest:.3f} m)"
    )
