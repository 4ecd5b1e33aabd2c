"""Conversions of power to amplitude, decibels, σ⁰ and γ⁰ of flat ground, and the range that pictures show.

Power is a numpy array or a number; conversions between β⁰, σ⁰ and γ⁰ accept torch tensors as well.
"""

import math
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Real

__all__ = [
    *("DYNAMIC_RANGE_DB", "amplitude", "beta0_of_gamma0", "beta0_of_sigma0", "bright_level", "brighter"),
    *("difference_db", "from_db", "gamma0_of_beta0", "shade", "sigma0_of_beta0", "to_db", "usual_peak", "white_level"),
]

DYNAMIC_RANGE_DB = 40.0
"""Dynamic range of pictures below the brightest training pixel (`white_level`), dB."""

LEAST_POWER = float(np.finfo(np.float32).tiny)
"""Minimum power in decibels (−379 dB), instead of −inf."""

Power = TypeVar("Power", bound=Any)
"""A number, an array or a tensor."""


def to_db(
    power: Real[np.ndarray, "*shape"] | float | np.floating[Any], reference: Any = 1.0, least: float = LEAST_POWER
) -> Any:
    """Return 10·log10(power / reference), dB, float64 [*shape].

    Parameters
    ----------
    power : numpy.ndarray [*shape] or float
        Linear power, at least 0.
    reference : numpy.ndarray or float
        Power of 0 dB, linear.
    least : float
        Minimum quotient; with 0, zero power is −inf dB.
    """
    quotient = np.maximum(np.asarray(power, dtype=np.float64) / reference, least)
    with np.errstate(divide="ignore"):
        return 10 * np.log10(quotient)


def from_db(level_db: Power) -> Power:
    """Return the linear power of decibels: 10^(dB / 10)."""
    power: Power = 10 ** (level_db / 10)
    return power


def amplitude(power: Real[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return √power."""
    return np.sqrt(power)


def beta0_of_gamma0(gamma0: Power, grazing_deg: float) -> Power:
    """Return β⁰ of flat ground with this γ⁰, both linear: γ⁰·tan(grazing)."""
    return gamma0 * math.tan(math.radians(grazing_deg))


def gamma0_of_beta0(beta0: Power, grazing_deg: float) -> Power:
    """Return γ⁰ of flat ground with this β⁰, both linear: β⁰ / tan(grazing)."""
    return beta0 / math.tan(math.radians(grazing_deg))


def beta0_of_sigma0(sigma0: Power, grazing_deg: float) -> Power:
    """Return β⁰ of flat ground with this σ⁰, both linear: σ⁰ / cos(grazing)."""
    return sigma0 / math.cos(math.radians(grazing_deg))


def sigma0_of_beta0(beta0: Power, grazing_deg: float) -> Power:
    """Return σ⁰ of flat ground with this β⁰, both linear: β⁰·cos(grazing)."""
    return beta0 * math.cos(math.radians(grazing_deg))


def bright_level(power: Real[np.ndarray, "*pixels"]) -> float:
    """Return the 99.9 % quantile of the pixels, which a corner reflector does not raise; never 0."""
    return float(np.quantile(power, 0.999)) or float(power.max()) or 1.0


def white_level(power: Real[np.ndarray, "*pixels"]) -> float:
    """Return the power that pictures show as white: the largest, at most 20 dB above the brightest 0.1 %; never 0.

    In sets of targets the largest is 2 dB to 11 dB above these, so that only corner reflectors are clipped, beside
    which targets would be black. A single scatterer in an empty image has less than 0.1 % of the pixels; the brightest
    quarter of the echoes keeps it from being clipped.
    """
    if not power.size:
        return 1.0
    echoes = power[power > 0]
    bright = max(bright_level(power), float(np.quantile(echoes, 0.75)) if echoes.size else 0.0)
    return min(float(power.max(initial=0.0)), 100.0 * bright) or 1.0


def usual_peak(power: Real[np.ndarray, "*values"]) -> float:
    """Return the largest power, or a lower level if few echoes far outshine all others, as corner reflectors do.

    The level is 20 dB above the upper quartile of the echoes within 60 dB below it: independent of the empty share of
    an image and of the brightness of the few. For targets alone the largest power is 4 dB to 20 dB above that quartile,
    and is returned.
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
    """Return the brightness in a picture, linear in decibels: 1 from `peak`, 0 from `range_db` below it."""
    return np.clip(1 + to_db(power, peak) / range_db, 0, 1)


def brighter(power: Real[np.ndarray, "*pixels"], level_db: float, peak: Any = None) -> Bool[np.ndarray, "*pixels"]:
    """Return the mask of power above `level_db` relative to `peak`, by default that of all pixels."""
    return power > (power.max() if peak is None else peak) * from_db(level_db)


def difference_db(
    rendered: Real[np.ndarray, "*pixels"], truth: Real[np.ndarray, "*pixels"], peak: float, darkest_db: float
) -> Float[np.ndarray, "*pixels"]:
    """Return rendered over true power, dB, both at least `darkest_db` relative to the peak."""
    floor = peak * from_db(darkest_db)
    return to_db(np.maximum(rendered, floor)) - to_db(np.maximum(truth, floor))
