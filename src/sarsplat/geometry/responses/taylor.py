"""Response of an aperture and a band with Taylor weighting, which nearly all radars use."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from sarsplat.arguments import is_number
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.responses.response import Response

_SAMPLES, _FINE = 512, 16  # samples of the aperture, and of the response per 1/extent


@dataclass(frozen=True)
class Taylor(Response):
    """Response of a Taylor window (Carrara, Goodman and Majewski, Spotlight Synthetic Aperture Radar, appendix D).

    Parameters
    ----------
    level_db : float
        Level of the side lobes, dB below the main lobe: 10 to 100.
    sidelobes : int
        n̄: side lobes up to the (n̄ − 1)th are equally high, those beyond fall off; 1 to 64. 1 means no weighting.

    Raises
    ------
    SarsplatError
        If one of them is out of range.
    """

    kind = "taylor"
    level_db: float = 35.0
    sidelobes: int = 4

    def __post_init__(self) -> None:
        level, count = self.level_db, self.sidelobes
        in_range = is_number(level) and 10 <= level <= 100 and type(count) is int and 1 <= count <= 64
        if not in_range:  # also catches NaN
            raise SarsplatError(
                f"a Taylor response of level_db {shown(level)} and sidelobes {shown(count)} is not possible; give 10 "
                "to 100 dB and a whole number from 1 to 64"
            )
        object.__setattr__(self, "level_db", float(self.level_db))

    def window(self, places: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return weights, of mean 1, at places from −½ to ½ of the aperture or band."""
        a2 = (math.acosh(10 ** (self.level_db / 20)) / math.pi) ** 2
        sigma2 = self.sidelobes**2 / (a2 + (self.sidelobes - 0.5) ** 2)
        orders = np.arange(1, self.sidelobes)
        weights = np.ones_like(places)
        for m in orders:
            others = orders[orders != m]
            zeros = np.prod(1 - m**2 / (sigma2 * (a2 + (orders - 0.5) ** 2)))
            weights -= (-1) ** m * zeros / np.prod(1 - (m / others) ** 2) * np.cos(2 * math.pi * m * places)
        return weights

    def table(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return distances in units of 1/(_FINE·extent), and the power there."""
        power = self._power(_FINE)
        return np.arange(len(power), dtype=np.float64), power

    @cached_property
    def width(self) -> float:
        """3 dB width in units of 1/extent: of a band B it is `width`·c/2B."""
        fine = 64 * _FINE
        power = self._power(fine)[: fine + 1]
        return 2 * float(np.interp(-0.5, -power, np.arange(fine + 1))) / fine

    def _power(self, fine: int) -> Float64[np.ndarray, " n"]:
        """Return the power at multiples of 1/(`fine`·extent), 1 at the peak."""
        window = self.window((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5)
        return (np.abs(np.fft.rfft(window, _SAMPLES * fine)) / window.sum()) ** 2


TAYLOR = Taylor()
"""Most common response, MSTAR's included."""

UNIFORM = Taylor(level_db=13.26, sidelobes=1)
"""Response of an unweighted aperture, the narrowest."""
