"""Phase history: the echo of the scene at every frequency of every pulse, with the antenna's position."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Bool, Complex64, Float64

from sarsplat.errors import SarsplatError
from sarsplat.geometry import Place
from sarsplat.importers.files import raise_damaged

SPEED_OF_LIGHT = 299_792_458.0
FARTHEST_M = 1e8
_LARGEST = 1e9  # no amplitude comes near it, and its square still fits into float32
_FREQUENCIES_HZ = (1e6, 1e12)
_LONGEST_GAP = 3  # maximum gap between two pieces of one flight, in steps from pulse to pulse
_OTHER_BAND = 0.1  # of the bandwidth: what may differ between passes of one radar
_SAME_FREQUENCY = 0.01  # tolerance of equal frequencies, in steps
_AT_A_TIME = 1 << 19  # maximum number of samples in memory, of a file that is read in pieces


_OF_PULSES = ("first_hz", "step_hz", "antenna_m", "reference_m", "moved_m", "shown_m")
"""Fields of `PhaseHistory` with a number or a vector for each pulse, or None."""


class Recorded(ABC):
    """Samples that stay in their file until they are needed."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Frequencies and pulses."""

    @abstractmethod
    def part(self, pulses: slice) -> Self:
        """Return the samples of some of the pulses."""

    @abstractmethod
    def read(self) -> Complex64[np.ndarray, "frequencies pulses"]:
        """Read all samples; raise if they cannot be read."""


