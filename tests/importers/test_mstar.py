"""MSTAR import on made-up chips, and on the measured ones where they are at hand; Phoenix files as published."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import uniform_filter

from chip_files import LOWER_LEFT, MAGNITUDE, ROWS, phoenix_bytes, write_chips, write_originals
from made_imports import import_chips, rewrite, scale_chips
from sarsplat.cli import main
from sarsplat.data import Dataset, read_dataset
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR, Taylor
from sarsplat.importers import import_mstar, read_phoenix
from sarsplat.importers.pictures import read_pixels

pytestmark = pytest.mark.usefixtures("unexamined")

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data" / "mstar"
needs_measured = pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured MSTAR chips are not here")


@pytest.fixture
def chips(tmp_path):
    folder = tmp_path / "chips"
    folder.mkdir()
    write_chips(folder, ROWS)
    return folder


def target_az(dataset: Dataset) -> list[float]:
    """The published azimuths of its chips."""
    published = {chip["name"]: chip["target_az_deg"] for chip in dataset.source["chips"]}
    return [published[entry.name] for entry in dataset.entries]


def test_what_was_assumed_is_said(chips, originals):
    assert import_chips(chips).source["assumptions"] == [
        "near range is at the bottom of the chips, and they are not mirror images",
        "azimuth = −TargetAz; the grazing angle is the measured depression",
        "pixels are 0.2031 m × 0.2021 m, the resolution is 0.3229 m × 0.3013 m (azimuth × range)",
        "all JPEGs are scaled alike",
        "azimuths are exact",
    ]
    mirrored = import_chips(originals, labels=None, mirrored=True).source["assumptions"]
    assert (len(mirrored), mirrored[1].split(";")[0]) == (3, "azimuth = +TargetAz")


def test_splits_angles_and_order(chips):
    dataset = import_chips(chips)
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
    assert import_chips(chips, target_box_m=corners).target_box_m == corners


def test_training_chips_are_distinct_and_limited(chips):
    dataset = import_chips(chips, train_views=8)
    assert sorted(target_az(dataset.select("train"))) == sorted(row[3] for row in ROWS[:8])
    with pytest.warns(SarsplatWarning, match="leave a gap of 270° in azimuth, from 350° clockwise to 260°"):
        assert import_chips(chips, train_views=2, train_depression=15).splits() == ("train", "test-17")


def test_all_chips_of_a_depression_can_be_trained_on(chips):
    dataset = import_chips(chips, train_views="all")
    assert target_az(dataset.select("train")) == sorted(row[3] for row in ROWS[:8])
    assert dataset.source["train_views"] == 8
    both = import_chips(chips, train_views="all", train_depression=(17, 15))
    assert both.splits() == ("train",) and len(both) == 10


def test_several_classes_or_all_of_them_are_a_dataset_each(chips, tmp_path, capsys):
    words = f"import mstar {chips} --labels {chips}/labels.csv --train-views all --out {tmp_path}/sets"
    assert main([*words.split(), "--class", "all"]) == 0
    said = capsys.readouterr()
    assert "sets: 2 of 2 classes, a dataset each" in " ".join(said.out.split())
    assert said.out.count("azimuth = −TargetAz") == 1
    assert "assumed of 2 datasets: azimuth = −TargetAz" in " ".join(said.out.split())
    made = {path.name: read_dataset(path) for path in (tmp_path / "sets").iterdir()}
    assert {name: (one.target, len(one)) for name, one in made.items()} == {"BMP2": ("BMP2", 1), "T72": ("T72", 10)}
    assert main([*words.split(), "--class", "T72", "BMP2"]) == 2
    assert "already exists" in capsys.readouterr().err
    assert main([*words.split(), "--class", "T72", "T55", "--overwrite"]) == 2
    assert "error: T55: there is no class 'T55'" in capsys.readouterr().err


def test_without_tests_the_other_chips_are_not_even_read(chips):
    whole = import_chips(chips).select("train")
    (chips / "T72" / "chip001.jpeg").write_bytes(b"not a picture")
    with pytest.raises(SarsplatError, match="chip001"):
        import_chips(chips)
    alone = import_chips(chips, test=False)
    assert alone.splits() == ("train",)
    assert alone.entries == whole.entries
    assert np.array_equal(alone.power, whole.power)


def test_several_depressions_take_the_azimuths_in_turn(chips):
    with pytest.warns(SarsplatWarning, match="along directions 73°"):
        dataset = import_chips(chips, train_views=4, train_depression=(17, 15))
    train = dataset.select("train")
    assert [round(view.grazing_deg) for view in train.views] == [17, 15, 17, 15]
    assert target_az(train)[::2] == [359.5, 181]
    assert dataset.splits() == ("train", "test-17")  # both of 15° are trained on
    assert dataset.source["train_depression_deg"] == [17, 15]


def test_uncertain_azimuths(chips):
    """A column of the table, where it is filled in; elsewhere the option."""

    def stds(**options) -> list[float]:
        dataset = import_chips(chips, **options)
        found = {entry.name: entry.azimuth_std_deg for entry in dataset.entries}
        return [found[f"T72/chip{k:03d}.jpeg"] for k in (0, 1)]

    assert stds(azimuth_std_deg=1.5) == [1.5, 1.5]
    rewrite(chips / "labels.csv", lambda rows: [[*rows[0], "azimuth_std_deg"], [*rows[1], "0.5"], *rows[2:]])
    assert stds() == [0.5, 0]
    assert stds(azimuth_std_deg=1.5) == [0.5, 1.5]


def test_orientation_and_power(chips):
    image = import_chips(chips).images("train")[0]
    # Turned by 180°: what was lower left, near the radar, is upper right.
    assert image[:8, 8:].min() > 100 * image[:8, :8].max()
    assert image[:8, 8:].min() > 100 * image[8:].max()
    assert import_chips(chips).images("train").mean() == pytest.approx(1, rel=1e-5)
    dark = image.min()
    assert image.max() / dark == pytest.approx((200 / 2) ** 2, rel=0.03)  # dark pixels are raised to DN 2


def test_power_of_jpegs(chips):
    """Scaled alike, to the bit; a column that says the same of all of them changes nothing; scaled each in its way."""
    dataset = import_chips(chips)
    dn = [np.asarray(Image.open(chips / name), np.float32)[::-1, ::-1] for name in names(dataset)]
    power = np.maximum(np.stack(dn), 2) ** 2
    expected = power / np.float32(power[:4].mean(dtype=np.float64))
    np.testing.assert_array_equal(dataset.power, expected)
    assert "scaled alike" in dataset.source["calibration"]
    scale_chips(chips, ["1"] * 10)
    np.testing.assert_array_equal(import_chips(chips).power, expected)
    scale_chips(chips, ["37"] * 10)
    np.testing.assert_allclose(import_chips(chips).power, expected, rtol=1e-6)
    number = {f"T72/chip{index:03d}.jpeg": 100.0 + 7 * index for index in range(10)}
    scale_chips(chips, [str(value) for value in number.values()])
    dataset = import_chips(chips)
    power = expected / np.array([number[name] for name in names(dataset)])[:, None, None] ** 2
    np.testing.assert_allclose(dataset.power, power / power[:4].mean(), rtol=1e-5)
    assert "(max(DN, min_dn) / dn_per_magnitude)^2" in dataset.source["calibration"]


def names(dataset: Dataset) -> list[str]:
    return [entry.name for entry in dataset.entries]


def test_mirrored_flips_columns_and_azimuth(chips):
    plain, mirrored = import_chips(chips), import_chips(chips, target_class="t-72", mirrored=True)
    np.testing.assert_array_equal(mirrored.images("train"), plain.images("train")[:, :, ::-1])
    for a, b in zip(plain.views, mirrored.views):
        assert (a.azimuth_deg + b.azimuth_deg) % 360 == 0
    assert mirrored.source["mirrored"] is True


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
        (lambda t: [*t, ["T72/./chip002.jpeg", *t[3][1:]], t[4]], "repeats 2 labels; each chip is taken once", 10),
        (lambda t: [*t, ["T72/" + "a" * 5000, *t[1][1:]]], "lacks 1 of 11 chips in", 10),
        (lambda t: [t[0], ["t72/CHIP000.jpeg", *t[1][1:]], *t[2:]], "spells 1 file otherwise than they are called", 10),
    ],
    ids=["empty", "planned", "no class", "twice", "too long a path", "capitals"],
)
def test_what_the_table_lacks_is_said_once(chips, change, words, left):
    rewrite(chips / "labels.csv", change)
    with pytest.warns(SarsplatWarning, match=words) as caught:
        dataset = import_chips(chips)
    assert sum(str(chips) in str(item.message) for item in caught) == 1
    assert len({entry.name for entry in dataset.entries}) == len(dataset) == left
    if "measured" in words:
        assert {view.grazing_deg for view in dataset.select("train").views} == {17.0}
        assert {view.grazing_deg for view in dataset.select("test-15").views} == {15.1}


def test_several_vehicles(chips):
    write_chips(chips, [*ROWS, ("T72", "812", 17, 200)])
    with pytest.warns(SarsplatWarning, match="2 vehicles .serials 132, 812."):
        import_chips(chips)
    with pytest.warns(SarsplatWarning, match="one training view"):
        assert import_chips(chips, serial="812", train_views=1).source["serials"] == ["812"]


def test_different_sizes_are_cut(chips):
    Image.fromarray(np.pad(LOWER_LEFT, ((2, 3), (1, 1)))).save(chips / "T72" / "chip001.jpeg", quality=100)
    with pytest.warns(SarsplatWarning, match="all images are cut to what they have in common, 16 × 16"):
        dataset = import_chips(chips)
    assert dataset.source["cut_to_common_size"] is True
    np.testing.assert_allclose(dataset.images("test-17")[1][:8, 8:], dataset.images("train")[0][:8, 8:], rtol=0.1)


@pytest.fixture
def originals(tmp_path):
    folder = write_originals(tmp_path / "originals")
    (folder / "readme.txt").write_text("not a chip")
    return folder


def test_phoenix_originals(originals, chips):
    dataset = import_chips(originals, labels=None)
    assert target_az(dataset.select("train")) == [2, 92, 178, 275]
    assert [view.azimuth_deg for view in dataset.select("test-17").views] == [60]
    assert dataset.source["format"] == "phoenix"
    image, expected = dataset.images("train")[0], import_chips(chips).images("train")[0]
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
    expected = import_chips(originals, labels=None).power
    write_originals(originals, factor)
    np.testing.assert_allclose(import_chips(originals, labels=None).power, expected, rtol=1e-5)


def test_chips_of_other_spacings_are_resampled(originals):
    (originals / "HB1.015").write_bytes(phoenix_bytes(LOWER_LEFT / 300, TargetAz="92", CrossRangePixelSpacing="0.4"))
    with pytest.warns(SarsplatWarning, match=r"resampled to the finest, 0.2031 m × 0.2021 m"):
        assert import_chips(originals, labels=None).grid.spacing_m == (0.203125, 0.202148)


@needs_measured
def test_measured_t72(tmp_path):
    labels = Path(shutil.copy(MEASURED / "labels.csv", tmp_path))
    rewrite(labels, lambda rows: [rows[0], *[row for row in rows if row[1] == "T72"][::4]])
    with pytest.warns(SarsplatWarning) as caught:
        dataset = import_mstar(MEASURED, tmp_path / "t72", labels=labels, target_class="T72", train_views=8)
    left_out, cut_off, told = [str(item.message) for item in caught]  # all were taken at one grazing angle
    assert "has no label for" in left_out
    assert cut_off.startswith("0.21% of the pixels hold the largest value of their image, 0.62% at most")  # DN 255
    assert "the 8 training views determine positions 5.5 times less well along directions 76° above" in told
    assert [len(dataset.select(split)) for split in dataset.splits()] == [8, 232 // 4 - 8, 196 // 4]
    images = dataset.images("test-17")
    assert dataset.images("train").mean() == pytest.approx(1, rel=1e-5)
    # The target is bright and its shadow falls down, away from near range.
    mean = images.mean(0)
    assert mean[50:66, 54:74].mean() > 5
    assert mean[76:90, 56:72].mean() < 0.6 * mean[20:40, 56:72].mean()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "HB03787.015"


def test_reads_magnitudes_and_header(path):
    path.write_bytes(phoenix_bytes())
    chip = read_phoenix(path)
    np.testing.assert_array_equal(chip.magnitude, MAGNITUDE)
    assert chip.magnitude.dtype == np.float32
    assert chip.magnitude.dtype.isnative
    assert (chip.target_type, chip.serial, chip.radar_position) == ("t72_tank", "132", "bottom")
    assert (chip.target_az_deg, chip.measured_depression_deg, chip.desired_depression_deg) == (10.790657, 17.09375, 17)
    assert chip.spacing_m == (0.203125, 0.202148)
    assert chip.resolution_m == (0.3229, 0.3013)


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        (("-35dB_Taylor", "-35dB_Taylor"), TAYLOR),
        (("-30dB_Taylor", "-30dB_Taylor"), Taylor(30)),
        (("-35dB_Taylor", "-30dB_Taylor"), GAUSSIAN),
        (("-1e9dB_Taylor", "-1e9dB_Taylor"), GAUSSIAN),
        (("Hamming", "Hamming"), GAUSSIAN),
    ],
)
def test_the_header_states_the_response(path, stated, expected):
    path.write_bytes(phoenix_bytes(RangeWeighting=stated[0], CrossRangeWeighting=stated[1]))
    assert read_phoenix(path).response == read_phoenix(path).image.grid.response == expected
    path.write_bytes(phoenix_bytes())
    assert read_phoenix(path).response == GAUSSIAN


def test_a_chip_is_an_image(path):
    path.write_bytes(phoenix_bytes())
    image = read_phoenix(path).image
    np.testing.assert_allclose(image.power, MAGNITUDE[::-1, ::-1] ** 2, rtol=1e-6)  # row 0 near range
    np.testing.assert_allclose(image.signal, MAGNITUDE[::-1, ::-1] * np.exp(3j), rtol=1e-6)
    assert (image.view.azimuth_deg, image.view.grazing_deg) == (pytest.approx(349.209343), 17.09375)
    assert image.grid.spacing_m == (0.203125, 0.202148)


@needs_measured
@pytest.mark.parametrize(
    ("original", "jpeg", "header", "correlation"),
    [
        ("BMP2_HB03787.000", "BMP2", ("bmp2_tank", "9563", 346.491974), 0.94),
        ("T72_HB03787.015", "T72", ("t72_tank", "132", 10.790657), 0.955),
    ],
)
def test_originals_against_their_jpegs(original, jpeg, header, correlation):
    """One reader against the other, where the JPEG does not saturate: pixel by pixel, and less its noise."""
    chip = read_phoenix(MEASURED / "phoenix" / original)
    assert (chip.target_type, chip.serial, chip.target_az_deg) == header
    published = read_pixels(MEASURED / jpeg / "17deg" / "hb03787.jpeg")
    expected = np.minimum(chip.magnitude * 523.6, 255)  # as this set was scaled
    assert np.corrcoef(expected.ravel(), published.ravel())[0, 1] > correlation
    assert np.corrcoef(uniform_filter(expected, 3).ravel(), uniform_filter(published, 3).ravel())[0, 1] > 0.99
    assert expected.mean() == pytest.approx(published.mean(), rel=0.04)
