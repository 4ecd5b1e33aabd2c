"""Refinement of the azimuths of training images that are known only to within some degrees."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from sarsplat.data import Dataset
from sarsplat.geometry import View
from sarsplat.learning.losses import speckle_nats
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State, at_round
from sarsplat.settings.config import Config

_REACH = 2.5  # largest offset tried, standard deviations of the label
_EACH_WAY = 5  # number of offsets tried on each side of the label

NegativeLogLikelihood = Callable[[Sequence[View], Int64[np.ndarray, " n"]], Float64[np.ndarray, " n"]]
"""Function from views and numbers of training images to each image's negative log-likelihood, nats."""

AZIMUTH_OFFSETS = "strategy/azimuths/offset_deg"
"""Tensor in snapshots: offsets of the K training views' azimuths, degrees, float64; absent if all are certain."""


class AzimuthRefinement(Configured):
    """Estimates the azimuths of training images from their labels and standard deviations."""

    order = 30
    name = "azimuths"
    section = "surroundings"

    def __init__(self, config: Config, train: Dataset) -> None:
        super().__init__(config, train)
        self._std_deg = np.array([entry.azimuth_std_deg for entry in train.entries])

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return config.surroundings is not None and any(entry.azimuth_std_deg for entry in train.entries)

    def initial_state(self, params: Params) -> State:
        """Azimuth corrections, zero at first, degrees."""
        return State(whole={"offset_deg": torch.zeros(len(self.train), dtype=torch.float64, device="cpu")})

    def due(self, step: int) -> bool:
        s, iterations = self.settings, self.config.iterations
        first, last = s.azimuth_from * iterations, s.azimuth_until * iterations
        return s.azimuth_rounds > 0 and at_round(step, first, last, s.azimuth_rounds - 1)

    def act(self, params: Params, optimizers: Optimiser, state: State, info: Info) -> None:
        def nats(views: Sequence[View], numbers: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
            batches = [speckle_nats(rendered, measured) for measured, rendered in info.compared(views, numbers)]
            return torch.cat(batches).double().cpu().numpy() * info.images.samples

        offset_deg = self.most_likely(nats)
        state.whole["offset_deg"] = torch.from_numpy(offset_deg)
        info.images.views = self.views(offset_deg)

    def views(self, offset_deg: Float64[np.ndarray, " k"]) -> tuple[View, ...]:
        """Training views with these offsets, degrees, where the azimuth is uncertain."""
        known = zip(self.train.views, offset_deg.tolist(), self._std_deg.tolist(), strict=True)
        return tuple(_turned(view, offset) if std else view for view, offset, std in known)

    def most_likely(self, nats: NegativeLogLikelihood) -> Float64[np.ndarray, " k"]:
        """Most likely offset of each azimuth from its label, given label and image, degrees.

        Their mean, weighted by the labels' precision, is 0: a common offset would turn the target relative to the test
        views. Azimuths that are known exactly fix the heading instead.
        """
        uncertain = np.flatnonzero(self._std_deg)
        std = self._std_deg[uncertain]
        tried = std[:, None] * np.linspace(-_REACH, _REACH, 2 * _EACH_WAY + 1)
        views = [
            _turned(self.train.views[k], offset)
            for k, row in zip(uncertain, tried.tolist(), strict=True)
            for offset in row
        ]
        misfit = nats(views, np.repeat(uncertain, tried.shape[1])).reshape(tried.shape)
        offset = np.zeros(len(self._std_deg))
        offset[uncertain] = lowest(tried, misfit + (tried / std[:, None]) ** 2 / 2)
        if len(uncertain) == len(offset):
            offset -= np.average(offset, weights=std**-2.0)
        return offset


def lowest(places: Float64[np.ndarray, "k n"], values: Float64[np.ndarray, "k n"]) -> Float64[np.ndarray, " k"]:
    """Minimum of each row, sampled at evenly spaced places: by a parabola through the lowest 3, or at an end."""
    rows = np.arange(len(places))
    best = values.argmin(axis=1)
    middle = best.clip(1, places.shape[1] - 2)
    before, at, after = (values[rows, middle + k] for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    slope = (before - after) / 2
    steps = np.divide(slope, curvature, out=(best - middle).astype(float), where=curvature > 0).clip(-1, 1)
    return places[rows, middle] + steps * (places[:, 1] - places[:, 0])


def _turned(view: View, offset_deg: float) -> View:
    return replace(view, azimuth_deg=(view.azimuth_deg + offset_deg) % 360)
