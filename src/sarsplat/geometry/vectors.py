"""Directions and places that users give: three numbers, or many times three."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError, shown


def direction_of(value: object, what: str) -> Float64[np.ndarray, " 3"]:
    """Three finite numbers that are not all zero, float64; `what` is what an error calls them."""
    vector = _numbers(value)
    if vector is None or vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        plain = value.tolist() if isinstance(value, np.ndarray) else value
        raise SarsplatError(f"the {what} {shown(plain)} has no direction; give three numbers, not all 0")
    return vector


def places_of(value: object, what: str) -> Float64[np.ndarray, "*n 3"]:
    """Any number of three numbers each, float64; `what` is what an error calls them."""
    places = _numbers(value)
    if places is None or places.shape[-1:] != (3,):
        plain = f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else shown(value)
        raise SarsplatError(f"the {what} are {plain}; give an array of numbers whose last axis has three")
    return places


def _numbers(value: object) -> Float64[np.ndarray, "*shape"] | None:
    """An array of real numbers; None if it is none, or holds text or True and False."""
    if isinstance(value, Iterable) and not hasattr(value, "dtype"):
        value = [*value]
        if any(isinstance(one, bool | str) for one in value):
            return None
    try:
        array = np.asarray(value)
        return None if array.dtype.kind not in "iufO" else array.astype(np.float64)
    except (TypeError, ValueError):
        return None
