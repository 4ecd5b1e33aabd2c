"""The report in a browser: it works offline, turns, and can be read on a phone."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chromium import Page, chromium
from made_runs import make_dataset, make_metrics, make_run
from sarsplat import View, write_report

SMALL_TEXT = """
(() => {
  const small = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode, parent = node.parentElement;
    if (!node.data.trim() || ["SCRIPT", "STYLE", "NOSCRIPT"].includes(parent.tagName)) continue;
    const style = getComputedStyle(parent), box = parent.getBoundingClientRect();
    if (style.visibility === "hidden" || box.width === 0 || box.height === 0) continue;
    if (parseFloat(style.fontSize) < 11) small.push(node.data.trim() + " " + style.fontSize);
  }
  return small;
})()
"""

FIRST_OVERFLOWING = """
[...document.querySelectorAll("body *")].filter((e) => e.getBoundingClientRect().right > innerWidth + 1
  && !e.closest("pre") && getComputedStyle(e).position !== "absolute").slice(0, 5).map((e) => e.className || e.tagName)
"""


DRAWN = """
(() => {
  const {width, height} = cloud, data = cloud.getContext("2d").getImageData(0, 0, width, height).data;
  let [left, right, top, bottom] = [width, 0, height, 0];
  for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) if (data[4 * (y * width + x) + 3]) {
    left = Math.min(left, x); right = Math.max(right, x); top = Math.min(top, y); bottom = Math.max(bottom, y);
  }
  return [(right - left) / width, (bottom - top) / height];
})()
"""
"""How much of the width and of the height of the box something is drawn in."""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of views from one grazing angle."""
    return written(tmp_path_factory.mktemp("report"))


def written(folder: Path, **grazing_deg: float) -> str:
    """The address of a report; the views have a grazing angle of 30° except those of the splits named."""
    metrics = make_metrics(registered_nats_per_pixel=0.5, registered_log_correlation=0.8)
    metrics["baselines"] = {"test": {"rotated_average": {"registered_nats_per_pixel": 0.6}}}
    dataset = make_dataset(folder, measured=True)
    brighter = np.arange(1, 1 + len(dataset), dtype=np.float32)[:, None, None]  # no two images are the same
    entries = [
        replace(entry, view=replace(entry.view, grazing_deg=grazing_deg.get(entry.split, 30.0)))
        for entry in dataset.entries
    ]
    dataset = replace(dataset, power=dataset.power * brighter, entries=tuple(entries))

    def render(views: Sequence[View]) -> np.ndarray:
        levels = [0.1 + view.azimuth_deg / 20 + view.grazing_deg / 5 for view in views]
        return np.stack([np.full((32, 32), level, np.float32) for level in levels])

    return write_report(make_run(folder, dataset, metrics, render=render)).as_uri()


@pytest.fixture(scope="module")
def tab() -> Iterator[Page]:
    with chromium() as browser:
        yield browser.page


def ready(tab: Page, report: str, width: int = 1400) -> None:
    """Open a report and wait until its images are there."""
    tab.size(width, 900)
    tab.open(report)
    tab.until("document.getElementById('sar-true-title').textContent.startsWith('measured, azimuth')")


def pixels(tab: Page, canvas: str) -> str:
    return str(tab.value(f"document.getElementById('{canvas}').toDataURL()"))


def test_a_drag_turns_the_points_and_changes_the_images(tab: Page, report: str) -> None:
    ready(tab, report)
    canvases = ("cloud", "sar-rendered", "sar-true", "sar-error")
    before = {name: pixels(tab, name) for name in canvases}
    tab.value("document.getElementById('stage').scrollIntoView({block: 'center'})")
    box = tab.value("(({x, y, width, height}) => [x, y, width, height])(stage.getBoundingClientRect())")
    x, y = box[0] + box[2] / 2, box[1] + box[3] / 2
    tab.mouse("mousePressed", x, y)
    for step in range(1, 5):
        tab.mouse("mouseMoved", x + 25 * step, y)
    tab.mouse("mouseReleased", x + 100, y)
    tab.until(f"document.getElementById('cloud').toDataURL() !== {before['cloud']!r}")
    assert float(tab.value("document.getElementById('azimuth').value")) == pytest.approx(20 + 50, abs=1)
    assert "azimuth 60°" in tab.value("document.getElementById('sar-true-title').textContent")
    assert {name for name in canvases if pixels(tab, name) != before[name]} >= {"cloud", "sar-rendered", "sar-true"}
    assert tab.complaints == []


def test_a_grazing_angle_is_offered_only_where_it_changes_the_image(tab: Page, report: str, tmp_path: Path) -> None:
    ready(tab, report)
    assert not tab.value("document.getElementById('grazing') !== null")
    tab.value("document.getElementById('stage').focus()")
    tab.key("ArrowUp")
    assert "grazing 30°" in tab.value("document.getElementById('sar-rendered-title').textContent")

    ready(tab, written(tmp_path, test=60.0))
    assert tab.value("[grazing.min, grazing.max].map(Number)") == [30, 60]
    for angle in (30, 60):
        before = pixels(tab, "sar-rendered")
        tab.value(f"grazing.value = {angle}; grazing.dispatchEvent(new Event('input'))")
        tab.until(f"document.getElementById('sar-rendered-title').textContent.endsWith('grazing {angle}°')")
    assert pixels(tab, "sar-rendered") != before


def test_pictures_use_the_room_of_a_wide_page(tab: Page, report: str) -> None:
    ready(tab, report)
    assert min(tab.value("[...document.querySelectorAll('.widget .frame')].map(e => e.offsetWidth)")) > 280
    boards = "[...document.querySelectorAll('.board .panels')].map(e => e.lastElementChild.offsetTop - e.offsetTop)"
    assert max(tab.value(boards)) < 50  # all three sides in one row
    drawn = tab.value(DRAWN)
    assert max(drawn) > 0.9 and min(drawn) > 0.7


def test_no_request_leaves_the_machine(report: str) -> None:
    with chromium() as browser:
        ready(browser.page, report)
        assert browser.quit() == []


def test_keys_turn_it_and_the_range_darkens_it(tab: Page, report: str) -> None:
    ready(tab, report)
    azimuth = float(tab.value("document.getElementById('azimuth').value"))
    tab.value("document.getElementById('stage').focus()")
    tab.key("ArrowRight")
    tab.until(f"Number(document.getElementById('azimuth').value) === {azimuth + 5}")
    before = pixels(tab, "sar-rendered")
    tab.value("document.getElementById('depth').value = 12; depth.dispatchEvent(new Event('input'))")
    tab.until(f"document.getElementById('sar-rendered').toDataURL() !== {before!r}")
    assert tab.value("document.querySelector('#power-bar .tick').textContent") == "−12"


@pytest.mark.parametrize("width", [390, 1400])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_can_be_read_and_nothing_sticks_out(tab: Page, report: str, width: int, scheme: str) -> None:
    tab.scheme(scheme)
    ready(tab, report, width)
    assert tab.value(SMALL_TEXT) == []
    assert tab.value("document.documentElement.scrollWidth") <= width, tab.value(FIRST_OVERFLOWING)
    light = tab.value("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert (min(light) > 200) == (scheme == "light")
