"""TIFFs as other programs pack them: what is read is what GDAL stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sarsplat.data.geotiff import read_heights
from sarsplat.errors import SarsplatError
from sarsplat.importers.pictures import read_pixels

rasterio = pytest.importorskip("rasterio")

FLOATS = np.random.default_rng(0).normal(size=(37, 50)).astype(np.float32)


def written(path: Path, pixels: np.ndarray, **options) -> Path:
    bands = pixels if pixels.ndim == 3 else pixels[None]
    count, height, width = bands.shape
    size = {"count": count, "height": height, "width": width, "dtype": pixels.dtype}
    with rasterio.open(path, "w", driver="GTiff", **size, **options) as file:
        file.write(bands)
    return path


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int16, np.uint32, np.int32, np.float32])
@pytest.mark.parametrize(
    "options",
    [
        {"compress": "LZW"},
        {"compress": "LZW", "predictor": 2, "tiled": True, "blockxsize": 16, "blockysize": 32},
        {"compress": "ZSTD", "BIGTIFF": "YES"},
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_pixels_are_those_stored(tmp_path, kind, options):
    pixels = (FLOATS * 1000).astype(np.int16).astype(kind)
    read = read_pixels(written(tmp_path / "a.tif", pixels, **options))
    assert read.dtype == kind
    np.testing.assert_array_equal(read, pixels)


def test_heights_with_a_predictor_and_overviews(tmp_path):
    place = {"crs": "EPSG:32632", "transform": rasterio.Affine(0.5, 0, 500000, 0, -0.5, 5e6)}
    path = written(tmp_path / "a.tif", FLOATS, compress="DEFLATE", predictor=3, **place)
    with rasterio.open(path, "r+") as file:
        file.build_overviews([2, 4])
    np.testing.assert_array_equal(read_heights(path).raster.values, FLOATS)
    np.testing.assert_array_equal(read_pixels(path), FLOATS)


def test_masked_heights_are_not_known(tmp_path):
    place = {"crs": "EPSG:32632", "transform": rasterio.Affine(0.5, 0, 500000, 0, -0.5, 5e6)}
    seen = FLOATS > -1
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        path = written(tmp_path / "a.tif", FLOATS, **place)
        with rasterio.open(path, "r+") as file:
            file.write_mask(seen)
    np.testing.assert_array_equal(read_heights(path).raster.values, np.where(seen, FLOATS, np.nan))


def test_feet_are_told_by_the_system_of_heights(tmp_path):
    """GDAL writes no unit of heights beside the number of their system."""
    transform = rasterio.Affine(0.5, 0, 500000, 0, -0.5, 5e6)
    for crs in ("EPSG:6340+6360", "EPSG:32632+8228"):
        with pytest.raises(SarsplatError, match=r"a\.tif has heights in feet \(EPSG:(6360|8228)\); convert them"):
            read_heights(written(tmp_path / "a.tif", FLOATS, crs=crs, transform=transform))


def test_opencv_writes_lzw(tmp_path):
    sixteen = (FLOATS * 1000 + 5000).astype(np.uint16)
    Image.fromarray(sixteen).save(tmp_path / "a.tif", compression="tiff_lzw")
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif"), sixteen)


@pytest.mark.parametrize(
    ("pixels", "options", "words"),
    [
        (FLOATS, {"compress": "LERC"}, r"a\.tif holds float32 numbers as LERC, .* COMPRESS=DEFLATE -co PREDICTOR=1"),
        (FLOATS.astype(np.complex64), {"compress": "LZW"}, "holds complex64 numbers as LZW"),
        (np.stack([FLOATS, FLOATS]), {"compress": "LZW"}, "holds float32 numbers in 2 bands as LZW"),
        (FLOATS, {"compress": "LZW", "ENDIANNESS": "BIG"}, "holds float32 numbers as LZW"),
        (FLOATS.astype(float), {"compress": "DEFLATE", "predictor": 3}, "as ADOBE_DEFLATE with predictor 3, which"),
        (np.ones((9, 9), np.uint8), {"NBITS": 4}, "holds uint8 numbers as 4 bits each, .* NBITS=8"),
        ((FLOATS > 0).astype(np.uint8), {"photometric": "MINISWHITE", "compress": "LZW"}, "uint8 numbers as LZW"),
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_what_is_not_read_is_named(tmp_path, pixels, options, words):
    with pytest.raises(SarsplatError, match=words):
        read_pixels(written(tmp_path / "a.tif", pixels, **options))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_damage_is_said(tmp_path):
    path = written(tmp_path / "a.tif", FLOATS, compress="LZW")
    data = bytearray(path.read_bytes())
    data[-3000:] = bytes(3000)
    path.write_bytes(data)
    with pytest.raises(SarsplatError, match=r"a\.tif"):
        read_pixels(path)
