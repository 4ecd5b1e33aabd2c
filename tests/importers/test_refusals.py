"""What importers refuse, each in one sentence, writing nothing."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from PIL import Image

from chip_files import COLUMNS, LOWER_LEFT, MAGNITUDE, ROWS, phoenix_bytes, write_chips
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
from sarsplat.importers.pictures import likely_quantity, power_or_signal, read_pixels

# ---- pictures and a table ----


def table(names: str, **options: Any) -> Do:
    """A table with these columns."""
    return lambda at: import_pictures(write_pictures(at / "in", POWER, names=names), **options)


def stranger(file: str) -> Do:
    """A table that leads to a file."""

    def do(at: Path) -> object:
        np.save(at / "secret.npy", POWER[0])
        folder = write_pictures(at / "in", POWER, [["1.npy", 0, 30], [file, 10, 30]])
        (folder / "link.npy").symlink_to(at / "secret.npy")
        return import_pictures(folder)

    return do


def classes(**options: Any) -> Do:
    rows = [[f"{k}.npy", 90 * k, 30, "tank" if k < 3 else "car"] for k in range(4)]
    return lambda at: import_pictures(write_pictures(at / "in", POWER, rows, "file,azimuth,grazing,class"), **options)


def two_tables(at: Path) -> object:
    (write_pictures(at / "in", POWER) / "other.csv").write_text("a\n1\n")
    return import_pictures(at / "in")


PLAIN = "file,azimuth,grazing"
FOLDER: Refusals = [
    (table("file,heading,grazing"), r"no column that looks like the azimuth; name it .* \(there are file, heading"),
    (
        table("file,azimuth,x"),
        "like the grazing; name it .* grazing=NAME .incidence=NAME, .*, or give one grazing angle",
    ),
    (
        table("shot,heading,x", spacing_m=None),
        "like the file or the azimuth or the grazing or the spacing; name them with "
        "--columns file=NAME,azimuth=NAME,grazing=NAME,spacing=NAME .incidence=NAME, not grazing, .*, or give one",
    ),
    (table(PLAIN, columns={"az": "azimut"}), r"no column 'azimut' \(did you mean 'azimuth'\?\)"),
    (table(PLAIN, columns={"azimut": "x"}), r"can be a 'azimut' \(did you mean 'azimuth'\?\)"),
    (table("file,az,aspect"), "several columns that may be the azimuth: 'az', 'aspect'"),
    (table(PLAIN, spacing_m=None), "looks like the spacing; .* or give one spacing for all"),
    (table(PLAIN, spacing_m=(0.1, -1)), "pixel spacing"),
    (table(PLAIN, near="north"), "near is 'north'"),
    (table(PLAIN, quantity=None), "holds float32 numbers of unknown meaning"),
    (table("file,azimuth,split", grazing_deg=3), "line 2: the set is '30'; it must be train"),
    (table("file,azimuth,look", grazing_deg=3), "line 2: the look side is '30'"),
    (table("file,split,azimuth", grazing_deg=3), "the set is '0.0'"),
    (table("azimuth,file,grazing"), "has none of 4 pictures"),
    (stranger("../secret.npy"), "points outside"),
    (stranger("link.npy"), "is a link out of the folder"),
    (stranger("./1.npy"), "has two rows"),
    (two_tables, r"has 2 tables .* --table"),
    (lambda at: import_pictures(at / "none"), "is not a folder"),
    (classes(), r"2 classes \(tank, car\), and a dataset shows one; .* --class NAME"),
    (classes(target_class="Tank"), "no picture of the class 'Tank'; choose one of tank, car"),
    (table(PLAIN, target_class="tank"), "has no column of classes to choose 'tank' from; name it with --columns"),
]

# ---- images of any format ----


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
    (images(), "no images were given"),
    (images({}, {"pixels": np.ones((40, 44), np.float32)}), "some images are complex and others are not"),
    (images(*constant(0)[:2]), "all 2 images are black"),
    (images({}, {"center_m": (50.0, 0.0)}), "no part in common"),
    *((images(*constant(factor)), r"mean power of .*implausible in any unit") for factor in (1e-18, 1e18)),
    *(
        (images(*[{}] * 8, train_views=count), f"{count} training views? asked for, but there are 8 images")
        for count in (0, 9)
    ),
    (images({}, {"split": "test-17"}, train_views=2), "the images name their sets"),
    (images({"pixels": [[1.0, 2.0]]}), "pixels is .* give a numpy.ndarray"),
    (
        images({"pixels": np.ones((4, 4), np.uint8)}),
        "0.img holds uint8 of shape .4, 4.; give complex amplitudes, or power",
    ),
    (images({"pixels": np.ones((2, 4, 4), np.complex64)}), "0.img holds complex64 of shape .2, 4, 4.; give complex"),
    (images({"spacing_m": 0.3}), "spacing_m is 0.3; give 2 values"),
    (images({}, train_views="2"), "train_views is '2'; give a whole number"),
    (lambda _: dataset_of([1], target="thing", source={}), "images holds 1; make each an object of the class Measured"),
]

# ---- chips ----


def chips(change: Callable[[Path], object] = lambda folder: None, **options: Any) -> Do:
    """Labelled JPEGs, changed."""

    def do(at: Path) -> object:
        (folder := at / "chips").mkdir()
        write_chips(folder, ROWS)
        change(folder)
        return import_chips(folder, **options)

    return do


def originals(factor: float = 1 / 300, changed: Callable[[bytes], bytes] = lambda data: data, **options: Any) -> Do:
    """Phoenix files, the second of them changed."""

    def do(at: Path) -> object:
        (folder := at / "originals").mkdir()
        for index, azimuth in enumerate((2, 92, 178, 275, 300)):
            magnitude = LOWER_LEFT * np.float32(factor * (1 + index / 500))
            data = phoenix_bytes(magnitude, TargetAz=str(azimuth))
            (folder / f"HB{index}.015").write_bytes(changed(data) if index == 1 else data)
        (folder / "HB0.000").write_bytes(phoenix_bytes(TargetType="bmp2_tank"))
        return import_chips(folder, **{"labels": None, **options})

    return do


def labels(content: str | bytes) -> Do:
    """Other labels; a line of them alone is put below the columns."""
    if isinstance(content, str):
        content = f"{','.join(COLUMNS)}{content}".encode()
    return chips(lambda folder: (folder / "labels.csv").write_bytes(content), train_views=1)


def relabelled(change: Callable[[list[list[str]]], list[list[str]]]) -> Do:
    return chips(lambda folder: rewrite(folder / "labels.csv", change))


def scaled(value: str) -> Do:
    return chips(lambda folder: scale_chips(folder, ["5", "5", value, *["5"] * 7]))


def third(content: Callable[[bytes], bytes] | Image.Image, kind: str = "JPEG") -> Do:
    """Another picture in place of the fourth chip."""

    def change(folder: Path) -> None:
        path = folder / "T72" / "chip003.jpeg"
        if isinstance(content, Image.Image):
            content.save(path, format=kind)
        else:
            path.write_bytes(content(path.read_bytes()))

    return chips(change)


def black(folder: Path) -> None:
    for path in folder.rglob("*.jpeg"):
        Image.fromarray(np.zeros((16, 16), np.uint8)).save(path)


CHIP = "\nT72/chip000.jpeg,T72,132,17"
MSTAR: Refusals = [
    (chips(train_views=0), "train_views is 0; give at least 1, or 'all'$"),
    (
        chips(train_views=9),
        "9 training views asked for, but there are 8 chips at 17°; ask for 1 to 8, or add 15 to --train-depression$",
    ),
    (
        chips(train_depression=30),
        "no chips at the training depression of 30°, but 2 at 15° and 8 at 17°; choose among them with --train-depress",
    ),
    (
        chips(train_views=6, train_depression=(17, 15)),
        "3 of 6 training views asked for, but there are 2 chips at 15°; ask",
    ),
    (chips(train_depression=(17, 17)), r"\[17, 17\] must be at least one, each named once"),
    (
        relabelled(lambda rows: [[*rows[0], "azimuth_std_deg"], [*rows[1], "much"], *rows[2:]]),
        "line 2: azimuth_std_deg is 'much'",
    ),
    *(
        (
            relabelled(lambda rows, name=name, cell=cell: [[*rows[0], name], [*rows[1], cell], *rows[2:]]),
            rf"line 2: {name} is '{cell}', but MSTAR's radar is one, flies level .* `sarsplat import folder`",
        )
        for name, cell in (("tilt_deg", "-3"), ("look", "left"), ("side", "L"))
    ),
    (chips(azimuth_std_deg=11), r"azimuth_std_deg 11 of the image .* is not a number between 0 and 10"),
    (scaled(""), "line 4: dn_per_magnitude of 'T72/chip002.jpeg' is empty, so this chip is not comparable with the"),
    *(
        (scaled(text), f"line 4: dn_per_magnitude is '{text}'; it must be a positive number")
        for text in ("0", "-5", "nan", "much", "inf", "1e-300")
    ),
    (
        relabelled(lambda rows: [*rows, [*rows[3][:5], "200"]]),
        r"gives 'T72/chip002.jpeg' two labels, in lines 4 and 13",
    ),
    *(
        (
            relabelled(lambda rows, path=path: [*rows, [path, *rows[1][1:]]]),
            r"line 13: .* points outside the folder of chips|not a readable CSV",
        )
        for path in ("../outside.jpeg", "T72/../../outside.jpeg", "/etc/passwd", "T72/a\0b.jpeg")
    ),
    (
        chips(lambda folder: write_chips(folder, [*ROWS, ("T72", "812", 17, 200)]), serial="9"),
        "no T72 with the serial '9'; choose one of 132, 812",
    ),
    (chips(target_class="T80"), r"no class 'T80' in .*labels\.csv; it has BMP2, T72"),
    (lambda at: import_chips(at / "none"), "is not a folder"),
    (lambda at: (at / "empty").mkdir() or import_chips(at / "empty"), "is empty"),
    (chips(labels=None), r"no Phoenix file .* --labels"),
    (chips(lambda folder: shutil.rmtree(folder / "T72")), "has none of 10 chips in"),
    (chips(labels=Path("none.csv")), "does not exist"),
    (labels(b""), "is missing the columns 'path', 'class', "),
    (labels(b"path,class\nT72/chip000.jpeg,T72\n"), "is missing the columns 'serial', 'desired"),
    (labels(""), "has no rows"),
    (labels(b"\xff\xfe\x00"), "not a readable CSV"),
    (labels(CHIP + ",17.1,north\n"), "line 2: target_az_deg is 'north'"),
    (labels(CHIP + "\n"), "line 2: target_az_deg is empty"),
    (labels(CHIP + ",17.1,-361\n"), "line 2: target_az_deg is '-361'; directions are degrees, -360 to 360"),
    (
        relabelled(lambda rows: [[*rows[0], "near_side"], [*rows[1], "south"], *rows[2:]]),
        "line 2: near_side is 'south'; it must be one of top, right, bottom, left",
    ),
    (labels(CHIP + ",95,3\n"), "T72/chip000.jpeg: grazing angle 95"),
    (third(lambda data: data[: len(data) // 2]), r"(?i)chip003\.jpeg is .*truncated"),
    (third(lambda data: data[:-40]), r"(?i)chip003\.jpeg is .*truncated"),
    (third(lambda data: b"no"), r"(?i)chip003\.jpeg is .*a PNG or"),
    (third(Image.new("RGB", (16, 16), "red")), r"chip003\.jpeg is a picture in colour"),
    (third(Image.fromarray(np.ones((16, 16), np.uint16)), "PNG"), r"chip003\.jpeg holds u?int.* chips are 8-bit grey"),
    (chips(black), "all 4 training chips are black; .* from .*chips"),
    (originals(0), "all 4 training chips are black; .* from .*originals"),
    (originals(target_class="T80"), r"no class 'T80' in .*; it has bmp2_tank, t72_tank"),
    (originals(changed=lambda data: data[:-9]), r"HB1\.015 is truncated"),
    (originals(changed=lambda _: phoenix_bytes(RadarPosition="top")), "RadarPosition= 'top'"),
]

# ---- Phoenix files ----


def phoenix(data: bytes = phoenix_bytes(), asked: str | None = None, **changes: str) -> Do:
    """One file, of which something is asked."""

    def do(at: Path) -> object:
        (at / "HB03787.015").write_bytes(phoenix_bytes(**changes) if changes else data)
        chip = read_phoenix(at / "HB03787.015")
        return asked and getattr(chip, asked)

    return do


WHOLE = phoenix_bytes()
NAMED = r"HB03787\.015.*"
PHOENIX: Refusals = [
    (phoenix(b""), "not a Phoenix file"),
    (phoenix(b"\xff\xd8 a picture"), NAMED + "not a Phoenix file"),
    (phoenix(WHOLE[:-1]), NAMED + "is truncated"),
    (phoenix(WHOLE[:-150]), NAMED + "is truncated"),
    (phoenix(WHOLE[:200]), NAMED + "declares a header of"),
    (phoenix(WHOLE + b"x"), NAMED + "is too long"),
    (phoenix(NumberOfRows="4096", NumberOfColumns="4096"), NAMED + "is truncated"),
    *((phoenix(NumberOfRows=rows), NAMED + "NumberOfRows") for rows in ("1000000", "0", "-4")),
    (phoenix(NumberOfColumns=""), NAMED + "no readable NumberOfColumns"),
    (phoenix(native_header_length="512"), NAMED + "a scene and not a float32 chip"),
    (phoenix(WHOLE.replace(b"Length= 00", b"Length= 99")), NAMED + "declares a header of 99"),
    (phoenix(WHOLE.replace(b"Length= 00", b"Length= -1")), NAMED + "declares a header of 0"),
    (phoenix(WHOLE.replace(b"[EndofPhoenixHeader]", b"[EndOfPhoenixHeader]")), NAMED + "no .EndofPhoenixHeader"),
    (phoenix(WHOLE.replace(b"t72_tank", b"t72\xfftank")), NAMED + "not ASCII"),
    (phoenix(phoenix_bytes(-MAGNITUDE)), NAMED + "holds the magnitude -0.02 at row 0, column 1"),
    (phoenix(phoenix_bytes(MAGNITUDE * np.float32(np.nan))), NAMED + "holds the magnitude nan"),
    *((phoenix(TargetAz=value, asked="target_az_deg"), "TargetAz") for value in ("north", "nan", "inf", "")),
    (phoenix(RadarPosition="left", asked="image"), "RadarPosition= 'left'; only 'bottom'"),
    (lambda at: read_phoenix(at / "HB03787.015"), "does not exist"),
]

# ---- passes ----


def passes(columns: dict[str, list] = THREE, **options: Any) -> Do:
    return lambda at: import_passes(write_passes(at / "in", NOISY, columns), **options)


def second(pixels: np.ndarray) -> Do:
    """Other pixels in the second channel of the first view."""

    def do(at: Path) -> object:
        folder = write_passes(at / "in", NOISY, THREE)
        np.save(folder / "0-1.npy", pixels)
        return import_passes(folder)

    return do


def lines(change: Callable[[list[str]], Sequence[str]]) -> Do:
    """Other lines of the table."""

    def do(at: Path) -> object:
        path = write_passes(at / "in", NOISY, THREE) / "passes.csv"
        path.write_text("\n".join(change(path.read_text().splitlines())))
        return import_passes(at / "in")

    return do


def divided(text: list[str]) -> list[str]:
    sets = ["split", "train", "test", *["train"] * 4]
    return [f"{line},{split}" for line, split in zip(text, sets, strict=True)]


def third_line(old: str, new: str) -> Do:
    return lines(lambda text: [*text[:2], text[2].replace(old, new), *text[3:]])


PASSES: Refusals = [
    (lambda at: import_pictures(write_passes(at / "in", NOISY, THREE), quantity=None), "several rows for one view"),
    (passes(wavelength_m=-1.0), r"the view 'v0': wavelength_m is -1.0; give .* metres"),
    (passes(noise=0.0), "the view 'v0': the noise of a channel is 0.0"),
    (passes(transmit="both"), "transmit is 'both'; give one of each, one"),
    (passes({}), r"no column of baselines \(b/R, rad\) or of polarisations; name it with --columns baseline=NAME"),
    (passes({"baseline": [0.0, 1e-3, 1e-3]}), "the view 'v0': offsets_rad is .* two passes are the same"),
    (passes({"baseline": [0.0, 1e-3, 120]}), r"the view 'v0': an offset is 120.0; give b/R in radians, at most ±0.2"),
    (passes({"baseline": [0.0, "far", 2e-3]}), "line 3: baseline is 'far'; it must be a number"),
    (passes({"baseline": [0.0, "", 2e-3]}), "has no baseline of 0-1; give b/R, rad"),
    (passes({"baseline_m": [0.0, 0.1, 0.15]}), "'baseline_m' of .* seems to hold m; give perpendicular baselines over"),
    (passes({"Baseline (deg)": [0.0, 0.1, 0.15]}), "seems to hold deg; give"),
    (passes({"polarisation": ["HH", "HV", "XX"]}), "the view 'v0': a polarisation is 'XX'; give one of HH, HV"),
    (passes({"polarisation": ["HH", "", "VV"]}), "1 row of 3 have no polarisation, the first that of 0-1; fill"),
    (second(NOISY[0, 1][:-2]), r"different sizes, 20 × 16 pixels in 0-0 and 18 × 16 in 0-1; coregister"),
    (second(np.abs(NOISY[0, 1])), "the quantity is 'complex'"),
    (second(0 * NOISY[0, 1]), "0-1 is zero everywhere, which no channel of a stack is; leave out its row"),
    (lines(divided), "channels of different sets, 'train' in 0-0 and 'test' in 0-1; give them"),
    (lines(lambda text: text[:-1]), r"v0 has 3 channels and v1 has 2 \(0: no stack\); give all views the same"),
    (lines(lambda text: text[:-2]), "the view 'v1' has one row; a stack needs several"),
    (third_line("v0,0.0", "v0,0.1"), r"has channels of different angles, View\(.*0.0.* in 0-0 and .*0.1"),
    (third_line("v0", ""), "names no view of 0-1; name it in every row"),
    (
        lines(lambda text: [line.replace("view", "comment") for line in text]),
        "no column that says which rows are channels of one view; name it with",
    ),
]

# ---- phase history ----

GOOD = record(circle(np.linspace(-1, 1, 20)), [(0, 0, 0)])


def history(**changes: Any) -> Do:
    """One file; a change to None leaves a field out."""
    data = {name: value for name, value in {**GOOD, **changes}.items() if value is not None}
    return lambda at: import_phase_history([write(at / "a.mat", data)], at / "out", size_m=4)


def no_format(at: Path) -> object:
    (at / "a.bin").write_bytes(b"CPH")
    return import_phase_history([at / "a.bin"], at / "out", size_m=4)


def no_record(at: Path) -> object:
    (at / "a.mat").write_bytes(b"MATLAB".ljust(126) + b"IM")
    return import_phase_history([at / "a.mat"], at / "out", size_m=4)


def two_bands(at: Path) -> object:
    wide = np.linspace(60, 62, 20)
    paths = [
        write(at / "a.mat", record(circle(wide), [(0, 0, 0)])),
        write(at / "b.mat", record(circle(wide + 20), [(0, 0, 0)], FREQUENCIES - 25e9)),
    ]
    return import_phase_history(paths, at / "out", size_m=4)


HISTORY: Refusals = [
    (
        no_format,
        r"a\.bin is no phase history of a known format; give CPHD files .* or MATLAB files \(\.mat\) in the layout",
    ),
    (no_record, "holds no record named data"),
    (history(fp=None), "has no field fp"),
    (history(z=None), "has no field z"),
    (history(freq="X band"), "has no real numbers in freq"),
    (history(fp=GOOD["fp"].real), "has no complex numbers in fp"),
    (history(fp=GOOD["fp"][..., None].repeat(2, 2)), r"fp of the shape \(64, 20, 2\)"),
    (history(x=GOOD["x"][:-1]), "has 19 values of x for 20 pulses"),
    (history(freq=FREQUENCIES[1:]), "samples of 64 frequencies × 20 pulses, but 63 freq"),
    (history(af={"r_correct": np.zeros(20)}), "has no field ph_correct"),
    (history(af={"r_correct": np.zeros(3), "ph_correct": np.zeros(20)}), "3 values of r_correct"),
    (history(fp=GOOD["fp"] * np.nan), "holds a sample of nan"),
    (history(y=GOOD["y"] * np.inf), "holds an antenna position of -?inf"),
    (history(freq=FREQUENCIES[::-1]), "only rising, evenly spaced ones"),
    (history(freq=np.geomspace(30e9, 40e9, 64)), "only rising, evenly spaced ones"),
    (history(freq=FREQUENCIES / 1e6), "give them in hertz"),
    (history(r0=GOOD["r0"] + 5), "differs from r0 by 5 m"),
    (history(y=np.abs(GOOD["y"])), "the azimuth turns back after pulse"),
    (history(z=-GOOD["z"]), "the antenna is not above"),
    (
        lambda at: import_phase_history([write(at / "a.mat", GOOD)] * 2, at / "out", size_m=4),
        r"a\.mat is given twice; give each file once",
    ),
    (two_bands, r"b\.mat covers 1016 MHz about 10 GHz but .*a\.mat 1016 MHz about 35 GHz; import each band on its own"),
]

# ---- pixels and what they stand for ----

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


def objects(at: Path) -> object:
    np.save(at / "a.npy", np.array([[object()]], dtype=object), allow_pickle=True)
    return read_pixels(at / "a.npy")


PIXELS: Refusals = [
    (quantity(COMPLEX, "amplitude"), "it holds complex numbers, but the quantity is 'amplitude'; give that"),
    (quantity(REAL, "complex"), "it holds real numbers"),
    (quantity(-REAL, "power"), r"it holds -0\.1.* at \(0, 0\) as power"),
    (quantity(np.where(REAL[1, 2] == REAL, np.nan, REAL), "amplitude"), r"holds nan at \(1, 2\)"),
    (quantity(REAL * 1e4, "db"), "holds .* as db"),
    (quantity(COMPLEX.astype(complex) * 1e300, "complex"), "as complex"),
    (quantity(np.resize([1e300, -1e300, -1e300], (3, 4, 2)), "complex"), "as complex"),
    (quantity(REAL, "power", scale=math.nan), r"at \(0, 0\), times nan plus 0, as power"),
    *(
        (quantity(REAL * 0 - 18.5, name), r"holds -18\.5 at \(0, 0\) as .*; if .* decibels, give --quantity db")
        for name in ("amplitude", "power")
    ),
    (
        quantity(np.full((2, 2), 6119, np.uint16), "db"),
        r"holds 6119 .* as db; no decibels are that large; give --quantity ampl",
    ),
    (lambda _: likely_quantity(REAL, "it"), "it holds float32 numbers of unknown .* --quantity"),
    (picture(np.stack([EIGHT, ALPHA], axis=-1)), "transparent pixels, 2 of 12"),
    (picture(np.stack([EIGHT] * 3 + [ALPHA], axis=-1)), "transparent pixels, 2 of 12"),
    (picture(np.where(ALPHA, EIGHT, 7).astype(np.uint8), transparency=7), "transparent pixels, 2 of 12"),
    (picture(np.stack([EIGHT, ALPHA], axis=-1), "a.tif"), "masks 2 of its 12 pixels"),
    (picture(np.stack([EIGHT, EIGHT, 255 - EIGHT], axis=-1)), "picture in colour"),
    (objects, "not a readable array"),
    (matrices(image=REAL, b=REAL), r"2 matrices \(image, b\); give one image"),
    (matrices(image=np.ones((1, 5))), "has no matrix of numbers; give one image for each file"),
]

# ---- SAMPLE ----

SIGNAL = np.full((24, 18), 1 + 1j, np.complex64)


def sample(target: str = "t72", kind: str = "real", **changes: Any) -> Do:
    def do(at: Path) -> object:
        write_sample(at / "set", SIGNAL, 20.4, changes=changes)
        write_sample(at / "set", SIGNAL, 30.0, kind="synth")
        write_sample(at / "set", SIGNAL, 30.0, target="zsu23")
        return import_sample(at / "set", at / "out", target=target, kind=kind)

    return do


SAMPLE: Refusals = [
    (sample(complex_img=np.ones((4, 4))), "no complex matrix complex_img"),
    (sample(complex_img=SIGNAL * np.nan), "holds .*nan.* as complex"),
    (sample(azimuth=33.0), "azimuth is 33.0, but its name says 20°"),
    (sample(azimuth="north"), "azimuth is None"),
    (sample(elevation=None), "elevation is None, but its name says 16°"),
    (sample(range_pixel_spacing=0, xrange_pixel_spacing=-1), "has no pixel spacing in xrange_pixel_spacing"),
    (sample("m1"), r"no real images of 'm1'; it has t72 \(real\), t72 \(synthetic\), zsu23"),
    (sample(kind="odd"), "the kind is 'odd'"),
    (lambda at: import_sample(at, at / "out", target="t72"), "no file named like those"),
]


@pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")
@pytest.mark.parametrize(("do", "words"), [*FOLDER, *IMAGES, *MSTAR, *PHOENIX, *PASSES, *HISTORY, *PIXELS, *SAMPLE])
def test_what_is_refused_in_a_sentence(tmp_path: Path, do: Do, words: str) -> None:
    check_refused(tmp_path, do, words)
