"""Chart of views as points on the sky, drawn with characters by `sarsplat info`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.text import Text

if TYPE_CHECKING:
    from sarsplat.geometry import View

_WIDEST, _NARROWEST = 48, 24  # columns
_RINGS_DEG = (0.0, 30.0, 60.0)
_RINGS_ALOFT_DEG = (-30.0, 0.0, 30.0)
_DOTS_ACROSS, _DOTS_DOWN = 2, 4  # of a braille character
_BRAILLE = 0x2800
_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))


@dataclass(frozen=True)
class Symbols:
    """Characters of a chart; rings are of braille dots unless `ring` is given."""

    train: str
    test: str
    ring: str | None = None


PLAIN = Symbols("o", "x", ".")
"""Symbols of ASCII."""

PRETTY = Symbols("●", "○")


def symbols_for(encoding: str) -> Symbols:
    """Return the symbols that a terminal of this encoding can show."""
    try:
        (PRETTY.train + PRETTY.test + chr(_BRAILLE)).encode(encoding)
    except (UnicodeEncodeError, LookupError):
        return PLAIN
    return PRETTY


def sky_chart(train: Sequence[View], test: Sequence[View], width: int, symbols: Symbols, zero: str = "nose") -> Text:
    """Draw the sky from above: the zenith in the middle, the horizon around, azimuth 0°, named `zero`, at the top.

    At most `width` columns; a training view hides a test view in the same place.
    """
    columns = max(_NARROWEST, min(width, _WIDEST)) - 10  # labels at the sides
    rows = columns * _DOTS_ACROSS // _DOTS_DOWN + 1
    middle = (columns * _DOTS_ACROSS // 2, rows * _DOTS_DOWN // 2)
    radius = min(middle) - 1
    aloft = any(view.aloft for view in train)
    farthest, rings = (180, _RINGS_ALOFT_DEG) if aloft else (90, _RINGS_DEG)  # the nadir around, or the horizon

    def place(azimuth_deg: float, grazing_deg: float) -> tuple[int, int]:
        """Return the dot of a direction."""
        distance = radius * (90 - grazing_deg) / farthest
        angle = math.radians(azimuth_deg)
        return round(middle[0] + distance * math.sin(angle)), round(middle[1] - distance * math.cos(angle))

    cells = [[" "] * columns for _ in range(rows)]
    for ring in rings:
        count = max(24, round(radius * (90 - ring) / farthest * 1.6))
        for x, y in {place(360 * k / count, ring) for k in range(count)}:
            row, column = y // _DOTS_DOWN, x // _DOTS_ACROSS
            if symbols.ring is not None:
                cells[row][column] = symbols.ring
            else:
                before = 0 if cells[row][column] == " " else ord(cells[row][column]) - _BRAILLE
                cells[row][column] = chr(_BRAILLE + (before | _BITS[y % _DOTS_DOWN][x % _DOTS_ACROSS]))
    styles: dict[tuple[int, int], str] = {}
    for views, symbol, style in ((test, symbols.test, "yellow"), (train, symbols.train, "bold cyan")):
        for view in views:
            x, y = place(view.azimuth_deg, view.grazing_deg)
            cells[y // _DOTS_DOWN][x // _DOTS_ACROSS] = symbol
            styles[y // _DOTS_DOWN, x // _DOTS_ACROSS] = style
    return _labelled(cells, styles, f"0° ({zero})")


def _labelled(cells: Sequence[Sequence[str]], styles: dict[tuple[int, int], str], zero: str) -> Text:
    columns, margin = len(cells[0]), 5
    text = Text(zero.center(columns + 2 * margin).rstrip() + "\n", no_wrap=True)
    for row, line in enumerate(cells):
        at_the_middle = row == len(cells) // 2
        text.append("270° ".rjust(margin) if at_the_middle else " " * margin)
        for column, symbol in enumerate(line):
            text.append(symbol, style=styles.get((row, column), "dim"))
        text.append(" 90°\n" if at_the_middle else "\n")
    text.append("180°".center(columns + 2 * margin).rstrip())
    return text


def legend(tests: Iterable[str], symbols: Symbols, aloft: bool = False) -> str:
    """Return a legend of symbols and rings with the names of the test sets."""
    named = ", ".join(tests)
    points = f"{symbols.train} train" + (f"  {symbols.test} {named}" if named else "")
    around = "; around: from below; rings: grazing 30°, 0° and −30°" if aloft else "; rings: grazing 60°, 30° and 0°"
    return f"{points}; middle: straight from above{around}"
