"""What is drawn in three dimensions."""

from __future__ import annotations

import numpy as np
import pytest

from sarsplat.geometry import View, radar_frame
from sarsplat.radar import Pixel
from sarsplat.viewer.stage import ground_lines, seen_through

pytest.importorskip("viser")

MIDDLE, REACH = np.array([1.0, -2.0, 0.0]), 6.0
TILTED = np.array([[-3.0, -4.0, 1.5], [4.0, -4.0, 1.5], [4.0, 4.0, -4.0], [-3.0, 4.0, -4.0]])  # through the ground


@pytest.mark.parametrize("pixel", [Pixel(18, 15), Pixel(0, 0)], ids=["on the target", "beside it"])
@pytest.mark.parametrize("grazing_deg", [5.0, 40.0, 85.0])
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
    highest = max(
        (np.array([stage.low, stage.high]) @ radar_frame(view)[1]).max(),
        stage.high[2] * np.cos(np.radians(grazing_deg)),
    )
    assert elevation[1] > highest + stage.size_m


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
    from scipy.spatial.transform import Rotation

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
