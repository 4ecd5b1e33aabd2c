"""Odds from likelihoods: a temperature, and a bias of each class, fitted to labelled images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import minimize
from scipy.special import log_softmax

from sarsplat.data.files import read_versioned_json, write_json
from sarsplat.errors import SarsplatError

_SCHEMA, _SCHEMA_VERSION = "sarsplat-calibration", 1

TEMPERATURE = 8.4
"""Temperature without labelled images, as MSTAR's chips have it."""

_LOG_TEMPERATURE_STD, _BIAS_STD = 1.0, 0.02
"""Standard deviations of the priors: of the logarithm of the temperature, and of biases, nats per pixel."""

_MEDIAN_OF_NORMAL = 0.6745  # median of the absolute value of a normal variable, standard deviations


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """Numbers by which likelihoods become odds of classes, and curvatures standard deviations of azimuths."""

    runs: dict[str, str]
    """Class of each run by its name and the digest of its training."""
    settings: dict[str, Any]
    """Options of `locate` that it belongs to."""
    temperature: float = TEMPERATURE
    """Factor by which the likelihoods of independent samples are overconfident."""
    bias: dict[str, float] = {}
    """Nats per pixel added for each class."""
    azimuth_scale: float = 1.0
    """Factor on the standard deviations of azimuths."""
    images: int = 0
    """Number of labelled images; 0: not calibrated."""
    schema: str = _SCHEMA
    schema_version: int = _SCHEMA_VERSION

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes in alphabetical order."""
        return tuple(sorted({*self.runs.values()}))

    def odds(self, nats: Float64[np.ndarray, "n c"], samples: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n c"]:
        """Return odds from nats per pixel and the number of independent samples in the window."""
        bias = np.array([self.bias.get(name, 0.0) for name in self.classes])
        return np.exp(log_softmax(-(nats + bias) * samples[:, None] / self.temperature, axis=1))

    def fitted(
        self,
        nats: Float64[np.ndarray, "n c"],
        samples: Float64[np.ndarray, " n"],
        labels: Int64[np.ndarray, " n"],
        relative_errors: Float64[np.ndarray, " e"],
    ) -> Calibration:
        """Return the most probable numbers, given the labelled classes of images, which all count the same.

        `relative_errors` are the errors of known azimuths, in standard deviations; `odds` has the others.
        """
        counts = np.bincount(labels, minlength=len(self.classes))
        if not counts.all() or len(counts) < 2:
            lacks = self.classes[int(counts.argmin())] if len(counts) > 1 else "a second class"
            raise SarsplatError(
                f"there is no labelled image of {lacks} to calibrate with, besides those to be located; give one, or "
                "leave out `calibrate`"
            )
        weights = counts.mean() / counts[labels]

        def with_values(x: Float64[np.ndarray, " p"]) -> Calibration:
            bias = dict(zip(self.classes, map(float, _BIAS_STD * (x[1:] - x[1:].mean())), strict=True))
            hotter = float(np.exp(_LOG_TEMPERATURE_STD * x[0]))
            return msgspec.structs.replace(self, temperature=TEMPERATURE * hotter, bias=bias)

        def cost(x: Float64[np.ndarray, " p"]) -> float:
            odds = with_values(x).odds(nats, samples)[np.arange(len(labels)), labels]
            return float((x**2).sum() / 2 - (weights * np.log(odds + 1e-300)).sum())

        found = with_values(minimize(cost, np.zeros(1 + len(self.classes))).x)
        scale = float(np.median(np.abs(relative_errors))) / _MEDIAN_OF_NORMAL if len(relative_errors) else 1.0
        return msgspec.structs.replace(found, azimuth_scale=scale, images=len(labels))

    def write(self, path: Path) -> None:
        """Write it as JSON."""
        write_json(path, self)

    def read(self, path: Path) -> Calibration:
        """Read one that was made with the same runs and settings as this; raise if they differ."""
        made = read_versioned_json(
            path, Calibration, schema=_SCHEMA, version=_SCHEMA_VERSION, remedy="calibrate again with labelled images"
        )
        for theirs, own in ((made.runs, self.runs), (made.settings, self.settings)):
            if theirs != own:
                raise SarsplatError(f"{path} was made with {theirs}, not {own}; give `calibrate` labelled images")
        return made
