"""What importers refuse, each in one sentence, writing nothing; damaged files are those of the fuzz harness."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from PIL import Image

from chip_files import COLUMNS, MAGNITUDE, ROWS, phoenix_bytes, write_chips, write_originals
from made import write_sample
from made_imports import (
    NOISY,
    POWER,
    THREE,
    import_chips,
    import_passes,
    import_pictures,
    rewrite,
    scale_chips,
    write_passes,
    write_pictures,
)
from pulses import FREQUENCIES, circle, record, write
from refusals import Do, Refusals, check_refused
from sarsplat.geometry import View
from sarsplat.importers import MeasuredImage, dataset_of, import_phase_history, import_sample, read_phoenix
from sarsplat.importers.pictures import power_or_signal, read_pixels


def table(names: str, rows: list[list] | None = None, **options: Any) -> Do:
    """Pictures with a table of these columns."""
    return lambda at: import_pictures(write_pictures(at / "in", POWER, rows, names), **options)


def stranger(file: str) -> Do:
    """A table that leads to a file."""

    def do(at: Path) -> object:
        np.save(at / "secret.npy", POWER[0])
        folder = write_pictures(at / "in", POWER, [["1.npy", 0, 30], [file, 10, 30]])
        (folder / "link.npy").symlink_to(at / "secret.npy")
        return import_pictures(folder)

    return do


PLAIN, CLASSES = "file,azimuth,grazing", [[f"{k}.npy", 90 * k, 30, "tank" if k < 3 else "car"] for k in range(4)]
FOLDER: Refusals = [
    (table("shot,heading,x", spacing_m=None), "the file or the azimuth or the grazing or the spacing; .*grazing_deg"),
    (table(PLAIN, columns={"az": "azimut"}), r"no column 'azimut'; did you mean azimuth\?"),
    (table(PLAIN, columns={"azimut": "x"}), r"can be a 'azimut'; did you mean azimuth\?"),
    (table(PLAIN, spacing_m=(0.1, -1)), "pixel spacing"),
    (table(PLAIN, near="north"), "near is 'north'"),
    (table("file,azimuth,split", grazing_deg=3), "line 2: split is '30'; it must be one of train"),
    (table("file,azimuth,look", grazing_deg=3), "line 2: look is '30'; it must be one of left"),
    (table("file,azimuth,near_side", grazing_deg=3), "line 2: near_side is '30'; it must be one of top"),
    (table("azimuth,file,grazing"), "has none of 4 pictures"),
    (stranger("../secret.npy"), "points outside"),
    (stranger("link.npy"), "is a link out of the folder"),
    (stranger("./1.npy"), "has two rows"),
    (lambda at: import_pictures(at / "none"), "is not a folder"),
    (table(PLAIN + ",class", CLASSES, target_class="Tank"), r"2 classes \(tank, car\)"),
]


def images(*changes: dict[str, Any], **options: Any) -> Do:
    """One image for each set of changes, seen from as many sides."""

    def do(_: Path) -> object:
        made = []
        for k, change in enumerate(changes):
            fields = {"pixels": np.full((40, 44), 1 + 1j, np.complex64), "spacing_m": (0.15, 0.17), **change}
            view = View(k * 360 / len(changes), 20.0)
            made.append(MeasuredImage(f"{k}.img", view=view, resolution_m=(0.3, 0.35), **fields))
        return dataset_of(made, target="thing", source={"kind": "made up", "assumptions": []}, **options)

    return do


def constant(value: float) -> list[dict[str, Any]]:
    return [{"pixels": np.full((4, 4), value, np.complex64)} for _ in range(4)]


IMAGES: Refusals = [
    (images(), "no image with an azimuth was given"),
    (images({}, {"pixels": np.ones((40, 44), np.float32)}), "0.img has complex amplitudes and 1.img has power"),
    (images(*constant(0)[:2]), "all 2 images are black"),
    (images({}, {"center_m": (50.0, 0.0)}), "no part in common"),
    *((images(*constant(factor)), "implausible in any unit") for factor in (1e-18, 1e18)),
    *((images({}, {}, train_views=n), f"{n} training views? asked for, but there are 2 images") for n in (0, 3)),
    (images({}, {"split": "test-17"}, train_views=2), "the images name their sets"),
    (images({"pixels": np.ones((4, 4), np.uint8)}), "holds uint8 of shape .4, 4.; give complex amplitudes, or power"),
    (images({"pixels": np.ones((2, 4, 4), np.complex64)}), "0.img holds complex64 of shape .2, 4, 4.; give complex"),
]


def chips(change: Callable[[Path], object] = lambda folder: None, **options: Any) -> Do:
    """Labelled JPEGs, changed."""

    def do(at: Path) -> object:
        (folder := at / "chips").mkdir()
        write_chips(folder, ROWS)
        change(folder)
        return import_chips(folder, **options)

    return do


def originals(factor: float = 1 / 300, second: bytes | None = None, **options: Any) -> Do:
    """Phoenix files, perhaps with another second one."""

    def do(at: Path) -> object:
        folder = write_originals(at / "originals", factor)
        if second:
            (folder / "HB1.015").write_bytes(second)
        return import_chips(folder, **{"labels": None, **options})

    return do


def row(cells: str, name: str = "") -> Do:
    """One chip with these last cells, perhaps with a further column."""
    text = f"{','.join(COLUMNS)}{name and ','}{name}\nT72/chip000.jpeg,T72,132,17,{cells}\n"
    return chips(lambda folder: (folder / "labels.csv").write_text(text), train_views=1)


def scaled(value: str) -> Do:
    return chips(lambda folder: scale_chips(folder, ["5", "5", value, *["5"] * 7]))


def added(*cells: str) -> Do:
    """A further row: the third chip, with other cells."""
    return chips(lambda folder: rewrite(folder / "labels.csv", lambda rows: [*rows, [*cells, *rows[3][len(cells) :]]]))


def sixteen_bits(folder: Path) -> None:
    Image.fromarray(np.ones((16, 16), np.uint16)).save(folder / "T72" / "chip003.jpeg", format="PNG")


MSTAR: Refusals = [
    *((chips(train_depression=angles), "at least one angle, each once") for angles in ((), (17, 17))),
    (chips(train_views=9), "but there are 8 chips at 17°; ask for 1 to 8$"),
    (chips(train_views=6, train_depression=(17, 15)), "3 of 6 training views asked for, but there are 2 chips at 15°"),
    *((row(f"17.1,3,{cell}", name), f"{name} is '{cell}', but MSTAR's radar is one, flies level")
      for name, cell in (("tilt_deg", "-3"), ("look", "left"), ("side", "L"))),
    (chips(azimuth_std_deg=11), r"azimuth_std_deg 11 of the image .* is not a number between 0 and 10"),
    *((scaled(text), "line 4: dn_per_magnitude is .*number") for text in ("", "0", "-5", "nan", "much", "1e-300")),
    (added("T72/chip002.jpeg", "T72", "812"), "gives 'T72/chip002.jpeg' two labels, in lines 4 and 13"),
    *((added(path), "line 13: .* points outside the folder of chips") for path in ("../a.jpeg", "/etc/passwd")),
    (chips(serial="9"), "no T72 of serial '9'; choose one of 132"),
    (chips(target_class="T80"), r"no class 'T80' in .*labels\.csv; it has BMP2, T72"),
    (chips(lambda folder: (folder / "T72").rename(folder / "T73")), "has none of 10 chips in"),
    (chips(lambda folder: (folder / "labels.csv").write_text("path,class\na,T72\n")), "is missing the columns 'serial"),
    *((row(f"17.1,{cell}"), f"line 2: target_az_deg is {it}") for cell, it in (("north", "'north'"), ("", "empty"))),
    (row("17.1,3,south", "near_side"), "near_side is 'south'; it must be one of top, right, bottom, left"),
    (row("95,3"), "T72/chip000.jpeg: grazing angle 95"),
    (chips(sixteen_bits), r"chip003\.jpeg holds u?int.* chips are 8-bit grey"),
    (chips(lambda folder: [Image.new("L", (16, 16)).save(chip) for chip in folder.rglob("*.jpeg")]), "all 4 .* black"),
    (originals(0), "all 4 training chips are black"),
    (originals(target_class="T80"), r"no class 'T80' in .*; it has bmp2_tank, t72_tank"),
    (originals(second=phoenix_bytes(RadarPosition="top")), "RadarPosition= 'top'"),
]  # fmt: skip


def phoenix(data: bytes = b"", asked: str | None = None, **changes: str) -> Do:
    """One file, of which something is asked."""

    def do(at: Path) -> object:
        (at / "HB03787.015").write_bytes(data or phoenix_bytes(**changes))
        chip = read_phoenix(at / "HB03787.015")
        return asked and getattr(chip, asked)

    return do


PHOENIX: Refusals = [
    (phoenix(b"\xff\xd8 a picture"), "not a Phoenix file"),
    (phoenix(phoenix_bytes()[:-1]), "is truncated"),
    (phoenix(phoenix_bytes() + b"x"), "is too long"),
    *((phoenix(NumberOfRows=rows), "NumberOfRows") for rows in ("1000000", "0", "-4", "")),
    (phoenix(native_header_length="512"), "a scene and not a float32 chip"),
    (phoenix(phoenix_bytes(-MAGNITUDE)), "holds magnitude -0.02 at row 0, column 1"),
    *((phoenix(TargetAz=value, asked="target_az_deg"), "TargetAz") for value in ("north", "nan", "inf", "")),
    (phoenix(RadarPosition="left", asked="image"), "RadarPosition= 'left', not 'bottom'"),
]


def passes(columns: dict[str, list] = THREE, **options: Any) -> Do:
    return lambda at: import_passes(write_passes(at / "in", NOISY, columns), **options)


def second(pixels: np.ndarray) -> Do:
    """Other pixels in the second channel of the first view."""

    def do(at: Path) -> object:
        folder = write_passes(at / "in", NOISY, THREE)
        np.save(folder / "0-1.npy", pixels)
        return import_passes(folder)

    return do


def lines(change: Callable[[list[list[str]]], list[list[str]]]) -> Do:
    """Other rows of the table."""

    def do(at: Path) -> object:
        folder = write_passes(at / "in", NOISY, THREE)
        rewrite(folder / "passes.csv", change)
        return import_passes(folder)

    return do


def of_second(column: int, cell: str) -> Do:
    """Another cell in the row of the second channel."""
    return lines(lambda rows: [*rows[:2], [*rows[2][:column], cell, *rows[2][column + 1 :]], *rows[3:]])


SETS = ["split", "train", "test", *["train"] * 4]
PASSES: Refusals = [
    (lambda at: import_pictures(write_passes(at / "in", NOISY, THREE), quantity=None), "several rows for one view"),
    (passes(wavelength_m=-1.0), r"the view 'v0': wavelength_m is -1.0; give .* metres"),
    (passes(transmit="both"), "transmit is 'both'; give one of 'each', 'one'"),
    (lines(lambda rows: [[rows[0][0], "comment", *rows[0][2:]], *rows[1:]]), "lacks a column of views"),
    (passes({"baseline": [0.0, 1e-3, 120]}), r"offsets_rad is \(.*120.0\); give for each channel b/R in radians"),
    (passes({"baseline": [0.0, "", 2e-3]}), "does not state the baseline, b/R in radians, of 0-1"),
    (passes({"baseline_m": [0.0, 0.1, 0.15]}), "not state one unit of angle; give b/R in radians, and rename it"),
    (passes({"polarisation": ["HH", "", "VV"]}), "does not state the polarisation of 0-1"),
    (second(NOISY[0, 1][:-2]), r"different sizes, \(20, 16\) in 0-0 and \(18, 16\) in 0-1; coregister"),
    (second(np.abs(NOISY[0, 1])), "the quantity is 'complex'"),
    (second(0 * NOISY[0, 1]), "0-1 is zero everywhere"),
    (lines(lambda rows: [[*row, name] for row, name in zip(rows, SETS)]), "different sets, 'train' in 0-0 and 'test'"),
    (lines(lambda rows: rows[:-1]), "v0 has 3 channels and v1 has 2 channels"),
    (lines(lambda rows: rows[:-2]), "the view 'v1' has one row; a stack needs several"),
    (of_second(2, "0.1"), r"has channels of different angles, View\(.*0.0.* in 0-0 and .*0.1"),
    (of_second(1, ""), "does not state the view of 0-1"),
]

GOOD = record(circle(np.linspace(-1, 1, 20)), [(0, 0, 0)])


def history(*, times: int = 1, more: dict[str, Any] | None = None, **changes: Any) -> Do:
    """One file, perhaps several times, or another, with changed fields and options; one of None is left out."""
    data = {name: value for name in GOOD.keys() | {"af"} if (value := changes.pop(name, GOOD.get(name))) is not None}

    def do(at: Path) -> object:
        paths = [write(at / "a.mat", data)] * times + ([write(at / "b.mat", more)] if more else [])
        return import_phase_history(paths, at / "out", **{"size_m": 4.0, **changes})

    return do


def no_format(at: Path) -> object:
    (at / "a.bin").write_bytes(b"CPH")
    return import_phase_history([at / "a.bin"], at / "out", size_m=4)


HISTORY: Refusals = [
    (no_format, r"a\.bin is no phase history of a known format; give CPHD files .* or MATLAB files \(\.mat\) in the"),
    *((history(**{name: None}), f"has no field {name}") for name in ("fp", "z")),
    (history(freq="X band"), "has no real numbers in freq"),
    (history(fp=GOOD["fp"].real), "has no complex numbers in fp"),
    (history(fp=GOOD["fp"][..., None].repeat(2, 2)), r"fp of the shape \(64, 20, 2\)"),
    (history(x=GOOD["x"][:-1]), "has 19 values of x for 20 pulses"),
    (history(freq=FREQUENCIES[1:]), "has 63 frequencies, .* for samples of 64"),
    (history(af={"r_correct": np.zeros(20)}), "has no field ph_correct"),
    (history(af={"r_correct": np.zeros(3), "ph_correct": np.zeros(20)}), "3 values of r_correct"),
    (history(fp=GOOD["fp"] * np.nan), "holds a sample of nan"),
    (history(y=GOOD["y"] * np.inf), "holds an antenna position of -?inf"),
    *((history(freq=freq), "only rising, evenly spaced") for freq in (FREQUENCIES[::-1], np.geomspace(3e10, 4e10, 64))),
    (history(freq=FREQUENCIES / 1e6), "give them in hertz"),
    (history(r0=GOOD["r0"] + 5), "differs from r0 by 5 m"),
    (history(spacing_m=1e-4), "makes 40000 × 40000 pixels of"),
    (history(spacing_m=0.0), "makes 0 × 0 pixels of"),
    *((history(size_m=size), f"the size {size} m must be positive") for size in (math.nan, math.inf, -1)),
    *((history(aperture_deg=width), f"{width}° must be above 0°, at most 60°, and within") for width in (0, 9, 61)),
    (history(aperture_deg=5e-324), "holds [01] of 20 pulses; give a larger"),
    (history(train_views=2), "2 training views asked for, but there are 1 image"),
    (history(times=2), r"a\.mat is given twice; give each file once"),
    (
        history(more=record(circle(np.linspace(80, 82, 20)), [(0, 0, 0)], FREQUENCIES - 25e9)),
        r"b\.mat covers 1016 MHz about 10 GHz but .*a\.mat 1016 MHz about 35 GHz; import each band on its own",
    ),
]

EIGHT = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
REAL = np.linspace(0.1, 9, 12, dtype=np.float32).reshape(3, 4)
COMPLEX = (REAL * np.exp(1j * np.arange(12).reshape(3, 4))).astype(np.complex64)
ALPHA = np.where((EIGHT == 100) | (EIGHT == 120), 0, 255).astype(np.uint8)


def quantity(pixels: np.ndarray, name: str, **options: float) -> Do:
    return lambda _: power_or_signal(pixels, name, "it", **options)


def picture(pixels: np.ndarray, name: str = "a.png", **options: Any) -> Do:
    return lambda at: Image.fromarray(pixels).save(at / name, **options) or read_pixels(at / name)


def matrices(**variables: np.ndarray) -> Do:
    return lambda at: scipy.io.savemat(at / "a.mat", variables) or read_pixels(at / "a.mat")


PIXELS: Refusals = [
    (quantity(np.where(REAL[1, 2] == REAL, np.nan, REAL), "amplitude"), r"holds nan at \(1, 2\)"),
    (quantity(COMPLEX.astype(complex) * 1e300, "complex"), "as complex"),
    (quantity(np.resize([1e300, -1e300, -1e300], (3, 4, 2)), "complex"), "as complex"),
    (quantity(REAL, "power", scale=math.nan), r"at \(0, 0\), times nan plus 0, as power"),
    *((quantity(REAL * 0 - 18.5, name), r"holds -18\.5 .*quantity='db'") for name in ("amplitude", "power")),
    (quantity(np.full((2, 2), 6119, np.uint16), "db"), "holds 6119 .* as db; no decibels are that large"),
    *((picture(np.stack([*grey, ALPHA], axis=-1)), "masks 2 of its 12") for grey in ([EIGHT], [EIGHT] * 3)),
    (picture(np.where(ALPHA, EIGHT, 7).astype(np.uint8), transparency=7), "masks 2 of its 12"),
    (picture(np.stack([EIGHT, ALPHA], axis=-1), "a.tif"), "masks 2 of its 12 pixels"),
    (picture(np.stack([EIGHT, EIGHT, 255 - EIGHT], axis=-1)), "picture in colour"),
    (matrices(image=REAL, b=REAL), r"2 matrices \(image, b\); give one image"),
    (matrices(image=np.ones((1, 5))), "has no matrix of numbers; give one image for each file"),
]

SIGNAL = np.full((24, 18), 1 + 1j, np.complex64)


def sample(target: str = "t72", kind: str = "real", **changes: Any) -> Do:
    def do(at: Path) -> object:
        write_sample(at / "set", SIGNAL, 20.4, changes=changes)
        write_sample(at / "set", SIGNAL, 30.0, kind="synth")
        return import_sample(at / "set", at / "out", target=target, kind=kind)

    return do


SAMPLE: Refusals = [
    (sample(complex_img=np.ones((4, 4))), "no complex matrix complex_img"),
    (sample(azimuth=33.0), "has 33.0 as azimuth, but 20° in its name"),
    (sample(elevation=None), "has None as elevation"),
    (sample(range_pixel_spacing=0, xrange_pixel_spacing=-1), "has no pixel spacing in xrange_pixel_spacing"),
    (sample("m1"), r"no real images of 'm1'; it has t72 \(real\), t72 \(synthetic\)"),
    (lambda at: import_sample(at, at / "out", target="t72"), "no file named like those"),
]


@pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")
@pytest.mark.parametrize(("do", "words"), [*FOLDER, *IMAGES, *MSTAR, *PHOENIX, *PASSES, *HISTORY, *PIXELS, *SAMPLE])
def test_what_is_refused_in_a_sentence(tmp_path: Path, do: Do, words: str) -> None:
    check_refused(tmp_path, do, words)