@dataclass(frozen=True)
class PhaseHistory:
    """Pulses of one flight, in its order.

    A scatterer of amplitude A at p contributes A·exp(−4πj f/c·(R(p) − reference)) to a sample; R is its distance from
    the antenna, or half of the way there and back if that moves meanwhile. Raises if sizes contradict each other, or a
    number is not finite or absurdly large.
    """

    name: str
    """Its file, for error messages."""
    first_hz: Float64[np.ndarray, " pulses"]
    """Lowest frequency of each pulse."""
    step_hz: Float64[np.ndarray, " pulses"]
    """Step between frequencies of each pulse."""
    antenna_m: Float64[np.ndarray, "pulses 3"]
    """Position of the antenna, world frame, midway between sending the pulse and receiving its echo."""
    reference_m: Float64[np.ndarray, " pulses"]
    """Range whose phase was taken out of each pulse (motion compensation)."""
    samples: Complex64[np.ndarray, "frequencies pulses"] | Recorded
    moved_m: Float64[np.ndarray, "pulses 3"] | None = None
    """Vector from the sending position to `antenna_m`, and from there to the receiving position; None if zero."""
    shown_m: Float64[np.ndarray, "pulses 2"] | None = None
    """Nearest and farthest range that the samples of each pulse show, m beyond its reference; None for the unambiguous
    extent."""
    place: Place | None = None
    """Place on earth of the world frame, if stated."""
    lit: Callable[[Float64[np.ndarray, "places 3"]], Bool[np.ndarray, " pulses"]] | None = None
    """Function that returns the pulses that saw all of some places (ECEF, m); None if all see everything."""
    collection: Mapping[str, str] = field(default_factory=dict)
    """Facts about the collection."""

    def __post_init__(self) -> None:
        frequencies, pulses = self.samples.shape
        sizes = {len(self.first_hz), len(self.step_hz), len(self.antenna_m), len(self.reference_m)}
        if sizes != {pulses}:
            raise_damaged(self.name, f"has samples of {pulses} pulses, but {len(self.antenna_m)} antenna positions")
        if min(frequencies, pulses) < 2:
            raise_damaged(self.name, f"has only {frequencies} × {pulses} samples (frequencies × pulses)")
        self._check("an antenna position", self.antenna_m, FARTHEST_M)
        self._check("a reference range", self.reference_m, FARTHEST_M)
        if isinstance(self.samples, np.ndarray):
            self._check("a sample", self.samples, _LARGEST)
        low, high = _FREQUENCIES_HZ
        last = self.first_hz + (frequencies - 1) * self.step_hz
        if not ((self.first_hz >= low) & (last <= high) & (self.step_hz > 0)).all():  # also catches NaN
            raise SarsplatError(
                f"{self.name} has frequencies that are not all between {low:g} and {high:g} Hz; give them in hertz"
            )

    def _check(self, what: str, values: np.ndarray, limit: float) -> None:
        wrong = ~(np.abs(values) <= limit)  # also catches NaN
        if wrong.any():
            raise_damaged(self.name, f"holds {what} of {values[wrong][0]:g}, not finite or above {limit:g}")

    def __len__(self) -> int:
        return len(self.antenna_m)

    @property
    def frequencies(self) -> int:
        """Number of frequencies of a pulse."""
        return self.samples.shape[0]

    @property
    def bandwidth_hz(self) -> float:
        """Bandwidth, half a step beyond the outer frequencies included."""
        return float(self.step_hz.mean()) * self.frequencies

    @property
    def carrier_hz(self) -> float:
        """Mean frequency."""
        return float((self.first_hz + (self.frequencies - 1) / 2 * self.step_hz).mean())

    @property
    def limits_m(self) -> Float64[np.ndarray, "pulses 2"]:
        """Unambiguous ranges of each pulse, beyond its reference."""
        whole = SPEED_OF_LIGHT / (2 * self.step_hz)
        unambiguous = np.stack([-whole / 2, whole / 2], axis=1)
        return unambiguous if self.shown_m is None else self.shown_m

    def part(self, pulses: slice) -> Self:
        """Return some of its pulses."""
        stored = self.samples
        samples = stored[:, pulses] if isinstance(stored, np.ndarray) else stored.part(pulses)
        parts = {name: values[pulses] for name in _OF_PULSES if (values := getattr(self, name)) is not None}
        return replace(self, samples=samples, lit=None, **parts)

    def seeing(self, places: Float64[np.ndarray, "places 3"]) -> Self:
        """Return the pulses that saw all of some places, world frame, m; raise if no pulse did."""
        if self.lit is None or self.place is None:
            return self
        seen = np.flatnonzero(self.lit(self.place.to_ecef(places)))
        if len(seen) < 2:
            raise SarsplatError(
                f"{self.name} states that no pulses saw all of the image; give a smaller `size_m`, or another place"
            )
        return self.part(slice(int(seen[0]), int(seen[-1]) + 1))

    def seen_from(self, place: Place) -> Self:
        """Transform a history with a place to the world frame of another."""
        assert self.place is not None
        turn = self.place.axes @ place.axes.T
        return replace(
            self,
            antenna_m=place.from_ecef(self.place.to_ecef(self.antenna_m)),
            moved_m=None if self.moved_m is None else self.moved_m @ turn,
            place=place,
        )

    def pieces(self) -> Iterator[tuple[slice, Complex64[np.ndarray, "frequencies some"]]]:
        """Yield samples of some pulses at a time, and the slice of these pulses."""
        if isinstance(self.samples, np.ndarray):
            yield slice(0, len(self)), self.samples
            return
        count = max(1, _AT_A_TIME // self.frequencies)
        for first in range(0, len(self), count):
            pulses = slice(first, min(first + count, len(self)))
            samples = self.samples.part(pulses).read()
            self._check("a sample", samples, _LARGEST)
            yield pulses, samples

    def beyond_m(self, pulses: slice, places: Float64[np.ndarray, "places 3"]) -> Float64[np.ndarray, "pulses places"]:
        """Return the range of places beyond the reference of each pulse, m."""
        from_antenna = places - self.antenna_m[pulses, None]
        if self.moved_m is None:
            return np.linalg.norm(from_antenna, axis=2) - self.reference_m[pulses, None]
        moved = self.moved_m[pulses, None]
        sent, received = (np.linalg.norm(from_antenna + way * moved, axis=2) for way in (1, -1))
        return (sent + received) / 2 - self.reference_m[pulses, None]


def flights(histories: Sequence[PhaseHistory]) -> list[PhaseHistory]:
    """Join pieces in any order to whole flights: a piece that begins where another ends continues it.

    The gap between them may be three steps from pulse to pulse; frequencies must be equal on both sides. Raises if
    pieces are of different bands, whose images show a target differently.
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
    if isinstance(first.samples, Recorded) or isinstance(second.samples, Recorded):
        return False  # such files are whole flights
    step = np.linalg.norm(first.antenna_m[-1] - first.antenna_m[-2])
    gap = np.linalg.norm(second.antenna_m[0] - first.antenna_m[-1])
    if not 0 < gap <= _LONGEST_GAP * step or first.frequencies != second.frequencies:
        return False
    own, other = ((one.first_hz[at], one.step_hz[at]) for one, at in ((first, -1), (second, 0)))
    apart = max(abs(other[0] - own[0]), abs(other[0] - own[0] + (first.frequencies - 1) * (other[1] - own[1])))
    return bool(apart <= _SAME_FREQUENCY * own[1])


def _joined(pieces: Sequence[PhaseHistory]) -> PhaseHistory:
    if len(pieces) == 1:
        return pieces[0]
    first = pieces[0]
    stated = [name for name in _OF_PULSES if getattr(first, name) is not None]
    joined: dict[str, Any] = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in stated}
    samples = np.concatenate([piece.samples for piece in pieces], axis=1)
    return replace(first, name=f"{first.name} … {Path(pieces[-1].name).name}", samples=samples, **joined)
