"""Response of the system along one axis: power in the image of a point scatterer; a Gaussian by default."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float64

_SIGMAS = 8.0  # end of a Gaussian's table in standard deviations: e⁻³² of the peak
_RATIO = 8 * math.log(2)  # squared 3 dB width of a Gaussian over its variance


def variance_of(width: float) -> float:
    """Return the variance of the Gaussian with this 3 dB width, in the square of its unit."""
    return width**2 / _RATIO


def width_of(variance: float, width: float = 0.0) -> float:
    """Return the 3 dB width of a Gaussian of this variance, or of a Gaussian of `width` widened by it."""
    return math.sqrt(width**2 + _RATIO * variance)


class Response(ABC):
    """Shape of |h|², symmetric and the same along both axes; the grid gives its 3 dB width.

    To add one, put a frozen dataclass in a new file beside this one. Its fields, numbers or tuples of numbers
    that it checks, become the settings in files.

    Attributes
    ----------
    kind : str
        Name in files.
    """

    kind: ClassVar[str]

    @abstractmethod
    def table(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return distances from the peak, rising from 0, and the power there, in any units; zero beyond them."""

    @cached_property
    def _lobes(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], int]:
        """Distances in 3 dB widths, power relative to the peak, and the number of samples in the main lobe."""
        distance, power = self.table()
        power = power / power[0]
        below = int(np.argmax(power < 0.5))
        half = np.interp(-0.5, -power[below - 1 : below + 1], distance[below - 1 : below + 1])
        rising = np.flatnonzero(np.diff(power[below:]) > 0)
        return distance / (2 * half), power, below + int(rising[0]) if len(rising) else len(power)

    @property
    def reach(self) -> float:
        """Distance beyond which the power is zero, in 3 dB widths."""
        return float(self._lobes[0][-1])

    def reach_above(self, power: float) -> float:
        """Return the distance, in 3 dB widths, beyond which the power relative to the peak stays below `power`."""
        distance, powers, _ = self._lobes
        return float(distance[np.flatnonzero(powers >= power)[-1]])

    @property
    def main_lobe(self) -> float:
        """Distance at which the side lobes begin, in 3 dB widths; infinite without side lobes."""
        distance, _, own = self._lobes
        return float(distance[own]) if own < len(distance) else math.inf

    def density(self, distance: Float64[np.ndarray, "*n"], variance: float = 1 / _RATIO) -> Float64[np.ndarray, "*n"]:
        """Evaluate |h|², power per unit of distance, float64 [*n]; with integral 1, it preserves cross-sections.

        Distances from the peak, float64 [*n], are in 3 dB widths; or in any unit with the `variance`, in that unit
        squared, of the Gaussian of the same 3 dB width.
        """
        places, power, _ = self._lobes
        area = ((power[1:] + power[:-1]) * np.diff(places)).sum()
        width = width_of(variance)
        return np.interp(np.abs(distance) / width, places, power, right=0.0) / (area * width)

    def amplitude(self, distance: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Evaluate h relative to its peak, at distances in 3 dB widths: √|h|², whose sign alternates between lobes.

        That is the response of a symmetric window without phase errors, which crosses zero between its lobes.
        """
        places, power, _ = self._lobes
        falls, rises = power[1:-1] < power[:-2], power[2:] >= power[1:-1]
        zeros = np.flatnonzero(falls & rises) + 1
        sign = 1 - 2 * (np.searchsorted(zeros, np.arange(len(power))) % 2)
        return np.interp(np.abs(distance), places, sign * np.sqrt(power), right=0.0)

    def side_lobes(self, distance: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Evaluate the side lobes alone, relative to the main lobe's peak, at distances ≥ 0 in 3 dB widths."""
        places, power, own = self._lobes
        return np.interp(distance, places, np.where(np.arange(len(power)) < own, 0.0, power), right=0.0)

    def as_dict(self) -> dict[str, Any]:
        """Return kind and settings for JSON; `response_of` reads them."""
        return {"kind": self.kind} | {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]


@dataclass(frozen=True)
class Gaussian(Response):
    """Gaussian response, without side lobes; the renderer uses that of the same 3 dB width for every response."""

    kind = "gaussian"

    def table(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return distances in standard deviations, and the power there."""
        distance = np.linspace(0.0, _SIGMAS, 513)
        return distance, np.exp(-(distance**2) / 2)

    def density(
        self, distance: Float64[np.ndarray, "*n"], variance: float = variance_of(1.0)
    ) -> Float64[np.ndarray, "*n"]:
        """Evaluate |h|² in closed form."""
        return np.exp(-(distance**2) / (2 * variance)) / math.sqrt(2 * math.pi * variance)


GAUSSIAN = Gaussian()
"""Default response."""
