"""TIFFs as other programs pack them: what is read is what GDAL stored."""

from __future__ import annotations

import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from tifffile import _imagecodecs

from sarsplat.data import geotiff
from sarsplat.data.geotiff import read_heights
from sarsplat.errors import SarsplatError
from sarsplat.importers.pictures import read_picture, read_pixels

rasterio = pytest.importorskip("rasterio")

FLOATS = np.random.default_rng(0).normal(size=(37, 50)).astype(np.float32)


def written(path: Path, pixels: np.ndarray, **options) -> Path:
    bands = pixels if pixels.ndim == 3 else pixels[None]
    count, height, width = bands.shape
    size = {"count": count, "height": height, "width": width, "dtype": pixels.dtype}
    with rasterio.open(path, "w", driver="GTiff", **size, **options) as file:
        file.write(bands)
    return path


OPTIONS = [
    {"compress": "LZW"},
    {"compress": "LZW", "ENDIANNESS": "BIG", "blockysize": 7},
    {"compress": "LZW", "predictor": 2, "tiled": True, "blockxsize": 16, "blockysize": 32},
    {"compress": "LZW", "predictor": 2, "ENDIANNESS": "BIG"},
    {"compress": "ZSTD", "BIGTIFF": "YES", "tiled": True, "blockxsize": 32, "blockysize": 16},
]


@pytest.mark.parametrize("kind", ["uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64"])
@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_pixels_are_those_stored(tmp_path, kind, options):
    pixels = (FLOATS * 1000).astype(np.int16).astype(kind)
    read = read_pixels(written(tmp_path / "a.tif", pixels, **options))
    assert read.dtype == kind
    np.testing.assert_array_equal(read, pixels)


@pytest.mark.parametrize("kind", ["float32", "float64"])
@pytest.mark.parametrize("compression", ["DEFLATE", "LZW", "ZSTD"])
@pytest.mark.parametrize("interleave", ["band", "pixel"])
@pytest.mark.parametrize("more", [{}, {"ENDIANNESS": "BIG"}, {"tiled": True, "blockxsize": 16, "blockysize": 16}])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_bands_with_a_predictor_for_floating_point(tmp_path, kind, compression, interleave, more):
    pixels = np.stack([FLOATS, FLOATS[::-1] ** 2]).astype(kind)
    options = {"compress": compression, "predictor": 3, "interleave": interleave, **more}
    read = read_pixels(written(tmp_path / "a.tif", pixels, **options))
    np.testing.assert_array_equal(read if interleave == "band" else np.moveaxis(read, 2, 0), pixels)


@pytest.mark.parametrize("options", [OPTIONS[0], OPTIONS[1], OPTIONS[4]])
@pytest.mark.parametrize("kind", ["complex64", "complex128", "complex_int16"])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_complex_pixels(tmp_path, options, kind):
    pixels = np.round(1000 * (FLOATS + 1j * FLOATS[::-1])).astype("complex128" if kind == "complex128" else "complex64")
    rows, columns = pixels.shape
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", height=rows, width=columns, count=1, dtype=kind, **options
    ) as file:
        file.write(pixels[None])
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif"), pixels)


@pytest.mark.parametrize("kind", ["complex64", "complex_int16"])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_complex_pixels_with_a_predictor_are_refused(tmp_path, kind):
    """Of which tifffile makes other numbers."""
    options = {"count": 1, "dtype": kind, "compress": "DEFLATE", "predictor": 2}
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", height=37, width=50, **options) as file:
        file.write((FLOATS[None] + 1j).astype("complex64"))
    with pytest.raises(SarsplatError, match=r"complex64 numbers as ADOBE_DEFLATE PREDICTOR=2, .* -co PREDICTOR=1"):
        read_pixels(tmp_path / "a.tif")


@pytest.mark.parametrize("compression", ["DEFLATE", "LZW", "ZSTD"])
@pytest.mark.parametrize("shape", [{"blockysize": 10}, {"tiled": True, "blockxsize": 16, "blockysize": 32}])
@pytest.mark.parametrize("empty", [0.0, -9.0])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_blocks_that_a_file_leaves_out_hold_no_data(tmp_path, capfd, compression, shape, empty):
    for part in (np.s_[35:], np.s_[:5], np.s_[15:16]):  # of strips, only the last, which is shorter
        pixels = np.full((37, 50), empty, np.float32)
        pixels[part] = FLOATS[part]
        options = {"compress": compression, "predictor": 3, "SPARSE_OK": True, "nodata": empty, **shape}
        read = read_pixels(written(tmp_path / "a.tif", pixels, **options))
        np.testing.assert_array_equal(read, pixels)
    assert capfd.readouterr().err == ""  # as libtiff may write to


