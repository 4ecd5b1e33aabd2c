"""Page with a radar to drag around a target, and the image that it would take."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from html import escape
from typing import Any, Self

import numpy as np
from jaxtyping import Float, UInt8

from sarsplat.arguments import checks_arguments
from sarsplat.colours import DARK, ERROR, HEIGHT, STRENGTH, rgb
from sarsplat.data import Dataset
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, View
from sarsplat.radar import Pixel
from sarsplat.radiometry import to_db
from sarsplat.runs import Step
from sarsplat.viewer.controls import BY_ERROR, BY_GAMMA0, Choices, Controls
from sarsplat.viewer.pictures import (
    MAPS,
    PHASES,
    Panel,
    Scale,
    Strip,
    difference_panel,
    heights_up_to,
    map_panel,
    phase_panel,
    power_panel,
)
from sarsplat.viewer.server import HOST, Newest, start_server, stop_server
from sarsplat.viewer.stage import Stage
from sarsplat.viewer.subject import TRUTH, Cloud, Contributors, Subject, dataset_subject, scene_of, training_subject

_MARGIN = 1.4  # half side of the zoomed part of an image, in radii of the target: room for shadow
_GAMMA0_DB = 30.0  # dynamic range of γ⁰
_MOST_OF_IT = 0.9  # share of a pixel's power that is explained
_KEPT = 0.4  # share of its colour that a dimmed cloud keeps; the rest is grey
_ACROSS = 2  # pictures in a row
_SAME_DEG = 0.05  # largest angle between equal views
_FIRST_AZIMUTH_DEG = 45.0

_SHARE = 0.03  # maximum share of a training's time that is spent on showing it
_WAIT_S = 2.0  # maximum wait for one picture, s


class Viewer:
    """Page on this machine, served until `close` or the end of a `with` block.

    Parameters
    ----------
    subject : Subject or Gaussians
        Subject of a folder (`subject_at`), or Gaussians of a custom training loop (`update`).
    port : int
        Port on 127.0.0.1; 0 takes any free one.
    grid : ImageGrid, optional
        Pixels and resolution of the images of Gaussians; by default 128 × 128 pixels that show all of them.
    views : sequence of View, optional
        Views to choose from for Gaussians; by default 24 from all sides.

    Attributes
    ----------
    frame_s : float
        Time to draw the newest image, s.

    Raises
    ------
    SarsplatError
        If the port is taken.
    """

    @checks_arguments
    def __init__(
        self,
        subject: Subject | Gaussians,
        port: int = 0,
        *,
        grid: ImageGrid | None = None,
        views: Sequence[View] | None = None,
    ) -> None:
        subject = scene_of(subject, grid, views) if isinstance(subject, Gaussians) else subject
        self._pause_until = 0.0
        self._subject = subject
        self._view, self._pixel = _first_view(subject), None  # type: tuple[View, Pixel | None]
        self._picked: tuple[View, Pixel, Contributors | None] | None = None
        self._strip, self._part, self._corner = Strip(subject.grid, 1, DARK), subject.grid, (0, 0)
        self._offered, self._ready = True, False
        self.frame_s = 0.0
        self._server = start_server(port, self._pick_at)
        self._newest = Newest(self._draw)
        self._stage = Stage(self._server, subject.box_m, subject.views, self._view, self.look_from, self._pick_on_plane)
        self._controls = Controls(self._server, subject, self._view, self._ask, self.look_from)
        self._ready = True
        self._ask()

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{HOST}:{self._server.get_port()}"

    @property
    def view(self) -> View:
        """View of the radar."""
        return self._view

    @property
    def pixel(self) -> Pixel | None:
        """Picked pixel, if any."""
        return self._pixel

    @checks_arguments
    def look_from(self, view: View) -> None:
        """Move the radar to a view and redraw."""
        self._view = view
        self._ask()

    @checks_arguments
    def pick(self, pixel: Pixel | None) -> None:
        """Highlight the contributors to a pixel; None clears it."""
        self._pixel = pixel
        self._ask()

    @checks_arguments
    def show(self, subject: Subject) -> None:
        """Show a newer state of the same subject."""
        self._subject, self._picked, self._offered = subject, None, False
        self._ask()

    @checks_arguments
    def update(self, gaussians: Gaussians) -> None:
        """Show a newer state of Gaussians of a custom loop, unless that would take more than 3 % of its time."""
        old = self._subject
        self.keep_up(lambda: scene_of(gaussians, old.grid, old.train_views, old.peak))

    @checks_arguments
    def keep_up(self, newer: Callable[[], Subject]) -> None:
        """Show a newer state of a training, unless that would take more than 3 % of its time; the training waits."""
        begun = time.monotonic()
        if begun >= self._pause_until:
            self.show(newer())
            self.wait(_WAIT_S)
            ended = time.monotonic()
            self._pause_until = ended + (ended - begun) / _SHARE

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @checks_arguments
    def wait(self, timeout_s: float = 10.0) -> bool:
        """Wait until everything requested is drawn; False on timeout."""
        return self._newest.wait(timeout_s)

    def close(self) -> None:
        """Stop serving the page."""
        self._newest.close()
        stop_server(self._server)

    def _ask(self) -> None:
        if self._ready:  # viser also reports values set by this program, and browsers may connect early
            self._newest.ask()

    # ---- drawing, on a single thread --------------------------------------------------------------------------------
    def _draw(self) -> None:
        begun = time.perf_counter()
        subject, view, pixel = self._subject, self._view, self._pixel
        if not self._offered:
            self._offered = True
            self._controls.offer(subject)
        choices = self._controls.choices
        part, window = self._window(view, choices.zoom)
        panels = self._panels(subject, view, choices)
        heads = [(panel.title, line) for panel, line in panels]
        cut = [replace(panel, rgb=panel.rgb[window]) for panel, _ in panels]
        self._strip, self._part = Strip(part, min(len(cut), _ACROSS), choices.page), part
        self._corner = window[0].start, window[1].start
        inside = None if pixel is None else _moved(pixel, -self._corner[0], -self._corner[1], part)
        on_plane = cut[-1 if choices.map else 0]
        with self._server.atomic():
            rows = [slice(first, first + _ACROSS) for first in range(0, len(cut), _ACROSS)]
            for index, row in enumerate(rows):
                legends = [panel.legend for panel in cut[row]]
                self._controls.show_row(index, heads[row], self._strip.drawn(cut[row], inside), legends)
            self._controls.hide_rows(len(rows))
            self._controls.follow(view)
            self._stage.aim(view)
            self._stage.lay_image(self._strip.enlarged(on_plane), view, part, choices.plane)
            lit = self._light(subject, view, pixel)
            self._draw_target(subject, view, choices, dimmed=lit is not None)
            self._stage.show_dome(choices.views)
            self._stage.show_ground(choices.lines)
            self._stage.paint(choices.page)
            self.frame_s = time.perf_counter() - begun
            self._controls.show_foot(self._text(subject, view, pixel, lit))

    def _panels(self, subject: Subject, view: View, choices: Choices) -> list[tuple[Panel, str]]:
        """Pictures of the strip, each with the line below its title."""
        panels, name = [], _name(view)
        style = subject.peak, choices.limits_db, choices.colours, choices.page
        rendered = None
        if subject.renders:
            rendered = subject.render(view, ground=choices.ground, shadow=choices.shadow)
            panels.append((power_panel("rendered", rendered, *style), name))
        if subject.dataset is not None:
            index, apart_deg = subject.nearest(view)
            entry, power = subject.dataset.entries[index], subject.dataset.power[index]
            kind = "training" if entry.split == "train" else entry.split
            same = apart_deg < _SAME_DEG and entry.view.unusual == view.unusual
            away = "the same view" if same else f"{apart_deg:.1f}° away: {_name(entry.view)}"
            panels.append((power_panel(f"nearest {kind} image", power, *style), away))
            if rendered is not None:
                levels = subject.peak, choices.limits_db[0]
                panel = difference_panel(rendered, power, *levels, choices.page, speckled=subject.speckled)
                panels.append((panel, "rendered over nearest image"))
        if choices.map == PHASES and subject.knows_phases:
            shown, pair = subject.interferogram(view)
            panel = phase_panel(shown.phase, pair.cycle_m, choices.page)
            panels.append((panel, f"passes {pair.first + 1} and {pair.second + 1}, rendered"))
        elif choices.map in MAPS and (maps := subject.maps(view)) is not None:
            highest_m = heights_up_to(subject.clouds[0].places_m[:, 2])
            panels.append((map_panel(choices.map, maps, highest_m, subject.grid.cell_m, choices.page), name))
        return panels

    def _window(self, view: View, zoom: bool) -> tuple[ImageGrid, tuple[slice, slice]]:
        """Grid and slices (rows, columns) of the part that shows the target; its size does not depend on the view."""
        grid, radius = self._subject.grid, _MARGIN * self._stage.size_m
        azimuth, slant_range = view.look.gradients @ self._stage.centre
        window = []
        sides = ((slant_range, grid.range_m, grid.spacing_m[1]), (azimuth, grid.azimuth_m, grid.spacing_m[0]))
        for middle, places, spacing in sides:
            count = min(2 * math.ceil(radius / spacing) + 1, len(places)) if zoom else len(places)
            start = round((middle - places[0]) / spacing) - count // 2
            first = min(max(start, 0), len(places) - count)
            window.append(slice(first, first + count))
        rows, columns = window
        return grid.part(rows, columns), (rows, columns)

    def _draw_target(self, subject: Subject, view: View, choices: Choices, *, dimmed: bool) -> None:
        cloud = next((cloud for cloud in subject.clouds if cloud.name == choices.cloud), None)
        if cloud is None or len(cloud.places_m) == 0:
            return
        values, scale = _coloured(subject, cloud, view, choices)
        colours: UInt8[np.ndarray, "n 3"] = scale.rgb(values)
        if dimmed:
            colours = np.rint(_KEPT * colours + (1 - _KEPT) * np.array(rgb(choices.page.muted))).astype(np.uint8)
        self._stage.draw_cloud(cloud, colours, choices.point_size)
        bar = f'<div style="padding:0 10px">{scale.bar()}</div>'
        if self._controls.legend.content != bar:
            self._controls.legend.content = bar

    # ---- picking ----------------------------------------------------------------------------------------------------
    def _pick_at(self, x: float, y: float) -> None:
        self._pick_in_part(self._strip.pixel_at(x, y))

    def _pick_on_plane(self, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> None:
        frame, part = self._view.look.frame, self._part
        down = (self._stage.plane_depth(self._view) - float(origin @ frame[1])) / float(direction @ frame[1])
        azimuth, slant_range = self._view.look.gradients @ (origin + down * direction)
        column = round((azimuth - part.azimuth_m[0]) / part.spacing_m[0])
        row = round((slant_range - part.range_m[0]) / part.spacing_m[1])
        self._pick_in_part(_moved(Pixel(row, column), 0, 0, part))

    def _pick_in_part(self, pixel: Pixel | None) -> None:
        """Pick a pixel of the visible part; picking the same pixel again clears it."""
        picked = None if pixel is None else _moved(pixel, *self._corner, self._subject.grid)
        self.pick(None if picked == self._pixel else picked)

    def _light(self, subject: Subject, view: View, pixel: Pixel | None) -> Contributors | None:
        if pixel is None:
            self._stage.light(None, None)
            return None
        if self._picked is None or self._picked[:2] != (view, pixel):
            self._picked = (view, pixel, subject.contributors(view, pixel))
        lit = self._picked[2]
        self._stage.light(self._stage.iso_range_line(view, pixel.place_m(subject.maps_grid)), lit)
        return lit

    def _text(self, subject: Subject, view: View, pixel: Pixel | None, lit: Contributors | None) -> str:
        took = f'<span style="opacity:.6">Drawn in {1e3 * self.frame_s:.0f} ms.</span>' if self._newest.done else ""
        if pixel is None:
            return f"Click on a pixel to see what makes it: all places of one azimuth and one range. {took}"
        azimuth, slant_range = pixel.place_m(subject.grid)
        where = (
            f"<b>Row {pixel.row}, column {pixel.column}</b>: azimuth {azimuth:.2f} m, slant range {slant_range:.2f} m"
        )
        if subject.renders:
            power = subject.render(view)[pixel.row, pixel.column]
            where += f"; {float(to_db(power, subject.peak)):.1f} dB"
        if lit is None:
            return f"{where}. Nothing is known to be there. {took}"
        return f"{where}. {escape(_explained(lit, subject.scatters))} {took}".replace("-", "−")


@contextmanager
def watched(dataset: Dataset, port: int, say: Callable[[str], None]) -> Iterator[Callable[[Step[Any]], None]]:
    """Open a page that shows a training; the yielded function, called after each step, updates it.

    Drawing takes at most 3 % of the training's time (`Viewer.keep_up`) and leaves the training unchanged. `say` gets a
    sentence with the page's URL. Raises if the port is taken; 0 takes any free one.
    """
    with Viewer(dataset_subject(dataset), port) as viewer:
        say(f"open {viewer.address} in a browser on this machine to watch the training")
        yield lambda step: viewer.keep_up(lambda: training_subject(dataset, step.trainer))


def _first_view(subject: Subject) -> View:
    """Known view nearest to the front left, at the median elevation."""
    usual = float(np.median([view.grazing_deg for view, _ in subject.views]))
    return subject.views[subject.nearest(View(_FIRST_AZIMUTH_DEG, usual, aloft=subject.views[0][0].aloft))[0]][0]


def _explained(lit: Contributors, gaussians: bool) -> str:
    """Sentence on the contributors to a pixel."""
    ground = f" {lit.ground_share:.0%} comes from the ground." if lit.ground_share >= 0.005 else ""
    if lit.by_ground_share >= 0.005:
        ground += f" {lit.by_ground_share:.0%} returns by way of the ground, at the foot of what returns it."
    if len(lit.shares) == 0:
        return f"No part of the target is there.{ground}"
    target = lit.shares.sum()
    count = int(np.searchsorted(lit.shares.cumsum(), _MOST_OF_IT * target)) + 1
    heights = lit.places_m[:count, 2]
    what = "Gaussians" if gaussians else "pieces of the surface"
    return (
        f"{_MOST_OF_IT:.0%} of what the target adds comes from {count} {what} at heights of {heights.min():.2f} to "
        f"{heights.max():.2f} m.{ground}"
    )


def _coloured(subject: Subject, cloud: Cloud, view: View, choices: Choices) -> tuple[np.ndarray, Scale]:
    """Value of each place, and its colour scale."""
    quantity, page = choices.coloured_by, choices.page
    if quantity == BY_GAMMA0 and cloud.name != TRUTH:
        level = to_db(subject.gamma0(cloud, view))
        top = float(np.ceil(np.quantile(level, 0.995)))
        return level, Scale("γ⁰ towards the radar, dB", top - _GAMMA0_DB, top, STRENGTH, page)
    if quantity == BY_ERROR and cloud.name != TRUTH:
        return subject.error_m(cloud), Scale("distance to the true surface, m", 0.0, subject.grid.cell_m, ERROR, page)
    return cloud.places_m[:, 2], Scale("height, m", 0.0, heights_up_to(cloud.places_m[:, 2]), HEIGHT, page)


def _name(view: View) -> str:
    return f"azimuth {view.azimuth_deg:.1f}°, grazing {view.grazing_deg:.1f}°{view.unusual}"


def _moved(pixel: Pixel, rows: int, columns: int, grid: ImageGrid) -> Pixel | None:
    """Pixel shifted by rows and columns; None outside the grid."""
    row, column = pixel.row + rows, pixel.column + columns
    return Pixel(row, column) if 0 <= row < grid.rows and 0 <= column < grid.columns else None
