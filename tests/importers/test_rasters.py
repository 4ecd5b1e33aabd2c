"""Pictures in rasters of other programs, read by GDAL."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from made_imports import AZIMUTHS, PHASE, POWER, import_pictures
from sarsplat.errors import SarsplatError

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
    with rasterio.open(
        path, "w", driver=driver, height=rows, width=columns, count=1, dtype=pixels.dtype, **options
    ) as file:
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
    (tmp_path / "a.vrt").write_text(
        '<VRTDataset rasterXSize="2" rasterYSize="2"><VRTRasterBand dataType="Float32" band="1"/></VRTDataset>'
    )
    (tmp_path / "angles.csv").write_text("file,azimuth,grazing\na.vrt,0,30\n")
    with pytest.raises(SarsplatError, match=r"a\.vrt is not a readable raster"):
        import_pictures(tmp_path)
