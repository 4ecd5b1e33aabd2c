"""Pictures of one view side by side: the rendering, the nearest measured image, their difference, and radar maps."""

import math
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float, Real, UInt8
from scipy.ndimage import uniform_filter

from sarsplat.colours import (
    DIFFERENCE,
    HEIGHT,
    INCIDENCE,
    LAYOVER,
    PHASE,
    PICKED,
    SHADOW,
    SPREAD,
    TARGET,
    Page,
    gradient,
    over,
    rgb,
)
from sarsplat.geometry import ImageGrid
from sarsplat.radar import Pixel, RadarMaps
from sarsplat.radiometry import difference_db, to_db

_SIDE = 256  # longer side of a panel, pixels; at least half of it after rounding
_GAP = 6  # pixels between panels

MAPS = ("height", "incidence", "layover", "shadow and layover")
"""Names of the radar maps on the page."""

PHASES = "phase between passes"
"""Name of the map of learned phases on the page."""


@dataclass(frozen=True)
class Scale:
    """Colour scale of one quantity, with its unit in the label; values beyond the ends are clipped.

    Transparent colours of a ramp show the background of the `page`'s panels.
    """

    label: str
    low: float
    high: float
    colours: str
    page: Page

    def rgb(self, values: Real[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
        """Colours of values; NaN looks almost like an empty panel."""
        width = self.high - self.low
        parts = (np.asarray(values, np.float64) - self.low) / (width if width > 0 else 1.0)
        finite = np.isfinite(parts)
        index = np.rint(255 * np.clip(np.where(finite, parts, 0), 0, 1)).astype(np.uint8)
        colours: UInt8[np.ndarray, "*shape 3"] = over(self.colours, self.page.card)[index]
        return np.where(finite[..., None], colours, np.array(rgb(self.page.line), np.uint8))

    def bar(self) -> str:
        """Colour bar as HTML, with numbers at its ends and in the middle."""
        digits = 0 if self.high - self.low >= 8 else 1 if self.high - self.low >= 1 else 2
        places = (self.low, (self.low + self.high) / 2, self.high)
        numbers = "".join(f"<span>{place:.{digits}f}</span>".replace("-", "−") for place in places)
        return (
            f'<div style="margin:2px 0 6px"><div style="font-size:12px;opacity:.8">{escape(self.label)}</div>'
            f'<div style="height:9px;border-radius:2px;background:{gradient(self.colours)},{self.page.card}"></div>'
            '<div style="display:flex;justify-content:space-between;font-size:11px;opacity:.8">'
            f"{numbers}</div></div>"
        )

    def panel(self, title: str, values: Real[np.ndarray, "rows columns"]) -> "Panel":
        """Panel of values, with a colour bar."""
        return Panel(title, self.rgb(values), self.bar())


@dataclass(frozen=True)
class Panel:
    """Picture of a strip, with its title, and its colour legend as HTML."""

    title: str
    rgb: UInt8[np.ndarray, "rows columns 3"]
    legend: str


def power_panel(
    title: str,
    power: Real[np.ndarray, "rows columns"],
    peak: float,
    limits_db: tuple[float, float],
    colours: str,
    page: Page,
) -> Panel:
    """Panel of an image in decibels relative to `peak`."""
    return Scale("dB relative to the brightest pixels", *limits_db, colours, page).panel(title, to_db(power, peak))


def difference_panel(
    rendered: Real[np.ndarray, "rows columns"],
    measured: Real[np.ndarray, "rows columns"],
    peak: float,
    darkest_db: float,
    page: Page,
    *,
    speckled: bool,
) -> Panel:
    """Panel of rendered over measured power, dB; pixels below `darkest_db` count as equally dark."""
    widest = 10.0 if speckled else 6.0
    if speckled:
        rendered, measured = (uniform_filter(power, 3) for power in (rendered, measured))
    scale = Scale(f"dB{' (3×3 means)' if speckled else ''}", -widest, widest, DIFFERENCE, page)
    return scale.panel("difference", difference_db(rendered, measured, peak, darkest_db))


def map_panel(name: str, maps: RadarMaps, highest_m: float, cell_m: float, page: Page) -> Panel:
    """Panel of one of `MAPS`; heights are coloured up to `highest_m`."""
    if name == "height":
        heights = Scale("height of the first return, m", 0.0, highest_m, HEIGHT, page)
        return heights.panel("first-return height", maps.height_m)
    if name == "incidence":
        angles = Scale("local incidence angle, degrees", 0.0, 90.0, INCIDENCE, page)
        return angles.panel("local incidence", maps.incidence_deg)
    if name == "layover":
        label = f"separation in elevation, m (cell {cell_m:.2g} m)"
        return Scale(label, 0.0, max(highest_m, 2 * cell_m), SPREAD, page).panel("layover", maps.spread_m)
    kinds = (
        (maps.shadow, SHADOW, "shadow on flat ground"),
        (~np.isnan(maps.height_m), TARGET, "target"),
        (maps.layover, LAYOVER, "layover"),
    )
    classes = np.full((*maps.shadow.shape, 3), rgb(page.card), np.uint8)
    legend = ""
    for mask, colour, text in kinds:
        classes[mask] = rgb(colour)
        legend += (
            f'<span style="display:inline-block;width:10px;height:10px;border-radius:2px;background:{colour};'
            f'margin:0 5px 0 0"></span>{text}<br>'
        )
    return Panel("shadow and layover", classes, f'<div style="font-size:12px;margin:2px 0 6px">{legend}</div>')


def phase_panel(phase: Float[np.ndarray, "rows columns"], cycle_m: float, page: Page) -> Panel:
    """Panel of a phase, rad, of which one cycle is `cycle_m` of height."""
    scale = Scale(f"rad; one cycle is {cycle_m:.3g} m of height", -math.pi, math.pi, PHASE, page)
    return scale.panel("phase above level ground", phase)


class Strip:
    """Strip of `count` panels of one grid side by side, on a scale that is equal in azimuth and slant range."""

    def __init__(self, grid: ImageGrid, count: int, page: Page) -> None:
        self.grid, self.count, self._page = grid, count, page
        finest = min(grid.spacing_m)
        size = np.array([grid.rows * grid.spacing_m[1], grid.columns * grid.spacing_m[0]]) / finest
        factor = max(_SIDE / size.max(), 1.0)
        factor = math.floor(factor) if factor < 8 else 8.0  # whole multiples keep all pixels the same size
        self._height, self._width = (max(round(side * factor), 1) for side in size.tolist())

    def drawn(self, panels: list[Panel], pixel: Pixel | None) -> UInt8[np.ndarray, "height width 4"]:
        """Draw the panels as one RGBA picture, with a frame around the picked pixel in each; missing ones are empty."""
        step = self._width + _GAP
        strip = np.zeros((self._height, self.count * step - _GAP, 4), np.uint8)
        for place, panel in enumerate(panels):
            picture = self.enlarged(panel)
            if pixel is not None:
                self._frame(picture, pixel)
            strip[:, place * step : place * step + self._width] = np.pad(
                picture, ((0, 0), (0, 0), (0, 1)), constant_values=255
            )
        return strip

    def enlarged(self, panel: Panel) -> UInt8[np.ndarray, "height width 3"]:
        """Enlarge a panel to its size in the strip, with a thin line around it."""
        row = np.arange(self._height) * self.grid.rows // self._height
        column = np.arange(self._width) * self.grid.columns // self._width
        picture: UInt8[np.ndarray, "height width 3"] = panel.rgb[row[:, None], column]
        picture[[0, -1]] = picture[:, [0, -1]] = rgb(self._page.muted)
        return picture

    def pixel_at(self, x: float, y: float) -> Pixel | None:
        """Pixel at a position in the strip, relative to its width and height; None between two panels."""
        total = self.count * (self._width + _GAP) - _GAP
        place = int(x * total) % (self._width + _GAP)
        if place >= self._width or not 0 <= y < 1:
            return None
        return Pixel(int(y * self._height) * self.grid.rows // self._height, place * self.grid.columns // self._width)

    def _frame(self, picture: UInt8[np.ndarray, "height width 3"], pixel: Pixel) -> None:
        reach = max(self._height, self._width) // 40 + 1
        top, bottom = ((pixel.row + k) * self._height // self.grid.rows for k in (0, 1))
        left, right = ((pixel.column + k) * self._width // self.grid.columns for k in (0, 1))
        top, bottom = max(top - reach, 0), min(bottom + reach, self._height) - 1
        left, right = max(left - reach, 0), min(right + reach, self._width) - 1
        for y in (top, bottom):
            picture[y, left : right + 1] = rgb(PICKED)
        for x in (left, right):
            picture[top : bottom + 1, x] = rgb(PICKED)


def heights_up_to(height_m: Float[np.ndarray, " n"]) -> float:
    """Upper end of a colour bar of heights, m."""
    return float(max(np.quantile(height_m, 0.995), 1e-3)) if len(height_m) else 1.0
