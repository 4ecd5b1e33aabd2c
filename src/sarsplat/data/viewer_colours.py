"""Colours of Gaussians for viewers of 3D Gaussian splatting.

A viewer shows max(0, ½ + Σ_k h_k Y_k) in each channel at the direction from the camera. Scattering spans decades, so
greys show decibels, over the range of most Gaussians. Directions below the horizon, where no radar looked, resemble the
mirror image of those above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64

from sarsplat.colours import HEIGHT, ramp
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.law_harmonics import CONSTANTS, harmonic_basis
from sarsplat.names import Colour
from sarsplat.radiometry import to_db

ODD = (1, 2, 3, 9, 10, 11, 12, 13, 14, 15)
"""Harmonics of degree 1 and 3, which change sign with the direction."""

_DIRECTIONS = 200  # number of directions above the horizon to which harmonics are fitted
_SPAN = (0.1, 0.995)  # quantiles of γ⁰ or height shown black and white, so that a glint does not darken everything else
_DARKEST = 0.08  # minimum shade, visible before a black background
_BELOW = 0.03  # weight of the mirror image below the horizon
_DEGREE = 3
_SAMPLE = 20_000  # number of Gaussians from which the range of γ⁰ is estimated
_BATCH = 4096  # Gaussians at once


@dataclass(frozen=True)
class ViewerColours:
    """Colours of N Gaussians in the convention of viewers."""

    harmonics: Float32[np.ndarray, "n 3 16"]
    """Coefficients of degree 3 for each channel, for the direction from the camera."""
    mean: Float32[np.ndarray, "n 3"]
    """Mean colour over all directions, 0 to 1, for formats with one colour only."""
    legend: str
    """Text: the values of black and white, or of both ends of the colour ramp."""


def viewer_colours(gaussians: Gaussians, colour: Colour = "db") -> ViewerColours:
    """Return greys by γ⁰ in decibels towards the camera, or colours by height; rounded, so that calls agree."""
    if colour == "height":
        height = gaussians.means[:, 2].detach().double().cpu().numpy()
        low, high = _span(height, _weight(gaussians))
        mean = ramp(HEIGHT)[np.round(np.interp(height, (low, high), (0, 255))).astype(int), :3] / 255
        constant = np.zeros((len(mean), 3, len(CONSTANTS)))
        constant[:, :, 0] = (mean - 0.5) / CONSTANTS[0]
        return _rounded(constant, mean, f"colours: height, blue = {low:.3g} m, yellow = {high:.3g} m")
    directions = _hemisphere()
    sample = gaussians[:: math.ceil(len(gaussians) / _SAMPLE) or 1]
    level_db = _level_db(sample, directions)
    low, high = _span(level_db, np.broadcast_to(_weight(sample), level_db.shape))
    above, below = (harmonic_basis(torch.from_numpy(u), _DEGREE).numpy() for u in (directions, directions * (1, 1, -1)))
    moments = above.T @ above + _BELOW * below.T @ below
    grey, mean = np.empty((len(gaussians), len(moments))), np.empty(len(gaussians))
    for first in range(0, len(gaussians), _BATCH):
        part = slice(first, first + _BATCH)
        shade = np.interp(_level_db(gaussians[part], directions), (low, high), (_DARKEST, 1.0))
        right_side = (above + _BELOW * below).T @ (shade - 0.5)  # viewers add ½
        grey[part], mean[part] = np.linalg.solve(moments, right_side).T, shade.mean(axis=0)
    grey[:, ODD] *= -1  # directions from the camera are opposite to directions to the radar
    black = low - _DARKEST / (1 - _DARKEST) * (high - low)
    return _rounded(
        np.repeat(grey[:, None], 3, axis=1),
        np.repeat(mean[:, None], 3, axis=1),
        f"colours: gamma0 in dB, black = {black:.3g} dB, white = {high:.3g} dB",
    )


def _level_db(gaussians: Gaussians, directions: Float64[np.ndarray, "v 3"]) -> Float64[np.ndarray, "v n"]:
    """Return γ⁰ in these directions, dB."""
    with torch.no_grad():
        return to_db(gaussians.detach().to("cpu").to(torch.float64).gamma0(torch.from_numpy(directions)).numpy())


def _rounded(harmonics: Float64[np.ndarray, "n 3 16"], mean: Float64[np.ndarray, "n 3"], legend: str) -> ViewerColours:
    return ViewerColours(np.round(harmonics, 6).astype(np.float32) + 0, np.round(mean, 6).astype(np.float32), legend)


def _hemisphere() -> Float64[np.ndarray, "v 3"]:
    """Return directions above the horizon on a spiral, evenly spread."""
    golden, index = math.pi * (3 - math.sqrt(5)), np.arange(_DIRECTIONS)
    z = (index + 0.5) / _DIRECTIONS
    ring = np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(golden * index), ring * np.sin(golden * index), z])


def _weight(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """Return the visual weight of each Gaussian: its opacity times its largest cross-section."""
    scales = gaussians.scales.detach().double().cpu().numpy()
    area = np.sort(scales, axis=1)[:, 1:].prod(axis=1)
    return area * -np.expm1(-gaussians.optical_depth.detach().double().cpu().numpy())


def _span(values: Float[np.ndarray, "*any"], weight: Float[np.ndarray, "*any"]) -> tuple[float, float]:
    """Return the range of values that holds most of the weight; its ends always differ."""
    values, weight = values.ravel(), weight.ravel()
    if not weight.any():
        return 0.0, 1.0
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weight[order]) / weight.sum()
    low, high = (float(values[order][np.searchsorted(share, part)]) for part in _SPAN)
    return (low, high) if high - low > 1e-3 else (low - 0.5, high + 0.5)
