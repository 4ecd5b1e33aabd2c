"""What can be set on the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

from sarsplat.geometry import View
from sarsplat.report.decibels import DYNAMIC_DB
from sarsplat.viewer.colours import POWER_MAPS
from sarsplat.viewer.pictures import MAPS
from sarsplat.viewer.subject import Subject

if TYPE_CHECKING:
    import viser

_HEIGHT, _GAMMA0, _ERROR = "height", "γ⁰ towards the radar", "distance to the true surface"
_NO_MAP = "none"


@dataclass(frozen=True)
class Choices:
    """What is set, all at once."""

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


class Controls:
    """The page's panels: settings on the left, images on the right.

    Parameters
    ----------
    server : viser.ViserServer
        The page.
    subject : Subject
        What is looked at; it decides what there is to set.
    view : View
        Where the radar is at first.
    on_change : callable
        Called when anything is set.
    on_aim : callable
        Told of the view that the sliders or buttons ask for.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        subject: Subject,
        view: View,
        on_change: Callable[[], None],
        on_aim: Callable[[View], None],
    ) -> None:
        self._gui = gui = server.gui
        self._on_change, self._on_aim = on_change, on_aim
        self._dark()
        gui.set_panel_label("sarsplat view")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(290)
        self.title = gui.add_markdown(f"**{subject.title}**")
        self._radar(subject, view)
        self._target(subject)
        self._image(subject)
        with gui.add_folder("Scene", expand_by_default=False):
            self._views = self._watched(gui.add_checkbox("views", True))
            self._plane = self._watched(gui.add_checkbox("image plane", True))
            self._lines = self._watched(gui.add_checkbox("ground lines", True))
            dark = gui.add_checkbox("dark page", True)
            dark.on_update(lambda _: self._dark(dark.value))
        panel = gui.add_panel()
        panel.dock_right()
        panel.set_width(580)
        with panel.add_tab("SAR image"):
            self.heads = gui.add_html("")
            self.strip: Any = None
            self.foot = gui.add_html("", order=1e12)
        self._tab = panel

    def _dark(self, dark: bool = True) -> None:
        self._gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, brand_color=(92, 160, 220), control_width="medium"
        )

    def _watched(self, handle: Any) -> Any:
        handle.on_update(lambda _: self._on_change())
        return handle

    def _radar(self, subject: Subject, view: View) -> None:
        gui = self._gui
        with gui.add_folder("Radar"):
            self._azimuth = gui.add_slider("azimuth, °", 0.0, 360.0, 0.1, round(view.azimuth_deg % 360, 1))
            self._grazing = gui.add_slider("grazing, °", 1.0, 89.0, 0.1, round(min(max(view.grazing_deg, 1), 89), 1))
            steps = gui.add_button_group("known views", ("◀ previous", "next ▶"))

        def slid(event: Any) -> None:
            if event.client is not None:  # and not the page itself, which follows the radar
                self._on_aim(View(self._azimuth.value, self._grazing.value))

        self._azimuth.on_update(slid)
        self._grazing.on_update(slid)

        @steps.on_click
        def stepped(event: Any) -> None:
            index, _ = subject.nearest(View(self._azimuth.value, self._grazing.value))
            step = 1 if event.target.value == "next ▶" else -1
            self._on_aim(subject.views[(index + step) % len(subject.views)][0])

    def _target(self, subject: Subject) -> None:
        gui = self._gui
        names = [cloud.name for cloud in subject.clouds]
        ways = [_HEIGHT, *([_GAMMA0] if subject.scatters else []), *([_ERROR] if subject.truth is not None else [])]
        with gui.add_folder("Target"):
            self._cloud = self._watched(gui.add_dropdown("show", names or ["nothing"], visible=len(names) > 0))
            self._coloured = self._watched(gui.add_dropdown("colour", ways, visible=len(names) > 0))
            self._size = self._watched(gui.add_slider("point size", 0.25, 4.0, 0.25, 1.0, visible=len(names) > 0))
            self.legend = gui.add_html("")

    def _image(self, subject: Subject) -> None:
        gui, ground = self._gui, subject.has_ground
        maps = (_NO_MAP, *MAPS)
        with gui.add_folder("Image"):
            self._limits = self._watched(
                gui.add_multi_slider("power, dB", -80.0, 20.0, 1.0, (-DYNAMIC_DB, 0.0), min_range=5.0)
            )
            self._colours = self._watched(gui.add_dropdown("colours", POWER_MAPS))
            self._map = self._watched(gui.add_dropdown("radar map", maps, visible=len(subject.clouds) > 0))
            self._zoom = self._watched(gui.add_checkbox("zoom to the target", True))
            self._ground = self._watched(gui.add_checkbox("ground", True, visible=ground))
            self._shadow = self._watched(gui.add_checkbox("shadow on the ground", True, visible=ground))

    @property
    def choices(self) -> Choices:
        """What is set now."""
        low, high = self._limits.value
        return Choices(
            self._cloud.value,
            self._coloured.value,
            self._size.value,
            (low, high),
            self._colours.value,
            self._ground.value,
            self._shadow.value,
            None if self._map.value == _NO_MAP else self._map.value,
            self._zoom.value,
            self._views.value,
            self._plane.value,
            self._lines.value,
        )

    def follow(self, view: View) -> None:
        """Bring the sliders to where the radar is."""
        for slider, angle in ((self._azimuth, view.azimuth_deg % 360), (self._grazing, view.grazing_deg)):
            if slider.value != round(angle, 1):
                slider.value = round(angle, 1)

    def show_strip(self, picture: Any) -> None:
        """Show the images."""
        if self.strip is not None:
            self.strip.image = picture
            return
        with self._tab._tab_handles[0]:
            self.strip = self._gui.add_image(picture, format="png", order=1e11)

    def show_heads(self, heads: list[tuple[str, str]]) -> None:
        """Titles above the images, each with a smaller line."""
        cells = "".join(
            f'<div style="flex:1;min-width:0"><b>{escape(title)}</b>'
            f'<div style="font-size:11px;opacity:.75">{escape(line)}</div></div>'
            for title, line in heads
        )
        text = f'<div id="heads" style="display:flex;gap:6px;padding:0 10px;font-size:13px;line-height:1.35">{cells}</div>'
        if self.heads.content != text:
            self.heads.content = text

    def show_foot(self, legends: list[str], text: str) -> None:
        """What the colours mean, below the images, and a line of text."""
        cells = "".join(f'<div style="flex:1;min-width:0">{legend}</div>' for legend in legends)
        content = (
            f'<div style="display:flex;gap:10px;padding:0 10px">{cells}</div>'
            f'<div id="foot" style="font-size:13px;line-height:1.5;margin-top:4px;padding:0 10px">{text}</div>'
        )
        if self.foot.content != content:
            self.foot.content = content
