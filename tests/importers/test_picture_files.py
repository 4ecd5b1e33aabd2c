"""Pixels of pictures of every kind, and what they stand for."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

from fuzz import watched
from sarsplat.errors import SarsplatError
from sarsplat.importers.pictures import likely_quantity, power_or_signal, read_pixels

EIGHT = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
SIXTEEN = EIGHT.astype(np.uint16) * 250
REAL = np.linspace(0.1, 9, 12, dtype=np.float32).reshape(3, 4)
COMPLEX = (REAL * np.exp(1j * np.arange(12).reshape(3, 4))).astype(np.complex64)


def written(folder: Path, name: str, pixels: np.ndarray, **options) -> Path:
    path = folder / name
    match path.suffix:
        case ".npy":
            np.save(path, pixels)
        case ".tif":
            tifffile.imwrite(path, pixels, **options)
        case ".mat":
            scipy.io.savemat(path, {"image": pixels, "spacing": 0.5, "azimuths": [1.0, 2.0], **options})
        case _:
            Image.fromarray(pixels).save(path, **options)
    return path


@pytest.mark.parametrize(
    ("name", "pixels", "options"),
    [
        ("a.png", EIGHT, {}),
        ("a.png", SIXTEEN, {}),
        ("a.png", np.stack([EIGHT] * 3, axis=-1), {}),  # grey that was saved in colour
        ("a.tif", EIGHT, {"compression": "zlib"}),
        ("a.tif", SIXTEEN, {"byteorder": ">"}),
        ("a.tif", REAL, {"photometric": "minisblack"}),
        ("a.tif", REAL.astype(np.float64), {"tile": (16, 16)}),
        ("a.tif", COMPLEX, {}),
        ("a.npy", REAL, {}),
        ("a.npy", COMPLEX.astype(np.complex128), {}),
        ("a.npy", REAL[None], {}),
        ("a.npy", np.asfortranarray(REAL), {}),
        ("a.mat", COMPLEX, {}),
        ("a.mat", SIXTEEN, {"about": {"sensor": "x"}}),
    ],
)
def test_pixels_are_those_written(tmp_path, name, pixels, options):
    read = read_pixels(written(tmp_path, name, pixels, **options))
    expected = pixels[..., 0] if name == "a.png" and pixels.ndim == 3 else pixels.reshape(3, 4)
    assert read.shape == (3, 4)
    assert read.dtype.kind == pixels.dtype.kind
    np.testing.assert_array_equal(read, expected)


def test_opaque_pixels_are_those_without_their_transparency(tmp_path):
    Image.fromarray(np.stack([EIGHT, np.full_like(EIGHT, 255)], axis=-1)).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png"), EIGHT)


def test_jpeg(tmp_path):
    path = tmp_path / "a.JPG"
    Image.fromarray(np.kron(EIGHT, np.ones((8, 8), np.uint8))).save(path, "JPEG", quality=100)
    assert np.abs(read_pixels(path)[::8, ::8].astype(int) - EIGHT).max() <= 2


def test_overviews_of_a_geotiff_are_left_out(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as tiff:
        tiff.write(REAL, metadata=None, extratags=[(33550, "d", 3, (0.3, 0.3, 0.0), True)])
        tiff.write(REAL[::2, ::2], subfiletype=1, metadata=None)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif"), REAL)


@pytest.mark.parametrize("axis", [0, -1])
def test_two_bands_are_real_and_imaginary_part(tmp_path, axis):
    bands = np.stack([COMPLEX.real, COMPLEX.imag], axis=axis)
    for name, options in (("a.npy", {}), ("a.tif", {"photometric": "minisblack", "planarconfig": "contig"})):
        pixels = read_pixels(written(tmp_path, name, bands, **options))
        assert likely_quantity(pixels, "it") == "complex"
        np.testing.assert_allclose(power_or_signal(pixels, "complex", "it"), COMPLEX, rtol=1e-6)


def test_quantities_are_one_power():
    for pixels, quantity in (
        (REAL**2, "power"),
        (REAL, "amplitude"),
        (20 * np.log10(REAL), "db"),
        (np.abs(COMPLEX) ** 2, "power"),
    ):
        power = power_or_signal(pixels, quantity, "it")
        assert power.dtype == np.float32
        np.testing.assert_allclose(power, REAL**2, rtol=1e-5)
    signal = power_or_signal(COMPLEX.astype(np.complex128), "complex", "it", scale=2)
    assert signal.dtype == np.complex64
    np.testing.assert_allclose(signal, 2 * COMPLEX, rtol=1e-6)
    assert likely_quantity(COMPLEX, "it") == "complex"
    assert likely_quantity(SIXTEEN, "it") == "amplitude"


def test_eight_bits_of_decibels_and_zeros():
    np.testing.assert_allclose(
        10 * np.log10(power_or_signal(EIGHT, "db", "it", scale=60 / 255, offset=-60)),
        EIGHT * (60 / 255) - 60,
        atol=1e-4,
    )
    assert power_or_signal(EIGHT, "amplitude", "it", scale=0.5).max() == 110**2
    assert power_or_signal(REAL * 0, "power", "it").max() == 0


def png_of_zeros(side: int) -> bytes:
    """A PNG that promises `side`² pixels in a hundredth of the bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    body = zlib.compress(bytes((side + 1) * side), 1)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def npy(header: str) -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def tiff_of(pixels: np.ndarray, **options) -> bytes:
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, pixels, **options)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.png", png_of_zeros(3000), "claims to hold"),
        ("a.png", b"no", "not a PNG or JPEG"),
        ("a.png", png_of_zeros(20)[:45], "not a PNG or JPEG"),
        ("a.gif", b"GIF89a", r"does not end in one of \.png"),
        ("a.tif", tiff_of(np.zeros((1500, 1500), np.float32), compression="zlib"), "claims to hold"),
        ("a.tif", tiff_of(np.zeros((2, 3, 4), np.uint8), photometric="minisblack", planarconfig=None), "several pages"),
        ("a.tif", tiff_of(np.zeros((3, 4, 3), np.uint8), photometric="rgb"), "holds uint8 of shape"),
        ("a.tif", tiff_of(REAL)[:100], "not a readable TIFF"),
        ("a.npy", b"no", "not a NumPy file"),
        ("a.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (90000, 90000)}"), "not a readable array"),
        ("a.tif", b"II*\0" + bytes(4), "no image in it"),
        ("a.npy", npy("{'descr': '|O', 'fortran_order': False, 'shape': (2, 2)}"), "not a readable array"),
        ("a.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 2)}"), "not a readable array"),
        ("a.npy", npy("{'descr': '<f4', 'fortran_order': False, 'shape': (0, 2)}"), "a.npy"),
    ],
)  # fmt: skip
def test_files_from_strangers(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    with watched() as cost, pytest.raises(SarsplatError, match=words):
        read_pixels(tmp_path / name)
    assert cost.seconds < 1
    assert cost.bytes < 64 << 20


@pytest.mark.parametrize("other", [np.full((8, 8), 2.0), np.linspace(-3.1, 3.1, 64).reshape(8, 8)])
@pytest.mark.parametrize("first", [True, False])
def test_two_bands_that_are_no_real_and_imaginary_part(other, first):
    amplitude = np.linspace(1, 90, 64).reshape(8, 8)
    bands = np.stack([amplitude, other] if first else [other, amplitude])
    for pixels in (bands, np.moveaxis(bands, 0, -1)):
        with pytest.raises(SarsplatError, match=r"a has two bands, .* amplitude and phase, or two channels"):
            power_or_signal(pixels, "complex", "a")
