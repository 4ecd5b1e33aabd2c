"""Colours, strips of images, and the way back from a click to a pixel."""

import numpy as np
import pytest

from sarsplat.colours import DARK, DIFFERENCE, LIGHT, rgb
from sarsplat.geometry import ImageGrid
from sarsplat.radar import Pixel, RadarMaps

pytest.importorskip("matplotlib")

from sarsplat.viewer.pictures import MAPS, Scale, Strip, difference_panel, map_panel, power_panel

GRID = ImageGrid(20, 30, (0.4, 0.2), (0.5, 0.5))


def panel_of(value: float = 1.0):
    return power_panel("rendered", np.full((20, 30), value, np.float32), 1.0, (-40.0, 0.0), "gray", DARK)


def test_white_is_the_brightest_and_black_the_bottom_of_the_range():
    assert (panel_of(1.0).rgb == 255).all()
    assert (panel_of(1e-4).rgb == 0).all()
    assert (panel_of(0.0).rgb == 0).all()
    assert abs(int(panel_of(1e-2).rgb[0, 0, 0]) - 128) <= 1


def test_what_is_unknown_is_neither_end_of_the_scale():
    scale = Scale("height, m", 0.0, 2.0, "viridis", DARK)
    low, high, unknown = scale.rgb(np.array([0.0, 2.0, np.nan]))
    assert not (unknown == low).all() and not (unknown == high).all()
    assert "height, m" in scale.bar() and "2.0" in scale.bar()
    assert (Scale("height, m", 0.0, 0.0, "viridis", DARK).rgb(np.zeros(3)) == low).all()  # of no width


def test_equal_images_differ_nowhere_and_what_is_dark_in_both_is_equal():
    image = np.full((20, 30), 0.1, np.float32)
    middle = Scale("", -6, 6, DIFFERENCE, DARK).rgb(np.zeros(1))[0]
    for other in (image, image.copy()):
        assert (difference_panel(image, other, 1.0, -40.0, DARK, speckled=False).rgb == middle).all()
    dark = difference_panel(image * 1e-6, image * 1e-9, 1.0, -40.0, DARK, speckled=True)
    assert (dark.rgb == middle).all()
    brighter = difference_panel(image * 2, image, 1.0, -40.0, DARK, speckled=False).rgb[0, 0].astype(int)
    assert brighter[0] > brighter[2] + 30  # orange


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_click_finds_the_pixel_that_is_drawn_there(count):
    strip = Strip(GRID, count, DARK)
    for pixel in (Pixel(0, 0), Pixel(19, 29), Pixel(7, 12)):
        marked = panel_of(0.0)
        marked.rgb[pixel.row, pixel.column] = 255
        picture = strip.drawn([panel_of(0.0)] * (count - 1) + [marked], None)
        rows, columns = np.nonzero((picture == 255).all(axis=-1))
        for row, column in ((rows[0], columns[0]), (rows[-1], columns[-1])):
            place = (column + 0.5) / picture.shape[1], (row + 0.5) / picture.shape[0]
            assert strip.pixel_at(*place) == pixel
    height, width, _ = picture.shape
    assert (width - 6 * (count - 1)) / count / height == pytest.approx(30 * 0.4 / (20 * 0.2), rel=0.02)  # as the ground
    assert strip.pixel_at(0.2, 1.0) is None
    assert count != 2 or strip.pixel_at(0.5, 0.5) is None  # between two panels


def test_a_picked_pixel_is_framed_in_every_panel():
    strip, panel = Strip(GRID, 3, DARK), panel_of(0.0)
    plain, framed = strip.drawn([panel] * 3, None), strip.drawn([panel] * 3, Pixel(10, 15))
    columns = np.nonzero((plain != framed).any(axis=(0, 2)))[0]
    assert len(np.nonzero(np.diff(columns) > 20)[0]) >= 2  # in three places
    assert strip.drawn([panel] * 3, Pixel(0, 29)).shape == plain.shape  # at an edge


@pytest.mark.parametrize("name", MAPS)
def test_every_map_has_a_picture_and_a_legend(name):
    some = np.full((20, 30), np.nan, np.float32)
    some[5:9] = 1.0
    maps = RadarMaps(some, 40 * some, some, some == 1, np.roll(some == 1, 6, axis=0))
    panel = map_panel(name, maps, 2.0, 0.3, DARK)
    assert panel.rgb.shape == (20, 30, 3)
    assert len(np.unique(panel.rgb.reshape(-1, 3), axis=0)) >= 2
    assert panel.legend


@pytest.mark.parametrize("page", [DARK, LIGHT])
def test_what_is_empty_has_the_colour_of_the_page(page):
    image = np.full((20, 30), 0.1, np.float32)
    nothing = np.full((20, 30), np.nan, np.float32)
    shadowless = RadarMaps(nothing, nothing, nothing, np.zeros((20, 30), bool), np.zeros((20, 30), bool))
    equal = difference_panel(image, image, 1.0, -40.0, page, speckled=False)
    for panel in (equal, map_panel("shadow and layover", shadowless, 2.0, 0.3, page)):
        assert (np.abs(panel.rgb.astype(int) - rgb(page.card)) <= 1).all()
        framed = Strip(GRID, 1, page).enlarged(panel)
        assert (framed[0] == rgb(page.muted)).all() and (framed[5:-5, 5:-5] != rgb(page.muted)).any()
