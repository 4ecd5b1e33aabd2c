"""The line of one azimuth and range, and who is on it."""

import numpy as np
import pytest
import torch

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Ground, Harmonics
from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.radar import Pixel, contributions, iso_range_line
from sarsplat.renderer import GroundBounce, render

GRID = ImageGrid(32, 24, (0.3, 0.2), (0.4, 0.3), (0.5, -0.3))
VIEW = View(70.0, 35.0)
PIXEL = Pixel(11, 15)


def balls(places: np.ndarray) -> Gaussians:
    n = len(places)
    turned = torch.tensor([0.9, 0.1, 0.3, 0.2]).repeat(n, 1)
    scales = torch.tensor([0.12, 0.08, 0.05]).repeat(n, 1)
    return Gaussians(torch.from_numpy(places).float(), turned, scales, torch.ones(n), Harmonics(torch.ones(n, 4)))


def at(azimuth: float, elevation: float, slant_range: float) -> np.ndarray:
    return np.array([azimuth, elevation, slant_range]) @ radar_frame(VIEW)


def test_every_place_on_the_line_is_in_the_pixel_and_its_ends_are_on_the_box():
    low, high = np.array([-3.0, -2.0, -1.0]), np.array([3.0, 2.5, 4.0])
    ends = iso_range_line(VIEW, GRID, PIXEL, low, high)
    azimuth, elevation, slant_range = radar_frame(VIEW) @ ends.T
    assert np.allclose(azimuth, GRID.azimuth_m[15])
    assert np.allclose(slant_range, GRID.range_m[11])
    assert elevation[0] < elevation[1]
    assert ends[0, 2] < ends[1, 2]
    for end in ends:
        assert np.isclose(np.minimum(abs(end - low), abs(end - high)).min(), 0, atol=1e-9)
        assert (end >= low - 1e-9).all() and (end <= high + 1e-9).all()


def test_a_line_that_misses_the_box_is_none():
    assert iso_range_line(VIEW, GRID, PIXEL, np.full(3, 40.0), np.full(3, 41.0)) is None


def test_a_line_along_a_side_of_the_box_meets_it_or_not():
    """From azimuth 0 elevation has no part along y, so the whole line lies at one y."""
    view, y = View(0.0, 35.0), -PIXEL.place_m(GRID)[0]
    for first, meets in ((y - 0.1, True), (y + 0.1, False)):
        line = iso_range_line(view, GRID, PIXEL, np.array([-3, first, -1]), np.array([3, first + 2, 4]))
        assert (line is not None) == meets
        assert line is None or np.allclose(line[:, 1], y)


def test_two_scatterers_at_one_range_light_up_and_a_third_does_not():
    azimuth, slant_range = PIXEL.place_m(GRID)
    places = [at(azimuth, 2.0, slant_range), at(azimuth, -1.5, slant_range), at(azimuth, 2.0, slant_range + 2.0)]
    powers = contributions(balls(np.stack(places)), VIEW, GRID, PIXEL)
    assert powers[0] == pytest.approx(powers[1], rel=0.1)
    assert powers[0] > 0
    assert powers[2] == 0


def test_the_contributions_add_up_to_the_pixel():
    chance = np.random.default_rng(3)
    scene = balls(chance.uniform(-1.5, 1.5, (200, 3)))
    for count in (200, 1, 0):
        image = render(scene[:count], [VIEW], GRID).channel(0)[0]
        for pixel in (PIXEL, Pixel(16, 12), Pixel(0, 0)):
            parts = contributions(scene[:count], VIEW, GRID, pixel)
            assert parts.shape == (count,)
            assert float(parts.sum()) == pytest.approx(float(image[pixel.row, pixel.column]), rel=1e-4, abs=1e-7)


def test_what_returns_by_way_of_the_ground_adds_up_to_the_pixel_of_that_echo():
    scene = balls(np.random.default_rng(3).uniform(-1.5, 1.5, (200, 3)))
    ground = Ground(torch.tensor(0.1), height_m=-0.5)
    bounce = GroundBounce(ground, torch.tensor(0.6))
    image = render(scene, [VIEW], GRID, ground=ground, echoes=[bounce]).echoes[1][0]
    for pixel in (PIXEL, Pixel(16, 12), Pixel(0, 0)):
        parts = contributions(scene, VIEW, GRID, pixel, bounce=bounce)
        assert float(parts.sum()) == pytest.approx(float(image[pixel.row, pixel.column]), rel=1e-4, abs=1e-7)
    assert float(image[16, 12]) > 0
    assert not parts[scene.means[:, 2].numpy() < -0.5].any()


def test_a_pixel_outside_is_refused():
    with pytest.raises(SarsplatError, match="there is no pixel in row 32 and column 0 of an image of 32 × 24"):
        contributions(balls(np.zeros((1, 3))), VIEW, GRID, Pixel(32, 0))
