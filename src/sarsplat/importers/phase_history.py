"""Phase history: for every pulse, the echo of the scene at every frequency, with the antenna's place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Complex64, Float64

from sarsplat.errors import SarsplatError

SPEED_OF_LIGHT = 299_792_458.0
FARTHEST_M = 1e8
_LARGEST = 1e9  # no amplitude comes near it, and its square still fits into float32
_FREQUENCIES_HZ = (1e6, 1e12)
_LONGEST_GAP = 3
"""Longest gap between two pieces of one flight, in steps from pulse to pulse."""
_OTHER_BAND = 0.1  # of the bandwidth: what may differ between passes of one radar
_UNEVEN = 0.01
"""Largest distance of a frequency from its place among evenly spaced ones, in steps. Single precision costs 0.03 %."""


@dataclass(frozen=True)
class PhaseHistory:
    """Pulses of one flight, in its order.

    A scatterer of amplitude A at p contributes A·exp(−4πj f/c·(|antenna − p| − reference)) to a sample.

    Raises
    ------
    SarsplatError
        If sizes do not fit one another, frequencies are not as required, or a number is not finite or absurdly large.
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

    The gap between them may be three steps from pulse to pulse; the frequencies must be the same on both sides.

    Raises
    ------
    SarsplatError
        If pieces are of different bands, whose images show a target differently.
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
