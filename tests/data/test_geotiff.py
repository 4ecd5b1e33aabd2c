"""Terrain from GeoTIFFs, and in datasets."""

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from made import hill, small_dataset, write_geotiff
from sarsplat import Place, SarsplatError, SarsplatWarning, Terrain, View, read_terrain, write_terrain
from sarsplat.data import Dataset, read_dataset, write_dataset
from sarsplat.data.terrain_file import read_heights
from sarsplat.examination.plausible import suspicions
from sarsplat.importers import MeasuredImage, dataset_of

pyproj, rasterio = pytest.importorskip("pyproj"), pytest.importorskip("rasterio")

HEIGHTS = np.arange(12.0).reshape(3, 4)


def test_rows_go_north_and_columns_east(tmp_path):
    for path in (
        write_geotiff(tmp_path / "scale.tif", HEIGHTS.astype(np.float32)),
        write_geotiff(
            tmp_path / "matrix.tif",
            HEIGHTS.astype(np.int16),
            scale=None,
            extra=[(34264, "d", 16, (2.0, 0, 0, 7, 0, -3.0, 0, 9, 0, 0, 0, 0, 0, 0, 0, 1), True)],
        ),
    ):
        terrain = read_terrain(path)
        assert terrain.pitch_m == (2.0, 3.0)
        assert np.array_equal(terrain.heights_m, HEIGHTS[::-1])
        assert terrain.height_m(np.array([3.0]), np.array([3.0])) == 3.0  # north-east: first row, last column
        level = terrain.centred()
        assert level.height_m(np.zeros(1), np.zeros(1)) == pytest.approx(0.0, abs=1e-12)
        # linear between places, and beyond the last ones as there
        assert level.height_m(np.array([1.0, 50.0]), np.array([0.0, 0.0])) == pytest.approx([0.5, 1.5])


def test_what_is_written_is_read_to_the_bit_and_by_other_programs(tmp_path):
    terrain, path = hill().centred(), tmp_path / "hill.tif"
    write_terrain(path, terrain)
    read = read_terrain(path)
    assert np.array_equal(read.heights_m, terrain.heights_m)
    assert read.pitch_m == terrain.pitch_m
    with tifffile.TiffFile(path) as tiff:
        tags = tiff.geotiff_metadata
    assert tags["ModelPixelScale"][:2] == [0.5, 0.4]
    assert tags["GTModelTypeGeoKey"] == 1
    assert tags["ModelTiepoint"][3:5] == [-15.0, 12.0]
    with rasterio.open(path, "r+") as file:  # of another program that knows where it is
        file.crs = "EPSG:32632"
        file.transform = rasterio.Affine(2.0, 0, 5e5, 0, -2.0, 5e6)
    place = read_terrain(path).place
    assert place is not None and place.latitude_deg == pytest.approx(45.15, abs=0.01)


