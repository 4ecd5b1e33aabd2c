"""Sub-apertures of a flight: the pulses of each image, their view and their resolution."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.geometry.responses import Taylor
from sarsplat.importers.phase_history import SPEED_OF_LIGHT, PhaseHistory

_MOST = 0.9  # share of an aperture whose steps determine the unambiguous extent
_GAP = 1.5  # minimum step between pulses that is a gap, in median steps
WIDEST_DEG = 60.0
"""Maximum width of an aperture: beyond it the radar has no single direction."""


@dataclass(frozen=True)
class Aperture:
    """Pulses of one image around a place."""

    history: PhaseHistory
    around_m: Float64[np.ndarray, " 3"]
    """The place, world frame."""
    view: View
    """Direction to the middle of the aperture from there."""
    width_deg: float
    """Azimuths it covers, half a pulse beyond the outer ones included."""

    @property
    def cross(self) -> Float64[np.ndarray, " pulses"]:
        """Direction to the antenna along the image's columns: the sine of the angle from the middle."""
        return self._directions() @ self.view.look.gradients[0]

    @property
    def looks_left(self) -> bool:
        """True if the radar looks to the left of its flight."""
        return bool(self.cross[-1] < self.cross[0])

    @property
    def tilt_deg(self) -> float:
        """Tilt of the slant plane about the line of sight; on level axes, heights are displaced by its tangent."""
        level = replace(self.view, tilt_deg=0.0).look
        across, up, _ = level.frame @ (self._directions()[-1] - self._directions()[0])
        return math.degrees(math.atan2(math.copysign(1, across) * up, abs(across)))

    def tilted(self) -> Self:
        """Return the aperture with the azimuth axis of its image tilted as the slant plane."""
        return replace(self, view=replace(self.view, tilt_deg=self.tilt_deg))

    @property
    def extent(self) -> float:
        """Extent of `cross`, half a pulse beyond the outer ones included."""
        return float(np.ptp(self.cross)) * len(self.history) / (len(self.history) - 1)

    @property
    def unambiguous_m(self) -> float:
        """Extent along the columns beyond which echoes are aliased, by the steps of most of the aperture."""
        steps = np.sort(np.abs(np.diff(self.cross)))
        share = np.cumsum(steps) / steps.sum()
        return SPEED_OF_LIGHT / (2 * self.history.carrier_hz * float(steps[np.searchsorted(share, _MOST)]))

    @property
    def missing(self) -> float:
        """Share of its extent without pulses: steps much larger than the median."""
        steps = np.abs(np.diff(self.cross))
        usual = float(np.median(steps))
        return float((steps - usual)[steps > _GAP * usual].sum() / steps.sum())

    def resolution_m(self, weighting: Taylor) -> tuple[float, float]:
        """Return the 3 dB width of the power response (azimuth, slant range), m."""
        factor = weighting.width * SPEED_OF_LIGHT / 2
        return factor / (self.history.carrier_hz * self.extent), factor / self.history.bandwidth_hz

    def _directions(self) -> Float64[np.ndarray, "pulses 3"]:
        return _unit(self.history.antenna_m - self.around_m)


def apertures(history: PhaseHistory, around_m: Float64[np.ndarray, " 3"], width_deg: float | None) -> list[Aperture]:
    """Divide a flight around a place into apertures of `width_deg` of azimuth, in its order.

    The remainder at both ends is not used. Without a width, parts are equal and make azimuth resolution about that of
    slant range; a shorter flight is one part. Raises if the width is out of range or exceeds the flight, the azimuth
    turns back, or the radar is not above the place.
    """
    directions = _unit(history.antenna_m - around_m)
    azimuth, span = _azimuths(history, directions)
    pulses = len(azimuth)
    if width_deg is None:
        square = math.degrees(history.bandwidth_hz / history.carrier_hz / np.hypot(*directions[:, :2].T).mean())
        count = min(max(1, round(span / square), math.ceil(span / WIDEST_DEG)), pulses // 2)
        width_deg = span / count
    else:
        count = math.floor(min(span / width_deg + 0.02, pulses)) if 0 < width_deg <= WIDEST_DEG else 0  # also of NaN
        if count < 1:
            raise SarsplatError(
                f"an aperture of {width_deg:g}° must be above 0°, at most {WIDEST_DEG:g}°, and within the {span:.3g}° "
                f"of {history.name}; give another `aperture_deg`, or further files of the same flight"
            )
    edges = (np.arange(count + 1) - count / 2) * math.radians(width_deg) + (azimuth[0] + azimuth[-1]) / 2
    sign = np.sign(azimuth[1] - azimuth[0])
    if sign < 0:
        edges = edges[::-1]
    places = np.searchsorted(sign * azimuth, sign * edges)
    parts = []
    for first, last in pairwise(places):
        if last - first < 2:
            raise SarsplatError(
                f"{history.name}: an aperture of {width_deg:.3g}° holds {last - first} of {pulses} pulses; give a "
                "larger `aperture_deg`"
            )
        ends = azimuth[first], azimuth[last - 1]
        parts.append(_aperture(history.part(slice(first, last)), around_m, ends, width_deg))
    return parts


def whole_flight(history: PhaseHistory, around_m: Float64[np.ndarray, " 3"]) -> Aperture:
    """Return all pulses as one aperture of any width; raise as `apertures` does."""
    azimuth, span = _azimuths(history, _unit(history.antenna_m - around_m))
    return _aperture(history, around_m, (azimuth[0], azimuth[-1]), span)


def _azimuths(
    history: PhaseHistory, directions: Float64[np.ndarray, "pulses 3"]
) -> tuple[Float64[np.ndarray, " pulses"], float]:
    """Return the azimuths of all pulses, rad, without jumps, and their span, degrees, half a pulse beyond the ends."""
    azimuth = np.unwrap(np.arctan2(-directions[:, 1], directions[:, 0]))
    step = np.diff(azimuth)
    turned = np.flatnonzero(step * step[0] <= 0)
    if len(turned):
        raise SarsplatError(
            f"{history.name}: the azimuth turns back after pulse {turned[0]}; give pulses of one pass, in its order"
        )
    return azimuth, math.degrees(abs(azimuth[-1] - azimuth[0])) * len(azimuth) / (len(azimuth) - 1)


def _aperture(
    history: PhaseHistory, around_m: Float64[np.ndarray, " 3"], ends: tuple[float, float], width_deg: float
) -> Aperture:
    """Return the aperture of all pulses between azimuths `ends`, rad."""
    middle = _unit(_unit(history.antenna_m - around_m).sum(axis=0, keepdims=True))[0]
    azimuth_deg = math.degrees((ends[0] + ends[1]) / 2) % 360
    if middle[2] <= 0:
        raise SarsplatError(f"{history.name}: the antenna is not above `around_m`; give heights in metres")
    return Aperture(history, around_m, View(azimuth_deg, View.towards(middle).grazing_deg), width_deg)


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(np.float64).tiny)
