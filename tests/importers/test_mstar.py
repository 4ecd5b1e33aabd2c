"""MSTAR import on made-up chips, and on the measured ones where they are at hand."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chip_files import COLUMNS, LOWER_LEFT, ROWS, phoenix_bytes, write_chips
from sarsplat.data import Dataset, read_dataset
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry.responses import Taylor
from sarsplat.importers import import_mstar

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data" / "mstar"
needs_measured = pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured MSTAR chips are not here")


@pytest.fixture
def chips(tmp_path):
    folder = tmp_path / "chips"
    folder.mkdir()
    write_chips(folder, ROWS)
    return folder


def run(chips: Path, train_views: int = 4, target_class: str = "T72", **options):
    options = {"labels": chips / "labels.csv", **options}
    return import_mstar(chips, chips.parent / "out", target_class=target_class, train_views=train_views, **options)


def target_az(dataset: Dataset) -> list[float]:
    """The published azimuths of its chips."""
    published = {chip["name"]: chip["target_az_deg"] for chip in dataset.source["chips"]}
    return [published[entry.name] for entry in dataset.entries]


def test_what_was_assumed_is_said(chips, originals):
    assert run(chips).source["assumptions"] == [
        "near range is the bottom row of the published chips, and they are not mirror images",
        "azimuth = −TargetAz; the grazing angle is the measured depression",
        "pixels are 0.2031 m × 0.2021 m, the resolution is 0.3229 m × 0.3013 m (azimuth × range)",
        "all JPEGs are scaled alike",
        "azimuths are exact",
    ]
    mirrored = run(originals, labels=None, mirrored=True, overwrite=True).source["assumptions"]
    assert (len(mirrored), mirrored[1].split(";")[0]) == (3, "azimuth = +TargetAz")


def test_splits_angles_and_order(chips):
    dataset = run(chips)
    assert dataset.splits() == ("train", "test-17", "test-15")
    train = dataset.select("train")
    assert target_az(train) == [359.5, 89, 181, 269]  # 89 and 91 tie; the earlier name wins
    assert [view.azimuth_deg for view in train.views] == [0.5, 271, 179, 91]
    assert target_az(dataset.select("test-17")) == [1, 44, 91, 330]
    assert [view.grazing_deg for view in dataset.select("test-15").views] == [15.1, 15.1]
    assert (dataset.target, dataset.calibration, dataset.looks, dataset.ground) == ("T72", "relative", 1.0, True)
    assert dataset.score_margin == 3
    assert dataset.target_box_m is None
    assert [entry.name for entry in train.entries[:2]] == ["T72/chip007.jpeg", "T72/chip002.jpeg"]
    assert read_dataset(dataset.path).fingerprint() == dataset.fingerprint()
    assert "max(DN, min_dn)^2" in dataset.source["calibration"]
    assert (dataset.grid.spacing_m, dataset.grid.resolution_m) == ((0.203125, 0.202148), (0.3229, 0.3013))
    assert dataset.grid.response == Taylor(35, 4)
    corners = (-1.0, -2.0, 0.0), (3.0, 4.0, 5.0)
    assert run(chips, target_box_m=corners, overwrite=True).target_box_m == corners


def test_training_chips_are_distinct_and_limited(chips):
    dataset = run(chips, train_views=8)
    assert sorted(target_az(dataset.select("train"))) == sorted(row[3] for row in ROWS[:8])
    for count, remedy in ((0, "to 8$"), (9, "to 8, or add 15 to --train-depression$")):
        said = f"{count} training views asked for, but there are 8 chips at 17°; ask for 1 {remedy}"
        with pytest.raises(SarsplatError, match=said):
            run(chips, train_views=count, overwrite=True)
    said = (
        "no chips at the training depression of 30°, but 2 at 15° and 8 at 17°; choose among them with --train-depress"
    )
    with pytest.raises(SarsplatError, match=said):
        run(chips, train_depression=30, overwrite=True)
    with pytest.warns(SarsplatWarning, match="leave a gap of 270° in azimuth, from 350° clockwise to 260°"):
        assert run(chips, train_views=2, train_depression=15, overwrite=True).splits() == ("train", "test-17")


def test_without_tests_the_other_chips_are_not_even_read(chips):
    whole = run(chips).select("train")
    (chips / "T72" / "chip001.jpeg").write_bytes(b"not a picture")
    with pytest.raises(SarsplatError, match="chip001"):
        run(chips, overwrite=True)
    alone = run(chips, test=False, overwrite=True)
    assert alone.splits() == ("train",)
    assert alone.entries == whole.entries
    assert np.array_equal(alone.power, whole.power)


def test_several_depressions_take_the_azimuths_in_turn(chips):
    with pytest.warns(SarsplatWarning, match="along directions 73°"):
        dataset = run(chips, train_views=4, train_depression=(17, 15))
    train = dataset.select("train")
    assert [round(view.grazing_deg) for view in train.views] == [17, 15, 17, 15]
    assert target_az(train)[::2] == [359.5, 181]
    assert dataset.splits() == ("train", "test-17")  # both of 15° are trained on
    assert dataset.source["train_depression_deg"] == [17, 15]
    with pytest.raises(SarsplatError, match="3 of 6 training views asked for, but there are 2 chips at 15°; ask"):
        run(chips, train_views=6, train_depression=(17, 15), overwrite=True)
    with pytest.raises(SarsplatError, match=r"\[17, 17\] must be at least one, each named once"):
        run(chips, train_depression=(17, 17), overwrite=True)


def test_uncertain_azimuths(chips):
    """A column of the table, where it is filled in; elsewhere the option."""

    def stds(**options) -> list[float]:
        dataset = run(chips, overwrite=True, **options)
        return [
            {entry.name: entry.azimuth_std_deg for entry in dataset.entries}[f"T72/chip{k:03d}.jpeg"] for k in (0, 1)
        ]

    assert stds() == [0, 0]
    assert stds(azimuth_std_deg=1.5) == [1.5, 1.5]
    rewrite(chips / "labels.csv", lambda rows: [[*rows[0], "azimuth_std_deg"], [*rows[1], "0.5"], *rows[2:]])
    assert stds() == [0.5, 0]
    assert stds(azimuth_std_deg=1.5) == [0.5, 1.5]
    rewrite(chips / "labels.csv", lambda rows: [rows[0], [*rows[1][:-1], "much"], *rows[2:]])
    with pytest.raises(SarsplatError, match="line 2: azimuth_std_deg is 'much'"):
        stds()
    with pytest.raises(SarsplatError, match=r"azimuth_std_deg 11 of the image .* is not a number between 0 and 10"):
        run(chips, azimuth_std_deg=11, labels=write_chips(chips, ROWS), overwrite=True)


def test_orientation_and_power(chips):
    image = run(chips).images("train")[0]
    # Turned by 180°: what was lower left, near the radar, is upper right.
    assert image[:8, 8:].min() > 100 * image[:8, :8].max()
    assert image[:8, 8:].min() > 100 * image[8:].max()
    assert run(chips, overwrite=True).images("train").mean() == pytest.approx(1, rel=1e-5)
    dark = image.min()
    assert image.max() / dark == pytest.approx((200 / 2) ** 2, rel=0.03)  # dark pixels are raised to DN 2


def test_power_of_jpegs_that_are_scaled_alike(chips):
    """To the bit; a column that says the same of all of them changes nothing."""
    dataset = run(chips)
    dn = [np.asarray(Image.open(chips / name), np.float32)[::-1, ::-1] for name in names(dataset)]
    power = np.maximum(np.stack(dn), 2) ** 2
    expected = power / np.float32(power[:4].mean(dtype=np.float64))
    np.testing.assert_array_equal(dataset.power, expected)
    assert "scaled alike" in dataset.source["calibration"]
    scale_chips(chips, ["1"] * 10)
    np.testing.assert_array_equal(run(chips, overwrite=True).power, expected)
    scale_chips(chips, ["37"] * 10)
    np.testing.assert_allclose(run(chips, overwrite=True).power, expected, rtol=1e-6)


def test_power_of_jpegs_that_are_scaled_each_in_its_own_way(chips):
    plain = run(chips)
    number = {f"T72/chip{index:03d}.jpeg": 100.0 + 7 * index for index in range(10)}
    scale_chips(chips, [str(value) for value in number.values()])
    dataset = run(chips, overwrite=True)
    power = plain.power / np.array([number[name] for name in names(plain)])[:, None, None] ** 2
    np.testing.assert_allclose(dataset.power, power / power[:4].mean(), rtol=1e-5)
    assert "(max(DN, min_dn) / dn_per_magnitude)^2" in dataset.source["calibration"]


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("", "line 4: dn_per_magnitude of 'T72/chip002.jpeg' is empty, so this chip is not comparable with the others"),
        *((text, f"line 4: dn_per_magnitude is '{text}'; it must be a positive number") for text in ("0", "-5", "nan")),
        *((text, f"line 4: dn_per_magnitude is '{text}'; it must be a positive") for text in ("much", "inf", "1e-300")),
    ],
)
def test_wrong_scales(chips, value, words):
    scale_chips(chips, ["5", "5", value, *["5"] * 7])
    with pytest.raises(SarsplatError, match=words):
        run(chips)
    assert not (chips.parent / "out").exists()


def names(dataset: Dataset) -> list[str]:
    return [entry.name for entry in dataset.entries]


def scale_chips(chips: Path, scales: list[str]) -> None:
    """Give the T72 a scale each; the column of other classes stays empty."""
    column = ["dn_per_magnitude", *scales, ""]
    labels = write_chips(chips, ROWS)
    rewrite(labels, lambda rows: [[*row, cell] for row, cell in zip(rows, column, strict=True)])


def test_mirrored_flips_columns_and_azimuth(chips):
    plain, mirrored = run(chips), run(chips, target_class="t-72", mirrored=True, overwrite=True)
    np.testing.assert_array_equal(mirrored.images("train"), plain.images("train")[:, :, ::-1])
    for a, b in zip(plain.views, mirrored.views):
        assert (a.azimuth_deg + b.azimuth_deg) % 360 == 0
    assert mirrored.source["mirrored"] is True


def rewrite(labels: Path, change) -> None:
    with labels.open(newline="") as file:
        rows = list(csv.reader(file))
    with labels.open("w", newline="") as file:
        csv.writer(file).writerows(change(rows))


@pytest.mark.parametrize(
    ("change", "words", "left"),
    [
        # the azimuth of the second chip, the planned depression of the fifth
        (
            lambda t: [*t[:2], [*t[2][:5], ""], *t[3:5], [*t[5][:3], " ", *t[5][4:]], *t[6:]],
            r"empty fields for 2 of 10 chips \(the first: target_az_deg in line 3\)",
            8,
        ),
        (
            lambda t: [t[0], *([*row[:4], "", row[5]] for row in t[1:9]), *t[9:]],
            "no measured_depression_deg for 8 of 10 chips .*line 2",
            10,
        ),
        (lambda t: [*t[:2], [t[2][0], "", *t[2][2:]], *t[3:]], "has no label for 1 JPEG in", 9),
        (lambda t: [*t, ["T72/chip002.jpeg", *t[3][1:]], t[4]], "repeats 2 labels; each chip is taken once", 10),
        (lambda t: [*t, ["T72/./chip002.jpeg", *t[3][1:]], t[4]], "repeats 2 labels; each chip is taken once", 10),
        (lambda t: [*t, ["T72/" + "a" * 5000, *t[1][1:]]], "lacks 1 of 11 chips in", 10),
    ],
    ids=["empty", "planned", "no class", "twice", "twice, spelt otherwise", "too long a path"],
)
def test_what_the_table_lacks_is_said_once(chips, change, words, left):
    rewrite(chips / "labels.csv", change)
    with pytest.warns(SarsplatWarning, match=words) as caught:
        dataset = run(chips)
    assert sum(str(chips) in str(item.message) for item in caught) == 1
    assert len({entry.name for entry in dataset.entries}) == len(dataset) == left
    if "measured" in words:
        assert {view.grazing_deg for view in dataset.select("train").views} == {17.0}
        assert {view.grazing_deg for view in dataset.select("test-15").views} == {15.1}


def test_two_labels_of_one_chip_are_refused(chips):
    rewrite(chips / "labels.csv", lambda rows: [*rows, [*rows[3][:5], "200"]])
    with pytest.raises(SarsplatError, match=r"gives 'T72/chip002.jpeg' two labels, in lines 4 and 13"):
        run(chips)


@pytest.mark.parametrize("path", ["../outside.jpeg", "T72/../../outside.jpeg", "/etc/passwd", "T72/a\0b.jpeg"])
def test_labels_may_not_lead_out_of_the_folder(chips, path):
    shutil.copy(chips / "T72" / "chip000.jpeg", chips.parent / "outside.jpeg")
    rewrite(chips / "labels.csv", lambda rows: [*rows, [path, *rows[1][1:]]])
    with pytest.raises(SarsplatError, match=r"line 13: .* points outside the folder of chips|not a readable CSV"):
        run(chips)
    assert not (chips.parent / "out").exists()


def test_several_vehicles(chips):
    write_chips(chips, [*ROWS, ("T72", "812", 17, 200)])
    with pytest.warns(SarsplatWarning, match="2 vehicles .serials 132, 812."):
        run(chips)
    with pytest.warns(SarsplatWarning, match="one training view"):
        assert run(chips, serial="812", train_views=1, overwrite=True).source["serials"] == ["812"]
    with pytest.raises(SarsplatError, match="no T72 with the serial '9'; choose one of 132, 812"):
        run(chips, serial="9", overwrite=True)


def test_unknown_class_names_the_known_ones(chips):
    with pytest.raises(SarsplatError, match=r"no class 'T80' in .*labels\.csv; it has BMP2, T72"):
        run(chips, target_class="T80")


def test_wrong_folders(tmp_path, chips):
    with pytest.raises(SarsplatError, match="is not a folder"):
        run(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SarsplatError, match="is empty"):
        run(tmp_path / "empty")
    with pytest.raises(SarsplatError, match=r"no Phoenix file .* --labels"):
        run(chips, labels=None)
    with pytest.raises(SarsplatError, match="overwrite=True"):
        run(chips)
        run(chips)
    shutil.rmtree(chips / "T72")
    with pytest.raises(SarsplatError, match="has none of 10 chips in"):
        run(chips, overwrite=True)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is missing the columns 'path', 'class', "),
        (b"path,class\nT72/chip000.jpeg,T72\n", "is missing the columns 'serial', 'desired"),
        (",".join(COLUMNS).encode(), "has no rows"),
        (b"\xff\xfe\x00", "not a readable CSV"),
        (
            ",".join(COLUMNS).encode() + b"\nT72/chip000.jpeg,T72,132,17,17.1,north\n",
            "line 2: target_az_deg is 'north'",
        ),
        (",".join(COLUMNS).encode() + b"\nT72/chip000.jpeg,T72,132,17\n", "line 2: target_az_deg is empty"),
        (",".join(COLUMNS).encode() + b"\nT72/chip000.jpeg,T72,132,17,95,3\n", "T72/chip000.jpeg: grazing angle 95"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*has no label")
def test_wrong_labels(chips, content, words):
    (chips / "labels.csv").write_bytes(content)
    with pytest.raises(SarsplatError, match=words):
        run(chips, train_views=1)
    with pytest.raises(SarsplatError, match="does not exist"):
        run(chips, labels=chips / "none.csv")


def test_damaged_jpegs_are_named(chips):
    path = chips / "T72" / "chip003.jpeg"
    whole = path.read_bytes()
    for content, words in [(whole[: len(whole) // 2], "truncated"), (whole[:-40], "truncated"), (b"no", "a PNG or")]:
        path.write_bytes(content)
        with pytest.raises(SarsplatError, match=rf"(?i)chip003\.jpeg is .*{words}"):
            run(chips)
    Image.new("RGB", (16, 16), "red").save(path, format="JPEG")
    with pytest.raises(SarsplatError, match=r"chip003\.jpeg is a picture in colour"):
        run(chips)
    Image.fromarray(np.ones((16, 16), np.uint16)).save(path, format="PNG")
    with pytest.raises(SarsplatError, match=r"chip003\.jpeg holds u?int.* chips are 8-bit grey"):
        run(chips)


def test_different_sizes_are_cut(chips):
    Image.fromarray(np.pad(LOWER_LEFT, ((2, 3), (1, 1)))).save(chips / "T72" / "chip001.jpeg", quality=100)
    with pytest.warns(SarsplatWarning, match="all images are cut to what they have in common, 16 × 16"):
        dataset = run(chips)
    assert dataset.source["cut_to_common_size"] is True
    np.testing.assert_allclose(dataset.images("test-17")[1][:8, 8:], dataset.images("train")[0][:8, 8:], rtol=0.1)


@pytest.fixture
def originals(tmp_path):
    folder = tmp_path / "originals"
    folder.mkdir()
    write_originals(folder)
    (folder / "HB0.000").write_bytes(phoenix_bytes(TargetType="bmp2_tank"))
    (folder / "readme.txt").write_text("not a chip")
    return folder


def write_originals(folder: Path, factor: float = 1 / 300) -> None:
    for index, azimuth in enumerate((2, 92, 178, 275, 300)):
        magnitude = LOWER_LEFT * np.float32(factor * (1 + index / 500))
        (folder / f"HB{index}.015").write_bytes(phoenix_bytes(magnitude, TargetAz=str(azimuth)))


def test_phoenix_originals(originals, chips):
    dataset = run(originals, labels=None)
    assert target_az(dataset.select("train")) == [2, 92, 178, 275]
    assert [view.azimuth_deg for view in dataset.select("test-17").views] == [60]
    assert dataset.source["format"] == "phoenix"
    from_jpeg = import_mstar(
        chips, chips.parent / "jpeg", labels=chips / "labels.csv", target_class="T72", train_views=4
    )
    image, expected = dataset.images("train")[0], from_jpeg.images("train")[0]
    least = max(image.min(), expected.min())  # dark pixels are raised, each format's to its own least power
    bright = expected > 1.1 * least
    assert bright.sum() > 30
    np.testing.assert_allclose(image[bright], expected[bright], rtol=0.05)
    assert (image[~bright] <= 1.2 * least).all()
    assert dataset.images("train").mean() == pytest.approx(1, rel=1e-5)
    assert dataset.power.min() == pytest.approx(1e-3, rel=2e-3)  # zeros have no logarithm
    assert (dataset.source["min_power"], "min_dn" in dataset.source) == (1e-3, False)


@pytest.mark.parametrize("factor", [1e-9, 0.4, 523.6, 1e6])
def test_the_unit_of_originals_does_not_matter(originals, factor):
    expected = run(originals, labels=None).power
    write_originals(originals, factor)
    np.testing.assert_allclose(run(originals, labels=None, overwrite=True).power, expected, rtol=1e-5)


def test_black_chips_are_refused(chips, originals):
    for path in chips.rglob("*.jpeg"):
        Image.fromarray(np.zeros_like(np.asarray(Image.open(path)))).save(path)
    write_originals(originals, 0)
    for folder, options in ((chips, {}), (originals, {"labels": None})):
        with pytest.raises(SarsplatError, match=f"all 4 training chips are black; .* from .*{folder.name}"):
            run(folder, **options)
        assert not (folder.parent / "out").exists()


def test_wrong_originals(originals):
    with pytest.raises(SarsplatError, match=r"no class 'T80' in .*; it has bmp2_tank, t72_tank"):
        run(originals, labels=None, target_class="T80")
    good = (originals / "HB1.015").read_bytes()
    (originals / "HB1.015").write_bytes(good[:-9])
    with pytest.raises(SarsplatError, match=r"HB1\.015 is truncated"):
        run(originals, labels=None)
    (originals / "HB1.015").write_bytes(phoenix_bytes(RadarPosition="top"))
    with pytest.raises(SarsplatError, match="RadarPosition= 'top'"):
        run(originals, labels=None)


def test_chips_of_other_spacings_are_resampled(originals):
    (originals / "HB1.015").write_bytes(phoenix_bytes(LOWER_LEFT / 300, TargetAz="92", CrossRangePixelSpacing="0.4"))
    with pytest.warns(SarsplatWarning, match=r"resampled to the finest, 0.2031 m × 0.2021 m"):
        assert run(originals, labels=None).grid.spacing_m == (0.203125, 0.202148)


@needs_measured
def test_measured_t72(tmp_path):
    with pytest.warns(SarsplatWarning) as caught:
        dataset = import_mstar(
            MEASURED, tmp_path / "t72", labels=MEASURED / "labels.csv", target_class="T72", train_views=8
        )
    (told,) = [str(item.message) for item in caught]  # all were taken at one grazing angle
    assert "the 8 training views determine positions 5.5 times less well along directions 76° above" in told
    assert [len(dataset.select(split)) for split in dataset.splits()] == [8, 232 - 8, 196]
    images = dataset.images("test-17")
    assert dataset.images("train").mean() == pytest.approx(1, rel=1e-5)
    # The target is bright and its shadow falls down, away from near range.
    mean = images.mean(0)
    assert mean[50:66, 54:74].mean() > 5
    assert mean[76:90, 56:72].mean() < 0.6 * mean[20:40, 56:72].mean()


@needs_measured
def test_measured_originals(tmp_path):
    with pytest.warns(SarsplatWarning, match="3 vehicles|in azimuth"):
        dataset = import_mstar(MEASURED / "phoenix", tmp_path / "a", labels=None, target_class="BMP2", train_views=2)
    assert len(dataset) == 3
    assert dataset.grid.resolution_m == (0.3229, 0.3013)
