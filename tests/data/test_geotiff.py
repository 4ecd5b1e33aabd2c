"""Terrain from GeoTIFFs, and in datasets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tifffile

from datasets import small_dataset
from sarsplat import Terrain, read_terrain, write_terrain
from sarsplat.data import read_dataset, write_dataset
from sarsplat.examination.plausible import suspicions
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
    assert any(
        "the terrain ends 1.5 m from the scene's centre" in text for text in suspicions(small_dataset(terrain=small))
    )
    assert not any("terrain" in text for text in suspicions(small_dataset(terrain=hill())))


def test_other_programs_read_it(tmp_path):
    write_terrain(tmp_path / "hill.tif", hill())
    with tifffile.TiffFile(tmp_path / "hill.tif") as tiff:
        tags = tiff.geotiff_metadata
        assert tags["ModelPixelScale"][:2] == [0.5, 0.4]
        assert tags["GTModelTypeGeoKey"] == 1
        assert tags["ModelTiepoint"][3:5] == [-15.0, 12.0]
