"""Values as colours, and the bar that says which is which."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Real, UInt8

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

POWER_MAPS = ("gray", "cividis", "viridis", "inferno", "magma")
"""For power in decibels, by matplotlib's names: all grow evenly in brightness."""

DIFFERENCE = "difference"
"""For differences: blue below zero, dark at zero, orange above."""

_DIVERGING = ("#a8e4ff", "#2b7fd0", "#12161c", "#d0602b", "#ffd9a8")

_NOTHING = (38, 44, 52)
"""Where there is no value."""

_STOPS = 9  # of a bar


@dataclass(frozen=True)
class Scale:
    """How numbers of one kind are coloured.

    Parameters
    ----------
    label : str
        What they are, with their unit.
    low, high : float
        Numbers of the first and the last colour; what is beyond looks alike.
    colours : str
        Name of the colour map in matplotlib, or `DIFFERENCE`.
    """

    label: str
    low: float
    high: float
    colours: str

    def rgb(self, values: Real[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
        """Colours of values; NaN is dark."""
        width = self.high - self.low
        parts = (np.asarray(values, np.float64) - self.low) / (width if width > 0 else 1.0)
        known = np.isfinite(parts)
        index = np.rint(255 * np.clip(np.where(known, parts, 0), 0, 1)).astype(np.uint8)
        found: UInt8[np.ndarray, "*shape 3"] = _table(self.colours)[index]
        return np.where(known[..., None], found, np.array(_NOTHING, np.uint8))

    def bar(self) -> str:
        """A colour bar with numbers at its ends and in the middle, as HTML."""
        table = _table(self.colours)
        stops = ", ".join(f"rgb({r},{g},{b})" for r, g, b in table[np.linspace(0, 255, _STOPS).astype(int)].tolist())
        numbers = "".join(f"<span>{number}</span>" for number in self._numbers())
        return (
            f'<div style="margin:2px 0 6px"><div style="font-size:12px;opacity:.8">{escape(self.label)}</div>'
            f'<div style="height:9px;border-radius:2px;background:linear-gradient(90deg,{stops})"></div>'
            '<div style="display:flex;justify-content:space-between;font-size:11px;opacity:.8">'
            f"{numbers}</div></div>"
        )

    def _numbers(self) -> list[str]:
        middle = (self.low + self.high) / 2
        digits = 0 if self.high - self.low >= 8 else 1 if self.high - self.low >= 1 else 2
        return [f"{value:.{digits}f}".replace("-", "−") for value in (self.low, middle, self.high)]


@cache
def _table(name: str) -> UInt8[np.ndarray, "256 3"]:
    return np.rint(255 * _map(name)(np.arange(256))[:, :3]).astype(np.uint8)


def _map(name: str) -> Colormap:
    from matplotlib import colormaps

    from sarsplat.report.canvas import ramp

    return ramp(name, *_DIVERGING) if name == DIFFERENCE else colormaps[name]
