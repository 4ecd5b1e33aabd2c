"""Pixels of pictures of every kind, and what they stand for."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

from fuzz import watched
from made import in_memory
from sarsplat.errors import SarsplatError
from sarsplat.importers.pictures import (
    likely_quantity,
    meaning_of,
    power_or_signal,
    read_picture,
    read_pixels,
    read_values,
)

EIGHT = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
ALPHA = {"photometric": "minisblack", "extrasamples": ["unassalpha"]}
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
        ("a.png", np.stack([EIGHT, np.full_like(EIGHT, 255)], axis=-1), {}),  # opaque
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
    planes = {0: "separate", -1: "contig"}[axis]
    for name, options in (("a.npy", {}), ("a.tif", {"photometric": "minisblack", "planarconfig": planes})):
        pixels = read_pixels(written(tmp_path, name, bands, **options))
        assert likely_quantity(pixels, "it") == "complex"
        np.testing.assert_allclose(power_or_signal(pixels, "complex", "it"), COMPLEX, rtol=1e-6)


def tagged(folder: Path, pixels: np.ndarray, *tags: tuple, **options) -> Path:
    return written(folder, "a.tif", pixels, metadata=None, extratags=tags, **options)


def raw_tiff(folder: Path, parts: np.ndarray, kind: int, order: str = "<") -> Path:
    """An image of 3 × 4 pixels that tifffile does not write, of this sample format; 5 and 6 are complex."""
    body = parts.astype(parts.dtype.newbyteorder(order)).tobytes()
    bits = 8 * len(body) // 12
    tags = {256: 4, 257: 3, 258: bits, 259: 1, 262: 1, 273: 8, 277: 1, 278: 3, 279: len(body), 339: kind}
    entries = b"".join(struct.pack(order + "HHII", code, 4, 1, value) for code, value in tags.items())
    head = struct.pack(order + "2sHI", b"II" if order == "<" else b"MM", 42, 8 + len(body))
    (folder / "a.tif").write_bytes(head + body + struct.pack(order + "H", len(tags)) + entries + bytes(4))
    return folder / "a.tif"


@pytest.mark.parametrize(("kind", "order", "form"), [("i2", "<", 5), ("i2", ">", 5), ("i4", "<", 5), ("f2", "<", 6)])
def test_complex_numbers_in_two_parts(tmp_path, kind, order, form):
    """As GDAL's CInt16, CInt32 and CFloat16; nothing reads those of bytes."""
    signal = np.round(COMPLEX * 200)  # halves hold whole numbers up to 2048
    parts = np.stack([signal.real, signal.imag], axis=-1).astype(kind)
    np.testing.assert_array_equal(read_pixels(raw_tiff(tmp_path, parts, form, order)), signal)
    for bad, undefined in ((parts.astype("i1"), 5), (REAL, 4)):
        with pytest.raises(SarsplatError, match="has samples of an undefined format, or complex ones of 8"):
            read_pixels(raw_tiff(tmp_path, bad, undefined))


def masked(folder: Path, mask: np.ndarray) -> Path:
    """With a mask of its pixels beside it, as GDAL writes one."""
    with tifffile.TiffWriter(folder / "a.tif") as tiff:
        tiff.write(REAL, metadata=None)
        tiff.write(mask, subfiletype=4, photometric="mask", metadata=None)
    return folder / "a.tif"


@pytest.mark.parametrize("axis", [0, -1])
def test_masks_and_transparency_say_what_is_not_known(tmp_path, axis):
    seen = np.ones(EIGHT.shape, bool)
    whole = masked(tmp_path, seen)
    assert not read_values(whole, "power", 1.0, 0.0).unknown.any()
    np.testing.assert_array_equal(read_pixels(whole), REAL)
    seen[0, 1:3] = False
    values = read_values(masked(tmp_path, seen), "power", 1.0, 0.0)
    np.testing.assert_array_equal(values.unknown, ~seen)
    np.testing.assert_array_equal(values.image, np.where(seen, REAL, 0))

    planes = {0: "separate", -1: "contig"}[axis]
    options = {**ALPHA, "planarconfig": planes}
    path = written(tmp_path, "b.tif", np.stack([EIGHT, 255 * seen.astype(np.uint8)], axis=axis), **options)
    values = read_values(path, "amplitude", 1.0, 0.0)
    np.testing.assert_array_equal(values.unknown, ~seen)
    np.testing.assert_array_equal(values.image, np.where(seen, EIGHT.astype(float) ** 2, 0))
    path = written(tmp_path, "b.tif", np.stack([EIGHT, np.full_like(EIGHT, 255)], axis=axis), **options)
    np.testing.assert_array_equal(read_pixels(path), EIGHT)
    with pytest.raises(SarsplatError, match="holds nothing but pixels without data"):
        read_values(masked(tmp_path, np.zeros(EIGHT.shape, bool)), "power", 1.0, 0.0)


def described(*names: str) -> tuple:
    items = (f'<Item name="D" sample="{k}" role="description">{name}</Item>' for k, name in enumerate(names))
    return (42112, "s", 0, f"<GDALMetadata>{''.join(items)}</GDALMetadata>", True)


