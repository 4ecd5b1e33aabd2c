"""Radar maps of a slope, a box and a wall, and the line of one azimuth and range."""

import math

import numpy as np
import pytest
import torch

from made import upright
from sarsplat import Gaussians, Ground, GroundBounce, Harmonics, SarsplatError, render
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.radar import Pixel, RadarMaps, Surface, contributions, iso_range_line, radar_maps, surface_of_mesh
from sarsplat.radar.maps import _unexplained

trimesh = pytest.importorskip("trimesh")

GRID = ImageGrid(48, 40, (0.25, 0.25), (0.3, 0.3))
VIEW = View(0.0, 40.0)  # the radar is at +x
THETA = math.radians(VIEW.grazing_deg)


def maps_of(mesh: "trimesh.Trimesh", view: View = VIEW, grid: ImageGrid = GRID) -> RadarMaps:
    return radar_maps(surface_of_mesh(mesh, grid.cell_m), view, grid)


def plate(tilt_deg: float, size: tuple[float, float] = (5.0, 5.0), height: float = 3.0) -> "trimesh.Trimesh":
    """A rectangle whose side towards the radar is lowered by `tilt_deg`."""
    mesh = trimesh.Trimesh(
        [[x * size[0] / 2, y * size[1] / 2, 0.0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))],
        [[0, 1, 2], [0, 2, 3]],
        process=False,
    )
    mesh.apply_transform(trimesh.transformations.rotation_matrix(math.radians(tilt_deg), [0, 1, 0]))
    mesh.apply_translation([0, 0, height])
    return mesh


def box(sides: tuple[float, float, float] = (4.0, 4.0, 2.0)) -> "trimesh.Trimesh":
    return trimesh.creation.box(sides, trimesh.transformations.translation_matrix((0, 0, sides[2] / 2)))


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, -15.0])
@pytest.mark.parametrize("view", [VIEW, View(180.0, 60.0)])
def test_a_slope_has_its_height_and_incidence_and_no_layover(tilt_deg, view):
    mesh = plate(tilt_deg)
    maps = maps_of(mesh, view)
    inside = ~np.isnan(maps.height_m)
    assert inside.sum() > 100
    # z and range grow linearly with x: so does z with range
    frame, along = radar_frame(view), mesh.vertices[1] - mesh.vertices[0]
    slope = along[2] / (frame[2] @ along)
    middle = mesh.vertices.mean(axis=0)
    expected = middle[2] + slope * (GRID.range_m[:, None] - frame[2] @ middle)
    core = np.zeros_like(inside)
    core[1:-1, 1:-1] = inside[1:-1, 1:-1] & inside[2:, 1:-1] & inside[:-2, 1:-1] & inside[1:-1, 2:] & inside[1:-1, :-2]
    error = (maps.height_m - expected)[core]
    assert abs(error.mean()) < 0.02
    assert error.std() < 0.05  # of pixels of 0.25 m
    incidence = math.degrees(math.acos(abs(mesh.face_normals[0] @ view.direction)))
    assert np.allclose(maps.incidence_deg[core], incidence, atol=0.1)
    assert not maps.layover[core].any()


