"""Phase history: for every pulse, the echo of the scene at every frequency, with the antenna's place.

A flight is cut into sub-apertures: the pulses of each image, their view and their resolution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Complex64, Float64

from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.geometry.responses import Taylor

SPEED_OF_LIGHT = 299_792_458.0
FARTHEST_M = 1e8
_LARGEST = 1e9  # no amplitude comes near it, and its square still fits into float32
_FREQUENCIES_HZ = (1e6, 1e12)
_LONGEST_GAP = 3
"""Longest gap between two pieces of one flight, in steps from pulse to pulse."""
_OTHER_BAND = 0.1  # of the bandwidth: what may differ between passes of one radar
_UNEVEN = 0.01
"""Largest distance of a frequency from its place among evenly spaced ones, in steps. Single precision costs 0.03 %."""

WIDEST_DEG = 60.0
"""Widest aperture: beyond it the radar has no one direction."""


@dataclass(frozen=True)
class PhaseHistory:
    """Pulses of one flight, in its order.

    A scatterer of amplitude A at p contributes A·exp(−4πj f/c·(|antenna − p| − reference)) to a sample. Refused if
    sizes do not fit one another, frequencies are not as required, or a number is not finite or absurdly large.
    """

    name: str
    """Its file, for error messages."""
    frequencies_hz: Float64[np.ndarray, " frequencies"]
    """Rising, evenly spaced."""
    antenna_m: Float64[np.ndarray, "pulses 3"]
    """Where the antenna was, world frame."""
    reference_m: Float64[np.ndarray, " pulses"]
    """Range whose phase was taken out of each pulse (motion compensation)."""
    samples: Complex64[np.ndarray, "frequencies pulses"]

    def __post_init__(self) -> None:
        frequencies, pulses = self.samples.shape
        sizes = (len(self.frequencies_hz), len(self.antenna_m), len(self.reference_m))
        if sizes != (frequencies, pulses, pulses):
            raise SarsplatError(
                f"{self.name} has samples of {frequencies} frequencies × {pulses} pulses, but {sizes[0]} frequencies "
                f"and {sizes[1]} antenna positions; download it again"
            )
        if min(frequencies, pulses) < 2:
            raise SarsplatError(
                f"{self.name} has {frequencies} × {pulses} samples (frequencies × pulses); an image needs two of each"
            )
        for what, values, limit in (
            ("an antenna position", self.antenna_m, FARTHEST_M),
            ("a reference range", self.reference_m, FARTHEST_M),
            ("a sample", self.samples, _LARGEST),
        ):
            wrong = ~(np.abs(values) <= limit)  # also catches NaN
            if wrong.any():
                raise SarsplatError(
                    f"{self.name} holds {what} of {values[wrong][0]:g}; it must be finite and at most {limit:g}, so "
                    "download it again"
                )
        self._check_frequencies()

    def _check_frequencies(self) -> None:
        low, high = _FREQUENCIES_HZ
        if not ((self.frequencies_hz >= low) & (self.frequencies_hz <= high)).all():  # also catches NaN
            raise SarsplatError(
                f"{self.name} has frequencies that are not all between {low:g} and {high:g} Hz; give them in hertz"
            )
        steps = np.diff(self.frequencies_hz)
        even = np.linspace(self.frequencies_hz[0], self.frequencies_hz[-1], len(self.frequencies_hz))
        if steps.min() <= 0 or np.abs(self.frequencies_hz - even).max() > _UNEVEN * steps.mean():
            raise SarsplatError(
                f"{self.name} has frequencies in steps of {steps.min():g} to {steps.max():g} Hz; only rising, evenly "
                "spaced ones are supported"
            )

    def __len__(self) -> int:
        return len(self.antenna_m)

    @property
    def step_hz(self) -> float:
        """From one frequency to the next."""
        first, last = self.frequencies_hz[[0, -1]]
        return float(last - first) / (len(self.frequencies_hz) - 1)

    @property
    def bandwidth_hz(self) -> float:
        """What the frequencies cover, half a step beyond the outer ones included."""
        return self.step_hz * len(self.frequencies_hz)

    @property
    def carrier_hz(self) -> float:
        """The middle of the frequencies."""
        return float(self.frequencies_hz[[0, -1]].mean())

    @property
    def unambiguous_m(self) -> float:
        """Extent in range beyond which echoes come back at the other side."""
        return SPEED_OF_LIGHT / (2 * self.step_hz)

    def part(self, pulses: slice) -> Self:
        """Some of its pulses."""
        return replace(
            self,
            antenna_m=self.antenna_m[pulses],
            reference_m=self.reference_m[pulses],
            samples=self.samples[:, pulses],
        )


def flights(histories: Sequence[PhaseHistory]) -> list[PhaseHistory]:
    """Whole flights, joined from pieces in any order: a piece that begins where another ends continues it.

    The gap between them may be three steps from pulse to pulse; the frequencies must be the same on both sides. Refused
    if pieces are of different bands, whose images show a target differently.
    """
    waiting = [*histories]
    _require_one_band(histories)
    whole = []
    while waiting:
        chain = [waiting.pop(0)]
        while (after := next((other for other in waiting if _goes_on(chain[-1], other)), None)) is not None:
            chain.append(after)
            waiting = [other for other in waiting if other is not after]
        while (before := next((other for other in waiting if _goes_on(other, chain[0])), None)) is not None:
            chain.insert(0, before)
            waiting = [other for other in waiting if other is not before]
        whole.append(_joined(chain))
    return whole


def _require_one_band(histories: Sequence[PhaseHistory]) -> None:
    first = histories[0]
    for other in histories[1:]:
        apart = abs(other.carrier_hz - first.carrier_hz) + abs(other.bandwidth_hz - first.bandwidth_hz)
        if apart > _OTHER_BAND * first.bandwidth_hz:
            raise SarsplatError(
                f"{other.name} covers {_band(other)} but {first.name} {_band(first)}; import each band on its own"
            )


def _band(history: PhaseHistory) -> str:
    return f"{history.bandwidth_hz / 1e6:.4g} MHz about {history.carrier_hz / 1e9:.4g} GHz"


def _goes_on(first: PhaseHistory, second: PhaseHistory) -> bool:
    step = np.linalg.norm(first.antenna_m[-1] - first.antenna_m[-2])
    gap = np.linalg.norm(second.antenna_m[0] - first.antenna_m[-1])
    if not 0 < gap <= _LONGEST_GAP * step or len(first.frequencies_hz) != len(second.frequencies_hz):
        return False
    return bool(np.abs(first.frequencies_hz - second.frequencies_hz).max() <= _UNEVEN * first.step_hz)


def _joined(pieces: Sequence[PhaseHistory]) -> PhaseHistory:
    name = pieces[0].name if len(pieces) == 1 else f"{pieces[0].name} … {Path(pieces[-1].name).name}"
    return PhaseHistory(
        name,
        pieces[0].frequencies_hz,
        np.concatenate([piece.antenna_m for piece in pieces]),
        np.concatenate([piece.reference_m for piece in pieces]),
        np.concatenate([piece.samples for piece in pieces], axis=1),
    )


@dataclass(frozen=True)
class Aperture:
    """Pulses that make one image of what is around a place."""

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
        """Whether the radar looks to the left of its flight."""
        return bool(self.cross[-1] < self.cross[0])

    @property
    def tilt_deg(self) -> float:
        """Turn of the slant plane about the line of sight; on level axes, its tangent displaces what stands up."""
        level = replace(self.view, tilt_deg=0.0).look
        across, up, _ = level.frame @ (self._directions()[-1] - self._directions()[0])
        return math.degrees(math.atan2(math.copysign(1, across) * up, abs(across)))

    def tilted(self) -> Self:
        """With the azimuth axis of its image tilted as the slant plane is."""
        return replace(self, view=replace(self.view, tilt_deg=self.tilt_deg))

    @property
    def extent(self) -> float:
        """Extent of `cross`, half a pulse beyond the outer ones included."""
        return float(np.ptp(self.cross)) * len(self.history) / (len(self.history) - 1)

    @property
    def unambiguous_m(self) -> float:
        """Extent along the columns beyond which echoes come back at the other side."""
        return SPEED_OF_LIGHT / (2 * self.history.carrier_hz * float(np.abs(np.diff(self.cross)).max()))

    def resolution_m(self, weighting: Taylor) -> tuple[float, float]:
        """3 dB width of the power response (azimuth, slant range), m."""
        factor = weighting.width * SPEED_OF_LIGHT / 2
        return factor / (self.history.carrier_hz * self.extent), factor / self.history.bandwidth_hz

    def _directions(self) -> Float64[np.ndarray, "pulses 3"]:
        return _unit(self.history.antenna_m - self.around_m)


def apertures(history: PhaseHistory, around_m: Float64[np.ndarray, " 3"], width_deg: float | None) -> list[Aperture]:
    """The parts of a whole flight around a place, in its order.

    Each has `width_deg` of azimuth; what is left over is divided between both ends and not used. Without a width, the
    parts are equal and about as wide as makes the azimuth resolution that of slant range; a shorter flight is one part.
    Refused if the width is out of range or more than there is, the azimuth turns back during the flight, or the radar
    is not above the place.
    """
    directions = _unit(history.antenna_m - around_m)
    azimuth = np.unwrap(np.arctan2(-directions[:, 1], directions[:, 0]))
    step = np.diff(azimuth)
    turned = np.flatnonzero(step * step[0] <= 0)
    if len(turned):
        raise SarsplatError(
            f"{history.name}: the azimuth turns back after pulse {turned[0]}; give pulses of one pass, in its order"
        )
    pulses = len(azimuth)
    span = math.degrees(abs(azimuth[-1] - azimuth[0])) * pulses / (pulses - 1)
    if width_deg is None:
        square = math.degrees(history.bandwidth_hz / history.carrier_hz / np.hypot(*directions[:, :2].T).mean())
        count = min(max(1, round(span / square), math.ceil(span / WIDEST_DEG)), pulses // 2)
        width_deg = span / count
    else:
        count = _count(history, width_deg, span)
    edges = (np.arange(count + 1) - count / 2) * math.radians(width_deg) + (azimuth[0] + azimuth[-1]) / 2
    if step[0] < 0:
        edges = edges[::-1]
    sign = np.sign(step[0])
    places = np.searchsorted(sign * azimuth, sign * edges)
    parts = []
    for first, last in pairwise(places):
        if last - first < 2:
            raise SarsplatError(_too_few(history, width_deg, last - first))
        middle = _unit(directions[first:last].sum(axis=0, keepdims=True))[0]
        azimuth_deg = math.degrees((azimuth[first] + azimuth[last - 1]) / 2) % 360
        if middle[2] <= 0:
            raise SarsplatError(f"{history.name}: the antenna is not above what --around names; heights are in metres")
        view = View(azimuth_deg, View.towards(middle).grazing_deg)
        parts.append(Aperture(history.part(slice(first, last)), around_m, view, width_deg))
    return parts


def _count(history: PhaseHistory, width_deg: float, span_deg: float) -> int:
    """How many apertures of a width fit into a flight; a pulse more or less does not matter."""
    if not 0 < width_deg <= WIDEST_DEG:  # also catches NaN
        raise SarsplatError(
            f"an aperture of {width_deg:g}° is not possible; give more than 0° and at most {WIDEST_DEG:g}°"
        )
    count = math.floor(span_deg / width_deg + 0.02)
    if count < 1:
        raise SarsplatError(
            f"an aperture of {width_deg:g}° is more than the {span_deg:.3g}° of {history.name}; give --aperture a "
            "smaller angle, or further files of the same flight"
        )
    if count > len(history):
        raise SarsplatError(_too_few(history, width_deg, 0))
    return count


def _too_few(history: PhaseHistory, width_deg: float, pulses: int) -> str:
    return (
        f"{history.name}: an aperture of {width_deg:.3g}° holds {pulses} of {len(history)} pulses; give --aperture a "
        "larger angle"
    )


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(np.float64).tiny)
