"""Figures of a page: panels with axes, and colour bars. `figure.html.j2` turns them into HTML.

Only the inside of a panel's frame is a picture or drawing; axes, scale bars and labels are text of the page, so they
keep their size on a phone and follow light and dark.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sarsplat.colours import gradient

_SIDE_UNITS = 1000  # side of a drawing


@dataclass(frozen=True)
class Axis:
    """Label with its unit, and ticks: positions from 0 (left or top) to 1 with their texts."""

    label: str
    ticks: tuple[tuple[float, str], ...]


@dataclass(frozen=True)
class Panel:
    """Frame with axes around a picture, a canvas that a program fills, or a drawing."""

    title: str
    alt: str  # for screen readers
    across: Axis
    down: Axis
    aspect: float | None = None  # width over height; a chart is as high as the page says
    image: str = ""  # URL
    drawing: str = ""  # SVG in a square of 1000 units, stretched to the frame; classes give its colours
    scale: tuple[float, str] | None = None  # of a scale bar: part of the width, and its length with the unit
    radar: bool = False  # a SAR image: the radar is above it, near range first
    black: bool = False  # black background in both themes: text on it is white
    canvas: str = ""  # id


@dataclass(frozen=True)
class ColourBar:
    """Colour scale: label with its unit, CSS gradient, and ticks from 0 (left) to 1."""

    label: str
    gradient: str
    ticks: tuple[tuple[float, str], ...]


@dataclass(frozen=True)
class Block:
    """Titled group of panels.

    `columns` are the relative widths of three sides of a target, of which narrow pages show two in a row; other panels
    are as wide as if `across` shared a row.
    """

    title: str
    panels: tuple[Panel, ...]
    columns: tuple[float, ...] = ()
    across: int = 3

    @property
    def tall(self) -> bool:
        """True if three sides in two rows would be higher than half their width; they then share one row."""
        if not self.columns:
            return False
        side, _, top = (width / (panel.aspect or 1) for width, panel in zip(self.columns, self.panels, strict=True))
        return side + top > (self.columns[0] + self.columns[1]) / 2


@dataclass(frozen=True)
class Figure:
    """Figure of a page: heading, caption, blocks of panels, colour bars, and the name of a legend.

    `layout` is "beside" for blocks side by side, "beside low" for many of them, "sheet" for rows of small panels.
    """

    title: str
    text: str
    blocks: tuple[Block, ...]
    bars: tuple[ColourBar, ...] = ()
    legend: str = ""
    layout: str = ""


def nice(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(step * power for step in (5, 2, 1) if step * power <= length * (1 + 1e-9))


def axis(label: str, low: float, high: float, wanted: int = 4) -> Axis:
    """An axis from `low` (left or top) to `high`, with about `wanted` round ticks."""
    if not abs(high - low) > 0:
        return Axis(label, ((0.5, f"{low:.3g}"),))
    step = nice(abs(high - low) / max(wanted - 1, 1))
    first, last = sorted((low, high))
    numbers = [k * step for k in range(math.ceil(first / step - 1e-9), math.floor(last / step + 1e-9) + 1)]
    while len(numbers) > wanted + 1:
        numbers = [number for number in numbers if round(number / step) % 2 == 0]
        step *= 2
    return Axis(label, tuple(((number - low) / (high - low), written(number)) for number in numbers))


def written(number: float) -> str:
    """A round number, with a true minus sign."""
    return f"{number + 0.0:,.6g}".replace("-", "−") if number else "0"


def scale_bar(width_m: float) -> tuple[float, str]:
    """A bar of a round length, about a quarter of a picture's width in metres."""
    length = nice(width_m / 3)
    units = (("km", 1000.0), ("m", 1.0), ("cm", 0.01), ("mm", 0.001))
    unit, size = next((unit for unit in units if length >= unit[1] * (1 - 1e-9)), ("m", 1.0))
    return length / width_m, f"{length / size:g} {unit}"


def colour_bar(label: str, name: str, low: float, high: float) -> ColourBar:
    """A bar of a ramp (colours.py) from `low` to `high`."""
    return ColourBar(label, gradient(name), axis("", low, high, 7).ticks)


def polyline(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], style: str) -> str:
    """A line through points from 0 to 1, y upwards."""
    places = " ".join(f"{_SIDE_UNITS * a:.4g},{_SIDE_UNITS * (1 - b):.4g}" for a, b in zip(x, y, strict=True))
    return f'<polyline class="{style}" points="{places}"/>'


def chart(title: str, alt: str, across: Axis, down: Axis, parts: Sequence[str]) -> Panel:
    """A chart: grid lines at the ticks, then the parts of its drawing."""
    lines = [f"M{_SIDE_UNITS * place:.4g} 0v{_SIDE_UNITS}" for place, _ in across.ticks]
    lines += [f"M0 {_SIDE_UNITS * place:.4g}h{_SIDE_UNITS}" for place, _ in down.ticks]
    return Panel(title, alt, across, down, drawing=f'<path class="grid" d="{"".join(lines)}"/>' + "".join(parts))
