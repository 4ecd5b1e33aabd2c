"""Geocoded pictures, made by a producer that shares no code, come back to azimuth and slant range."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from geocoded import UTM_33N, on_map, write_map, write_maps
from made import terrain
from sarsplat.cli import main
from sarsplat.data import Dataset, read_dataset, read_terrain, write_terrain
from sarsplat.data.geotiff import Georeference
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import ImageGrid, View
from sarsplat.importers import import_folder
from sarsplat.importers.geocoded import on_ground

pytestmark = pytest.mark.usefixtures("unexamined")

RESOLUTION = (0.5, 0.45)
GRID = ImageGrid(150, 150, (0.2, 0.2), RESOLUTION)
VIEWS = [View(float(azimuth), 30.0 + azimuth % 20) for azimuth in range(0, 360, 72)]
SIDE, PITCH = 100, 0.2
POINTS = np.array([[0.0, 0.0, 0.0], [3.0, 1.0, 0.0], [-2.0, 2.5, 1.5], [1.0, -3.0, 2.0], [-3.5, -2.0, 0.8]])
DEGREES = (1, 1, 0, 2, 1024, 0, 1, 2, 2048, 0, 1, 4326)
LOCAL = (1, 1, 0, 1, 1024, 0, 1, 1)
NO_DATA = [(42113, "s", 0, "-9999", True)]


def seen(points: np.ndarray, view: View, grid: ImageGrid) -> np.ndarray:
    """An image of points and of what lies around them: power, with a floor."""
    phi, theta = np.radians(view.azimuth_deg), np.radians(view.grazing_deg)
    azimuth = -np.sin(phi) * points[:, 0] - np.cos(phi) * points[:, 1]
    to_radar = np.array([np.cos(phi) * np.cos(theta), -np.sin(phi) * np.cos(theta), np.sin(theta)])
    away = -points @ to_radar
    image = np.full((grid.rows, grid.columns), 0.05)
    for at, far in zip(azimuth, away, strict=True):
        across = (grid.azimuth_m - at) / grid.resolution_m[0]
        along = (grid.range_m - far) / grid.resolution_m[1]
        image += np.exp(-4 * np.log(2) * (along[:, None] ** 2 + across**2))
    return image.astype(np.float32)


IMAGES = [seen(POINTS, view, GRID) for view in VIEWS]
OPTIONS = {"quantity": "power", "resolution_m": RESOLUTION, "looks": None, "calibration": "absolute", "overwrite": True}


def imported(folder: Path, **options) -> Dataset:
    return import_folder(folder, folder.parent / "out", **{**OPTIONS, "geocoded": "level", **options})


def offsets(image: np.ndarray, view: View, grid: ImageGrid, points: np.ndarray) -> np.ndarray:
    """By how much of a cell points are shown elsewhere than the radar sees them; those that it shows."""
    found = []
    expected = [seen(points[[k]], view, grid) - 0.05 for k in range(len(points))]
    for k, alone in enumerate(expected):
        others = np.sum(expected[:k] + expected[k + 1 :], axis=0)
        row, column = np.unravel_index(alone.argmax(), alone.shape)
        inside = 4 <= row < grid.rows - 4 and 4 <= column < grid.columns - 4
        if not inside or others[row, column] > 0.02:
            continue
        for axis in (0, 1):
            window = [slice(row - 1, row + 2), slice(column, column + 1)]
            line = tuple(window if axis == 0 else [slice(row, row + 1), slice(column - 1, column + 2)])
            tops = []
            for power in (alone, np.maximum(image - 0.05, 1e-6)):
                low, middle, high = np.log(power[line].ravel())
                tops.append((low - high) / 2 / (low - 2 * middle + high))
            found.append((tops[1] - tops[0]) * grid.spacing_m[1 - axis] / grid.resolution_m[1 - axis])
    return np.array(found)


def check_places(made: Dataset, points: np.ndarray, least: int = 30) -> None:
    found = np.concatenate([offsets(image, view, made.grid, points) for image, view in zip(made.power, made.views)])
    assert len(found) >= least
    assert np.abs(found).max() < 0.05  # of a resolution cell


def write(folder: Path, images=IMAGES, **options) -> Path:
    return write_maps(folder, images, VIEWS, GRID, SIDE, PITCH, **options)


@pytest.fixture(scope="module")
def straight(unexamined: None, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return imported(write(tmp_path_factory.mktemp("straight") / "in"))


@pytest.mark.parametrize(
    ("system", "unit_m"),
    [(UTM_33N, 1 / 0.9996), (LOCAL, 1.0), (None, 1.0)],  # the last has only a scale of its pixels
    ids=["UTM", "without a number", "none"],
)
def test_level_ground(tmp_path: Path, system, unit_m: float) -> None:
    """Points above the ground are where the radar shows them, nearer than they stand."""
    made = imported(write(tmp_path / "in", keys=system, unit_m=unit_m), spacing_m=None if system else (PITCH, PITCH))
    assert [view.azimuth_deg for view in made.views] == pytest.approx([view.azimuth_deg for view in VIEWS])
    assert [view.grazing_deg for view in made.views] == pytest.approx([view.grazing_deg for view in VIEWS])
    assert made.grid.spacing_m == pytest.approx((PITCH, PITCH * np.cos(np.radians(max(v.grazing_deg for v in VIEWS)))))
    check_places(made, POINTS)
    assert (made.place is not None) == (system is UTM_33N)
    assert any("projected them from level ground" in text for text in made.source["assumptions"])
    assert read_dataset(tmp_path / "out").source["geocoded"] == "level"


def test_what_was_not_measured_along_edges_is_left_out(tmp_path: Path, straight: Dataset) -> None:
    """As after gdalwarp; where it is, is said only of what is needed."""
    folder = write(tmp_path / "in")
    path = folder / "000.tif"
    pixels = tifffile.imread(path)
    for rows, needed in ((3, False), (20, True)):  # other views are turned, so that edges are not
        pixels[:rows] = -9999
        write_map(path, pixels, PITCH, extra=NO_DATA)
        with pytest.warns(match=f"{100 * rows:,} pixels hold what their files call no data"):
            made = imported(folder)
        cut = [(a - b) // 2 for a, b in zip(straight.power.shape[1:], made.power.shape[1:], strict=True)]
        assert (max(cut) > 0) == needed
        inner = tuple(slice(k, size - k) for k, size in zip(cut, straight.power.shape[1:], strict=True))
        np.testing.assert_allclose(made.power[0], straight.power[0][inner], rtol=1e-3)


def test_a_plane_above_the_ground(tmp_path: Path) -> None:
    """Told of the plane on which its producer projected, z = 0 is the ground again; without it, that is off."""
    folder = write(tmp_path / "in", height=lambda x, y: 0 * x + 2.0)
    check_places(imported(folder, geocoded_height_m=2.0), POINTS, 20)
    wrong = imported(folder)
    assert [view.azimuth_deg for view in wrong.views] == pytest.approx([view.azimuth_deg for view in VIEWS])
    lower = POINTS - np.array([0.0, 0.0, 2.0])  # of a scene whose z = 0 is that plane
    check_places(wrong, lower, 20)


def hill(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 1.8 * np.exp(-((x - 2) ** 2 + (y + 1) ** 2) / 3.0) + 0.05 * x


def test_terrain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Hills with slopes that lie over, as one sees them from some sides."""
    hills = terrain(hill, (14.0, 14.0), (0.25, 0.25)).centred()
    folder = write(tmp_path / "in", height=hills.height_m)
    made = imported(folder, geocoded="terrain", terrain=hills)
    check_places(made, POINTS, 20)
    write_terrain(tmp_path / "hills.tif", hills)
    words = ["import", "folder", str(folder), "--out", str(tmp_path / "typed"), "--quantity", "power", "--looks", "0"]
    words += ["--resolution", "0.5", "0.45", "--geocoded", "terrain", "--terrain", str(tmp_path / "hills.tif")]
    assert main([*words, "--calibrated"]) == 0
    np.testing.assert_array_equal(read_dataset(tmp_path / "typed").power, made.power)
    assert "projected them from the terrain" in capsys.readouterr().out


