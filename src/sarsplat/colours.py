"""Every colour that has a meaning, once, for report, viewer, figures and exports.

Ramps are legible on light and dark pages, and colour-blind readers can distinguish them. Their names are those below,
or names of colour maps in matplotlib.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from sarsplat.errors import SarsplatError, shown

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

Palette = UInt8[np.ndarray, "256 4"]
"""Red, green, blue and opacity of the 256 indices of a picture."""

# ---- ramps: their names ----------------------------------------------------------------------------------------------
POWER = "gray"
"""Power in decibels: dark is weak."""

POWER_RAMPS = (POWER, "cividis", "viridis", "inferno", "magma")
"""Alternatives for power that readers may choose: their brightness rises evenly."""

HEIGHT = "height"
"""Height z, from blue (low) to yellow (high), visible against white and against black."""

ERROR = "error"
"""Distance to the true surface, or another error without a sign: grey is none."""

DIFFERENCE = "difference"
"""Errors with a sign: the larger the error, the more opaque; zero is transparent."""

STRENGTH = "inferno"
"""γ⁰ of points in the world, on a dark background."""

INCIDENCE, SPREAD = "cividis", "inferno"
"""Radar maps: local incidence angle, and how far apart along elevation scatterers of one pixel lie."""

PHASE = "twilight"
"""Phases: the colours of −π and π are the same."""

COHERENCE = "viridis"
"""Coherence, from 0 to 1."""

TOO_DARK, TOO_BRIGHT = "#8f6be0", "#e66101"
DIFFERENCE_IN_WORDS = "orange: too bright, purple: too dark"

_STOPS = {
    POWER: ("#000000", "#ffffff"),
    HEIGHT: ("#4b5bbf", "#2a9d8f", "#d9a01b"),
    ERROR: ("#7f8fa3", "#e69f00", "#c51b7d"),
}
_FAINTER = 1.5  # small differences are disproportionately faint


# ---- classes ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Page:
    """Colours of a page: background, panels, text, lines, training and test sets."""

    ground: str
    card: str
    ink: str
    muted: str
    line: str
    train: str
    test: str


LIGHT = Page("#f6f7f9", "#ffffff", "#17202b", "#55626f", "#dfe4ea", "#0a6fb8", "#b45309")
DARK = Page("#0b0f14", "#10151c", "#e3e9f1", "#9aa8b9", "#2a3441", "#5cc8ff", "#ffb454")

TARGET, SHADOW, LAYOVER = "#ffb454", "#5cc8ff", "#d6569c"
"""Classes of pixels, outlined on images and filled in radar maps."""

TRUE, PREDICTED = "#0b84d8", "#e66101"
"""Outlines of true and predicted masks."""

RADAR, PICKED = "#ff5c46", "#c8f04a"
"""The radar in the viewer, and the picked pixel with everything that contributes to it."""


@cache
def ramp(name: str) -> Palette:
    """The 256 colours of a ramp, or of a colour map of matplotlib; refuses unknown names."""
    if name == DIFFERENCE:
        signed = np.linspace(-1, 1, 256)[:, None]
        colours = np.where(signed < 0, rgb(TOO_DARK), rgb(TOO_BRIGHT))
        return np.concatenate([colours, 255 * np.abs(signed) ** _FAINTER], axis=1).round().astype(np.uint8)
    if name in _STOPS:
        corners = np.array([rgb(stop) for stop in _STOPS[name]], dtype=float)
        places = np.linspace(0, len(corners) - 1, 256)
        channels = [np.interp(places, np.arange(len(corners)), channel) for channel in corners.T]
        return np.stack([*channels, np.full(256, 255.0)], axis=1).round().astype(np.uint8)
    try:
        from matplotlib import colormaps
    except ImportError as error:
        raise SarsplatError(
            "colours need matplotlib, which is not installed; install it with: pip install 'sarsplat[report]'"
        ) from error
    if name not in colormaps:
        raise SarsplatError(
            f"there is no colour map {shown(name)}; choose gray, viridis, magma, cividis, turbo or another from "
            "matplotlib"
        )
    return np.round(255 * colormaps[name](np.linspace(0, 1, 256))).astype(np.uint8)


def hollow(name: str) -> Palette:
    """The ramp with index 0 transparent, for pixels without data."""
    colours = ramp(name).copy()
    colours[0, 3] = 0
    return colours


def over(name: str, background: str) -> UInt8[np.ndarray, "256 3"]:
    """The ramp as it looks in front of a background."""
    opacity: Float[np.ndarray, "256 1"] = ramp(name)[:, 3:] / 255
    return np.round(ramp(name)[:, :3] * opacity + np.array(rgb(background)) * (1 - opacity)).astype(np.uint8)


def gradient(name: str) -> str:
    """The ramp as a CSS gradient from left to right."""
    stops = ramp(name)[np.linspace(0, 255, 9).astype(int)].tolist()
    return f"linear-gradient(90deg, {', '.join(f'rgb({r} {g} {b} / {a / 255:.2f})' for r, g, b, a in stops)})"


def colormap(name: str) -> Colormap:
    """The ramp as a colour map of matplotlib."""
    from matplotlib.colors import ListedColormap

    return ListedColormap(ramp(name) / 255, name)


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of `#rrggbb`."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