def test_two_polarisations_are_no_complex_numbers(tmp_path):
    """In decibels both are negative, and yet no real and imaginary part."""
    decibels = np.stack([np.log10(REAL) * 10 - 20, np.log10(REAL[::-1]) * 10 - 25])
    options = {"photometric": "minisblack", "planarconfig": "separate"}
    with pytest.raises(SarsplatError, match=r"a\.tif has two bands that are both negative nearly everywhere"):
        read_values(tagged(tmp_path, decibels, **options), None, 1.0, 0.0)
    for bands in (decibels, 10 ** (decibels / 10)):
        path = tagged(tmp_path, bands, described("Sigma0_VV_db", "Sigma0_VH_db"), **options)
        with pytest.raises(SarsplatError, match=r"bands of several polarisations \(VV, VH\); give one"):
            read_pixels(path)
    path = tagged(tmp_path, np.stack([COMPLEX.real, COMPLEX.imag]), described("i_VV", "q_VV"), **options)
    np.testing.assert_allclose(read_values(path, None, 1.0, 0.0).image, COMPLEX, rtol=1e-6)


def test_no_data_does_not_change_what_bands_mean(tmp_path):
    phase = np.linspace(-3.14, 3.14, REAL.size, dtype=np.float32).reshape(REAL.shape)
    bands = np.stack([REAL, phase])
    bands[:, 1, 2] = -9999
    options = {"photometric": "minisblack", "planarconfig": "separate"}
    values = read_values(tagged(tmp_path, bands, (42113, "s", 0, "-9999", True), **options), None, 1.0, 0.0)
    assert values.assumptions == ("the two bands of complex pictures are amplitude and phase in radians",)
    expected = np.where(values.unknown, 0, REAL * np.exp(1j * phase))
    np.testing.assert_allclose(values.image, expected, rtol=1e-5)
    assert np.argwhere(values.unknown).tolist() == [[1, 2]]


def test_pixels_without_data_are_zero_and_known(tmp_path):
    holes = REAL.copy()
    holes[1, 2] = -9999
    for hole, text in ((-9999, "-9999"), (np.nan, "nan"), (-3.4028234663852886e38, "-3.4028234663852886e+38")):
        holes[1, 2] = hole
        for quantity in ("power", "amplitude", "db"):
            values = read_values(tagged(tmp_path, holes, (42113, "s", 0, text, True)), quantity, 1.0, 0.0)
            assert np.argwhere(values.unknown).tolist() == [[1, 2]]
            assert values.image[1, 2] == 0
            expected = power_or_signal(REAL, quantity, "it")
            np.testing.assert_array_equal(values.image[~values.unknown], expected[~values.unknown])
    with pytest.raises(SarsplatError, match="holds nothing but"):
        read_values(tagged(tmp_path, REAL * 0, (42113, "s", 0, "0", True)), "power", 1.0, 0.0)


def test_scale_and_offset_of_the_file(tmp_path):
    """Those of the user come first."""
    text = '<GDALMetadata><Item name="OFFSET" sample="0" role="offset">-60</Item>'
    text += '<Item name="SCALE" sample="0" role="scale">0.25</Item></GDALMetadata>'
    path = tagged(tmp_path, EIGHT, (42112, "s", 0, text, True))
    values = read_values(path, "db", 1.0, 0.0)
    np.testing.assert_allclose(values.image, 10 ** ((EIGHT * 0.25 - 60) / 10), rtol=1e-5)
    assert values.assumptions == ("pixels are multiplied by the files' scales, and their offsets added",)
    given = read_values(path, "db", 0.1, 0.0, own=False)
    np.testing.assert_allclose(given.image, 10 ** (EIGHT * 0.1 / 10), rtol=1e-5)
    assert given.assumptions == ("the files state scales or factors, which are not used, for others are given",)
    with pytest.raises(SarsplatError, match=r"names \[\(inf, -60\.0\)\] as scale and offset"):
        read_picture(tagged(tmp_path, EIGHT, (42112, "s", 0, text.replace("0.25", "inf"), True)))


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_scale_in_a_sidecar(tmp_path, ending):
    path = written(tmp_path, f"a.{ending}", EIGHT)
    band = '<PAMRasterBand band="1"><Offset>3</Offset><Scale>0.5</Scale></PAMRasterBand>'
    path.with_name(f"a.{ending}.aux.xml").write_text(f"<PAMDataset>{band}</PAMDataset>")
    np.testing.assert_allclose(read_values(path, "power", 1.0, 0.0).image, EIGHT * 0.5 + 3)


