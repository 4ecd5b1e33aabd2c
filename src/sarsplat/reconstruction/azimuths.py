"""Azimuths of training chips that are known only to within some degrees: refined while the scene is learned."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float64, Int64

from sarsplat.data import Dataset
from sarsplat.geometry import View
from sarsplat.reconstruction.config import Surroundings
from sarsplat.reconstruction.rounds import at_round

_REACH = 2.5
"""How far from its label an azimuth is looked for, standard deviations."""

_EACH_WAY = 5
"""Offsets tried on each side of the label."""

NegativeLogLikelihood = Callable[[Sequence[View], Int64[np.ndarray, " n"]], Float64[np.ndarray, " n"]]
"""Of training chips, given by their numbers, as seen from these views; nats."""


class Azimuths:
    """From where the training images are taken to have been taken.

    Parameters
    ----------
    train : Dataset
        The training images: azimuths as labelled, and how well each is known.

    Attributes
    ----------
    offset_deg : numpy.ndarray, float64 [K]
        What is added to the labels, degrees.
    views : tuple of View
        The result; a view that is known exactly is the dataset's own.
    """

    def __init__(self, train: Dataset) -> None:
        self._labelled = train.views
        self._std_deg = np.array([entry.azimuth_std_deg for entry in train.entries])
        self.correct(np.zeros(len(self._labelled)))

    @property
    def uncertain(self) -> bool:
        """Whether any is not known exactly."""
        return bool(self._std_deg.any())

    def correct(self, offset_deg: Float64[np.ndarray, " k"]) -> None:
        """Add these to the labels, degrees; ValueError if they are not one finite number for each."""
        if offset_deg.shape != self._std_deg.shape or not np.isfinite(offset_deg).all():
            raise ValueError(f"{offset_deg.shape} azimuth offsets for {len(self._std_deg)} views")
        self.offset_deg = offset_deg
        self.views = tuple(
            _turned(view, offset) if std else view
            for view, offset, std in zip(self._labelled, offset_deg.tolist(), self._std_deg.tolist(), strict=True)
        )

    def refine(self, nats: NegativeLogLikelihood) -> None:
        """Move each uncertain azimuth to where it is most likely, given its label and its image.

        The offsets of all have no mean: turning all chips alike would turn the target, away from the test views. Each
        counts as much as it is known, so one that is known exactly holds the target alone.
        """
        chips = np.flatnonzero(self._std_deg)
        std = self._std_deg[chips]
        tried = std[:, None] * np.linspace(-_REACH, _REACH, 2 * _EACH_WAY + 1)
        views = [
            _turned(self._labelled[k], offset) for k, row in zip(chips, tried.tolist(), strict=True) for offset in row
        ]
        misfit = nats(views, np.repeat(chips, tried.shape[1])).reshape(tried.shape)
        offset = np.zeros(len(self._std_deg))
        offset[chips] = lowest(tried, misfit + (tried / std[:, None]) ** 2 / 2)
        if len(chips) == len(offset):
            offset -= np.average(offset, weights=std**-2.0)
        self.correct(offset)


def due(config: Surroundings, iteration: int, iterations: int) -> bool:
    """Whether a round follows this iteration."""
    first, last = config.azimuth_from * iterations, config.azimuth_until * iterations
    return config.azimuth_rounds > 0 and at_round(iteration, first, last, config.azimuth_rounds - 1)


def lowest(places: Float64[np.ndarray, "k n"], values: Float64[np.ndarray, "k n"]) -> Float64[np.ndarray, " k"]:
    """Where each row has its least value: of the parabola through the lowest three, or at the end.

    Parameters
    ----------
    places : numpy.ndarray, float64 [K, N]
        Evenly spaced in each row.
    values : numpy.ndarray, float64 [K, N]
        There.
    """
    rows = np.arange(len(places))
    best = values.argmin(axis=1)
    middle = best.clip(1, places.shape[1] - 2)
    before, at, after = (values[rows, middle + k] for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    slope = (before - after) / 2
    steps = np.divide(slope, curvature, out=(best - middle).astype(float), where=curvature > 0).clip(-1, 1)
    return places[rows, middle] + steps * (places[:, 1] - places[:, 0])


def _turned(view: View, offset_deg: float) -> View:
    return View((view.azimuth_deg + offset_deg) % 360, view.grazing_deg)
