"""Colour maps of pictures: legible on light and on dark pages, and told apart by colour-blind readers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

GREY = ("#000000", "#ffffff")
"""Power: dark is weak."""

HEIGHT = ("#4b5bbf", "#2a9d8f", "#d9a01b")
"""Of lightnesses that stand out from white and from black."""

DISTANCE = ("#7f8fa3", "#e69f00", "#c51b7d")
"""Errors without a sign: grey is none."""

TOO_DARK, TOO_BRIGHT = "#8f6be0", "#e66101"
"""Errors with a sign: each is the more opaque the larger the error is, so that none looks like the page."""

_FAINTER = 1.5

Palette = UInt8[np.ndarray, "256 4"]
"""Red, green, blue and opacity of the 256 indices of a picture."""


def channels(colour: str) -> Float[np.ndarray, " 3"]:
    """Red, green and blue, 0 to 255, of `#rrggbb`."""
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], dtype=float)


def palette(stops: tuple[str, ...], *, hollow: bool = False) -> Palette:
    """Colours through evenly spaced stops, opaque; `hollow` makes index 0 transparent: nothing is there."""
    corners = np.array([channels(stop) for stop in stops])
    places = np.linspace(0, len(stops) - 1, 256)
    colours = [np.interp(places, np.arange(len(stops)), corners[:, channel]) for channel in range(3)]
    opacity = np.full(256, 255.0)
    opacity[0] = 0 if hollow else 255
    return np.stack([*colours, opacity], axis=1).round().astype(np.uint8)


def diverging() -> Palette:
    """From `TOO_DARK` through nothing to `TOO_BRIGHT`; small errors are fainter than in proportion."""
    signed = np.linspace(-1, 1, 256)[:, None]
    colours = np.where(signed < 0, channels(TOO_DARK), channels(TOO_BRIGHT))
    return np.concatenate([colours, 255 * np.abs(signed) ** _FAINTER], axis=1).round().astype(np.uint8)


def gradient(colours: Palette) -> str:
    """The palette as a CSS gradient from left to right."""
    some = colours[np.linspace(0, 255, 9).astype(int)]
    return f"linear-gradient(90deg, {', '.join(f'rgb({r} {g} {b} / {a / 255:.2f})' for r, g, b, a in some)})"
