"""Conversion of users' directions and points to float64 arrays."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError, shown


def direction_of(value: object, what: str) -> Float64[np.ndarray, " 3"]:
    """Return a direction as float64 [3], finite and not zero; `what` names it in errors."""
    vector = _numbers(value)
    if vector is None or vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        plain = value.tolist() if isinstance(value, np.ndarray) else value
        raise SarsplatError(f"the {what} {shown(plain)} has no direction; give three numbers, not all 0")
    return vector


def places_of(value: object, what: str) -> Float64[np.ndarray, "*n 3"]:
    """Return points as float64 [..., 3]; `what` names them in errors."""
    places = _numbers(value)
    if places is None or places.shape[-1:] != (3,):
        plain = f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else shown(value)
        raise SarsplatError(f"the {what} are {plain}; give an array of numbers whose last axis has three")
    return places


def _numbers(value: object) -> Float64[np.ndarray, "*shape"] | None:
    """Return real numbers as float64, or None for anything else, including text and booleans."""
    if isinstance(value, Iterable) and not hasattr(value, "dtype"):
        value = [*value]
        if any(isinstance(one, bool | str) for one in value):
            return None
    try:
        array = np.asarray(value)
        return None if array.dtype.kind not in "iufO" else array.astype(np.float64)
    except (TypeError, ValueError):
        return None
