"""Frames, angles, pixel positions (docs/reference/conventions.md §1), stacks, and places on earth."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from made import tiny_dataset
from sarsplat import ImageGrid, Place, RayGrid, SarsplatError, Stack, View, read_dataset, write_dataset
from sarsplat.geometry.view import seen_alike

CHANCE = np.random.default_rng(0)
VIEWS = [View(azimuth, grazing) for azimuth in range(-720, 721, 90) for grazing in (0.01, 45.0, 89.99)]
VIEWS += [View(*angles) for angles in CHANCE.uniform((-720, 0.01), (720, 89.99), (50, 2))]


def test_pixel_centres():
    even = ImageGrid(4, 6, spacing_m=(0.5, 0.25), resolution_m=(0.6, 0.3))
    assert even.azimuth_m == pytest.approx([-1.25, -0.75, -0.25, 0.25, 0.75, 1.25])
    assert even.range_m == pytest.approx([-0.375, -0.125, 0.125, 0.375])
    odd = ImageGrid(3, 1, spacing_m=(0.5, 0.25), resolution_m=(0.6, 0.3), center_m=(10.0, -2.0))
    assert odd.azimuth_m == pytest.approx([10.0])
    assert odd.range_m == pytest.approx([-2.25, -2.0, -1.75])


def test_rays_to_a_pixel():
    grid = ImageGrid(4, 6, spacing_m=(0.5, 0.2), resolution_m=(0.6, 0.3))
    assert RayGrid.for_image(grid).spacing_m == (0.1, 0.1)  # half of the finer spacing
    assert RayGrid.for_image(grid, per_pixel=4).spacing_m == (0.05, 0.05)
    assert RayGrid((0.1, 0.3)).cell_area == pytest.approx(0.03)


def test_a_view_towards_a_direction_is_the_view_from_there():
    assert View.towards(np.array([0.0, 0.0, 3.0])).grazing_deg == 89.999  # the zenith
    for view, length in itertools.product(VIEWS, (1e-3, 1.0, 1e3)):
        again = View.towards(length * view.direction)
        assert 0 <= again.azimuth_deg <= 360
        assert again.direction == pytest.approx(view.direction, abs=1e-9)
        assert again.grazing_deg == pytest.approx(view.grazing_deg, abs=1e-6)


def test_numbers_of_every_kind_are_angles_and_count_pixels_limits_included():
    assert View(np.float32(30), 40) == View(30.0, np.int64(40))
    assert json.dumps(View(np.float32(30), np.int64(40)).as_dict()) == '{"azimuth_deg": 30.0, "grazing_deg": 40.0}'
    assert View(3600, 40).direction == pytest.approx(View(0, 40).direction, abs=1e-12)
    grid = ImageGrid(np.int64(4), np.int32(5), (0.2, 0.2), (0.3, 0.3))
    assert json.dumps([grid.rows, grid.columns]) == "[4, 5]"
    shortest = ImageGrid(1, 131_072, (1e-6, 1e6), (1e6, 1e-6), (-1e6, 1e6))
    assert ImageGrid(131_072, 1, *(getattr(shortest, f"{name}_m") for name in ("spacing", "resolution", "center")))


def test_cells_and_independent_samples_are_the_coarser_of_pixel_and_resolution():
    fine = ImageGrid(10, 20, spacing_m=(0.1, 0.2), resolution_m=(0.4, 0.8))
    assert fine.cell_m == pytest.approx(math.sqrt(0.4 * 0.8))
    assert fine.independent_samples == pytest.approx(10 * 20 / 16)
    mixed = ImageGrid(10, 20, spacing_m=(0.5, 0.2), resolution_m=(0.4, 0.8))
    assert mixed.cell_m == pytest.approx(math.sqrt(0.5 * 0.8))
    assert mixed.independent_samples == pytest.approx(10 * 20 / 4)


@pytest.mark.parametrize(("azimuth", "grazing"), [(0, 30), (35, 20), (123.4, 10), (271, 70)])
def test_a_turntable_is_seen_as_a_radar_that_flies_around_it(azimuth, grazing):
    """Clockwise, as azimuths run: the target turns the other way, and the scene is on the radar's right."""
    level = View(azimuth, grazing)
    view = View.isar(level.direction, (0, 0, 1))
    assert (view.tilt_deg, view.side, view.unusual) == (0.0, "right", "")
    assert view.look.frame == pytest.approx(level.look.frame)
    assert View.isar(level.direction, (0, 0, -1)).side == "left"
    assert View.isar((1e-300, 0, 1e-300), (0, 1e300, 1e300)) == View.isar((1, 0, 1), (0, 1, 1))


def test_a_direction_is_looked_from_as_all_known_views_look() -> None:
    left = [View(10, 30, 12.2, "left"), View(80, 40, 12.0, "left"), View(90, 40, 12.4, "left")]
    assert seen_alike(left, 50, 60) == View(50, 60, 12.2, "left")
    assert seen_alike([*left, View(10, 30, 12.2)], 50, 60) == View(50, 60)
    assert seen_alike([View(10, 30), View(10, 30, 5)], 50, 60) == View(50, 60)
    assert seen_alike([View(10, -30, 60, aloft=True), View(20, 0, -20, aloft=True)], 5, -8) == View(5, -8, aloft=True)