def test_terrain_that_lies_elsewhere_on_the_same_map(tmp_path: Path) -> None:
    """A larger one, whose middle is not that of the pictures, is laid where the map says."""
    pytest.importorskip("pyproj")
    x, y = (np.arange(-60, 60.5, 0.5) for _ in range(2))
    heights = 100 + 1.8 * np.exp(-((x - 2) ** 2 + (y[:, None] + 1) ** 2) / 3.0) + 0.05 * x
    middle = (5e5 + SIDE * PITCH / 2, 5e6 - SIDE * PITCH / 2)
    corner = (middle[0] - 60.25 + 7.0, middle[1] + 60.25 - 4.0)
    same_hill = np.roll(heights, (8, -14), (0, 1))[::-1]
    dem = read_terrain(write_map(tmp_path / "dem.tif", same_hill, 0.5, corner=corner)).centred()
    folder = write(tmp_path / "in", height=lambda x, y: hill(x, y) - hill(0 * x, 0 * y), unit_m=1 / 0.9996)
    made = imported(folder, geocoded="terrain", terrain=dem)
    assert any("which lies where the map says" in text for text in made.source["assumptions"])
    check_places(made, POINTS, 20)


def test_degrees_turned_maps_and_points(tmp_path: Path, straight: Dataset) -> None:
    """A map in longitude and latitude at 60° north, one that is turned, and pixels that are points, are the same."""
    folder = write(tmp_path / "in")
    radii = np.array([0.5 * 6378137 / np.sqrt(1 - 0.00669438 * 0.75), 6335439 / (1 - 0.00669438 * 0.75) ** 1.5])
    dx, dy = PITCH / (np.pi / 180 * radii)
    for number, view in enumerate(VIEWS):
        write_degrees(folder / f"{number:03d}.tif", on_map(IMAGES[number], view, GRID, SIDE, PITCH), dx, dy)
    made = imported(folder)
    assert made.place is not None
    assert made.place.latitude_deg == pytest.approx(60 - SIDE * dy / 2, abs=1e-9)
    assert made.grid.spacing_m == pytest.approx(straight.grid.spacing_m, rel=1e-3)
    check_places(made, POINTS)
    for number, view in enumerate(VIEWS):  # rows run north, columns east: a quarter turn and a mirror
        pixels = on_map(IMAGES[number], view, GRID, SIDE, PITCH)[::-1].T
        matrix = (0, PITCH, 0, 5e5, PITCH, 0, 0, 5e6, 0, 0, 0, 0, 0, 0, 0, 1)
        keys = (*LOCAL[:3], 2, *LOCAL[4:], 1025, 0, 1, 2)
        tags = [(34264, "d", 16, matrix, True), (34735, "H", len(keys), keys, True)]
        tifffile.imwrite(folder / f"{number:03d}.tif", pixels, metadata=None, extratags=tags)
    check_places(imported(folder), POINTS)


