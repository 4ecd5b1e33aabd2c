"""Power as amplitude and in decibels, β⁰ as σ⁰ and γ⁰ of flat ground, and the range of power that pictures show.

Power is a numpy array or a number; conversions between β⁰, σ⁰ and γ⁰ accept torch tensors as well.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Real

__all__ = [
    *("DYNAMIC_RANGE_DB", "amplitude", "beta0_of_gamma0", "beta0_of_sigma0", "bright_level", "brighter"),
    *("difference_db", "from_db", "gamma0_of_beta0", "shade", "sigma0_of_beta0", "to_db", "usual_peak", "white_level"),
]

DYNAMIC_RANGE_DB = 40.0
"""Pictures show this range below the brightest training pixel (`white_level`), dB; anything darker is black."""

LEAST_POWER = float(np.finfo(np.float32).tiny)
"""Smaller powers count as this one in decibels (−379 dB), so that nothing is −inf."""

Power = TypeVar("Power", bound=Any)
"""A number, an array or a tensor."""


def to_db(
    power: Real[np.ndarray, "*shape"] | float | np.floating[Any], reference: Any = 1.0, least: float = LEAST_POWER
) -> Any:
    """10·log10(power / reference), dB, float64 [*shape].

    Parameters
    ----------
    power : numpy.ndarray [*shape] or float
        Linear power, at least 0.
    reference : numpy.ndarray or float
        What 0 dB is, linear.
    least : float
        Smaller quotients count as this one; with 0, zero power is −inf dB.
    """
    quotient = np.maximum(np.asarray(power, dtype=np.float64) / reference, least)
    with np.errstate(divide="ignore"):
        return 10 * np.log10(quotient)


def from_db(level_db: Power) -> Power:
    """Linear power of decibels: 10^(dB / 10)."""
    power: Power = 10 ** (level_db / 10)
    return power


def amplitude(power: Real[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """√power."""
    return np.sqrt(power)


def beta0_of_gamma0(gamma0: Power, grazing_deg: float) -> Power:
    """β⁰ of flat ground with this γ⁰, both linear: γ⁰·tan(grazing)."""
    return gamma0 * math.tan(math.radians(grazing_deg))


def gamma0_of_beta0(beta0: Power, grazing_deg: float) -> Power:
    """γ⁰ of flat ground with this β⁰, both linear: β⁰ / tan(grazing)."""
    return beta0 / math.tan(math.radians(grazing_deg))


def beta0_of_sigma0(sigma0: Power, grazing_deg: float) -> Power:
    """β⁰ of flat ground with this σ⁰, both linear: σ⁰ / cos(grazing)."""
    return sigma0 / math.cos(math.radians(grazing_deg))


def sigma0_of_beta0(beta0: Power, grazing_deg: float) -> Power:
    """σ⁰ of flat ground with this β⁰, both linear: β⁰·cos(grazing)."""
    return beta0 * math.cos(math.radians(grazing_deg))


def bright_level(power: Real[np.ndarray, "*pixels"]) -> float:
    """Level that the brightest 0.1 % of pixels exceed, so that a corner reflector does not darken the rest; never 0."""
    return float(np.quantile(power, 0.999)) or float(power.max()) or 1.0


def white_level(power: Real[np.ndarray, "*pixels"]) -> float:
    """What pictures show as white: the largest power, but no more than 20 dB above the brightest 0.1 %; never 0.

    Of sets of targets the largest is 2 dB to 11 dB above these, so that only what outshines all is cut off, such as
    corner reflectors, beside which a target would be black. A single scatterer on nothing has less than 0.1 % of the
    pixels: its own response is not cut off, by the quarter of the echoes that is the brightest.
    """
    if not power.size:
        return 1.0
    echoes = power[power > 0]
    bright = max(bright_level(power), float(np.quantile(echoes, 0.75)) if echoes.size else 0.0)
    return min(float(power.max(initial=0.0)), 100.0 * bright) or 1.0


def usual_peak(power: Real[np.ndarray, "*values"]) -> float:
    """The largest power; or a lower level, if few echoes outshine all others by far, as corner reflectors do.

    The level is 20 dB above what a quarter of all echoes exceed that are less than 60 dB below it. It depends neither
    on how much of an image is empty, nor on how bright the few are. Of targets alone, the largest power of an image is
    4 dB to 20 dB above that quarter, so that it is the largest.
    """
    peak = float(power.max(initial=0.0))
    while True:
        echoes = power[power > 1e-6 * peak]
        level = 100.0 * float(np.quantile(echoes, 0.75)) if echoes.size else 0.0
        if not 0 < level < peak:
            return peak
        peak = level


def shade(
    power: Real[np.ndarray, "*pixels"], peak: float, range_db: float = DYNAMIC_RANGE_DB
) -> Float[np.ndarray, "*pixels"]:
    """Brightness in a picture, linear in decibels: 1 at `peak` and above, 0 at `range_db` below it and darker."""
    return np.clip(1 + to_db(power, peak) / range_db, 0, 1)


def brighter(power: Real[np.ndarray, "*pixels"], level_db: float, peak: Any = None) -> Bool[np.ndarray, "*pixels"]:
    """Where power exceeds `level_db` (negative: below) of `peak`, by default of the brightest of all pixels."""
    return power > (power.max() if peak is None else peak) * from_db(level_db)


def difference_db(
    rendered: Real[np.ndarray, "*pixels"], truth: Real[np.ndarray, "*pixels"], peak: float, darkest_db: float
) -> Float[np.ndarray, "*pixels"]:
    """Rendered over true power, dB; all power below `darkest_db` of the peak counts as that."""
    floor = peak * from_db(darkest_db)
    return to_db(np.maximum(rendered, floor)) - to_db(np.maximum(truth, floor))
