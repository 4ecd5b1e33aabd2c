"""Values as colours, and the colour bar that explains them."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Real, UInt8

from sarsplat.colours import DARK, gradient, over, rgb


@dataclass(frozen=True)
class Scale:
    """How numbers of one kind are coloured.

    Parameters
    ----------
    label : str
        What they are, with their unit.
    low, high : float
        Values of the first and the last colour; values beyond are clipped.
    colours : str
        Name of the ramp (colours.py).
    """

    label: str
    low: float
    high: float
    colours: str

    def rgb(self, values: Real[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
        """Colours of values, on a dark panel; NaN is nearly as dark."""
        width = self.high - self.low
        parts = (np.asarray(values, np.float64) - self.low) / (width if width > 0 else 1.0)
        finite = np.isfinite(parts)
        index = np.rint(255 * np.clip(np.where(finite, parts, 0), 0, 1)).astype(np.uint8)
        colours: UInt8[np.ndarray, "*shape 3"] = over(self.colours, DARK.card)[index]
        return np.where(finite[..., None], colours, np.array(rgb(DARK.line), np.uint8))

    def bar(self) -> str:
        """A colour bar with numbers at its ends and in the middle, as HTML."""
        digits = 0 if self.high - self.low >= 8 else 1 if self.high - self.low >= 1 else 2
        places = (self.low, (self.low + self.high) / 2, self.high)
        numbers = "".join(f"<span>{place:.{digits}f}</span>".replace("-", "−") for place in places)
        return (
            f'<div style="margin:2px 0 6px"><div style="font-size:12px;opacity:.8">{escape(self.label)}</div>'
            f'<div style="height:9px;border-radius:2px;background:{gradient(self.colours)},{DARK.card}"></div>'
            '<div style="display:flex;justify-content:space-between;font-size:11px;opacity:.8">'
            f"{numbers}</div></div>"
        )