def write_degrees(path: Path, pixels: np.ndarray, dx: float, dy: float) -> None:
    """A GeoTIFF in longitude and latitude, whose top left corner lies at 15° east and 60° north."""
    tags = [(33550, "d", 3, (dx, dy, 0.0), True), (33922, "d", 6, (0.0, 0.0, 0.0, 15.0, 60.0, 0.0), True)]
    tags.append((34735, "H", len(DEGREES), DEGREES, True))
    tifffile.imwrite(path, pixels, metadata=None, extratags=tags)


def test_true_north_is_not_that_of_the_map(tmp_path: Path) -> None:
    """At the edge of a UTM zone, far north, a grid is turned by degrees: bearings count from true north."""
    pyproj = pytest.importorskip("pyproj")
    x, y = pyproj.Transformer.from_crs(4326, 32633, always_xy=True).transform(18.0, 60.0)
    turn = pyproj.Proj(32633).get_factors(18.0, 60.0).meridian_convergence
    assert turn > 2.5
    views = [View(view.azimuth_deg - turn, view.grazing_deg) for view in VIEWS]  # as the map shows them
    images = [seen(POINTS, view, GRID) for view in views]
    folder = write_maps(tmp_path / "in", images, views, GRID, SIDE, PITCH, corner=(x, y))
    rows = [f"{k:03d}.tif,{(view.azimuth_deg + 90) % 360},{view.incidence_deg}" for k, view in enumerate(VIEWS)]
    (folder / "table.csv").write_text("\n".join(["file,azimuth,incidence", *rows]))
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    east = POINTS @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    check_places(imported(folder), east)


