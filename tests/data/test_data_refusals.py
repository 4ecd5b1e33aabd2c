"""What is refused of data, each in one sentence, writing nothing."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import tifffile
import torch
from PIL import Image

from made import NOISE, SIGNALS, TINY, VIEWS, hill, small_dataset, small_mask, tiny_dataset, upright, write_geotiff
from refusals import Do, Refusals, check_refused, edit_json, stored
from sarsplat import Terrain, Turn, read_terrain
from sarsplat.data import (
    Dataset,
    SarImage,
    load_checkpoint,
    read_dataset,
    read_gaussians_ply,
    read_json,
    read_masks,
    read_points_ply,
    read_tiff,
    write_dataset,
    write_gaussians_ply,
    write_points_ply,
)
from sarsplat.data.csv_table import CsvTable, read_table, relative_path
from sarsplat.data.files import write_bytes
from sarsplat.gaussians import Harmonics
from sarsplat.geometry import ImageGrid, View

# ---- files, checkpoints, tables ----


FILES: Refusals = [
    (lambda at: write_bytes(at / "no" / "a", b""), "does not exist"),
    (stored(b"", lambda file: write_bytes(file / "a", b"")), "is a file, not a folder"),
    (lambda at: write_bytes(at, b""), "is a folder"),
    (stored(b'{"a": 1, "b": ' + b"[" * 100_000, lambda path: read_json(path, dict[str, str])), "got 'int'"),
]


def checkpoint(**described: str) -> bytes:
    return safetensors.torch.save({"x": torch.ones(100)}, {"schema": "sarsplat-checkpoint", **described})


GOOD = checkpoint(version="1", state="{}")
CHECKPOINTS: Refusals = [
    (lambda at: load_checkpoint(at / "none"), "does not exist"),
    *((stored(bad, load_checkpoint), "damaged checkpoint") for bad in (b"", GOOD[:-1], b"\xff" * 8 + GOOD[8:])),
    (stored(safetensors.torch.save({"x": torch.ones(1)}), load_checkpoint), "holds None of version None"),
    *(
        (stored(checkpoint(**described), load_checkpoint), words)
        for described, words in (
            ({"version": "9"}, "version '9'"),
            ({"version": "1"}, "not valid JSON"),
            ({"version": "1", "state": "[1]"}, "expected 'object', got 'array'"),
        )
    ),
]


def table(data: bytes, ask: Callable[[CsvTable], object] = id, *needed: str) -> Do:
    return stored(data, lambda path: ask(read_table(path, "the table", needed)))


TABLES: Refusals = [
    *((table(text), "has no rows") for text in (b"", b"a,b\n")),
    (table(b"a,a\n1,2\n"), "the column 'a' twice"),
    (table(b"a,b\n1,2,3\n"), "line 2: there are 3 cells for 2 columns"),
    (table(b"\xff\xfea"), "not a readable CSV"),
    (table(b"a\n" + b"1\n" * 100_001), "more than 100000 rows"),
    (table(b"a,b\n1,2\n", id, "a", "c"), r"is missing the column 'c'; it needs a, c"),
    (table(b'a,b\n1,"0,5"\n', lambda made: made.number(made.rows[0], "b")), "line 2: b is '0,5'; give a number, with"),
    *(
        (
            table(f"file\n{path}\n".encode(), lambda made: relative_path(made.path, made.rows[0], "file", of="images")),
            r"line 2: .* points outside the folder of images",
        )
        for path in ("../a.png", "/etc/passwd", "a\0.png", "..\\a.png")
    ),
]

# ---- images and datasets in memory ----

VIEW, GRID = View(0, 30), ImageGrid(2, 3, (0.3, 0.3), (0.3, 0.3))
POWERS: Refusals = [
    (lambda _: SarImage([[1.0, 1, 1], [1, 1, 1]], VIEW, GRID), "power is .*give a numpy.ndarray"),
    (lambda _: SarImage(np.ones((2, 3), complex), VIEW, GRID), "complex128 .*SarImage.of_complex"),
    (lambda _: SarImage(np.ones((3, 2)), VIEW, GRID), r"shape \(3, 2\); give real power of shape \(2, 3\)"),
    (lambda _: SarImage(np.array([[1, 1, 1], [1, -1, 1.0]]), VIEW, GRID), r"holds -1 at \(1, 1\)"),
    (lambda _: SarImage(np.array([[1, 1, 1], [1, 1, np.nan]]), VIEW, GRID), r"holds nan at \(1, 2\)"),
    (lambda at: SarImage(np.ones((2, 3)), VIEW, GRID).save(at / "out.tif"), r"does not end in \.png"),
    (lambda at: SarImage(np.ones((2, 3)), VIEW, GRID).save(at / "out.png", dynamic_range_db=0.0), r"of 0\.0 dB"),
]

PHASES = tiny_dataset(SIGNALS)
_FIRST, _OTHER = (SarImage(NOISE[0], VIEW, grid) for grid in (TINY, replace(TINY, center_m=(0, 0))))
SETS: Refusals = [
    (lambda _: replace(PHASES, power=2 * PHASES.power), "not the squared magnitude of its signal"),
    (lambda _: SarImage(PHASES.power[0], VIEW, TINY, SIGNALS[1]), "not the squared magnitude of its signal"),
    (lambda _: SarImage.of_complex(np.ones((6, 5)), VIEW, TINY), "of type float64; give an array of complex"),
    (lambda _: SarImage.of_complex(np.full((6, 5), 1e30 + 0j), VIEW, TINY), r"holds inf at \(0, 0\)"),
    (lambda _: Dataset.from_images([PHASES[0], PHASES[1], _FIRST]), "2 of 3 images have their phase"),
    (lambda _: tiny_dataset(NOISE[:0], views=[]), "at least one image"),
    (lambda _: Dataset.from_images([_FIRST, _OTHER]), r"image 1 is on .* but the first image is on"),
    (lambda _: Dataset.from_images([], test=[_FIRST]), "no training images"),
    (lambda _: Dataset.from_images([_FIRST] * 4, azimuth_std_deg=[1, 2]), "azimuth_std_deg holds 2 "),
    *(
        (lambda _, wrong=wrong: Dataset.from_images([_FIRST] * 4, azimuth_std_deg=[wrong] * 4), "between 0 and 10")
        for wrong in (-1, float("nan"))
    ),
    (lambda _: Dataset.from_images([_FIRST] * 4, turns=[Turn((0, 0, 1), 0.0)]), "turns holds 1 "),
    (lambda _: Dataset.from_images([_FIRST], turns=[Turn((0, 0, 1), 0.0)]), "is not of a target that turns about"),
    *((lambda _, ask=ask: ask(tiny_dataset(), "test-15"), "no set 'test-15'; it has train, test-17, test")
      for ask in (Dataset.images, Dataset.select)),
    (lambda _: tiny_dataset(terrain=hill()), "terrain .* ground is False"),
]  # fmt: skip

# ---- datasets on the disk ----


def write(images: Any = NOISE, *, masks: np.ndarray | None = None, made: Any = tiny_dataset, **changes: Any) -> Do:
    return lambda at: write_dataset(at / "out", made(images, **changes), masks=masks)


WRITTEN: Refusals = [
    (write(NOISE[:3]), "of shape"),
    (write(NOISE.astype(np.float64)), "float64"),
    (write(np.where(NOISE[2, 3, 4] == NOISE, np.nan, NOISE)), r"image '002' holds nan at \(3, 4\)"),
    (write(views=[(view, "test") for view, _ in VIEWS]), "nothing to train on"),
    *((write(source={"x": value}), "JSON") for value in (float("nan"), object())),
    (write(calibration="dreamt"), "'dreamt'"),
    (write(looks=0), "looks 0 must be a positive number"),
    (write(clean_tests=True), "looks is None"),
    (write(score_margin=3), "score_margin 3 does not suit images of 6 × 5 pixels"),
    (write(target_box_m=((0, 0, 0), (1, 1, 0))), "target_box_m"),
    (write(masks=np.zeros((2, 6, 5), np.uint8)), r"uint8 of shape \(2, 6, 5\); .* must be uint8 \(4, 6, 5\)"),
    (write(masks=np.full((4, 6, 5), 3, np.uint8)), "a mask holds the number 3"),
]


def altered(change: Callable[[Path], object], **fields: Any) -> Do:
    """To read a dataset after a change to its folder."""

    def do(at: Path) -> object:
        change(write_dataset(at / "set", tiny_dataset(**fields)).path)
        return read_dataset(at / "set")

    return do


def header(place: str, value: object) -> Do:
    """With another value at that place, or none if it is KeyError."""
    return altered(lambda folder: edit_json(folder / "dataset.json", place, value))


HEADERS: Refusals = [
    (header("schema_version", 1), "its schema_version is 1 but this program reads 2"),
    (header("pixels", "complex"), "holds float32 pixels"),
    (header("grid.rows", 6.0), "grid.rows is 6.0: expected 'int', got 'float'"),
    (header("grid.rows", 7), "shape|too few"),
    (header("grid.spacing_m", [0.1]), "grid.spacing_m is .* length 2"),
    (header("grid.center_m", [0, 10**400]), r"grid.center_m\[1\] is 1000.*: number out of range"),
    (header("grid.resolution_m", KeyError), "grid: object missing required field 'resolution_m'"),
    (header("grid.\x1b[2J", 1), "unknown field '.\\[2J'"),
    (header("truth_mesh", "../x.ply"), "is not inside"),
    (header("truth_mesh", "none.ply"), r"none\.ply: it does not exist"),
    (header("truth_mesh", "x" * 300), r"cannot read .*name is too long"),
    (header("views.1.azimuth_deg", "north"), r"views\[1\].azimuth_deg is 'north': expected 'float', got 'str'"),
    (header("views.1.azimuth_std_deg", -1), "azimuth_std_deg -1.0 of the image '001' is not"),
    (header("views.1.stretch", 1.1), r"views\[1\]: only images of a target aloft"),
    (header("views.1.apart_deg", 30.0), r"views\[1\]: the view is bistatic, which is not supported"),
    (header("views.1.turn", {"axis": [0, 0, 0], "angle_deg": 3}), r"views\[1\]\.turn: .* no direction"),
    (header("views.1.turn", {"axis": [0, 0, 1], "angle_deg": 3}), r"views\[1\]\.turn: View.* is not of a target that"),
    *(
        (header("views.1.file", file), "is not inside")
        for file in ("../images/001.tif", "/etc/passwd", "images/a\0b.tif", "", "images/\x1b[2J.tif")
    ),
    (header("views.1.file", "images/000.tif"), "same image"),
    (header("views.1.file", "images/none.tif"), "does not exist"),
    (header("views.1.file", "images"), "is a folder"),
]


def image(pixels: np.ndarray, **options: Any) -> Do:
    """Another first image."""
    return altered(lambda folder: tifffile.imwrite(folder / "images" / "000.tif", pixels, **options))


def linked(folder: Path, target: str) -> None:
    """A link in place of the first image, which is then beside the folder."""
    (folder / "images" / "000.tif").rename(folder.parent / "elsewhere.tif")
    (folder / "images" / "000.tif").symlink_to(target)


def beside(file: Path) -> Dataset:
    return read_dataset(file.parent)


FOLDERS: Refusals = [
    (lambda at: read_dataset(at / "nowhere"), "does not exist"),
    (stored(b"", beside, "001.tif"), r"not a dataset, .* no dataset\.json; .* `sarsplat info .*` recommends"),
    (stored(b"", beside, "metrics.jsonl"), "looks like a run"),
    (stored(b"{}", read_dataset, "dataset.json"), "is a file, not a folder"),
    (altered(lambda folder: linked(folder, "../../elsewhere.tif")), "is not inside"),
    (altered(lambda folder: linked(folder, "001.tif")), "same image file"),
    (altered(lambda folder: (folder / "terrain.tif").unlink(), ground=True, terrain=hill()), r"terrain\.tif"),
    (image(NOISE[0].astype(np.float64)), "float64"),
    (image(-NOISE[0]), "finite and ≥ 0"),
    (image(NOISE[0], compression="zlib", description="x" * 200), "compress"),
    (image(SIGNALS[0]), "holds complex64 pixels"),
    (stored(b"II*\0" + bytes(200), lambda path: read_tiff(path, (6, 5))), "holds no page"),
]

# ---- masks ----


def masks(pixels: np.ndarray | bytes, name: str = "001.png", dataset: Dataset | None = None, *sets: str) -> Do:
    """One mask in a folder."""

    def do(at: Path) -> object:
        if isinstance(pixels, bytes):
            (at / name).write_bytes(pixels)
        else:
            Image.fromarray(pixels).save(at / name)
        return read_masks(at, dataset or small_dataset(), sets or None)

    return do


def named(*names: str, **fields: Any) -> Dataset:
    made = small_dataset(**fields)
    entries = zip(made.entries, names, strict=True)
    return replace(made, entries=tuple(replace(entry, name=name) for entry, name in entries))


MASKS: Refusals = [
    (masks(np.zeros((16, 13), np.uint8)), "16 × 13 pixels"),
    (masks(np.full((16, 12), 127, np.uint8)), "holds the number 127"),
    *((masks(pixels), "is not a readable grey") for pixels in (np.zeros((16, 12, 3), np.uint8), b"")),
    *(
        (masks(np.zeros(size, np.uint8), "b.png", named("a", "b", "c", source=source)), "pixels, its image 16 × 12")
        for size, source in (
            ((14, 40), {"kind": "mstar"}),
            *(((20, 16), {"kind": "mstar", "mirrored": mirrored}) for mirrored in (False, True)),
        )
    ),
    (masks(small_mask(), "elsewhere.png"), r"has no mask of any test image .*002\.png"),
    (masks(small_mask(), "b.png", named("a", "b.1", "b.2")), r"'b\.1' and 'b\.2' would share the mask 'b\.png'"),
    *(
        (masks(small_mask(), "a.png", named(*(f"{out}{k}.jpeg" for k in range(3)))), "no mask can be named after")
        for out in ("/etc/", "../")
    ),
    (masks(small_mask(), "001.png", None, "test-15"), "has no set 'test-15'; it has train, test"),
    *(
        (lambda at, made=made: write_dataset(at / "out", made, masks=np.zeros((3, 16, 12), np.uint8)), words)
        for made, words in (
            (named("T72/a.jpeg", "b", "c"), "'T72/a.png' has a folder in it"),
            (small_dataset(source={"kind": "mstar"}), "these are measured chips"),
        )
    ),
]

# ---- terrain ----

HEIGHTS = np.arange(12.0).reshape(3, 4)
ASCII_GRID = b"ncols 2\nnrows 2\nxllcorner 8.5\nyllcorner 47.1\ncellsize 0.1\n1 2\n3 4\n"
DEGREES = (1, 1, 0, 1, 1024, 0, 1, 2)
UNKNOWN = (1, 1, 0, 3, 1024, 0, 1, 1, 3072, 0, 1, 32767)
TURNED = (34264, "d", 16, (2.0, 1, 0, 7, 1, -3, 0, 9, 0, 0, 0, 0, 0, 0, 0, 1), True)


def heights(values: np.ndarray = HEIGHTS, cut: int | None = None, **options: Any) -> Do:
    def do(at: Path) -> Terrain:
        path = write_geotiff(at / "bad.tif", values, **options)
        path.write_bytes(path.read_bytes()[:cut])
        return read_terrain(path)

    return do


TERRAIN: Refusals = [
    (heights(keys=DEGREES), "measured north in units called"),
    (heights(keys=(1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 2263)), "measured east in units called US survey foot"),
    *((heights(keys=(*UNKNOWN, key, 0, 1, 9002)), "another unit than metres .EPSG 9002") for key in (3076, 4099)),
    (heights(keys=(*UNKNOWN, 3076, 0, 1, 32767), extra=[(34736, "d", 1, (0.3,), True)]), "another unit than metres"),
    (heights(scale=None), "no pixel size"),
    (heights(np.where(HEIGHTS == 5, np.nan, HEIGHTS)), "1 unknown height of 12, within rows 2 to 2 and columns 2 to 2"),
    (heights(extra=[(42113, "s", 0, "6", True)]), "1 unknown height of 12"),
    (heights(np.zeros((4, 5, 3), np.uint8), photometric="rgb"), "has 3 bands of uint8"),
    (heights(scale=None, extra=[TURNED]), "rotated against"),
    (heights(cut=-40), "bad.tif"),
    (stored(b"heights", read_terrain), "is not a readable raster"),
    (stored(ASCII_GRID, read_terrain, "a.asc"), "names no coordinate system"),
]

# ---- PLY ----

PLACES = torch.randn(7, 3, generator=torch.Generator().manual_seed(0))
SCENE = upright(PLACES, 0.1, 1.0, Harmonics(torch.ones(7, 4), 0.05))


def points(places: np.ndarray, **columns: np.ndarray) -> Do:
    return lambda at: write_points_ply(at / "out.ply", places, **columns)


def points_with(old: bytes, new: bytes) -> Do:
    """Points that are read with other words in their header."""
    made = np.ones((9, 3))
    return lambda at: (
        write_points_ply(at / "p.ply", made, power=made[:, 0]) or read_points_ply(replaced(at / "p.ply", old, new))
    )


def gaussians_with(old: bytes, new: bytes) -> Do:
    return lambda at: write_gaussians_ply(at / "p.ply", SCENE) or read_gaussians_ply(replaced(at / "p.ply", old, new))


def replaced(path: Path, old: bytes, new: bytes) -> Path:
    data = path.read_bytes()
    assert data.count(old) == 1
    path.write_bytes(data.replace(old, new))
    return path


def gaussians(name: str, value: float) -> Do:
    """Gaussians that are written with another value in the fourth of them."""
    tensor = SCENE.tensors()[name].clone()
    tensor[3] = value
    return lambda at: write_gaussians_ply(at / "out.ply", SCENE.with_tensors(**{name: tensor}))


def points_read(places: np.ndarray, read: Do) -> Do:
    return lambda at: write_points_ply(at / "p.ply", places) or read(at / "p.ply")


P_MIN = b'"p_min": 0.05'
PLY: Refusals = [
    (gaussians("means", float("nan")), "NaN or an infinity in means"),
    (gaussians("scales", 1e-5), "scales of"),
    (gaussians("optical_depth", -1.0), "optical_depth of -1"),
    (gaussians("quaternions", 0.0), "quaternion of zeros"),
    (points(np.zeros((4, 2))), r"array of shape \(4, 2\); give"),
    (points(np.zeros((4, 3)), a=np.zeros(3)), r"column 'a' .* has shape \(3,\)"),
    (points(np.zeros((4, 3)), x=np.zeros(4)), "column 'x'"),
    (points(np.full((4, 3), np.nan)), "NaN or an infinity"),
    *(
        (points_read(np.eye(3) * far, read_points_ply), r"p\.ply holds a point .* from the origin")
        for far in (3e38, -1.1e9)
    ),
    (stored(bytes(33), read_gaussians_ply, "a.splat"), r"a\.splat has 33 bytes"),
    (stored(b"NGSP", read_gaussians_ply, "a.spz"), r"a\.spz is not a PLY .* or convert it, z up, with splat-"),
    (points_with(b"vertex 9", b"vertex 999999999999"), "is truncated"),
    (points_with(b"vertex 9", b"vertex -9"), "'element vertex -9' in its PLY header, which is garbled or of a mesh"),
    (points_with(b"ply\n", b"PLY\n"), "not a PLY file"),
    (points_with(b"binary_little_endian", b"ascii"), "only 'format binary_little_endian 1.0' is read"),
    (points_with(b"float power", b"list uchar int power"), "or of a mesh"),
    (points_with(b"float x", b"float q"), "is missing the vertex property 'x'"),
    (points_with(b"float y", b"float x"), "different names"),
    (points_with(b"element vertex", b"element corner"), "not one of vertices"),
    (points_read(np.eye(3), read_gaussians_ply), "is missing the vertex property 'rot_0'"),
    (lambda at: read_gaussians_ply(at / "none.ply"), "does not exist"),
    (gaussians_with(b"gaussians 2", b"gaussians 3"), "'sarsplat gaussians 3'"),
    (gaussians_with(b"scattering {", b"scattered {"), "exactly one scattering law"),
    (gaussians_with(b"harmonics", b"harmonica"), "'harmonica' is unknown; choose one of harmonics, normal-lobes"),
    (gaussians_with(P_MIN, b'"p_min": 1e+999'), r"the header of .*p\.ply: .*number out of range"),
    (gaussians_with(P_MIN, b'"p_min": -0.5'), "p_min -0.5 must be finite"),
    (gaussians_with(P_MIN, b'"gloss": 0.5'), "has an invalid scattering law .*gloss"),
]


@pytest.mark.parametrize(
    ("do", "words"),
    [*FILES, *CHECKPOINTS, *TABLES, *POWERS, *SETS, *WRITTEN, *HEADERS, *FOLDERS, *MASKS, *TERRAIN, *PLY],
)
def test_what_is_refused_in_a_sentence(tmp_path: Path, do: Do, words: str) -> None:
    check_refused(tmp_path, do, words)
