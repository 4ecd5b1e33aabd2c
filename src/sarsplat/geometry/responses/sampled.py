"""Tabulated response, such as one measured at a corner reflector."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.responses.response import Response


@dataclass(frozen=True)
class Sampled(Response):
    """Response whose power is linear between samples.

    Parameters
    ----------
    distances : sequence of float
        Distances from the peak, rising from 0, in any unit: only the shape counts.
    powers : sequence of float
        Power at these distances, in any unit, ≥ 0; the first is the largest, and the last is below half of it.

    Raises
    ------
    SarsplatError
        If the table is invalid.
    """

    kind = "sampled"
    distances: Sequence[float]
    powers: Sequence[float]

    def __post_init__(self) -> None:
        try:
            distance, power = table = np.array([self.distances, self.powers], np.float64)
            ordered = distance[0] == 0 and (np.diff(distance) > 0).all() and power[0] == power.max()
            valid = np.isfinite(table).all() and ordered and power.min() >= 0 and power[-1] < power[0] / 2
        except (IndexError, TypeError, ValueError):
            valid = False
        if not valid:
            given = " and powers ".join(" ".join(shown(values).split()) for values in (self.distances, self.powers))
            raise SarsplatError(
                f"distances {given} are not a sampled response; give as many of both: distances rising from 0, and "
                "power ≥ 0 that is largest there and ends below half of that"
            )
        object.__setattr__(self, "distances", tuple(distance.tolist()))  # hashable, and valid in JSON
        object.__setattr__(self, "powers", tuple(power.tolist()))

    def table(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return the samples."""
        return np.array(self.distances), np.array(self.powers)