def test_maps_that_do_not_fit(tmp_path: Path) -> None:
    folder = write(tmp_path / "in")
    with pytest.raises(SarsplatError, match=r"pixels are 0.2.* m × 0.2.* m \(east × north\), but 0.3 × 0.3 is given"):
        imported(folder, spacing_m=(0.3, 0.3))
    pixels = tifffile.imread(folder / "000.tif")
    path = folder / "000.tif"
    for change, words in (
        ({"corner": (6e5, 5e6)}, "no place on the map in common"),
        ({"keys": LOCAL}, "bring all into one"),
        ({"keys": None}, "000.tif has no GeoTIFF tags, and others say where they lie"),
        ({"corner": (5e5 + 18.5, 5e6)}, "remain that all geocoded"),
    ):
        write_map(path, pixels, PITCH, **change)
        with pytest.raises(SarsplatError, match=words):
            imported(folder)
    write(folder)
    pixels[40, 40] = -9999
    write_map(path, pixels, PITCH, extra=NO_DATA)
    with (
        pytest.raises(SarsplatError, match=r"that were not measured, near rows .*; cut the pictures"),
        pytest.warns(match="call no data"),
    ):
        imported(folder)
    for number in range(len(VIEWS)):
        write_degrees(folder / f"{number:03d}.tif", np.ones((SIDE, SIDE), np.float32), 1e-2, 1e-2)
    with pytest.raises(SarsplatError, match=r"which is bent by .* m within the pictures"):
        imported(folder)


def test_power_of_ground_by_its_own_unit(tmp_path: Path, straight: Dataset) -> None:
    """σ⁰ and γ⁰ become β⁰ by the grazing angle of each view."""
    folder = write(tmp_path / "in")
    for backscatter, factor in (
        ("sigma0", [1 / np.cos(np.radians(view.grazing_deg)) for view in VIEWS]),
        ("gamma0", [np.tan(np.radians(view.grazing_deg)) for view in VIEWS]),
    ):
        made = imported(folder, backscatter=backscatter)
        np.testing.assert_allclose(made.power, straight.power * np.array(factor)[:, None, None], rtol=1e-5)
        assert any(f"the power is {backscatter}" in text for text in made.source["assumptions"])


def test_headings_tell_where_the_radar_is(tmp_path: Path, straight: Dataset) -> None:
    """A radar is 90° to the left of its flight if it looks to the right, and to the right if it looks left."""
    folder = write(tmp_path / "in")
    rows = ["file,Platform Heading (deg),look,incidence"]
    for number, view in enumerate(VIEWS):
        left = number % 2 == 1
        heading = (view.azimuth_deg + (0 if left else 180)) % 360
        rows.append(f"{number:03d}.tif,{heading},{'left' if left else 'right'},{view.incidence_deg}")
    (folder / "table.csv").write_text("\n".join(rows))
    made = imported(folder)
    assert [view.azimuth_deg for view in made.views] == pytest.approx([view.azimuth_deg for view in straight.views])
    np.testing.assert_allclose(made.power, straight.power, rtol=1e-6)
    assert any("azimuths are 90° to the left of headings" in text for text in made.source["assumptions"])
    (folder / "table.csv").write_text("\n".join(",".join(np.array(row.split(","))[[0, 1, 3]]) for row in rows))
    with pytest.raises(SarsplatError, match="or give `look`, the side to which the radar looks"):
        imported(folder)
    assert imported(folder, look="right").views[0].azimuth_deg == pytest.approx(straight.views[0].azimuth_deg)


