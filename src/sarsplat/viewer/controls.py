"""Controls on the viewer's page."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from sarsplat.colours import DARK, LIGHT, POWER_RAMPS, Page, rgb
from sarsplat.geometry import View
from sarsplat.radiometry import DYNAMIC_RANGE_DB
from sarsplat.viewer.pictures import MAPS, PHASES
from sarsplat.viewer.stage import HIGHEST_DEG, lowest_deg
from sarsplat.viewer.subject import Subject

if TYPE_CHECKING:
    import viser

BY_HEIGHT, BY_GAMMA0, BY_ERROR = "height", "γ⁰ towards the radar", "distance to the true surface"
_NO_MAP = "none"

_HINT = (
    '<div style="font-size:12px;line-height:1.5;padding:0 10px;opacity:.85">Drag the red ball, or click on a dot: '
    f'<span style="color:light-dark({LIGHT.train},{DARK.train})">●</span> training view, '
    f'<span style="color:light-dark({LIGHT.test},{DARK.test})">●</span> test view.</div>'
)


@dataclass(frozen=True)
class Choices:
    """Current values of all controls."""

    cloud: str
    coloured_by: str
    point_size: float
    limits_db: tuple[float, float]
    colours: str
    ground: bool
    shadow: bool
    map: str | None
    zoom: bool
    views: bool
    plane: bool
    lines: bool
    dark: bool

    @property
    def page(self) -> Page:
        """Colours of the page."""
        return DARK if self.dark else LIGHT


class Controls:
    """Panels of the page: settings on the left, images on the right.

    The subject decides which controls are offered. `on_change` is called when a control changes, `on_aim` with the view
    that the sliders or buttons set.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        subject: Subject,
        view: View,
        on_change: Callable[[], None],
        on_aim: Callable[[View], None],
    ) -> None:
        self._gui = gui = server.gui
        self._on_change, self._on_aim = on_change, on_aim
        self._set: dict[str, Any] = {}
        self._rows: list[tuple[Any, Any, Any]] = []
        self._dark()
        gui.set_panel_label("sarsplat view")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(280)
        self.title = gui.add_markdown("")
        self._radar(subject, view)
        self._target()
        self._image()
        self.offer(subject)
        with gui.add_folder("Scene", expand_by_default=False):
            self._watched("views", gui.add_checkbox("views", True))
            self._watched("plane", gui.add_checkbox("image plane", True))
            self._watched("lines", gui.add_checkbox("ground lines", True))
            dark = gui.add_checkbox("dark page", True)
            dark.on_update(lambda _: self._dark(dark.value))
            self._watched("dark", dark)
        panel = gui.add_panel()
        panel.dock_right()
        panel.expand()  # on a phone, too
        panel.set_width(560)
        self._tab = panel.add_tab("SAR image")
        with self._tab:
            self.foot = gui.add_html("", order=1e12)

    def _dark(self, dark: bool = True) -> None:
        self._gui.configure_theme(
            dark_mode=dark,
            show_logo=False,
            show_share_button=False,
            brand_color=rgb((DARK if dark else LIGHT).train),
            control_width="medium",
        )

    def _watched(self, name: str, handle: Any) -> None:
        """Register a control under the name of its choice, and redraw when it changes."""
        handle.on_update(lambda _: self._on_change())
        self._set[name] = handle

    def _radar(self, subject: Subject, view: View) -> None:
        gui, views, self._view = self._gui, subject.views, view
        with gui.add_folder("Radar"):
            self._azimuth = gui.add_slider("azimuth, °", 0.0, 360.0, 0.1, round(view.azimuth_deg % 360, 1))
            lowest = lowest_deg(view)
            first = round(min(max(view.grazing_deg, lowest), HIGHEST_DEG), 1)
            self._grazing = gui.add_slider("grazing, °", lowest, HIGHEST_DEG, 0.1, first)
            gui.add_html(_HINT)
            steps = gui.add_button_group("known views", ("◀ previous", "next ▶"))

        def slid(event: Any) -> None:
            if event.client is None:  # set by `follow`
                return
            self._on_aim(replace(self._view, azimuth_deg=self._azimuth.value, grazing_deg=self._grazing.value))

        self._azimuth.on_update(slid)
        self._grazing.on_update(slid)

        @steps.on_click
        def stepped(event: Any) -> None:
            index, _ = subject.nearest(self._view)
            self._on_aim(views[(index + (1 if event.target.value == "next ▶" else -1)) % len(views)][0])

    def _target(self) -> None:
        gui = self._gui
        with gui.add_folder("Target"):
            self._watched("cloud", gui.add_dropdown("show", ["nothing"]))
            self._watched("coloured_by", gui.add_dropdown("colour", [BY_HEIGHT]))
            self._watched("point_size", gui.add_slider("point size", 0.25, 4.0, 0.25, 1.0))
            self.legend = gui.add_html("")

    def _image(self) -> None:
        gui = self._gui
        with gui.add_folder("Image"):
            self._watched(
                "limits_db",
                gui.add_multi_slider("power, dB", -80.0, 20.0, 1.0, (-DYNAMIC_RANGE_DB, 0.0), min_range=5.0),
            )
            self._watched("colours", gui.add_dropdown("colours", POWER_RAMPS))
            self._watched("map", gui.add_dropdown("radar map", (_NO_MAP, *MAPS)))
            self._watched("zoom", gui.add_checkbox("zoom to target", True))
            self._watched("ground", gui.add_checkbox("ground", True))
            self._watched("shadow", gui.add_checkbox("its shadow", True))

    def offer(self, subject: Subject) -> None:
        """Show the controls that apply to a subject, and hide the rest."""
        self.title.content = f"**{subject.title}**"
        names = tuple(cloud.name for cloud in subject.clouds)
        colours = [BY_HEIGHT, *([BY_GAMMA0] if subject.scatters else []), *([BY_ERROR] if subject.knows_errors else [])]
        maps = (_NO_MAP, *(MAPS if subject.surface is not None else ()), *((PHASES,) if subject.knows_phases else ()))
        offered = {"cloud": names or ("nothing",), "coloured_by": tuple(colours), "map": maps}
        for handle, options in ((self._set[name], options) for name, options in offered.items()):
            if tuple(handle.options) != options:
                handle.options = options
        for handle in (self._set["cloud"], self._set["coloured_by"], self._set["point_size"], self.legend):
            handle.visible = len(names) > 0
        self._set["map"].visible = len(maps) > 1
        self._set["ground"].visible = self._set["shadow"].visible = subject.has_ground

    @property
    def choices(self) -> Choices:
        """Current values of all controls."""
        values = {name: handle.value for name, handle in self._set.items()}
        return Choices(**values | {"map": None if values["map"] == _NO_MAP else values["map"]})

    def follow(self, view: View) -> None:
        """Set the sliders to the radar's view."""
        self._view = view
        slider: Any
        for slider, angle in ((self._azimuth, view.azimuth_deg % 360), (self._grazing, view.grazing_deg)):
            if slider.value != round(angle, 1):
                slider.value = round(angle, 1)

    def show_row(
        self, index: int, heads: list[tuple[str, str]], picture: UInt8[np.ndarray, "height width 4"], legends: list[str]
    ) -> None:
        """Show a row of images, with titles (each with a smaller line) above and colour legends below."""
        if index == len(self._rows):
            with self._tab:
                html, order = self._gui.add_html, 10.0 * index
                image = self._gui.add_image(picture, format="png", order=order + 1)
                self._rows.append((html("", order=order), image, html("", order=order + 2)))
        titles, image, below = self._rows[index]
        image.image = picture
        words = (
            f'<b>{escape(title)}</b><div style="font-size:11px;opacity:.75">{escape(line)}</div>'
            for title, line in heads
        )
        self._show(titles, _cells(words, 'class="heads" style="font-size:13px;line-height:1.35;'))
        self._show(below, _cells(legends, 'style="'))
        for handle in self._rows[index]:
            handle.visible = True

    def hide_rows(self, first: int) -> None:
        """Hide this row of images and all after it."""
        for handle in (handle for row in self._rows[first:] for handle in row):
            handle.visible = False

    def show_foot(self, text: str) -> None:
        """Show a line of text below the images."""
        style = "font-size:13px;line-height:1.5;margin-top:4px;padding:0 10px"
        self._show(self.foot, f'<div id="foot" style="{style}">{text}</div>')

    def _show(self, handle: Any, content: str) -> None:
        if handle.content != content:
            handle.content = content


def _cells(contents: Iterable[str], attributes: str) -> str:
    """HTML of contents side by side, in two columns as the images of a row."""
    cells = "".join(f'<div style="flex:0 1 50%;min-width:0">{content}</div>' for content in contents)
    return f'<div {attributes}display:flex;gap:6px;padding:0 10px">{cells}</div>'
