"""Layover (several places of a map share a pixel) and shadow (a place is hidden), from heights alone."""

import math

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from scipy.ndimage import distance_transform_edt, map_coordinates

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.memory import required
from sarsplat.progress import stage

FREE, SHADOW, LAYOVER, BOTH, UNKNOWN = 0, 1, 2, 3, 255
"""Classes, as in the mask layer of OPERA's radiometrically terrain-corrected products."""

LEGEND = {FREE: "neither", SHADOW: "shadow", LAYOVER: "layover", BOTH: "layover and shadow", UNKNOWN: "height unknown"}

_STEP = 0.5  # spacing of sampled places, pixels of the map
_AT_A_TIME = 1 << 22  # places in a batch
_MOST_PLACES, _MOST_LINES = 1 << 33, 1 << 24  # maximum number of places (a byte each), and of lines across the map
_PIXEL, _PLACE = 40, 130  # memory per pixel of the map, and per place in a batch, bytes
_SMALLER = "cut it in parts, or make its pixels larger"
_ALONG_AN_EDGE = 1e-9
"""Step of a line towards an edge, relative to half the map's side, below which the line is parallel to the edge."""


@checks_arguments
def layover_shadow(
    heights_m: Float[np.ndarray, "rows columns"], pitch_m: tuple[float, float], view: View
) -> UInt8[np.ndarray, "rows columns"]:
    """Classes of the places of a map for one view: uint8, 0 neither, 1 shadow, 2 layover, 3 both, 255 unknown.

    A place is in shadow if a nearer one reaches above its line of sight, and in layover if another place has the same
    azimuth and slant range: a slope that faces the radar, and the places that it shares pixels with.

    Heights are z, m; columns along +x and rows along −y, as on maps, `pitch_m` apart along x and y. NaN is unknown;
    such places hide nothing and cause no layover. Raise if the view is tilted or from below, or the map is too large.
    """
    if view.tilt_deg or view.grazing_deg <= 0:
        raise SarsplatError(
            f"layover and shadow on a map need a level view from above, which {view} is not; give another"
        )
    rows, columns = heights_m.shape
    step, ahead = _STEP * min(pitch_m), view.look.ahead
    axes = np.array([[-ahead[1], ahead[0]], ahead])  # across the lines (azimuth), and along them, away from the radar
    half = np.array([(columns - 1) / 2 * pitch_m[0], (rows - 1) / 2 * pitch_m[1]])
    lines, most = (2 * math.ceil(float(reach) / step) + 1 for reach in abs(axes) @ half)
    steps = axes / (half + np.array(pitch_m) / 2) * step
    if lines > _MOST_LINES or lines * (spans := _on_map(np.arange(lines) - lines // 2, most, steps))[1] > _MOST_PLACES:
        raise SarsplatError(
            f"a map of {rows} × {columns} places {pitch_m[0]:g} m × {pitch_m[1]:g} m apart is too large for layover "
            f"and shadow; {_SMALLER} and square"
        )
    starts, places = spans
    required(
        f"layover and shadow on {rows} × {columns} places",
        _PIXEL * rows * columns + lines * places + _PLACE * min(lines * places, max(_AT_A_TIME, places)),
        _SMALLER,
    )
    known = np.isfinite(heights_m)
    if not known.any():
        return np.full((rows, columns), UNKNOWN, np.uint8)
    filled = _filled(heights_m.astype(np.float64), known)
    found = np.empty((lines, places), np.uint8)
    count = max(1, _AT_A_TIME // places)
    with stage("layover and shadow", lines) as shown:
        for first in range(0, lines, count):
            batch = np.arange(first, min(first + count, lines))
            along = (starts[batch, None] + np.arange(places)) * step
            x, y = ((batch - lines // 2) * step)[:, None] * axes[0][:, None, None] + along * axes[1][:, None, None]
            pixel = np.stack([(half[1] - y) / pitch_m[1], (x + half[0]) / pitch_m[0]])
            z = map_coordinates(filled, pixel, order=1, mode="nearest")
            inside = ((pixel > -0.5) & (pixel < np.array([rows, columns])[:, None, None] - 0.5)).all(axis=0)
            nearest = np.clip(np.rint(pixel).astype(np.int64), 0, np.array([rows, columns])[:, None, None] - 1)
            z[~(inside & known[tuple(nearest)])] = np.nan
            found[batch] = _along_lines(z, along, view)
            shown.advance(len(batch))
    classes = np.empty((rows, columns), np.uint8)
    x = np.arange(columns) * pitch_m[0] - half[0]
    for row in range(rows):
        y = half[1] - row * pitch_m[1]
        line, place = (np.rint((axis[0] * x + axis[1] * y) / step).astype(np.int64) for axis in axes)
        classes[row] = found[line + lines // 2, place - starts[line + lines // 2]]
    classes[~known] = UNKNOWN
    return classes


def _on_map(
    lines: Int64[np.ndarray, " lines"], most: int, axes: Float64[np.ndarray, "2 2"]
) -> tuple[Int64[np.ndarray, " lines"], int]:
    """First place of each line (of `most`, around 0) that may be on the map, and the maximum number of places from it.

    Only these are sampled: on a long and narrow map, full lines would be its length squared. `axes` are the steps
    across and along lines, in halves of the map's sides.
    """
    first, last = np.full(len(lines), float(-(most // 2))), np.full(len(lines), float(most // 2))
    for across, along in axes.T:  # |line · across + place · along| ≤ 1
        if abs(along) > _ALONG_AN_EDGE:  # otherwise the line is parallel to these edges
            ends = (np.array([[-1.0], [1.0]]) - lines * across) / along
            first, last = np.maximum(first, ends.min(axis=0) - 1), np.minimum(last, ends.max(axis=0) + 1)  # rounded
    first = np.floor(first)
    count = max(1, int((np.ceil(last) - first).max()) + 1)
    return np.minimum(first, most // 2 + 1 - count).astype(np.int64), count


def _filled(
    heights: Float64[np.ndarray, "rows columns"], known: Bool[np.ndarray, "rows columns"]
) -> Float64[np.ndarray, "rows columns"]:
    """Fill unknown heights with the nearest known one, so that interpolation makes no slope at their edge."""
    if known.all():
        return heights
    return heights[tuple(distance_transform_edt(~known, return_distances=False, return_indices=True))]


def _along_lines(
    z: Float64[np.ndarray, "lines places"], ground_range: Float64[np.ndarray, "lines places"], view: View
) -> UInt8[np.ndarray, "lines places"]:
    """Classes along lines away from the radar."""
    elevation, slant_range = view.look.in_section(ground_range, z)
    known = np.isfinite(z)
    before = np.maximum.accumulate(np.where(known, elevation, -np.inf), axis=1)
    shadow = elevation < before
    nearer = np.maximum.accumulate(np.where(known, slant_range, -np.inf), axis=1)
    farther = np.minimum.accumulate(np.where(known, slant_range, np.inf)[:, ::-1], axis=1)[:, ::-1]
    layover = (slant_range < nearer) | (slant_range > farther)
    return np.where(known, SHADOW * shadow + LAYOVER * layover, UNKNOWN).astype(np.uint8)