# ---- stacks ----------------------------------------------------------------------------------------------------------
def test_evenly_spaced_passes_repeat_after_as_many_resolutions_as_there_are_gaps() -> None:
    stack = Stack(0.03, tuple(0.001 * k for k in range(8)))
    assert stack.resolution_m == pytest.approx(0.03 / (2 * 0.007))
    assert stack.ambiguous_elevation_m == pytest.approx(7 * stack.resolution_m, rel=0.01)
    assert Stack(0.03, stack.offsets_rad, transmit="one").resolution_m == pytest.approx(2 * stack.resolution_m)

    # a ruler of marks 0, 1, 4, 9, 11 measures each length once: uneven passes are alike after all eleven
    ruler = Stack(0.03, tuple(0.007 / 11 * mark for mark in (0, 1, 4, 9, 11)))
    assert ruler.ambiguous_elevation_m == pytest.approx(11 * ruler.resolution_m, rel=0.01)


def test_one_pass_or_several_polarisations_tell_no_elevation() -> None:
    alone = Stack(0.03, (0.0,))
    assert alone.resolution_m == alone.ambiguous_elevation_m == math.inf
    assert not alone.interferometric
    assert not Stack(0.03, (0.0, 0.0), polarisations=("HH", "VV")).interferometric
    assert not Stack(0.03, (0.0, 0.0, 0.001), polarisations=("HH", "VV", "HH")).interferometric
    assert Stack(0.03, (0.0, 0.001), polarisations=("HH", "HH")).interferometric


# ---- a place on earth ------------------------------------------------------------------------------------------------
PLACES = [
    Place(45.29, 7.5, 312.0, 90.0),
    Place(-33.9, 151.2, -12.0, 17.0),  # south
    Place(64.1, -179.9999, 5.0, 200.0),  # beside the date line
    Place(0.0, 0.0, 0.0, 0.0),
    Place(89.9999, 40.0, 100.0, 90.0),  # 11 m from the pole
    Place(-90.0, 0.0, 2800.0, 90.0),
]
POINTS = np.concatenate([np.zeros((1, 3)), np.random.default_rng(0).normal(size=(50, 3)) * [2e3, 2e3, 100]])


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_conversions_are_those_of_pyproj_and_points_come_back(place):
    pyproj = pytest.importorskip("pyproj")
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    local = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=topocentric +ellps=WGS84 +lat_0={place.latitude_deg!r} "
        f"+lon_0={place.longitude_deg!r} +h_0={place.height_m!r}"
    )
    ecef, found = place.to_ecef(POINTS), place.to_geodetic(POINTS)
    np.testing.assert_allclose(place.from_ecef(ecef), POINTS, atol=5e-9)
    np.testing.assert_allclose(place.from_geodetic(found), POINTS, atol=1e-8)
    np.testing.assert_allclose(found[0, [0, 2]], [place.latitude_deg, place.height_m], atol=1e-8)
    longitude, latitude, height = geodetic.transform(*ecef.T)
    np.testing.assert_allclose(found[:, 0], latitude, atol=1e-12)
    np.testing.assert_allclose(np.cos(np.radians(found[:, 1] - longitude)), 1, atol=1e-15)
    np.testing.assert_allclose(found[:, 2], height, atol=2e-8)
    level = replace(place, x_towards_deg=90.0)  # x to the east
    np.testing.assert_allclose(level.from_ecef(ecef), np.transpose(local.transform(*ecef.T)), atol=1e-8)


def test_x_points_to_its_bearing_and_a_radars_bearing_is_its_azimuth_plus_that():
    """Where bearings count from: 30° is north of east by 60°."""
    place = Place(48.0, 11.0, 500.0, x_towards_deg=30.0)
    ahead, left = place.to_geodetic(np.array([[100.0, 0, 0], [0, 100.0, 0]]))
    metre = 111_190  # of latitude, per degree
    assert (ahead[0] - 48) * metre == pytest.approx(100 * np.cos(np.radians(30)), rel=2e-3)
    assert ahead[1] > 11 > left[1]
    view = View(75.0, 40.0)
    east, north, _ = replace(place, x_towards_deg=90.0).from_ecef(place.to_ecef(view.look.facing))
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(place.bearing_deg(75.0)) == pytest.approx(105.0)


def test_the_frame_is_level_at_the_origin_alone_and_longitudes_count_on_across_the_date_line():
    assert Place(50.0, 9.0, 100.0).to_geodetic(np.array([1000.0, 0, 0]))[2] == pytest.approx(100.078, abs=1e-3)
    assert Place(10.0, 359.0, 0.0) == Place(10.0, -1.0, 0.0)
    assert Place(10.0, 180.0, 0.0).to_geodetic(np.array([10.0, 0, 0]))[1] < -179.99


def test_a_dataset_keeps_it(tmp_path):
    place = Place(-12.5, 179.999, 33.25, 271.0, "sea level")
    made = write_dataset(tmp_path / "made", tiny_dataset(place=place))
    assert read_dataset(tmp_path / "made").place == place
    header = json.loads((tmp_path / "made" / "dataset.json").read_text())
    assert header["place"] == {
        **{"latitude_deg": -12.5, "longitude_deg": 179.999, "height_m": 33.25, "x_towards_deg": 271.0},
        **{"height_above": "sea level", "datum": "WGS 84"},
    }
    assert made.select("train").place == place
    assert replace(made, place=None).fingerprint() != made.fingerprint()

    write_dataset(tmp_path / "none", tiny_dataset())
    assert "place" not in json.loads((tmp_path / "none" / "dataset.json").read_text())  # as before
    path = tmp_path / "made" / "dataset.json"
    path.write_text(path.read_text().replace('"latitude_deg": -12.5', '"latitude_deg": 123'))
    with pytest.raises(SarsplatError, match=r"dataset\.json: latitude_deg 123"):
        read_dataset(made.path)