def test_what_is_not_known_at_edges_is_cut_off_around_the_same_middle(tmp_path):
    whole = np.add.outer(np.arange(30.0), np.arange(40.0) ** 2)
    wedges = whole.copy()
    for row in range(30):  # as after bringing it into another system
        wedges[row, : row // 10] = wedges[row, 40 - (29 - row) // 10 :] = np.nan
    write_geotiff(tmp_path / "whole.tif", whole)
    with pytest.warns(SarsplatWarning, match=r"60 unknown heights of 1200 .* 0 rows above .* 2 columns left"):
        read = read_terrain(write_geotiff(tmp_path / "a.tif", wedges))
    assert np.array_equal(read.heights_m, whole[::-1, 2:-2])
    assert read.height_m(np.zeros(1), np.zeros(1)) == read_terrain(tmp_path / "whole.tif").height_m(*np.zeros((2, 1)))
    corner = whole.copy()
    corner[-1, 0] = np.nan
    with pytest.warns(SarsplatWarning, match="0 rows above and below and 1 column left"):
        assert read_terrain(write_geotiff(tmp_path / "a.tif", corner)).heights_m.shape == (30, 38)
    wedges[9:11, 20] = np.nan
    with pytest.raises(SarsplatError, match=r"2 unknown heights .* rows 10 to 11 and columns 21 to 21; fill"):
        read_terrain(write_geotiff(tmp_path / "a.tif", wedges))


def test_a_dataset_keeps_its_terrain(tmp_path):
    dataset = small_dataset(terrain=hill())
    read = read_dataset(write_dataset(tmp_path / "d", dataset).path)
    assert np.array_equal(read.terrain.heights_m, dataset.terrain.heights_m)
    assert read.fingerprint() == dataset.fingerprint()
    assert read.select("train").fingerprint() == dataset.select("train").fingerprint()
    other = replace(dataset, terrain=Terrain(dataset.terrain.heights_m + 1e-9, dataset.terrain.pitch_m))
    assert len({one.fingerprint() for one in (dataset, other, small_dataset())}) == 3


def test_terrain_that_ends_within_the_images_is_reported():
    small = Terrain(np.zeros((4, 4)), (1.0, 1.0))
    assert any("the terrain ends 1.5 m from" in text for text in suspicions(small_dataset(terrain=small)))
    assert not any("terrain" in text for text in suspicions(small_dataset(terrain=hill())))


def on_map(path: Path, epsg: int, east: float, north: float, *more: int, heights: np.ndarray = HEIGHTS) -> Path:
    """Heights of 20 × 30 m, or as many pixels as there are, whose first pixel begins at a corner of a map."""
    keys = (1, 1, 0, 3 + len(more) // 4, 1024, 0, 1, 1, 3072, 0, 1, epsg, 3076, 0, 1, 9001, *more)
    return write_geotiff(path, heights, keys, (20.0, 30.0, 0.0), corner=(east, north))


ZONES = [(32632, 7.0, 47.3), (32756, 151.2, -33.9), (32660, 179.99, 64.0), (2056, 8.5, 47.3), (3857, 8.5, 60.0)]


@pytest.mark.parametrize(("epsg", "longitude", "latitude"), ZONES)
def test_a_map_says_where_the_terrain_is(tmp_path, epsg, longitude, latitude):
    """By places that pyproj moves there from longitude and latitude: a corner, and steps on the ground."""
    forward = pyproj.Transformer.from_crs("EPSG:4326", epsg, always_xy=True)
    east, north = forward.transform(longitude, latitude)
    made = read_terrain(on_map(tmp_path / "a.tif", epsg, east, north))
    place = made.centred().place
    assert place.height_m == pytest.approx(made.height_m(np.zeros(1), np.zeros(1))[0])
    assert place.height_above == "unknown"
    corner = np.array([-made.half_m[0] - made.pitch_m[0] / 2, made.half_m[1] + made.pitch_m[1] / 2, 0.0])
    found = replace(place, height_m=0.0).to_geodetic(corner)
    assert forward.transform(found[1], found[0]) == pytest.approx((east, north), abs=2e-3)
    stretch = np.sqrt(np.divide(*np.array([made.pitch_m, (20.0, 30.0)])).prod())
    assert stretch == pytest.approx(0.5 if epsg == 3857 else 1.0, abs=1e-3)


def test_points_are_middles_of_pixels_if_the_file_says_so(tmp_path):
    area = read_terrain(on_map(tmp_path / "a.tif", 32632, 5e5, 5e6)).place
    point = read_terrain(on_map(tmp_path / "b.tif", 32632, 5e5, 5e6, 1025, 0, 1, 2)).place
    assert area.from_ecef(point.ecef)[:2] == pytest.approx((-10.0, 15.0), abs=0.01)


LEVELS = {5773: "sea level", 3855: "sea level", 5103: "sea level", 5030: "ellipsoid"}


@pytest.mark.parametrize(("code", "above"), [*LEVELS.items(), *((code, "unknown") for code in (32767, 5001, 4342))])
def test_what_heights_are_above(tmp_path, code, above):
    assert read_terrain(on_map(tmp_path / "a.tif", 32632, 5e5, 5e6, 4096, 0, 1, code)).place.height_above == above


def test_a_map_that_is_nowhere_is_told(tmp_path, monkeypatch):
    with pytest.warns(SarsplatWarning, match="is outside of that system"):
        assert read_terrain(on_map(tmp_path / "a.tif", 32632, 5e11, 5e6)).place is None
    assert read_terrain(on_map(tmp_path / "a.tif", 1500, 5e5, 5e6)).pitch_m == (20.0, 30.0)  # of no known system
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(SarsplatError, match=r"needs rasterio, which is not installed; .*sarsplat\[gis\]"):
        read_terrain(tmp_path / "a.tif")
    dataset = small_dataset(terrain=hill())  # of our own files
    assert read_dataset(write_dataset(tmp_path / "d", dataset).path).terrain.pitch_m == dataset.terrain.pitch_m


def test_terrain_is_laid_out_around_another_place(tmp_path):
    """A plane that rises by 0.1 to the north-east of the map, whose north is not the true one there."""
    rows, columns = np.mgrid[0:80, 0:100]
    slope = 0.1 * (20.0 * columns - 30.0 * rows) / np.sqrt(2) + 500
    made = read_terrain(on_map(tmp_path / "a.tif", 32632, 2e5, 5e6, heights=slope)).centred()
    east, north = 2e5 + 20 * 30.5, 5e6 - 30 * 50.5  # the middle of a pixel
    longitude, latitude = pyproj.Transformer.from_crs(32632, 4326, always_xy=True).transform(east, north)
    spot = Place(latitude, longitude, 470.0, 33.0)
    around = made.around(spot, 300.0).centred()
    assert min(around.half_m) >= 300
    assert around.place.height_m == pytest.approx(slope[50, 30], abs=0.01)
    point = np.array([120.0, -70.0, 0.0])
    there = spot.to_geodetic(point)
    moved = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(there[1], there[0])
    rise = 0.1 * (moved[0] - east + moved[1] - north) / np.sqrt(2)
    assert around.height_m(point[:1], point[1:2])[0] == pytest.approx(rise, abs=0.02)
    with pytest.raises(SarsplatError, match=r"the scene is at 46\..* m from there; give terrain that shows it"):
        made.around(replace(spot, latitude_deg=46.0), 300.0)


def on_terrain(terrain: Terrain, place: Place | None = None) -> Dataset:
    image = MeasuredImage("a", np.ones((16, 16), np.float32), View(0, 40), (0.5, 0.5), (0.6, 0.6))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SarsplatWarning)
        return dataset_of([image], target="a", source={}, terrain=terrain, place=place)


def test_a_dataset_takes_the_place_of_its_terrain():
    place = Place(10.0, 20.0, 30.0)
    relief = replace(hill(), place=place)
    made, turned = on_terrain(relief), on_terrain(relief, replace(place, x_towards_deg=0.0))
    assert made.place == place
    assert made.terrain is relief
    assert turned.place.x_towards_deg == 0.0  # north, which is to the left of the other's x
    assert turned.terrain.height_m(np.zeros(1), np.array([-1.0])) == pytest.approx(
        relief.height_m(np.ones(1), np.zeros(1)) - relief.height_m(np.zeros(1), np.zeros(1)), abs=0.08
    )


def test_heights_have_scale_and_offset_of_their_file_and_are_in_metres(tmp_path):
    def made(item, value):
        text = f'<GDALMetadata><Item name="A" sample="0" role="{item}">{value}</Item></GDALMetadata>'
        return write_geotiff(tmp_path / "a.tif", HEIGHTS.astype(np.int16), extra=[(42112, "s", 0, text, True)])

    for item, value, highest in (("scale", 0.1, 1.1), ("offset", 5.0, 16.0)):
        assert read_terrain(made(item, value)).heights_m.max() == pytest.approx(highest)
    with pytest.raises(SarsplatError, match="measured upwards in 'ft'; convert"):
        read_terrain(made("unittype", "ft"))


@pytest.mark.parametrize("hole", [-9999.0, -32768.0, -3.4028234663852886e38])
def test_holes_that_are_not_said_to_be_holes_are_no_heights(tmp_path, hole):
    heights = HEIGHTS.astype(np.float32)
    heights[1, 1] = hole
    with pytest.raises(SarsplatError, match=r"1 height beyond .*gdal_translate -a_nodata -"):
        read_terrain(write_geotiff(tmp_path / "a.tif", heights))
    said = write_geotiff(tmp_path / "b.tif", heights, extra=[(42113, "s", 0, f"{hole!r}", True)])
    assert np.isnan(read_heights(said).raster.values[1, 1])


def test_another_datum_is_reached_as_exactly_as_is_said_or_not_at_all(tmp_path):
    """ED50 by EPSG's own shift of geocentric coordinates (ED50 to WGS 84 (1), 3 to 8 m); NAD27 has none in Europe."""
    with pytest.warns(SarsplatWarning, match=r"\(EPSG:23032\) .* to within 2 m"):
        place = read_terrain(on_map(tmp_path / "a.tif", 23032, 5e5 - 40, 5e6 + 45)).place
    longitude, latitude = pyproj.Proj("+proj=utm +zone=32 +ellps=intl")(5e5, 5e6, inverse=True)
    cartesian = pyproj.Transformer.from_pipeline("+proj=cart +ellps=intl")
    x, y, z = cartesian.transform(longitude, latitude, 0)
    shifted = np.array([x - 87, y - 98, z - 121])
    assert np.hypot(*place.from_ecef(shifted)[:2]) < 10
    plain = pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(longitude, latitude, 0)
    assert np.hypot(*place.from_ecef(np.array(plain))[:2]) > 100  # had the datum been ignored
    forward = pyproj.Proj("+proj=utm +zone=18 +ellps=clrk66")
    with pytest.warns(SarsplatWarning, match="stays unknown: no installed transformation"):
        assert read_terrain(on_map(tmp_path / "b.tif", 26718, *forward(10, 40))).place is None


@pytest.mark.parametrize(
    ("code", "said"), [(5715, "measured down"), (8051, "foot"), (6357, "measured down"), (6360, "foot")]
)
def test_depths_and_heights_in_feet_are_refused(tmp_path, code, said):
    with pytest.raises(SarsplatError, match=said):
        read_terrain(on_map(tmp_path / "a.tif", 32632, 5e5, 5e6, 4096, 0, 1, code))


@pytest.mark.parametrize("inside", [True, False])  # a file beside it is GDAL's habit before 3.9
def test_packed_heights_with_a_mask_and_overviews(tmp_path, inside):
    heights = np.random.default_rng(0).normal(size=(37, 50)).astype(np.float32)
    made = {"driver": "GTiff", "count": 1, "dtype": "float32", "width": 50, "height": 37, "crs": "EPSG:32632"}
    made |= {"transform": rasterio.Affine(0.5, 0, 5e5, 0, -0.5, 5e6), "compress": "LZW", "predictor": 3}
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=inside), rasterio.open(tmp_path / "a.tif", "w", **made) as file:
        file.write(heights, 1)
        file.write_mask(heights > -1)
        file.build_overviews([2, 4])
    assert (tmp_path / "a.tif.msk").exists() != inside
    read = read_heights(tmp_path / "a.tif").raster.values
    np.testing.assert_array_equal(read, np.where(heights > -1, heights, np.nan))


