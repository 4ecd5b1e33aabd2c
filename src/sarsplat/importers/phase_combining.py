"""Combination of pulses before back-projection, into as few as the extent of the image needs.

What a pulse adds to a pixel is the sum of its samples times exp(4πj f/c·d), d being how much farther the pixel is than
the middle of the image. From pulse to pulse such a phase changes no faster than it does for the farthest pixels, so
that those of all pulses can be interpolated between few of them, by least squares over that band. Images are sums over
pulses; so instead of interpolating their terms, the same weights, transposed, add the samples of each to those of
the few. Echoes from beyond the image are not aliased into it. Gaps and uneven flights need nothing of their own: pulses
that are not interpolated well stay, and their number tells whether anything is gained.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Complex64, Complex128, Float64, Int64
from scipy import sparse

from sarsplat.importers.phase_history import SPEED_OF_LIGHT, PhaseHistory

_ERROR = 1e-5  # maximum relative error of an interpolated phase: 100 dB below its echo
_TAPS = 14
_OVERSAMPLING = 2.0
"""Ratio of kept pulses to those that the band of phases needs. With `_TAPS`, the error is 6e-6 where pulses are even;
`_few` keeps more elsewhere."""
_WORTH = 0.5  # maximum share of kept pulses that is worth combining
_CHORDS = 64
"""Number of parts of the flight over which rates of phase are measured; over single pulses, jitter would be."""
_REGULAR = 1e-13  # regularisation of the nearly singular correlation of adjacent pulses
_BLOCK = 128
_PULSES_AT_ONCE = 4096


@dataclass(frozen=True)
class Combined:
    """Pulses that are back-projected, and the weights with which all others are added to them."""

    history: PhaseHistory
    middle_m: Float64[np.ndarray, " 3"]
    """The place whose range is taken out of the phases, world frame."""
    kept: Int64[np.ndarray, " few"]
    """Indices of these pulses, rising."""
    weights: sparse.csc_array
    """few × pulses."""

    @classmethod
    def around(
        cls,
        history: PhaseHistory,
        middle_m: Float64[np.ndarray, " 3"],
        edge_m: Float64[np.ndarray, "places 3"],
        cross: Float64[np.ndarray, " pulses"],
    ) -> Self:
        """Combine for an image with this middle and edge; `cross` is the direction to the antenna along its columns."""
        everything = slice(None)
        beyond = history.beyond_m(everything, edge_m) - history.beyond_m(everything, middle_m[None])
        last_hz = history.first_hz + (history.frequencies - 1) * history.step_hz
        waves = np.stack([history.first_hz, last_hz], axis=1) * 2 / SPEED_OF_LIGHT
        turns = (waves[:, :, None] * beyond[:, None]).reshape(len(history), -1)  # phases of the places at the edge
        kept, weights = _few(cross, turns)
        return cls(history, middle_m, kept, weights)

    def echoes(
        self, shares: Float64[np.ndarray, " pulses"]
    ) -> Iterator[tuple[int, Complex64[np.ndarray, " frequencies"]]]:
        """Yield each kept pulse with combined samples, weighted by `shares`, without the phase of the middle's range.

        Memory does not grow with the length of the flight.
        """
        weights = self.weights.astype(np.complex64)  # as the samples are, which are not copied then
        weights.data *= np.repeat(shares, np.diff(weights.indptr))
        lowest = np.minimum.reduceat(weights.indices, weights.indptr[:-1])
        later = np.append(np.minimum.accumulate(lowest[::-1])[::-1], len(self.kept))
        first, begun = 0, np.zeros((0, self.history.frequencies), np.complex64)
        for pulses, samples in self.history.pieces():
            adds = weights[:, pulses]
            needed = max(int(adds.indices.max()) + 1, first + len(begun))
            begun = np.pad(begun, ((0, needed - first - len(begun)), (0, 0)))
            begun += adds[first:needed].tocsr() @ self._moved(pulses, samples)
            ready = int(later[pulses.stop])
            for one in range(first, ready):
                yield int(self.kept[one]), begun[one - first]
            begun, first = begun[ready - first :], ready

    def _moved(
        self, pulses: slice, samples: Complex64[np.ndarray, "frequencies some"]
    ) -> Complex64[np.ndarray, "some frequencies"]:
        """Remove the range of the middle from the phases of samples.

        Phases are products of those of every 128th frequency and of the 128 that follow it.
        """
        history = self.history
        wave = 4j * np.pi / SPEED_OF_LIGHT * history.beyond_m(pulses, self.middle_m[None])
        coarse = np.arange(0, history.frequencies, _BLOCK)
        far = np.exp(wave * (history.first_hz[pulses, None] + coarse * history.step_hz[pulses, None]))
        near = np.exp(wave * (np.arange(_BLOCK) * history.step_hz[pulses, None]))
        turned = far.astype(np.complex64)[:, :, None] * near.astype(np.complex64)[:, None]
        return samples.T * turned.reshape(len(turned), -1)[:, : history.frequencies]


def _few(
    places: Float64[np.ndarray, " pulses"], turns: Float64[np.ndarray, "pulses phases"]
) -> tuple[Int64[np.ndarray, " few"], sparse.csc_array]:
    """Return pulses between which phases can be interpolated, or all, and the weights, few × pulses."""
    count = len(places)
    everything = np.arange(count), sparse.csc_array(sparse.eye_array(count))
    chord = np.unique(np.linspace(0, count - 1, _CHORDS + 1).round().astype(int))
    steps = np.diff(places[chord])
    if not (steps * steps[0] > 0).all():
        return everything  # the direction turns back, so that places do not tell pulses apart
    band = float(np.abs(np.diff(turns[chord], axis=0) / steps[:, None]).max()) * 2
    travelled = np.maximum.accumulate(np.abs(places - places[0]))
    evenly = max(_OVERSAMPLING * band * travelled[-1] + 2, _TAPS + 1)
    if evenly > _WORTH * count:  # without end where directions all but stand still while phases change
        return everything
    needed = np.linspace(0, travelled[-1], math.ceil(evenly))
    kept = np.unique(np.append(np.searchsorted(travelled, needed), count - 1))
    phases = np.exp(2j * np.pi * turns)
    while _TAPS < len(kept) <= _WORTH * count:
        weights, error = _interpolating(places, phases, kept, band)
        wrong = np.flatnonzero(~(error <= _ERROR))
        if len(wrong) == 0:
            return kept, weights
        before = np.unique(np.searchsorted(kept, wrong) - 1)
        kept = np.unique(np.concatenate([kept, (kept[before] + kept[before + 1]) // 2]))
    return everything


def _interpolating(
    places: Float64[np.ndarray, " pulses"],
    phases: Complex128[np.ndarray, "pulses phases"],
    kept: Int64[np.ndarray, " few"],
    band: float,
) -> tuple[sparse.csc_array, Float64[np.ndarray, " pulses"]]:
    """Return weights of least squares over all phases of a band, and the maximum error of each pulse."""
    starts = np.clip(np.searchsorted(kept, np.arange(len(places))) - _TAPS // 2, 0, len(kept) - _TAPS)
    rows = starts[:, None] + np.arange(_TAPS)
    weights, errors = [], []
    for first in range(0, len(places), _PULSES_AT_ONCE):
        chunk = slice(first, first + _PULSES_AT_ONCE)
        around = places[kept[rows[chunk]]]
        likeness = np.sinc(band * (around[:, :, None] - around[:, None])) + _REGULAR * np.eye(_TAPS)
        solved = np.linalg.solve(likeness, np.sinc(band * (around - places[chunk, None]))[..., None])[..., 0]
        itself = kept[rows[chunk]] == np.arange(len(places))[chunk, None]
        solved = np.where(itself.any(axis=1, keepdims=True), itself, solved)
        between = np.einsum("pt,ptq->pq", solved, phases[kept[rows[chunk]]])
        weights.append(solved)
        errors.append(np.abs(between - phases[chunk]).max(axis=1))
    ends = np.arange(len(places) + 1) * _TAPS
    table = sparse.csc_array((np.concatenate(weights).ravel(), rows.ravel(), ends), shape=(len(kept), len(places)))
    return table, np.concatenate(errors)
