"""Three sides of a target, as on a drawing board, for one or more blocks side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from sarsplat.report.canvas import INK, MUTED, dress, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INCHES = 5.4  # of the two sides that stand next to each other


@dataclass(frozen=True)
class Side:
    """From where a target is seen: axes of the world, 0 to 2; `sign` is −1 if `towards` points away from the viewer."""

    name: str
    across: int
    up: int
    towards: int
    sign: int


SIDES = (Side("side", 0, 2, 1, -1), Side("front", 1, 2, 0, 1), Side("top", 0, 1, 2, 1))


@dataclass(frozen=True)
class Board:
    """Where one block is drawn: axes in metres for each of `SIDES`, and a free corner."""

    sides: tuple[Axes, ...]
    corner: Axes


def drawing_boards(
    names: Sequence[str], low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]
) -> tuple[Figure, list[Board]]:
    """A figure with a board for each name, side by side; all show the space between the corners `low` and `high`, m."""
    size = high - low
    scale = _INCHES / (size[0] + size[1])
    height = (size[2] + size[1]) * scale + 1.2
    figure, boards = new_figure(len(names) * 6.4, height), []
    for block, name in zip(figure.subfigures(1, len(names), squeeze=False)[0], names, strict=True):
        block.set_facecolor("none")
        grid = block.add_gridspec(
            2,
            2,
            width_ratios=(size[0], size[1]),
            height_ratios=(size[2], size[1]),
            left=0.09,
            right=0.985,
            top=1 - 0.5 / height,
            bottom=0.34 / height,
            wspace=0.12,
            hspace=0.24,
        )
        sides = []
        for side, place in zip(SIDES, (grid[0, 0], grid[0, 1], grid[1, 0]), strict=True):
            axes = block.add_subplot(place)
            axes.set_xlim(low[side.across], high[side.across])
            axes.set_ylim(low[side.up], high[side.up])
            axes.set_aspect("equal")
            dress(axes)
            axes.set_title(f"{side.name}, m", loc="left", size=9, color=MUTED, pad=3)
            sides.append(axes)
        corner = block.add_subplot(grid[1, 1])
        corner.set_axis_off()
        block.text(0.09, 1 - 0.24 / height, name, color=INK, size=11, weight="bold")
        boards.append(Board(tuple(sides), corner))
    return figure, boards