@pytest.mark.parametrize(("bits", "kind"), [(4, "uint8"), (11, "uint16"), (31, "uint32")])
@pytest.mark.parametrize("options", [{}, *OPTIONS[:2]])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_numbers_of_few_bits(tmp_path, bits, kind, options):
    pixels = (np.abs(FLOATS) * 2**30 % 2**bits).astype(kind)
    read = read_pixels(written(tmp_path / "a.tif", pixels, nbits=bits, **options))
    np.testing.assert_array_equal(read, pixels)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_few_bits_count_as_the_bytes_they_become(tmp_path):
    with pytest.raises(SarsplatError, match=r"a\.tif has \d+ bytes but claims to hold 9000000;"):
        read_pixels(written(tmp_path / "a.tif", np.zeros((3000, 3000), np.uint8), nbits=2, compress="DEFLATE"))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_jpeg_of_eight_bits_is_nearly_what_was_stored(tmp_path):
    smooth = np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)
    for shape in ({"blockysize": 16}, {"tiled": True, "blockxsize": 32, "blockysize": 16}):
        path = written(tmp_path / "a.tif", smooth, compress="JPEG", JPEG_QUALITY=95, **shape)
        assert np.abs(read_pixels(path).astype(int) - smooth).max() <= 2
    data = bytearray(path.read_bytes())
    for start in range(len(data)):
        if data[start : start + 2] == b"\xff\xc0":  # where each says how large it is
            data[start + 5 : start + 9] = b"\xf0\0\xf0\0"
    path.write_bytes(data)
    with pytest.raises(SarsplatError, match=r"a\.tif is not a readable TIFF .*61440"):
        read_pixels(path)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_without_imagecodecs_its_extra_is_named(tmp_path, monkeypatch):
    few = tifffile.tifffile.CompressionCodec(encode=False)
    monkeypatch.setattr(tifffile.tifffile, "imagecodecs", _imagecodecs)
    monkeypatch.setattr(tifffile.TIFF, "DECOMPRESSORS", few)
    monkeypatch.setattr(tifffile.TIFF, "UNPREDICTORS", tifffile.tifffile.PredictorCodec(encode=False))
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    assert read_pixels(written(tmp_path / "a.tif", FLOATS, compress="DEFLATE")).shape == FLOATS.shape
    for pixels, options, words in (
        (FLOATS, {"compress": "LZW"}, "LZW"),
        (FLOATS, {"compress": "DEFLATE", "predictor": 3}, "ADOBE_DEFLATE PREDICTOR=3"),
        (np.ones((37, 50), np.uint8), {"compress": "JPEG"}, "JPEG"),
        (np.ones((37, 50), np.uint8), {"nbits": 4}, "NONE NBITS=4"),
    ):
        path = written(tmp_path / "a.tif", pixels, **options)
        with pytest.raises(SarsplatError, match=rf"a\.tif is packed \({words}\), which needs imagecodecs; install it"):
            read_pixels(path)


def test_heights_with_a_predictor_and_overviews(tmp_path):
    place = {"crs": "EPSG:32632", "transform": rasterio.Affine(0.5, 0, 500000, 0, -0.5, 5e6)}
    path = written(tmp_path / "a.tif", FLOATS, compress="DEFLATE", predictor=3, **place)
    with rasterio.open(path, "r+") as file:
        file.build_overviews([2, 4])
    np.testing.assert_array_equal(read_heights(path).raster.values, FLOATS)
    np.testing.assert_array_equal(read_pixels(path), FLOATS)


@pytest.mark.parametrize("compression", ["DEFLATE", "LZW"])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_heights_in_a_tile_that_is_far_larger_than_they_are_are_refused(tmp_path, monkeypatch, compression):
    monkeypatch.setattr(geotiff, "_HARMLESS", 1 << 20)
    options = {"compress": compression, "tiled": True, "blockxsize": 4096, "blockysize": 2048}
    path = written(tmp_path / "a.tif", np.zeros((9, 9), np.uint8), **options)
    tracemalloc.start()
    with pytest.raises(SarsplatError, match=r"a\.tif holds .*uint8.* of shape \(9, 9\)"):
        read_heights(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 22
    tracemalloc.stop()


@pytest.mark.parametrize("inside", [True, False])  # a file beside it is GDAL's habit before 3.9
def test_masked_heights_are_not_known(tmp_path, inside):
    place = {"crs": "EPSG:32632", "transform": rasterio.Affine(0.5, 0, 500000, 0, -0.5, 5e6)}
    seen = FLOATS > -1
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=inside):
        path = written(tmp_path / "a.tif", FLOATS, **place)
        with rasterio.open(path, "r+") as file:
            file.write_mask(seen)
    assert (tmp_path / "a.tif.msk").exists() != inside
    np.testing.assert_array_equal(read_heights(path).raster.values, np.where(seen, FLOATS, np.nan))
    np.testing.assert_array_equal(read_picture(path)[1].absent, ~seen)
    if not inside:
        (tmp_path / "a.tif.msk").write_bytes(b"no")
        with pytest.raises(SarsplatError, match=r"a\.tif\.msk is not a readable TIFF"):
            read_heights(path)


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
        (np.ones((9, 9), np.uint32), {"NBITS": 24}, "holds uint32 numbers as NONE NBITS=24, .* -co NBITS=32"),
        (np.ones((3, 32, 32), np.uint8), {"compress": "JPEG", "photometric": "YCBCR"}, "holds uint8 numbers as JPEG"),
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
