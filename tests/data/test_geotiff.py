"""Terrain from GeoTIFFs, and in datasets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tifffile

from sarsplat import Dataset, DatasetEntry, ImageGrid, SarsplatError, Terrain, View, read_terrain, write_terrain
from sarsplat.data import read_dataset, write_dataset
from sarsplat.data.plausible import suspicions
from terrains import hill, write_geotiff

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


def test_what_is_written_is_read_to_the_bit(tmp_path):
    terrain = hill().centred()
    write_terrain(tmp_path / "hill.tif", terrain)
    read = read_terrain(tmp_path / "hill.tif")
    assert np.array_equal(read.heights_m, terrain.heights_m)
    assert read.pitch_m == terrain.pitch_m


DEGREES = (1, 1, 0, 1, 1024, 0, 1, 2)
FEET = (1, 1, 0, 2, 1024, 0, 1, 1, 3076, 0, 1, 9002)


@pytest.mark.parametrize(
    ("heights", "options", "message"),
    [
        (HEIGHTS, {"keys": DEGREES}, "is in degrees of latitude and longitude; bring it into metres"),
        (HEIGHTS, {"keys": FEET}, "has lengths in another unit than metres .EPSG 9002.; convert it"),
        (HEIGHTS, {"scale": None}, "does not say how far its pixels are apart; write it as a GeoTIFF in metres"),
        (HEIGHTS, {"scale": (0.0, 1.0, 0.0)}, "pitch_m is .0.0, 1.0.; give two positive"),
        (HEIGHTS[:1], {}, "has 1 × 4 heights; give at least 2 × 2"),
        (np.where(HEIGHTS == 5, np.nan, HEIGHTS), {}, "has 1 height of 12 that is not known; fill them in"),
        (HEIGHTS, {"extra": [(42113, "s", 0, "3", True)]}, "has 1 height of 12 that is not known"),
        (np.zeros((4, 5, 3), np.uint8), {"photometric": "rgb"}, "has 3 bands; give one of heights"),
        (
            HEIGHTS,
            {"scale": None, "extra": [(34264, "d", 16, (2.0, 1, 0, 7, 1, -3, 0, 9, 0, 0, 0, 0, 0, 0, 0, 1), True)]},
            "is turned against its system's axes; straighten it",
        ),
    ],
)
def test_what_is_no_terrain_is_refused_in_one_sentence(tmp_path, heights, options, message):
    path = write_geotiff(tmp_path / "bad.tif", heights, **options)
    with pytest.raises(SarsplatError, match=message):
        read_terrain(path)


def test_damaged_files_are_refused(tmp_path):
    path = write_geotiff(tmp_path / "cut.tif", HEIGHTS)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(SarsplatError):
        read_terrain(path)
    (tmp_path / "text.tif").write_text("heights")
    with pytest.raises(SarsplatError, match="is not a readable TIFF"):
        read_terrain(tmp_path / "text.tif")


def _dataset(terrain: Terrain | None) -> Dataset:
    grid = ImageGrid(16, 16, (0.5, 0.5), (0.5, 0.5))
    entries = tuple(DatasetEntry(View(90.0 * k, 40.0), "train", f"{k}") for k in range(4))
    power = np.random.default_rng(0).uniform(0.1, 1.0, (4, 16, 16)).astype(np.float32)
    return Dataset(grid, entries, power, ground=True, terrain=terrain)


def test_a_dataset_keeps_its_terrain(tmp_path):
    dataset = _dataset(hill())
    read = read_dataset(write_dataset(tmp_path / "d", dataset).path)
    assert np.array_equal(read.terrain.heights_m, dataset.terrain.heights_m)
    assert read.fingerprint() == dataset.fingerprint() == read.select("train").fingerprint()
    other = replace(dataset, terrain=Terrain(dataset.terrain.heights_m + 1e-9, dataset.terrain.pitch_m))
    assert len({one.fingerprint() for one in (dataset, other, _dataset(None))}) == 3
    (tmp_path / "d" / "terrain.tif").unlink()
    with pytest.raises(SarsplatError, match=r"terrain\.tif"):
        read_dataset(tmp_path / "d")


def test_terrain_is_of_ground():
    with pytest.raises(SarsplatError, match="terrain is the ground that images show, but ground is False"):
        replace(_dataset(hill()), ground=False)


def test_terrain_that_ends_within_the_images_is_reported():
    small = Terrain(np.zeros((4, 4)), (1.0, 1.0))
    assert any("the terrain ends 1.5 m from the scene's centre" in text for text in suspicions(_dataset(small)))
    assert not any("terrain" in text for text in suspicions(_dataset(hill())))


def test_other_programs_read_it(tmp_path):
    write_terrain(tmp_path / "hill.tif", hill())
    with tifffile.TiffFile(tmp_path / "hill.tif") as tiff:
        tags = tiff.geotiff_metadata
        assert tags["ModelPixelScale"][:2] == [0.5, 0.4]
        assert tags["GTModelTypeGeoKey"] == 1
        assert tags["ModelTiepoint"][3:5] == [-15.0, 12.0]
