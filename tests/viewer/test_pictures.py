"""Colours, strips of images, the way back from a click to a pixel, and what is drawn in three dimensions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sarsplat.colours import DARK, DIFFERENCE, LIGHT, rgb
from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.radar import Pixel, RadarMaps
from sarsplat.viewer.pictures import MAPS, Scale, Strip, difference_panel, map_panel, power_panel
from sarsplat.viewer.stage import ground_lines, seen_through

pytest.importorskip("matplotlib")


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


# ---- in three dimensions ---------------------------------------------------------------------------------------------
MIDDLE, REACH = np.array([1.0, -2.0, 0.0]), 6.0
TILTED = np.array([[-3.0, -4.0, 1.5], [4.0, -4.0, 1.5], [4.0, 4.0, -4.0], [-3.0, 4.0, -4.0]])  # through the ground


@pytest.mark.parametrize("pixel", [Pixel(18, 15), Pixel(0, 0)], ids=["on the target", "beside it"])
@pytest.mark.parametrize("grazing_deg", [5.0, 85.0])
def test_the_line_of_a_pixel_runs_from_the_image_to_well_above_the_target(viewer, pixel, grazing_deg):
    view = View(50.0, grazing_deg)
    viewer.look_from(view)
    viewer.pick(pixel)
    assert viewer.wait(60)
    stage = viewer._stage
    assert stage._line.visible
    azimuth, elevation, slant_range = radar_frame(view) @ stage._line.points[0].T
    place = pixel.place_m(viewer._subject.maps_grid)
    np.testing.assert_allclose(np.stack([azimuth, slant_range]).T, [place] * 2, atol=1e-5)
    assert elevation[0] == pytest.approx(stage.plane_depth(view), abs=1e-5)
    corners = (np.array([stage.low, stage.high]) @ radar_frame(view)[1]).max()
    assert elevation[1] > max(corners, stage.high[2] * np.cos(np.radians(grazing_deg))) + stage.size_m


def test_what_is_not_highlighted_stays_visible(viewer):
    """On a dark page and on a light one: neither black nor white, and its colours can still be distinguished."""
    viewer.look_from(View(50.0, 40.0))
    viewer.pick(Pixel(18, 15))
    assert viewer.wait(60)
    colours = viewer._stage._cloud[1].colors.astype(int)
    assert colours.max(axis=1).min() > 50 and colours.min(axis=1).max() < 200
    assert np.abs(colours - colours[0]).sum(axis=1).max() > 60


def test_lines_of_the_ground_leave_out_the_image_while_it_is_shown(viewer):
    viewer.look_from(View(50.0, 40.0))
    lengths = []
    for shown in (True, False):
        viewer._controls._set["plane"].value = shown
        viewer._ask()
        assert viewer.wait(60)
        starts, ends = np.swapaxes(viewer._stage.grid.points, 0, 1)
        lengths.append(np.linalg.norm(ends - starts, axis=1).sum())
    assert lengths[0] < 0.95 * lengths[1]


@pytest.mark.parametrize("view", [View(50.0, 40.0, 10.0, "left"), View(50.0, -40.0, 80.0, "left", aloft=True)])
def test_the_image_of_a_radar_that_looks_left_lies_where_its_pixels_are(viewer, view):
    viewer.look_from(view)
    assert viewer.wait(60)
    stage, part = viewer._stage, viewer._part
    picture = np.zeros((part.rows, part.columns, 3), np.uint8)
    picture[0, 0] = 200  # near range, at the end of the azimuths
    stage.lay_image(picture, view, part, visible=True)
    plane = stage._plane[0]
    row, column = np.argwhere(np.asarray(plane.image)[..., 0] == 200)[0] if plane.image is not None else (0, 0)
    across = (column - (part.columns - 1) / 2) * part.spacing_m[0]
    down = (row - (part.rows - 1) / 2) * part.spacing_m[1]
    turn = Rotation.from_quat(plane.wxyz, scalar_first=True).as_matrix()
    place = np.asarray(plane.position) + turn @ (across, down, 0.0)
    azimuth, _, slant_range = radar_frame(view) @ place
    assert (azimuth, slant_range) == pytest.approx((part.azimuth_m[0], part.range_m[0]), abs=1e-6)


def test_dragged_on_the_radar_looks_as_it_did(viewer):
    stage = viewer._stage
    stage.aim(View(50.0, -40.0, 30.0, "left", aloft=True))
    low = stage.view_under(np.array([30.0, 5.0, -30.0]), stage._foot)
    assert low.grazing_deg < -10 and (low.tilt_deg, low.side, low.aloft) == (30.0, "left", True)
    stage.aim(View(50.0, 40.0))
    assert stage.view_under(np.array([30.0, 5.0, -30.0]), stage._foot).grazing_deg == 1.0


def in_the_picture(eye, place, corners):
    """Whether the ray from the eye through a place on the ground meets the picture behind that, well inside."""
    across, down = corners[1] - corners[0], corners[3] - corners[0]
    a, b, distance = np.linalg.solve(np.stack([across, down, eye - place], axis=1), eye - corners[0])
    return distance > 1.001 and 0.01 < a < 0.99 and 0.01 < b < 0.99


@pytest.mark.parametrize("eye", [(-9.0, -7.0, 6.0), (12.0, 3.0, 2.0), (0.0, 9.0, 14.0), (3.0, -12.0, -5.0)])
def test_no_line_crosses_the_picture_and_none_is_missing_beside_it(eye):
    eye = np.array(eye)
    lines = ground_lines(MIDDLE, REACH, 1.0, seen_through(TILTED, eye))
    every = ground_lines(MIDDLE, REACH, 1.0, np.empty((0, 2)))
    assert len(every) == 2 * 13
    shares = np.linspace(0, 1, 120)[:, None]
    places = np.concatenate([start + shares * (end - start) for start, end in every])
    hidden = np.array([in_the_picture(eye, place, TILTED) for place in places])
    assert 0 < hidden.sum() < len(places)
    drawn = np.concatenate([start + shares * (end - start) for start, end in lines])
    assert not any(in_the_picture(eye, place, TILTED) for place in drawn)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum()
    assert length == pytest.approx((~hidden).mean() * 2 * 13 * 2 * REACH, rel=0.05)


def test_a_picture_above_the_ground_hides_no_line():
    assert len(seen_through(TILTED + np.array([0, 0, 5.0]), np.array([0.0, 9.0, 14.0]))) == 0
