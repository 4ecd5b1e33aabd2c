"""Exports of a run that knows where on earth it is, read back by programs that are not ours."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from made import upright
from made_runs import at, with_points
from sarsplat import Place, Run, SarsplatError, SarsplatWarning, View, export, write_gaussians_ply
from sarsplat.cli import main
from sarsplat.exports.format_geojson import rings_of
from sarsplat.exports.georeference import MapSystem, usual_system, write_place

laspy, pyproj = pytest.importorskip("laspy"), pytest.importorskip("pyproj")

PLACES = {
    "north": (Place(45.29, 7.5, 312.0, 90.0), "EPSG:32632"),
    "south, turned": (Place(-33.9, 151.2, -12.0, 17.0), "EPSG:32756"),
    "at the date line": (Place(64.1, -179.9999, 5.0, 200.0), "EPSG:32601"),
    "on the date line": (Place(10.0, 180.0, 5.0), "EPSG:32601"),
    "on the equator": (Place(0.0, 0.0, 0.0), "EPSG:32631"),
    "north pole": (Place(89.9999, 40.0, 100.0, 90.0), "EPSG:5041"),
    "south pole": (Place(-90.0, 0.0, 2800.0, 30.0), "EPSG:5042"),
}
SWISS, CUT = Place(47.3, 8.5, 420.0), {"crs": "EPSG:3857"}
"""A place, and a map that is cut along the date line."""


@pytest.fixture(scope="module")
def anywhere() -> Run:
    """Points of a bump, 60 m wide."""
    run = Run.from_gaussians(upright(np.random.default_rng(0).normal(size=(40, 3))), views=[View(0.0, 40.0)])
    places = np.random.default_rng(1).uniform(-30, 30, size=(500, 3))
    places[:, 2] = 4 * np.exp(-(places[:, :2] ** 2).sum(axis=1) / 400)
    normals = np.column_stack([places[:, :2] * places[:, 2:] / 200, np.ones(500)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return with_points(run, places, normals, np.linspace(0.1, 1, 500))


@pytest.mark.parametrize(("place", "usual"), PLACES.values(), ids=PLACES)
def test_las_holds_the_coordinates_of_a_map(anywhere: Run, tmp_path: Path, place: Place, usual: str) -> None:
    run = at(anywhere, place)
    assert usual in export(run, tmp_path / "a.las").summary
    read = laspy.read(tmp_path / "a.las")
    forward = pyproj.Transformer.from_crs("EPSG:4978", usual, always_xy=True)
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    ecef = place.to_ecef(run.points)
    east, north = forward.transform(*ecef.T)[:2]
    height = geodetic.transform(*ecef.T)[2]
    np.testing.assert_allclose(read.xyz, np.column_stack([east, north, height]), atol=0.6e-4)  # half a step, m
    assert list(read.header.scales) == [1e-4] * 3
    system = pyproj.CRS.from_wkt(read.header.vlrs.get("WktCoordinateSystemVlr")[0].string)
    assert f"EPSG:{system.to_2d().to_epsg()}" == usual
    assert [axis.name for axis in system.axis_info][2:] == ["Ellipsoidal height"]
    ahead = place.to_ecef(run.points + np.float32(0.5) * run.normals)
    steps = np.column_stack([*forward.transform(*ahead.T)[:2], geodetic.transform(*ahead.T)[2]]) - read.xyz
    normals = np.column_stack([read[name] for name in ("nx", "ny", "nz")])
    np.testing.assert_allclose(normals, steps / np.linalg.norm(steps, axis=1, keepdims=True), atol=4e-3)


def test_las_may_be_in_another_system(anywhere: Run, tmp_path: Path) -> None:
    place = SWISS
    done = export(at(anywhere, place), tmp_path / "a.laz", crs="EPSG:2056")
    assert "CH1903+ / LV95 (EPSG:2056), heights above the WGS 84 ellipsoid (not the sea)" in done.summary
    assert "reached from WGS 84 to 1 m" in done.summary
    read = laspy.read(tmp_path / "a.laz")
    assert read.header.parse_crs().to_epsg() == 2056  # with no heights, which would be above another ellipsoid
    forward = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:2056", always_xy=True)
    latitude, longitude, height = place.to_geodetic(anywhere.points).T
    np.testing.assert_allclose(read.xyz[:, :2], np.transpose(forward.transform(longitude, latitude)), atol=0.02)
    np.testing.assert_allclose(read.z, height, atol=1e-4)


def test_heights_above_the_sea_are_not_said_to_be_ellipsoidal(anywhere: Run, tmp_path: Path) -> None:
    done = export(at(anywhere, Place(47.3, 8.5, 420.0, height_above="sea level")), tmp_path / "a.las")
    assert done.summary.endswith("heights above sea level")
    header = laspy.read(tmp_path / "a.las").header
    assert len(header.parse_crs().axis_info) == 2
    (text,) = (vlr for vlr in header.vlrs if vlr.record_id == 3)
    assert text.record_data_bytes() == b"heights above sea level\0"


@pytest.mark.parametrize(
    ("name", "place", "given", "why"),
    [
        ("a.las", SWISS, {"crs": "EPSG:4326"}, r"\(WGS 84\) is not in metres on a plane.*such as EPSG:32632"),
        ("a.las", SWISS, {"crs": "EPSG:2263"}, "is not in metres on a plane"),
        ("a.las", SWISS, {"crs": "EPSG:5555"}, "without heights, which are not converted"),
        ("a.las", SWISS, {"colour": "height"}, r"a\.las will hold points, whose colours are not chosen"),
        ("a.geojson", SWISS, {"crs": "EPSG:32632"}, "will hold longitudes and latitudes; leave out `crs`"),
        ("a.geojson", PLACES["south pole"][0], {}, "goes around a pole"),
        ("a.geojson", None, {}, "the run in memory has no georeference"),
        # half of the points would lie 40,000 km from the others; also where the cut is not at the very origin
        ("a.las", Place(10.0, 180.0, 5.0), CUT, r"cut in two within the scene.*such as EPSG:326(01|60)"),
        ("dsm.tif", Place(10.0, 180.0002, 5.0), {**CUT, "pixel_m": 5.0}, "cut in two within the scene"),
    ],
)
def test_places_refused(
    anywhere: Run, tmp_path: Path, name: str, place: Place | None, given: dict[str, Any], why: str
) -> None:
    with pytest.raises(SarsplatError, match=why):
        export(at(anywhere, place), tmp_path / name, **given)
    assert list(tmp_path.iterdir()) == []


def test_a_system_that_is_not_for_the_place_is_warned_of(anywhere: Run, tmp_path: Path) -> None:
    outside = r"EPSG:32636 .*is for longitudes 30° to 36° .* such as EPSG:32632"
    with pytest.warns(SarsplatWarning, match=outside) as caught:
        system = MapSystem.of(SWISS, "EPSG:32636")
    assert len(caught) == 1
    assert "is for" not in str(system)
    for name, given in (("a.las", {}), ("dsm.tif", {"pixel_m": 20.0})):
        with pytest.warns(SarsplatWarning, match=outside) as caught:
            export(at(anywhere, SWISS), tmp_path / name, crs="EPSG:32636", **given)
        assert len(caught) == 1
    assert "a metre on the ground is 1.47 m of the map" in str(MapSystem.of(SWISS, "EPSG:3857"))
    MapSystem.of(Place(10.0, 180.0, 0.0), "EPSG:3832")  # 98.69°E to 68.44°W: warnings are errors here
    MapSystem.of(Place(10.0, 179.9, 5.0), "EPSG:3857").to_map(anywhere.points)
    assert "reached from WGS 84 to 10 m" in str(MapSystem.of(Place(40.0, -75.0, 5.0), "EPSG:26718"))


def test_zones_are_those_of_utm() -> None:
    assert [usual_system(Place(1.0, at, 0.0)) for at in (-180, -174.0001, 5.9999, 6, 179.99)] == [
        *("EPSG:32601", "EPSG:32601", "EPSG:32631", "EPSG:32632", "EPSG:32660")
    ]
    assert [usual_system(Place(at, 3.0, 0.0)) for at in (84.1, 84, -0.1, -80, -80.1)] == [
        *("EPSG:5041", "EPSG:32631", "EPSG:32731", "EPSG:32731", "EPSG:5042")
    ]


def test_maps_lead_back_to_the_scene(anywhere: Run) -> None:
    for place, _ in PLACES.values():
        system = MapSystem.of(place)
        np.testing.assert_allclose(system.to_scene(system.to_map(anywhere.points)), anywhere.points, atol=1e-6)


@pytest.mark.parametrize("ending", ["ply", "splat"])
def test_beside_other_files_stands_where_they_are(anywhere: Run, tmp_path: Path, ending: str) -> None:
    place = PLACES["south, turned"][0]
    plain = export(anywhere, tmp_path / f"plain.{ending}")
    path = tmp_path / f"a.{ending}"
    done = export(at(anywhere, place), path)
    assert path.read_bytes() == (tmp_path / f"plain.{ending}").read_bytes()
    beside = tmp_path / f"a.{ending}.place.json"
    assert str(beside) in done.beside
    said = json.loads(beside.read_text())
    assert said["place"] == place.as_dict()
    ecef = np.column_stack([anywhere.points, np.ones(500)]) @ np.transpose(said["ecef_from_scene"])
    np.testing.assert_allclose(ecef[:, :3], place.to_ecef(anywhere.points), atol=1e-8)
    export(anywhere, path)  # of no place: what was said of the old one does not stay
    assert not plain.beside
    assert not beside.exists()
    beside.write_text('{"place": "mine"}')
    with pytest.raises(SarsplatError, match="was not written by an export"):
        export(anywhere, path)


@pytest.mark.parametrize("place", [place for place, _ in PLACES.values()][:3], ids=[*PLACES][:3])
def test_the_outline_is_around_all_points(anywhere: Run, tmp_path: Path, place: Place) -> None:
    matplotlib_path = pytest.importorskip("matplotlib.path")
    export(at(anywhere, place), tmp_path / "a.geojson")
    (feature,) = json.loads((tmp_path / "a.geojson").read_text())["features"]
    shape = feature["geometry"]
    rings = [part[0] for part in (shape["coordinates"] if shape["type"] == "MultiPolygon" else [shape["coordinates"]])]
    assert len(rings) == (2 if abs(place.longitude_deg) > 179 else 1)
    latitude, longitude, height = place.to_geodetic(anywhere.points).T
    inside = np.zeros(500, bool)
    for ring in rings:
        assert ring[0] == ring[-1]
        x, y = np.transpose(ring)
        assert (x[:-1] * y[1:] - x[1:] * y[:-1] - (x[1:] - x[:-1]) * y[0]).sum() > 0  # counter-clockwise
        assert np.abs(x).max() <= 180
        assert np.ptp(x) < 0.01
        inside |= matplotlib_path.Path(ring).contains_points(np.column_stack([longitude, latitude]), radius=2e-8)
    assert inside.all()
    about = feature["properties"]
    assert (about["lowest_m"], about["highest_m"]) == pytest.approx((height.min(), height.max()), abs=1e-3)
    assert 3000 < about["area_m2"] < 3600


def test_a_ring_is_cut_where_it_crosses_the_date_line() -> None:
    west, east = rings_of(np.array([[179.0, 0], [-179.0, 0], [-179.0, 1], [179.0, 1]]), Path("a"))
    assert {tuple(at) for at in west} == {(179.0, 0.0), (180.0, 0.0), (180.0, 1.0), (179.0, 1.0)}
    assert {tuple(at) for at in east} == {(-179.0, 0.0), (-180.0, 0.0), (-180.0, 1.0), (-179.0, 1.0)}
    ((left,),) = [rings_of(np.array([[179.0, 0], [180.0, 0], [180.0, 1], [179.0, 1]]), Path("a"))]
    assert np.max(left, axis=0)[0] == 180


def test_without_pyproj_it_says_what_to_install(anywhere: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyproj", None)
    with pytest.raises(SarsplatError, match=r"needs pyproj, which is not installed; .*sarsplat\[gis\]"):
        export(at(anywhere, Place(1.0, 2.0, 3.0)), tmp_path / "a.las")
    assert "outline of 500 points" in export(at(anywhere, Place(1.0, 2.0, 3.0)), tmp_path / "a.geojson").summary


def test_the_command_says_where_it_is(anywhere: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = Place(-33.9, 151.2, -12.0, 17.0)
    folder = at(anywhere, place).save(tmp_path / "run", quiet=True).folder
    assert main(["export", str(folder), str(tmp_path / "a.ply")]) == 0
    assert "a.ply.place.json: its georeference" in " ".join(capsys.readouterr().out.split())
    assert main(["info", str(folder)]) == 0
    assert "33.900000° S, 151.200000° E (WGS 84), -12.0 m above the ellipsoid" in capsys.readouterr().out


def test_a_file_of_gaussians_is_where_it_was_exported_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also where it is moved to the origin, far from that of its scene."""
    place = Place(45.29, 7.5, 312.0, 20.0)
    gaussians = upright(np.array([[5000.0, 0.0, 0.0], [5000.5, 0.5, 0.5]]))
    write_gaussians_ply(tmp_path / "a.ply", gaussians)
    write_place(tmp_path / "a.ply", place)
    assert main(["export", str(tmp_path / "a.ply"), str(tmp_path / "a.las")]) == 0
    read = laspy.read(tmp_path / "a.las")
    there = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    middle = there.transform(*place.to_ecef(np.array([5000.25, 0.25, 0.25])))
    np.testing.assert_allclose(np.mean([read.x, read.y, read.z], axis=1), middle, atol=0.3)
    assert main(["info", str(tmp_path / "a.ply")]) == 0
    assert "45.290000° N, 7.500000° E" in capsys.readouterr().out
    (tmp_path / "a.ply.place.json").write_text('{"place": "mine"}')
    assert main(["export", str(tmp_path / "a.ply"), str(tmp_path / "b.las")]) == 2
    assert "a.ply.place.json" in capsys.readouterr().err
    assert not (tmp_path / "b.las").exists()


def test_a_place_is_moved_with_its_axes() -> None:
    """At the pole, 3 km off, and 40 km along a meridian that is not the scene's x: as tilted as the earth is round."""
    for place, _ in PLACES.values():
        by = np.array([3000.0, -40_000.0, 20.0])
        moved = place.moved(by)
        np.testing.assert_allclose(moved.ecef, place.to_ecef(by), atol=1e-6)
        turn = moved.axes @ place.axes.T
        assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(np.degrees(40_112 / 6.37e6), rel=0.02)