def test_headings_that_contradict_azimuths_are_refused(tmp_path: Path, straight: Dataset) -> None:
    folder = write(tmp_path / "in")

    def told(turned: float, columns: str = "file,azimuth,heading,look,incidence") -> None:
        rows = [columns]
        for number, view in enumerate(VIEWS):
            bearing = (view.azimuth_deg + 90) % 360
            rows.append(f"{number:03d}.tif,{bearing},{(bearing + 90 + turned) % 360},right,{view.incidence_deg}")
        (folder / "table.csv").write_text("\n".join(rows))

    for turned in (0.0, 3.0):
        told(turned)
        assert imported(folder).views == straight.views
    for turned in (180.0, 90.0, -20.0):
        told(turned)
        with pytest.raises(SarsplatError, match=r"000.tif has an azimuth of .*°, but a radar with the heading"):
            imported(folder)
    assert imported(folder, columns={"azimuth": "azimuth"}).views == straight.views
    by_heading, by_azimuth = imported(folder, columns={"heading": "heading"}).views[0], straight.views[0]
    assert by_heading.azimuth_deg == pytest.approx((by_azimuth.azimuth_deg - 20.0) % 360)
    told(180.0, "file,azimuth,heading,anything,incidence")  # perhaps of the target: no side is known
    assert imported(folder).views == straight.views
    with pytest.raises(SarsplatError, match="say which holds with `columns"):
        imported(folder, look="right")


def test_complex_pictures_keep_their_power(tmp_path: Path, straight: Dataset) -> None:
    folder = write(tmp_path / "in")
    for path in folder.glob("*.tif"):
        write_map(path, (np.sqrt(tifffile.imread(path)) * np.complex64(1j)).astype(np.complex64), PITCH)
    made = imported(folder, quantity=None)
    assert made.signal is None
    np.testing.assert_allclose(made.power, straight.power, rtol=1e-5)


def lying(longitude: float, latitude: float, epsg: int, step: float = 1e-5) -> Georeference:
    """64 pixels to a side, a step of the system's unit apart, around a place."""
    affine = np.array([[step, 0.0, longitude - 31.5 * step], [0.0, -step, latitude + 31.5 * step]])
    return Georeference(affine, pytest.importorskip("pyproj").CRS.from_epsg(epsg))


def laid_out(*georeferences: Georeference):
    names = [f"{k}.tif" for k in range(len(georeferences))]
    return on_ground([(64, 64)] * len(georeferences), georeferences, 90.0, names)


def test_pictures_on_both_sides_of_the_date_line_lie_together() -> None:
    pytest.importorskip("pyproj")
    affines, place = laid_out(lying(180.00002, 10.0, 4326), lying(-180.0, 10.0, 4326))
    apart = affines[0][:, 2] - affines[1][:, 2]
    assert apart == pytest.approx((2e-5 * 111_320 * np.cos(np.radians(10)), 0), abs=0.01)
    assert abs(place.longitude_deg) == pytest.approx(180.0, abs=1e-4)


def test_pictures_of_a_pole_are_refused() -> None:
    pytest.importorskip("pyproj")
    with pytest.raises(SarsplatError, match="lies around a pole, where there is no north"):
        laid_out(lying(2_000_010.0, 2_000_005.0, 5041, step=1.0))
    assert laid_out(lying(2_000_500.0, 2_000_005.0, 5041, step=1.0))[1].latitude_deg > 89.99


def test_datums_and_units_of_maps_are_minded() -> None:
    pyproj = pytest.importorskip("pyproj")
    with pytest.warns(SarsplatWarning, match="EPSG:4267, from where WGS 84 is reached to 7 m"):
        place = laid_out(lying(-120.0, 40.0, 4267))[1]
    away = pyproj.Geod(ellps="WGS84").inv(-120, 40, place.longitude_deg, place.latitude_deg)[2]
    assert 80 < away < 110  # of NAD27 there, westwards
    with pytest.raises(SarsplatError, match="no installed transformation relates its datum"):
        laid_out(lying(10.0, 40.0, 4267))
    with pytest.warns(SarsplatWarning, match=r"is for longitudes 6° to 12° .*check its number"):
        laid_out(lying(5e5 + 2e6, 5e6, 32632, step=1.0))
    with pytest.warns(SarsplatWarning, match="reached to 4 m"):
        affine = laid_out(lying(1e6, 2e5, 2263, step=1.0))[0][0]
    assert np.hypot(*affine[:, 0]) == pytest.approx(0.3048, rel=1e-3)
