"""Pictures in rasters of other programs, read by GDAL."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from made_imports import AZIMUTHS, PHASE, POWER, import_pictures
from sarsplat.data import geotiff
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.importers.rasters import first_georeference, read_raster

rasterio = pytest.importorskip("rasterio")
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SIGNAL = (np.sqrt(POWER) * np.exp(1j * PHASE)).astype(np.complex64)


def envi_big(path: Path, pixels: np.ndarray) -> None:
    """Pixels, highest byte first, with a header of text, as other programs than GDAL write them."""
    kind = {"f": 4, "c": 6}[pixels.dtype.kind]
    path.write_bytes(pixels.astype(pixels.dtype.newbyteorder(">")).tobytes())
    shape = f"samples = {pixels.shape[1]}\nlines = {pixels.shape[0]}\nbands = 1\n"
    more = f"header offset = 0\ndata type = {kind}\ninterleave = bsq\nbyte order = 1\n"
    path.with_suffix(".hdr").write_text(f"ENVI\n{shape}{more}")


def by_gdal(path: Path, pixels: np.ndarray, driver: str, **options: object) -> None:
    rows, columns = pixels.shape
    options |= {"driver": driver, "height": rows, "width": columns, "count": 1, "dtype": pixels.dtype}
    with rasterio.open(path, "w", **options) as file:
        file.write(pixels, 1)


@pytest.mark.parametrize(
    ("name", "driver", "pixels", "options"),
    [
        ("a.img", "ENVI", POWER, {}),
        ("a.img", "ENVI", SIGNAL, {}),
        ("a.img", "big", POWER, {}),
        ("a.img", "big", SIGNAL, {}),
        ("a.slc", "ISCE", SIGNAL, {}),
        ("a.slc", "ROI_PAC", SIGNAL, {}),
        ("a.data/Sigma0_VV.img", "big", POWER, {}),  # of BEAM-DIMAP
        ("a.tif", "GTiff", POWER.astype(np.float16).astype(np.float32), {"NBITS": 16}),
        ("a.tif", "GTiff", POWER, {"compress": "LERC_ZSTD"}),
        ("a.tif", "GTiff", SIGNAL, {"compress": "DEFLATE", "predictor": 1, "ENDIANNESS": "BIG"}),
    ],
)
def test_any_raster_is_a_picture(tmp_path, name, driver, pixels, options):
    folder, rows = tmp_path / "in", []
    for k, (one, azimuth) in enumerate(zip(pixels, AZIMUTHS, strict=True)):
        rows.append([f"{k}{name}", azimuth, 30])
        path = folder / f"{k}{name}"
        path.parent.mkdir(parents=True, exist_ok=True)
        envi_big(path, one) if driver == "big" else by_gdal(path, one, driver, **options)
    with (folder / "angles.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["file", "azimuth", "grazing"], *rows])
    made = import_pictures(folder, quantity=None if pixels is SIGNAL else "power")
    np.testing.assert_array_equal(made.power if made.signal is None else made.signal, pixels)


def test_rasters_that_point_elsewhere_are_refused(tmp_path):
    band = '<VRTRasterBand dataType="Float32" band="1"/>'
    (tmp_path / "a.vrt").write_text(f'<VRTDataset rasterXSize="2" rasterYSize="2">{band}</VRTDataset>')
    (tmp_path / "angles.csv").write_text("file,azimuth,grazing\na.vrt,0,30\n")
    with pytest.raises(SarsplatError, match=r"a\.vrt is not a readable raster"):
        import_pictures(tmp_path)


@pytest.mark.parametrize("options", [{}, {"tiled": True, "blockxsize": 64, "blockysize": 64}])
def test_what_unpacks_to_far_more_than_its_size_is_refused(tmp_path, monkeypatch, options):
    monkeypatch.setattr(geotiff, "_HARMLESS", 100)
    path = tmp_path / "a.tif"
    size = (300, 300) if not options else (9, 9)
    by_gdal(path, np.zeros(size, np.uint8), "GTiff", compress="DEFLATE", **options)
    path.write_bytes(path.read_bytes() + bytes(0 if options else 64))
    monkeypatch.setattr(geotiff, "_MOST_PACKED", 4)
    with pytest.raises(SarsplatError, match="claims to hold"):
        read_raster(path)


def test_a_world_file_beside_a_packed_picture_says_nothing_of_its_unit(tmp_path):
    for k, (image, azimuth) in enumerate(zip(POWER, AZIMUTHS, strict=True)):
        by_gdal(tmp_path / f"{k}.tif", image, "GTiff", compress="LZW")
        (tmp_path / f"{k}.tfw").write_text("2e-5\n0\n0\n-3e-5\n8.5\n47.3\n")
        with (tmp_path / "angles.csv").open("a") as file:
            file.write(("file,azimuth,grazing\n" if k == 0 else "") + f"{k}.tif,{azimuth},30\n")
    with pytest.warns(SarsplatWarning, match=r"has the world file 0\.tfw beside it"):
        made = import_pictures(tmp_path, quantity="power")
    assert made.grid.spacing_m[0] > 0.01


def test_a_stated_spacing_is_found_after_a_picture_without_one(tmp_path):
    by_gdal(tmp_path / "0-browse.bmp", np.ones((4, 5), np.uint8), "BMP")
    by_gdal(tmp_path / "a.tif", POWER[0], "GTiff", transform=rasterio.Affine(0.2, 0, 0, 0, -0.3, 0))
    found = first_georeference(sorted(tmp_path.iterdir()))
    assert found is not None and found.pitch == pytest.approx((0.2, 0.3))
