"""A place on earth: the world frame there, exactly, against pyproj and by what must hold."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from made import tiny_dataset
from sarsplat import Place, SarsplatError, View, read_dataset, write_dataset

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
def test_points_come_back_from_geocentric_and_geodetic_coordinates(place):
    np.testing.assert_allclose(place.from_ecef(place.to_ecef(POINTS)), POINTS, atol=5e-9)
    np.testing.assert_allclose(place.from_geodetic(place.to_geodetic(POINTS)), POINTS, atol=1e-8)
    np.testing.assert_allclose(place.to_geodetic(POINTS[0])[[0, 2]], [place.latitude_deg, place.height_m], atol=1e-8)
    assert np.linalg.det(place.axes) == pytest.approx(1)


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_conversions_are_those_of_pyproj(place):
    pyproj = pytest.importorskip("pyproj")
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    local = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=topocentric +ellps=WGS84 +lat_0={place.latitude_deg!r} "
        f"+lon_0={place.longitude_deg!r} +h_0={place.height_m!r}"
    )
    ecef = place.to_ecef(POINTS)
    longitude, latitude, height = geodetic.transform(*ecef.T)
    found = place.to_geodetic(POINTS)
    np.testing.assert_allclose(found[:, 0], latitude, atol=1e-12)
    np.testing.assert_allclose(np.cos(np.radians(found[:, 1] - longitude)), 1, atol=1e-15)
    np.testing.assert_allclose(found[:, 2], height, atol=2e-8)
    np.testing.assert_allclose(place.enu(POINTS), np.transpose(local.transform(*ecef.T)), atol=1e-8)


def test_x_points_to_its_bearing_and_a_radars_bearing_is_its_azimuth_plus_that():
    """Where bearings count from: 30° is north of east by 60°."""
    place = Place(48.0, 11.0, 500.0, x_towards_deg=30.0)
    ahead, left = place.to_geodetic(np.array([[100.0, 0, 0], [0, 100.0, 0]]))
    metre = 111_190  # of latitude, per degree
    assert (ahead[0] - 48) * metre == pytest.approx(100 * np.cos(np.radians(30)), rel=2e-3)
    assert ahead[1] > 11 > left[1]
    view = View(75.0, 40.0)
    east, north, _ = place.enu(view.look.facing)
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(place.bearing_deg(75.0)) == pytest.approx(105.0)


def test_the_frame_is_level_at_the_origin_alone():
    assert Place(50.0, 9.0, 100.0).to_geodetic(np.array([1000.0, 0, 0]))[2] == pytest.approx(100.078, abs=1e-3)


def test_a_longitude_counts_on_across_the_date_line():
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
