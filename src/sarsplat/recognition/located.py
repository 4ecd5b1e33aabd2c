"""Result of `locate`: class and azimuth of each image with their odds, and scores where labels are known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from sarsplat.data.files import write_bytes
from sarsplat.evaluation.azimuths import CLOSE_DEG, REVERSED_DEG, signed
from sarsplat.recognition.chips import Chip
from sarsplat.recognition.odds import Calibration
from sarsplat.runs import Run
from sarsplat.samples.encoding import encoded_table

_SURE = 0.95  # odds whose reliability is a score

_MAX_STD_DEG, _MAX_REVERSED = 10.0, 0.05
"""Maximum standard deviation, degrees, and maximum odds of the reversed azimuth, of a certain one."""

_FAR_STD = 4.0
"""Standard deviations beyond which a certain azimuth contradicts a label; they are too small at other depressions."""

_MAX_NAMED = 6  # maximum number of images named


@dataclass(frozen=True, eq=False)
class Located:
    """Class and azimuth of N images; C classes are in alphabetical order. Arrays are float64 [N, C] unless noted."""

    chips: tuple[Chip, ...]
    """The images, with their labels."""
    runs: tuple[Run, ...]
    calibration: Calibration
    """Temperature and biases of the odds, which are not calibrated if its `images` is 0."""
    odds: Float64[np.ndarray, "n c"]
    """Odds of each class; they sum to 1."""
    azimuth_deg: Float64[np.ndarray, "n c"]
    """Azimuth of the image if it is of that class, degrees in [0, 360)."""
    azimuth_std_deg: Float64[np.ndarray, "n c"]
    """Its standard deviation, degrees."""
    reversed_odds: Float64[np.ndarray, "n c"]
    """Odds that the target stands the other way round, within 45° of 180°."""
    shift_m: Float64[np.ndarray, "n c 2"]
    """Displacement of the target from the origin in azimuth and slant range, m, [N, C, 2]."""
    gain_db: Float64[np.ndarray, "n c"]
    """Power of the image relative to the rendered one, dB."""
    nats: Float64[np.ndarray, "n c"]
    """Negative log-likelihood per pixel of the image divided by its mean."""
    run_index: Int64[np.ndarray, "n c"]
    """Index of the run that explains the image best, among those of the class, int64."""

    def __len__(self) -> int:
        return len(self.chips)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        return self.calibration.classes

    @property
    def found(self) -> Int64[np.ndarray, " n"]:
        """Index of the most probable class of each image."""
        return self.odds.argmax(axis=1)

    @cached_property
    def labels(self) -> Int64[np.ndarray, " n"]:
        """Index of the labelled class of each image; −1 if it is unknown or none of the classes."""
        known = {name: index for index, name in enumerate(self.classes)}
        return np.array([known.get(chip.target, -1) for chip in self.chips])

    @property
    def azimuth_errors_deg(self) -> Float64[np.ndarray, " n"]:
        """Error of the azimuth given the labelled class, degrees in [−180, 180); NaN where a label is unknown."""
        errors = self.of_class(self.azimuth_deg) - np.array([chip.azimuth_deg for chip in self.chips])
        return np.where(self.labels < 0, np.nan, signed(errors))

    @property
    def relative_azimuth_errors(self) -> Float64[np.ndarray, " k"]:
        """Errors of the known azimuths, in standard deviations."""
        relative = self.azimuth_errors_deg / self.of_class(self.azimuth_std_deg)
        return relative[np.isfinite(relative)]

    def of_class(self, values: Float64[np.ndarray, "n c"]) -> Float64[np.ndarray, " n"]:
        """Values of each image given its labelled class, or the class found if its label is unknown."""
        return values[np.arange(len(self)), np.where(self.labels < 0, self.found, self.labels)]

    @property
    def certain(self) -> Bool[np.ndarray, " n"]:
        """Mask of images whose azimuth is neither wide nor perhaps reversed, and whose label, if any, is a class."""
        of_a_class = (self.labels >= 0) | ~np.array([bool(chip.target) for chip in self.chips])
        narrow = self.of_class(self.azimuth_std_deg) <= _MAX_STD_DEG
        return of_a_class & narrow & (self.of_class(self.reversed_odds) <= _MAX_REVERSED)

    @property
    def contradicted(self) -> Int64[np.ndarray, " k"]:
        """Indices of images with a certain azimuth that is far from the labelled one."""
        errors = np.abs(self.azimuth_errors_deg)
        far = errors > np.maximum(CLOSE_DEG, _FAR_STD * self.of_class(self.azimuth_std_deg))
        return np.flatnonzero(far & self.certain)

    @property
    def confusion(self) -> Int64[np.ndarray, "c c"]:
        """Number of images by labelled (row) and found class (column)."""
        counts, known = np.zeros((len(self.classes),) * 2, dtype=np.int64), self.labels >= 0
        np.add.at(counts, (self.labels[known], self.found[known]), 1)
        return counts

    def scores(self) -> dict[str, float]:
        """Return shares of 1, and the median of azimuth errors in degrees, by name; without labels none."""
        known, errors = self.labels >= 0, np.abs(self.azimuth_errors_deg)
        scores: dict[str, float] = {}
        if known.any() and len(self.classes) > 1:
            right, claimed = (self.found == self.labels)[known], self.odds.max(axis=1)[known]
            scores |= {"accuracy": right.mean(), f"claimed at {_SURE:.0%} or more": (claimed >= _SURE).mean()}
            if (claimed >= _SURE).any():
                scores["right of these"] = right[claimed >= _SURE].mean()
        if len(errors := errors[np.isfinite(errors)]):
            scores["median azimuth error, °"] = np.median(errors)
            scores[f"azimuth within {CLOSE_DEG:g}°"] = (errors <= CLOSE_DEG).mean()
            scores["reversed"] = (errors > REVERSED_DEG).mean()
            scores["azimuth within one standard deviation"] = (np.abs(self.relative_azimuth_errors) <= 1).mean()
        return {name: float(value) for name, value in scores.items()}

    def scores_in_words(self) -> dict[str, str]:
        """Return the scores, and images whose labelled azimuth is contradicted, as text by name."""
        words = {name: f"{value:.2f}" if ", °" in name else f"{value:.1%}" for name, value in self.scores().items()}
        if len(far := self.contradicted):
            errors = self.azimuth_errors_deg
            names = ", ".join(self.chips[index].name for index in far[:_MAX_NAMED]) + ", …" * (len(far) > _MAX_NAMED)
            words["labelled azimuths contradicted"] = (
                f"{len(far)} of {np.isfinite(errors).sum()}, by {np.median(errors[far]):+.0f}° in the median: {names}"
            )
        return words

    def rows(self) -> list[dict[str, Any]]:
        """Return a row of the table for each image."""
        rows = []
        for k, (chip, best) in enumerate(zip(self.chips, self.found, strict=True)):
            order = np.argsort(-self.odds[k], kind="stable")
            named = {"image": chip.name, "class": self.classes[best]}
            named["runner_up"] = self.classes[order[1]] if len(order) > 1 else ""
            numbers = {
                "odds": self.odds[k, best],
                "azimuth_deg": self.azimuth_deg[k, best],
                "azimuth_std_deg": self.azimuth_std_deg[k, best],
                "reversed_odds": self.reversed_odds[k, best],
                "azimuth_shift_m": self.shift_m[k, best, 0],
                "range_shift_m": self.shift_m[k, best, 1],
                "gain_db": self.gain_db[k, best],
                "nats_per_pixel": self.nats[k, best],
                **{f"odds_{name}": odds for name, odds in zip(self.classes, self.odds[k], strict=True)},
                "grazing_deg": chip.view.grazing_deg,
                "labelled_azimuth_deg": chip.azimuth_deg,
            }
            texts = {name: "" if np.isnan(value) else f"{value:.6g}" for name, value in numbers.items()}
            calibrated = "yes" if self.calibration.images else "no"
            rows.append({**named, **texts, "labelled_class": chip.target, "calibrated": calibrated})
        return rows

    def write_csv(self, path: Path) -> None:
        """Write the table of all images as CSV, whole or not at all."""
        rows = self.rows()
        write_bytes(path, encoded_table(rows, [*rows[0]]))