def test_a_box_is_laid_over_in_front_and_throws_a_shadow_behind():
    depth, height = 4.0, 2.0
    maps = maps_of(box((depth, 4.0, height)))
    middle = slice(GRID.columns // 2 - 3, GRID.columns // 2 + 3)
    near = -depth / 2 * math.cos(THETA)
    top = near - height * math.sin(THETA)  # of the wall: the nearest range
    roof_end = depth / 2 * math.cos(THETA) - height * math.sin(THETA)
    shadow_end = (depth / 2 + height / math.tan(THETA)) * math.cos(THETA)
    r, margin = GRID.range_m, GRID.spacing_m[1]
    wall_and_roof = (r > top + margin) & (r < near - margin)
    roof = (r > near + margin) & (r < roof_end - margin)
    shadow = (r > max(roof_end, depth / 2 * math.cos(THETA)) + margin) & (r < shadow_end - margin)
    beyond = (r > shadow_end + margin) | (r < top - margin)
    assert min(wall_and_roof.sum(), roof.sum(), shadow.sum()) >= 2
    assert maps.layover[wall_and_roof][2:, middle].all()  # at its top, wall and roof are near one another
    assert not maps.layover[roof][:, middle].any()
    assert np.allclose(maps.height_m[roof][:, middle], height, atol=0.05)
    assert np.allclose(maps.incidence_deg[roof][:, middle], 90 - VIEW.grazing_deg, atol=0.5)
    assert maps.shadow[shadow][:, middle].all()
    assert not maps.shadow[beyond][:, middle].any()
    assert np.isnan(maps.height_m[beyond | shadow][:, middle]).all()


def test_the_spread_of_two_plates_is_their_distance_along_elevation():
    # displaced along elevation, so both have the same ranges, and neither hides the other
    apart, frame = 3.0, radar_frame(VIEW)
    plates = [plate(0.0, (2.0, 3.0)) for _ in range(2)]
    for mesh, side in zip(plates, (-1, 1), strict=True):
        mesh.apply_translation(side * apart / 2 * frame[1])
    maps = maps_of(trimesh.util.concatenate(plates))
    row = int(abs(GRID.range_m + 3.0 * math.sin(THETA)).argmin())
    seen = (slice(row - 1, row + 2), slice(GRID.columns // 2 - 3, GRID.columns // 2 + 3))
    assert np.allclose(maps.spread_m[seen], apart, rtol=0.02)
    assert np.allclose(maps.height_m[seen], 3.0, atol=0.1)  # the mean of both
    assert maps.layover[seen].all()


def test_what_hides_behind_something_else_does_not_count():
    frame = radar_frame(VIEW)
    front, back = plate(50.0, (3.0, 3.0), 6.0), plate(50.0, (1.0, 1.0), 6.0)  # they face the radar
    back.apply_translation(3.0 * frame[2])
    alone, both = maps_of(front), maps_of(trimesh.util.concatenate([front, back]))
    assert np.array_equal(np.isnan(alone.height_m), np.isnan(both.height_m))


@pytest.mark.parametrize(("part", "shown"), [(0.96, False), (1.04, True)])
def test_a_pixel_shows_what_has_half_the_area_of_flat_ground(part, shown):
    """A ball in the middle of a pixel, as large as that or a little smaller."""
    wanted, response = part * 0.5 * math.tan(THETA), 0.25**2 / (8 * math.log(2))  # m² per m², m²
    lit = 2.187  # of optical depth 5 at its middle, in 2πs²: ∫ (1 − exp(−5 e^{−x})) dx
    s = math.sqrt(wanted * response / (lit - wanted))  # lit·s² / (response + s²) is what the pixel's middle has
    middle = np.array([GRID.azimuth_m[20], 3.0, GRID.range_m[20]]) @ radar_frame(VIEW)
    ball = upright(middle, s, 5.0, 0.0)
    maps = radar_maps(Surface(ball, VIEW.direction[None]), VIEW, GRID, rays=RayGrid((0.01, 0.01)))
    assert (~np.isnan(maps.height_m)).sum() == shown


def test_what_a_slope_spreads_over_a_pixel_is_explained_whatever_its_direction():
    places = np.random.default_rng(0).normal(size=(5000, 2)) @ np.array([[1.0, 0.8], [0.0, 0.5]])
    noise = np.random.default_rng(1).normal(scale=0.3, size=5000)
    place = np.column_stack([places, places @ [0.7, -1.2] + noise])  # azimuth, range, elevation
    pairs = np.triu_indices(3)
    means = np.concatenate([np.zeros(4), place.mean(axis=0), (place[:, pairs[0]] * place[:, pairs[1]]).mean(axis=0)])
    assert _unexplained(means[:, None, None], GRID).item() == pytest.approx(0.3**2, rel=0.03)


@pytest.mark.parametrize(("depth", "hidden"), [(0.95 * math.log(2), False), (1.05 * math.log(2), True)])
def test_ground_is_in_shadow_if_half_of_its_light_is_taken(depth, hidden):
    haze = upright([0.0, 0.0, 4.0], [1.5, 1.5, 0.01], depth, 0.0)
    maps = radar_maps(Surface(haze, np.array([[0.0, 0.0, 1.0]])), VIEW, GRID)
    assert maps.shadow.any() == hidden


def test_the_maps_of_nothing_are_empty():
    maps = radar_maps(Surface(upright([]), np.zeros((0, 3))), VIEW, GRID)
    assert np.isnan(maps.height_m).all()
    assert not maps.shadow.any()


def test_normals_of_other_gaussians_and_pixels_outside_are_refused():
    one = upright(torch.zeros(1, 3))
    with pytest.raises(SarsplatError, match=r"normals has shape \(2, 3\); for 1 Gaussians it must be \(1, 3\)"):
        Surface(one, np.zeros((2, 3)))
    with pytest.raises(SarsplatError, match="there is no pixel in row 32 and column 0 of an image of 32 × 24"):
        contributions(balls(np.zeros((1, 3))), LOOK, PIXELS, Pixel(32, 0))


def test_aloft_there_is_no_shadow_and_the_target_is_seen_from_below() -> None:
    mesh = box()
    mesh.apply_translation((0, 0, -1))  # around the origin: above and below are alike
    above, below = (maps_of(mesh, View(20.0, grazing, aloft=True)) for grazing in (40.0, -40.0))
    assert not above.shadow.any() and not below.shadow.any()
    shown = np.isfinite(below.height_m)
    assert 0 < shown.mean() < 0.3
    assert shown.sum() == pytest.approx(np.isfinite(above.height_m).sum(), rel=0.05)
    assert np.nanmean(below.height_m) == pytest.approx(-np.nanmean(above.height_m), abs=0.02)


# ---- the line of one azimuth and range, and who is on it -------------------------------------------------------------
PIXELS = ImageGrid(32, 24, (0.3, 0.2), (0.4, 0.3), (0.5, -0.3))
LOOK = View(70.0, 35.0)
LOOKS = pytest.mark.parametrize("view", [LOOK, View(25.0, -40.0, 10.0, aloft=True, stretch=1.07)], ids=str)
PIXEL = Pixel(11, 15)


def balls(places: np.ndarray) -> Gaussians:
    n = len(places)
    turned = torch.tensor([0.9, 0.1, 0.3, 0.2]).repeat(n, 1)
    scales = torch.tensor([0.12, 0.08, 0.05]).repeat(n, 1)
    return Gaussians(torch.from_numpy(places).float(), turned, scales, torch.ones(n), Harmonics(torch.ones(n, 4)))


def at(azimuth: float, elevation: float, slant_range: float) -> np.ndarray:
    return np.array([azimuth, elevation, slant_range]) @ radar_frame(LOOK)


@LOOKS
def test_every_place_on_the_line_is_in_the_pixel_and_its_ends_are_on_the_box(view):
    low, high = np.array([-3.0, -2.0, -1.0]), np.array([3.0, 2.5, 4.0])
    ends = iso_range_line(view, PIXELS, PIXEL, low, high)
    azimuth, slant_range = view.look.gradients @ ends.T
    assert np.allclose(azimuth, PIXELS.azimuth_m[15])
    assert np.allclose(slant_range, PIXELS.range_m[11])
    assert np.diff(radar_frame(view)[1] @ ends.T) > 0
    assert ends[0, 2] < ends[1, 2]
    for end in ends:
        assert np.isclose(np.minimum(abs(end - low), abs(end - high)).min(), 0, atol=1e-9)
        assert (end >= low - 1e-9).all() and (end <= high + 1e-9).all()


def test_a_line_that_misses_the_box_is_none():
    assert iso_range_line(LOOK, PIXELS, PIXEL, np.full(3, 40.0), np.full(3, 41.0)) is None


def test_a_line_along_a_side_of_the_box_meets_it_or_not():
    """From azimuth 0 elevation has no part along y, so the whole line lies at one y."""
    view, y = View(0.0, 35.0), -PIXEL.place_m(PIXELS)[0]
    for first, meets in ((y - 0.1, True), (y + 0.1, False)):
        line = iso_range_line(view, PIXELS, PIXEL, np.array([-3, first, -1]), np.array([3, first + 2, 4]))
        assert (line is not None) == meets
        assert line is None or np.allclose(line[:, 1], y)


def test_two_scatterers_at_one_range_light_up_and_a_third_does_not():
    azimuth, slant_range = PIXEL.place_m(PIXELS)
    places = [at(azimuth, 2.0, slant_range), at(azimuth, -1.5, slant_range), at(azimuth, 2.0, slant_range + 2.0)]
    powers = contributions(balls(np.stack(places)), LOOK, PIXELS, PIXEL)
    assert powers[0] == pytest.approx(powers[1], rel=0.1)
    assert powers[0] > 0
    assert powers[2] == 0


@LOOKS
def test_the_contributions_add_up_to_the_pixel(view):
    chance = np.random.default_rng(3)
    scene = balls(chance.uniform(-1.5, 1.5, (200, 3)))
    for count in (200, 1, 0):
        image = render(scene[:count], [view], PIXELS).channel(0)[0]
        for pixel in (PIXEL, Pixel(16, 12), Pixel(0, 0)):
            parts = contributions(scene[:count], view, PIXELS, pixel)
            assert parts.shape == (count,)
            assert float(parts.sum()) == pytest.approx(float(image[pixel.row, pixel.column]), rel=1e-4, abs=1e-7)


def test_what_returns_by_way_of_the_ground_adds_up_to_the_pixel_of_that_echo():
    scene = balls(np.random.default_rng(3).uniform(-1.5, 1.5, (200, 3)))
    ground = Ground(torch.tensor(0.1), height_m=-0.5)
    bounce = GroundBounce(ground, torch.tensor(0.6))
    image = render(scene, [LOOK], PIXELS, ground=ground, echoes=[bounce]).echoes[1][0]
    for pixel in (PIXEL, Pixel(16, 12), Pixel(0, 0)):
        parts = contributions(scene, LOOK, PIXELS, pixel, bounce=bounce)
        assert float(parts.sum()) == pytest.approx(float(image[pixel.row, pixel.column]), rel=1e-4, abs=1e-7)
    assert float(image[16, 12]) > 0
    assert not parts[scene.means[:, 2].numpy() < -0.5].any()
