"""Where a radar sees several places of a map in one pixel (layover), or none (shadow), from heights alone."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from scipy.ndimage import distance_transform_edt, map_coordinates

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
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
_MOST_PLACES = 1 << 33
"""As many bytes."""


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
        From where: level, monostatic.

    Returns
    -------
    numpy.ndarray, uint8 [rows, columns]
        0 neither, 1 shadow, 2 layover, 3 both, 255 unknown.

    Raises
    ------
    SarsplatError
        If the view is tilted, bistatic or from below, or the map is too large.
    """
    if view.tilt_deg or view.look.bistatic or view.grazing_deg <= 0:
        raise SarsplatError(
            f"layover and shadow on a map need a level, monostatic view from above, which {view} is not; give another"
        )
    rows, columns = heights_m.shape
    step, ahead = _STEP * min(pitch_m), view.look.ahead
    axes = np.array([[-ahead[1], ahead[0]], ahead])  # along a line of azimuths, and away from the radar along each
    half = np.array([(columns - 1) / 2 * pitch_m[0], (rows - 1) / 2 * pitch_m[1]])  # from the middle, rows along -y
    lines, places = (2 * math.ceil(float(reach) / step) + 1 for reach in abs(axes) @ half)
    if lines * places > _MOST_PLACES:
        raise SarsplatError(
            f"a map of {rows} × {columns} places {pitch_m[0]:g} m × {pitch_m[1]:g} m apart is too large for layover "
            "and shadow; cut it in parts, or make its pixels larger and square"
        )
    known = np.isfinite(heights_m)
    if not known.any():
        return np.full((rows, columns), UNKNOWN, np.uint8)
    held = _with_known(heights_m.astype(np.float64), known)
    along = (np.arange(places) - places // 2) * step
    found = np.empty((lines, places), np.uint8)
    each = max(1, _AT_A_TIME // places)
    with stage("layover and shadow", lines) as shown:
        for first in range(0, lines, each):
            some = np.arange(first, min(first + each, lines))
            x, y = np.moveaxis(((some - lines // 2) * step)[:, None, None] * axes[0] + along[:, None] * axes[1], -1, 0)
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
        classes[row] = found[line + lines // 2, place + places // 2]
    classes[~known] = UNKNOWN
    return classes


def _with_known(
    heights: Float64[np.ndarray, "rows columns"], known: Bool[np.ndarray, "rows columns"]
) -> Float64[np.ndarray, "rows columns"]:
    """Unknown heights are as the nearest that is known: between it and them there is no slope that no one saw."""
    if known.all():
        return heights
    return heights[tuple(distance_transform_edt(~known, return_distances=False, return_indices=True))]


def _along_lines(
    z: Float64[np.ndarray, "lines places"], ground_range: Float64[np.ndarray, " places"], view: View
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
