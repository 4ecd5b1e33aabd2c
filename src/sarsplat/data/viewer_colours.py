"""Colours of Gaussians for viewers of 3D Gaussian splatting, which know colours but no γ⁰.

A viewer shows max(0, ½ + Σ_k h_k Y_k) in each channel, as it stands, at the direction from the camera. Scattering
spans decades, so what it is shown are decibels: grey from black to white over most of what there is. A viewer also
turns below the horizon, where no radar looked: what it sees there resembles the mirror image of what is above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64

from sarsplat.colours import HEIGHT, ramp
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.harmonics import CONSTANTS, harmonic_basis
from sarsplat.names import Colour
from sarsplat.radiometry import to_db

ODD = (1, 2, 3, 9, 10, 11, 12, 13, 14, 15)
"""Harmonics of degree 1 and 3: those that change sign with the direction."""

_DIRECTIONS = 200  # above the horizon
_SPAN = (0.1, 0.995)  # of all that is seen: black and white; a glint must not darken everything else
_DARKEST = 0.08  # of a shade: what is dark stays visible before a black background
_BELOW = 0.03  # weight of the mirror image below the horizon
_DEGREE = 3
_SAMPLE = 20_000  # Gaussians that tell the span of what is seen
_AT_ONCE = 4096  # Gaussians


@dataclass(frozen=True)
class ViewerColours:
    """Colours of N Gaussians as a viewer takes them."""

    harmonics: Float32[np.ndarray, "n 3 16"]
    """Coefficients of degree 3 for each channel, for the direction from the camera."""
    mean: Float32[np.ndarray, "n 3"]
    """Mean colour over all directions, 0 to 1, for formats with one colour only."""
    legend: str
    """What black and white, or the ends of the colours, stand for."""


def viewer_colours(gaussians: Gaussians, colour: Colour = "db") -> ViewerColours:
    """Greys by γ⁰ in decibels towards the camera, or colours by height; rounded, to be the same in every call."""
    if colour == "height":
        height = gaussians.means[:, 2].detach().double().cpu().numpy()
        low, high = _span(height, _weight(gaussians))
        mean = ramp(HEIGHT)[np.round(np.interp(height, (low, high), (0, 255))).astype(int), :3] / 255
        constant = np.zeros((len(mean), 3, len(CONSTANTS)))
        constant[:, :, 0] = (mean - 0.5) / CONSTANTS[0]
        return _rounded(constant, mean, f"colours: height, blue = {low:.3g} m, yellow = {high:.3g} m")
    directions = _hemisphere()
    some = gaussians[:: math.ceil(len(gaussians) / _SAMPLE) or 1]
    level_db = _level_db(some, directions)
    low, high = _span(level_db, np.broadcast_to(_weight(some), level_db.shape))
    above, below = (harmonic_basis(torch.from_numpy(u), _DEGREE).numpy() for u in (directions, directions * (1, 1, -1)))
    moments = above.T @ above + _BELOW * below.T @ below
    grey, mean = np.empty((len(gaussians), len(moments))), np.empty(len(gaussians))
    for first in range(0, len(gaussians), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        shade = np.interp(_level_db(gaussians[part], directions), (low, high), (_DARKEST, 1.0))
        wanted = (above + _BELOW * below).T @ (shade - 0.5)  # ½ is what viewers add
        grey[part], mean[part] = np.linalg.solve(moments, wanted).T, shade.mean(axis=0)
    grey[:, ODD] *= -1  # the direction from the camera is opposite to that to the radar
    black = low - _DARKEST / (1 - _DARKEST) * (high - low)
    return _rounded(
        np.repeat(grey[:, None], 3, axis=1),
        np.repeat(mean[:, None], 3, axis=1),
        f"colours: gamma0 in dB, black = {black:.3g} dB, white = {high:.3g} dB",
    )


def _level_db(gaussians: Gaussians, directions: Float64[np.ndarray, "v 3"]) -> Float64[np.ndarray, "v n"]:
    """γ⁰ towards these directions, dB."""
    with torch.no_grad():
        return to_db(gaussians.detach().to("cpu").to(torch.float64).gamma0(torch.from_numpy(directions)).numpy())


def _rounded(harmonics: Float64[np.ndarray, "n 3 16"], mean: Float64[np.ndarray, "n 3"], legend: str) -> ViewerColours:
    return ViewerColours(np.round(harmonics, 6).astype(np.float32) + 0, np.round(mean, 6).astype(np.float32), legend)


def _hemisphere() -> Float64[np.ndarray, "v 3"]:
    """A spiral of directions above the horizon, evenly spread."""
    golden, index = math.pi * (3 - math.sqrt(5)), np.arange(_DIRECTIONS)
    z = (index + 0.5) / _DIRECTIONS
    ring = np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(golden * index), ring * np.sin(golden * index), z])


def _weight(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """Visual weight of each Gaussian: its opacity times its largest cross-section."""
    scales = gaussians.scales.detach().double().cpu().numpy()
    area = np.sort(scales, axis=1)[:, 1:].prod(axis=1)
    return area * -np.expm1(-gaussians.optical_depth.detach().double().cpu().numpy())


def _span(values: Float[np.ndarray, "*any"], weight: Float[np.ndarray, "*any"]) -> tuple[float, float]:
    """The range of values that holds most of the weight; its ends always differ."""
    values, weight = values.ravel(), weight.ravel()
    if not weight.any():
        return 0.0, 1.0
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weight[order]) / weight.sum()
    low, high = (float(values[order][np.searchsorted(share, part)]) for part in _SPAN)
    return (low, high) if high - low > 1e-3 else (low - 0.5, high + 0.5)