@pytest.mark.parametrize("compression", [None, "zlib", "a.json", "a_extended.json", "png"])
@pytest.mark.parametrize(
    ("said", "factor", "by", "kind"),
    [
        ({"image": {"scale_factor": 0.01, "radiometry": "sigma_nought"}}, 1e-4, ["the square of "], "sigma0"),
        ({"product": [{"iceye:calibration_factor": "2e-6"}]}, 2e-6, [""], None),
        ({"scale_factor": "none", "other": 3}, 1.0, [], None),
    ],
)
def test_factors_of_producers(tmp_path, said, factor, by, kind, compression):
    ending, name = ("png", "a.json") if compression == "png" else ("tif", compression)
    beside = name is not None and name.endswith(".json")
    told = {} if beside else {"description": json.dumps(said), "compression": compression, "metadata": None}
    path = written(tmp_path, f"a.{ending}", SIXTEEN, **told)
    if beside:
        path.with_name(name).write_text(" " * (5 << 20) + json.dumps(said))
    values = read_values(path, None, 1.0, 0.0)
    assert (values.power_factor, values.tags.backscatter) == (pytest.approx(factor), kind)
    told = [text for text in values.assumptions if "each file's" in text]
    assert [text.split("multiplied by ")[1].split("each")[0] for text in told] == by
    assert read_values(path, None, 1.0, 0.0, own=False).power_factor == 1.0  # another is given


@pytest.mark.parametrize(
    ("pixels", "options", "words"),
    [
        (EIGHT, {"photometric": "palette", "colormap": np.zeros((3, 256), np.uint16)}, "colours in a palette"),
        (SIXTEEN, {"photometric": "miniswhite"}, "zero is white"),
        (EIGHT, {"photometric": "miniswhite"}, "zero is white"),
        (EIGHT, {"extratags": [(274, "H", 1, 6, True)]}, "stored turned .orientation 6."),
        (np.stack([EIGHT, EIGHT]), {**ALPHA, "planarconfig": "separate"}, "transparent in part"),
    ],
)
def test_tags_that_change_the_meaning(tmp_path, pixels, options, words):
    with pytest.raises(SarsplatError, match=words):
        read_pixels(written(tmp_path, "a.tif", pixels, metadata=None, **options))


@pytest.mark.parametrize("axis", [0, -1])
def test_what_two_bands_are(axis):
    phase = np.linspace(-np.pi, np.pi, REAL.size).reshape(REAL.shape)
    turned = REAL * np.exp(1j * phase)
    for bands, meaning in (
        ((turned.real, turned.imag), "real and imaginary part"),
        ((REAL, phase), "amplitude and phase in radians"),
        ((REAL, np.degrees(phase)), "amplitude and phase in degrees"),
    ):
        pixels = np.stack(bands, axis=axis).astype(np.float32)
        assert meaning_of(pixels, "it") == meaning
        np.testing.assert_allclose(power_or_signal(pixels, "complex", "it"), turned, atol=1e-4)
    for bands in ((REAL, REAL), (REAL, phase / 4), (phase, REAL), (REAL, 3 * phase)):
        with pytest.raises(SarsplatError, match=r"it has two bands, of which .* negative"):
            power_or_signal(np.stack(bands, axis=axis).astype(np.float32), "complex", "it")
    assert meaning_of(REAL, "it") is None


def test_quantities_are_one_power():
    for pixels, quantity in ((REAL**2, "power"), (REAL, "amplitude"), (20 * np.log10(REAL), "db")):
        power = power_or_signal(pixels, quantity, "it")
        assert power.dtype == np.float32
        np.testing.assert_allclose(power, REAL**2, rtol=1e-5)
    signal = power_or_signal(COMPLEX.astype(np.complex128), "complex", "it", scale=2)
    assert signal.dtype == np.complex64
    np.testing.assert_allclose(signal, 2 * COMPLEX, rtol=1e-6)
    assert likely_quantity(COMPLEX, "it") == "complex"
    assert likely_quantity(SIXTEEN, "it") == "amplitude"


def test_eight_bits_of_decibels_and_zeros():
    decibels = 10 * np.log10(power_or_signal(EIGHT, "db", "it", scale=60 / 255, offset=-60))
    np.testing.assert_allclose(decibels, EIGHT * (60 / 255) - 60, atol=1e-4)
    assert power_or_signal(EIGHT, "amplitude", "it", scale=0.5).max() == 110**2
    assert power_or_signal(REAL * 0, "power", "it").max() == 0


def png_that_claims(side: int) -> bytes:
    """A PNG that promises `side`² pixels and holds a line."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    body = zlib.compress(bytes(side))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def npy(header: str) -> bytes:
    text = f"{{{header}}}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


PAGES = in_memory(tifffile.imwrite, np.zeros((2, 3, 4), np.uint8), photometric="minisblack", planarconfig=None)
COLOURS = in_memory(tifffile.imwrite, np.zeros((3, 4, 3), np.uint8), photometric="rgb")


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.png", png_that_claims(9000), "claims to hold"),
        ("a.gif", b"GIF89a", "not a readable raster"),
        ("a.tif", PAGES, "several pages"),
        ("a.tif", COLOURS, "holds uint8 of shape"),
        ("a.npy", npy("'descr': '<f4', 'fortran_order': False, 'shape': (90000, 90000)"), "not a readable array"),
        ("a.npy", npy("'descr': '|O', 'fortran_order': False, 'shape': (2, 2)"), "not a readable array"),
    ],
)
def test_files_from_strangers(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    with watched() as cost, pytest.raises(SarsplatError, match=words):
        read_pixels(tmp_path / name)
    assert cost.seconds < 1
    assert cost.bytes < 64 << 20