def test_levels_of_heights_are_not_mixed_without_a_word():
    def made(terrain, place=None):
        dataset = on_terrain(terrain, place)
        return dataset.place, " ".join(dataset.source["assumptions"])

    sea = replace(hill(), place=Place(10.0, 20.0, 30.0, height_above="sea level")).centred()
    way = "gdalwarp -s_srs EPSG:326xx+5773"
    place, said = made(sea)
    assert place == sea.place and "heights are those of the terrain, above sea level" in said and way in said
    spot = Place(10.0, 20.0, 80.0)
    place, said = made(sea, spot)
    assert place == spot and f"{sea.place.height_m:.1f} m above sea level, and the place 80.0 m above the WGS" in said
    assert "only differences of heights are used" in said and way in said
    place, said = made(replace(sea, place=replace(sea.place, height_above="ellipsoid")), spot)
    assert way not in said
    place, said = made(sea, Place(10.0, 20.0, 0.0, height_above="unknown"))  # of pictures on a map
    assert (place.height_above, place.height_m) == ("sea level", pytest.approx(sea.place.height_m))


def test_terrain_that_is_turned_ends_where_the_other_did():
    """A slope, laid out around a place whose x is turned by 45°: it must not be level beyond the edges it had."""
    x = np.arange(-20.0, 21.0)
    slope = Terrain(np.tile(x, (41, 1)), (1.0, 1.0), Place(10.0, 20.0, 0.0))
    around = slope.around(Place(10.0, 20.0, 0.0, 45.0), 100.0)
    right, up = np.meshgrid(*(np.arange(-half, half + 0.1) for half in around.half_m))
    np.testing.assert_allclose(around.heights_m, (right - up) * np.sqrt(0.5), atol=1e-6)
    assert min(around.half_m) >= 13
    assert min(slope.around(Place(10.0, 20.0, 0.0), 100.0).half_m) == 20


def test_coordinates_far_from_where_a_system_is_for_are_told(tmp_path):
    for epsg, at, told in ((28992, (5e5, 5e6), True), (32632, (5e5, 5e6), False), (3832, (3e6, 1e6), False)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert read_terrain(on_map(tmp_path / "a.tif", epsg, *at)).place is not None
        assert any("check its number and its coordinates" in str(one.message) for one in caught) == told
