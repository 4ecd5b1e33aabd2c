"""Training views that stand as evenly around the target as the images allow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment


def nearest_to(azimuths_deg: Sequence[float], wanted_deg: Sequence[float]) -> list[int]:
    """Distinct images nearest to the azimuths that are wanted, one for each, in their order.

    Parameters
    ----------
    azimuths_deg : sequence of float
        Of the images, degrees; at least as many as are wanted.
    wanted_deg : sequence of float
        Degrees.

    Notes
    -----
    The total distance is the least possible: where two azimuths want the same image, they share out.
    """
    apart = np.subtract.outer(np.asarray(wanted_deg, dtype=float), np.asarray(azimuths_deg, dtype=float))
    _, chosen = linear_sum_assignment(np.abs((apart + 180) % 360 - 180))
    return [int(index) for index in chosen]
