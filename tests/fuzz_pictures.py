"""What strangers may hand to the importers of pictures: tables, pictures of every kind, files of the SAMPLE set."""

import io
import random
import re
from pathlib import Path

import numpy as np
import scipy.io
import tifffile
from PIL import Image

from fuzz_mutations import FLOATS, NUMBERS
from fuzz_radar_files import checked
from made import in_memory, sample_bytes, sample_path
from sarsplat.importers import import_folder, import_sample

_POWER = np.random.default_rng(3).gamma(1.0, size=(10, 12)).astype(np.float32) + 0.1
_SIGNAL = (np.sqrt(_POWER) * np.exp(1j * np.arange(12))).astype(np.complex64)

_TAGS = [
    (33550, "d", 3, (0.1, 0.3, 0.0), True),
    (33922, "d", 6, (0.0, 0.0, 0.0, 5e5, 5e6, 0.0), True),
    (34735, "H", 8, (1, 1, 0, 1, 1025, 0, 1, 1), True),
    (42112, "s", 0, '<GDALMetadata><Item name="SCALE" sample="0" role="scale">0.5</Item></GDALMetadata>', True),
    (42113, "s", 0, "0", True),
]
"""Where pixels lie, what they are multiplied by and which were not measured."""

# ---- tables ----


def tables() -> list[bytes]:
    """Of two pictures, a.npy and b.npy."""
    plain = "file,azimuth,grazing,spacing,split\na.npy,0,30,0.2,train\nb.npy,90,31,0.2,train\n"
    rich = "path;az (deg);Incidence_deg;pixel_spacing_m;range-resolution;azimuth-resolution;look;az_std_deg\n"
    rich += "a;0,5;60;0,2;0,3;0,3;left;1\n./b.npy;90,25;59;0,2;0,3;0,3;R;0,5\n"
    return [plain.encode(), b"\xef\xbb\xbf" + rich.replace("\n", "\r\n").encode()]


def prepare_table(folder: Path) -> None:
    """The pictures, and one that the table must not lead to."""
    (folder / "shots").mkdir()
    for name in ("shots/a", "shots/b", "secret"):
        np.save(folder / f"{name}.npy", _POWER)
    (folder / "shots/link.npy").symlink_to(folder / "secret.npy")


def spoil_cell(data: bytes, rng: random.Random) -> bytes:
    """One cell replaced by what may hurt."""
    cells = [found.span() for found in re.finditer(rb"[^,;\r\n]+", data)]
    if not cells:
        return data
    start, end = rng.choice(cells)
    words = [b"../secret.npy", b"/etc/passwd", b"link.npy", b"shots\\a.npy", b"a.npy\0", b'"', b'"a\nb"', b"x" * 300]
    words += [b"left", b"test-1", b"TRAIN", b"azimuth", b"scale", b"", b";", b"1e400", b"\xff"]
    words += [str(number).encode() for number in (*NUMBERS, *FLOATS)]
    return data[:start] + rng.choice(words) + data[end:]


def read_table(folder: Path) -> object:
    return checked(import_folder, folder / "shots", folder / "out", quantity="power", grazing_deg=20)


# ---- pictures ----


def pictures() -> list[bytes]:
    """Of every kind, zeros among each that can be packed."""
    eight, zeros = (_POWER * 40).astype(np.uint8), np.zeros((1000, 1000), np.uint8)
    made = []
    for pixels in (eight, (_POWER * 9000).astype(np.uint16), np.stack([eight] * 3, axis=-1), zeros):
        made.append(in_memory(Image.fromarray(pixels).save, "PNG"))
    picture = Image.fromarray(eight)
    made += [in_memory(picture.convert("P").save, "PNG"), in_memory(picture.save, "JPEG")]
    for pixels, options in (
        (_POWER, {}),
        (eight, {"compression": "zlib"}),
        (_POWER, {"byteorder": ">"}),
        (np.stack([_POWER, _POWER]), {"photometric": "minisblack", "planarconfig": "separate"}),
        (_POWER.astype(np.float64), {"tile": (16, 16)}),
        (zeros, {"compression": "zlib"}),
        (_SIGNAL, {"photometric": "minisblack"}),
        (eight, {"photometric": "miniswhite", "extratags": _TAGS}),
        (eight, {"description": '{"scale_factor": 0.1, "radiometry": "sigma_nought"}'}),
    ):
        made.append(in_memory(tifffile.imwrite, pixels, **{"metadata": None, **options}))
    for pixels, options in ((_POWER, {"tiffinfo": {317: 3}}), ((_POWER * 9000).astype(np.uint16), {}), (zeros, {})):
        made.append(in_memory(Image.fromarray(pixels).save, "TIFF", compression="tiff_lzw", **options))
    made.append(in_memory(picture.save, "TIFF", compression="jpeg"))
    opaque = np.stack([eight, eight * 0 + 255], axis=-1)
    made.append(in_memory(tifffile.imwrite, opaque, photometric="minisblack", extrasamples=[2]))
    with tifffile.TiffWriter(buffer := io.BytesIO()) as tiff:
        tiff.write(_POWER, metadata=None)
        tiff.write(_POWER > 1, subfiletype=4, photometric="mask", metadata=None)
    made.append(buffer.getvalue())
    for pixels in (_POWER, _SIGNAL, np.stack([_POWER, _POWER], axis=-1), np.asfortranarray(eight)):
        made.append(in_memory(np.save, pixels))
    return [*made, in_memory(scipy.io.savemat, {"image": _SIGNAL, "spacing": 0.5})]


def spoil_npy(data: bytes, rng: random.Random) -> bytes:
    """Type or shape in the header of a NumPy file; others stay."""
    found = re.search(rb"'descr': '[^']*'|'shape': \([^)]*\)", data[:128]) if data.startswith(b"\x93NUMPY") else None
    if found is None:
        return data
    shape = f"'shape': ({rng.choice(NUMBERS)}, {rng.choice(NUMBERS)})".encode()
    new = rng.choice((shape, b"'descr': '|O'", b"'descr': '<f8'", b"'descr': '<U900'", b"'descr': [('a', '<f4')]"))
    whole = new.ljust(len(found[0]))
    return data[: found.start()] + whole + data[found.end() :]


def read_picture(folder: Path) -> object:
    """Named after how it begins, as nobody else would know what it is."""
    data = (folder / "picture").read_bytes()
    endings = {b"\x89P": "png", b"\xff\xd8": "jpg", b"II": "tif", b"MM": "tif", b"MA": "mat"}
    name = f"a.{endings.get(data[:2], 'npy')}"
    shots = folder / "shots"
    shots.mkdir(exist_ok=True)
    (shots / name).write_bytes(data)
    (shots / "t.csv").write_text(f"file,azimuth\n{name},30\n")
    try:
        quantity = None if b"<c" in data[:128] or name[2] in "pjm" else "power"
        options = {"spacing_m": (0.1, 0.3), "grazing_deg": 20, "quantity": quantity}
        return checked(import_folder, shots, folder / "out", **options)
    finally:
        (shots / name).unlink()


# ---- SAMPLE ----


def samples() -> list[bytes]:
    return [sample_bytes(_SIGNAL, 20.4, changes) for changes in ({}, {"azimuth": 0.3560, "xrange_pixel_spacing": 0})]


SAMPLE_FILE = str(sample_path(Path("set"), 20.4))


def prepare_sample(folder: Path) -> None:
    (folder / SAMPLE_FILE).parent.mkdir(parents=True)


def read_sample(folder: Path) -> object:
    return checked(import_sample, folder / "set", folder / "out", target="t72")
