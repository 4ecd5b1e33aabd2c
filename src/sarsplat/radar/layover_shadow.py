"""Where a radar sees several places of a map in one pixel (layover), or none (shadow), from heights alone."""

from __future__ import annotations

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

LEGEND = {
    FREE: "neither",
    SHADOW: "shadow",
    LAYOVER: "layover",
    BOTH: "layover and shadow",
    UNKNOWN: "height unknown",
}

_STEP = 0.5
"""Distance of the places that are looked at, pixels."""

_AT_A_TIME = 1 << 22
"""Places."""
_MOST_PLACES, _MOST_LINES = 1 << 33, 1 << 24
"""As many bytes; and as many lines across the map."""
_PIXEL, _PLACE = 40, 130
"""Bytes that are needed for each pixel of the map, and for each place that is looked at."""
_SMALLER = "cut it in parts, or make its pixels larger"
_ALONG_AN_EDGE = 1e-9
"""Of half a map's side, by which a line nears it at each step: so near 0 that it never reaches it."""


@checks_arguments
def layover_shadow(
    heights_m: Float[np.ndarray, "rows columns"], pitch_m: tuple[float, float], view: View
) -> UInt8[np.ndarray, "rows columns"]:
    """Classes of the places of a map for one view, by the heights between the radar and them.

    A place is in shadow if what is nearer to the radar reaches above its line of sight, and in layover if another place
    of the same azimuth has its slant range: all that share a range are, the slope that lies over and what it lies on.

    Parameters
    ----------
    heights_m : numpy.ndarray, float [rows, columns]
        Heights z, m, along +x with the columns and along −y with the rows, as maps are; NaN where they are unknown.
        Unknown places hide nothing and lie over nothing.
    pitch_m : (float, float)
        Distance of the places along x and y, m.
    view : View
        From where: level.

    Returns
    -------
    numpy.ndarray, uint8 [rows, columns]
        0 neither, 1 shadow, 2 layover, 3 both, 255 unknown.

    Raises
    ------
    SarsplatError
        If the view is tilted or from below, or the map is too large.
    """
    if view.tilt_deg or view.grazing_deg <= 0:
        raise SarsplatError(
            f"layover and shadow on a map need a level view from above, which {view} is not; give another"
        )
    rows, columns = heights_m.shape
    step, ahead = _STEP * min(pitch_m), view.look.ahead
    axes = np.array([[-ahead[1], ahead[0]], ahead])  # along a line of azimuths, and away from the radar along each
    half = np.array([(columns - 1) / 2 * pitch_m[0], (rows - 1) / 2 * pitch_m[1]])  # from the middle, rows along -y
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
    held = _with_known(heights_m.astype(np.float64), known)
    found = np.empty((lines, places), np.uint8)
    each = max(1, _AT_A_TIME // places)
    with stage("layover and shadow", lines) as shown:
        for first in range(0, lines, each):
            some = np.arange(first, min(first + each, lines))
            along = (starts[some, None] + np.arange(places)) * step
            x, y = ((some - lines // 2) * step)[:, None] * axes[0][:, None, None] + along * axes[1][:, None, None]
            where = np.stack([(half[1] - y) / pitch_m[1], (x + half[0]) / pitch_m[0]])
            z = map_coordinates(held, where, order=1, mode="nearest")
            inside = ((where > -0.5) & (where < np.array([rows, columns])[:, None, None] - 0.5)).all(axis=0)
            nearest = np.clip(np.rint(where).astype(np.int64), 0, np.array([rows, columns])[:, None, None] - 1)
            z[~(inside & known[tuple(nearest)])] = np.nan
            found[some] = _along_lines(z, along, view)
            shown.advance(len(some))
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
    """The first of the `most` places of each line that may be on the map, and of how many from there on any is.

    A long and narrow map has a few of each line, wherever on it these are: all places would be its length squared.
    `axes` are steps across and along lines, in halves of the map's sides.
    """
    first, last = np.full(len(lines), float(-(most // 2))), np.full(len(lines), float(most // 2))
    for across, along in axes.T:  # |line · across + place · along| ≤ 1
        if abs(along) > _ALONG_AN_EDGE:  # or else the line stays between these edges
            ends = (np.array([[-1.0], [1.0]]) - lines * across) / along
            first, last = np.maximum(first, ends.min(axis=0) - 1), np.minimum(last, ends.max(axis=0) + 1)  # rounded
    first = np.floor(first)
    count = max(1, int((np.ceil(last) - first).max()) + 1)
    return np.minimum(first, most // 2 + 1 - count).astype(np.int64), count


def _with_known(
    heights: Float64[np.ndarray, "rows columns"], known: Bool[np.ndarray, "rows columns"]
) -> Float64[np.ndarray, "rows columns"]:
    """Unknown heights are as the nearest that is known: between it and them there is no slope that no one saw."""
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
